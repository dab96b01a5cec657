"""`cranionav surface` on small CTs: its options, and what a stranger may give it."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from CranioNavLib.surface import Surface
from CranioNavLib.volume import Volume
from ModuleRegistrationLib.anatomy.ct_reader import write_ct

from Workstation.__main__ import run

RADIUS_MM = 50.0


def a_skull(bone_hu: int = 1300) -> Volume:
    """A round head of one soft tissue and one bone, 1.5 mm voxels, no blur."""
    step, count = 1.5, 90
    axis = (np.arange(count) - (count - 1) / 2) * step
    radius = np.sqrt(axis[:, None, None] ** 2 + axis[:, None] ** 2 + axis**2)
    hu = np.where(radius < RADIUS_MM + 6, 40, -1000)
    hu[(radius < RADIUS_MM) & (radius > RADIUS_MM - 6)] = bone_hu
    matrix = np.diag([-step, -step, step, 1.0])
    matrix[:3, 3] = -axis[0] * np.array([-1, -1, 1]) * -1
    return Volume(hu.astype(np.int16), matrix)


@pytest.fixture
def a_ct(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    write_ct(tmp_path / "ct.nrrd", a_skull())
    return tmp_path / "ct.nrrd"


def surface(ct: Path, *options: str) -> tuple[int, Path]:
    out = ct.parent / "bone.vtp"
    return run(["surface", str(ct), "-o", str(out), *options]), out


def test_bone_of_one_density_is_found(a_ct):
    status, out = surface(a_ct)
    assert status == 0
    radius = np.linalg.norm(Surface.read(out).vertices_mm, axis=1)
    outer = radius[radius > RADIUS_MM - 3]
    assert outer.mean() == pytest.approx(RADIUS_MM, abs=0.6)


def test_the_given_threshold_is_used_and_said(a_ct, capsys):
    status, _ = surface(a_ct, "--threshold", "250", "--json")
    assert status == 0
    assert json.loads(capsys.readouterr().out)["threshold_hu"] == 250


@pytest.mark.parametrize("threshold", ["20", "5000", "nan"])
def test_a_threshold_that_is_none_of_bone_is_refused(a_ct, capsys, threshold):
    status, out = surface(a_ct, "--threshold", threshold)
    assert status == 2
    assert "threshold_hu" in capsys.readouterr().err
    assert not out.exists()


def test_a_file_that_is_no_image_is_refused_in_words(tmp_path, capsys):
    (tmp_path / "ct.nrrd").write_text("hello")
    status, _ = surface(tmp_path / "ct.nrrd")
    said = capsys.readouterr().err
    assert status == 2
    assert "ct.nrrd" in said
    assert "it is no image of the kind its name says" in said
    assert "sitk" not in said
