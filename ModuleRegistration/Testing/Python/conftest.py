"""What the tests stand on: shells whose edge is known, DICOM folders, the sample head, a touched patient."""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pydicom
import pytest
from CranioNavLib.errors import InputError
from CranioNavLib.volume import Volume
from pydicom.dataset import Dataset, FileMetaDataset
from pydicom.uid import ExplicitVRLittleEndian, generate_uid

sys.path.insert(0, str(Path(__file__).parent))
from touched_patient import a_logic, a_patient, a_skull  # noqa: F401 (fixtures)

CT_CLASS = "1.2.840.10008.5.1.4.1.1.2"


@pytest.fixture(scope="session")
def a_sample_head() -> Volume:
    """The real head CT."""
    from CranioNavLib.sample_head import load_sample_head

    try:
        return load_sample_head()
    except InputError as error:
        pytest.skip(str(error))


@pytest.fixture(scope="session")
def a_shell() -> Callable[..., Volume]:
    """Voxelised concentric spheres: scalp, outer table, diploe, inner table, brain. Truth by super-sampling."""
    kept: dict[str, Volume] = {}

    def shell(*arguments: Any, **options: Any) -> Volume:
        key = repr((arguments, options))
        if key not in kept:
            kept[key] = _shell(*arguments, **options)
        return kept[key]

    return shell


def _shell(
    radius_mm: float = 40.0,
    spacing_mm: tuple[float, float, float] = (2.0, 0.42, 0.42),
    layers: tuple[tuple[float, float], ...] = ((1.5, 1400.0), (3.0, 600.0), (1.5, 1400.0)),
    scalp_mm: float = 6.0,
    fwhm_mm: float = 0.8,
    rotation: np.ndarray | None = None,
    center_mm: tuple[float, float, float] = (0.0, 0.0, 0.0),
) -> Volume:
    """`spacing_mm` along k, j, i. The shell's centre lies at `center_mm` in RAS; the scanner's blur is in-plane."""
    from scipy.ndimage import gaussian_filter

    spacing = np.array(spacing_mm)
    shape = np.ceil(2 * (radius_mm + scalp_mm + 8) / spacing).astype(int)
    samples = (6, 2, 2)
    off = (0.3, 0.11, 0.07)  # the centre is not on the grid
    axes = [
        (np.arange(n * s).reshape(n, s) + 0.5) / s * d - n * d / 2 - o
        for n, s, d, o in zip(shape, samples, spacing, off, strict=True)
    ]
    edges, levels = [radius_mm + scalp_mm, radius_mm], [-1000.0, 40.0]
    for thickness, hu in layers:
        levels.append(hu)
        edges.append(edges[-1] - thickness)
    levels.append(40.0)
    steps = np.diff(levels)
    hu = np.zeros(shape, dtype=np.float32)
    for a in range(samples[0]):
        for b in range(samples[1]):
            for c in range(samples[2]):
                squared = (axes[0][:, a] ** 2)[:, None, None] + (axes[1][:, b] ** 2)[:, None] + axes[2][:, c] ** 2
                for edge, step in zip(edges, steps, strict=True):
                    hu += np.float32(step) * (squared < edge**2)
    hu = hu / np.prod(samples) - 1000.0
    if fwhm_mm:
        hu = gaussian_filter(hu, (0.0, *(fwhm_mm / 2.355 / spacing[1:])))
    turn = np.eye(3) if rotation is None else rotation
    matrix = np.eye(4)
    matrix[:3, :3] = turn * spacing[::-1]
    middle = np.array([(n - 1) * d / 2 + o for n, d, o in zip(shape, spacing, off, strict=True)])[::-1]
    matrix[:3, 3] = np.array(center_mm) - turn @ middle
    return Volume(np.rint(hu).astype(np.int16), matrix)


@pytest.fixture(scope="session")
def ball() -> Volume:
    """A small CT."""
    return _ball()


@pytest.fixture
def a_dicom_folder(tmp_path: Path) -> Callable[..., Path]:
    """Writes one slice a file; `edit(dataset, index)` may change each, or return False to leave it out."""

    def write(
        volume: Volume | None = None,
        name: str = "ct",
        number: int = 3,
        edit: Callable[[Dataset, int], Any] | None = None,
        drift_mm: float = 0.0,
    ) -> Path:
        return _write_dicom(tmp_path / name, _ball() if volume is None else volume, number, edit, drift_mm)

    return write


def _ball() -> Volume:
    """A small CT: a bone ball in air, 20 slices of 3 mm."""
    z, y, x = np.meshgrid(np.arange(20) - 9.5, np.arange(24) - 11.5, np.arange(28) - 13.5, indexing="ij")
    inside = (3 * z) ** 2 + (2.5 * y) ** 2 + (2.5 * x) ** 2 < 20**2
    hu = np.where(inside, 900, -1000).astype(np.int16) + np.arange(28, dtype=np.int16)
    matrix = np.diag([-2.5, -2.5, 3.0, 1.0])
    matrix[:3, 3] = (35.0, 30.0, -28.0)
    return Volume(hu, matrix)


def _write_dicom(folder: Path, volume: Volume, number: int, edit: Callable[[Dataset, int], Any] | None, drift_mm: float) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    ijk_to_lps = np.diag([-1.0, -1.0, 1.0, 1.0]) @ volume.ijk_to_ras
    spacing = np.linalg.norm(ijk_to_lps[:3, :3], axis=0)
    direction = ijk_to_lps[:3, :3] / spacing
    series = generate_uid()
    for index, voxels in enumerate(volume.hu):
        item = Dataset()
        item.file_meta = FileMetaDataset()
        item.file_meta.TransferSyntaxUID = ExplicitVRLittleEndian
        item.SOPClassUID, item.SOPInstanceUID = CT_CLASS, generate_uid()
        item.file_meta.MediaStorageSOPClassUID, item.file_meta.MediaStorageSOPInstanceUID = CT_CLASS, item.SOPInstanceUID
        item.Modality, item.SeriesInstanceUID, item.SeriesNumber, item.SeriesDescription = "CT", series, number, "Head 2.0"
        item.Rows, item.Columns = voxels.shape
        item.PixelSpacing = [f"{spacing[1]:.6g}", f"{spacing[0]:.6g}"]
        item.ImageOrientationPatient = [f"{value:.8f}" for value in np.r_[direction[:, 0], direction[:, 1]]]
        place = ijk_to_lps[:3, 3] + index * ijk_to_lps[:3, 2] + index * drift_mm * direction[:, 1]
        item.ImagePositionPatient = [f"{value:.6f}" for value in place]
        item.SamplesPerPixel, item.PhotometricInterpretation = 1, "MONOCHROME2"
        item.BitsAllocated, item.BitsStored, item.HighBit, item.PixelRepresentation = 16, 16, 15, 0
        item.RescaleSlope, item.RescaleIntercept = 1, -1024
        item.PixelData = (voxels.astype(np.int32) + 1024).astype(np.uint16).tobytes()
        if edit is None or edit(item, index) is not False:
            # last slice first: the order of the names is not that of the slices
            pydicom.dcmwrite(folder / f"IM{len(volume.hu) - index:04d}", item, enforce_file_format=True)
    return folder
