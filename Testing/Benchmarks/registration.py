"""Registration methods side by side on the same simulated cases: time, TRE, failures, and the Cramer-Rao bound.

    python Testing/Benchmarks/registration.py -o DIR [--surface bone.vtp] [--trials 30] [--landmark-sd 2.3]

Writes DIR/registration.csv and DIR/registration.png. The cases are simulated: 18 points drawn over the regions of the
palpation protocol on the surface itself, a common offset, white noise, four landmarks. Points carry errors, the surface
does not, so the figures compare methods; they are no accuracy of the system. The picture shows the processor's time, which
other programs on the machine do not change. Without --surface the sample head's outer
table is used.
"""

from __future__ import annotations

import argparse
import csv
import importlib.util
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from CranioNavLib.bone_points import BonePoints
from CranioNavLib.rigid import Array, invert_rigid, rigid, transform_points
from CranioNavLib.surface import Surface
from ModuleRegistrationLib.registration.error_theory import predict_tre
from ModuleRegistrationLib.registration.landmarks import fit_rigid, motion_jacobian
from ModuleRegistrationLib.registration.problem import METHODS, RegistrationProblem
from scipy.spatial.transform import Rotation

# points, azimuth from the front (deg, + right), elevation (deg), as the palpation protocol spreads them
REGIONS = (
    (3, (-115, -75), (5, 40)),
    (3, (75, 115), (5, 40)),
    (4, (-40, 40), (40, 70)),
    (4, (-38, 38), (8, 34)),
    (4, (-52, 52), (-20, 2)),
)
LANDMARKS = ((0, -14), (-40, -14), (40, -14), (0, -32))
TARGETS = ((-90, 15), (90, 15), (-50, 40), (50, 40), (0, 60), (0, 20), (-120, 45), (120, 45), (-30, 5), (30, 5))
NOISE_SD_MM, OFFSET_SD_MM, FAILURE_MM = 0.45, 0.3, 3.0

Solver = Callable[[RegistrationProblem], Array]


@dataclass(frozen=True, eq=False)
class Trial:
    """One simulated case."""

    problem: RegistrationProblem
    truth: Array
    bound_mm: float  # mean TRE of the Cramer-Rao bound


class Head:
    """A surface, and where its regions are."""

    def __init__(self, surface: Surface) -> None:
        self.surface = surface
        self.middles = surface.vertices_mm[surface.triangles].mean(axis=1)
        top, bottom = self.middles[:, 2].max(), self.middles[:, 2].min()
        centre = np.array([surface.center_mm[0], surface.center_mm[1], top - min(85.0, 0.6 * (top - bottom))])
        arm = self.middles - centre
        self.azimuth = np.degrees(np.arctan2(arm[:, 0], arm[:, 1]))
        self.elevation = np.degrees(np.arctan2(arm[:, 2], np.hypot(arm[:, 0], arm[:, 1])))
        self.targets, self.landmarks = self._near(TARGETS), self._near(LANDMARKS)

    def _near(self, places: tuple[tuple[float, float], ...]) -> Array:
        away = [(self.azimuth - azimuth) ** 2 + (self.elevation - elevation) ** 2 for azimuth, elevation in places]
        return self.middles[[int(np.argmin(distance)) for distance in away]]

    def trial(self, seed: int, landmark_sd_mm: float, surface: Surface) -> Trial:
        """A case of 18 points."""
        rng, chosen = np.random.default_rng(seed), []
        for count, (left, right), (low, high) in REGIONS:
            inside = (self.azimuth > left) & (self.azimuth < right) & (self.elevation > low) & (self.elevation < high)
            chosen += list(rng.choice(np.flatnonzero(inside), count, replace=False))
        points, normals = self.middles[chosen], self.surface.vertex_normals[self.surface.triangles[chosen]].mean(axis=1)
        normals /= np.linalg.norm(normals, axis=1, keepdims=True)
        error = rng.normal(0, OFFSET_SD_MM) + rng.normal(0, NOISE_SD_MM, len(points))
        truth = rigid(Rotation.random(random_state=seed).as_matrix(), rng.uniform(-400, 400, 3))
        back = invert_rigid(truth)
        touched = transform_points(back, self.landmarks + rng.normal(0, landmark_sd_mm, self.landmarks.shape))
        palpated = BonePoints.palpated(transform_points(back, points + normals * error[:, None]), NOISE_SD_MM)
        start = fit_rigid(touched, self.landmarks)
        problem = RegistrationProblem(surface, palpated, start, self.landmarks, touched, surface_sd_mm=0.05, seed=seed)
        rows = np.einsum("ni,nij->nj", normals, motion_jacobian(points, points.mean(axis=0)))
        design = np.column_stack([rows, np.ones(len(points))]) / NOISE_SD_MM
        information = design.T @ design
        information[6, 6] += 1 / OFFSET_SD_MM**2
        bound = predict_tre(np.linalg.inv(information)[:6, :6], points.mean(axis=0), self.targets)
        return Trial(problem, truth, float(bound.mean_mm.mean()))

    def tre(self, trial: Trial, reference_to_ras: Array) -> float:
        """Mean error at the targets."""
        moved = transform_points(reference_to_ras, transform_points(invert_rigid(trial.truth), self.targets))
        return float(np.linalg.norm(moved - self.targets, axis=1).mean())


def ours(name: str) -> Solver:
    """One of our methods."""
    method = METHODS.create(name)
    return lambda problem: method.register(problem).reference_to_ras


def vtk_icp(mesh: Any) -> Solver:
    """vtkIterativeClosestPointTransform as SlicerIGT calls it; it builds its locator in every call."""
    from vtkmodules.util.numpy_support import numpy_to_vtk
    from vtkmodules.vtkCommonCore import vtkPoints
    from vtkmodules.vtkCommonDataModel import vtkIterativeClosestPointTransform, vtkPolyData

    def solve(problem: RegistrationProblem) -> Array:
        start = problem.initial_reference_to_ras
        cloud, source = vtkPoints(), vtkPolyData()
        cloud.SetData(numpy_to_vtk(transform_points(start, problem.points.positions_mm), deep=True))
        source.SetPoints(cloud)
        icp = vtkIterativeClosestPointTransform()
        icp.SetSource(source)
        icp.SetTarget(mesh)
        icp.GetLandmarkTransform().SetModeToRigidBody()
        icp.SetMaximumNumberOfIterations(100)
        icp.Update()
        matrix = icp.GetMatrix()
        return np.array([[matrix.GetElement(i, j) for j in range(4)] for i in range(4)]) @ start

    return solve


def small_gicp(surface: Surface) -> Solver:
    """small_gicp's point-to-plane ICP on the vertices."""
    import small_gicp as library

    target = library.PointCloud(surface.vertices_mm)
    tree = library.KdTree(target)
    library.estimate_normals_covariances(target, tree, num_neighbors=12)

    def solve(problem: RegistrationProblem) -> Array:
        source = library.PointCloud(problem.points.positions_mm)
        found = library.align(
            target,
            source,
            tree,
            problem.initial_reference_to_ras,
            registration_type="PLANE_ICP",
            max_correspondence_distance=30.0,
        )
        return np.asarray(found.T_target_source)

    return solve


def trimesh_icp(surface: Surface) -> Solver:
    """trimesh.registration.icp with its default number of iterations."""
    import trimesh

    mesh = trimesh.Trimesh(surface.vertices_mm, surface.triangles, process=False)

    def solve(problem: RegistrationProblem) -> Array:
        start = problem.initial_reference_to_ras
        moved = transform_points(start, problem.points.positions_mm)
        matrix, _, _ = trimesh.registration.icp(moved, mesh, reflection=False, scale=False)
        return np.asarray(matrix) @ start

    return solve


def surgerycore(problem: RegistrationProblem) -> Array:
    """scikit-surgerycore's landmark registration."""
    from sksurgerycore.algorithms.procrustes import orthogonal_procrustes

    rotation, translation, _ = orthogonal_procrustes(problem.landmarks_ct_mm, problem.landmarks_patient_mm)
    return rigid(rotation, translation.ravel())


def fresh(surface: Surface) -> Surface:
    """The same mesh without any index."""
    return Surface(surface.vertices_mm, surface.triangles)


def contestants(surface: Surface, with_trimesh: bool) -> dict[str, Callable[[], Solver]]:
    """Name -> what builds the solver, index included."""
    made: dict[str, Callable[[], Solver]] = {
        f"cranionav: {name}": (lambda name=name: ours(name))
        for name in ("cranionav", "icp", "random-icp", "trimmed-icp", "open3d", "procrustes")
    }
    made["vtkIterativeClosestPointTransform"] = lambda: vtk_icp(surface.to_polydata())
    made["small_gicp PLANE_ICP"] = lambda: small_gicp(surface)
    made["scikit-surgerycore landmarks"] = lambda: surgerycore
    if with_trimesh:
        made["trimesh icp"] = lambda: trimesh_icp(surface)
    return made


def run(surface: Surface, trials: int, landmark_sd_mm: float, with_trimesh: bool) -> list[dict[str, float | str]]:
    """One row a method."""
    head, rows = Head(surface), []
    for name, build in contestants(surface, with_trimesh).items():
        first_ms = first_cpu_ms = np.inf
        for _ in range(2):  # the first of them imports the library, too
            indexed = fresh(surface)
            problem = head.trial(0, landmark_sd_mm, indexed).problem
            started, cpu_started = time.perf_counter(), time.process_time()
            solve = build()
            solve(problem)
            first_ms = min(first_ms, 1e3 * (time.perf_counter() - started))
            first_cpu_ms = min(first_cpu_ms, 1e3 * (time.process_time() - cpu_started))
        errors, times, cpu_times, bounds = [], [], [], []
        for seed in range(trials):
            trial = head.trial(seed, landmark_sd_mm, indexed)
            started, cpu_started = time.perf_counter(), time.process_time()
            pose = solve(trial.problem)
            times.append(1e3 * (time.perf_counter() - started))
            cpu_times.append(1e3 * (time.process_time() - cpu_started))
            errors.append(head.tre(trial, pose))
            bounds.append(trial.bound_mm)
        rows.append(
            {
                "method": name,
                "landmark_sd_mm": landmark_sd_mm,
                "tre_mean_mm": float(np.mean(errors)),
                "tre_sd_mm": float(np.std(errors)),
                "tre_max_mm": float(np.max(errors)),
                "above_3mm": int(np.sum(np.array(errors) > FAILURE_MM)),
                "trials": trials,
                "cramer_rao_mm": float(np.mean(bounds)),
                "median_ms": float(np.median(times)),
                "median_cpu_ms": float(np.median(cpu_times)),
                "first_call_with_index_ms": first_ms,
                "first_call_with_index_cpu_ms": first_cpu_ms,
            }
        )
        print(
            f"{name:36s} TRE {rows[-1]['tre_mean_mm']:6.2f} / {rows[-1]['tre_sd_mm']:5.2f} / {rows[-1]['tre_max_mm']:6.2f} mm, "
            f"above 3 mm {rows[-1]['above_3mm']}/{trials}, bound {rows[-1]['cramer_rao_mm']:.2f} mm, "
            f"{rows[-1]['median_ms']:7.1f} ms ({rows[-1]['median_cpu_ms']:.1f} of the processor), "
            f"with index {first_ms:7.1f} ms ({first_cpu_ms:.1f})",
            flush=True,
        )
    return rows


def plot(rows: list[dict[str, float | str]], triangles: int, path: Path) -> None:
    """A line for each method: TRE beside the bound, failures, time with and without the index; a colour a landmark error."""
    import matplotlib as mpl

    mpl.use("Agg")
    from matplotlib import pyplot
    from matplotlib.ticker import FixedLocator, FormatStrFormatter, NullLocator

    methods = list(dict.fromkeys(str(row["method"]) for row in rows))
    levels = sorted({float(row["landmark_sd_mm"]) for row in rows})
    figure, (tre, failed, speed) = pyplot.subplots(
        1, 3, figsize=(12, 1.6 + 0.42 * len(methods)), sharey=True, width_ratios=(3, 1.5, 3), layout="constrained"
    )
    for row in rows:
        level = levels.index(float(row["landmark_sd_mm"]))
        colour, place = f"C{level}", methods.index(str(row["method"])) + 0.28 * (level - (len(levels) - 1) / 2)
        mean, worst = float(row["tre_mean_mm"]), float(row["tre_max_mm"])
        tre.plot([mean, worst], [place, place], color=colour, linewidth=1.5, alpha=0.5)
        tre.plot(mean, place, "o", color=colour, markersize=6)
        share = 100 * float(row["above_3mm"]) / float(row["trials"])
        failed.barh(place, share, height=0.24, color=colour)
        failed.text(share + 2, place, f"{share:.0f}", va="center", fontsize=8)
        times = [float(row["median_cpu_ms"]), float(row["first_call_with_index_cpu_ms"])]
        speed.plot(times, [place, place], color=colour, alpha=0.4)
        speed.plot(times[0], place, "o", color=colour, markersize=6)
        speed.plot(times[1], place, "o", color=colour, markersize=6, markerfacecolor="white")
    for level, sd in enumerate(levels):
        tre.plot([], [], "o", color=f"C{level}", label=f"landmarks {sd:g} mm (SD per axis)")
    bound = float(rows[0]["cramer_rao_mm"])
    tre.axvline(bound, color="0.4", linestyle="--", label=f"Cramer-Rao bound {bound:.2f} mm")
    figure.legend(loc="outside lower left", ncols=len(levels) + 1, fontsize=9, frameon=False)
    tre.set(xscale="log", xlabel="TRE (mm): mean, line to the largest", yticks=range(len(methods)), yticklabels=methods)
    tre.xaxis.set_major_locator(FixedLocator([0.5, 1, 2, 5, 10, 20, 50]))
    tre.xaxis.set_major_formatter(FormatStrFormatter("%g"))
    tre.xaxis.set_minor_locator(NullLocator())
    failed.set(xlim=(0, 122), xticks=(0, 50, 100), xlabel="TRE above 3 mm (% of cases)")
    speed.set(
        xscale="log",
        xlabel="processor time of one registration (ms): filled with\nthe index built, hollow the first call, index included",
    )
    tre.invert_yaxis()
    for axes in (tre, speed):
        axes.grid(axis="x", color="0.9")
        axes.set_axisbelow(True)
    figure.suptitle(f"18 points, {triangles} triangles, {rows[0]['trials']} simulated cases", fontsize=11)
    figure.savefig(path, dpi=130)


def main() -> None:
    """Run the comparison."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("-o", "--output", type=Path, required=True)
    parser.add_argument("--surface", type=Path)
    parser.add_argument("--trials", type=int, default=30)
    parser.add_argument("--landmark-sd", type=float, nargs="+", default=[2.3, 6.9])
    parser.add_argument("--trimesh", action="store_true", help="trimesh too: seconds a registration")
    options = parser.parse_args()
    if options.trimesh and importlib.util.find_spec("rtree") is None:
        parser.error("--trimesh: trimesh finds closest points with the package rtree, which is not installed")
    if options.surface:
        surface = Surface.read(options.surface)
    else:
        from CranioNavLib.sample_head import load_sample_head
        from ModuleRegistrationLib.anatomy.segmentation import segment_bone

        surface = segment_bone(load_sample_head()).outer_table
    print(f"surface of {len(surface.triangles)} triangles")
    rows = [row for sd in options.landmark_sd for row in run(surface, options.trials, sd, options.trimesh)]
    options.output.mkdir(parents=True, exist_ok=True)
    with (options.output / "registration.csv").open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, list(rows[0]))
        writer.writeheader()
        writer.writerows(rows)
    plot(rows, len(surface.triangles), options.output / "registration.png")


if __name__ == "__main__":
    main()
