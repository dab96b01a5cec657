import numpy as np
import pytest
from CranioNavLib.errors import InputError
from CranioNavLib.sequence_metafile import Acquisition
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from ModuleUltrasoundLib.echo.candidates import refine_peaks
from ModuleUltrasoundLib.echo.signal_chain import check_acquisition, complex_envelopes, design_band


def gaussian_echo(time_s, centre_hz, at_s, phase=0.0, bandwidth=0.6):
    sigma = np.sqrt(2 * np.log(2)) / (np.pi * bandwidth * centre_hz)
    return np.exp(-0.5 * ((time_s - at_s) / sigma) ** 2) * np.cos(2 * np.pi * centre_hz * (time_s - at_s) + phase)


def peak_time(line, acquisition):
    envelopes = complex_envelopes(line[None], design_band(acquisition, len(line), 1.0))
    magnitude = np.abs(envelopes.values)
    position, _ = refine_peaks(magnitude, magnitude.argmax(axis=1)[:, None])
    return float(position[0, 0]) / envelopes.rate_hz


@settings(max_examples=40, deadline=None)
@given(
    st.floats(3e6, 10e6),
    st.sampled_from([25e6, 40e6, 62.5e6, 125e6]),
    st.floats(8e-6, 18e-6),
    st.floats(0, 6.28),
    st.floats(0.35, 0.9),
)
def test_peak_of_the_envelope_stays_where_a_symmetric_pulse_has_its_centre(centre, rate, at, phase, bandwidth):
    assume(rate > 3.5 * centre)  # else the pulse itself reaches beyond half the sampling rate
    time = np.arange(int(26e-6 * rate)) / rate
    line = np.round(20000 * gaussian_echo(time, centre, at, phase, bandwidth)).astype(np.int16)
    assert peak_time(line, Acquisition(rate, centre)) == pytest.approx(at, abs=0.04 / centre)  # 4 % of a wavelength: 0.01 mm


def test_envelope_of_a_tone_in_the_band_is_its_amplitude():
    rate, centre = 60e6, 5e6
    band = design_band(Acquisition(rate, centre), 3000, 1.0)
    time = np.arange(3000) / rate
    line = np.round(1000 * np.cos(2 * np.pi * band.carrier_hz * time)).astype(np.int16)
    middle = np.abs(complex_envelopes(line[None], band).values)[0, 200:-200]
    assert middle == pytest.approx(np.full(middle.shape, 1000.0), rel=0.01)


def test_offset_and_slow_drift_leave_no_trace_at_the_ends_of_a_line():
    rate = 60e6
    drift = (300 + 0.1 * np.arange(3200)).astype(np.int16)
    envelopes = complex_envelopes(drift[None], design_band(Acquisition(rate, 5e6), 3200, 1.0))
    assert np.abs(envelopes.values).max() < 1.0


def test_straight_drift_is_removed_exactly():
    lines = (np.arange(1000)[None] * np.array([[1], [-2], [0]]) + 5).astype(np.int16)
    band = design_band(Acquisition(50e6, 4e6), 1000, 1.0)
    assert np.abs(complex_envelopes(lines, band).values).max() < 0.05


def test_result_does_not_depend_on_the_lines_beside():
    rng = np.random.default_rng(0)
    lines = rng.integers(-500, 500, (5, 2000)).astype(np.int16)
    band = design_band(Acquisition(50e6, 4e6), 2000, 1.0)
    together = complex_envelopes(lines, band).values
    alone = complex_envelopes(lines[2:3], band).values
    assert np.abs(together[2] - alone[0]).max() < 1e-3 * np.abs(alone).max()


@pytest.mark.parametrize(
    ("acquisition", "text"),
    [
        (Acquisition(float("nan"), 5e6), "SamplingFrequencyHz is nan"),
        (Acquisition(60e6, 0.0), "TransducerFrequencyHz is 0"),
        (Acquisition(8e6, 5e6), "above half"),
        (Acquisition(60e6, 5e6, 20.0, 0.0), "ForerunSpeedOfSoundMps 0.0"),
        (Acquisition(60e6, 5e6, -1.0, 2000.0), "ForerunLengthMm -1.0"),
    ],
)
def test_header_that_no_pulse_echo_line_can_have_is_refused(acquisition, text):
    with pytest.raises(InputError, match=text):
        check_acquisition(acquisition)
