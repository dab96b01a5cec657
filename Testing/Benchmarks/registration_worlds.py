"""Registration on worlds drawn at random: accuracy, robustness and honesty of one method in one table.

    python Testing/Benchmarks/registration_worlds.py -o DIR [--cases 40] [--classes plain poor ...] [--method NAME]

Simulated, and unlike the virtual patient: the bone that is touched is an iso-surface of the head CT at a level of its own,
found from outside by rays; the surface that registration gets is segmented from a coarser and noisier CT of that head.
Noise, offset, spread of the points, landmarks and biases are drawn anew for every case. The TRE is against the true pose,
at ten places of the head that carry no error. The bound is Cramer and Rao's for the points that are no
outliers, at their true noise.
"""

from __future__ import annotations

import argparse
import csv
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from functools import cache
from pathlib import Path

import numpy as np
from CranioNavLib.bone_points import BonePoints
from CranioNavLib.errors import InputError
from CranioNavLib.rigid import Array, invert_rigid, rigid, transform_points
from CranioNavLib.sample_head import load_sample_head
from CranioNavLib.surface import Surface
from CranioNavLib.volume import Volume
from ModuleRegistrationLib.anatomy.segmentation import BoneSurfaces, segment_bone
from ModuleRegistrationLib.procedure import STYLUS_POINT_SD_MM
from ModuleRegistrationLib.registration.error_theory import predict_tre, predict_tre_of
from ModuleRegistrationLib.registration.landmarks import fit_rigid, motion_jacobian
from ModuleRegistrationLib.registration.problem import METHODS, RegistrationProblem
from ModuleRegistrationLib.registration.verdict import judge
from scipy.spatial.transform import Rotation
from ultrasound_points import Echoes, draw_echoes

TRUE_LEVELS_HU = (300.0, 360.0, 420.0)
SHAPES = ((1.0, 1.0, 1.0), (0.95, 1.05, 0.98))  # the head, and another one stretched from it
SLICES_MM = (1.5, 2.0)
HOLE_DEG, STEP_MM = 2.0, 2.5  # the bone near a touched point must not fall away, as it does at a hole or a socket
CENTRE_BELOW_TOP_MM = 85.0  # rays come in towards a point this far below the top of the skull
FAR_MM = 3.0  # a true TRE above it has to be refused or warned of

# azimuth from the front (deg, + right), elevation (deg): limits of patches over the head, as a protocol spreads its points
PATCHES = ((-115, -70, 5, 40), (70, 115, 5, 40), (-40, 40, 40, 72), (-38, 38, 8, 36), (-52, 52, -18, 4), (-60, 60, 20, 60))
LANDMARK_PLACES = ((0, -14), (-40, -12), (40, -12), (0, -30), (-85, -12), (85, -12))


@dataclass(frozen=True)
class Condition:
    """What is drawn for the cases of a class."""

    landmark_sd_mm: float = 2.3
    outlier_share: float = 0.0
    points: int = 18
    sweep: bool = False
    spread: str = "head"  # head, side, vault
    ultrasound: bool = False


CONDITIONS = {
    "plain": Condition(),
    "poor landmarks": Condition(landmark_sd_mm=6.9),
    "outliers": Condition(outlier_share=0.2),
    "poor landmarks, outliers": Condition(landmark_sd_mm=6.9, outlier_share=0.2),
    "sweep": Condition(points=2000, sweep=True),
    "sweep, poor landmarks": Condition(landmark_sd_mm=6.9, points=2000, sweep=True),
    "sweep, outliers": Condition(points=2000, sweep=True, outlier_share=0.2),
    "ultrasound": Condition(ultrasound=True),
    "ultrasound, outliers": Condition(ultrasound=True, outlier_share=0.2),
    "ultrasound, poor landmarks": Condition(ultrasound=True, landmark_sd_mm=6.9),
    "ultrasound sweep": Condition(ultrasound=True, points=1000, sweep=True),
    "ultrasound sweep, outliers": Condition(ultrasound=True, points=1000, sweep=True, outlier_share=0.2),
    "one side": Condition(spread="side"),
    "vault": Condition(spread="vault"),
}


@dataclass(frozen=True, eq=False)
class Head:
    """A skull as it is, and as a segmentation gives it."""

    true: Surface
    given: BoneSurfaces
    centre_mm: Array

    def touch(self, azimuth_deg: Array, elevation_deg: Array, alone: bool = False) -> tuple[Array, Array]:
        """Where rays from outside meet the bone, and the outward normals there; NaN where they meet none."""
        azimuth, elevation = np.radians(azimuth_deg), np.radians(elevation_deg)
        outward = np.stack([np.sin(azimuth) * np.cos(elevation), np.cos(azimuth) * np.cos(elevation), np.sin(elevation)], axis=-1)
        hits = self.true.cast(self.centre_mm + 200 * outward, -outward)
        points = self.centre_mm + (200 - hits.distances_mm)[:, None] * outward
        wrong = (hits.normals * outward).sum(axis=1) < 0.5  # a rim, an ear canal: nobody measures there
        for step in np.array([[1, 0], [-1, 0], [0, 1], [0, -1]]) * HOLE_DEG:
            if not alone:
                around, _ = self.touch(azimuth_deg + step[0], elevation_deg + step[1], alone=True)
                wrong |= ~(np.abs(np.linalg.norm(around - self.centre_mm, axis=1) - 200 + hits.distances_mm) < STEP_MM)
        return np.where(wrong[:, None], np.nan, points), hits.normals


@cache
def head(shape: int, level_hu: float, slice_mm: float) -> Head:
    """One of the heads."""
    import SimpleITK
    from vtkmodules.util.numpy_support import numpy_to_vtk, vtk_to_numpy
    from vtkmodules.vtkCommonDataModel import vtkImageData
    from vtkmodules.vtkFiltersCore import vtkFlyingEdges3D, vtkPolyDataConnectivityFilter

    volume = load_sample_head()
    stretch = np.diag([*SHAPES[shape], 1.0])
    to_ras = stretch @ volume.ijk_to_ras
    smooth = SimpleITK.GetArrayFromImage(SimpleITK.SmoothingRecursiveGaussian(SimpleITK.GetImageFromArray(volume.hu), 0.6))
    grid, contour = vtkImageData(), vtkFlyingEdges3D()
    grid.SetDimensions(*smooth.shape[::-1])
    grid.GetPointData().SetScalars(numpy_to_vtk(smooth.ravel(), deep=True))
    contour.SetInputData(grid)
    contour.SetValue(0, level_hu)
    largest = vtkPolyDataConnectivityFilter()  # no headrest, no wire
    largest.SetInputConnection(contour.GetOutputPort())
    largest.SetExtractionModeToLargestRegion()
    largest.Update()
    vertices = transform_points(to_ras, vtk_to_numpy(largest.GetOutput().GetPoints().GetData()).astype(float))
    triangles = vtk_to_numpy(largest.GetOutput().GetPolys().GetConnectivityArray()).reshape(-1, 3).astype(np.int64)
    true = Surface(vertices, triangles[:, ::-1] if np.linalg.det(to_ras[:3, :3]) < 0 else triangles)
    given = segment_bone(coarse_ct(Volume(volume.hu, to_ras, "world"), slice_mm))
    centre = np.array([*true.center_mm[:2], vertices[:, 2].max() - CENTRE_BELOW_TOP_MM])
    return Head(true, given, centre)


def coarse_ct(volume: Volume, slice_mm: float) -> Volume:
    """A CT of the same head with other slices, shifted against the first, and noise."""
    from scipy.ndimage import gaussian_filter1d, map_coordinates

    old = np.linalg.norm(volume.ijk_to_ras[:3, 2])
    hu = gaussian_filter1d(volume.hu.astype(np.float32), 0.35 * slice_mm / old, axis=0)
    k = np.arange(0.4, volume.hu.shape[0] - 1, slice_mm / old)
    mesh = np.meshgrid(k, np.arange(hu.shape[1]), np.arange(hu.shape[2]), indexing="ij")
    noisy = map_coordinates(hu, mesh, order=1) + np.random.default_rng(0).normal(0, 12, mesh[0].shape)
    step = np.diag([1, 1, slice_mm / old, 1.0])
    step[2, 3] = 0.4
    return Volume(np.rint(noisy).astype(np.int16), volume.ijk_to_ras @ step, "world")


@dataclass(frozen=True, eq=False)
class World:
    """One case and the truth behind it."""

    problem: RegistrationProblem
    truth: Array  # (4, 4) reference_to_ras
    targets: Array  # (10, 3)
    outliers: Array  # (N,) bool
    bound_mm: float

    def tre(self, reference_to_ras: Array) -> Array:
        """(10,) true error at the targets."""
        moved = transform_points(reference_to_ras @ invert_rigid(self.truth), self.targets)
        return np.linalg.norm(moved - self.targets, axis=1)


def draw_places(rng: np.random.Generator, condition: Condition) -> tuple[Array, Array, Array]:
    """Azimuth, elevation (deg) and sweep number of more points than are needed."""
    if condition.sweep:
        return _draw_glides(rng, condition.points)
    count = 6 * condition.points
    if condition.spread == "side":
        return rng.uniform(40, 120, count), rng.uniform(-10, 55, count), np.arange(count)
    if condition.spread == "vault":
        return rng.uniform(-180, 180, count), rng.uniform(42, 88, count), np.arange(count)
    patches = rng.permutation(np.array(PATCHES) + rng.normal(0, 5, (len(PATCHES), 4)))[np.arange(count) % len(PATCHES)]
    left, right, low, high = patches.T
    return rng.uniform(left, right), rng.uniform(low, high), np.arange(count)


def _draw_glides(rng: np.random.Generator, count: int) -> tuple[Array, Array, Array]:
    number = int(rng.integers(6, 11))
    sweeps = np.sort(rng.integers(0, number, int(1.3 * count)))
    azimuth, elevation = np.empty(len(sweeps)), np.empty(len(sweeps))
    for k in range(number):
        share = np.linspace(0, 1, int((sweeps == k).sum()))
        left, right, low, high = np.array(PATCHES[k % len(PATCHES)]) + rng.normal(0, 5, 4)
        ends = rng.uniform([left, low], [right, high], (4, 2))
        middle, across = np.array([(left + right) / 2, (low + high) / 2]), np.array([right - left, high - low]) / 2
        path = middle + across * np.sin(np.outer(share, rng.uniform(2, 9, 2)) + ends[0])  # to and fro
        azimuth[sweeps == k], elevation[sweeps == k] = path.T
    return azimuth, elevation, sweeps


def _even(found: Array, patches: int, count: int) -> Array:
    """Indices of `count` of the points found, as many from each patch as it has."""
    index = np.flatnonzero(found)
    rank = np.empty(len(index), dtype=int)
    for patch in range(patches):
        rank[index % patches == patch] = np.arange(int((index % patches == patch).sum()))
    return np.sort(index[np.argsort(rank, kind="stable")[:count]])


def draw_errors(rng: np.random.Generator, sweeps: Array, sd_mm: float, sweep: bool) -> Array:
    """(N,) errors along the normal besides each point's own noise: common, of a sweep, and drifting along it."""
    errors = np.full(len(sweeps), rng.normal(0, rng.uniform(0.05, 0.5)))
    if sweep:
        names, member = np.unique(sweeps, return_inverse=True)
        errors += rng.normal(0, rng.uniform(0.05, 0.4), len(names))[member]
        drift = np.cumsum(rng.normal(0, 1, len(sweeps)))
        drift -= np.convolve(np.pad(drift, 60, mode="edge"), np.ones(121) / 121, mode="valid")
        errors += rng.uniform(0, 0.5) * sd_mm * drift / drift.std()
    return errors


def draw_world(seed: int, condition: Condition) -> World:
    """A case; the same seed with another condition keeps what both conditions share."""
    rng, bad = np.random.default_rng(seed), np.random.default_rng([seed, 1])
    skull = head(int(rng.integers(len(SHAPES))), float(rng.choice(TRUE_LEVELS_HU)), float(rng.choice(SLICES_MM)))
    sd_mm = float(rng.uniform(0.25, 0.7))
    truth = rigid(Rotation.random(random_state=seed).as_matrix(), rng.uniform(-400, 400, 3))
    places = rng.choice(len(LANDMARK_PLACES), 4, replace=False)
    while not {0, 3} & set(places) or not {1, 4} & set(places) or not {2, 5} & set(places):
        places = rng.choice(len(LANDMARK_PLACES), 4, replace=False)
    landmarks, _ = skull.touch(*np.array([LANDMARK_PLACES[i] for i in places], dtype=float).T)
    missing = ~np.isfinite(landmarks[:, 0])
    landmarks[missing] = skull.centre_mm + rng.normal(0, 60, (int(missing.sum()), 3))
    digitised = landmarks + condition.landmark_sd_mm * rng.lognormal(0, 0.15) * rng.standard_normal((4, 3))
    targets, _ = skull.touch(rng.uniform(-150, 150, 60), rng.uniform(-5, 75, 60))
    targets = targets[np.isfinite(targets[:, 0])][:10]
    azimuth, elevation, sweeps = draw_places(rng, condition)
    points, normals = skull.touch(azimuth, elevation)
    kept = _even(np.isfinite(points[:, 0]), 1 if condition.sweep else len(PATCHES), condition.points)
    points, normals, sweeps = points[kept], normals[kept], sweeps[kept]
    if condition.ultrasound:
        shared = draw_errors(rng, sweeps, 0.0, condition.sweep) if condition.sweep else np.zeros(len(points))
        place = points + normals * shared[:, None]  # what the depth's zero does not explain: coupling, the tracker's drift
        found = draw_echoes(rng, bad, place, normals, azimuth[kept], elevation[kept], condition.outlier_share)
    else:
        found = draw_touched(rng, bad, points, normals, draw_errors(rng, sweeps, sd_mm, condition.sweep), sd_mm, condition)
    back = invert_rigid(truth)
    touched = transform_points(back, digitised)
    problem = RegistrationProblem(
        surface=skull.given.outer_table,
        points=found.points.transformed(back),
        initial_reference_to_ras=fit_rigid(touched, landmarks),
        landmarks_ct_mm=landmarks,
        landmarks_patient_mm=touched,
        surface_sd_mm=skull.given.position_sd_mm,
        surface_offset_sd_mm=skull.given.offset_sd_mm,
    )
    return World(problem, truth, targets, found.outliers, _bound(points, normals, found, landmarks, condition, targets))


def draw_touched(
    rng: np.random.Generator,
    bad: np.random.Generator,
    points: Array,
    normals: Array,
    shared: Array,
    sd_mm: float,
    condition: Condition,
) -> Echoes:
    """Points touched with a stylus, which has no beam and no speed of sound."""
    measured = points + normals * shared[:, None] + rng.normal(0, sd_mm, points.shape)
    outliers = bad.random(len(points)) < condition.outlier_share
    side = np.where(bad.random(len(points)) < bad.choice([0.5, 0.8, 1.0]), 1.0, -1.0)  # mostly too shallow
    measured = measured + (outliers * side * bad.uniform(2, 8, len(points)))[:, None] * normals
    return Echoes(BonePoints.palpated(measured, STYLUS_POINT_SD_MM), outliers, sd_mm, np.zeros(len(points)), 1.0)


def _bound(points: Array, normals: Array, found: Echoes, landmarks: Array, condition: Condition, targets: Array) -> float:
    """Mean TRE of the Cramer-Rao bound: independent noise, an unknown offset and speed of sound, and the landmarks."""
    good = ~found.outliers
    pivot = points[good].mean(axis=0)
    rows = np.einsum("ni,nij->nj", normals[good], motion_jacobian(points[good], pivot))
    design = np.column_stack([rows, np.ones(len(rows)), found.reach_mm[good]]) / found.sd_mm
    information = design.T @ design
    information[7, 7] += 1 / found.speed_sd**2
    pairs = motion_jacobian(landmarks, pivot).reshape(-1, 6) / condition.landmark_sd_mm
    information[:6, :6] += pairs.T @ pairs
    return float(predict_tre(np.linalg.inv(information)[:6, :6], pivot, targets).mean_mm.mean())


@dataclass(frozen=True)
class Row:
    """One registration."""

    condition: str
    seed: int
    bound_mm: float
    tre_mm: float  # mean over the targets
    covered: float  # share of the targets whose error is below the predicted 95 %
    predicted_mm: float
    predicted_p95_mm: float  # mean over the targets
    worst_ratio: float  # largest error over predicted 95 %
    status: str
    cpu_ms: float
    messages: str


def run_case(name: str, condition: Condition, seed: int, solve: Callable[[RegistrationProblem], object]) -> Row:
    """Register one world and hold the result to the truth."""
    world = draw_world(seed, condition)
    nan = float("nan")
    started = time.process_time()
    try:
        result = solve(world.problem)
    except InputError as error:
        return Row(name, seed, world.bound_mm, nan, nan, nan, nan, nan, "refused", nan, str(error))
    cpu_ms = 1e3 * (time.process_time() - started)
    verdict = judge(world.problem, result, world.targets)
    tre, told = world.tre(result.reference_to_ras), predict_tre_of(result, world.targets)
    return Row(
        condition=name,
        seed=seed,
        bound_mm=world.bound_mm,
        tre_mm=float(tre.mean()),
        covered=float(np.mean(tre < told.p95_mm)),
        predicted_mm=float(told.mean_mm.mean()),
        predicted_p95_mm=float(told.p95_mm.mean()),
        worst_ratio=float((tre / told.p95_mm).max()),
        status=verdict.status,
        cpu_ms=cpu_ms,
        messages="; ".join(verdict.messages),
    )


def summary(name: str, rows: list[Row], plain_mm: float) -> str:
    """One line of the table."""
    done = [row for row in rows if np.isfinite(row.tre_mm)]
    tre, bound = np.array([row.tre_mm for row in done]), float(np.mean([row.bound_mm for row in done]))
    covered, predicted, p95 = (
        float(np.mean([getattr(row, field) for row in done])) for field in ("covered", "predicted_mm", "predicted_p95_mm")
    )
    status = [row.status for row in rows]
    silent = sum(row.status == "accepted" and (row.tre_mm > FAR_MM or row.worst_ratio > 2) for row in done)
    return (
        f"{name:26s} {tre.mean():5.2f} {np.median(tre):5.2f} {np.percentile(tre, 95):5.2f} {tre.max():6.2f} {bound:6.2f}"
        f" {tre.mean() / bound:6.2f} {tre.mean() / plain_mm:7.2f} {covered:8.3f} {predicted:6.2f} {p95:6.2f}"
        f" {status.count('warning'):5d} {status.count('refused'):5d} {silent:5d} {np.median([row.cpu_ms for row in done]):7.0f}"
    )


HEADING = (
    f"{'':26s} {'TRE':>5s} {'med.':>5s} {'95%':>5s} {'max':>6s} {'bound':>6s} {'ratio':>6s} {'/plain':>7s} {'covered':>8s}"
    f" {'pred.':>6s} {'p95':>6s} {'warn':>5s} {'ref.':>5s} {'wrong':>5s} {'CPU ms':>7s}"
)


def main() -> None:
    """Run the classes asked for."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("-o", "--output", type=Path, required=True)
    parser.add_argument("--cases", type=int, default=40)
    parser.add_argument("--first-seed", type=int, default=0)
    parser.add_argument("--classes", nargs="+", choices=list(CONDITIONS), default=list(CONDITIONS))
    parser.add_argument("--method", default="cranionav")
    options = parser.parse_args()
    method = METHODS.create(options.method)
    print("TRE in mm; 'wrong': accepted although the TRE is above 3 mm or twice the predicted 95 %\n" + HEADING)
    every: list[Row] = []
    plain: dict[bool, float] = {}
    for name in options.classes:
        condition = CONDITIONS[name]
        seeds = range(options.first_seed, options.first_seed + options.cases)
        rows = [run_case(name, condition, seed, method.register) for seed in seeds]
        mean = float(np.nanmean([row.tre_mm for row in rows]))
        plain.setdefault(condition.sweep, mean)
        print(summary(name, rows, plain[condition.sweep]), flush=True)
        every += rows
    options.output.mkdir(parents=True, exist_ok=True)
    with (options.output / "registration_worlds.csv").open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, list(asdict(every[0])))
        writer.writeheader()
        writer.writerows(asdict(row) for row in every)


if __name__ == "__main__":
    main()
