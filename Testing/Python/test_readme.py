"""README's own text, run."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from pathlib import Path

import pytest

from Workstation.__main__ import run

ROOT = Path(__file__).resolve().parents[2]
BLOCKS = re.findall(r"```python\n(.*?)```", (ROOT / "README.md").read_text(encoding="utf-8"), re.DOTALL)

pytestmark = pytest.mark.xdist_group("simulated case")


def test_the_console_script_runs_as_it_stands(a_case, tmp_path):
    (tmp_path / "cranionav-demo").mkdir()
    (tmp_path / "cranionav-demo" / "case").symlink_to(a_case)
    script = next(block for block in BLOCKS if "ModuleRegistrationLogic()" in block)
    assert len(script.strip().splitlines()) <= 10
    done = subprocess.run([sys.executable, "-c", script], cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    said = done.stdout.splitlines()
    assert len(said) == 5
    assert "TRE" in said[-1]


def test_the_plugin_example_registers_a_case(a_case, tmp_path):
    example = next(block for block in BLOCKS if "class ShakenIcp(" in block)
    (tmp_path / "shaken_icp.py").write_text(example)
    command = ["register", str(a_case), "-o", str(tmp_path / "out"), "--mode", "IIb"]
    assert run([*command, "--load", str(tmp_path / "shaken_icp.py"), "--method", "shaken-icp"]) in (0, 2)
    record = json.loads((tmp_path / "out" / "registration.json").read_text())
    assert record["method"] == "shaken-icp"
    assert record["surface_rms_mm"] < 1.5


def test_every_command_of_the_table_exists(capsys):
    table = re.findall(r"^\| `(.*?)\|", (ROOT / "README.md").read_text(encoding="utf-8"), re.MULTILINE)
    named = {word for row in table for word in re.findall(r"`?(\w+)[^`]*`?", row)[:1]}
    assert run(["--help"]) == 0
    said = capsys.readouterr().out
    for name in named & {"register", "surface", "echo", "evaluate", "study", "tracker", "selftest"}:
        assert f" {name} " in said


def test_pictures_and_pages_that_it_links_to_are_there():
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    for target in re.findall(r"\]\((?!https?:)([^)#]+)\)", text):
        assert (ROOT / target).is_file(), target
