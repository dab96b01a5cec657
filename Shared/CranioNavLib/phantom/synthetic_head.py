"""The parametric synthetic head: for machines that cannot fetch the sample head. A shape, not an anatomy.

An ellipsoid of bone with brows, orbits, nose, cheekbones, temporal hollows and uneven parietal bones, closed all
round, with scalp over it and a head holder behind it. It is lopsided enough to have only one best registration.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from CranioNavLib.rigid import Array
from CranioNavLib.volume import Volume

SPACING_MM = 1.2
HALF_EXTENT_MM = (98.0, 118.0, 104.0)  # right, front, top
SEMI_AXES_MM = (72.0, 90.0, 82.0)  # outer table: right, front, top; adult neurocranium about 145 x 180 mm

# azimuth from the face to the patient's right, elevation, degrees; height mm; width (SD) degrees
BONE_BUMPS = (
    (17, 3, 5.0, 9), (-18, 4, 5.5, 9), (0, 6, 3.0, 7),  # brows, glabella
    (0, -6, -3.0, 4), (0, -17, 7.0, 6),  # nasion, nasal bones
    (24, -14, -9.0, 9), (-25, -14, -9.5, 9),  # orbits
    (43, -7, 4.0, 5), (-44, -7, 4.0, 5),  # lateral orbital rims
    (47, -21, 7.0, 8), (-49, -23, 8.0, 9),  # cheekbones
    (0, -38, 9.0, 12), (0, -31, 4.0, 4),  # upper jaw, nasal spine
    (75, -3, -5.0, 14), (-74, -5, -4.5, 14),  # temporal hollows
    (122, 35, 3.0, 18), (-116, 40, 5.0, 20),  # parietal bones
    (180, -15, 4.0, 12), (-160, 8, 2.5, 14),  # back of the head
    (8, 50, 2.0, 14), (-30, 38, 1.5, 10),  # forehead
)  # fmt: skip
SCALP_MM = 5.0
SCALP_BUMPS = (
    (75, -3, 6.0, 15),
    (-74, -5, 6.0, 15),
    (0, -20, 12.0, 5),
    (180, -10, 2.5, 25),
    (24, -14, 9.0, 8),
    (-25, -14, 9.0, 8),
)
LANDMARK_DIRECTIONS_DEG = ((0, -6), (-44, -7), (43, -7), (0, -31))  # in the order of LANDMARK_LABELS

# From the outer table inwards: depth mm at which a layer begins, and its HU
LAYERS = ((0.0, 1350.0), (1.8, 480.0), (4.8, 1250.0), (6.5, 35.0))
SCALP_HU, AIR_HU, HOLDER_HU = 55.0, -1000.0, 180.0
BLUR_MM = 0.7  # SD of the scanner's point spread
HOLDER_RADIUS_MM, HOLDER_THICKNESS_MM = 112.0, 3.0
GRID_DEG = 0.5


def synthetic_head() -> tuple[Volume, Array]:
    """The head as a CT of 1.2 mm voxels, and its four landmarks near the bone (4, 3), RAS mm. Always the same."""
    half = np.array(HALF_EXTENT_MM)
    counts = np.round(2 * half / SPACING_MM).astype(int) + 1
    ijk_to_ras = np.diag([-SPACING_MM, -SPACING_MM, SPACING_MM, 1.0])
    ijk_to_ras[:3, 3] = (half[0], half[1], -half[2])
    x = (half[0] - SPACING_MM * np.arange(counts[0]))[None, None, :].astype(np.float32)
    y = (half[1] - SPACING_MM * np.arange(counts[1]))[None, :, None].astype(np.float32)
    z = (-half[2] + SPACING_MM * np.arange(counts[2]))[:, None, None].astype(np.float32)
    radius = np.sqrt(x**2 + y**2 + z**2)
    outside_bone, scalp = _outside_bone(x, y, z, radius)
    hu = np.interp(-outside_bone, *_bone_profile()).astype(np.float32)
    air_share = _step(outside_bone - scalp)
    hu = hu * (1 - air_share) + AIR_HU * air_share
    shell = np.abs(np.hypot(x, y) - HOLDER_RADIUS_MM) - HOLDER_THICKNESS_MM / 2
    behind = np.broadcast_to((shell < 0) & (y < -40.0), hu.shape)
    hu[behind & (air_share > 0.99)] = HOLDER_HU
    rounded = np.rint(hu).astype(np.int16)
    rounded.setflags(write=False)
    azimuth, elevation = np.radians(np.array(LANDMARK_DIRECTIONS_DEG, dtype=float)).T
    directions = _directions(azimuth, elevation)
    landmarks: Array = directions * _radius(directions)[:, None]
    return Volume(rounded, ijk_to_ras, "parametric synthetic head"), landmarks


def _directions(azimuth: Array, elevation: Array) -> Array:
    flat = np.cos(elevation)
    unit: Array = np.stack([np.sin(azimuth) * flat, np.cos(azimuth) * flat, np.sin(elevation)], axis=-1)
    return unit


def _bumps(directions: Array, bumps: tuple[tuple[float, float, float, float], ...]) -> Array:
    total = np.zeros(directions.shape[:-1])
    for azimuth, elevation, height, width in bumps:
        center = _directions(np.radians(np.array(float(azimuth))), np.radians(np.array(float(elevation))))
        angle = np.degrees(np.arccos(np.clip(directions @ center, -1, 1)))
        total += height * np.exp(-0.5 * (angle / width) ** 2)
    return total


def _radius(directions: Array) -> Array:
    """Distance of the outer table from the middle of the head in given directions (..., 3)."""
    ellipsoid = 1 / np.linalg.norm(directions / np.array(SEMI_AXES_MM), axis=-1)
    radius: Array = ellipsoid + _bumps(directions, BONE_BUMPS)
    return radius


def _outside_bone(
    x: npt.NDArray[np.float32], y: npt.NDArray[np.float32], z: npt.NDArray[np.float32], radius: npt.NDArray[np.float32]
) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.float32]]:
    """Distance outside the outer table and thickness of the scalp at each voxel, from a table over all directions."""
    from scipy.ndimage import map_coordinates

    azimuths = np.radians(np.arange(-180, 180 + GRID_DEG, GRID_DEG))
    elevations = np.radians(np.arange(-90, 90 + GRID_DEG, GRID_DEG))
    directions = _directions(*np.meshgrid(azimuths, elevations))
    at = [
        (np.degrees(np.arcsin(np.clip(z / np.maximum(radius, 1e-3), -1, 1))) + 90) / GRID_DEG,
        np.broadcast_to((np.degrees(np.arctan2(x, y)) + 180) / GRID_DEG, radius.shape),
    ]
    bone = map_coordinates(_radius(directions).astype(np.float32), at, order=1, mode="nearest")
    scalp_table = (SCALP_MM + _bumps(directions, SCALP_BUMPS)).astype(np.float32)
    return radius - bone, map_coordinates(scalp_table, at, order=1, mode="nearest")


def _step(distance: npt.NDArray[np.float32]) -> npt.NDArray[np.float32]:
    """0 inside, 1 outside, blurred."""
    from scipy.special import ndtr

    return np.asarray(ndtr(distance / BLUR_MM), dtype=np.float32)


def _bone_profile() -> tuple[Array, Array]:
    """HU against depth below the outer table, blurred."""
    from scipy.special import ndtr

    depths: Array = np.asarray(np.arange(-6.0, 14.0, 0.1), dtype=float)
    values = np.full(depths.shape, SCALP_HU)
    before = SCALP_HU
    for begins, hu in LAYERS:
        values += (hu - before) * ndtr((depths - begins) / BLUR_MM)
        before = hu
    return depths, values
