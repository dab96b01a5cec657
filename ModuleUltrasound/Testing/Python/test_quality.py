import numpy as np
import pytest
from CranioNavLib.rigid import rigid_from_vector
from CranioNavLib.sequence_metafile import Acquisition, Recording
from ModuleUltrasoundLib.measurement.quality import (
    choose,
    clipped_share,
    converter_limits,
    lost_contact,
    quality_of,
    reasons_of,
    unstable,
)


def a_recording(count=20, lines=None, statuses=None):
    poses = np.tile(rigid_from_vector([0.0, 0, 0], [0.0, 0, 0]), (count, 1, 1))
    lines = np.zeros((count, 600), dtype=np.int16) if lines is None else lines
    return Recording(
        lines, Acquisition(60e6, 5e6), poses, statuses or ("OK",) * count, np.arange(count) / 50, np.zeros(count, dtype=np.int64)
    )


def test_quality_adds_up_echoes_within_the_tolerance_and_the_timing():
    depth = np.array([[6.0, 6.3, 9.0, np.nan]])
    chance = np.array([[0.6, 0.2, 0.1, 0.0]])
    assert quality_of(depth, np.array([0]), chance, np.array([0.01]))[0] == pytest.approx(0.8)
    assert quality_of(depth, np.array([0]), chance, np.array([0.5]))[0] == pytest.approx(0.8 * 0.6827, abs=1e-4)
    assert quality_of(depth, np.array([3]), chance, np.array([0.1]))[0] == 0


def test_only_a_converters_ends_count_as_clipped():
    wave = 2000 * np.sin(2 * np.pi * 5e6 * np.arange(600) / 60e6)
    calm, loud = np.tile(wave, (2, 1)).astype(np.int16), np.clip(3 * wave, -2048, 2047).astype(np.int16)[None].repeat(2, 0)
    assert converter_limits(calm)[1] > 32767
    assert converter_limits(loud) == (-2048, 2047)
    at = np.full(2, 5e-6)
    assert clipped_share(a_recording(2, calm), at).max() == 0
    assert clipped_share(a_recording(2, loud), at).min() > 0.3
    assert clipped_share(a_recording(2, loud), np.full(2, np.nan)).max() == 0


def test_jump_of_the_depth_under_a_resting_probe_is_unstable():
    depth = np.full(20, 7.0)
    depth[8] = 4.5
    good = np.ones(20, dtype=bool)
    assert np.flatnonzero(unstable(a_recording(), depth, good, np.zeros(20, dtype=int))).tolist() == [8]


def test_depths_that_share_nothing_are_no_instability():
    """A recording whose poses never change, of lines from everywhere: no neighbour tells what another should show."""
    depth = np.random.default_rng(2).uniform(2, 15, 20)
    assert not unstable(a_recording(), depth, np.ones(20, dtype=bool), np.zeros(20, dtype=int)).any()


def test_pressing_is_no_instability():
    recording = a_recording()
    press = np.linspace(0, 1.9, 20)
    recording.probe_to_reference[:, 2, 3] = press
    assert not unstable(recording, 8.0 - press, np.ones(20, dtype=bool), np.zeros(20, dtype=int)).any()


def reasons(**values):
    given = {
        "quality": 0.2, "clipped": False, "shaky": False, "depth_mm": 6.0, "line_snr_db": 30.0, "strength_db": 0.0,
        "forerun_db": 0.0, "likely": 0.5, "lifted": False, "status": "OK", **values,
    }  # fmt: skip
    one = {name: np.array([value]) for name, value in given.items() if name != "status"}
    return reasons_of(a_recording(1, statuses=(given["status"],)), gate=0.8, **one)[0]


@pytest.mark.parametrize(
    ("values", "reason"),
    [
        ({"quality": 0.9}, ""),
        ({"quality": 0.9, "status": "MISSING"}, "pose missing"),
        ({"quality": 0.9, "status": "OUT_OF_VIEW"}, "pose out of view"),
        ({"quality": 0.9, "status": "REQ_TIMEOUT"}, "pose invalid"),
        ({"quality": 0.9, "clipped": True}, "saturated"),
        ({"quality": 0.0, "clipped": True, "lifted": True}, "no contact"),
        ({"quality": 0.9, "shaky": True}, "unstable"),
        ({"forerun_db": 12.0}, "no contact"),
        ({"strength_db": -12.0}, "tilt too large"),
        ({"quality": 0.99, "strength_db": -15.0}, "tilt too large"),
        ({"depth_mm": np.nan, "likely": 0.0}, "no echo"),
        ({"line_snr_db": 9.0}, "no echo"),
        ({}, "doubtful echo"),
    ],
)
def test_each_refusal_has_its_reason(values, reason):
    assert reasons(**values) == reason


def test_face_far_above_that_of_the_lines_with_bone_is_in_air():
    face, good = np.array([1.0, 1.1, 0.9, 5.0, 2.0, 2.0]), np.array([True, True, True, True, True, False])
    again = np.array([0.0, 0.0, 0.0, 0.0, 0.9, 0.1])
    assert lost_contact(face, again, good).tolist() == [False, False, False, True, True, False]
    assert not lost_contact(face, again, np.zeros(6, dtype=bool)).any(), "nobody knows how strong it is in contact"
    assert not lost_contact(np.zeros(6), np.zeros(6), good).any(), "there is no forerun"


def test_bone_that_is_seen_only_where_the_face_repeats_is_the_face():
    again, good = np.array([1.0, 0.9, 1.0, 0.1, 1.0]), np.array([True, True, True, False, False])
    assert lost_contact(np.full(5, 3.0), again, good).tolist() == [True, True, True, False, False]
    elsewhere = np.concatenate([again, np.zeros(3)])
    assert not lost_contact(np.full(8, 3.0), elsewhere, np.ones(8, dtype=bool)).any(), "three lines show contact"


def test_echoes_side_by_side_count_together_when_the_bone_is_chosen():
    depth = np.array([[3.1, 9.0, 3.3, 3.4], [3.1, 9.0, 6.0, np.nan]])
    chance = np.array([[0.2, 0.35, 0.25, 0.15], [0.3, 0.35, 0.2, 0.0]])
    assert choose(depth, chance).tolist() == [2, 1]


def test_few_lines_of_a_trigger_that_jumps_show_no_contact():
    again = np.concatenate([np.ones(36), np.zeros(4)])
    lifted = lost_contact(np.full(40, 3.0), again, np.ones(40, dtype=bool))
    assert lifted.tolist() == [True] * 36 + [False] * 4
