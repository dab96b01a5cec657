"""A CT series from a folder of DICOM files: sorted, checked, rectangular.

Headers are read with pydicom, voxels with GDCM (through SimpleITK), which applies rescale slope and intercept.
"""

from __future__ import annotations

import importlib
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Optional

import numpy as np
from CranioNavLib.errors import InputError
from CranioNavLib.rigid import Array

TAGS = [
    "SOPClassUID", "SOPInstanceUID", "Modality", "SeriesInstanceUID", "SeriesNumber", "SeriesDescription", "ImageType",
    "ImageOrientationPatient", "ImagePositionPatient", "PixelSpacing", "Rows", "Columns", "SamplesPerPixel",
    "BitsAllocated", "NumberOfFrames", "TransferSyntaxUID", "PatientName",
]  # fmt: skip
DIRECTORY_CLASS = "1.2.840.10008.1.3.10"  # DICOMDIR
ENHANCED_CT_CLASS = "1.2.840.10008.5.1.4.1.1.2.1"
FEWEST_SLICES = 4  # up to three slices are a localizer
GAP_TOLERANCE, ROUNDING_MM = 0.1, 0.11  # of the slice distance, but positions are often rounded to 0.1 mm
ORIENTATION_TOLERANCE = 1e-3
TILT_TOLERANCE_MM = 0.01  # sideways drift from slice to slice above which the gantry was tilted


@dataclass(frozen=True, eq=False)
class Slice:
    """One DICOM file's header and place."""

    path: Path
    header: Any
    pixel_offset: int  # bytes before the pixel data element

    @property
    def position(self) -> Array:
        """(3,) LPS, mm, of the first voxel's centre."""
        return np.array([float(value) for value in self.header.ImagePositionPatient])

    @property
    def orientation(self) -> Array:
        """(6,) direction cosines of rows and columns, LPS."""
        return np.array([float(value) for value in self.header.ImageOrientationPatient])


def read_dicom(path: Path, series: Optional[str] = None) -> tuple[Any, str]:
    """The CT series in a folder (or the one that a file belongs to), as a SimpleITK image and its description.

    Raises
    ------
    InputError
        As `ct_reader.read_ct`.
    """
    folder = path if path.is_dir() else path.parent
    slices = _read_headers(folder)
    if not path.is_dir():
        own = next((item for item in slices if item.path == path), None)
        if own is None:
            raise InputError(f"{path} is no DICOM file and no known volume format; use a DICOM folder, .nrrd, .nii.gz or .mha")
        series = str(own.header.SeriesInstanceUID) if series is None else series
    chosen = _without_localizers(_choose(_by_series(slices), series, folder))
    name = _describe(chosen)
    _check_modality(chosen, name, folder)
    ordered, tilted = _sorted(_without_copies(chosen), name)
    for item in ordered:
        _check_whole(item)
    return _read_voxels(ordered, tilted, name), name


def list_series(folder: Path) -> list[tuple[str, str]]:
    """SeriesInstanceUID and description, for people, of every series in a folder that may be a CT of a head.

    Raises
    ------
    InputError
        No or damaged DICOM files, or none of a CT.
    """
    groups = _by_series(_read_headers(folder))
    volumes = [group for group in groups if _is_ct(group) and len(group) >= FEWEST_SLICES]
    if not volumes:
        raise InputError(f"{folder} holds no CT, but {_listed(groups)}; choose another folder")
    return [
        (str(group[0].header.SeriesInstanceUID), f"{_describe(group) or 'series without a name'}, {len(group)} slices")
        for group in volumes
    ]


def _read_headers(folder: Path) -> list[Slice]:
    pydicom: Any = importlib.import_module("pydicom")
    try:
        next(folder.iterdir(), None)  # below, a folder that may not be read would pass for an empty one
    except OSError as error:
        raise InputError(f"cannot read {folder}: {error.strerror or error}; check the folder's permissions") from None
    files = sorted(item for item in folder.rglob("*") if item.is_file() and not item.name.startswith("."))
    if not files:
        raise InputError(f"the folder {folder} is empty; give the folder that holds the CT's DICOM files")
    found = []
    for item in files:
        try:
            with item.open("rb") as file:
                header = pydicom.dcmread(file, stop_before_pixels=True, specific_tags=TAGS)
                offset = file.tell()
        except pydicom.errors.InvalidDicomError:
            if item.suffix.lower() in (".dcm", ".ima"):
                raise InputError(f"{item} is cut off or no DICOM file; copy the series again") from None
            continue
        except OSError as error:
            raise InputError(f"cannot read {item}: {error.strerror or error}; check the folder's permissions") from None
        except Exception as error:
            raise InputError(f"{item} is damaged ({type(error).__name__}); copy the series again") from None
        if item.name.upper() == "DICOMDIR" or header.get("SOPClassUID", "") == DIRECTORY_CLASS:
            continue
        if "SeriesInstanceUID" not in header:
            raise InputError(f"{item} is cut off: it ends before its series is named; copy the series again")
        found.append(Slice(item, header, offset))
    if not found:
        raise InputError(f"the folder {folder} holds no DICOM files; give the folder that holds the CT's DICOM files")
    return found


def _by_series(slices: Sequence[Slice]) -> list[list[Slice]]:
    groups: dict[str, list[Slice]] = {}
    for item in slices:
        groups.setdefault(str(item.header.get("SeriesInstanceUID", "")), []).append(item)
    return sorted(groups.values(), key=lambda group: (str(group[0].header.get("SeriesNumber", "")).zfill(8), str(group[0].path)))


def _choose(groups: list[list[Slice]], series: Optional[str], folder: Path) -> list[Slice]:
    if series is not None:
        wanted = str(series).strip()
        for key in ("SeriesInstanceUID", "SeriesNumber", "SeriesDescription"):
            matching = [group for group in groups if str(group[0].header.get(key, "")).strip() == wanted]
            if len(matching) == 1:
                return matching[0]
            if matching:
                raise InputError(
                    f"{len(matching)} series in {folder} match {wanted!r}; give the SeriesInstanceUID: {_listed(matching)}"
                )
        raise InputError(f"no series {wanted!r} in {folder}; there are: {_listed(groups)}")
    if len(groups) == 1:
        return groups[0]
    volumes = [group for group in groups if _is_ct(group) and len(group) >= FEWEST_SLICES]
    if len(volumes) == 1:  # beside localizers, dose reports and other modalities
        return volumes[0]
    raise InputError(
        f"{folder} holds {len(groups)} series: {_listed(groups)}; give the number of one as the series "
        "(in the panel: Details, Series; in the console: --series NUMBER)"
    )


def _is_ct(group: Sequence[Slice]) -> bool:
    return group[0].header.get("Modality", "") == "CT" and not _is_localizer(group[0])


def _is_localizer(item: Slice) -> bool:
    return "LOCALIZER" in [str(part).upper() for part in item.header.get("ImageType", None) or []]


def _without_localizers(group: Sequence[Slice]) -> list[Slice]:
    """The series without localizers filed under it; all of it where it holds nothing else."""
    return [item for item in group if not _is_localizer(item)] or list(group)


def _listed(groups: Sequence[Sequence[Slice]]) -> str:
    return "; ".join(
        f"number {group[0].header.get('SeriesNumber', '?')} ({group[0].header.get('Modality', '?')}, "
        f"{str(group[0].header.get('SeriesDescription', '')).strip() or 'no description'}, {len(group)} slices"
        + (f", UID {group[0].header.SeriesInstanceUID})" if _repeats(group, groups) else ")")
        for group in groups
    )


def _repeats(group: Sequence[Slice], groups: Sequence[Sequence[Slice]]) -> bool:
    counts = Counter(str(other[0].header.get("SeriesNumber", "?")) for other in groups)
    return counts[str(group[0].header.get("SeriesNumber", "?"))] > 1 and "SeriesInstanceUID" in group[0].header


def _describe(group: Sequence[Slice]) -> str:
    header = group[0].header
    return f"series {header.get('SeriesNumber', '?')} {str(header.get('SeriesDescription', '')).strip()}".strip()


def _check_modality(group: Sequence[Slice], name: str, folder: Path) -> None:
    header = group[0].header
    modality = str(header.get("Modality", "")) or "of no stated modality"
    if modality != "CT":
        raise InputError(f"{name} in {folder} is {modality}, not CT; give the CT series")
    if str(header.get("SOPClassUID", "")) == ENHANCED_CT_CLASS or int(header.get("NumberOfFrames", 1) or 1) > 1:
        raise InputError(f"{name} in {folder} is a multi-frame DICOM file; export it as one file a slice, or as .nrrd")
    for item in group:
        lacking = [tag for tag in ("ImagePositionPatient", "ImageOrientationPatient", "PixelSpacing", "Rows", "Columns")
                   if item.header.get(tag) in (None, "")]  # fmt: skip
        if lacking:
            raise InputError(
                f"{item.path} lacks {', '.join(lacking)}: a localizer or a derived image; remove it or give the axial series"
            )
        if int(item.header.get("SamplesPerPixel", 1)) != 1:
            raise InputError(f"{item.path} is a colour image, not a CT slice; remove it from the folder")
    if len(group) < FEWEST_SLICES:
        raise InputError(f"{name} in {folder} has only {len(group)} slices; give the whole CT of the head")


def _without_copies(group: Sequence[Slice]) -> list[Slice]:
    """The series with files of the same instance taken once."""
    unique = {str(item.header.get("SOPInstanceUID", item.path)): item for item in group}
    return list(unique.values())


def _sorted(group: Sequence[Slice], name: str) -> tuple[list[Slice], bool]:
    """Slices from first to last along the stack, and whether the gantry was tilted."""
    orientation = group[0].orientation
    for item in group:
        if np.abs(item.orientation - orientation).max() > ORIENTATION_TOLERANCE:
            raise InputError(
                f"{name} mixes orientations ({group[0].path.name} and {item.path.name}); export the axial series alone"
            )
        for tag in ("Rows", "Columns", "PixelSpacing"):
            if item.header.get(tag) != group[0].header.get(tag):
                raise InputError(
                    f"{name}: {tag} is {item.header.get(tag)} in {item.path.name} but {group[0].header.get(tag)} in "
                    f"{group[0].path.name}; export one reconstruction alone"
                )
    if not np.allclose((orientation[:3] @ orientation[:3], orientation[3:] @ orientation[3:]), 1, atol=1e-3):
        raise InputError(f"{name}: its direction cosines are not of unit length; export the series again")
    normal = np.cross(orientation[:3], orientation[3:])
    ordered = sorted(group, key=lambda item: float(item.position @ normal))
    positions = np.array([item.position for item in ordered])
    along = positions @ normal
    _check_gaps(np.diff(along), along, ordered, name)
    drift = np.diff(positions, axis=0) - np.diff(along)[:, None] * normal
    mean_drift = drift.mean(axis=0)
    if np.abs(drift - mean_drift).max() > GAP_TOLERANCE * float(np.median(np.diff(along))) + 0.05:
        raise InputError(f"{name}: its slices are shifted sideways unevenly; it mixes two scans, export one alone")
    return ordered, bool(np.linalg.norm(mean_drift) > TILT_TOLERANCE_MM)


def _check_gaps(gaps: Array, along: Array, ordered: Sequence[Slice], name: str) -> None:
    middle = float(np.median(gaps))
    step = float(gaps[np.abs(gaps - middle) <= 0.5 * middle].mean())  # rounded positions leave the median off by 0.1 mm
    if gaps.min() < 0.01 * max(step, 0.05):
        first = int(np.argmin(gaps))
        raise InputError(
            f"{name}: {ordered[first].path.name} and {ordered[first + 1].path.name} lie at the same position; "
            "it holds two reconstructions or phases, export one alone"
        )
    uneven = np.flatnonzero(np.abs(gaps - step) > max(GAP_TOLERANCE * step, ROUNDING_MM))
    if len(uneven):
        first = int(uneven[0])
        missing = int(np.rint(gaps[first] / step)) - 1
        what = f"{missing} slice(s) are missing" if missing > 0 else "the slice distance changes"
        raise InputError(
            f"{name}: {what} between {along[first]:.1f} and {along[first + 1]:.1f} mm (after {ordered[first].path.name}; "
            f"slice distance {step:.3g} mm); copy the whole series or export it with one slice distance"
        )


def _check_whole(item: Slice) -> None:
    """Refuse a file that ends before its pixels do: GDCM would fill the rest with zeros."""
    header = item.header
    syntax = header.file_meta.get("TransferSyntaxUID") if hasattr(header, "file_meta") else None
    size = item.path.stat().st_size
    start = item.pixel_offset + (8 if syntax is not None and syntax.is_implicit_VR else 12)  # tag, representation, length
    if syntax is not None and syntax.is_compressed:
        needed = start
    else:
        needed = start + int(header.Rows) * int(header.Columns) * int(header.get("BitsAllocated", 16)) // 8
    if size < needed:
        raise InputError(f"{item.path} is cut off: {size} bytes, expected at least {needed}; copy the series again")


def _read_voxels(ordered: Sequence[Slice], tilted: bool, name: str) -> Any:
    sitk: Any = importlib.import_module("SimpleITK")
    reader = sitk.ImageSeriesReader()
    reader.SetFileNames([str(item.path) for item in ordered])
    told = sitk.ProcessObject.GetGlobalWarningDisplay()
    sitk.ProcessObject.GlobalWarningDisplayOff()  # the positions are checked here, and better
    try:
        image = reader.Execute()
    except RuntimeError as error:
        lines = [line.strip() for line in str(error).splitlines() if line.strip()]
        raise InputError(f"{name}: its voxels cannot be read ({lines[-1][:160]}); copy the series again") from None
    finally:
        sitk.ProcessObject.SetGlobalWarningDisplay(told)
    first, last = ordered[0], ordered[-1]
    rows, columns = first.orientation[:3], first.orientation[3:]
    normal = np.cross(rows, columns)
    step = (last.position - first.position) / (len(ordered) - 1)
    between_rows, between_columns = (float(value) for value in first.header.PixelSpacing)
    if image.GetNumberOfComponentsPerPixel() == 1:
        # From the headers, at full precision: readers have failed on spacings such as ".4785"
        image.SetSpacing((between_columns, between_rows, float(step @ normal)))
        image.SetDirection(np.stack([rows, columns, normal], axis=1).ravel().tolist())
        image.SetOrigin(first.position.tolist())
    return _untilted(image, np.array([step @ rows, step @ columns])) if tilted else image


def _untilted(image: Any, drift_mm: Array) -> Any:
    """A stack whose slices drift sideways by `drift_mm` (row, column direction) each, on a rectangular grid."""
    sitk: Any = importlib.import_module("SimpleITK")
    spacing, size = np.array(image.GetSpacing()), np.array(image.GetSize())
    origin, direction = np.array(image.GetOrigin()), np.array(image.GetDirection()).reshape(3, 3)
    plain = sitk.Image(image)  # the same voxels, in the stack's own axes
    plain.SetOrigin((0.0, 0.0, 0.0))
    plain.SetDirection(np.eye(3).ravel().tolist())
    total = drift_mm * (size[2] - 1)
    start = np.minimum(0, np.floor(total / spacing[:2])) * spacing[:2]
    larger = size.copy()
    larger[:2] += np.ceil(np.abs(total) / spacing[:2]).astype(int)
    shear = np.eye(3)
    shear[:2, 2] = -drift_mm / spacing[2]  # from the rectangular grid back to the stack
    resample = sitk.ResampleImageFilter()
    resample.SetTransform(sitk.AffineTransform(shear.ravel().tolist(), (0.0, 0.0, 0.0)))
    resample.SetSize([int(n) for n in larger])
    resample.SetOutputSpacing(spacing.tolist())
    resample.SetOutputOrigin((float(start[0]), float(start[1]), 0.0))
    resample.SetDefaultPixelValue(-1024)
    resample.SetInterpolator(sitk.sitkLinear)
    result = resample.Execute(plain)
    result.SetDirection(direction.ravel().tolist())
    result.SetOrigin((origin + direction[:, :2] @ start).tolist())
    return result
