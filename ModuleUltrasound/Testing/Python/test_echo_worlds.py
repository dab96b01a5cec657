"""The detector over many simulated worlds; the everyday suite takes a few of them."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import find_peaks, hilbert

from Testing.Benchmarks.echo import calibration, measure_world, rates
from Testing.Studies.simulators import session_lines


@pytest.mark.slow
def test_textbook_lines_are_told():
    found = rates([measure_world(90_000_000 + index, "plain_lines") for index in range(100)])
    assert found["within 0.5 mm"] >= 0.99
    assert found["within 0.25 mm"] >= 0.95
    assert found["accepted < 3 deg"] >= 0.9
    assert found["accepted without bone"] < 0.01


@pytest.mark.slow
@pytest.mark.parametrize("family", ["echo_lines", "tissue_lines"])
def test_detector_stays_as_good_as_it_was_over_many_simulated_worlds(family):
    judged = [measure_world(90_000_000 + index, family) for index in range(100)]
    found = rates(judged)
    # a little below what was measured on these recordings; some of them no detector can tell (a lone interface without bone)
    assert found["within 0.5 mm"] >= 0.975
    assert found["within 0.25 mm"] >= 0.95
    assert found["and SNR >= 12 dB"] >= 0.87
    assert found["accepted without bone"] < 0.04
    bins = np.array(calibration(judged))
    # a bin of a few lines, most of one recording, says little: weigh the distance by the lines in it
    assert (np.abs(bins[:, 0] - bins[:, 1]) * bins[:, 2]).sum() / bins[:, 2].sum() < 0.03


@pytest.mark.parametrize("family", ["echo_lines", "tissue_lines", "page_lines", "plain_lines", "latency_lines"])
def test_accepted_depths_are_right_in_a_few_simulated_worlds(family):
    found = rates([measure_world(91_000_000 + index, family) for index in range(6)])
    assert found["within 0.5 mm"] >= 0.98
    assert found["within 0.25 mm"] >= 0.95
    assert found["accepted without bone"] <= 0.02


@pytest.fixture(scope="module")
def some_sessions():
    return [session_lines.simulate(np.random.default_rng(92_000_000 + index), 40) for index in range(40)]


@pytest.mark.parametrize("frames", [1, 4, 12, 60])
def test_simulated_session_has_as_many_lines_as_asked_for(frames):
    recording, truth, _ = session_lines.simulate(np.random.default_rng(frames), frames)
    assert len(recording) == frames == len(truth.depth_mm) == len(truth.snr_db) == len(truth.tilt_deg)


def test_echo_of_a_simulated_session_stands_where_the_truth_says(some_sessions):
    off = []  # cycles
    for recording, truth, session in some_sessions:
        acquisition = recording.acquisition
        if session.onset:  # of such a pulse the peak comes later
            continue
        line_us = 2e3 * acquisition.forerun_length_mm / (acquisition.forerun_speed_m_s or 1.0) * session.late
        skin_us = line_us * (1 + session.warming * np.linspace(0, 1, len(recording)))
        time_us = np.arange(recording.lines.shape[1]) / acquisition.sampling_hz * 1e6
        for row in np.flatnonzero(truth.snr_db > 25):
            arrival_us = skin_us[row] + truth.depth_mm[row] * 2e3 / truth.speed_m_s
            near = np.abs(time_us - arrival_us) < 1.5 / session.centre_mhz
            level = np.abs(hilbert(recording.lines[row] - recording.lines[row].mean()))[near]
            off.append((time_us[near][level.argmax()] - arrival_us) * session.centre_mhz)
    assert len(off) > 100
    assert abs(np.median(off)) < 0.1
    assert np.quantile(np.abs(off), 0.8) < 0.5


def test_echoes_of_a_simulated_session_may_clip_but_not_whole_lines(some_sessions):
    for recording, _, session in some_sessions:
        largest = 2 ** (session.bits - 1) - 1
        assert np.abs(recording.lines.astype(int)).max() <= largest + 1
        late = np.abs(recording.lines[:, recording.lines.shape[1] // 2 :].astype(int)) >= largest
        assert late.mean(axis=1).max() < 0.2


def test_probe_in_air_answers_from_its_face_alone():
    plain = {"glides": False, "static": (), "trail": (), "hum": 0.0, "drift": 0.0, "spikes": 0.0, "bits": 14, "fill": 0.5}
    drawn = (session_lines.draw_session(np.random.default_rng(seed)) for seed in range(100))
    session = next(one for one in drawn if one.acquisition.forerun_length_mm > 20 and not one.without)
    air, truth, _ = session_lines.simulate(np.random.default_rng(1), 12, replace(session, without="air", **plain))
    assert np.isnan(truth.depth_mm).all()
    acquisition = air.acquisition
    face_us = 2e3 * acquisition.forerun_length_mm / acquisition.forerun_speed_m_s * session.late
    first, last = (int((face_us + after) * acquisition.sampling_hz * 1e-6) for after in (4.0, 12.0))
    silent = air.lines[:, first:last].astype(float).std()
    assert np.abs(air.lines[:, first:last]).max() < 6 * silent
    assert np.abs(air.lines[:, :first]).max() > 20 * silent


def test_film_of_gel_with_air_behind_answers_with_a_ladder_of_equal_steps():
    plain = {"glides": False, "static": (), "trail": (), "hum": 0.0, "drift": 0.0, "spikes": 0.0, "bits": 14, "fill": 0.5}
    drawn = (session_lines.draw_session(np.random.default_rng(seed)) for seed in range(100))
    # rungs must be apart: high frequency, and nothing of the main bang over them
    session = next(one for one in drawn if one.acquisition.forerun_length_mm > 20 and one.centre_mhz > 6 and one.pulse == "gauss")
    film, truth, _ = session_lines.simulate(np.random.default_rng(3), 12, replace(session, without="film", snr_db=38.0, **plain))
    assert np.isnan(truth.depth_mm).all()
    acquisition = film.acquisition
    line = film.lines[len(film) // 2].astype(float)
    level = np.abs(hilbert(line - line.mean()))
    per_mm = 2e3 / truth.speed_m_s * acquisition.sampling_hz * 1e-6
    skin = 2e3 * acquisition.forerun_length_mm / acquisition.forerun_speed_m_s * session.late * acquisition.sampling_hz * 1e-6
    peaks, _ = find_peaks(level, height=8 * np.median(level), distance=int(0.3 * per_mm))
    rungs = (peaks[peaks > skin - 0.1 * per_mm] - skin) / per_mm
    assert len(rungs) >= 3
    assert np.diff(rungs[:3]) == pytest.approx(np.full(2, rungs[1] - rungs[0]), abs=0.06)
    assert 0.35 < rungs[1] - rungs[0] < 1.8


def test_depth_is_continuous_within_a_place_and_places_are_apart(some_sessions):
    for recording, truth, session in some_sessions:
        if session.glides or not session.numbered:
            continue
        same = np.diff(recording.palpation_points) == 0
        step = np.abs(np.diff(truth.depth_mm))[same]
        assert np.nanmax(step, initial=0.0) < 0.8
        apart = np.linalg.norm(np.diff(recording.probe_to_reference[:, :3, 3], axis=0), axis=1)
        if not session.lifts:
            assert (apart[~same] > 5).all()
            assert (apart[same] < 2).all()


def test_few_lines_of_a_simulated_session_cannot_be_read(some_sessions):
    for _, truth, session in some_sessions:
        bone = np.isfinite(truth.depth_mm)
        assert (truth.snr_db[bone] < 8).sum() <= 0.2 * bone.sum()
        assert (truth.snr_db[~bone] == -np.inf).all()
        assert not (session.without and bone.any())
