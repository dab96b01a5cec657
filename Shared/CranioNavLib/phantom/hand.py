"""The hand that holds the probe: where it comes down, how it is tilted, how it trembles and presses."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Optional

import numpy as np
import numpy.typing as npt
import scipy

from CranioNavLib.phantom import constants
from CranioNavLib.phantom.beam import look_at_bone
from CranioNavLib.phantom.patient import VirtualPatient
from CranioNavLib.rigid import Array, check_points, rigid

LOOK_FROM_MM = 25.0  # above the bone, from where it is looked at
THINNEST_SCALP_MM = 1.0


@dataclass(frozen=True)
class Skill:
    """How steady and exact a hand is. The defaults are those of constants.py."""

    aim_sd_mm: float = constants.AIM_SD_MM
    tilt_sd_deg: float = constants.TILT_SD_DEG
    tremor_tilt_sd_deg: float = constants.TREMOR_TILT_SD_DEG
    tremor_position_sd_mm: float = constants.TREMOR_POSITION_SD_MM


@dataclass(frozen=True, eq=False)
class Stand:
    """Where and how the probe is meant to stand at each of N points, in RAS."""

    bone_points_mm: Array  # (N, 3) where the undisturbed beam meets the bone
    beams: Array  # (N, 3) unit, into the bone
    tissue_mm: Array  # (N,) scalp between the forerun and the bone, compressed


def frames_along(beams: npt.ArrayLike, origins_mm: npt.ArrayLike, roll_rad: Optional[Array] = None) -> Array:
    """Frames (N, 4, 4) at `origins_mm` with +z along `beams` (N, 3), turned about z by `roll_rad`."""
    z = np.asarray(beams, dtype=float)
    helper = np.where(np.abs(z[:, [2]]) < 0.9, [[0.0, 0.0, 1.0]], [[1.0, 0.0, 0.0]])
    x = np.cross(helper, z)
    x /= np.linalg.norm(x, axis=1, keepdims=True)
    frames = rigid(np.stack([x, np.cross(z, x), z], axis=2), np.asarray(origins_mm, dtype=float))
    if roll_rad is None:
        return frames
    turn = scipy.spatial.transform.Rotation.from_rotvec(np.column_stack([np.zeros((len(z), 2)), roll_rad])).as_matrix()
    rolled: Array = frames @ rigid(turn, np.zeros(3))
    return rolled


def bone_below(patient: VirtualPatient, positions_ras_mm: npt.ArrayLike, outward: npt.ArrayLike) -> tuple[Array, Array]:
    """True bone points (N, 3) and outward normals (N, 3) met from outside at planned places; NaN where there is none.

    The normal is that of the footprint which the beam covers: what guidance steers the probe to.
    """
    positions, outward = check_points(positions_ras_mm), np.asarray(outward, dtype=float)
    frames = frames_along(-outward, positions + LOOK_FROM_MM * outward)
    seen = look_at_bone(patient.bone, frames)
    points = frames[:, :3, 3] + frames[:, :3, 2] * seen.center_mm[:, None]
    return points, seen.normals


def stand_at(
    patient: VirtualPatient,
    positions_ras_mm: npt.ArrayLike,
    outward: npt.ArrayLike,
    rng: np.random.Generator,
    skill: Optional[Skill] = None,
) -> Stand:
    """The probe set down near planned places, guided to the bone's normal, with the user's errors.

    Where the drawn place holds no bone (a burr hole), the user goes back to the planned one, and where that has none
    either the probe stands as planned.
    """
    skill = skill or Skill()
    positions, outward = check_points(positions_ras_mm), np.asarray(outward, dtype=float)
    frames = frames_along(-outward, positions)
    shift = rng.normal(0.0, skill.aim_sd_mm, (len(positions), 2))
    aimed = positions + np.einsum("nij,nj->ni", frames[:, :3, :2], shift)
    points, normals = bone_below(patient, aimed, outward)
    for fallback in (bone_below(patient, positions, outward), (positions, outward)):
        lost = ~np.isfinite(points).all(axis=1) | ~np.isfinite(normals).all(axis=1)
        points[lost], normals[lost] = fallback[0][lost], fallback[1][lost]
    tilts = np.radians(rng.normal(0.0, skill.tilt_sd_deg, (len(positions), 2)))
    tilted = frames_along(-normals, points) @ rigid(
        scipy.spatial.transform.Rotation.from_rotvec(np.column_stack([tilts, np.zeros(len(tilts))])).as_matrix(), np.zeros(3)
    )
    beams = tilted[:, :3, 2]
    return Stand(points, beams, pressed_tissue(patient, points, beams, rng.uniform(*constants.COMPRESSION_RANGE, len(beams))))


def pressed_tissue(patient: VirtualPatient, bone_points_mm: Array, beams: Array, compression: Array) -> Array:
    """(N,) scalp along the beams from the skin to bone points, with a share (N,) of it pressed away."""
    reach = patient.skin.cast(bone_points_mm - 0.05 * beams, -beams).distances_mm + 0.05
    reach = np.where(np.isfinite(reach), reach, THINNEST_SCALP_MM)
    return np.asarray(np.maximum(reach * (1 - compression), THINNEST_SCALP_MM))


def slide_over(
    patient: VirtualPatient,
    positions_ras_mm: npt.ArrayLike,
    outward: npt.ArrayLike,
    lines: int,
    rng: np.random.Generator,
    tilt_sd_deg: float = constants.SWEEP_TILT_SD_DEG,
) -> Array:
    """True ProbeToRas (lines, 4, 4) while the probe slides over the skin from one planned place to the next.

    Nobody steers it to the bone's normal here: it stands roughly upright on the head, tilted by `tilt_sd_deg` an axis.
    """
    from scipy.special import ndtr

    positions, normals = check_points(positions_ras_mm, at_least=2), np.asarray(outward, dtype=float)
    lengths = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(positions, axis=0), axis=1))])
    along = np.linspace(0.0, lengths[-1], lines)
    chord = np.column_stack([np.interp(along, lengths, positions[:, axis]) for axis in range(3)])
    upright = np.column_stack([np.interp(along, lengths, normals[:, axis]) for axis in range(3)])
    upright /= np.linalg.norm(upright, axis=1, keepdims=True)
    points = bone_below(patient, chord, upright)[0]
    points = np.where(np.isfinite(points), points, chord)  # over a hole the hand goes on
    sway = tremor(rng, 1, lines, 3)[0]
    tilts = np.column_stack([np.radians(tilt_sd_deg) * sway[:, :2], np.zeros(lines)])
    frames = frames_along(-upright, points) @ rigid(scipy.spatial.transform.Rotation.from_rotvec(tilts).as_matrix(), np.zeros(3))
    low, high = constants.COMPRESSION_RANGE
    tissue = pressed_tissue(patient, points, frames[:, :3, 2], low + (high - low) * ndtr(sway[:, 2]))
    depth = np.zeros((lines, 3))
    depth[:, 2] = -(tissue + constants.FORERUN_LENGTH_MM)
    poses: Array = frames @ rigid(np.eye(3), depth)
    return poses


def hold(stand: Stand, lines: int, rng: np.random.Generator, skill: Optional[Skill] = None) -> Array:
    """True ProbeToRas (N, lines, 4, 4) while the probe is held at each of N points for some lines."""
    skill = skill or Skill()
    count = len(stand.tissue_mm)
    roll = rng.uniform(0, 2 * np.pi, count)
    contact = stand.bone_points_mm - stand.beams * stand.tissue_mm[:, None]
    base = frames_along(stand.beams, contact, roll)
    tilt = np.radians(skill.tremor_tilt_sd_deg) * tremor(rng, count, lines, 2)
    slide = skill.tremor_position_sd_mm * tremor(rng, count, lines, 3)
    slide[..., 2] *= 0.3  # the skin is pressed, and holds the probe along the beam better than across
    turn = scipy.spatial.transform.Rotation.from_rotvec(
        np.concatenate([tilt, np.zeros((count, lines, 1))], axis=2).reshape(-1, 3)
    ).as_matrix()
    moves = rigid(turn.reshape(count, lines, 3, 3), slide)
    back = rigid(np.eye(3), np.array([0.0, 0.0, -constants.FORERUN_LENGTH_MM]))  # contact -> transducer's face
    poses: Array = base[:, None] @ moves @ back
    return poses


def tremor(rng: np.random.Generator, count: int, lines: int, axes: int) -> Array:
    """(count, lines, axes) random motion of SD 1: slow sway and physiological tremor, in the time of the line rate."""
    from scipy.signal import lfilter

    total = np.zeros((count, lines, axes))
    for rate_hz, share in ((0.5, 0.8), (constants.TREMOR_HZ, 0.2)):
        keep = float(np.exp(-2 * np.pi * rate_hz / constants.LINE_RATE_HZ))
        drive = rng.normal(size=(count, lines, axes)) * np.sqrt(1 - keep**2)
        drive[:, 0] /= np.sqrt(1 - keep**2)  # begins in its stationary state
        total += np.sqrt(share) * lfilter([1.0], [1.0, -keep], drive, axis=1)
    return total
