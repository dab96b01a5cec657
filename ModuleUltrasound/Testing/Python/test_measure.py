import time
from dataclasses import replace

import numpy as np
import pytest
from CranioNavLib.errors import InputError
from CranioNavLib.rigid import rigid_from_vector
from CranioNavLib.sequence_metafile import Acquisition, Recording
from ModuleUltrasoundLib.echo import likelihood
from ModuleUltrasoundLib.echo.network import Calibration, learnt
from ModuleUltrasoundLib.measurement.measure import EchoSettings, measure_lines, several_spots, stays

SPEED = 1500.0


def pulse(time_s, centre_hz):
    """A symmetric pulse, its middle at time zero."""
    return np.exp(-0.5 * (time_s * centre_hz / 0.45) ** 2) * np.cos(2 * np.pi * centre_hz * time_s + 0.4)


def onset_pulse(time_s, centre_hz):
    """A pulse that starts at time zero and rings down."""
    rise = np.clip(time_s * centre_hz / 0.7, 0, None)
    return np.where(time_s >= 0, rise * np.exp(1 - rise), 0.0) * np.sin(2 * np.pi * centre_hz * time_s)


def record(
    rng,
    depths_mm,
    acquisition,
    snr_db=30.0,
    wave=pulse,
    samples=3200,
    galea=0.12,
    warm=0.0,
    contact=None,
    bone=None,
    points=None,
    matched=0.2,
):
    """Lines of plain textbook pulse-echo: forerun face, galea, speckle down to the bone, bone, inner table, noise."""
    count = len(depths_mm)
    time = np.arange(samples) / acquisition.sampling_hz
    centre = acquisition.transducer_hz
    skin = 2e-3 * acquisition.forerun_length_mm / acquisition.forerun_speed_m_s if acquisition.forerun_length_mm else 0.0
    skin *= 1 + warm
    contact = np.ones(count, dtype=bool) if contact is None else contact
    bone = np.ones(count, dtype=bool) if bone is None else bone
    lines = np.zeros((count, samples))

    def add(line, at_s, height):
        first, last = (int((at_s + edge) * acquisition.sampling_hz) for edge in (-3 / centre, 12 / centre))
        first, last = max(first, 0), min(last, samples)
        if first < last:
            line[first:last] += height * wave(time[first:last] - at_s, centre)

    for index, depth in enumerate(depths_mm):
        line = lines[index]
        if skin:
            face = -matched if contact[index] else -1.0
            for bounce in (1, 2, 3):
                add(line, bounce * skin, face**bounce * 0.4 ** (bounce - 1))
        if contact[index]:
            arrival = skin + 2e-3 * depth / SPEED
            reach = depth if bone[index] else 40.0
            for z, amount in zip(rng.uniform(0.5, reach, int(reach * 6)), rng.normal(0, 0.004, int(reach * 6))):
                add(line, skin + 2e-3 * z / SPEED, amount)
            add(line, skin + 2e-3 * 0.55 * depth / SPEED, galea)
            if bone[index]:
                add(line, arrival, 0.5)
                add(line, arrival + 2e-3 * 5.5 / 3000, -0.12)
        line += rng.normal(0, 0.5 * 10 ** (-snr_db / 20), samples)
    points = np.arange(count) if points is None else points
    places = rng.uniform(-60, 60, (points.max() + 1, 3))[points]
    return Recording(
        lines=np.round(6000 * lines).astype(np.int16),
        acquisition=acquisition,
        probe_to_reference=rigid_from_vector(rng.uniform(-2, 2, (points.max() + 1, 3))[points], places),
        statuses=("OK",) * count,
        timestamps_s=np.arange(count) / 50,
        palpation_points=points,
    )


SET_UPS = {
    "5 MHz, polystyrene": Acquisition(60e6, 5e6, 23.0, 2340.0),
    "3 MHz, coarse sampling": Acquisition(25e6, 3e6, 23.0, 2340.0),
    "10 MHz, aqualene": Acquisition(62.5e6, 10e6, 16.0, 1616.0),
    "7 MHz, no forerun": Acquisition(100e6, 7e6),
}


@pytest.mark.parametrize("acquisition", SET_UPS.values(), ids=SET_UPS.keys())
@pytest.mark.parametrize("wave", [pulse, onset_pulse])
def test_bone_is_found_to_a_tenth_of_a_millimetre_on_textbook_lines(acquisition, wave):
    rng = np.random.default_rng(1)
    depths = rng.uniform(2.5, 14, 40)
    samples = int(48e-6 * acquisition.sampling_hz)
    lines = measure_lines(record(rng, depths, acquisition, wave=wave, samples=samples), EchoSettings(speed_of_sound_m_s=SPEED))
    errors = (lines.depths_mm - depths)[lines.accepted]
    assert lines.accepted.mean() > 0.9
    assert np.abs(errors).max() < 0.1


def test_warm_forerun_moves_nothing():
    rng = np.random.default_rng(2)
    depths = rng.uniform(3, 12, 30)
    recording = record(rng, depths, SET_UPS["5 MHz, polystyrene"], warm=0.015)
    lines = measure_lines(recording, EchoSettings(speed_of_sound_m_s=SPEED))
    assert np.abs(np.median((lines.depths_mm - depths)[lines.accepted])) < 0.02


def test_probe_in_air_and_tissue_without_bone_give_no_points():
    rng = np.random.default_rng(3)
    depths = rng.uniform(3, 12, 60)
    kind = np.arange(60) % 3
    recording = record(rng, depths, SET_UPS["5 MHz, polystyrene"], contact=kind != 0, bone=kind != 1)
    lines = measure_lines(recording, EchoSettings(speed_of_sound_m_s=SPEED))
    assert not lines.accepted[kind == 0].any()
    assert not lines.accepted[kind == 1].any()
    assert lines.accepted[kind == 2].mean() > 0.9
    assert "no contact" in {lines.reasons[index] for index in np.flatnonzero(kind == 0)}


def test_second_echo_of_a_face_in_air_is_no_bone_where_a_matched_face_shows_none_in_contact():
    """It lies where the neighbours see bone, and is as strong: only that the face's own echo is there at all tells it."""
    rng = np.random.default_rng(5)
    acquisition = SET_UPS["5 MHz, polystyrene"]
    again_mm = acquisition.forerun_length_mm / acquisition.forerun_speed_m_s * SPEED
    contact = np.arange(60) % 10 < 7
    depths = np.where(np.arange(60) < 30, again_mm + 0.25, 8.0) + rng.normal(0, 0.03, 60)
    recording = record(rng, depths, acquisition, contact=contact, points=np.arange(60) // 10, matched=0.01)
    found = measure_lines(recording, EchoSettings(speed_of_sound_m_s=SPEED))
    assert not found.accepted[~contact].any()
    assert {found.reasons[index] for index in np.flatnonzero(~contact)} == {"no contact"}
    assert found.accepted[contact].mean() > 0.9


def test_bone_is_only_looked_for_between_the_depths_that_are_set():
    rng = np.random.default_rng(6)
    depths = np.where(np.arange(40) % 2 == 0, 5.0, 9.0) + rng.normal(0, 0.05, 40)
    recording = record(rng, depths, SET_UPS["5 MHz, polystyrene"])
    deep = depths > 7
    whole = measure_lines(recording, EchoSettings(speed_of_sound_m_s=SPEED))
    assert whole.accepted.mean() > 0.9
    cut = measure_lines(recording, EchoSettings(speed_of_sound_m_s=SPEED, most_depth_mm=7.0))
    assert cut.accepted[~deep].mean() > 0.9
    assert not (cut.accepted & deep).any()
    assert not (cut.depths_mm > 7.1).any()
    assert set(np.array(cut.reasons)[deep]) <= {"no echo", "unstable", "tilt too large"}


def test_depth_scales_with_the_speed_of_sound():
    rng = np.random.default_rng(4)
    recording = record(rng, rng.uniform(4, 12, 20), SET_UPS["5 MHz, polystyrene"])
    slow = measure_lines(recording, EchoSettings(speed_of_sound_m_s=1450.0))
    fast = measure_lines(recording, EchoSettings(speed_of_sound_m_s=1595.0))
    both = slow.accepted & fast.accepted
    assert both.mean() > 0.8
    assert fast.depths_mm[both] / slow.depths_mm[both] == pytest.approx(np.full(both.sum(), 1.1), abs=2e-3)


def test_frame_without_a_good_pose_never_becomes_a_point():
    rng = np.random.default_rng(5)
    recording = record(rng, np.full(8, 6.0), SET_UPS["5 MHz, polystyrene"])
    poses = recording.probe_to_reference.copy()
    poses[[1, 2, 3, 4]] = np.nan
    statuses = ("OK", "MISSING", "INVALID", "OUT_OF_VIEW", "OK", "INVALID", "REQ_TIMEOUT", "OK")
    lines = measure_lines(replace(recording, probe_to_reference=poses, statuses=statuses))
    assert lines.accepted.tolist() == [True, False, False, False, False, False, False, True]
    assert lines.reasons[1:7] == (
        "pose missing", "pose invalid", "pose out of view", "pose missing", "pose invalid", "pose invalid"
    )  # fmt: skip
    assert np.isnan(lines.positions_mm[1:7]).all()
    assert np.isfinite(lines.depths_mm).all()  # the echo is seen all the same


def test_position_lies_on_the_beam_behind_forerun_and_tissue():
    rng = np.random.default_rng(6)
    recording = record(rng, np.array([5.0, 9.0]), SET_UPS["5 MHz, polystyrene"])
    lines = measure_lines(recording)
    for pose, position, depth in zip(recording.probe_to_reference, lines.positions_mm, lines.depths_mm):
        assert (np.linalg.inv(pose) @ [*position, 1])[:3] == pytest.approx([0, 0, 23.0 + depth])


def test_clipped_echo_is_refused_as_saturated():
    rng = np.random.default_rng(7)
    recording = record(rng, np.full(6, 6.0), SET_UPS["5 MHz, polystyrene"])
    loud = np.clip(recording.lines.astype(int) * 40, -2048, 2047).astype(np.int16)
    lines = measure_lines(replace(recording, lines=loud))
    assert set(lines.reasons) == {"saturated"}


def test_one_line_alone_is_measured():
    rng = np.random.default_rng(8)
    recording = record(rng, np.array([7.0]), SET_UPS["5 MHz, polystyrene"])
    lines = measure_lines(recording, EchoSettings(speed_of_sound_m_s=SPEED))
    assert lines.depths_mm[0] == pytest.approx(7.0, abs=0.1)
    assert lines.covariances_mm2[0] == pytest.approx(lines.covariances_mm2[0].T)
    assert np.linalg.eigvalsh(lines.covariances_mm2[0]).min() > 0


def test_stated_deviation_of_the_depth_matches_the_scatter():
    rng = np.random.default_rng(9)
    depths = rng.uniform(3, 12, 200)
    recording = record(rng, depths, SET_UPS["5 MHz, polystyrene"], snr_db=18.0, galea=0.0)
    lines = measure_lines(recording, EchoSettings(speed_of_sound_m_s=SPEED))
    z = ((lines.depths_mm - depths) / lines.depth_sds_mm)[lines.accepted]
    assert 0.6 < 1.4826 * np.median(np.abs(z - np.median(z))) < 1.6


def test_empty_and_silent_lines_give_no_points_and_no_warning(recwarn):
    acquisition = SET_UPS["5 MHz, polystyrene"]
    recording = record(np.random.default_rng(10), np.full(3, 6.0), acquisition)
    lines = measure_lines(replace(recording, lines=np.zeros_like(recording.lines)))
    assert not lines.accepted.any()
    short = measure_lines(replace(recording, lines=recording.lines[:, :50]))
    assert not short.accepted.any()
    nothing = replace(
        recording, lines=recording.lines[:0], probe_to_reference=recording.probe_to_reference[:0], statuses=(),
        timestamps_s=recording.timestamps_s[:0], palpation_points=recording.palpation_points[:0],
    )  # fmt: skip
    assert len(measure_lines(nothing)) == 0
    assert not recwarn.list


def test_recording_of_poses_only_is_refused_by_name():
    recording = record(np.random.default_rng(11), np.full(3, 6.0), SET_UPS["5 MHz, polystyrene"])
    with pytest.raises(InputError, match="no RF samples"):
        measure_lines(replace(recording, lines=recording.lines[:, :0]))


def test_stays_end_where_the_probe_jumps_or_the_point_changes():
    recording = record(
        np.random.default_rng(12), np.full(6, 6.0), SET_UPS["5 MHz, polystyrene"], points=np.array([0, 0, 1, 1, 1, 2])
    )
    poses = recording.probe_to_reference.copy()
    poses[4, :3, 3] += 20
    assert stays(replace(recording, probe_to_reference=poses)).tolist() == [0, 0, 1, 1, 2, 3]


def test_glide_of_centimetres_and_a_jump_are_several_spots_but_a_tremor_is_one():
    recording = record(np.random.default_rng(12), np.full(6, 6.0), SET_UPS["5 MHz, polystyrene"], points=np.zeros(6, dtype=int))
    poses = recording.probe_to_reference.copy()
    assert not several_spots(recording, stays(recording))
    poses[:, 0, 3] += 3.0 * np.arange(6)
    glide = replace(recording, probe_to_reference=poses)
    assert stays(glide).max() == 0
    assert several_spots(glide, stays(glide))
    assert several_spots(recording, np.array([0, 0, 1, 1, 2, 2]))


@pytest.mark.parametrize("depth", [3.0, 9.0, 12.5])  # 14.7 is where this forerun repeats
def test_scalp_of_one_depth_everywhere_is_no_artefact(depth):
    rng = np.random.default_rng(13)
    recording = record(rng, np.full(25, depth), SET_UPS["5 MHz, polystyrene"])
    lines = measure_lines(recording, EchoSettings(speed_of_sound_m_s=SPEED))
    assert lines.accepted.mean() > 0.9
    assert np.abs(lines.depths_mm[lines.accepted] - depth).max() < 0.1


def test_calibrated_quality_rises_with_the_likelihoods():
    quality = learnt().quality
    likelihood, stated = quality.stated, quality.right
    assert likelihood[0] == stated[0] == 0
    assert likelihood[-1] == 1
    assert (np.diff(likelihood) > 0).all()
    assert (np.diff(stated) >= 0).all()
    assert 0.99 < stated[-1] <= 1
    assert (np.diff(quality.probability(np.linspace(0, 1, 1001))) >= 0).all()


def test_quality_is_mapped_by_the_likelihood_that_is_given():
    recording = record(np.random.default_rng(12), np.full(12, 6.0), SET_UPS["5 MHz, polystyrene"])
    halved = replace(learnt(), quality=Calibration(np.array([0.0, 1.0]), np.array([0.0, 0.5])))
    straight = replace(learnt(), quality=Calibration(np.array([0.0, 1.0]), np.array([0.0, 1.0])))
    one, other = (measure_lines(recording, likelihood=likelihood).qualities for likelihood in (halved, straight))
    assert one == pytest.approx(other / 2)


@pytest.mark.parametrize("snr_db", [25.0, 45.0, 60.0])
def test_lone_clear_echo_is_taken_in_most_lines_however_quiet_they_are(snr_db):
    rng = np.random.default_rng(14)
    time = np.arange(1500) / 50e6 - 2e-3 * 6.0 / SPEED
    lines = 8000 * (pulse(time, 5e6) + rng.normal(0, 10 ** (-snr_db / 20), (30, len(time))))
    recording = record(rng, np.full(30, 6.0), Acquisition(50e6, 5e6), samples=1500, points=np.zeros(30, dtype=int))
    measured = measure_lines(replace(recording, lines=lines.astype(np.int16)), EchoSettings(speed_of_sound_m_s=SPEED))
    assert measured.accepted.mean() > 0.75


def test_lines_are_measured_on_one_thread_and_leave_the_other_cores_alone():
    rng = np.random.default_rng(15)
    few = record(rng, np.full(10, 6.0), Acquisition(50e6, 5e6), samples=600, points=np.zeros(10, dtype=int))
    index = np.arange(1500) % 10
    recording = Recording(
        few.lines[index], few.acquisition, few.probe_to_reference[index], ("OK",) * 1500, np.arange(1500) / 50, 0 * index
    )
    measure_lines(recording)  # threads of what ran before come to rest
    own, all_threads = time.thread_time(), time.process_time()
    measure_lines(recording)
    own, all_threads = time.thread_time() - own, time.process_time() - all_threads
    assert all_threads < 1.3 * own


def test_what_lies_far_along_a_glide_says_nothing_about_a_line(monkeypatch):
    monkeypatch.setattr(likelihood, "STRETCH", 24)
    monkeypatch.setattr(likelihood, "AROUND", 4)
    rng, set_up, count, near = np.random.default_rng(12), SET_UPS["5 MHz, polystyrene"], 90, 24
    # a scalp that differs along the way: what is alike everywhere, to a hundredth of a millimetre, would be an echo of the probe
    depths, one_spot = 7.0 + 0.3 * np.sin(np.arange(count) / 5), np.zeros(count, dtype=int)
    glide = rigid_from_vector(np.zeros((count, 3)), np.arange(count)[:, None] * np.array([0.5, 0, 0]))
    bone, no_bone = (record(rng, depths, set_up, snr_db=14.0, bone=one_spot == where, points=one_spot) for where in (0, 1))
    seen = replace(bone, probe_to_reference=glide, palpation_points=one_spot - 1)
    lost = replace(seen, lines=np.where(np.arange(count)[:, None] < 2 * near, seen.lines, no_bone.lines))
    fine = replace(learnt(), quality=replace(learnt().quality, doubtful=float("nan")))
    first, second = (measure_lines(one, EchoSettings(speed_of_sound_m_s=SPEED), fine) for one in (seen, lost))
    np.testing.assert_allclose(first.qualities[:near], second.qualities[:near], atol=1e-9)
    assert second.qualities[-near:].max() < 0.5
    assert first.qualities[-near:].min() > 0.5
