"""Titanium spheres: found where they are, below a voxel, and nothing else is."""

from __future__ import annotations

import numpy as np
import pytest
from CranioNavLib.errors import InputError
from CranioNavLib.volume import Volume
from ModuleRegistrationLib.anatomy.extraction import extract
from ModuleRegistrationLib.anatomy.grid import Grid
from ModuleRegistrationLib.anatomy.spheres import find_spheres, sphere_share

SUB = 9  # sub-samples of a voxel along each side: the truth is voxelised apart from the code under test


def with_spheres(volume: Volume, centers_mm: np.ndarray, radius_mm: float = 2.0, metal_hu: float = 8000.0) -> Volume:
    """`volume` with metal spheres, averaged over each voxel, clipped at 3071 HU."""
    grid = Grid.of(volume)
    hu, spacing = volume.hu.astype(float), grid.spacing_mm
    for center in grid.to_index(centers_mm):
        low = np.maximum(np.floor(center - (radius_mm + 3) / spacing).astype(int), 0)
        high = np.minimum(np.ceil(center + (radius_mm + 3) / spacing).astype(int) + 1, hu.shape)
        offsets = (np.arange(SUB) + 0.5) / SUB - 0.5
        k, j, i = (
            ((np.arange(a, b)[:, None] + offsets).ravel() - c) * s for a, b, c, s in zip(low, high, center, spacing, strict=True)
        )
        filled = (k**2)[:, None, None] + (j**2)[:, None] + i**2 < radius_mm**2
        shape = high - low
        share = filled.reshape(shape[0], SUB, shape[1], SUB, shape[2], SUB).mean(axis=(1, 3, 5))
        box = tuple(slice(a, b) for a, b in zip(low, high, strict=True))
        hu[box] += share * (metal_hu - hu[box])
    return Volume(np.clip(np.rint(hu), -1024, 3071).astype(np.int16), volume.ijk_to_ras)


def resampled(volume: Volume, spacing_mm: tuple[float, float, float]) -> Volume:
    """The volume at another spacing (k, j, i)."""
    from scipy.ndimage import zoom

    factors = Grid.of(volume).spacing_mm / spacing_mm
    hu = zoom(volume.hu, factors, order=1, grid_mode=True, mode="nearest")
    matrix = volume.ijk_to_ras.copy()
    ratio = np.array(volume.hu.shape) / np.array(hu.shape)
    matrix[:3, :3] = volume.ijk_to_ras[:3, :3] * ratio[::-1]
    matrix[:3, 3] = Grid.of(volume).to_ras([(ratio - 1) / 2])[0]
    return Volume(hu, matrix)


def errors_mm(found: np.ndarray, true: np.ndarray) -> np.ndarray:
    return np.linalg.norm(found[:, None] - true[None], axis=2).min(axis=0)


@pytest.fixture(scope="module")
def a_head_with_places(a_sample_head):
    """The sample head at the study's protocol, and ten places on skin and bone."""
    found = extract(a_sample_head)
    surface = found.mesh.surface(found.voxels.grid, found.outer)
    random = np.random.default_rng(3)
    places: list[np.ndarray] = []
    for vertex in random.permutation(len(surface.vertices_mm)):
        point, outwards = surface.vertices_mm[vertex], surface.vertex_normals[vertex]
        if point[2] < np.percentile(surface.vertices_mm[:, 2], 30):
            continue
        depth = found.head.depth_at(point[None])[0]
        place = point + outwards * (1.0 if len(places) % 2 else depth + random.uniform(-1, 1))
        if all(np.linalg.norm(place - other) > 25 for other in places):
            places.append(place)
        if len(places) == 10:
            break
    return resampled(a_sample_head, (2.0, 0.42, 0.42)), np.array(places)


@pytest.mark.parametrize("metal_hu", [pytest.param(3500.0, marks=pytest.mark.slow), 8000.0])
def test_all_spheres_on_a_real_head_are_found_to_a_fifth_of_a_millimetre(a_head_with_places, metal_hu):
    head, places = a_head_with_places
    found = find_spheres(with_spheres(head, places, metal_hu=metal_hu))
    errors = errors_mm(found.centers_ras_mm, places)
    print(f"simulated, metal {metal_hu:.0f} HU: centre error mean {errors.mean():.3f}, max {errors.max():.3f} mm")
    assert len(found) == 10
    assert errors.mean() < 0.1
    assert errors.max() < 0.2


def test_a_head_without_spheres_has_none(a_sample_head):
    found = find_spheres(a_sample_head)
    assert len(found) == 0
    assert found.centers_ras_mm.shape == (0, 3)


@pytest.fixture
def air() -> Volume:
    return Volume(np.full((40, 90, 90), -1000, dtype=np.int16), np.diag([-0.6, -0.6, 1.2, 1.0]))


def test_a_sphere_in_air_is_centred_to_a_twentieth_of_a_millimetre(air):
    random = np.random.default_rng(0)
    true = np.array([[-12.0, -12, 12], [-38, -14, 30], [-20, -40, 35]]) + random.uniform(-1, 1, (3, 3))
    assert errors_mm(find_spheres(with_spheres(air, true)).centers_ras_mm, true).max() < 0.05


def test_an_oblique_mirrored_grid_changes_nothing(air):
    turn = np.array([[0.36, 0.48, -0.8], [-0.8, 0.6, 0.0], [0.48, 0.64, 0.6]])
    matrix = np.eye(4)
    matrix[:3, :3] = turn @ np.diag([0.6, -0.6, 1.2])
    tilted = Volume(air.hu, matrix)
    true = Grid.of(tilted).to_ras([[20.3, 40.2, 50.7]])
    assert errors_mm(find_spheres(with_spheres(tilted, true)).centers_ras_mm, true).max() < 0.05


def test_other_metal_is_left_out(air):
    hu = air.hu.copy()
    hu[10:12, 10:60, 10:13] = 3000  # a wire
    hu[20:32, 20:50, 20:50] = 3071  # a block
    hu[8:11, 60:75, 60:75] = 3071  # a plate
    with_metal = with_spheres(Volume(hu, air.ijk_to_ras), np.array([[-40.0, -15.0, 40.0]]))
    assert errors_mm(find_spheres(with_metal).centers_ras_mm, np.array([[-40.0, -15.0, 40.0]])).max() < 0.1
    assert len(find_spheres(with_metal)) == 1


def test_spheres_of_another_size_are_left_out(air):
    true = np.array([[-20.0, -20.0, 20.0]])
    assert len(find_spheres(with_spheres(air, true, radius_mm=4.0))) == 0
    assert len(find_spheres(with_spheres(air, true, radius_mm=4.0), diameter_mm=8.0)) == 1


def test_spheres_come_from_the_top_down(air):
    true = np.array([[-12.0, -12, 12], [-38, -14, 30], [-20, -40, 21]])
    heights = find_spheres(with_spheres(air, true)).centers_ras_mm[:, 2]
    assert (np.diff(heights) < 0).all()


@pytest.mark.parametrize("diameter", [0.0, 50.0, float("nan")])
def test_an_impossible_diameter_is_refused(air, diameter):
    with pytest.raises(InputError, match="expected 1 to 20 mm"):
        find_spheres(air, diameter)


def test_the_shares_of_all_voxels_add_up_to_the_sphere():
    spacing = np.array([1.2, 0.5, 0.5])
    places = np.stack(np.meshgrid(*(np.arange(-4, 4.01, s) for s in spacing), indexing="ij"), axis=-1).reshape(-1, 3)
    total = sphere_share(places, np.array([0.13, 0.2, -0.11]), 2.0, spacing).sum() * spacing.prod()
    assert total == pytest.approx(np.pi / 6 * 4**3, rel=0.02)
