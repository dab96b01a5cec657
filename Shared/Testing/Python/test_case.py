"""The case folder: what its names lead to, and what is refused before anything is read."""

from __future__ import annotations

import json

import numpy as np
import pytest
from CranioNavLib.case import find_files, note_in_case, read_case
from CranioNavLib.errors import InputError
from CranioNavLib.slicer_files import LabelledPoints, write_points


@pytest.fixture
def a_folder(tmp_path):
    folder = tmp_path / "case"
    folder.mkdir()
    for name in ("ct.nrrd", "landmarks-ct.mrk.json", "landmarks-patient.mrk.json"):
        (folder / name).touch()
    (tmp_path / "elsewhere.mrk.json").touch()
    return folder


@pytest.mark.parametrize("key", ["target-ct", "Landmarks-CT", "landmarks_patient", "plausability", "points.mrk.jsn"])
def test_a_mistyped_name_is_refused_with_the_known_ones(a_folder, key):
    (a_folder / "case.json").write_text(json.dumps({key: "nowhere.mrk.json"}))
    with pytest.raises(InputError, match=rf"unknown name '{key}'; did you mean '[a-z.-]+'\? \(known: ct, landmarks-ct, .*"):
        find_files(a_folder)


def test_a_file_under_an_unknown_name_is_refused(a_folder):
    (a_folder / "case.json").write_text(json.dumps({"fiducials": "../elsewhere.mrk.json"}))
    with pytest.raises(InputError, match="unknown name 'fiducials' \\(known: ct, "):
        find_files(a_folder)


def test_notes_of_another_kind_may_stand_beside_the_names(a_folder):
    notes = {"seed": 7, "comment": "measured on a Monday. " * 200, "surgeon": "", "points.mrk.json": "../elsewhere.mrk.json"}
    (a_folder / "case.json").write_text(json.dumps(notes))
    found = find_files(a_folder)
    assert set(found) == {"ct", "landmarks-ct", "landmarks-patient", "points"}
    assert found["points"].resolve() == (a_folder.parent / "elsewhere.mrk.json").resolve()


def test_a_note_for_the_report_is_kept_beside_what_stands_in_case_json(a_folder):
    for name in ("landmarks-ct", "landmarks-patient"):
        write_points(a_folder / f"{name}.mrk.json", LabelledPoints(("a",), np.zeros((1, 3))), name)
    assert read_case(a_folder).note == ""
    (a_folder / "case.json").write_text(json.dumps({"surgeon": "M."}))
    note_in_case(a_folder, {"note": "Simulated patient"})
    note_in_case(a_folder, {})
    assert read_case(a_folder).note == "Simulated patient"
    assert json.loads((a_folder / "case.json").read_text()) == {"surgeon": "M.", "note": "Simulated patient"}
