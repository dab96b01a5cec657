"""A head CT from a DICOM folder, NRRD, NIfTI or MetaImage: Hounsfield units and the voxels' place in RAS.

Files speak LPS (left-posterior-superior); the one conversion to RAS stands in `volume_from_image`.
"""

from __future__ import annotations

import gzip
import importlib
import math
import struct
import zlib
from pathlib import Path
from typing import Any, Optional

import numpy as np
import numpy.typing as npt
from CranioNavLib.errors import InputError
from CranioNavLib.files import written_whole
from CranioNavLib.rigid import Array
from CranioNavLib.volume import Volume

IMAGE_SUFFIXES = (".nrrd", ".nhdr", ".nii", ".nii.gz", ".mha", ".mhd")
LPS_RAS = np.diag([-1.0, -1.0, 1.0, 1.0])
LOWEST_HU, HIGHEST_HU = -1024, 32767  # scanners pad outside their circle with -2000 or -3024: it is air
SMALLEST_SPACING_MM, LARGEST_SPACING_MM = 0.05, 10.0
SMALLEST_EXTENT_MM, LARGEST_EXTENT_MM = 40.0, 2500.0
AIR_HU = -500  # a CT of a head shows the air around it


def read_ct(path: str | Path, series: Optional[str] = None) -> Volume:
    """The CT at `path`: a DICOM folder, one of its files, or a .nrrd, .nii, .nii.gz or .mha file.

    Parameters
    ----------
    path
        The folder or file.
    series
        Which series of a DICOM folder: its number, description or SeriesInstanceUID. Not needed for one series.

    Returns
    -------
    Volume
        HU as int16, air below -1024 raised to it; oblique volumes keep their direction, a tilted gantry's
        slices are resampled onto a rectangular grid.

    Raises
    ------
    InputError
        Missing, empty or damaged input, several series, missing slices, mixed orientations, another modality
        than CT, colour, 2-D or 4-D images, NaN voxels, an absurd spacing, values that are not HU.
    """
    path = Path(path)
    if not path.exists():
        raise InputError(f"no CT at {path}; give a DICOM folder or a .nrrd, .nii.gz or .mha file")
    if path.is_dir() or not path.name.lower().endswith(IMAGE_SUFFIXES):
        from ModuleRegistrationLib.anatomy.dicom_series import read_dicom

        return volume_from_image(*read_dicom(path, series), where=str(path))
    if series is not None:
        raise InputError(f"{path} is a single image and holds no series; leave out series={series!r}")
    _require_orientation(path)
    sitk: Any = importlib.import_module("SimpleITK")
    try:
        image = sitk.ReadImage(str(path))
    except RuntimeError as error:
        raise InputError(f"cannot read {path}: {_reason(error)}; export the CT again") from None
    return volume_from_image(image, path.name, where=str(path))


def volume_from_image(image: Any, description: str, where: str) -> Volume:
    """A SimpleITK image (LPS) as a Volume (RAS), checked to be a 3-D CT in HU.

    Raises
    ------
    InputError
        As `read_ct`; `where` names the input in the message.
    """
    sitk: Any = importlib.import_module("SimpleITK")
    if image.GetNumberOfComponentsPerPixel() != 1:
        raise InputError(
            f"{where} is a colour or vector image ({image.GetNumberOfComponentsPerPixel()} values a voxel), not a CT"
        )
    if image.GetDimension() == 4 and image.GetSize()[3] == 1:
        image = image[:, :, :, 0]
    if image.GetDimension() != 3 or min(image.GetSize()) < 2:
        size = " x ".join(str(n) for n in image.GetSize())
        raise InputError(f"{where} is not a 3-D volume (it has {size} voxels); give the whole CT, one time point")
    direction = np.array(image.GetDirection()).reshape(3, 3)
    spacing = np.array(image.GetSpacing())
    _check_geometry(direction, spacing, np.array(image.GetSize()), where)
    ijk_to_lps = np.eye(4)
    ijk_to_lps[:3, :3] = direction * spacing
    ijk_to_lps[:3, 3] = image.GetOrigin()
    hu = _as_hu(sitk.GetArrayFromImage(image), where)
    return Volume(hu, LPS_RAS @ ijk_to_lps, description)


def write_ct(path: str | Path, volume: Volume) -> None:
    """`volume` as a compressed .nrrd (or .nii.gz, .mha), whole or not at all.

    Raises
    ------
    InputError
        The suffix is none of these, or the folder cannot be written to.
    """
    path = Path(path)
    if not path.name.lower().endswith((".nrrd", ".nii", ".nii.gz", ".mha")):
        raise InputError(f"cannot write {path}: unknown volume format; use .nrrd, .nii.gz or .mha")
    sitk: Any = importlib.import_module("SimpleITK")
    image = sitk.GetImageFromArray(volume.hu)
    ijk_to_lps = LPS_RAS @ np.asarray(volume.ijk_to_ras, dtype=float)
    spacing = np.linalg.norm(ijk_to_lps[:3, :3], axis=0)
    image.SetSpacing(spacing.tolist())
    image.SetDirection((ijk_to_lps[:3, :3] / spacing).ravel().tolist())
    image.SetOrigin(ijk_to_lps[:3, 3].tolist())
    with written_whole(path) as temporary:
        sitk.WriteImage(image, str(temporary), useCompression=True)


def _as_hu(values: npt.NDArray[Any], where: str) -> npt.NDArray[np.int16]:
    if values.dtype.kind == "f":
        missing = int(np.count_nonzero(~np.isfinite(values)))
        if missing:
            raise InputError(f"{where}: {missing} voxels hold NaN or infinity; export the CT again as whole numbers in HU")
        values = np.rint(values)
    low, high = float(values.min()), float(values.max())
    if low > AIR_HU:
        raise InputError(
            f"{where} is not in Hounsfield units: its values run from {low:g} to {high:g} and none is air (-1000); "
            "export it with rescale slope and intercept applied, not cropped inside the head"
        )
    if high < 300:
        raise InputError(f"{where} shows no bone: its values run from {low:g} to {high:g} HU; give a CT of the head")
    if values.dtype == np.int16 and low >= LOWEST_HU:
        return values
    return np.clip(values, LOWEST_HU, HIGHEST_HU).astype(np.int16)


def _check_geometry(direction: Array, spacing: Array, size: npt.NDArray[np.int64], where: str) -> None:
    if not (np.isfinite(direction).all() and np.isfinite(spacing).all()):
        raise InputError(f"{where}: its spacing or direction is not a finite number; export the CT again")
    text = " x ".join(f"{s:.4g}" for s in spacing)
    if spacing.min() <= 0 or np.allclose(spacing.min(), 0):
        raise InputError(f"{where}: its voxel spacing is {text} mm; it must be above 0; export the CT again")
    if spacing.max() < 0.02 and (spacing * size).max() < 1.0:
        raise InputError(f"{where}: its voxel spacing is {text} and looks like metres; expected millimetres")
    if spacing.min() < SMALLEST_SPACING_MM or spacing.max() > LARGEST_SPACING_MM:
        raise InputError(
            f"{where}: its voxel spacing is {text} mm; "
            f"expected {SMALLEST_SPACING_MM} to {LARGEST_SPACING_MM:g} mm in each direction"
        )
    extent = spacing * size
    if extent.min() < SMALLEST_EXTENT_MM or extent.max() > LARGEST_EXTENT_MM:
        shown = " x ".join(f"{e:.0f}" for e in extent)
        raise InputError(f"{where} covers {shown} mm; a head CT covers at least {SMALLEST_EXTENT_MM:.0f} mm each way")
    if not np.allclose(direction.T @ direction, np.eye(3), atol=1e-3):
        raise InputError(f"{where}: its axes are not at right angles (sheared); resample it onto a rectangular grid")


def _require_orientation(path: Path) -> None:
    """Refuse a file that does not say how it lies in the patient: guessing could mirror it."""
    name = path.name.lower()
    try:
        if name.endswith((".nrrd", ".nhdr")):
            with path.open("rb") as file:
                header = file.read(65536).split(b"\n\n")[0].split(b"\r\n\r\n")[0].lower()
            if header.startswith(b"nrrd") and b"dimension: 3" in header and b"space:" not in header:
                raise InputError(f"{path} does not say how it lies in the patient (no 'space' field); export it from DICOM again")
        elif name.endswith((".nii", ".nii.gz")):
            _check_nifti(path)
    except (OSError, EOFError, zlib.error) as error:
        raise InputError(f"cannot read {path}: {error}; export the CT again") from None


def _check_nifti(path: Path) -> None:
    """Refuse a NIfTI-1 file without orientation, and one that is cut off: ITK fills a cut .nii.gz with zeros."""
    packed = path.name.lower().endswith(".gz")
    with gzip.open(path, "rb") if packed else path.open("rb") as file:
        head = file.read(348)
    order = next((sign for sign in "<>" if head[:4] == struct.pack(sign + "i", 348)), None)
    if order is None or len(head) < 348:
        return  # NIfTI-2 or none at all: left to the reader
    qform, sform = struct.unpack(order + "hh", head[252:256])
    if qform <= 0 and sform <= 0:
        raise InputError(f"{path} does not say how it lies in the patient (qform and sform codes are 0); convert it again")
    dimensions = struct.unpack(order + "8h", head[40:56])
    (bits,) = struct.unpack(order + "h", head[72:74])
    (offset,) = struct.unpack(order + "f", head[108:112])
    needed = int(offset) + math.prod(max(1, n) for n in dimensions[1 : dimensions[0] + 1]) * bits // 8
    with path.open("rb") as file:
        file.seek(-4 if packed else 0, 2)
        held = struct.unpack("<I", file.read(4))[0] if packed else file.tell()  # gzip ends with the unpacked size
    if not needed % 2**32 <= held <= needed % 2**32 + 2**20:  # a cut .nii.gz ends with four bytes that mean nothing
        raise InputError(f"{path} is cut off: it does not hold the {needed} bytes that its header announces; copy it again")


def _reason(error: Exception) -> str:
    """The telling last line of an ITK exception."""
    lines = [line.strip() for line in str(error).splitlines() if line.strip()]
    last = lines[-1] if lines else "unknown error"
    if "Unable to determine ImageIO reader" in last:
        return "it is no image of the kind its name says, or damaged"
    return last.split("): ")[-1].replace("sitk::ERROR: ", "")[:160]
