import numpy as np
import pytest
from CranioNavLib.sequence_metafile import Acquisition
from ModuleUltrasoundLib.echo.candidates import rough_noise
from ModuleUltrasoundLib.echo.forerun import find_forerun, nominal_skin_s, steady, suppress_multiples
from ModuleUltrasoundLib.echo.signal_chain import complex_envelopes, design_band

ACQUISITION = Acquisition(60e6, 5e6, 20.0, 2340.0)
SKIN_S = 2e-3 * 20 / 2340


def lines_with(echoes, count=12, noise=0.004, seed=0):
    """Lines with symmetric pulses at given times (s, or one a line) and heights, and their envelopes."""
    rng = np.random.default_rng(seed)
    time = np.arange(3000) / ACQUISITION.sampling_hz
    lines = rng.normal(0, noise, (count, 3000))
    for at, height in echoes:
        t = time - np.broadcast_to(at, count)[:, None]
        lines += np.broadcast_to(height, count)[:, None] * np.exp(-0.5 * (t * 5e6 / 0.5) ** 2) * np.cos(2 * np.pi * 5e6 * t)
    codes = np.round(8000 * lines).astype(np.int16)
    envelopes = complex_envelopes(codes, design_band(ACQUISITION, 3000, 1.0))
    return envelopes, np.abs(envelopes.values)


def forerun_of(envelopes, magnitude):
    return find_forerun(envelopes, magnitude, rough_noise(magnitude), ACQUISITION)


def test_nominal_time_is_the_way_there_and_back():
    assert nominal_skin_s(ACQUISITION) == pytest.approx(SKIN_S)
    assert nominal_skin_s(Acquisition(60e6, 5e6)) == 0


@pytest.mark.parametrize("drift", [-0.02, 0.0, 0.02])
def test_face_is_tracked_as_the_delay_line_warms(drift):
    skin = SKIN_S * (1 + drift)
    forerun = forerun_of(*lines_with([(skin, -0.3), (skin + 8e-6, 0.5)]))
    assert forerun.found.all()
    assert np.abs(forerun.skin_s - skin).max() < 4e-9


def test_bone_and_speckle_are_not_taken_for_the_face():
    rng = np.random.default_rng(1)
    speckle = [(SKIN_S + rng.uniform(0, 8e-6, 12), rng.normal(0, 0.02, 12)) for _ in range(60)]
    forerun = forerun_of(*lines_with([*speckle, (SKIN_S + 8e-6, 0.5)]))
    assert not forerun.measured.any()
    assert forerun.skin_s == pytest.approx(np.full(12, SKIN_S))


def test_louder_layer_just_behind_the_face_is_not_taken_for_it():
    forerun = forerun_of(*lines_with([(SKIN_S, -0.1), (SKIN_S + 1e-6, 0.16)]))
    assert forerun.found.all()
    assert np.abs(forerun.skin_s - SKIN_S).max() < 1e-8


def test_line_whose_face_is_lost_takes_the_others_time():
    height = np.full(12, 0.3)
    height[5] = 0.0
    forerun = forerun_of(*lines_with([(SKIN_S, height), (SKIN_S + 8e-6, 0.5)]))
    assert not forerun.found[5]
    assert forerun.skin_s[5] == pytest.approx(SKIN_S, abs=4e-9)


def test_face_seen_in_air_only_is_the_zero_of_all_lines():
    """A well matched delay line shows no face in contact: it does whenever the probe is lifted."""
    height = np.zeros(20)
    height[[0, 1, 9, 10, 19]] = 1.0
    skin = SKIN_S * (1 + np.linspace(0.004, 0.008, 20))
    forerun = steady(forerun_of(*lines_with([(skin, height), (skin + 8e-6, np.where(height > 0, 0, 0.5))], count=20)))
    assert forerun.measured.all()
    assert np.abs(forerun.skin_s - skin).max() < 2e-8


def test_few_clear_echoes_at_different_times_are_not_the_face():
    height = np.zeros(20)
    height[[0, 1, 2, 10, 11, 12]] = 1.0
    layer = np.where(np.arange(20) < 5, SKIN_S + 1e-7, SKIN_S + 4.5e-7)
    assert not forerun_of(*lines_with([(layer, height)], count=20)).measured.any()


def test_multiples_are_suppressed_and_bone_is_kept():
    rng = np.random.default_rng(2)
    bone = SKIN_S + rng.uniform(5e-6, 14e-6, 12)
    envelopes, magnitude = lines_with([(SKIN_S, -0.3), (2 * SKIN_S, 0.06), (bone, 0.4)])
    at = round(2 * SKIN_S * envelopes.rate_hz)
    rows, bones = np.arange(12), np.rint(bone * envelopes.rate_hz).astype(int)
    before, kept = magnitude[:, at].copy(), magnitude[rows, bones].copy()
    suppress_multiples(envelopes, magnitude, forerun_of(envelopes, magnitude), ACQUISITION)
    assert (magnitude[:, at] < 0.15 * before).all()
    assert magnitude[rows, bones] == pytest.approx(kept, rel=0.05)


def test_strong_multiples_between_two_samples_leave_only_noise():
    """A face far stronger than any echo of tissue, a delay line that warms, a trigger that jitters."""
    rng = np.random.default_rng(4)
    jitter, skin = rng.normal(0, 5e-9, 60), SKIN_S * (1 + np.linspace(0, 0.002, 60))
    envelopes, magnitude = lines_with([(skin + jitter, 3.0), (2 * skin + jitter, -1.0)], count=60)
    at = np.rint(2 * skin * envelopes.rate_hz).astype(int)[:, None] + np.arange(-6, 7)
    rows = np.arange(60)[:, None]
    before = magnitude[rows, at].max(axis=1)
    suppress_multiples(envelopes, magnitude, forerun_of(envelopes, magnitude), ACQUISITION)
    assert np.median(magnitude[rows, at].max(axis=1) / before) < 0.05


def test_steadied_times_lose_the_noise_and_keep_a_drift():
    true = SKIN_S * (1 + np.linspace(0, 0.004, 400))
    envelopes, magnitude = lines_with([(true, -0.05), (true + 8e-6, 0.5)], count=400, noise=0.006)
    forerun = forerun_of(envelopes, magnitude)
    calm = steady(forerun)
    raw, left = np.std(forerun.skin_s - true), np.std(calm.skin_s - true)
    assert left < 0.5 * raw
    assert np.median(calm.sd_s) == pytest.approx(left, rel=0.6)


def test_trigger_jitter_stays_in_each_line():
    jitter = np.random.default_rng(3).normal(0, 2e-8, 200)
    envelopes, magnitude = lines_with([(SKIN_S + jitter, -0.3), (SKIN_S + jitter + 8e-6, 0.5)], count=200)
    calm = steady(forerun_of(envelopes, magnitude))
    assert np.std(calm.skin_s - SKIN_S - jitter) < 3e-9
