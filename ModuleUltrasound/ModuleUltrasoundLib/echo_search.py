"""All lines of a recording searched for echoes, batch by batch."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from CranioNavLib.rigid import Array
from CranioNavLib.sequence_metafile import Recording

from ModuleUltrasoundLib.echo_candidates import Candidates, concatenate, find_candidates, noise_level, take_levels
from ModuleUltrasoundLib.echo_features import line_features
from ModuleUltrasoundLib.signal_chain import check_acquisition, complex_envelopes, design_band
from ModuleUltrasoundLib.signal_forerun import Forerun, find_forerun, nominal_skin_s, suppress_multiples

CHUNK = 256  # lines worked on at once: the working set stays in the processor's cache
BEHIND_S = 4e-6  # of a line kept behind the deepest bone: what follows an echo speaks for or against it


@dataclass(frozen=True, eq=False)
class Found:
    """The echoes of n lines and what each says by itself."""

    candidates: Candidates
    forerun: Forerun
    forerun_phases: Array  # (n,) rad; 0 where no forerun echo was found
    features: Array  # (n, K, D)
    depths_mm: Array  # (n, K) at the speed of sound given


def search_lines(recording: Recording, speed_m_s: float, depth_mm: tuple[float, float], several_spots: bool) -> Found:
    """The candidates of every line with their features.

    `depth_mm` (least, most) is where bone is looked for. `several_spots`: the lines come from several places on the head,
    so that what repeats in all of them is an artefact, and can be subtracted.

    Raises
    ------
    InputError
        The recording's header cannot be that of pulse-echo lines.
    """
    acquisition = recording.acquisition
    check_acquisition(acquisition)
    per_s = 500.0 * speed_m_s  # mm of depth a second of delay
    window = (depth_mm[0] / per_s, depth_mm[1] / per_s)
    skin = nominal_skin_s(acquisition)
    band = design_band(acquisition, recording.lines.shape[1], skin * 1.04 + window[1] + BEHIND_S)
    found: list[Candidates] = []
    foreruns: list[Forerun] = []
    phases: list[Array] = []
    features: list[Array] = []
    parts = max(-(-len(recording) // CHUNK), 1)
    for lines in np.array_split(recording.lines, parts):
        envelopes = complex_envelopes(lines, band)
        magnitude = np.abs(envelopes.values)
        levels = take_levels(magnitude)
        noise = noise_level(levels)
        forerun = find_forerun(envelopes, magnitude, noise, acquisition)
        if several_spots and skin > 0:
            envelopes = suppress_multiples(envelopes, forerun, acquisition)
            levels = take_levels(np.abs(envelopes.values))
        candidates = find_candidates(envelopes, levels, noise, forerun.skin_s, window, acquisition.transducer_hz)
        found.append(candidates)
        foreruns.append(forerun)
        at = np.rint(forerun.skin_s * envelopes.rate_hz).astype(np.int64)[:, None]
        angle = np.angle(np.take_along_axis(envelopes.values, np.minimum(at, magnitude.shape[1] - 1), axis=1)[:, 0])
        phases.append(np.where(forerun.found, angle + 2 * np.pi * envelopes.carrier_hz * forerun.skin_s, 0.0))
        features.append(line_features(candidates, forerun, skin, acquisition.transducer_hz, speed_m_s))
    candidates = concatenate(found)
    forerun = Forerun(**{name: np.concatenate([getattr(part, name) for part in foreruns]) for name in Forerun.__dataclass_fields__})
    return Found(candidates, forerun, np.concatenate(phases), np.concatenate(features), candidates.delays_s * per_s)
