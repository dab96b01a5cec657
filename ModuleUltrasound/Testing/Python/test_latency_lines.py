"""The simulated A-lines whose trigger comes late: where the echo stands, what tells time zero, tilt, lines without bone."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import hilbert
from simulated_peaks import peaks_off_mm

from Testing.Studies.simulators import latency_echoes, latency_hand, latency_lines, latency_plan

LINES = 24
NO_BONE = ["air", "airfilm", "soft", "hole"]


@pytest.fixture(scope="module")
def some_recordings():
    return [latency_lines.simulate(np.random.default_rng(98_000_000 + index), LINES) for index in range(14)]


@pytest.fixture(scope="module")
def a_delayed_setup():
    """Bone on every place, heard well, behind a delay line whose echo is plain."""
    drawn = (latency_plan.draw_setup(np.random.default_rng(seed)) for seed in range(500))
    found = next(one for one in drawn if one.delay.material == "pmma" and not one.without and one.attenuation < 0.7)
    plain = {"sweeps": False, "soft_place": -1, "hole": False, "bubbles": False, "spikes": False, "tone": False, "gain_db": 0.0}
    delay = replace(found.delay, latency_us=0.12, slower=0.01, warms=0.005, static=False)
    return replace(found, delay=delay, snr_db=32.0, **plain)


def skin_s(recording, world):
    """Where the delay line truly ends, line by line."""
    slower = 1 + world.delay.slower + np.linspace(0, world.delay.warms, len(recording))
    return (world.delay.latency_us + world.delay_us * slower) * 1e-6


@pytest.mark.parametrize(("asked", "given"), [(1, 8), (12, 12), (90, 90)])
def test_recording_has_as_many_lines_as_asked_for_but_never_very_few(asked, given):
    for seed in range(2):
        recording, truth, world = latency_lines.simulate(np.random.default_rng(1000 * seed + asked), asked)
        assert len(recording) == given
        for values in (truth.depth_mm, truth.snr_db, truth.tilt_deg, world.kind, world.clash, world.ignore, world.must):
            assert len(values) == given


def test_peak_of_the_bones_envelope_stands_at_the_true_depth(some_recordings):
    off_mm = []
    for recording, truth, world in some_recordings:
        clear = np.flatnonzero((truth.snr_db > 25) & (truth.tilt_deg < 2) & ~world.ignore)
        off_mm.extend(peaks_off_mm(recording, truth, clear, skin_s(recording, world), 1e-6 / world.transducer.centre_mhz))
    assert len(off_mm) > 40
    assert 0.0 < np.median(off_mm) < 0.06  # the gel's film
    assert np.quantile(np.abs(off_mm), 0.9) < 0.15


def test_echo_of_the_delay_line_alone_tells_how_late_a_line_is(a_delayed_setup):
    recording, truth, world = latency_lines.simulate(np.random.default_rng(3), LINES, a_delayed_setup)
    time_us = np.arange(recording.lines.shape[1]) / world.sampling_mhz
    near = np.abs(time_us - world.delay_us) < 0.8
    level = np.abs(hilbert(recording.lines - recording.lines.mean(axis=1, keepdims=True), axis=1))[:, near]
    late_us = time_us[near][level.argmax(axis=1)] - world.delay_us
    held = np.isfinite(truth.depth_mm) & ~world.ignore
    true_us = skin_s(recording, world) * 1e6 - world.delay_us
    assert true_us.min() > 0.19  # far more than the depth may be off
    assert np.abs(late_us - true_us)[held].max() < 0.05
    assert recording.acquisition.forerun_length_mm == world.delay.length_mm


def test_lines_without_bone_have_no_truth(some_recordings):
    for _, truth, world in some_recordings:
        bone = np.isfinite(truth.depth_mm)
        assert np.isfinite(truth.snr_db[bone]).all()
        assert (truth.snr_db[~bone] == -np.inf).all()
        assert not (bone & np.isin(world.kind, NO_BONE)).any()
        assert not (world.without and bone.any())
        assert bone[world.must].all()
        assert not (world.must & world.ignore).any()
    kinds = {str(kind) for _, _, world in some_recordings for kind in world.kind}
    assert {"bone", "tilted", "air", "soft", "edge"} <= kinds


def test_tilt_weakens_the_echo_and_the_disc_averages_its_arrivals(a_delayed_setup):
    band = latency_echoes.Band(a_delayed_setup, 4000)
    tilts = np.array([0.0, 1.0, 2.0, 4.0])
    left = np.abs(band.mirror(tilts)[:, len(band.mhz) // 2])
    assert left[0] == pytest.approx(band.smooth[len(band.mhz) // 2], rel=1e-3)
    assert (np.diff(left[:3]) < 0).all()
    across = (np.arange(21) - 10) / 10.5
    weight = (1 - across**2) ** a_delayed_setup.transducer.taper
    apart_us = a_delayed_setup.transducer.disc_mm * np.sin(np.radians(4.0)) / a_delayed_setup.mm_us
    arrivals = np.exp(2j * np.pi * band.mhz[:, None] * apart_us * across) @ weight / weight.sum()
    np.testing.assert_allclose(band.mirror(np.array([4.0]))[0], arrivals.real * band.smooth, atol=3e-3)


def test_beam_meets_the_sphere_at_the_stated_depth_and_tilt(a_delayed_setup):
    hand = latency_hand.draw_hand(np.random.default_rng(4), a_delayed_setup, 60)
    hit = hand.skin_mm + hand.along * hand.depth_mm[:, None]
    np.testing.assert_allclose(np.linalg.norm(hit, axis=1), hand.head_mm)
    towards = -(hit * hand.along).sum(axis=1) / hand.head_mm
    np.testing.assert_allclose(np.degrees(np.arccos(towards)), hand.askew_deg, atol=1e-4)
    assert (hand.depth_mm >= hand.thick_mm - 1e-9).all()


def test_probe_in_air_answers_from_its_face_and_misses_the_tissue(a_delayed_setup):
    heights = {}
    for without in ("", "air"):
        recording, _, world = latency_lines.simulate(np.random.default_rng(5), LINES, replace(a_delayed_setup, without=without))
        time_us = np.arange(recording.lines.shape[1]) / world.sampling_mhz
        lines = np.abs(recording.lines - np.median(recording.lines, axis=1, keepdims=True))
        rows = world.kind == ("air" if without else "bone")
        face = np.abs(time_us - world.delay_us) < 1
        tissue = (time_us > world.delay_us + 2.5) & (time_us < 1.9 * world.delay_us)
        heights[without] = lines[rows][:, face].max() / lines[rows][:, tissue].max()
    assert heights["air"] > 3 * heights[""]


def test_burr_hole_is_passed_by_a_glide():
    drawn = (latency_plan.draw_setup(np.random.default_rng(seed)) for seed in range(300))
    setup = next(one for one in drawn if one.hole)
    _, truth, world = latency_lines.simulate(np.random.default_rng(0), 90, setup)
    assert np.isin(["hole", "rim", "bone"], world.kind).all()
    assert np.isnan(truth.depth_mm[world.kind == "hole"]).all()
    assert world.ignore[world.kind == "rim"].all()


def test_depth_and_frequency_are_such_that_a_user_could_hear_bone():
    setups = [latency_plan.draw_setup(np.random.default_rng(seed)) for seed in range(200)]
    for one in setups:
        loss_db_mm = 0.2e-6 * one.attenuation * one.acquisition.transducer_hz
        assert max(one.places_mm) * loss_db_mm <= max(latency_plan.MOST_LOSS_DB, (one.least_mm + 2.5) * loss_db_mm) + 1e-9
        assert 2 <= one.least_mm <= min(one.places_mm) <= max(one.places_mm) <= 15
    assert 0.5 < np.mean([one.delay.length_mm > 0 for one in setups]) < 0.7
    assert 0.22 < np.mean([one.formalin for one in setups]) < 0.38
    assert 0.18 < np.mean([one.sweeps for one in setups]) < 0.33
    assert 0.07 < np.mean([one.without != "" for one in setups]) < 0.18


def test_longer_recording_goes_to_more_places(a_delayed_setup):
    setup = replace(a_delayed_setup, places_mm=(5.0, 6.0, 4.0, 7.0))
    places = [int(latency_hand.draw_hand(np.random.default_rng(1), setup, frames).place[-1]) + 1 for frames in (12, 49, 98)]
    assert places == [1, 2, 4]
