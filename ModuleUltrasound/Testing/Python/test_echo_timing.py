import numpy as np
import pytest
from ModuleUltrasoundLib.echo.timing import BEFORE, BEHIND, learn_pulse, shift_windows, time_echoes

RATE, CARRIER, CENTRE = 20e6, 4.6e6, 5e6
WIDTH = 2.2  # samples


def windows_at(times, phase=0.5, snr_db=25.0, rng=None, jitter_phase=0.0):
    """Complex envelopes around true echo times, cut where the nearest sample is, with band-limited noise."""
    rng = rng or np.random.default_rng(0)
    nearest = np.rint(times * RATE)
    u = nearest[:, None] + np.arange(-BEFORE, BEHIND + 1) - (times * RATE)[:, None]
    clean = np.exp(-0.5 * (u / WIDTH) ** 2) * np.exp(1j * (phase - 2 * np.pi * CARRIER * times))[:, None]
    clean = clean * np.exp(1j * rng.normal(0, 1, len(times)) * jitter_phase)[:, None]
    noise = rng.normal(size=(len(times), u.shape[1] + 8, 2)) @ [1, 1j]
    kernel = np.exp(-0.5 * (np.arange(-4, 5) / 1.0) ** 2)
    kernel /= np.sqrt((kernel**2).sum())
    noise = np.stack([np.convolve(one, kernel, mode="valid") for one in noise])
    return (clean + 10 ** (-snr_db / 20) * noise).astype(np.complex64)


def test_cubic_shift_moves_a_smooth_window():
    u = np.arange(27.0)
    window = np.exp(-0.5 * ((u - 10) / 2.5) ** 2)[None].astype(np.complex64)
    moved = shift_windows(window, np.array([0.37]))
    assert np.abs(moved[0, 2:-2] - np.exp(-0.5 * ((u + 0.37 - 10) / 2.5) ** 2)[2:-2]).max() < 5e-3


@pytest.mark.parametrize("jitter_phase", [0.0, 3.0])
def test_matched_filter_beats_the_peak_and_states_its_deviation(jitter_phase):
    rng = np.random.default_rng(1)
    times = 10e-6 + rng.uniform(0, 5e-6, 400)
    picked = times + rng.normal(0, 0.3, 400) / RATE  # a peak read from the noisy envelope
    # windows are cut around the picked peak's nearest sample
    windows = windows_at(times, rng=rng, jitter_phase=jitter_phase)
    same = np.rint(times * RATE) == np.rint(picked * RATE)
    times, picked, windows = times[same], picked[same], windows[same]
    timing, pulse = time_echoes(windows, picked, np.zeros(len(times)), np.ones(len(times)), RATE, CARRIER, CENTRE)
    errors = picked + timing.shift_s - times
    assert errors.std() < 0.6 * (picked - times).std()
    assert 0.6 < errors.std() / np.median(timing.sd_s) < 1.6
    assert np.isfinite(pulse.phase_sd) == (jitter_phase == 0)  # echoes that share no phase are not timed by it


def test_phase_times_more_finely_than_the_envelope():
    rng = np.random.default_rng(2)
    times = 10e-6 + rng.uniform(0, 5e-6, 300)
    ones = np.ones(300)
    steady, _ = time_echoes(windows_at(times, rng=rng), times, np.zeros(300), ones, RATE, CARRIER, CENTRE)
    loose, _ = time_echoes(windows_at(times, rng=rng, jitter_phase=3.0), times, np.zeros(300), ones, RATE, CARRIER, CENTRE)
    assert steady.shift_s.std() < 0.7 * loose.shift_s.std()


def test_more_noise_gives_a_larger_deviation():
    times = 10e-6 + np.random.default_rng(3).uniform(0, 5e-6, 100)
    sds = []
    for snr in (35.0, 25.0, 15.0):
        timing, _ = time_echoes(windows_at(times, snr_db=snr), times, np.zeros(100), np.ones(100), RATE, CARRIER, CENTRE)
        sds.append(np.median(timing.sd_s))
    assert sds[0] < 0.5 * sds[1] < 0.25 * sds[2]


def test_too_few_sure_echoes_leave_the_pulse_assumed():
    times = 10e-6 + np.zeros(3)
    assert learn_pulse(windows_at(times), np.zeros(3), np.ones(3), RATE, CENTRE).lines == 0


def test_line_without_an_echo_stays_not_a_number():
    times = np.array([10e-6, np.nan])
    windows = np.concatenate([windows_at(times[:1]), np.zeros((1, BEFORE + BEHIND + 1), dtype=np.complex64)])
    timing, _ = time_echoes(windows, times, np.zeros(2), np.array([1.0, 0.0]), RATE, CARRIER, CENTRE)
    assert np.isfinite(timing.shift_s[0])
    assert np.isnan(timing.shift_s[1])
