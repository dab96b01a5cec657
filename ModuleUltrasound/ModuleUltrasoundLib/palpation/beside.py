"""Places beside a point of the protocol, where clamp or reference base are in the way of its own."""

from __future__ import annotations

import numpy as np
from CranioNavLib.rigid import Array
from CranioNavLib.surface import Surface

from ModuleUltrasoundLib.palpation.footprint import STAND_OFF_MM, probe_footprint, tangents

REACH_MM = 45.0  # a forehead point that has to make way for a pin on a neighbour's place still finds one
STEP_MM = 2.0  # a zygoma holds the probe on 1 to 2 cm^2: the windows' own grid of 3 mm misses places there
LARGEST_TURN_DEG = 45.0  # bone that faces another way tells of another motion of the head
LARGEST_LEDGE_MM = 6.0  # the temporal fossa behind the zygoma's rim lies 15 mm lower: another place, under muscle


def places_beside(surface: Surface, position_mm: Array, normal: Array) -> tuple[Array, Array, Array]:
    """Places around one on a surface where a probe can stand, on the same stretch of bone.

    The bone goes on from one place to another without a ledge when the way between them is square to the mean of
    their normals, as on a sphere.

    Parameters
    ----------
    surface : Surface
    position_mm, normal : arrays, shape (3,)
        A place and its outward unit normal.

    Returns
    -------
    positions (M, 3), normals (M, 3) as of `probe_footprint`, and (M,) roughness in mm.
    """
    count = int(REACH_MM / STEP_MM)
    steps = STEP_MM * np.array(
        [(i, j) for i in range(-count, count + 1) for j in range(-count, count + 1) if i * i + j * j <= count * count],
        dtype=float,
    )
    across, up = tangents(normal[None])
    origins = position_mm + steps[:, :1] * across + steps[:, 1:] * up + STAND_OFF_MM * normal
    distances = surface.cast(origins, np.broadcast_to(-normal, origins.shape)).distances_mm
    seen = np.isfinite(distances) & (distances < STAND_OFF_MM + REACH_MM)
    feet = origins[seen] - distances[seen, None] * normal
    positions, normals, roughness, good = probe_footprint(surface, feet, np.tile(normal, (len(feet), 1)))
    way, between = positions - position_mm, normals + normal
    ledge = np.abs(np.sum(way * between, axis=1)) / np.linalg.norm(between, axis=1)
    good &= (np.linalg.norm(way, axis=1) <= REACH_MM) & (normals @ normal > np.cos(np.radians(LARGEST_TURN_DEG)))
    good &= ledge < LARGEST_LEDGE_MM
    return positions[good], normals[good], roughness[good]
