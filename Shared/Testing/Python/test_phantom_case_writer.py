"""Simulated case folders: every file of its mode, readable by others, and true to the patient."""

from __future__ import annotations

import json

import numpy as np
import pytest
import SimpleITK
from CranioNavLib.errors import InputError
from CranioNavLib.phantom import MODES, make_patient, write_case
from CranioNavLib.phantom.sites import outer_seats
from CranioNavLib.rigid import transform_points
from CranioNavLib.sequence_metafile import read_recording
from CranioNavLib.slicer_files import read_points

COMMON = {"landmarks-ct", "landmarks-patient", "targets-ct", "targets-patient", "plausibility"}


@pytest.fixture(scope="module")
def a_patient():
    return make_patient(None, 2)


@pytest.fixture(scope="module")
def places(a_patient):
    points, normals = outer_seats(a_patient.bone, a_patient.skin, np.random.default_rng(0))
    return points[:8], normals[:8]


@pytest.fixture(scope="module", params=MODES)
def a_case(request, a_patient, places, tmp_path_factory):
    folder = tmp_path_factory.mktemp("cases") / request.param
    write_case(a_patient, folder, *places, np.random.default_rng(4), request.param, ct_name="../ct.nrrd")
    return request.param, folder


def test_a_case_holds_the_files_of_its_mode(a_case):
    mode, folder = a_case
    names = {path.name for path in folder.iterdir()}
    expected = {f"{name}.mrk.json" for name in COMMON} | {"case.json"}
    expected |= {"IIb": {"points.mrk.json"}, "III": {"palpation.igs.mha"}}.get(mode, set())
    assert names == expected
    assert json.loads((folder / "case.json").read_text()) == {"ct": "../ct.nrrd"}


def test_patient_points_map_onto_their_ct_points_by_the_true_transform(a_patient, a_case):
    mode, folder = a_case
    largest = {"Ia": 1.5, "Ib": 8.0}.get(mode, 5.0)
    for name, limit in (("landmarks", largest), ("targets", 1.5)):
        planned, touched = (read_points(folder / f"{name}-{side}.mrk.json") for side in ("ct", "patient"))
        assert planned.labels == touched.labels
        back = transform_points(a_patient.true_reference_to_ras, touched.positions_mm)
        assert np.linalg.norm(back - planned.positions_mm, axis=1).max() < limit
    for name in ("plausibility", *(["points"] if mode == "IIb" else [])):
        on_bone = transform_points(a_patient.true_reference_to_ras, read_points(folder / f"{name}.mrk.json").positions_mm)
        assert a_patient.bone.closest(on_bone).distances_mm.max() < 2.5
    assert len(read_points(folder / "plausibility.mrk.json").labels) == 5


def test_the_recording_reads_back(a_case):
    mode, folder = a_case
    if mode != "III":
        assert not (folder / "palpation.igs.mha").exists()
        return
    recording = read_recording(folder / "palpation.igs.mha")
    assert sorted(set(recording.palpation_points)) == list(range(8))
    assert recording.acquisition.forerun_length_mm == 23.0
    assert "MISSING" in recording.statuses


def test_the_written_ct_has_every_voxel_in_its_place(a_patient, places, tmp_path):
    write_case(a_patient, tmp_path / "case", *places, np.random.default_rng(4), "IIa")
    image = SimpleITK.ReadImage(str(tmp_path / "case" / "ct.nrrd"))
    ct = a_patient.planning_ct
    assert np.array_equal(SimpleITK.GetArrayFromImage(image), ct.hu)
    for index in ((0, 0, 0), (100, 50, 20), (11, 222, 44)):
        lps = np.array(image.TransformIndexToPhysicalPoint(index))
        assert np.allclose(lps * (-1, -1, 1), ct.ijk_to_ras[:3, :3] @ index + ct.ijk_to_ras[:3, 3], atol=1e-6)


def test_an_unknown_mode_is_refused_by_name(a_patient, places, tmp_path):
    with pytest.raises(InputError, match=r"unknown mode 'IV'; modes are Ia, Ib, IIa, IIb, III"):
        write_case(a_patient, tmp_path / "x", *places, np.random.default_rng(0), "IV")
    assert not (tmp_path / "x").exists()
