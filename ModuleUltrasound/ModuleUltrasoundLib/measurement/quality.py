"""The quality gate: how probable it is that a depth is right to 0.5 mm, and why a frame is not a point."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import scipy
from CranioNavLib.rigid import Array
from CranioNavLib.sequence_metafile import Recording

from ModuleUltrasoundLib.echo.features import REPEATED
from ModuleUltrasoundLib.echo.lean import clip, median, pick, without_nan

Bools = npt.NDArray[np.bool_]

TOLERANCE_MM = 0.5  # what "right" means
GROUP_SHARE = 0.9  # groups nearly as likely as the likeliest one compete by their best echo
CLIPPED_SHARE = 0.4  # of an echo's samples at the converter's end: beyond, its shape is lost
QUIET_DB = 14.0  # the strongest of a line's candidates is below this over the noise: nothing is seen in it
STRONG_FORERUN_DB = 5.0  # over the recording's median: nothing takes sound out of the forerun
# The forerun's face sends all back in air, and 0.05 to 0.3 of it with skin and gel behind: 10 to 26 dB less
IN_AIR_DB = 12.0  # of the face's echo over that of the lines that see bone
LIFTED_DB = 4.0  # the same, where the echo lies where the face's echo would repeat
LEAST_IN_CONTACT, HARDLY = 3, 0.2  # lines, and share of the good ones
TILTED_DB = 9.0  # a bone echo weaker than this under the recording's others: a tilt of several degrees
FAINT_DB = 13.0  # weaker than this it is no point, however sure: a layer that does not fade may have been followed instead
LIKELY = 0.3
UNSTABLE_MM = 1.0  # off the neighbours' median along the beam, while the probe rests
STILL_MM = 2.0  # the probe rests: its origin moved less than this over the neighbours
REACH = 5  # neighbours on each side
LEAST_NEIGHBOURS = 4
BLOCK = 32  # lines looked at together
AGREEING = 0.7  # of the neighbours are near their median: otherwise they tell nothing of this frame


def choose(depth_mm: Array, chance: Array) -> npt.NDArray[np.int64]:
    """The candidate (n,) to take for the bone: the likeliest of the group, no wider than the tolerance, that is likeliest.

    A rough bone under a tilted beam, or the end of the tissue's speckle at it, shows as several echoes side by side.
    """
    depth, share = np.ascontiguousarray(depth_mm.T), np.ascontiguousarray(chance.T)  # the lines last: long inner loops
    together = ((np.abs(depth[:, None] - depth) < TOLERANCE_MM) * share).sum(axis=1)
    best = together.max(axis=0, initial=0.0)
    return np.asarray(np.where(together > GROUP_SHARE * best, share, -1.0).argmax(axis=0), dtype=np.int64)


def quality_of(depth_mm: Array, best: npt.NDArray[np.int64], chance: Array, depth_sd_mm: Array) -> Array:
    """Probability (n,) that the chosen depth is within 0.5 mm: the right echo, and timed well enough.

    Candidates nearer than the tolerance to the chosen one would give a right depth as well: their probability counts.
    """
    chosen = depth_mm[np.arange(len(best)), best]
    same = np.abs(depth_mm - chosen[:, None]) < TOLERANCE_MM
    timed = scipy.special.erf(TOLERANCE_MM / np.sqrt(2) / np.maximum(without_nan(depth_sd_mm, 1.0), 1e-6))
    return np.where(np.isfinite(chosen), np.where(same, chance, 0.0).sum(axis=1) * timed, 0.0)


def converter_limits(lines: npt.NDArray[np.int16]) -> tuple[int, int]:
    """Lowest and highest code if these are ends of a converter's range (a power of two), else values that never occur."""
    # block by block: the second look finds the lines in the processor's cache
    blocks = [lines[start : start + BLOCK] for start in range(0, len(lines), BLOCK)]
    ends_of = [(int(block.min(initial=0)), int(block.max(initial=0))) for block in blocks]
    low, high = min((end[0] for end in ends_of), default=0), max((end[1] for end in ends_of), default=0)
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
    centre = np.rint(without_nan(times_s) * acquisition.sampling_hz).astype(np.int64)
    codes = pick(recording.lines, clip(centre[:, None] + np.arange(-half, half + 1), 0, samples - 1))
    return np.where(np.isfinite(times_s), ((codes <= low) | (codes >= high)).mean(axis=1), 0.0)


def unstable(recording: Recording, depth_mm: Array, good: Bools, runs: npt.NDArray[np.int64]) -> Bools:
    """Frames (n,) whose depth leaves the one that the neighbours share while the probe rests.

    Neighbours that do not agree with each other are not looked at: then the probe moves, whatever its pose says.
    """
    count = len(depth_mm)
    if count <= LEAST_NEIGHBOURS:
        return np.zeros(count, dtype=bool)
    steps = np.array([step for step in range(-REACH, REACH + 1) if step])[:, None]
    other = np.arange(count) + steps  # (2 REACH, n)
    inside = (other >= 0) & (other < count)
    other = clip(other, 0, count - 1)
    origin, beam = np.ascontiguousarray(recording.probe_to_reference[:, :3, 2:].transpose(2, 1, 0))[::-1]
    way = origin[:, other] - origin[:, None]  # (3, 2 REACH, n)
    use = inside & good[other] & (runs[other] == runs) & ((way**2).sum(axis=0) < STILL_MM**2)
    # the probe's own way along the beam is no change of the bone
    ahead = np.where(use, depth_mm[other] + (way * beam[:, None]).sum(axis=0) - depth_mm, np.nan)
    found = use.sum(axis=0)
    enough = found >= LEAST_NEIGHBOURS
    ordered, rows = np.sort(ahead.T, axis=1), np.arange(count)  # what is not a number comes last
    last = np.maximum(found - 1, 0)
    middle = np.where(enough, (ordered[rows, last // 2] + ordered[rows, (last + 1) // 2]) / 2, 0.0)
    near = (np.abs(ahead - middle) < UNSTABLE_MM).sum(axis=0)  # not a number compares as false
    return np.asarray(good & enough & (near >= AGREEING * found) & (np.abs(middle) > UNSTABLE_MM))


def lost_contact(face: Array, multiple: Array, good: Bools) -> Bools:
    """Frames (n,) whose forerun ends in air: its face's echo (`face`, level) is far above that of the frames that see bone.

    No sound gets into the head then, and an echo is the face's own, once more: `multiple` (n,) says how well the chosen echo
    lies where that would be. The rule needs no forerun echo in contact, where a well matched forerun shows none. A recording
    in which bone would be seen nowhere else than where the face's echo repeats has not been in contact.
    """
    known = good & (multiple < REPEATED) & (face > 0)
    if known.sum() < max(LEAST_IN_CONTACT, HARDLY * good.sum()):  # nothing shows that sound gets into the head at all
        return good & (multiple > REPEATED)
    over_db = 20 * np.log10(np.maximum(face, 1e-9) / median(face[known]))
    return np.asarray((over_db > IN_AIR_DB) | ((over_db > LIFTED_DB) & (multiple > REPEATED)))


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
    lifted: Bools,
) -> tuple[str, ...]:
    """Why each frame is not a point; empty for those that are. The first that applies of the list below."""
    status = {one: np.array([other == one for other in recording.statuses], dtype=bool) for one in set(recording.statuses)}
    none = np.zeros(len(quality), dtype=bool)
    fine = status.get("OK", none)
    has_pose = np.isfinite(recording.probe_to_reference).all(axis=(1, 2))
    good = quality >= gate
    quiet = line_snr_db < QUIET_DB
    cases: list[tuple[str, Bools]] = [
        ("pose missing", status.get("MISSING", none) | (fine & ~has_pose)),
        ("pose out of view", status.get("OUT_OF_VIEW", none) | status.get("OUT_OF_VOLUME", none)),
        ("pose invalid", ~fine),
        ("no contact", lifted),
        ("saturated", clipped),
        ("unstable", shaky),
        ("tilt too large", good & (strength_db < -FAINT_DB)),
        ("", good),
        ("no contact", forerun_db > STRONG_FORERUN_DB),
        ("tilt too large", (likely > LIKELY) & (strength_db < -TILTED_DB)),
        ("no echo", ~np.isfinite(depth_mm) | quiet | (likely < LIKELY)),
        ("doubtful echo", ~good),
    ]
    chosen = np.full(len(quality), len(cases) - 1)
    for index in range(len(cases) - 1, -1, -1):
        chosen[cases[index][1]] = index
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
