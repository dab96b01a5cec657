"""Markups, transforms and scenes on disk, read and written by MRML's own storage nodes.

They alone know about LPS on disk and RAS in memory; no sign is flipped here.
"""

from __future__ import annotations

import json
import os
import re
import tempfile
import zipfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from CranioNavLib import host
from CranioNavLib.errors import InputError
from CranioNavLib.files import written_whole
from CranioNavLib.rigid import Array, check_points, check_rigid

MARKUPS = (".mrk.json", ".json", ".fcsv")
TRANSFORMS = (".tfm", ".h5", ".txt", ".mat")
COORDINATE_SYSTEMS = ("LPS", "RAS")


@dataclass(frozen=True, eq=False)
class LabelledPoints:
    """Points with their labels, in order; RAS, or the frame that their file stands for, mm."""

    labels: tuple[str, ...]
    positions_mm: Array  # (N, 3)

    def __post_init__(self) -> None:
        check_points(self.positions_mm)
        if len(self.labels) != len(self.positions_mm):
            raise InputError(f"expected one label per point, got {len(self.labels)} for {len(self.positions_mm)} points")

    def __len__(self) -> int:
        return len(self.labels)


def read_points(path: str | Path) -> LabelledPoints:
    """The control points of a Slicer markups file (.mrk.json or .fcsv).

    Raises
    ------
    InputError
        Missing, empty, cut off, no points in it, of another kind than a point list, several lists in one file, a
        point that is not placed, a file that does not say its coordinate system or is not in mm.
    """
    path = _existing(path, MARKUPS, "a markups file (.mrk.json or .fcsv)")
    if path.suffix.lower() == ".fcsv":
        _check_fcsv(path)
        node = _read(path, "vtkMRMLMarkupsFiducialStorageNode", "vtkMRMLMarkupsFiducialNode")
    else:
        _check_markups_json(path)
        node = _read(path, "vtkMRMLMarkupsJsonStorageNode", "vtkMRMLMarkupsFiducialNode")
    return points_of_node(node, str(path))


def points_of_node(node: Any, where: str) -> LabelledPoints:
    """The control points of a markups node, in the node's own frame (its parent transform left out).

    Raises
    ------
    InputError
        The list is empty, or a point is not placed; the message names `where`.
    """
    count = node.GetNumberOfControlPoints()
    if count == 0:
        raise InputError(f"{where} holds no points; place at least one and save it again")
    labels = tuple(node.GetNthControlPointLabel(index) for index in range(count))
    defined = type(node).PositionDefined
    for index, label in enumerate(labels):
        if node.GetNthControlPointPositionStatus(index) != defined:
            raise InputError(f"{where}: point {index + 1} ({label!r}) has no position; place it or delete it")
    positions = np.array([node.GetNthControlPointPosition(index) for index in range(count)], dtype=float)
    try:
        return LabelledPoints(labels, check_points(positions))
    except InputError as error:
        raise InputError(f"{where}: {error}") from None


def write_points(path: str | Path, points: LabelledPoints, name: str = "Points") -> None:
    """Write a point list as Slicer markups (.mrk.json; LPS on disk), whole or not at all."""
    path = Path(path)
    if not path.name.endswith(".mrk.json"):
        raise InputError(f"cannot write points as {path.name}; give the file a name that ends with .mrk.json")
    slicer = _ready()
    node = slicer.vtkMRMLMarkupsFiducialNode()
    node.SetName(name)
    add_points(node, points)
    _write(path, slicer.vtkMRMLMarkupsJsonStorageNode(), node)


def add_points(node: Any, points: LabelledPoints) -> None:
    """Add control points to a markups node, in the node's own frame."""
    for label, position in zip(points.labels, points.positions_mm):
        index = node.AddControlPoint([float(value) for value in position], label)
        node.SetNthControlPointLabel(index, label)  # an empty label would have been replaced by a number


def read_transform(path: str | Path) -> Array:
    """The rigid 4x4 of a transform file (.tfm, .h5), as the ToParent matrix that 3D Slicer shows for it.

    Raises
    ------
    InputError
        Missing, empty, no transform in it, not linear or not rigid.
    """
    path = _existing(path, TRANSFORMS, "a transform file (.tfm or .h5)")
    node = _read(path, "vtkMRMLTransformStorageNode", "vtkMRMLTransformNode")
    matrix: Any = host.slicer_package().util.vtkMatrixFromArray(np.eye(4))
    if not node.IsLinear() or not node.GetMatrixTransformToParent(matrix):
        raise InputError(f"{path} holds a transform that is not linear; a rigid one is needed")
    try:
        return check_rigid(host.slicer_package().util.arrayFromVTKMatrix(matrix), str(path))
    except InputError as error:
        raise InputError(str(error)) from None


def write_transform(path: str | Path, matrix: npt.ArrayLike, name: str = "ReferenceToRas") -> None:
    """Write a rigid 4x4 (.tfm or .h5) so that 3D Slicer loads it as the same ToParent matrix."""
    path = Path(path)
    if path.suffix.lower() not in (".tfm", ".h5"):
        raise InputError(f"cannot write a transform as {path.name}; give the file a name that ends with .tfm or .h5")
    slicer = _ready()
    node = slicer.vtkMRMLLinearTransformNode()
    node.SetName(name)
    node.SetMatrixTransformToParent(slicer.util.vtkMatrixFromArray(check_rigid(matrix, name)))
    _write(path, slicer.vtkMRMLTransformStorageNode(), node)


def save_scene(path: str | Path) -> None:
    """Write the host's scene as .mrb, whole or not at all; 3D Slicer 5 opens it."""
    path = Path(path)
    if path.suffix.lower() != ".mrb":
        raise InputError(f"cannot save the scene as {path.name}; give the file a name that ends with .mrb")
    scene = host.scene()
    for index in range(scene.GetNumberOfNodes()):
        node = scene.GetNthNode(index)
        if not node.GetName():
            node.SetName(scene.GenerateUniqueName(node.GetNodeTagName()))
    with written_whole(path) as temporary, tempfile.TemporaryDirectory(prefix="cranionav-") as folder:
        bundle = Path(folder) / path.stem
        bundle.mkdir()
        with host.quiet() as said:
            saved = scene.SaveSceneToSlicerDataBundleDirectory(str(bundle), None)
        if not saved:
            raise InputError(f"cannot save the scene to {path}: {_reason(said)}; is the disk full?")
        with zipfile.ZipFile(temporary, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive:
            for file in sorted(bundle.rglob("*")):
                if file.is_file():
                    archive.write(file, file.relative_to(folder))


def load_scene(path: str | Path, clear: bool = True) -> None:
    """Load a .mrb into the host's scene; what was there is removed first unless `clear` is False.

    Raises
    ------
    InputError
        Missing, no .mrb, damaged, or a part of it cannot be read. The scene then holds what could be read.
    """
    path = _existing(path, (".mrb",), "a scene (.mrb)")
    host.check_thread()
    scene = host.scene()
    with tempfile.TemporaryDirectory(prefix="cranionav-") as folder:
        try:
            with zipfile.ZipFile(path) as archive:
                archive.extractall(folder)
        except (zipfile.BadZipFile, OSError, EOFError) as error:
            raise InputError(f"cannot read {path}: {error}; it is damaged or no .mrb; save it again") from None
        scenes = sorted(Path(folder).rglob("*.mrml"), key=lambda file: len(file.parts))
        if not scenes:
            raise InputError(f"{path} holds no scene (.mrml); it is no .mrb of 3D Slicer; save it again")
        if clear:
            scene.Clear(False)
        with host.quiet() as said:
            scene.SetURL(str(scenes[0]))
            loaded = scene.Import(None)
    scene.SetURL(str(path.resolve()))
    scene.SetRootDirectory(str(path.resolve().parent))
    if not loaded:
        raise InputError(f"cannot read all of {path}: {_reason(said)}; save it again where it was made")


def _ready() -> Any:
    host.scene()
    return host.slicer_package()


def _existing(path: str | Path, suffixes: tuple[str, ...], what: str) -> Path:
    path = Path(path)
    if not path.name.lower().endswith(suffixes):
        raise InputError(f"cannot read {path}: expected {what}")
    if not path.is_file():
        raise InputError(f"no file {path}; expected {what}")
    try:
        with path.open("rb") as file:
            if not file.read(1):
                raise InputError(f"{path} is empty; expected {what}")
    except OSError as error:
        raise InputError(f"cannot read {path}: {error.strerror}; allow reading it") from None
    return path


def _read(path: Path, storage_class: str, node_class: str) -> Any:
    slicer = _ready()
    storage, node = getattr(slicer, storage_class)(), getattr(slicer, node_class)()
    storage.SetFileName(str(path))
    with host.quiet() as said, _quiet_hdf5(path):
        read = storage.ReadData(node)
    if not read:
        raise InputError(f"cannot read {path}: {_reason(said)}; it is cut off or of another kind")
    return node


@contextmanager
def _quiet_hdf5(path: Path) -> Iterator[None]:
    """HDF5 writes what it thinks of a damaged file straight to file descriptor 2; for such a file it is led away."""
    if path.suffix.lower() != ".h5":
        yield
        return
    shown, nowhere = os.dup(2), os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, 2)
    try:
        yield
    finally:
        os.dup2(shown, 2)
        os.close(shown)
        os.close(nowhere)


def _write(path: Path, storage: Any, node: Any) -> None:
    with written_whole(path) as temporary:
        storage.SetFileName(str(temporary))
        with host.quiet() as said:
            written = storage.WriteData(node)
        if not written or temporary.stat().st_size == 0:
            raise InputError(f"cannot write {path}: {_reason(said)}; is the disk full?")


def _reason(said: Any) -> str:
    """What ITK or MRML gave as the first reason, without its addresses and source lines."""
    for line in (said.GetOutput() or "").splitlines():
        found = re.match(r"(?:Description: |vtk\w+ \(0x\w+\): )(?:.*(?:\(0x\w+\)|::\w+): )?(.*)", line.strip())
        if found and found[1] and not found[1].endswith("ITK exception:"):
            return found[1]
    return "no reason given"


def _check_markups_json(path: Path) -> None:
    """What the storage node would accept without a word: no coordinate system, another unit, further lists."""
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except (ValueError, RecursionError) as error:
        raise InputError(f"cannot read {path}: it is no JSON ({error}); save it again as Slicer markups") from None
    lists = content.get("markups") if isinstance(content, dict) else None
    if not isinstance(lists, list) or not lists or not all(isinstance(markup, dict) for markup in lists):
        raise InputError(f"{path} holds no Slicer markups; save a point list as .mrk.json")
    if len(lists) > 1:
        raise InputError(f"{path} holds {len(lists)} point lists; save each in a file of its own")
    markup = lists[0]
    system = markup.get("coordinateSystem")
    if system not in COORDINATE_SYSTEMS:
        said = "does not say" if system is None else f"says {system!r} for"
        raise InputError(f'{path} {said} its coordinate system; add "coordinateSystem": "LPS" or "RAS"')
    unit = markup.get("coordinateUnits", "mm")
    if unit not in ("mm", ["mm", "UCUM", "millimeter"]):
        raise InputError(f"{path} is in {unit!r}; save it in mm")
    if markup.get("type") != "Fiducial":
        raise InputError(f"{path} holds a markup of type {markup.get('type')!r}; save a point list (Fiducial)")


def _check_fcsv(path: Path) -> None:
    header = [line for line in path.read_text(encoding="utf-8", errors="replace").splitlines() if line.startswith("#")]
    systems = [line.partition("=")[2].strip() for line in header if "coordinatesystem" in line.lower().replace(" ", "")]
    if not systems or systems[0] not in (*COORDINATE_SYSTEMS, "0", "1"):
        said = f"says {systems[0]!r} for" if systems else "does not say"
        raise InputError(f"{path} {said} its coordinate system; add the line '# CoordinateSystem = LPS' (or RAS)")
