"""DICOM folders: what is read, what is resampled, what is refused and how."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from CranioNavLib.errors import InputError
from CranioNavLib.volume import Volume
from ModuleRegistrationLib.anatomy.ct_reader import read_ct
from ModuleRegistrationLib.anatomy.grid import Grid, sample_linear
from scipy.spatial.transform import Rotation


def refused(path: Path, words: str, **options: str) -> None:
    with pytest.raises(InputError, match=words):
        read_ct(path, **options)


def at(volume: Volume, points_mm: np.ndarray) -> np.ndarray:
    return sample_linear(volume.hu, Grid.of(volume).to_index(points_mm))


def some_points(volume: Volume, count: int = 200) -> np.ndarray:
    random = np.random.default_rng(5)
    return Grid.of(volume).to_ras(random.uniform(2, np.array(volume.hu.shape) - 3, (count, 3)))


def test_values_stay_where_they_are_in_the_patient(a_dicom_folder, ball):
    read = read_ct(a_dicom_folder(ball))
    points = some_points(ball)
    assert at(read, points) == pytest.approx(at(ball, points), abs=1e-6)
    assert read.hu.dtype == np.int16
    assert "3" in read.description
    assert "Head 2.0" in read.description


def test_an_oblique_series_keeps_its_direction(a_dicom_folder, ball):
    turn = Rotation.from_euler("xyz", (20, -12, 7), degrees=True).as_matrix()
    matrix = ball.ijk_to_ras.copy()
    matrix[:3] = turn @ matrix[:3]
    oblique = Volume(ball.hu, matrix)
    points = some_points(oblique)
    assert at(read_ct(a_dicom_folder(oblique)), points) == pytest.approx(at(oblique, points), abs=0.01)


def test_a_sagittal_series_is_read_in_place(a_dicom_folder, ball):
    matrix = np.eye(4)
    matrix[:3, :3] = np.array([[0, 0, 3.0], [2.5, 0, 0], [0, -2.5, 0]])
    sagittal = Volume(ball.hu, matrix)
    points = some_points(sagittal)
    assert at(read_ct(a_dicom_folder(sagittal)), points) == pytest.approx(at(sagittal, points), abs=0.01)


def test_a_spacing_without_leading_zero_is_read(a_dicom_folder, ball):
    def edit(item, index):
        item.PixelSpacing = [".4785", ".4785"]
        item.Rows, item.Columns = 120, 120
        item.PixelData = np.tile(np.frombuffer(item.PixelData, np.uint16).reshape(24, 28), (5, 5))[:120, :120].tobytes()

    assert Grid.of(read_ct(a_dicom_folder(ball, edit=edit))).spacing_mm[1:] == pytest.approx((0.4785, 0.4785), abs=1e-12)


def test_rescale_slope_and_intercept_are_applied(a_dicom_folder, ball):
    def edit(item, index):
        item.RescaleSlope, item.RescaleIntercept = "2", "-3024"
        item.PixelData = ((np.frombuffer(item.PixelData, np.uint16).astype(int) + 2000) // 2).astype(np.uint16).tobytes()

    read = read_ct(a_dicom_folder(ball, edit=edit))
    points = Grid.of(ball).to_ras(np.argwhere(np.ones(ball.hu.shape))[::37])
    assert np.abs(at(read, points) - at(ball, points)).max() <= 1


def test_padding_below_air_becomes_air(a_dicom_folder, ball):
    def edit(item, index):
        values = np.frombuffer(item.PixelData, np.uint16).astype(int) - 1024
        values[:5] = -3024
        item.PixelRepresentation, item.RescaleIntercept = 1, 0
        item.PixelData = values.astype(np.int16).tobytes()

    assert read_ct(a_dicom_folder(ball, edit=edit)).hu.min() == -1024


def test_a_tilted_gantry_is_resampled_onto_a_rectangular_grid(a_dicom_folder, a_smooth_ct):
    drift = 0.6  # mm a slice of 3 mm: 11 deg
    read = read_ct(a_dicom_folder(a_smooth_ct, drift_mm=drift))
    axes = Grid.of(read).axes
    assert axes.T @ axes == pytest.approx(np.eye(3), abs=1e-6)
    index = np.random.default_rng(2).uniform(4, np.array(a_smooth_ct.hu.shape) - 5, (300, 3))
    true = Grid.of(a_smooth_ct).to_ras(index) + drift * index[:, :1] * Grid.of(a_smooth_ct).axes[:, 1]
    assert at(read, true) == pytest.approx(at(a_smooth_ct, Grid.of(a_smooth_ct).to_ras(index)), abs=12)


def test_a_folder_that_may_not_be_read_is_not_called_empty(tmp_path, monkeypatch):
    def locked(folder):
        raise PermissionError(13, "Permission denied", str(folder))

    monkeypatch.setattr(Path, "iterdir", locked)
    refused(tmp_path, "cannot read .*: Permission denied; check the folder's permissions")


def test_several_series_are_listed_and_asked_for(a_dicom_folder, ball):
    a_dicom_folder(ball, name="all/a", number=3)
    folder = a_dicom_folder(Volume(ball.hu + np.int16(7), ball.ijk_to_ras), name="all/b", number=4).parent
    refused(folder, r"2 series: number 3 \(CT, Head 2.0, 20 slices\); number 4 \(CT, Head 2.0, 20 slices\).*--series NUMBER")
    assert read_ct(folder, series="4").hu.max() == ball.hu.max() + 7
    refused(folder, "no series '9'.*number 3", series="9")


def test_series_of_one_number_are_told_apart_by_their_uid(a_dicom_folder, ball):
    a_dicom_folder(ball, name="all/a")
    folder = a_dicom_folder(ball, name="all/b").parent
    refused(folder, r"UID 1\.2")
    refused(folder, "2 series .* match '3'", series="3")


def test_localizers_within_the_series_are_passed_over(a_dicom_folder, ball):
    def edit(item, index):
        if index < 2:
            item.ImageType = ["ORIGINAL", "PRIMARY", "LOCALIZER"]
            item.ImageOrientationPatient = [1, 0, 0, 0, 0, -1]

    assert read_ct(a_dicom_folder(ball, edit=edit)).hu.shape[0] == ball.hu.shape[0] - 2


def test_a_localizer_beside_the_series_is_passed_over(a_dicom_folder, ball):
    a_dicom_folder(ball, name="all/a", number=2)
    folder = a_dicom_folder(Volume(ball.hu[:1], ball.ijk_to_ras), name="all/scout", number=1).parent
    assert read_ct(folder).hu.shape == ball.hu.shape


def test_files_that_are_no_dicom_are_passed_over(a_dicom_folder, ball):
    folder = a_dicom_folder(ball)
    (folder / "readme.txt").write_text("burnt on a Tuesday")
    assert read_ct(folder).hu.shape == ball.hu.shape


def test_a_copy_of_a_slice_is_taken_once(a_dicom_folder, ball):
    folder = a_dicom_folder(ball)
    (folder / "copy").write_bytes((folder / "IM0003").read_bytes())
    assert read_ct(folder).hu.shape == ball.hu.shape


def test_one_file_of_a_series_stands_for_it(a_dicom_folder, ball):
    assert read_ct(a_dicom_folder(ball) / "IM0003").hu.shape == ball.hu.shape


def test_a_missing_slice_is_named(a_dicom_folder, ball):
    refused(a_dicom_folder(ball, edit=lambda item, index: index != 8), r"1 slice\(s\) are missing between")


def test_a_changing_slice_distance_is_refused(a_dicom_folder, ball):
    def edit(item, index):
        place = [float(value) for value in item.ImagePositionPatient]
        item.ImagePositionPatient = [place[0], place[1], place[2] + max(0, index - 10) * 1.2]

    refused(a_dicom_folder(ball, edit=edit), "slice distance changes")


@pytest.mark.parametrize("step", [1.5, 0.625, 0.4])
def test_positions_rounded_to_a_tenth_of_a_millimetre_are_accepted(a_dicom_folder, ball, step, capfd):
    matrix = ball.ijk_to_ras.copy()
    matrix[2, 2], matrix[2, 3] = step, -20.25
    many = Volume(np.concatenate([ball.hu] * 6), matrix)

    def edit(item, index):
        item.ImagePositionPatient = [f"{float(value):.1f}" for value in item.ImagePositionPatient]

    spacing = Grid.of(read_ct(a_dicom_folder(many, edit=edit))).spacing_mm[0]
    assert capfd.readouterr().err == ""  # nor does a library grumble about it
    assert spacing == pytest.approx(step, abs=0.101 / (len(many.hu) - 1))


def test_rounded_slice_positions_are_accepted(a_dicom_folder, ball):
    def edit(item, index):
        item.ImagePositionPatient = [f"{float(value):.1f}" for value in item.ImagePositionPatient]

    assert read_ct(a_dicom_folder(ball, edit=edit)).hu.shape == ball.hu.shape


def test_two_slices_at_one_place_are_refused(a_dicom_folder, ball):
    folder = a_dicom_folder(ball)

    def same_series(item, index):
        item.SeriesInstanceUID = series
        return index == 5

    import pydicom

    series = pydicom.dcmread(folder / "IM0001").SeriesInstanceUID
    extra = a_dicom_folder(ball, name="other", edit=same_series)
    next(extra.iterdir()).rename(folder / "extra")
    refused(folder, "same position")


def test_mixed_orientations_are_refused(a_dicom_folder, ball):
    def edit(item, index):
        if index == 4:
            item.ImageOrientationPatient = [1, 0, 0, 0, 0, -1]

    refused(a_dicom_folder(ball, edit=edit), "mixes orientations")


def test_an_mr_series_is_refused(a_dicom_folder, ball):
    refused(a_dicom_folder(ball, edit=lambda item, index: setattr(item, "Modality", "MR")), "is MR, not CT")


def test_a_colour_image_is_refused(a_dicom_folder, ball):
    def edit(item, index):
        item.SamplesPerPixel, item.PhotometricInterpretation, item.PlanarConfiguration = 3, "RGB", 0

    refused(a_dicom_folder(ball, edit=edit), "colour")


def test_images_without_a_place_are_refused(a_dicom_folder, ball):
    refused(a_dicom_folder(ball, edit=lambda item, index: delattr(item, "ImagePositionPatient")), "lacks ImagePositionPatient")


def test_a_multi_frame_file_is_refused(a_dicom_folder, ball):
    refused(a_dicom_folder(ball, edit=lambda item, index: setattr(item, "NumberOfFrames", 2)), "multi-frame")


def test_too_few_slices_are_refused(a_dicom_folder, ball):
    refused(a_dicom_folder(ball, edit=lambda item, index: index < 3), "only 3 slices")


def test_a_changed_matrix_size_is_refused(a_dicom_folder, ball):
    def edit(item, index):
        if index == 4:
            item.Rows, item.Columns = 28, 24

    refused(a_dicom_folder(ball, edit=edit), "Rows is")


@pytest.mark.parametrize("left", [0.2, 0.9, 0.999])
def test_a_truncated_file_is_named(a_dicom_folder, ball, left):
    path = a_dicom_folder(ball) / "IM0007"
    path.write_bytes(path.read_bytes()[: int(path.stat().st_size * left)])
    refused(path.parent, "IM0007 (is cut off|is damaged)")


def test_an_empty_dcm_file_is_named(a_dicom_folder, ball):
    folder = a_dicom_folder(ball)
    (folder / "x.dcm").touch()
    refused(folder, "x.dcm is cut off or no DICOM")


def test_an_empty_folder_is_refused(tmp_path):
    refused(tmp_path, "is empty")


def test_a_folder_without_dicom_is_refused(tmp_path):
    (tmp_path / "notes.txt").write_text("nothing")
    refused(tmp_path, "holds no DICOM")


def test_a_file_that_is_no_image_is_refused(tmp_path):
    (tmp_path / "notes.txt").write_text("nothing")
    refused(tmp_path / "notes.txt", "no DICOM")


def test_stored_values_without_rescale_are_refused(a_dicom_folder, ball):
    refused(a_dicom_folder(ball, edit=lambda item, index: setattr(item, "RescaleIntercept", 0)), "not in Hounsfield units")


@pytest.fixture
def a_smooth_ct() -> Volume:
    """Values that change slowly, so that interpolation is nearly exact."""
    z, y, x = np.meshgrid(np.arange(20) * 3.0, np.arange(24) * 2.5, np.arange(28) * 2.5, indexing="ij")
    hu = 400 + 900 * np.sin(z / 20) * np.cos(y / 18) + 500 * np.sin(x / 15)
    hu[0, 0, 0] = -1000
    return Volume(np.rint(hu).astype(np.int16), np.diag([-2.5, -2.5, 3.0, 1.0]))
