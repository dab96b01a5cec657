"""All lines of a recording searched for echoes, batch by batch."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
from CranioNavLib.errors import InputError
from CranioNavLib.rigid import Array
from CranioNavLib.sequence_metafile import Recording

from ModuleUltrasoundLib.echo_candidates import Candidates, concatenate, find_candidates, reorder, rough_noise, take_levels
from ModuleUltrasoundLib.echo_features import line_features
from ModuleUltrasoundLib.echo_timing import BEFORE, BEHIND, Complexes
from ModuleUltrasoundLib.signal_chain import Envelopes, check_acquisition, complex_envelopes, design_band
from ModuleUltrasoundLib.signal_forerun import Forerun, find_forerun, nominal_skin_s, steady, suppress_multiples

BANG_SAMPLES = 40  # ten cycles
KEPT = 3  # candidates of a line whose echo is kept sample by sample
CHUNK = 512  # lines worked on at once: enough to spread the cost of a step, few enough for the processor's last cache
BEHIND_S = 4e-6  # of a line kept behind the deepest bone: what follows an echo speaks for or against it


@dataclass(frozen=True, eq=False)
class Found:
    """The echoes of n lines and what each says by itself."""

    candidates: Candidates
    forerun: Forerun
    forerun_phases: Array  # (n,) rad; 0 where no forerun echo was found
    features: Array  # (n, K, D)
    scores: Array  # (n, K) of `rank`; 0 without it
    depths_mm: Array  # (n, K) at the speed of sound given
    windows: Complexes  # (n, KEPT, W) complex envelope around the first candidates, for the time of flight
    bang: npt.NDArray[np.complex128]  # mean complex envelope of the lines' first samples
    rate_hz: float
    carrier_hz: float


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


Rank = Callable[[Array], Array]  # features (n, K, D) -> scores (n, K)


def search_lines(
    recording: Recording, speed_m_s: float, depth_mm: tuple[float, float], several_spots: bool, rank: Rank | None = None
) -> Found:
    """The candidates of every line with their features, in the order of `rank` (else of salience).

    `depth_mm` (least, most) is where bone is looked for. `several_spots`: the lines come from several places on the head,
    so that what repeats in all of them is an artefact, and can be subtracted.

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
    window = (depth_mm[0] / per_s, depth_mm[1] / per_s)
    skin = nominal_skin_s(acquisition)
    band = design_band(acquisition, recording.lines.shape[1], skin * 1.04 + window[1] + BEHIND_S)
    found: list[Candidates] = []
    foreruns: list[Forerun] = []
    phases: list[Array] = []
    features: list[Array] = []
    scores: list[Array] = []
    windows: list[Complexes] = []
    bang = np.zeros(BANG_SAMPLES, dtype=np.complex128)
    parts = max(-(-len(recording) // CHUNK), 1)
    for lines in np.array_split(recording.lines, parts):
        envelopes = complex_envelopes(lines, band)
        magnitude = np.abs(envelopes.values)
        start = envelopes.values[:, :BANG_SAMPLES].sum(axis=0)
        bang[: len(start)] += start
        forerun = find_forerun(envelopes, magnitude, rough_noise(magnitude), acquisition)
        if several_spots and skin > 0:
            suppress_multiples(envelopes, magnitude, forerun, acquisition)
        levels = take_levels(magnitude)
        candidates = find_candidates(envelopes, magnitude, levels, forerun.skin_s, window, acquisition.transducer_hz)
        feature = line_features(candidates, forerun, skin, acquisition.transducer_hz, speed_m_s)
        score = np.zeros(feature.shape[:2]) if rank is None else rank(feature)
        if rank is not None:
            order = np.argsort(-np.where(np.isfinite(candidates.delays_s), score, -np.inf), axis=1, kind="stable")
            candidates, score = reorder(candidates, order), np.take_along_axis(score, order, axis=1)
            feature = np.take_along_axis(feature, order[..., None], axis=1)
        scores.append(score)
        found.append(candidates)
        foreruns.append(forerun)
        phases.append(_forerun_phases(envelopes, forerun))
        features.append(feature)
        windows.append(_cut_windows(envelopes, candidates.delays_s[:, :KEPT] + forerun.skin_s[:, None]))
    candidates = concatenate(found)
    forerun = Forerun(
        **{name: np.concatenate([getattr(part, name) for part in foreruns]) for name in Forerun.__dataclass_fields__}
    )
    calm = steady(forerun)
    candidates = replace(candidates, delays_s=candidates.delays_s + (forerun.skin_s - calm.skin_s)[:, None])
    turned = 2 * np.pi * band.carrier_hz * (calm.skin_s - forerun.skin_s)
    return Found(
        candidates,
        calm,
        np.concatenate(phases) + np.where(calm.found, turned, 0.0),
        np.concatenate(features),
        np.concatenate(scores),
        candidates.delays_s * per_s,
        np.concatenate(windows),
        np.asarray(bang / max(len(recording), 1), dtype=np.complex128),
        band.rate_hz,
        band.carrier_hz,
    )


def _forerun_phases(envelopes: Envelopes, forerun: Forerun) -> Array:
    """Phase of each line's forerun echo at its centre, rad; 0 where none was found."""
    at = np.rint(forerun.skin_s * envelopes.rate_hz).astype(np.int64)[:, None]
    values = np.take_along_axis(envelopes.values, np.minimum(at, envelopes.values.shape[1] - 1), axis=1)[:, 0]
    return np.where(forerun.found, np.angle(values) + 2 * np.pi * envelopes.carrier_hz * forerun.skin_s, 0.0)


def _cut_windows(envelopes: Envelopes, times_s: Array) -> Complexes:
    """Complex envelope (n, KEPT, W) around times (n, KEPT); beyond the line's ends its last sample repeats."""
    count = times_s.shape[0]
    centre = np.rint(np.nan_to_num(times_s) * envelopes.rate_hz).astype(np.int64)
    index = np.clip(centre[..., None] + np.arange(-BEFORE, BEHIND + 1), 0, envelopes.values.shape[1] - 1)
    return np.asarray(envelopes.values[np.arange(count)[:, None, None], index])
