"""A skull in closed form, and cases on it whose true pose is known. Simulated; nothing of it is known to the library."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest
from CranioNavLib.bone_points import BonePoints
from CranioNavLib.rigid import Array, invert_rigid, rigid, transform_points
from CranioNavLib.surface import Surface
from ModuleRegistrationLib.registration.landmarks import fit_rigid, motion_jacobian
from ModuleRegistrationLib.registration.problem import RegistrationProblem
from scipy.spatial.transform import Rotation

# azimuth (0 front, + right), elevation, width (deg), height (mm): brow, temples, orbits, cheeks, nose root, parietal bosses
BUMPS = np.array(
    [[0, 8, 14, 3], [-60, 5, 22, -5], [60, 8, 24, -4], [-25, -14, 10, -9], [26, -13, 10, -9], [-52, -22, 12, 6],
     [52, -23, 12, 6], [0, -16, 6, 5], [-95, 45, 25, 4], [100, 42, 25, 4], [10, 55, 20, -2], [180, 10, 30, 6]]
)  # fmt: skip
SEMI_AXES_MM = np.array([72.0, 92.0, 80.0])


def directions(azimuth_deg: Array, elevation_deg: Array) -> Array:
    """Unit vectors, RAS."""
    azimuth, elevation = np.radians(azimuth_deg), np.radians(elevation_deg)
    return np.stack([np.sin(azimuth) * np.cos(elevation), np.cos(azimuth) * np.cos(elevation), np.sin(elevation)], axis=-1)


def skull_points(azimuth_deg: Array, elevation_deg: Array) -> Array:
    """Points of the skull in those directions."""
    rays = directions(azimuth_deg, elevation_deg)
    radius = 1 / np.linalg.norm(rays / SEMI_AXES_MM, axis=-1)
    for azimuth, elevation, width, height in BUMPS:
        angle = np.degrees(np.arccos(np.clip(rays @ directions(azimuth, elevation), -1, 1)))
        radius = radius + height * np.exp(-((angle / width) ** 2))
    return radius[..., None] * rays


@dataclass(frozen=True, eq=False)
class SimulatedCase:
    """A problem and what the simulator knows."""

    problem: RegistrationProblem
    true_reference_to_ras: Array
    bound: Array  # (6, 6) Cramer-Rao bound about the points' centroid, common offset unknown
    pivot: Array
    outliers: np.ndarray
    targets: Array

    def tre(self, reference_to_ras: Array) -> Array:
        """(T,) true error at the targets."""
        back = transform_points(invert_rigid(self.true_reference_to_ras), self.targets)
        return np.linalg.norm(transform_points(reference_to_ras, back) - self.targets, axis=1)


@pytest.fixture(scope="session")
def a_skull() -> Surface:
    """About 26 000 triangles; open below."""
    azimuth, elevation = np.meshgrid(np.linspace(-180, 180, 181)[:-1], np.linspace(-45, 89, 75), indexing="ij")
    vertices = skull_points(azimuth, elevation).reshape(-1, 3)
    index = np.arange(len(vertices)).reshape(azimuth.shape)
    a, b = index[:, :-1], np.roll(index, -1, axis=0)[:, :-1]
    c, d = np.roll(index, -1, axis=0)[:, 1:], index[:, 1:]
    triangles = np.concatenate([np.stack([a, c, b], -1).reshape(-1, 3), np.stack([a, d, c], -1).reshape(-1, 3)])
    surface = Surface(vertices, triangles)
    outward = np.einsum("ij,ij->i", surface.triangle_normals, vertices[triangles].mean(axis=1)) > 0
    return Surface(vertices, np.where(outward[:, None], triangles, triangles[:, ::-1]))


REGIONS = (
    (3, (-115, -75), (0, 40)),
    (3, (75, 115), (0, 40)),
    (4, (-45, 45), (42, 72)),
    (4, (-38, 38), (6, 34)),
    (4, (-50, 50), (-24, 0)),
)


@pytest.fixture(scope="session")
def a_case(a_skull: Surface) -> Callable[..., SimulatedCase]:
    """Cases by seed and what is to be wrong with them."""

    def make(seed: int, **options: Any) -> SimulatedCase:
        return _make_case(a_skull, seed, **options)

    return make


def _make_case(
    surface: Surface,
    seed: int,
    repeats: int = 1,
    landmark_sd: float = 2.3,
    noise_sd: float = 0.4,
    offset: float | None = None,
    speed_error: float = 0.0,
    outlier_share: float = 0.0,
    regions: Any = REGIONS,
    stated_sd: float = 0.4,
    group_bias_sd: float = 0.0,
) -> SimulatedCase:
    rng = np.random.default_rng(seed)
    azimuth = np.concatenate([rng.uniform(*az, n * repeats) for n, az, _ in regions])
    elevation = np.concatenate([rng.uniform(*el, n * repeats) for n, _, el in regions])
    groups = np.concatenate([np.full(n * repeats, k) for k, (n, _, _) in enumerate(regions)])
    truth = skull_points(azimuth, elevation)
    normals = surface.closest(truth).normals
    count = len(truth)
    depths = rng.uniform(3, 9, count)
    error = rng.normal(0, noise_sd, count) + (rng.normal(0, 0.3) if offset is None else offset) + depths * speed_error
    error = error + rng.normal(0, group_bias_sd, len(regions))[groups]
    outliers = rng.random(count) < outlier_share
    error = error + outliers * rng.choice([-1, 1], count) * rng.uniform(2, 8, count)
    measured = truth - normals * error[:, None]
    true_pose = rigid(Rotation.random(random_state=seed).as_matrix(), rng.uniform(-500, 500, 3))
    back = invert_rigid(true_pose)
    points = BonePoints(
        positions_mm=measured,
        covariances_mm2=np.tile(np.eye(3) * stated_sd**2, (count, 1, 1)),
        beam_directions=-normals,
        depths_mm=depths,
        qualities=np.full(count, 0.95),
        labels=tuple(f"P{i + 1}" for i in range(count)),
        speed_of_sound_m_s=1540.0,
        speed_of_sound_sd_m_s=45.0,
        groups=groups if repeats > 1 else np.arange(count),
    ).transformed(back)
    landmarks = skull_points(np.array([0.0, -42, 42, 0]), np.array([-16.0, -14, -14, -36]))
    touched = (
        transform_points(back, landmarks + rng.normal(0, landmark_sd, landmarks.shape))
        if landmark_sd
        else transform_points(back, landmarks)
    )
    problem = RegistrationProblem(
        surface, points, fit_rigid(touched, landmarks), landmarks, touched, surface_sd_mm=0.05, seed=seed
    )
    rows = np.einsum("ni,nij->nj", normals, motion_jacobian(truth, truth.mean(axis=0)))
    design = np.column_stack([rows, np.ones(count)]) / max(noise_sd, 1e-3)
    design_information = design.T @ design + np.diag([0.0] * 6 + [1 / 0.3**2])
    bound = np.linalg.inv(design_information)[:6, :6]
    targets = skull_points(
        np.array([-90.0, 90, -50, 50, 0, 0, -120, 120, -30, 30]), np.array([15.0, 15, 40, 40, 60, 20, 45, 45, 5, 5])
    )
    return SimulatedCase(problem, true_pose, bound, truth.mean(axis=0), outliers, targets)
