from dataclasses import replace

import numpy as np
import pytest
from CranioNavLib.recording import Acquisition
from scipy.signal import hilbert

from Testing.Studies.simulators.lifted_lines import GEL_M_S, KINDS, Lines, draw_lifted, reflected, simulate

QUIET = {"snr_db": 90.0, "ringing": 0.0, "order": 0, "bandwidth": 0.7}


def only(kind, **changes):
    """A set-up at 5 MHz without a forerun whose probe meets one kind of thing."""
    lifted = draw_lifted(np.random.default_rng(1))
    shares = tuple(float(one == kind) for one in KINDS)
    set_up = {"acquisition": Acquisition(50e6, 5e6), "samples": 1200, "face_mrayl": 4.0, "shares": shares}
    return replace(lifted, **(QUIET | set_up | changes))


def envelope(recording):
    return np.abs(hilbert(recording.lines.astype(float), axis=1))


@pytest.mark.parametrize("order", [0, 3])
def test_echo_begins_or_has_its_middle_where_its_way_says(order):
    lifted = only("air", order=order)
    lines = Lines(lifted, 1)
    lines.add(np.array([0]), np.array([8.0]), np.array([1.0]))
    level = np.abs(hilbert(lines.rf()[0]))
    peak = level.argmax() / lifted.sampling_mhz
    if order:
        assert level[int(7.8 * lifted.sampling_mhz)] < 0.02 * level.max()
        assert 8.1 < peak < 8.6
    else:
        assert peak == pytest.approx(8.0, abs=0.03)


def test_drop_sends_all_back_turned_over_and_again_between_its_ends():
    for seed in range(5):
        recording, truth, _ = simulate(np.random.default_rng(seed), 20, only("drop"))
        assert np.isnan(truth.depth_mm).all()
        level = envelope(recording)
        first = level.argmax(axis=1) / 50.0
        assert (first * GEL_M_S / 2e3 < 7.6).all()
        later = level[np.arange(20), np.minimum(np.rint(2 * first * 50).astype(int), 1199)]
        known = (first > 1.5) & (first < 11)
        assert (later[known] > 3 * np.median(level[known], axis=1)).all()
    assert reflected(1.5, 0.0004) == pytest.approx(-1, abs=1e-3)


def test_soft_tissue_goes_on_and_air_shows_nothing():
    soft, _, _ = simulate(np.random.default_rng(3), 8, only("soft", attenuation=0.5))
    air, _, world = simulate(np.random.default_rng(3), 8, only("air"))
    level = envelope(soft)
    assert (level[:, 900:].mean(axis=1) > 0.02 * level.max(axis=1)).all()
    assert world.shares[0] == 1
    assert envelope(air).max() < 6 * envelope(air).mean()  # of noise's envelope
