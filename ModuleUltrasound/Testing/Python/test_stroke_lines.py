"""The family of strokes and dwells with dispersive echoes: its truth, its number of lines, and what it alone shows."""

from dataclasses import replace

import numpy as np
import pytest
from simulated_peaks import peaks_off_mm

from Testing.Studies.simulators import stroke_lines, stroke_plan

LINES = 24


def draw(wanted, frames=LINES):
    """The first drawn set-up that is as wanted."""
    drawn = (stroke_plan.draw_world(np.random.default_rng(seed), frames) for seed in range(500))
    return next(world for world in drawn if wanted(world))


@pytest.fixture(scope="module")
def some_recordings():
    return [stroke_lines.simulate(np.random.default_rng(97_000_000 + index), LINES) for index in range(12)]


@pytest.fixture(scope="module")
def a_quiet_world():
    """Behind a long delay line, with nothing that hides an echo."""
    world = draw(lambda one: one.material == "pmma" and not one.without and one.delay_us > 21.5 and one.place_mm.min() > 5)
    return replace(world, snr_db=40.0, hot=False, spikes=False, tone=False, junk=0, late=0.0, warming=0.0)


@pytest.mark.parametrize("asked", [1, 12, 40, 90])
def test_recording_has_about_as_many_lines_as_asked_for(asked):
    for seed in range(3):
        world = stroke_plan.draw_world(np.random.default_rng(seed), asked)
        hand = stroke_plan.draw_hand(np.random.default_rng(seed), world, asked)
        assert max(0.6 * asked, 8) <= len(hand.place) <= max(asked, 8)
    recording, truth, _ = stroke_lines.simulate(np.random.default_rng(asked), min(asked, 40))
    assert len(recording) == len(truth.depth_mm) == len(truth.snr_db) == len(truth.tilt_deg) == len(recording.statuses)


def test_peak_of_the_bones_envelope_stands_at_the_true_depth(some_recordings):
    off_mm = []
    for recording, truth, world in some_recordings:
        if world.hot:  # clipped
            continue
        clear = np.flatnonzero((truth.snr_db > 20) & (truth.tilt_deg < 3))
        skin_s = np.full(len(recording), world.delay_us * 1e-6 * (1 + world.late))
        off_mm.extend(peaks_off_mm(recording, truth, clear, skin_s, 1e-7 + 0.8e-6 / world.centre_mhz))
    assert len(off_mm) > 60
    assert abs(np.median(off_mm)) < 0.03
    assert np.quantile(np.abs(off_mm), 0.8) < 0.08


def test_recording_without_bone_has_no_truth():
    for without in ("soft", "air", "unplugged"):
        world = replace(draw(lambda one: not one.without), without=without)
        _, truth, _ = stroke_lines.simulate(np.random.default_rng(1), 12, world)
        assert np.isnan(truth.depth_mm).all()
        assert (truth.snr_db == -np.inf).all()


def test_sum_of_echoes_is_that_of_causal_attenuation(a_quiet_world):
    band = stroke_lines.Band(a_quiet_world, 2000)
    rng = np.random.default_rng(2)
    height, time_us, askew = rng.normal(size=(3, 30)), rng.uniform(1, 15, (3, 30)), np.array([0, 0.5, 2])
    loss = rng.uniform(0, 48 / band.centre_mhz, (3, 30))
    found = band.series(stroke_lines.Echoes(height, time_us, loss, askew))
    causal = 1 - 2j / np.pi * (np.log(band.mhz / band.centre_mhz) - 1)
    for row in range(3):
        lost = np.outer(loss[row] * np.log(10) / 20, causal) + 2j * np.pi * time_us[row][:, None]
        expected = height[row] @ np.exp(-lost * band.mhz)
        expected *= 0.5 ** ((askew[row] * band.mhz / band.centre_mhz) ** 2)
        off = np.abs(band.pulse * (found[row] - expected))
        assert off.max() < 1e-3 * np.abs(band.pulse).max() * np.abs(height[row]).sum()


def test_dispersion_turns_the_phase_but_keeps_the_time_of_the_group(a_quiet_world):
    world = replace(a_quiet_world, skew=1.0, bandwidth=0.45)
    band = stroke_lines.Band(world, 4000)
    two = np.array([[0.0], [6 / band.centre_mhz]])  # dB/MHz: the second echo has lost 6 dB
    ones = np.ones((2, 1))
    lines = band.analytic(band.series(stroke_lines.Echoes(ones, 10 * ones, two, np.zeros(2))))
    peaks = np.abs(lines).argmax(axis=1) / band.sampling_mhz
    np.testing.assert_allclose(peaks, 10, atol=1.5 / band.sampling_mhz + 0.01)
    row = round(10 * band.sampling_mhz)
    turned = np.angle(lines[1, row] / lines[0, row])
    assert abs(turned + 2 / np.pi * 6 * np.log(10) / 20) < 0.1


def test_delay_lines_echo_is_total_where_contact_is_lost(a_quiet_world):
    recording, truth, world = stroke_lines.simulate(np.random.default_rng(3), 60, replace(a_quiet_world, material="aqualene"))
    skin = round(world.delay_us * recording.acquisition.sampling_hz * 1e-6)
    at_skin = np.abs(recording.lines[:, skin - 5 : skin + 6].astype(float)).max(axis=1)
    total = at_skin > 0.7 * at_skin.max()
    assert 3 <= total.sum() <= 20
    assert np.isnan(truth.depth_mm[total]).mean() > 0.8  # the others are touching down
    assert np.median(at_skin[truth.snr_db > 30]) < 0.3 * at_skin.max()


def test_tilted_bone_loses_half_its_height_at_the_lobe_and_its_high_frequencies_first(a_quiet_world):
    band = stroke_lines.Band(a_quiet_world, 4000)
    one = np.full((2, 1), 10.0)
    spectra = band.series(stroke_lines.Echoes(one, one, 0 * one, np.array([0.0, 1.0])))
    lost = np.abs(spectra[1] / spectra[0])
    found = np.interp(band.centre_mhz * np.array([0.5, 1.0, 1.4]), band.mhz, lost)
    np.testing.assert_allclose(found, 0.5 ** np.array([0.25, 1, 1.96]), rtol=0.02)


def test_bone_stays_where_it_is_while_the_probe_moves(a_quiet_world):
    recording, truth, world = stroke_lines.simulate(np.random.default_rng(4), 60, a_quiet_world)
    seen = np.isfinite(truth.depth_mm) & np.isfinite(recording.probe_to_reference[:, 0, 0])
    poses = recording.probe_to_reference[seen]
    reach = truth.depth_mm[seen] + world.acquisition.forerun_length_mm
    bone = poses[:, :3, 3] + reach[:, None] * poses[:, :3, 2] - stroke_plan.HEAD_AT_MM
    radius = np.linalg.norm(bone, axis=1)
    assert 74 < np.median(radius) < 101
    assert np.abs(radius - np.median(radius)).max() < 0.8


def test_set_ups_cover_what_is_met():
    worlds = [stroke_plan.draw_world(np.random.default_rng(seed), 40) for seed in range(300)]
    loss_db = [0.2 * one.attenuation * one.acquisition.transducer_hz * 1e-6 * one.place_mm for one in worlds]
    assert max(loss.max() for loss in loss_db) < stroke_plan.MOST_LOSS_DB
    assert max(np.ptp(loss) for loss in loss_db) < stroke_plan.MOST_APART_DB
    assert 0.5 < np.mean([one.material != "" for one in worlds]) < 0.7
    assert 0.06 < np.mean([one.without != "" for one in worlds]) < 0.18
    assert 0.3 < np.mean([one.sweeps for one in worlds]) < 0.5
