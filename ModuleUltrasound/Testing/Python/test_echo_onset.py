import numpy as np
import pytest
from CranioNavLib.sequence_metafile import Acquisition
from ModuleUltrasoundLib.echo.onset import COUNTED, delay_from_bang, delay_from_shape, pulse_delay
from ModuleUltrasoundLib.echo.signal_chain import complex_envelopes, design_band
from ModuleUltrasoundLib.echo.timing import BEFORE, BEHIND, Pulse

RATE, CENTRE = 60e6, 5e6


def damped(time, order, decay_cycles):
    rise = np.clip(time * CENTRE / decay_cycles, 0, None)
    return np.where(time >= 0, rise**order * np.exp(-rise), 0) * np.sin(2 * np.pi * CENTRE * time)


def gaussian(time, bandwidth):
    sigma = np.sqrt(2 * np.log(2)) / (np.pi * bandwidth * CENTRE)
    return np.exp(-0.5 * (time / sigma) ** 2) * np.cos(2 * np.pi * CENTRE * time)


def filtered(wave, bang=None):
    """The pulse as the chain sees it, its true delay behind the arrival, and the start of a line with `bang` at zero."""
    time = np.arange(2400) / RATE
    arrival = 20e-6
    line = wave(time - arrival)
    if bang is not None:
        line = line + bang(time)
    codes = np.round(8000 * line / np.abs(line).max()).astype(np.int16)
    envelopes = complex_envelopes(codes[None], design_band(Acquisition(RATE, CENTRE), 2400, 1.0))
    values = envelopes.values[0].astype(complex)
    first = int(10e-6 * envelopes.rate_hz)
    peak = first + int(np.abs(values[first:]).argmax())
    pulse = Pulse(values[peak - BEFORE : peak + BEHIND + 1] / abs(values[peak]), envelopes.rate_hz, 100, 0.0, np.inf)
    return pulse, peak / envelopes.rate_hz - arrival, values[:40]


@pytest.mark.parametrize("order", [0, 1, 2])
@pytest.mark.parametrize("decay", [0.5, 0.9])
def test_damped_pulse_has_its_origin_nearer_to_its_onset_than_to_its_peak(order, decay):
    pulse, late, _ = filtered(lambda t: damped(t, order, decay))
    # an eighth of a cycle comes from the whole-sample peak of this test; half a cycle is 0.08 mm at 5 MHz
    assert delay_from_shape(pulse, CENTRE) == pytest.approx(COUNTED * late, abs=0.5 * COUNTED / CENTRE)


NEVER_MORE = 0.8  # cycles: 0.2 mm at 3 MHz, the lowest frequency, within the 0.25 mm that a depth is to be right to


@pytest.mark.parametrize("bandwidth", [0.3, 0.5, 0.7, 0.9])
def test_of_a_symmetric_pulse_that_may_count_from_its_middle_no_more_is_taken_than_does_no_harm(bandwidth):
    pulse, _, _ = filtered(lambda t: gaussian(t, bandwidth))
    assert 0.2 / CENTRE < delay_from_shape(pulse, CENTRE) <= NEVER_MORE / CENTRE


@pytest.mark.parametrize("order", [3, 4, 5])
@pytest.mark.parametrize("decay", [0.3, 0.4])
def test_of_a_slowly_rising_pulse_that_looks_symmetric_at_least_a_third_of_its_delay_is_taken(order, decay):
    pulse, late, _ = filtered(lambda t: damped(t, order, decay))
    assert 0.33 * late < delay_from_shape(pulse, CENTRE) < late


def test_main_bang_that_shows_the_whole_pulse_gives_its_delay():
    late_by = 1.5 / CENTRE
    wave = lambda t: gaussian(t - late_by, 0.7)  # noqa: E731
    pulse, late, bang = filtered(wave, bang=wave)
    assert late == pytest.approx(late_by, abs=0.13 / CENTRE)
    assert delay_from_bang(bang, pulse, CENTRE) == pytest.approx(late_by, abs=0.1 / CENTRE)
    assert pulse_delay(bang, pulse, CENTRE) == pytest.approx(late_by, abs=0.1 / CENTRE)


def test_half_a_bang_or_a_long_ringing_tells_nothing():
    wave = lambda t: gaussian(t, 0.7)  # noqa: E731
    pulse, _, half = filtered(wave, bang=wave)
    assert np.isnan(delay_from_bang(half, pulse, CENTRE))
    _, _, ringing = filtered(wave, bang=lambda t: 3 * np.exp(-t / 4e-7) * np.cos(2 * np.pi * CENTRE * t))
    assert np.isnan(delay_from_bang(ringing, pulse, CENTRE))


def test_pulse_that_was_not_learnt_has_no_delay():
    pulse, _, _ = filtered(lambda t: damped(t, 1, 0.9))
    assert delay_from_shape(Pulse(pulse.values, pulse.rate_hz, 0, 0.0, np.inf), CENTRE) == 0
