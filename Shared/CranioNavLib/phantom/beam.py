"""What the sound beam meets: a bundle of rays from the probe onto the true bone."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from CranioNavLib.phantom import constants
from CranioNavLib.rigid import Array, transform_directions
from CranioNavLib.surface import Surface

RINGS = ((0.0, 1), (0.35, 6), (0.7, 6), (1.1, 8), (1.7, 8), (2.3, 8))  # radius mm, rays
SAME_SURFACE_MM = 3.0  # rays that end farther than this from the middle one see something else (edge, hole)
BEYOND_OUTER_TABLE_MM = 0.8  # where the second cast starts, behind the outer table
THICKEST_BONE_MM = 14.0


def _bundle() -> tuple[Array, Array]:
    offsets, areas = [], []
    edges = [0.0, 0.18, 0.53, 0.9, 1.4, 2.0, 2.6]
    for index, (radius, count) in enumerate(RINGS):
        angle = 2 * np.pi * (np.arange(count) + 0.5 * (index % 2)) / count
        offsets.append(np.column_stack([radius * np.cos(angle), radius * np.sin(angle)]))
        areas.append(np.full(count, (edges[index + 1] ** 2 - edges[index] ** 2) / count))
    return np.vstack(offsets), np.concatenate(areas)


OFFSETS_MM, _AREAS = _bundle()  # (M, 2), (M,)
_HALF = constants.BEAM_WIDTH_MM / 2
BEAM_WEIGHTS = _AREAS * np.exp(-np.log(2.0) * (np.linalg.norm(OFFSETS_MM, axis=1) / _HALF) ** 2)
BEAM_WEIGHTS /= BEAM_WEIGHTS.sum()
# A plane reflector's tilt is felt over the element, not over the -6 dB beam: weights out to its rim.
TILT_WEIGHTS = _AREAS * (np.linalg.norm(OFFSETS_MM, axis=1) <= constants.ELEMENT_DIAMETER_MM / 2)
TILT_WEIGHTS /= TILT_WEIGHTS.sum()


@dataclass(frozen=True, eq=False)
class BeamOnBone:
    """F beams on the bone. NaN where the beam meets none."""

    ranges_mm: Array  # (F, M) from the contact plane along each ray; NaN: no bone
    center_mm: Array  # (F,) range of the plane fitted to the footprint, at the beam's axis
    tilt_deg: Array  # (F,) angle between beam and the footprint's normal
    roughness_mm: Array  # (F,) RMS of the footprint about its plane, beam-weighted
    thickness_mm: Array  # (F,) outer to inner table along the axis; NaN: none found
    normals: Array  # (F, 3) of the footprint, towards the probe, in the frame of the bone


def look_at_bone(bone: Surface, contact_to_ras: npt.ArrayLike) -> BeamOnBone:
    """The bone as seen from contact planes: frames (F, 4, 4) at the skin with +z along the beam."""
    frames = np.asarray(contact_to_ras, dtype=float).reshape(-1, 4, 4)
    count, rays = len(frames), len(OFFSETS_MM)
    axes = frames[:, :3, :3]
    origins = frames[:, None, :3, 3] + np.einsum("fij,mj->fmi", axes[:, :, :2], OFFSETS_MM)
    beams = np.repeat(axes[:, :, 2], rays, axis=0)
    ranges = bone.cast(origins.reshape(-1, 3), beams).distances_mm.reshape(count, rays)
    ranges[~np.isfinite(ranges)] = np.nan
    center, slopes, roughness = _plane_fit(ranges)
    inward = frames[:, :3, 3] + axes[:, :, 2] * (np.nan_to_num(center) + BEYOND_OUTER_TABLE_MM)[:, None]
    behind = bone.cast(inward, axes[:, :, 2]).distances_mm + BEYOND_OUTER_TABLE_MM
    thickness = np.where((behind < THICKEST_BONE_MM) & np.isfinite(center), behind, np.nan)
    normals = np.column_stack([slopes, np.full(count, -1.0)])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    turned = np.stack([transform_directions(frame, normal[None])[0] for frame, normal in zip(frames, normals)])
    tilt = np.degrees(np.arctan(np.linalg.norm(slopes, axis=1)))
    return BeamOnBone(ranges, center, tilt, roughness, thickness, turned)


def _plane_fit(ranges: Array) -> tuple[Array, Array, Array]:
    """Weighted plane through each beam's footprint: range at the axis (F,), slopes (F, 2), roughness (F,)."""
    valid: npt.NDArray[np.bool_] = np.asarray(np.isfinite(ranges))
    some = np.asarray(valid.any(axis=1))
    anchor = np.where(some, np.nanmedian(np.where(some[:, None], ranges, 0.0), axis=1), np.nan)
    with np.errstate(invalid="ignore"):
        valid &= np.abs(ranges - anchor[:, None]) < SAME_SURFACE_MM
    enough = (valid * BEAM_WEIGHTS).sum(axis=1) > 0.3
    weights = np.where(valid, TILT_WEIGHTS, 0.0)
    values = np.where(valid, ranges, 0.0)
    design = np.column_stack([np.ones(len(OFFSETS_MM)), OFFSETS_MM])
    normal = np.einsum("fm,mi,mj->fij", weights, design, design) + 1e-9 * np.eye(3)
    plane = np.linalg.solve(normal, np.einsum("fm,fm,mi->fi", weights, values, design)[..., None])[..., 0]
    residual = np.where(valid, values - plane @ design.T, 0.0)
    share = np.where(valid, BEAM_WEIGHTS, 0.0)
    total = np.maximum(share.sum(axis=1), 1e-9)
    center = plane[:, 0] + (share * residual).sum(axis=1) / total  # the beam's own mean, on a curved footprint
    roughness = np.sqrt(np.maximum((share * residual**2).sum(axis=1) / total - (center - plane[:, 0]) ** 2, 0.0))
    lost = np.where(enough, 1.0, np.nan)
    return center * lost, plane[:, 1:] * lost[:, None], roughness * lost
