"""The detector over many simulated worlds of two families; the everyday suite takes a few of them."""

import numpy as np
import pytest

from Testing.Benchmarks.echo import calibration, measure_world, rates


@pytest.mark.slow
@pytest.mark.parametrize("family", ["echo_lines", "tissue_lines"])
def test_detector_holds_its_promises_over_many_simulated_worlds(family):
    judged = [measure_world(90_000_000 + index, family) for index in range(150)]
    found = rates(judged)
    assert found["within 0.5 mm"] >= 0.99
    assert found["within 0.25 mm"] >= 0.95
    assert found["and SNR >= 12 dB"] >= 0.9
    assert found["accepted without bone"] < 0.01
    bins = np.array(calibration(judged))
    filled = bins[bins[:, 2] >= 50]  # a bin of a few lines, most of one recording, says little
    assert np.abs(filled[:, 0] - filled[:, 1]).max() <= 0.07


@pytest.mark.parametrize("family", ["echo_lines", "tissue_lines"])
def test_accepted_depths_are_right_in_a_few_simulated_worlds(family):
    found = rates([measure_world(91_000_000 + index, family) for index in range(6)])
    assert found["within 0.5 mm"] >= 0.98
    assert found["within 0.25 mm"] >= 0.95
    assert found["accepted without bone"] <= 0.02
