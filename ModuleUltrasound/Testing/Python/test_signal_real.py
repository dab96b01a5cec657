"""The signal chain on real lines of an open-hardware pulser: water above a stepped steel block."""

import numpy as np
import pytest
from CranioNavLib.sequence_metafile import Acquisition
from ModuleUltrasoundLib.echo.candidates import refine_peaks
from ModuleUltrasoundLib.echo.signal_chain import complex_envelopes, design_band

WATER_M_S, STEEL_M_S = 1480.0, 5950.0
RATE_HZ = 60e6
# line, step height in mm, sample numbers (to some ten) of the steel's echoes behind the first, of the water's echoes.
# The first water-steel echo of the 15 mm line is clipped; its steel multiples are not.
STEPS = [
    (0, 10.0, (2447, 2649, 2852), (2246, 4446, 6646)),
    (24, 15.0, (2131, 2435, 2738), (1824, 3608)),
    (27, 25.0, (1028, 1531), (1028, 2005, 2987)),
]


@pytest.fixture
def echo_times(amode_recordings):
    """Times (s) of the envelope peaks of a line near given samples."""
    codes = np.load(amode_recordings / "pic0rick-water-steel-steps.npz", allow_pickle=False)["codes"]
    band = design_band(Acquisition(RATE_HZ, 5e6), codes.shape[1], 1.0)
    envelopes = complex_envelopes(codes, band)
    magnitude = np.abs(envelopes.values)

    def times(line, samples):
        reach = int(25 / RATE_HZ * envelopes.rate_hz)
        starts = [int(sample / RATE_HZ * envelopes.rate_hz) - reach for sample in samples]
        peaks = [start + int(magnitude[line, start : start + 2 * reach].argmax()) for start in starts]
        return refine_peaks(magnitude[line : line + 1], np.array([peaks]))[0][0] / envelopes.rate_hz

    return times


@pytest.mark.parametrize(("line", "height_mm", "steel", "water"), STEPS)
def test_step_of_the_steel_block_is_measured_to_a_tenth_of_a_millimetre(echo_times, line, height_mm, steel, water):
    between = np.diff(echo_times(line, steel))
    assert 500 * STEEL_M_S * between == pytest.approx(np.full(len(between), height_mm), abs=0.1)


@pytest.mark.parametrize(("line", "height_mm", "steel", "water"), STEPS)
def test_water_path_repeats_at_whole_multiples(echo_times, line, height_mm, steel, water):
    # envelope peaks count from sample 46 to 48 on these lines, as the multiples of other lines say
    path = 500 * WATER_M_S * (echo_times(line, water) - 47 / RATE_HZ)
    number = np.arange(1, len(path) + 1)
    assert path - number * (path @ number) / (number @ number) == pytest.approx(np.zeros(len(path)), abs=0.05)
