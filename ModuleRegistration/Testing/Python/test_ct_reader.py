"""CT files other than DICOM: what is read and what is refused."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import SimpleITK as sitk
from CranioNavLib.errors import InputError
from CranioNavLib.volume import Volume
from ModuleRegistrationLib.anatomy.ct_reader import read_ct, write_ct
from ModuleRegistrationLib.anatomy.grid import Grid
from scipy.spatial.transform import Rotation


def refused(path: Path, words: str) -> None:
    with pytest.raises(InputError, match=words):
        read_ct(path)


def written(path: Path, hu: np.ndarray, spacing=(2.5, 2.5, 3.0), vector: bool = False) -> Path:
    image = sitk.GetImageFromArray(hu, isVector=vector)
    image.SetSpacing(spacing)
    sitk.WriteImage(image, str(path))
    return path


@pytest.fixture
def an_oblique_ct(ball) -> Volume:
    matrix = ball.ijk_to_ras.copy()
    matrix[:3] = Rotation.from_euler("zyx", (-14, 23, 8), degrees=True).as_matrix() @ matrix[:3]
    return Volume(ball.hu, matrix)


@pytest.mark.parametrize("suffix", [".nrrd", ".nii.gz", ".nii", ".mha"])
def test_what_is_written_is_read_back(an_oblique_ct, tmp_path, suffix):
    path = tmp_path / f"ct{suffix}"
    write_ct(path, an_oblique_ct)
    read = read_ct(path)
    assert np.array_equal(read.hu, an_oblique_ct.hu)
    assert read.ijk_to_ras == pytest.approx(an_oblique_ct.ijk_to_ras, abs=2e-4)


def test_the_volume_lies_where_simpleitk_says_in_lps(an_oblique_ct, tmp_path):
    write_ct(tmp_path / "ct.nrrd", an_oblique_ct)
    point = sitk.ReadImage(str(tmp_path / "ct.nrrd")).TransformIndexToPhysicalPoint((3, 5, 7))
    assert Grid.of(read_ct(tmp_path / "ct.nrrd")).to_ras([[7, 5, 3]])[0] == pytest.approx(np.array(point) * (-1, -1, 1), abs=1e-6)


def test_an_unknown_suffix_is_not_written(ball, tmp_path):
    with pytest.raises(InputError, match="unknown volume format"):
        write_ct(tmp_path / "ct.png", ball)


def test_a_missing_file_is_refused(tmp_path):
    refused(tmp_path / "ct.nrrd", "no CT at")


def test_whole_numbers_held_as_floats_are_rounded(ball, tmp_path):
    read = read_ct(written(tmp_path / "ct.nrrd", ball.hu.astype(np.float32) + 0.2))
    assert np.array_equal(read.hu, ball.hu)


def test_nan_voxels_are_counted(ball, tmp_path):
    hu = ball.hu.astype(np.float32)
    hu[3, 4, 5:8] = np.nan
    refused(written(tmp_path / "ct.nrrd", hu), "3 voxels hold NaN")


def test_a_colour_volume_is_refused(ball, tmp_path):
    refused(written(tmp_path / "ct.nrrd", np.stack([ball.hu] * 3, axis=-1), vector=True), "colour or vector image")


def test_a_2d_image_is_refused(ball, tmp_path):
    refused(written(tmp_path / "ct.mha", ball.hu[0], (2.5, 2.5)), "not a 3-D volume")


def test_a_4d_image_is_refused(ball, tmp_path):
    image = sitk.JoinSeries([sitk.GetImageFromArray(ball.hu)] * 2)
    sitk.WriteImage(image, str(tmp_path / "ct.nrrd"))
    refused(tmp_path / "ct.nrrd", "not a 3-D volume")


def test_metres_are_named(ball, tmp_path):
    refused(written(tmp_path / "ct.mha", ball.hu, (0.0025, 0.0025, 0.003)), "looks like metres")


@pytest.mark.parametrize(
    ("spacing", "words"), [((25.0, 25.0, 30.0), "expected 0.05 to 10 mm"), ((0.1, 0.1, 3.0), "covers 3 x 2 x 60 mm")]
)
def test_an_absurd_spacing_is_refused(ball, tmp_path, spacing, words):
    refused(written(tmp_path / "ct.nrrd", ball.hu, spacing), words)


def test_a_spacing_of_zero_is_refused(ball, tmp_path):
    path = tmp_path / "ct.mha"
    written(path, ball.hu)
    path.write_bytes(path.read_bytes().replace(b"ElementSpacing = 2.5 2.5 3", b"ElementSpacing = 0 2.5 3"))
    refused(path, "spacing|cannot read")


def test_values_that_are_not_hu_are_refused(ball, tmp_path):
    refused(written(tmp_path / "ct.nrrd", (ball.hu + 1024).astype(np.uint16)), "not in Hounsfield units")


def test_a_volume_without_bone_is_refused(ball, tmp_path):
    refused(written(tmp_path / "ct.nrrd", np.minimum(ball.hu, 100)), "shows no bone")


@pytest.mark.parametrize("suffix", [".nrrd", ".nii.gz", ".mha"])
def test_a_truncated_file_is_refused(ball, tmp_path, suffix):
    path = tmp_path / f"ct{suffix}"
    write_ct(path, ball)
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    refused(path, "cannot read|cut off")


@pytest.mark.parametrize("name", ["ct.nrrd", "ct.nii.gz", "ct.nii", "ct.mha"])
def test_a_file_of_something_else_is_refused(tmp_path, name):
    (tmp_path / name).write_bytes(b"not an image at all")
    refused(tmp_path / name, "cannot read")


def test_a_nrrd_that_does_not_say_how_it_lies_is_refused(ball, tmp_path):
    path = tmp_path / "ct.nrrd"
    path.write_bytes(
        b"NRRD0004\ntype: short\ndimension: 3\nsizes: 28 24 20\nspacings: 2.5 2.5 3\nendian: little\nencoding: raw\n\n"
        + ball.hu.tobytes()
    )
    refused(path, "does not say how it lies")


def test_a_nifti_that_does_not_say_how_it_lies_is_refused(ball, tmp_path):
    path = tmp_path / "ct.nii"
    write_ct(path, ball)
    data = bytearray(path.read_bytes())
    data[252:256] = bytes(4)
    path.write_bytes(data)
    refused(path, "does not say how it lies")


def test_a_series_cannot_be_chosen_from_a_single_image(ball, tmp_path):
    write_ct(tmp_path / "ct.nrrd", ball)
    with pytest.raises(InputError, match="holds no series"):
        read_ct(tmp_path / "ct.nrrd", series="2")
