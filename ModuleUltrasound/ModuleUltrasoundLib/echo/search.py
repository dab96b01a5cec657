"""All lines of a recording searched for echoes, batch by batch."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, Optional

import numpy as np
import numpy.typing as npt
from CranioNavLib.errors import InputError
from CranioNavLib.rigid import Array
from CranioNavLib.sequence_metafile import Acquisition, Recording

from ModuleUltrasoundLib.echo.candidates import Candidates, concatenate, find_candidates, reorder, rough_noise
from ModuleUltrasoundLib.echo.features import line_features
from ModuleUltrasoundLib.echo.forerun import Forerun, find_forerun, nominal_skin_s, steady, suppress_multiples
from ModuleUltrasoundLib.echo.lean import at_samples, clip, median, pick, without_nan
from ModuleUltrasoundLib.echo.signal_chain import Band, Envelopes, check_acquisition, design_band, envelopes_of
from ModuleUltrasoundLib.echo.static_echoes import believed, common_pattern, likeness
from ModuleUltrasoundLib.echo.timing import BEFORE, BEHIND, Complexes

BANG_SAMPLES = 40  # ten cycles
KEPT = 3  # candidates of a line whose echo is kept sample by sample
CHUNK = 512  # lines worked on at once: enough to spread the cost of a step, few enough for the processor's last cache
SEEN_MM = (0.4, 4.0)  # beyond the least and the most depth of bone: echoes there are no bone, and tell of what is
BEHIND_S = 4e-6  # of a line kept behind the deepest bone: what follows an echo speaks for or against it


@dataclass(frozen=True, eq=False)
class Found:
    """The echoes of n lines and what each says by itself."""

    candidates: Candidates
    forerun: Forerun
    forerun_phases: Array  # (n,) rad; 0 where no forerun echo was found
    features: Array  # (n, K, D)
    scores: Array  # (n, K) of `rank`; 0 without it, and where bone is not looked for
    depths_mm: Array  # (n, K) at the speed of sound given
    possible: npt.NDArray[np.bool_]  # (n, K) where bone is looked for
    windows: Complexes  # (n, KEPT, W) complex envelope around the first candidates, for the time of flight
    bang: npt.NDArray[np.complex128]  # mean complex envelope of the lines' first samples
    rate_hz: float
    carrier_hz: float

    def part(self, first: int, last: int) -> Found:
        """Lines [first, last) alone."""
        rows = slice(first, last)
        return replace(
            self,
            candidates=Candidates(**{name: getattr(self.candidates, name)[rows] for name in Candidates.__dataclass_fields__}),
            forerun=Forerun(**{name: getattr(self.forerun, name)[rows] for name in Forerun.__dataclass_fields__}),
            forerun_phases=self.forerun_phases[rows],
            features=self.features[rows],
            scores=self.scores[rows],
            depths_mm=self.depths_mm[rows],
            possible=self.possible[rows],
            windows=self.windows[rows],
        )


def check_length(recording: Recording, speed_m_s: float, least_depth_mm: float) -> None:
    """Refuse a recording whose lines end before any bone could be seen.

    Raises
    ------
    InputError
        The lines are shorter than the forerun and the least depth, or the header's numbers make them so.
    """
    needed_s = nominal_skin_s(recording.acquisition) + least_depth_mm / (500.0 * speed_m_s)
    covered_s = recording.lines.shape[1] / recording.acquisition.sampling_hz
    if len(recording) and 0 < covered_s <= needed_s:
        raise InputError(
            f"the lines end after {1e6 * covered_s:.3g} us, before bone can be seen ({1e6 * needed_s:.3g} us with the forerun);"
            " record longer lines, or correct SamplingFrequencyHz or ForerunLengthMm"
        )


Rank = Callable[[Array], Array]  # features (m, D) of the candidates that may be bone -> scores (m,)


@dataclass(frozen=True, eq=False)
class Search:
    """What to look for, and where."""

    acquisition: Acquisition
    speed_m_s: float
    bone_s: tuple[float, float]  # (least, most) behind the skin where bone is looked for
    window_s: tuple[float, float]  # the same where echoes are
    band: Band
    rank: Optional[Rank]

    def possible(self, delays_s: Array) -> npt.NDArray[np.bool_]:
        """Whether echoes at these delays may be bone; not where there is no echo."""
        return np.asarray((delays_s >= self.bone_s[0]) & (delays_s <= self.bone_s[1]))


def search_lines(
    recording: Recording,
    speed_m_s: float,
    depth_mm: tuple[float, float],
    places: npt.NDArray[np.int64] | None,
    rank: Rank | None = None,
) -> Found:
    """The candidates of every line with their features, in the order of `rank` (else of salience).

    `depth_mm` (least, most) is where bone is looked for. `places` (n,) numbers the places on the head that the lines come
    from, so that what repeats in all of them is an artefact; None: all come from one.

    Raises
    ------
    InputError
        The recording's header cannot be that of pulse-echo lines, or it holds poses only.
    """
    acquisition = recording.acquisition
    check_acquisition(acquisition)
    if len(recording) and not recording.lines.shape[1]:
        raise InputError("the recording holds no RF samples, only poses; record the A-lines with them (DimSize = N 1 F)")
    per_s = 500.0 * speed_m_s  # mm of depth a second of delay
    bone = (depth_mm[0] / per_s, depth_mm[1] / per_s)
    window = (max(depth_mm[0] - SEEN_MM[0], 0.0) / per_s, (depth_mm[1] + SEEN_MM[1]) / per_s)
    band = design_band(acquisition, recording.lines.shape[1], nominal_skin_s(acquisition) * 1.04 + window[1] + BEHIND_S)
    search = Search(acquisition, speed_m_s, bone, window, band, rank)
    batches = max(-(-len(recording) // CHUNK), 1)
    parts = np.array_split(recording.lines, batches) if batches > 1 else [recording.lines]
    of_parts = [None] * batches if places is None else np.array_split(places, batches)
    found = [_search_batch(lines, of_part, search) for lines, of_part in zip(parts, of_parts)]
    candidates = concatenate([part.candidates for part in found])
    forerun = Forerun(**{name: _joined([part.forerun for part in found], name) for name in Forerun.__dataclass_fields__})
    phases, calm = _joined(found, "forerun_phases"), steady(forerun)
    if calm is not forerun:
        earlier = forerun.skin_s - calm.skin_s
        candidates = replace(candidates, delays_s=candidates.delays_s + earlier[:, None])
        phases = phases - np.where(calm.found, 2 * np.pi * band.carrier_hz * earlier, 0.0)
    bang = np.sum([part.bang for part in found], axis=0) / max(len(recording), 1)
    return Found(
        candidates,
        calm,
        phases,
        _joined(found, "features"),
        _joined(found, "scores"),
        candidates.delays_s * per_s,
        search.possible(candidates.delays_s),
        _joined(found, "windows"),
        np.asarray(bang, dtype=np.complex128),
        band.rate_hz,
        band.carrier_hz,
    )


def _joined(parts: Sequence[object], name: str) -> Any:
    """The arrays of this name in all parts, one behind the other."""
    arrays = [getattr(part, name) for part in parts]
    return arrays[0] if len(arrays) == 1 else np.concatenate(arrays)


def _search_batch(lines: npt.NDArray[np.int16], places: npt.NDArray[np.int64] | None, search: Search) -> Found:
    """The echoes of some lines; `bang` is the sum over them."""
    acquisition, rank = search.acquisition, search.rank
    envelopes, magnitude = envelopes_of(lines, search.band)
    bang = np.zeros(BANG_SAMPLES, dtype=np.complex128)
    start = envelopes.values[:, :BANG_SAMPLES].sum(axis=0)
    bang[: len(start)] = start
    skin = nominal_skin_s(acquisition)
    forerun = find_forerun(envelopes, magnitude, rough_noise(magnitude), acquisition)
    pattern = None
    if places is not None:
        if skin > 0:
            suppress_multiples(envelopes, magnitude, forerun, acquisition)
        late = forerun.skin_s - median(forerun.skin_s)
        pattern = common_pattern(envelopes, places, late, acquisition.transducer_hz)
    candidates = find_candidates(envelopes, magnitude, forerun.skin_s, search.window_s, acquisition.transducer_hz)
    if pattern is not None:
        at = np.rint(without_nan(candidates.delays_s + forerun.skin_s[:, None], -1.0) * envelopes.rate_hz).astype(np.int64)
        candidates = replace(candidates, static=believed(likeness(envelopes, pattern, at), candidates.amplitudes))
    features = line_features(candidates, forerun, skin, acquisition.transducer_hz, search.speed_m_s)
    scores = np.zeros(features.shape[:2])
    if rank is not None:
        possible = search.possible(candidates.delays_s)
        scores[possible] = rank(features[possible])
        order = np.argsort(-np.where(possible, scores, -np.inf), axis=1, kind="stable")
        candidates, scores, features = reorder(candidates, order), pick(scores, order), pick(features, order)
    return Found(
        candidates,
        forerun,
        _forerun_phases(envelopes, forerun),
        features,
        scores,
        candidates.delays_s * 500.0 * search.speed_m_s,
        search.possible(candidates.delays_s),
        _cut_windows(envelopes, candidates.delays_s[:, :KEPT] + forerun.skin_s[:, None]),
        bang,
        envelopes.rate_hz,
        envelopes.carrier_hz,
    )


def _forerun_phases(envelopes: Envelopes, forerun: Forerun) -> Array:
    """Phase of each line's forerun echo at its centre, rad; 0 where none was found."""
    at = np.rint(forerun.skin_s * envelopes.rate_hz).astype(np.int64)
    values = at_samples(envelopes.values, np.minimum(at, envelopes.values.shape[1] - 1))
    return np.where(forerun.found, np.angle(values) + 2 * np.pi * envelopes.carrier_hz * forerun.skin_s, 0.0)


def _cut_windows(envelopes: Envelopes, times_s: Array) -> Complexes:
    """Complex envelope (n, KEPT, W) around times (n, KEPT); beyond the line's ends its last sample repeats."""
    values = envelopes.values
    centre = np.rint(without_nan(times_s) * envelopes.rate_hz).astype(np.int64)
    index = clip(centre[..., None] + np.arange(-BEFORE, BEHIND + 1), 0, values.shape[1] - 1)
    index += np.arange(0, values.size, values.shape[1])[:, None, None]
    return np.asarray(values.reshape(-1).take(index))
