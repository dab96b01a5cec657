"""Leading the hand: which point next, how far the probe is from it, and how to tilt it square to the bone.

Everything here works from the landmark registration alone and gets better with it: positions and normals come
from the bone model under the registration in force, and so does what is said of their uncertainty.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Optional

import numpy as np
import numpy.typing as npt
from CranioNavLib.errors import InputError
from CranioNavLib.parameters import Limits, Parameters
from CranioNavLib.rigid import Array, check_points
from CranioNavLib.surface import Surface

from ModuleUltrasoundLib.protocol import ProtocolPoints

BEAM_RADIUS_MM = 2.5  # half of a 5 mm element: the bone that a beam sees
PROBE_LENGTH_MM = 150.0  # what a probe with the hand takes up outside the head


@dataclass(frozen=True)
class GuidanceSettings(Parameters):
    """When the probe is there, and when it is square to the bone."""

    near_mm: Annotated[float, Limits(0.5, 50), "the beam passes this near the target: on target"] = 5.0
    aligned_deg: Annotated[float, Limits(0.2, 20), "the beam is square to the bone to this angle"] = 2.0
    clamp_clearance_mm: Annotated[float, Limits(0, 200), "between the probe and any part of the head clamp"] = 30.0
    point_sd_mm: Annotated[float, Limits(0.05, 10), "expected error of a point along the bone's normal"] = 0.6
    support_angle_deg: Annotated[float, Limits(0, 90), "normals nearer than this to the table's direction are out of reach"] = (
        50.0
    )


DEFAULTS = GuidanceSettings()

# -- which point next


@dataclass(frozen=True, eq=False)
class NextTarget:
    """The point to palpate next, and what it is expected to bring."""

    index: int  # in the protocol
    label: str
    tre_now_mm: float  # predicted, RMS over the targets
    tre_then_mm: float  # with this point


def motion_rows(positions_ras_mm: npt.ArrayLike, normals: npt.ArrayLike, pivot_ras_mm: npt.ArrayLike) -> Array:
    """(N, 6) how each point's distance to the bone changes with a rotation (rad) about the pivot and a translation (mm)."""
    positions = np.asarray(positions_ras_mm, dtype=float) - np.asarray(pivot_ras_mm, dtype=float)
    normals = np.asarray(normals, dtype=float)
    rows: Array = np.concatenate([np.cross(positions, normals), normals], axis=1)
    return rows


def rms_tre_mm(covariances: npt.ArrayLike, pivot_ras_mm: npt.ArrayLike, targets_ras_mm: npt.ArrayLike) -> Array:
    """(...) predicted TRE, root mean square over targets (T, 3), from motion covariances (..., 6, 6)."""
    arms = np.asarray(targets_ras_mm, dtype=float) - np.asarray(pivot_ras_mm, dtype=float)
    jacobians = np.zeros((len(arms), 3, 6))  # of r -> w x r + t
    jacobians[:, 0, 1], jacobians[:, 0, 2] = arms[:, 2], -arms[:, 1]
    jacobians[:, 1, 0], jacobians[:, 1, 2] = -arms[:, 2], arms[:, 0]
    jacobians[:, 2, 0], jacobians[:, 2, 1] = arms[:, 1], -arms[:, 0]
    jacobians[:, :, 3:] = np.eye(3)
    weight = np.einsum("tij,tik->jk", jacobians, jacobians) / len(arms)
    squared = np.einsum("...ij,ji->...", np.asarray(covariances, dtype=float), weight)
    rms: Array = np.sqrt(np.maximum(squared, 0.0))
    return rms


def covariance_with(
    covariance: npt.ArrayLike, position_ras_mm: npt.ArrayLike, normal: npt.ArrayLike, pivot_ras_mm: npt.ArrayLike, sd_mm: float
) -> Array:
    """A motion's covariance (6, 6) after one more point: C - C r r' C / (s^2 + r' C r), r its row of `motion_rows`."""
    covariance = np.asarray(covariance, dtype=float)
    row = motion_rows(np.asarray(position_ras_mm)[None], np.asarray(normal)[None], pivot_ras_mm)[0]
    gain = covariance @ row
    after: Array = covariance - np.outer(gain, gain) / (sd_mm**2 + row @ gain)
    return after


def choose_next(
    points: ProtocolPoints,
    open_points: npt.ArrayLike,
    covariance: npt.ArrayLike,
    pivot_ras_mm: npt.ArrayLike,
    targets_ras_mm: npt.ArrayLike,
    point_sd_mm: float = 0.6,
) -> Optional[NextTarget]:
    """The open point of the protocol that shrinks the predicted TRE most.

    Parameters
    ----------
    points : ProtocolPoints
    open_points : array-like of bool, shape (N,)
        Neither taken nor out of reach.
    covariance : array-like, shape (6, 6)
        Of the registration in force: rotation (rad) about the pivot, translation (mm), RAS axes.
    pivot_ras_mm : array-like, shape (3,)
    targets_ras_mm : array-like, shape (T, 3)
        Where accuracy is wanted.
    point_sd_mm : float
        Expected error of a point along the bone's normal.

    Returns
    -------
    NextTarget, or None when no point is open.

    Notes
    -----
    A distance measured along a normal is one linear equation for the motion: the covariance after it is
    C - C r r' C / (s^2 + r' C r) with the row r of `motion_rows`.

    Raises
    ------
    InputError
        A covariance that is none, or no targets.
    """
    covariance = np.asarray(covariance, dtype=float)
    if covariance.shape != (6, 6) or not np.isfinite(covariance).all() or np.linalg.eigvalsh(covariance).min() < -1e-9:
        raise InputError("expected the registration's covariance as a finite positive 6x6 matrix; register the landmarks first")
    targets = check_points(targets_ras_mm, "targets", at_least=1)
    candidates = np.flatnonzero(np.asarray(open_points, dtype=bool))
    if len(candidates) == 0:
        return None
    rows = motion_rows(points.positions_ras_mm, points.normals, pivot_ras_mm)[candidates]
    gains = rows @ covariance  # (K, 6)
    shrunk = gains[:, :, None] * gains[:, None, :] / (point_sd_mm**2 + np.sum(gains * rows, axis=1))[:, None, None]
    after = rms_tre_mm(covariance - shrunk, pivot_ras_mm, targets)
    best = int(np.argmin(after))
    index = int(candidates[best])
    now = float(rms_tre_mm(covariance, pivot_ras_mm, targets))
    return NextTarget(index, points.labels[index], now, float(after[best]))


def reachable(
    points: ProtocolPoints,
    clamp_ras_mm: Optional[npt.ArrayLike] = None,
    table_direction_ras: Optional[npt.ArrayLike] = None,
    settings: Optional[GuidanceSettings] = None,
) -> npt.NDArray[np.bool_]:
    """(N,) whether a probe can stand at each point, clear of the clamp and of the table.

    Parameters
    ----------
    points : ProtocolPoints
    clamp_ras_mm : array-like, shape (K, 3), optional
        Points on the head clamp (pins, arms), touched with the stylus or known.
    table_direction_ras : array-like, shape (3,), optional
        From the head towards the table; (0, -1, 0) for a patient lying on the back.
    settings : GuidanceSettings, optional
    """
    settings = settings or DEFAULTS
    free = np.ones(len(points), dtype=bool)
    if clamp_ras_mm is not None:
        clamp = check_points(clamp_ras_mm, "points on the clamp")
        for index, (foot, normal) in enumerate(zip(points.positions_ras_mm, points.normals)):
            along = np.clip((clamp - foot) @ normal, 0.0, PROBE_LENGTH_MM)
            gaps = np.linalg.norm(clamp - foot - along[:, None] * normal, axis=1)
            free[index] = len(gaps) == 0 or gaps.min() >= settings.clamp_clearance_mm
    if table_direction_ras is not None:
        down = np.asarray(table_direction_ras, dtype=float)
        free &= points.normals @ (down / np.linalg.norm(down)) < np.cos(np.radians(settings.support_angle_deg))
    return free


# -- how the probe stands to it


@dataclass(frozen=True)
class Cue:
    """What to sound: short tones at a rate and pitch, one long tone when the probe is square to the bone."""

    rate_hz: float  # 0: a continuous tone
    pitch_hz: float


@dataclass(frozen=True, eq=False)
class Guide:
    """Where the probe stands to the target, for the read-outs of a panel."""

    distance_mm: float  # from the target to the line of the beam
    angle_deg: float  # between the beam and the bone's normal
    angle_sd_deg: float  # how well the normal is known under the registration; NaN: not known
    bulls_eye_deg: tuple[float, float]  # the probe's back end off the normal: to the right and up, seen from outside
    normal_ras: Array  # (3,) of the bone under the beam, outward
    on_target: bool
    aligned: bool
    instruction: str
    cue: Cue


def bone_normal(surface: Surface, origin_ras_mm: Array, beam_ras: Array, fallback: Array) -> Array:
    """Outward unit normal (3,) of the bone that a beam sees: the plane through 13 rays over its width.

    Where the beam misses the bone, `fallback`.
    """
    across = np.cross(beam_ras, [0.0, 0.0, 1.0] if abs(beam_ras[2]) < 0.9 else [1.0, 0.0, 0.0])
    across /= np.linalg.norm(across)
    up = np.cross(beam_ras, across)
    angles = np.arange(12) * np.pi / 6
    radii = np.where(np.arange(12) % 2, BEAM_RADIUS_MM, BEAM_RADIUS_MM / 2)
    offsets = np.concatenate([[[0.0, 0.0]], radii[:, None] * np.column_stack([np.cos(angles), np.sin(angles)])])
    feet = origin_ras_mm + offsets[:, :1] * across + offsets[:, 1:] * up
    depths = surface.cast(feet, np.broadcast_to(beam_ras, feet.shape)).distances_mm
    seen = (
        np.isfinite(depths) & (np.abs(depths - np.median(depths[np.isfinite(depths)])) < 5.0) if np.isfinite(depths).any() else []
    )
    if np.sum(seen) < 6:
        return fallback
    design = np.column_stack([offsets, np.ones(len(offsets))])[seen]
    slopes = np.linalg.lstsq(design, depths[seen], rcond=None)[0]
    normal: Array = slopes[0] * across + slopes[1] * up - beam_ras
    return normal / float(np.linalg.norm(normal))


def guide(
    probe_to_ras: npt.ArrayLike,
    surface: Surface,
    target_ras_mm: npt.ArrayLike,
    target_normal: npt.ArrayLike,
    rotation_covariance: Optional[npt.ArrayLike] = None,
    settings: Optional[GuidanceSettings] = None,
) -> Guide:
    """How a probe stands to a target, and what to do.

    Parameters
    ----------
    probe_to_ras : array-like, shape (4, 4)
        `reference_to_ras @ probe_to_reference` under the registration in force.
    surface : Surface
        The bone model, RAS.
    target_ras_mm, target_normal : array-like, shape (3,)
        The point of the protocol and its normal, used while the beam is off the bone or far away.
    rotation_covariance : array-like, shape (3, 3), optional
        Of the registration's rotation (rad^2), to say how well the normal is known.
    settings : GuidanceSettings, optional
    """
    settings = settings or DEFAULTS
    pose = np.asarray(probe_to_ras, dtype=float)
    origin, beam = pose[:3, 3], pose[:3, 2]
    target, normal = np.asarray(target_ras_mm, dtype=float), np.asarray(target_normal, dtype=float)
    off = target - origin - ((target - origin) @ beam) * beam
    distance = float(np.linalg.norm(off))
    if distance < 3 * settings.near_mm:
        normal = bone_normal(surface, origin, beam, fallback=normal)
    lean = -beam - normal  # of the probe's back end off the normal
    angle = float(np.degrees(2 * np.arcsin(min(1.0, float(np.linalg.norm(lean)) / 2))))
    right, up = screen_axes(normal)
    scale = angle / max(float(np.hypot(lean @ right, lean @ up)), 1e-12)
    on_target, aligned = distance <= settings.near_mm, angle <= settings.aligned_deg
    return Guide(
        distance_mm=distance,
        angle_deg=angle,
        angle_sd_deg=_angle_sd_deg(rotation_covariance, normal),
        bulls_eye_deg=(float(scale * (lean @ right)), float(scale * (lean @ up))),
        normal_ras=normal,
        on_target=on_target,
        aligned=aligned,
        instruction=_instruction(off, distance, lean, angle, on_target, aligned),
        cue=cue(angle, settings.aligned_deg),
    )


def screen_axes(normal: npt.ArrayLike) -> tuple[Array, Array]:
    """Right and up (3,) of a bull's-eye for somebody who looks at the head from outside, straight at a point.

    Up is towards the crown; on the crown itself, towards the face.
    """
    normal = np.asarray(normal, dtype=float)
    towards = np.array([0.0, 0.0, 1.0]) if abs(normal[2]) < 0.9 else np.array([0.0, 1.0, 0.0])
    up: Array = towards - (towards @ normal) * normal
    up /= float(np.linalg.norm(up))
    right: Array = np.asarray(np.cross(up, normal), dtype=float)
    return right, up


def cue(angle_deg: float, aligned_deg: float = 2.0) -> Cue:
    """Tones that quicken from 2 to 12 a second and rise by an octave and a half from 20 degrees to square."""
    if angle_deg <= aligned_deg:
        return Cue(0.0, 880.0)
    share = float(np.clip((20.0 - angle_deg) / (20.0 - aligned_deg), 0.0, 1.0))
    return Cue(2.0 + 10.0 * share**2, 311.0 * 2.0 ** (1.5 * share))


DIRECTIONS = (("the patient's right", "the patient's left"), ("the face", "the back of the head"), ("the crown", "the chin"))


def direction_in_words(vector_ras: npt.ArrayLike) -> str:
    """A direction along the head in words: its largest anatomical component, and the second if it counts."""
    vector = np.asarray(vector_ras, dtype=float)
    length = float(np.linalg.norm(vector))
    order = np.argsort(-np.abs(vector))
    words = [DIRECTIONS[axis][0 if vector[axis] > 0 else 1] for axis in order[:2] if abs(vector[axis]) > 0.38 * length]
    return " and ".join(words)


def _instruction(off: Array, distance: float, lean: Array, angle: float, on_target: bool, aligned: bool) -> str:
    if not on_target:
        return f"move {distance:.0f} mm towards {direction_in_words(off)}"
    if not aligned:
        return f"tilt the probe's back end {angle:.0f}° towards {direction_in_words(-lean)}"
    return "hold still"


def _angle_sd_deg(rotation_covariance: Optional[npt.ArrayLike], normal: Array) -> float:
    """RMS angle by which the registration's rotation turns a normal: turns about the normal itself do not count."""
    if rotation_covariance is None:
        return float("nan")
    covariance = np.asarray(rotation_covariance, dtype=float)
    return float(np.degrees(np.sqrt(max(0.0, float(np.trace(covariance) - normal @ covariance @ normal)))))
