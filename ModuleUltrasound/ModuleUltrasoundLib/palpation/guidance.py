"""Leading the hand: how far the probe is from the point, and how to tilt it square to the bone.

Everything here works from the landmark registration alone and gets better with it: positions and normals come
from the bone model under the registration in force, and so does what is said of their uncertainty.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Optional

import numpy as np
import numpy.typing as npt
from CranioNavLib.parameters import Limits, Parameters
from CranioNavLib.rigid import Array
from CranioNavLib.surface import Surface

BEAM_RADIUS_MM = 2.5  # half of a 5 mm element: the bone that a beam sees


@dataclass(frozen=True)
class GuidanceSettings(Parameters):
    """When the probe is there, and when it is square to the bone."""

    near_mm: Annotated[float, Limits(0.5, 50), "the beam passes this near the target: on target"] = 5.0
    aligned_deg: Annotated[float, Limits(0.2, 20), "the beam is square to the bone to this angle"] = 2.0


DEFAULTS = GuidanceSettings()


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
