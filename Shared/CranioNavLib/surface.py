"""Surface: a closed or open triangle mesh with exact closest points, ray casts and normals.

The index (Open3D's RaycastingScene) is built on first use and kept. It works in single precision, so the
mesh is centred for it: at 150 mm from the centre the rounding is 1e-5 mm.
"""

from __future__ import annotations

import hashlib
import importlib
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from CranioNavLib.errors import InputError
from CranioNavLib.files import written_whole
from CranioNavLib.rigid import Array, check_points

PLANES = 12000  # one every 2 to 3 mm of a skull's outer table
SPACE = "SPACE"  # the name under which model files tell their axes: without it 3D Slicer takes them for LPS
LPS_RAS = np.array([-1.0, -1.0, 1.0])
READERS = {".vtp": "vtkXMLPolyDataReader", ".ply": "vtkPLYReader", ".stl": "vtkSTLReader", ".vtk": "vtkPolyDataReader"}


@dataclass(frozen=True, eq=False)
class ClosestPoints:
    """For each query: the closest point of the surface (N, 3), its distance (N,), triangle (N,) and its normal (N, 3)."""

    points_mm: Array
    distances_mm: Array
    triangles: npt.NDArray[np.int64]
    normals: Array


@dataclass(frozen=True, eq=False)
class RayHits:
    """For each ray: distance to the first hit (N,), inf where there is none; triangle (N,), -1 where none; normal (N, 3)."""

    distances_mm: Array
    triangles: npt.NDArray[np.int64]
    normals: Array


@dataclass(frozen=True, eq=False)
class Surface:
    """A triangle mesh in RAS, mm, with outward normals (counter-clockwise triangles)."""

    vertices_mm: Array  # (V, 3)
    triangles: npt.NDArray[np.int64]  # (T, 3)

    def __post_init__(self) -> None:
        check_points(self.vertices_mm, "surface vertices")
        if self.triangles.ndim != 2 or self.triangles.shape[1] != 3 or len(self.triangles) == 0:
            raise InputError(f"expected surface triangles of shape (T >= 1, 3), got {self.triangles.shape}")

    def _spanned(self, triangles: npt.NDArray[np.int64]) -> Array:
        """(M, 3) outward normals of triangles (M, 3), twice as long as the triangles are large."""
        corner = self.vertices_mm[triangles[:, 0]]
        (x, y, z), (u, v, w) = ((self.vertices_mm[triangles[:, k]] - corner).T for k in (1, 2))
        return np.stack([y * w - z * v, z * u - x * w, x * v - y * u], axis=1)

    @cached_property
    def triangle_normals(self) -> Array:
        """(T, 3) unit outward normals."""
        return _unit(self._spanned(self.triangles))

    @cached_property
    def triangle_areas_mm2(self) -> Array:
        """(T,) areas."""
        areas: Array = 0.5 * np.linalg.norm(self._spanned(self.triangles), axis=1)
        return areas

    @cached_property
    def vertex_normals(self) -> Array:
        """(V, 3) unit outward normals, area-weighted over the triangles around each vertex."""
        from scipy.sparse import csc_matrix

        corners, starts = self.triangles.ravel(), np.arange(0, self.triangles.size + 1, 3)
        around = csc_matrix((np.ones(len(corners)), corners, starts), shape=(len(self.vertices_mm), len(self.triangles)))
        return _unit(np.asarray(around @ self._spanned(self.triangles)))

    @cached_property
    def center_mm(self) -> Array:
        """(3,) middle of the bounding box."""
        middle: Array = (self.vertices_mm.min(axis=0) + self.vertices_mm.max(axis=0)) / 2
        return middle

    @cached_property
    def content_hash(self) -> str:
        """SHA-256 of vertices and triangles: the key for what is cached about a surface."""
        digest = hashlib.sha256(np.ascontiguousarray(self.vertices_mm, dtype="<f8").tobytes())
        digest.update(np.ascontiguousarray(self.triangles, dtype="<i8").tobytes())
        return digest.hexdigest()

    @cached_property
    def _index(self) -> Any:
        open3d: Any = importlib.import_module("open3d")

        scene = open3d.t.geometry.RaycastingScene()
        scene.add_triangles(
            open3d.core.Tensor(np.ascontiguousarray(self.vertices_mm - self.center_mm, dtype=np.float32)),
            open3d.core.Tensor(np.ascontiguousarray(self.triangles, dtype=np.uint32)),
        )
        return scene

    @cached_property
    def planes(self) -> tuple[Any, Array, Array]:
        """Search tree, middles (P, 3) and unit normals (P, 3) of planes through triangles taken evenly from the mesh.

        Nearest planes are found several times faster than exact closest points, and lie off the triangles by some 0.1 mm.
        """
        from scipy.spatial import cKDTree

        chosen = self.triangles[:: -(-len(self.triangles) // PLANES)]
        normals = self.vertex_normals[chosen].sum(axis=1)
        middles: Array = self.vertices_mm[chosen].mean(axis=1)
        return cKDTree(middles), middles, _unit(normals)

    def prepare(self) -> None:
        """Make now what is otherwise made on first use and takes seconds for a skull: where that disturbs nobody."""
        self.vertex_normals  # noqa: B018
        self.triangle_normals  # noqa: B018
        self.closest(self.vertices_mm[:1])

    def closest(self, points_mm: npt.ArrayLike) -> ClosestPoints:
        """Exact closest points on the triangles for points (N, 3) in RAS."""
        points = np.asarray(points_mm, dtype=float).reshape(-1, 3)
        found = self._index.compute_closest_points((points - self.center_mm).astype(np.float32))
        nearest = found["points"].numpy().astype(float) + self.center_mm
        ids = found["primitive_ids"].numpy().astype(np.int64)
        distances: Array = np.linalg.norm(points - nearest, axis=1)
        return ClosestPoints(nearest, distances, ids, _unit(self._spanned(self.triangles[ids])))

    def signed_distance(self, points_mm: npt.ArrayLike) -> Array:
        """(N,) distance, negative inside; only meaningful for a closed surface."""
        points = np.asarray(points_mm, dtype=float).reshape(-1, 3)
        signed: Array = self._index.compute_signed_distance((points - self.center_mm).astype(np.float32)).numpy().astype(float)
        return signed

    def cast(self, origins_mm: npt.ArrayLike, directions: npt.ArrayLike) -> RayHits:
        """First hits of rays from `origins_mm` (N, 3) along unit `directions` (N, 3)."""
        origins = np.asarray(origins_mm, dtype=float).reshape(-1, 3) - self.center_mm
        rays = np.concatenate([origins, np.broadcast_to(np.asarray(directions, dtype=float), origins.shape)], axis=1)
        found = self._index.cast_rays(rays.astype(np.float32))
        distances = found["t_hit"].numpy().astype(float)
        missed = ~np.isfinite(distances)
        ids = found["primitive_ids"].numpy().astype(np.int64)
        ids[missed] = -1
        normals = self.triangle_normals[np.maximum(ids, 0)].copy()
        normals[missed] = np.nan
        return RayHits(distances, ids, normals)

    def to_polydata(self) -> Any:
        """The mesh as vtkPolyData with point normals."""
        from vtkmodules.util.numpy_support import numpy_to_vtk, numpy_to_vtkIdTypeArray
        from vtkmodules.vtkCommonCore import vtkPoints
        from vtkmodules.vtkCommonDataModel import vtkCellArray, vtkPolyData

        points = vtkPoints()
        points.SetData(numpy_to_vtk(np.ascontiguousarray(self.vertices_mm), deep=True))
        cells = vtkCellArray()
        cells.SetData(3, numpy_to_vtkIdTypeArray(np.ascontiguousarray(self.triangles.ravel(), dtype=np.int64), deep=True))
        mesh = vtkPolyData()
        mesh.SetPoints(points)
        mesh.SetPolys(cells)
        normals = numpy_to_vtk(np.ascontiguousarray(self.vertex_normals, dtype=np.float32), deep=True)
        normals.SetName("Normals")
        mesh.GetPointData().SetNormals(normals)
        return mesh

    @classmethod
    def from_polydata(cls, mesh: Any) -> Surface:
        """From vtkPolyData; polygons are split into triangles.

        Raises
        ------
        InputError
            The mesh has no triangles.
        """
        from vtkmodules.util.numpy_support import vtk_to_numpy
        from vtkmodules.vtkFiltersCore import vtkTriangleFilter

        triangulate = vtkTriangleFilter()
        triangulate.SetInputData(mesh)
        triangulate.PassVertsOff()
        triangulate.PassLinesOff()
        triangulate.Update()
        mesh = triangulate.GetOutput()
        if mesh.GetNumberOfPolys() == 0:
            raise InputError("the surface holds no triangles; export it as a triangle mesh")
        triangles = vtk_to_numpy(mesh.GetPolys().GetConnectivityArray()).reshape(-1, 3).astype(np.int64)
        return cls(vtk_to_numpy(mesh.GetPoints().GetData()).astype(float), triangles)

    @classmethod
    def read(cls, path: str | Path) -> Surface:
        """A surface from .vtp, .ply, .stl or .vtk, in RAS and mm.

        A file that says that it is in LPS, as 3D Slicer writes them, is turned to RAS; one that says nothing is in RAS.

        Raises
        ------
        InputError
            No such file, unknown format, or nothing readable in it.
        """
        from vtkmodules import vtkIOGeometry, vtkIOLegacy, vtkIOPLY, vtkIOXML

        path = Path(path)
        if not path.is_file():
            raise InputError(f"no surface file {path}; give a .vtp, .ply, .stl or .vtk file")
        name = READERS.get(path.suffix.lower())
        if name is None:
            raise InputError(f"cannot read {path}: unknown surface format; use {', '.join(READERS)}")
        reader = next(
            getattr(module, name) for module in (vtkIOXML, vtkIOPLY, vtkIOGeometry, vtkIOLegacy) if hasattr(module, name)
        )()
        reader.SetFileName(str(path))
        reader.Update()
        if reader.GetOutput() is None or reader.GetOutput().GetNumberOfPoints() == 0:
            raise InputError(f"{path} holds no surface; it is empty, cut off or of another format")
        surface = cls.from_polydata(reader.GetOutput())
        return cls(surface.vertices_mm * LPS_RAS, surface.triangles) if "LPS" in _space(reader) else surface

    def write(self, path: str | Path) -> None:
        """Write .vtp (RAS, mm, outward normals), whole or not at all."""
        from vtkmodules.vtkCommonCore import vtkStringArray
        from vtkmodules.vtkIOXML import vtkXMLPolyDataWriter

        space, mesh = vtkStringArray(), self.to_polydata()
        space.SetName(SPACE)
        space.InsertNextValue("RAS")
        mesh.GetFieldData().AddArray(space)
        with written_whole(path) as temporary:
            writer = vtkXMLPolyDataWriter()
            writer.SetFileName(str(temporary))
            writer.SetInputData(mesh)
            writer.EncodeAppendedDataOff()  # with LZ4 0.35 s for a whole skull instead of 6, in 37 MB instead of 28
            writer.SetCompressorTypeToLZ4()
            if not writer.Write():
                raise InputError(f"cannot write {path}; is the disk full?")


def _space(reader: Any) -> str:
    """What a model file says of its axes, in the places where 3D Slicer writes it; "" if it says nothing."""
    said = reader.GetOutput().GetFieldData().GetAbstractArray(SPACE)
    if said is not None and said.GetNumberOfValues():
        return str(said.GetValue(0))
    comments = reader.GetComments() if hasattr(reader, "GetComments") else None
    texts = [] if comments is None else [comments.GetValue(k) for k in range(comments.GetNumberOfValues())]
    texts += [reader.GetHeader() or ""] if hasattr(reader, "GetHeader") else []
    return next((text for text in texts if f"{SPACE}=" in text), "")


def _unit(vectors: Array) -> Array:
    unit: Array = vectors / np.maximum(np.linalg.norm(vectors, axis=1, keepdims=True), 1e-30)
    return unit
