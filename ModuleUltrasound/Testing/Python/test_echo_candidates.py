import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from ModuleUltrasoundLib.echo.candidates import (
    CANDIDATES,
    find_candidates,
    logarithm,
    noise_level,
    refine_peaks,
    rough_noise,
    salient_peaks,
    take_levels,
)
from ModuleUltrasoundLib.echo.signal_chain import Envelopes

RATE = 20e6


def rayleigh(rng, sigma, shape=(50, 900)):
    return (sigma * np.hypot(rng.normal(size=shape), rng.normal(size=shape))).astype(np.float32)


def bump(at, height, width=2.0, length=900):
    return height * np.exp(-0.5 * ((np.arange(length) - at) / width) ** 2)


def test_noise_level_is_the_deviation_of_one_quadrature():
    magnitude = rayleigh(np.random.default_rng(0), 7.0)
    magnitude[:, 100:300] += 400  # tissue
    assert np.median(noise_level(take_levels(logarithm(magnitude), 900))) == pytest.approx(7.0, rel=0.15)
    assert np.median(rough_noise(magnitude)) == pytest.approx(7.0, rel=0.15)


@settings(max_examples=50, deadline=None)
@given(st.floats(20, 80), st.floats(1.0, 500.0), st.floats(1.2, 6.0))
def test_parabola_through_the_logarithm_is_exact_for_a_gaussian(at, height, width):
    magnitude = bump(at, height, width, 100).astype(np.float32)[None]
    position, top = refine_peaks(magnitude, magnitude.argmax(axis=1)[:, None])
    assert position[0, 0] == pytest.approx(at, abs=5e-3)
    assert top[0, 0] == pytest.approx(height, rel=1e-3)


def test_mean_level_of_any_stretch_is_that_of_the_logarithm():
    rng = np.random.default_rng(4)
    magnitude = rayleigh(rng, 5.0, (3, 901))
    levels = take_levels(logarithm(magnitude), 901)
    first, last = np.sort(rng.integers(0, 902, (2, 40, 3)), axis=0)
    expected = [[np.log(magnitude[n, a:b] + 1e-3).mean() if b > a else np.nan for n, (a, b) in enumerate(zip(*row))]
                for row in zip(first, last)]  # fmt: skip
    assert levels.mean(first, last) == pytest.approx(np.array(expected), abs=1e-3, nan_ok=True)


def test_faint_lone_echo_is_kept_beside_loud_tissue():
    rng = np.random.default_rng(1)
    magnitude = rayleigh(rng, 1.0, (20, 900))
    magnitude += (rayleigh(rng, 300.0, (20, 900)) * np.exp(-np.arange(900) / 60)).astype(np.float32)
    magnitude += bump(700, 15.0).astype(np.float32)
    log = logarithm(magnitude)
    samples = salient_peaks(log, take_levels(log, 900), RATE, 1e6, 20, 800, 4e-7)
    assert (np.abs(samples - 700) <= 2).any(axis=1).mean() > 0.95


def test_candidates_carry_their_time_phase_and_surroundings():
    carrier, at = 4.6e6, 301.3
    t = np.arange(900) / RATE
    values = bump(at, 100.0) * np.exp(-2j * np.pi * carrier * at / RATE + 0.7j) + 0 * t
    noise = np.random.default_rng(2).normal(0, 0.5, (2, 900, 2)) @ [1, 1j]
    envelopes = Envelopes((values + noise).astype(np.complex64), RATE, carrier)
    magnitude = np.abs(envelopes.values)
    found = find_candidates(envelopes, magnitude, np.full(2, 2e-6), (1e-6, 25e-6), 5e6)
    best = np.nanargmax(found.amplitudes, axis=1)
    assert found.delays_s[[0, 1], best] == pytest.approx(np.full(2, at / RATE - 2e-6), abs=6e-9)
    assert np.exp(1j * found.phases[[0, 1], best]) == pytest.approx(np.full(2, np.exp(0.7j)), abs=0.08)
    assert found.widths_s[[0, 1], best] * RATE == pytest.approx([2.0, 2.0], rel=0.1)
    assert np.abs(found.before_db[[0, 1], best]).max() < 2
    assert np.abs(found.after_db[[0, 1], best]).max() < 2


def test_window_outside_of_the_line_gives_no_candidates():
    envelopes = Envelopes(np.ones((3, 50), dtype=np.complex64), RATE, 4.6e6)
    magnitude = np.abs(envelopes.values)
    found = find_candidates(envelopes, magnitude, np.full(3, 1e-5), (1e-6, 2e-5), 5e6)
    assert found.delays_s.shape == (3, CANDIDATES)
    assert np.isnan(found.delays_s).all()


def test_second_rung_of_a_ladder_of_echoes_has_others_at_half_its_delay_and_at_one_and_a_half():
    ladder = sum(bump(100 + rung * 30, 400.0 / rung) for rung in (1, 2, 3))
    for magnitude, over in ((ladder, 20 * np.log10(2.0)), (ladder - bump(130, 400.0), None)):
        lines = (magnitude + 1.0).astype(np.float32)[None]
        envelopes = Envelopes(lines.astype(np.complex64), RATE, 5e6)
        found = find_candidates(envelopes, lines, np.array([100 / RATE]), (40 / RATE, 600 / RATE), 5e6)
        second = np.nanargmin(np.abs(found.delays_s[0] * RATE - 60))
        assert found.further_db[0, second] == pytest.approx(20 * np.log10(2 / 3), abs=0.2)
        if over is None:
            assert found.half_db[0, second] < -30
        else:
            assert found.half_db[0, second] == pytest.approx(over, abs=0.2)
