"""Case folders from the command line, end to end, on the real sample head with simulated devices."""

from __future__ import annotations

import csv
import json
import re
from pathlib import Path

import numpy as np
import pytest
from CranioNavLib import host, scene, scene_data
from CranioNavLib.case import read_case
from CranioNavLib.rigid import rigid_from_vector
from CranioNavLib.sequence_metafile import read_recording
from CranioNavLib.slicer_files import LabelledPoints, load_scene, read_points, read_transform, write_points
from ModuleRegistrationLib import quantities
from ModuleRegistrationLib.procedure import register_case
from pypdf import PdfReader

from Workstation.__main__ import run
from Workstation.results import registration_record, write_registration

pytestmark = pytest.mark.xdist_group("simulated case")

KEYS = {
    "case", "mode", "method", "status", "messages", "reference_to_ras", "fre_mm", "surface_rms_mm", "iterations",
    "points_used", "points_rejected", "speed_of_sound_m_s", "predicted_tre_mm", "predicted_tre_p95_mm", "tre_mm",
    "tre_mean_mm", "tre_max_mm", "duration_s", "versions", "verification",
}  # fmt: skip


def registered(case: Path, out: Path, *options: str) -> dict:
    status = run(["register", str(case), "-o", str(out), *options])
    record = json.loads((out / "registration.json").read_text())
    assert status == (2 if record["status"] == "refused" else 0)
    return record


def computed(case: Path, mode: str, method: str | None = None) -> dict:
    """The record alone, without the files and pictures that the command writes."""
    return registration_record(register_case(read_case(case), mode, method))


def refusal(capsys, case: Path, *options: str) -> str:
    assert run(["register", str(case), "-o", str(case / "out"), *options]) == 2
    lines = capsys.readouterr().err.strip().splitlines()
    assert len(lines) == 1, lines
    return lines[0]


@pytest.mark.parametrize(("mode", "method"), [("IIa", "procrustes"), ("IIb", "cranionav"), ("III", "icp")])
def test_every_mode_gives_exactly_the_agreed_keys(a_case, mode, method):
    record = computed(a_case, mode, None if mode == "IIa" else method)
    assert set(record) == KEYS
    assert (record["mode"], record["method"], record["case"]) == (mode, method, "case")
    assert len(record["predicted_tre_mm"]) == len(record["tre_mm"]) == 10
    assert record["tre_mean_mm"] == pytest.approx(np.mean(record["tre_mm"]))
    # the limit of each mode is generous: this is one simulated trial, the studies look at many
    assert record["tre_mean_mm"] < (8.0 if mode == "IIa" else 2.5)


def test_a_registered_case_leaves_record_transform_scene_and_report(a_case, tmp_path):
    record = registered(a_case, tmp_path / "out")
    assert set(record) == KEYS
    assert (record["mode"], record["method"]) == ("III", "cranionav")
    assert record["tre_mean_mm"] < 2.5
    matrix = np.array(record["reference_to_ras"])
    np.testing.assert_allclose(read_transform(tmp_path / "out" / "ReferenceToRas.tfm"), matrix, atol=1e-9)
    load_scene(tmp_path / "out" / "scene.mrb")
    shown = [scene.find(role).GetDisplayNode().GetVisibility() for role in ("Bone", "OuterTable")]
    assert shown == [1, 0], "two surfaces that lie on each other flicker when both are drawn"
    np.testing.assert_allclose(scene_data.get_transform("ReferenceToRas"), matrix, atol=1e-9)
    np.testing.assert_allclose(scene_data.get_motion_error()[0], record["verification"]["covariance"])
    rows = dict(zip(*scene_data.get_table("Results").values()))
    assert "expected (p = " in rows[quantities.HELD_OUT]
    assert len(scene_data.get_bone_points()) >= 12
    told = record["verification"]["speed_of_sound"]
    assert told["with_the_registration"]["m_s"] == record["speed_of_sound_m_s"]
    assert told["by_pressing"] is None  # this hand never varies its pressure on a point
    node = host.scene().GetFirstNodeByName("SurfacePoints")
    assert node.GetParentTransformNode().GetName() == "ReferenceToRas"
    page = (tmp_path / "out" / "report.html").read_text()
    assert page.count("data:image/png;base64,") == 5
    assert re.findall(r'(?:src|href)="(?!data:)', page) == []
    assert "not a medical device" in page
    pages = [sheet.extract_text() for sheet in PdfReader(tmp_path / "out" / "report.pdf").pages]
    assert f"{record['tre_mean_mm']:.2f} ±" in pages[0]
    assert "not a medical device" in pages[-1]
    for number, text in enumerate(pages, 1):  # each sheet says whose it is: it may be read alone
        assert f"{number} / {len(pages)}" in text
        assert f"Case {record['case']} · mode III" in text


def test_the_error_of_a_transform_is_the_same_when_evaluated_alone(a_case, tmp_path, capsys):
    record = write_registration(register_case(read_case(a_case), "IIb"), tmp_path)
    arguments = ["--transform", tmp_path / "ReferenceToRas.tfm", "--targets-ct", a_case / "targets-ct.mrk.json",
                 "--targets-patient", a_case / "targets-patient.mrk.json", "--json"]  # fmt: skip
    assert run(["evaluate", *map(str, arguments)]) == 0
    alone = json.loads(capsys.readouterr().out)
    np.testing.assert_allclose(alone["tre_mm"], record["tre_mm"], atol=1e-6)
    assert alone["tre_sd_mm"] == pytest.approx(np.std(record["tre_mm"], ddof=1))


def test_a_batch_goes_on_past_a_case_that_fails(a_case, tmp_path, capsys):
    broken = tmp_path / "broken"
    broken.mkdir()
    out = tmp_path / "out"
    assert run(["batch", str(broken), str(a_case), "-o", str(out), "--mode", "IIa"]) == 0
    with (out / "summary.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [row["case"] for row in rows] == ["broken", "case"]
    assert rows[0]["status"] == "refused"
    assert "has no ct.nrrd" in rows[0]["message"]
    assert float(rows[1]["tre_mean_mm"]) > 0
    assert set(json.loads((out / "broken" / "registration.json").read_text())) == KEYS
    assert not (out / "case" / "scene.mrb").exists()
    assert not (out / "case" / "report.pdf").exists()


def test_a_batch_takes_the_series_that_is_asked_for(a_case, tmp_path):
    assert run(["batch", str(a_case), "-o", str(tmp_path / "out"), "--series", "7"]) == 2
    with (tmp_path / "out" / "summary.csv").open() as file:
        assert "leave out series='7'" in next(csv.DictReader(file))["message"]


def test_renamed_landmarks_pair_by_order_and_shuffled_ones_by_label(a_case):
    before = computed(a_case, "IIa")
    patient = read_points(a_case / "landmarks-patient.mrk.json")
    renamed = LabelledPoints(tuple(f"F-{index}" for index in range(len(patient))), patient.positions_mm)
    write_points(a_case / "landmarks-patient.mrk.json", renamed)
    by_order = computed(a_case, "IIa")
    shuffled = LabelledPoints(patient.labels[::-1], patient.positions_mm[::-1])
    write_points(a_case / "landmarks-patient.mrk.json", shuffled)
    by_label = computed(a_case, "IIa")
    for other in (by_order, by_label):
        np.testing.assert_allclose(other["reference_to_ras"], before["reference_to_ras"], atol=1e-9)


def test_an_oblique_ct_gives_the_same_registration(a_case):
    """The CT's voxels on a tilted grid, its anatomy where it was: only the resampling may be felt."""
    import SimpleITK as sitk

    before = computed(a_case, "IIb")
    image = sitk.ReadImage(json.loads((a_case / "case.json").read_text())["ct"])
    turn = rigid_from_vector([0.15, -0.1, 0.2], [0, 0, 0])[:3, :3]
    spacing, size = np.array([0.8, 0.8, 1.6]), np.array([300, 330, 150])
    middle = np.array(image.TransformContinuousIndexToPhysicalPoint([(n - 1) / 2 for n in image.GetSize()]))
    grid = sitk.Image([int(n) for n in size], sitk.sitkInt16)
    grid.SetSpacing(spacing.tolist())
    grid.SetDirection(turn.ravel().tolist())
    grid.SetOrigin((middle - turn @ (spacing * (size - 1) / 2)).tolist())
    oblique = sitk.Resample(image, grid, sitk.Transform(), sitk.sitkLinear, -1024)
    sitk.WriteImage(oblique, str(a_case / "ct.nii.gz"))
    (a_case / "case.json").unlink()
    after = computed(a_case, "IIb")
    assert after["tre_mean_mm"] == pytest.approx(before["tre_mean_mm"], abs=0.6)


def change_points(path: Path, change) -> None:
    points = read_points(path)
    labels, positions = change(list(points.labels), points.positions_mm.copy())
    write_points(path, LabelledPoints(tuple(labels), positions))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda labels, xyz: (labels[:3], xyz[:3]), "expected one CT point per patient point"),
        (lambda labels, xyz: (labels, xyz / 1000), "metre"),
        (lambda labels, xyz: (labels, np.outer(np.arange(len(xyz)), [30.0, 10, 5])), "line"),
        (lambda labels, xyz: (labels, np.repeat(xyz[:1], len(xyz), axis=0)), "one spot"),
    ],
)
def test_bad_landmarks_are_refused_by_name(a_case, capsys, change, message):
    change_points(a_case / "landmarks-patient.mrk.json", change)
    assert message in refusal(capsys, a_case, "--mode", "IIa")


RESULT_FILES = ("ReferenceToRas.tfm", "scene.mrb", "report.html", "report.pdf")


@pytest.mark.parametrize("why", ["landmarks in metres", "no such mode", "no such method", "no such case", "no plugin file"])
def test_a_refused_call_leaves_no_result_of_an_earlier_one(a_case, capsys, why):
    out = a_case / "out"
    out.mkdir()
    for name in RESULT_FILES:
        (out / name).write_text("an earlier result")
    if why == "landmarks in metres":
        change_points(a_case / "landmarks-patient.mrk.json", lambda labels, xyz: (labels, xyz / 1000))
    elif why == "no such case":
        (a_case / "landmarks-ct.mrk.json").unlink()
    options = {"no such mode": ("--mode", "IV"), "no such method": ("--method", "magic"), "no plugin file": ("--load", "no.py")}
    said = refusal(capsys, a_case, *options.get(why, ("--mode", "IIa")))
    assert not [name for name in RESULT_FILES if (out / name).exists()]
    record = json.loads((out / "registration.json").read_text())
    assert record["status"] == "refused"
    assert record["messages"][0] in said


def test_patient_targets_without_ct_targets_are_named_as_unused(a_case):
    (a_case / "targets-ct.mrk.json").unlink()
    record = computed(a_case, "IIa")
    assert record["tre_mm"] == []
    assert any("targets-patient is not used" in message for message in record["messages"])


def test_fewer_than_three_pairs_are_refused(a_case, capsys):
    for name in ("landmarks-patient.mrk.json", "landmarks-ct.mrk.json"):
        change_points(a_case / name, lambda labels, xyz: (labels[:2], xyz[:2]))
    assert "at least 3" in refusal(capsys, a_case, "--mode", "IIa")


@pytest.mark.parametrize("number", ["NaN", "1e300", "123456789.0"])
def test_coordinates_that_cannot_be_are_refused(a_case, capsys, number):
    path = a_case / "landmarks-patient.mrk.json"
    text = path.read_text()
    start = text.index('"position": [') + len('"position": [')
    path.write_text(text[:start] + number + text[text.index(",", start) :])
    assert "landmarks-patient" in refusal(capsys, a_case, "--mode", "IIa")


def test_recordings_without_use_are_refused_by_name(a_case, capsys):
    path = a_case / "palpation.igs.mha"
    whole = path.read_bytes()
    path.write_bytes(whole[:-2501])
    assert "cut" in refusal(capsys, a_case)
    path.write_bytes(re.sub(rb"(?m)^Seq_Frame\d+_ProbeToReferenceTransform.*\n", b"", whole))
    assert "ProbeToReference" in refusal(capsys, a_case)
    path.write_bytes(whole)
    path.write_bytes(re.sub(rb"(?m)^(Seq_Frame\d+_ProbeToReferenceTransformStatus) = .*$", rb"\1 = INVALID", whole))
    assert "INVALID" in refusal(capsys, a_case)


def test_an_unknown_method_or_mode_is_refused_by_name(a_case, capsys):
    assert "unknown registration 'magic'" in refusal(capsys, a_case, "--method", "magic")
    assert "unknown mode 'IV'" in refusal(capsys, a_case, "--mode", "IV")
    assert "uses paired points only" in refusal(capsys, a_case, "--mode", "IIa", "--method", "icp")


def test_a_ct_that_is_no_head_ct_is_refused(a_case, capsys):
    (a_case / "ct.nrrd").write_bytes(b"NRRD0004\ntype: short\n")
    (a_case / "case.json").unlink()
    assert "ct.nrrd" in refusal(capsys, a_case, "--mode", "IIa")


def test_depths_have_exactly_the_agreed_columns(a_case, tmp_path, capsys):
    assert run(["echo", str(a_case / "palpation.igs.mha"), "-o", str(tmp_path / "depths.csv")]) == 0
    with (tmp_path / "depths.csv").open() as file:
        rows = list(csv.DictReader(file))
    columns = "frame,timestamp_s,palpation_point,tissue_depth_mm,bone_x_mm,bone_y_mm,bone_z_mm,quality,accepted,reason"
    assert list(rows[0]) == columns.split(",")
    assert len(rows) == len(read_recording(a_case / "palpation.igs.mha"))
    assert {row["frame"] for row in rows} == {str(index) for index in range(len(rows))}
    refused = [row for row in rows if row["accepted"] in ("0", "False", "false")]
    assert all(row["reason"] for row in refused)
