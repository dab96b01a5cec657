"""The quality gate: how probable it is that a depth is right to 0.5 mm, and why a frame is not a point."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import scipy
from CranioNavLib.rigid import Array
from CranioNavLib.sequence_metafile import Recording

Bools = npt.NDArray[np.bool_]

TOLERANCE_MM = 0.5  # what "right" means
GROUP_SHARE = 0.9  # groups nearly as likely as the likeliest one compete by their best echo
CLIPPED_SHARE = 0.15  # of an echo's samples at the converter's end: beyond, its shape is lost
QUIET_DB = 14.0  # the strongest of a line's candidates is below this over the noise: nothing is seen in it
STRONG_FORERUN_DB = 5.0  # over the recording's median: nothing takes sound out of the forerun
TILTED_DB = 9.0  # a bone echo weaker than this under the recording's others: a tilt of several degrees
LIKELY = 0.3
UNSTABLE_MM = 1.0  # off the neighbours' median along the beam, while the probe rests
STILL_MM = 2.0  # the probe rests: its origin moved less than this over the neighbours
REACH = 5  # neighbours on each side
LEAST_NEIGHBOURS = 4
AGREEING = 0.7  # of the neighbours are near their median: otherwise they tell nothing of this frame


def choose(depth_mm: Array, chance: Array) -> npt.NDArray[np.int64]:
    """The candidate (n,) to take for the bone: the likeliest of the group, no wider than the tolerance, that is likeliest.

    A rough bone under a tilted beam, or the end of the tissue's speckle at it, shows as several echoes side by side.
    """
    near = np.abs(depth_mm[:, :, None] - depth_mm[:, None, :]) < TOLERANCE_MM
    together = (near * chance[:, None, :]).sum(axis=2)
    best = together.max(axis=1, keepdims=True, initial=0.0)
    return np.asarray(np.where(together > GROUP_SHARE * best, chance, -1.0).argmax(axis=1), dtype=np.int64)


def quality_of(depth_mm: Array, best: npt.NDArray[np.int64], chance: Array, depth_sd_mm: Array) -> Array:
    """Probability (n,) that the chosen depth is within 0.5 mm: the right echo, and timed well enough.

    Candidates nearer than the tolerance to the chosen one would give a right depth as well: their probability counts.
    """
    chosen = depth_mm[np.arange(len(best)), best]
    same = np.abs(depth_mm - chosen[:, None]) < TOLERANCE_MM
    timed = scipy.special.erf(TOLERANCE_MM / np.sqrt(2) / np.maximum(np.nan_to_num(depth_sd_mm, nan=1.0), 1e-6))
    return np.where(np.isfinite(chosen), np.where(same, chance, 0.0).sum(axis=1) * timed, 0.0)


def converter_limits(lines: npt.NDArray[np.int16]) -> tuple[int, int]:
    """Lowest and highest code if these are ends of a converter's range (a power of two), else values that never occur."""
    low, high = int(lines.min(initial=0)), int(lines.max(initial=0))
    ends = {2**bits - 1 for bits in range(7, 16)} | {32767}
    starts = {-(2**bits) for bits in range(7, 16)} | {-(2**bits) + 1 for bits in range(7, 16)} | {0}
    return (low if low in starts and low != high else -40000), (high if high in ends else 40000)


def clipped_share(recording: Recording, times_s: Array) -> Array:
    """Share (n,) of the samples of the echo at `times_s` (one cycle on each side) that stand at the converter's ends."""
    low, high = converter_limits(recording.lines)
    acquisition, samples = recording.acquisition, recording.lines.shape[1]
    if (low < -32768 and high > 32767) or samples == 0:
        return np.zeros(len(times_s))
    half = max(int(acquisition.sampling_hz / acquisition.transducer_hz), 1)
    centre = np.rint(np.nan_to_num(times_s) * acquisition.sampling_hz).astype(np.int64)
    index = np.clip(centre[:, None] + np.arange(-half, half + 1), 0, samples - 1)
    codes = np.take_along_axis(recording.lines, index, axis=1)
    return np.where(np.isfinite(times_s), ((codes <= low) | (codes >= high)).mean(axis=1), 0.0)


def unstable(recording: Recording, depth_mm: Array, good: Bools, runs: npt.NDArray[np.int64]) -> Bools:
    """Frames (n,) whose depth leaves the one that the neighbours share while the probe rests.

    Neighbours that do not agree with each other are not looked at: then the probe moves, whatever its pose says.
    """
    count = len(depth_mm)
    steps = [step for step in range(-REACH, REACH + 1) if step]
    other = np.arange(count)[:, None] + np.array(steps)
    inside = (other >= 0) & (other < count)
    other = np.clip(other, 0, count - 1)
    origin = recording.probe_to_reference[:, :3, 3]
    moved = np.linalg.norm(origin[other] - origin[:, None], axis=2)
    use = inside & good[other] & (runs[other] == runs[:, None]) & (np.nan_to_num(moved, nan=np.inf) < STILL_MM)
    # the probe's own way along the beam is no change of the bone
    along = np.einsum("nkj,nj->nk", origin[other] - origin[:, None], recording.probe_to_reference[:, :3, 2])
    ahead = np.where(use, depth_mm[other] + along - depth_mm[:, None], np.nan)
    enough = use.sum(axis=1) >= LEAST_NEIGHBOURS
    middle = np.zeros(count)
    middle[enough] = np.nanmedian(ahead[enough], axis=1)
    near = (np.abs(ahead - middle[:, None]) < UNSTABLE_MM).sum(axis=1)  # not a number compares as false
    return np.asarray(good & enough & (near >= AGREEING * use.sum(axis=1)) & (np.abs(middle) > UNSTABLE_MM))


def reasons_of(
    recording: Recording,
    quality: Array,
    gate: float,
    clipped: Bools,
    shaky: Bools,
    depth_mm: Array,
    line_snr_db: Array,
    strength_db: Array,
    forerun_db: Array,
    likely: Array,
) -> tuple[str, ...]:
    """Why each frame is not a point; empty for those that are. The first that applies of the list below."""
    statuses = np.array(recording.statuses)
    has_pose = np.isfinite(recording.probe_to_reference).all(axis=(1, 2))
    good = quality >= gate
    quiet = line_snr_db < QUIET_DB
    cases: list[tuple[str, Bools]] = [
        ("pose missing", (statuses == "MISSING") | ((statuses == "OK") & ~has_pose)),
        ("pose out of view", np.isin(statuses, ("OUT_OF_VIEW", "OUT_OF_VOLUME"))),
        ("pose invalid", statuses != "OK"),
        ("saturated", clipped),
        ("unstable", shaky),
        ("", good),
        ("no contact", forerun_db > STRONG_FORERUN_DB),
        ("tilt too large", (likely > LIKELY) & (strength_db < -TILTED_DB)),
        ("no echo", ~np.isfinite(depth_mm) | quiet | (likely < LIKELY)),
        ("doubtful echo", ~good),
    ]
    chosen = np.select([case for _, case in cases], list(range(len(cases))), default=len(cases) - 1)
    return tuple(cases[index][0] for index in chosen.tolist())


CURES = {  # of the reasons that `reasons_of` gives
    "pose missing": "show the probe to the camera",
    "pose out of view": "show the probe's markers to the camera",
    "pose invalid": "hold the probe so that all its markers are seen",
    "saturated": "turn the gain down",
    "unstable": "hold the probe still",
    "no contact": "add gel, press a little",
    "tilt too large": "turn the probe square to the bone",
    "no echo": "press a little, add gel, tilt",
    "doubtful echo": "tilt slowly until it is strongest",
}


def reason_in_words(reason: str) -> str:
    """Why a line is no point, and what the hand can do about it."""
    return f"{reason}: {CURES[reason]}" if reason in CURES else reason
