"""The command line's outside: names, exit statuses, one clear line for bad input."""

from __future__ import annotations

import json
import subprocess
import sys

import pytest

from Workstation.__main__ import run

LISTED = {
    "demo",
    "test",
    "surface",
    "markers",
    "register",
    "batch",
    "evaluate",
    "plausibility",
    "echo",
    "plugins",
    "selftest",
    "workstation",
}


def refused(capsys: pytest.CaptureFixture[str], *arguments: object) -> str:
    """The one line that a refused call prints."""
    status = run([str(argument) for argument in arguments])
    lines = capsys.readouterr().err.strip().splitlines()
    assert status == 2
    assert len(lines) == 1, lines
    assert lines[0].startswith("cranionav: ")
    return lines[0]


def test_help_names_every_command(capsys):
    assert run(["--help"]) == 0
    said = capsys.readouterr().out
    assert all(name in said for name in LISTED)


def test_help_does_not_import_what_is_heavy():
    heavy = "numpy vtk slicer SimpleITK open3d scipy matplotlib pyvista trame".split()
    code = (
        "import sys; from Workstation.__main__ import run; run(['--help']); "
        f"print([name for name in {heavy!r} if name in sys.modules], file=sys.stderr)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stderr.strip() == "[]"


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["registre"], "No such command"),
        (["register"], "Missing argument"),
        (["register", "nowhere", "-o", "{tmp}/out"], "no case folder nowhere"),
        (["register", "{tmp}", "-o", "{tmp}/out"], "has no ct.nrrd"),
        (["surface", "nowhere.nrrd", "-o", "{tmp}/bone.vtp"], "nowhere.nrrd"),
        (["surface", "{tmp}", "-o", "{tmp}/bone.stl"], "written as .vtp"),
        (["echo", "nowhere.igs.mha", "-o", "{tmp}/d.csv"], "nowhere.igs.mha"),
        (["echo", "{tmp}/a.igs.mha", "-o", "{tmp}/a.igs.mha"], "is the recording itself"),
        (["markers", "{tmp}", "-o", "{tmp}/m.csv"], ".mrk.json"),
        (["selftest", "ModuleNothing"], "unknown module 'ModuleNothing'"),
        (["plugins", "--load", "{tmp}/none.py"], "no Python file"),
        (["plausibility", "--transform", "t.tfm", "--points", "p.mrk.json"], "either --surface or --ct"),
        (["evaluate", "--transform", "{tmp}/t.tfm", "--targets-ct", "{tmp}/a.fcsv", "--targets-patient", "b.fcsv"], "a.fcsv"),
    ],
)
def test_bad_calls_end_with_one_line_and_status_2(arguments, message, capsys, tmp_path):
    line = refused(capsys, *(argument.replace("{tmp}", str(tmp_path)) for argument in arguments))
    assert message in line


def test_an_output_folder_that_cannot_be_written_is_refused(capsys, tmp_path):
    (tmp_path / "file").write_text("")
    assert "cannot write into" in refused(capsys, "register", tmp_path, "-o", tmp_path / "file" / "out")


def test_a_defect_is_status_1_without_a_traceback(capsys, monkeypatch):
    from Workstation.commands import plugins

    def broken(*arguments: object, **options: object) -> None:
        raise RuntimeError("boom")

    monkeypatch.setattr("CranioNavLib.plugins.PluginKind.entries", broken)
    assert plugins is not None
    assert run(["plugins"]) == 1
    said = capsys.readouterr().err
    assert "defect: RuntimeError: boom" in said
    assert "Traceback" not in said
    assert run(["plugins"], debug=True) == 1
    assert "Traceback" in capsys.readouterr().err


def test_plugins_are_listed_for_programs(capsys):
    assert run(["plugins", "--json"]) == 0
    entries = json.loads(capsys.readouterr().out)
    names = {(entry["kind"], entry["name"]) for entry in entries}
    assert {("tracker", "simulated"), ("tracker", "replay"), ("amode", "simulated"), ("amode", "replay"),
            ("registration", "icp"), ("registration", "cranionav"), ("segmentation", "threshold")} <= names  # fmt: skip
    assert [entry for entry in entries if entry["problem"]] == []
