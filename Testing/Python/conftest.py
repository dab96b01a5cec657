"""What end-to-end tests share: one simulated case on the real sample head."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest


@pytest.fixture(scope="session")
def _simulated_case(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A Mode III case with points.mrk.json added, so that every mode can be asked for; nobody may write into it."""
    from CranioNavLib.sample_head import load_sample_head

    from Workstation.demo_case import make_case

    folder = tmp_path_factory.mktemp("simulated")
    volume = load_sample_head()  # missing is a failure: nothing here is worth anything without the real head
    case = make_case(volume, seed=0, folder=folder / "case")
    touched = make_case(volume, seed=0, folder=folder / "touched", mode="IIb")
    shutil.copy(touched / "points.mrk.json", case / "points.mrk.json")
    shutil.rmtree(touched)
    return case


@pytest.fixture
def a_case(_simulated_case: Path, tmp_path: Path) -> Path:
    """A case folder of one's own; its CT is the shared one, named by case.json."""
    case = tmp_path / "case"
    case.mkdir()
    for file in _simulated_case.iterdir():
        if file.name != "ct.nrrd":
            shutil.copy(file, case / file.name)
    (case / "case.json").write_text(f'{{"ct": "{_simulated_case / "ct.nrrd"}"}}')
    return case
