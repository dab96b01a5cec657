"""The detector over many simulated worlds; the everyday suite leaves this out."""

import numpy as np
import pytest

from Testing.Benchmarks.echo import calibration, measure_world, rates


@pytest.mark.slow
def test_detector_holds_its_promises_over_many_simulated_worlds():
    judged = [measure_world(90_000_000 + index) for index in range(120)]
    found = rates(judged)
    assert found["within 0.5 mm"] > 0.97
    assert found["within 0.25 mm"] > 0.95
    assert found["accepted < 3 deg"] > 0.82
    assert found["accepted without bone"] < 0.03
    # a bin of few recordings says little: weigh the distance by the lines in it
    bins = np.array(calibration(judged))
    assert (np.abs(bins[:, 0] - bins[:, 1]) * bins[:, 2]).sum() / bins[:, 2].sum() < 0.05
