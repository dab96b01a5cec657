"""Palpation: a point is taken when the probe rests and the echo is good, and at no other time."""

from __future__ import annotations

import numpy as np
import pytest
from CranioNavLib.errors import InputError
from hypothesis import given, settings
from hypothesis import strategies as st
from ModuleUltrasoundLib.measurement.measure import LineMeasurements
from ModuleUltrasoundLib.palpation.palpation import (
    Palpation,
    PalpationLine,
    PalpationSettings,
    PalpationState,
    Sweep,
    lines_of,
    to_bone_points,
)

LABELS = ("A", "B", "C")


def a_line(time_s: float, place=(0.0, 0.0, 0.0), quality: float = 0.95, accepted: bool = True, reason: str = "", frame: int = -1):
    return PalpationLine(
        time_s=time_s,
        accepted=accepted,
        quality=quality,
        reason=reason,
        position_mm=np.asarray(place, dtype=float),
        covariance_mm2=np.eye(3) * 0.04,
        beam=np.array([0.0, 0.0, -1.0]),
        depth_mm=5.0,
        frame=frame,
    )


def rest(palpation: Palpation, place, start_s: float, seconds: float = 0.6, rate_hz: float = 20.0, **more):
    """Lines from a probe at rest; the status after each."""
    rng = np.random.default_rng(0)
    times = start_s + np.arange(round(seconds * rate_hz) + 1) / rate_hz
    return [palpation.add(a_line(t, np.asarray(place) + rng.normal(size=3) * 0.1, **more)) for t in times]


def test_a_good_dwell_of_half_a_second_is_a_point_and_the_next_begins():
    palpation = Palpation(LABELS)
    states = rest(palpation, (0, 0, 0), 0.0)
    taken = [k for k, status in enumerate(states) if status.new_point]
    assert taken == [10]  # half a second at 20 lines a second
    assert states[9].state is PalpationState.DWELLING
    assert states[9].dwell == pytest.approx(0.9)
    point = states[10].new_point
    assert (point.target, point.label, point.lines) == (0, "A", 11)
    assert point.spread_mm == pytest.approx(0.1 * np.sqrt(3), rel=0.5)
    assert palpation.target == 1
    assert (states[10].taken, states[10].total) == (1, 3)


def test_the_best_line_of_the_dwell_is_kept():
    palpation = Palpation(LABELS)
    for k in range(11):
        palpation.add(a_line(k * 0.05, quality=0.99 if k == 4 else 0.9, frame=k))
    assert palpation.taken[0].line.frame == 4


def test_among_equally_sure_lines_the_middle_one_is_kept():
    palpation = Palpation(LABELS)
    for k in range(11):
        palpation.add(a_line(k * 0.05, (0.4 * np.sign(k - 5), 0, 0), frame=k))
    assert palpation.taken[0].line.frame == 5


@pytest.mark.parametrize(
    ("bad", "reason"),
    [
        ({"accepted": False, "reason": "no contact"}, "no contact"),
        ({"accepted": False}, "not accepted"),
        ({"quality": 0.5}, "echo not sure enough"),
        ({"place": (np.nan, 0, 0)}, "pose missing"),
    ],
)
def test_lines_that_are_not_good_never_make_a_point_and_say_why(bad, reason):
    palpation = Palpation(LABELS)
    for k in range(100):
        status = palpation.add(a_line(k * 0.05, **bad))
        assert status.reason == reason
        assert status.state is PalpationState.WAITING
    assert palpation.taken == ()


def test_a_moving_probe_makes_no_point():
    palpation = Palpation(LABELS)
    for k in range(200):
        assert palpation.add(a_line(k * 0.05, (k * 0.5, 0, 0))).new_point is None  # 10 mm/s


def test_a_gap_begins_the_dwell_anew():
    palpation = Palpation(LABELS)
    rest(palpation, (0, 0, 0), 0.0, seconds=0.4)
    states = rest(palpation, (0, 0, 0), 0.8, seconds=0.4)
    assert not any(status.new_point for status in states)
    assert states[0].dwell == 0.0


@pytest.mark.parametrize("interval_s", [0.025, 0.3, 0.8])
def test_a_slow_devices_lines_are_no_gaps(interval_s):
    palpation = Palpation(LABELS)
    taken = [k for k in range(40) if palpation.add(a_line(10 + k * interval_s)).new_point]
    assert taken == [max(3, round(0.5 / interval_s))]
    fresh = Palpation(LABELS)
    for k in range(3):
        fresh.add(a_line(k * interval_s))
    for k in range(20):  # the echo is lost for a while
        fresh.add(a_line((3 + k) * interval_s, accepted=False, reason="no echo"))
    assert fresh.add(a_line(23 * interval_s)).dwell == 0.0


def test_single_bad_lines_do_not_break_a_dwell():
    palpation = Palpation(LABELS)
    for k in range(11):
        palpation.add(a_line(k * 0.05, accepted=k % 3 != 2, reason="no echo"))
    assert len(palpation.taken) == 1
    assert palpation.refused == {"no echo": 3}


def test_few_lines_are_not_a_dwell_however_long():
    palpation = Palpation(LABELS)
    for k in range(3):
        assert palpation.add(a_line(k * 0.25)).new_point is None
    assert palpation.add(a_line(0.75)).new_point is not None


def test_the_place_just_taken_is_not_taken_again():
    palpation = Palpation(LABELS)
    states = rest(palpation, (0, 0, 0), 0.0, seconds=3.0)
    assert sum(status.new_point is not None for status in states) == 1
    assert states[-1].reason == "too near to A"
    assert any(status.new_point for status in rest(palpation, (20, 0, 0), 4.0))


def test_a_point_away_from_its_target_is_refused_until_the_probe_is_there():
    palpation = Palpation(LABELS)
    palpation.aim(1, np.array([50.0, 0, 0]))
    assert rest(palpation, (0, 0, 0), 0.0)[-1].reason == "away from the target"
    states = rest(palpation, (45.0, 5, 0), 2.0)
    assert [status.new_point.label for status in states if status.new_point] == ["B"]
    assert palpation.target == 2


def test_every_point_once_then_done():
    palpation = Palpation(LABELS)
    for k in range(3):
        status = rest(palpation, (30.0 * k, 0, 0), 2.0 * k)[-1]
    assert status.state is PalpationState.DONE
    assert palpation.target is None
    assert [point.label for point in palpation.taken] == list(LABELS)
    assert palpation.add(a_line(99.0, (90, 0, 0))).reason == "every point is taken"


def test_undo_returns_to_the_last_point():
    palpation = Palpation(LABELS)
    for k in range(3):
        rest(palpation, (30.0 * k, 0, 0), 2.0 * k)
    assert palpation.undo().label == "C"
    assert palpation.target == 2
    assert palpation.open_points == [False, False, True]
    rest(palpation, (70.0, 0, 0), 20.0)
    assert palpation.taken[-1].label == "C"
    for _ in range(3):
        palpation.undo()
    assert palpation.undo() is None
    assert palpation.target == 0


def test_a_line_taken_before_its_point_was_asked_for_is_not_its_point():
    palpation = Palpation(LABELS)
    rest(palpation, (0, 0, 0), 0.0, seconds=0.4)
    palpation.aim(1, asked_s=5.0)
    states = rest(palpation, (0, 0, 0), 4.3)
    assert {status.reason for status in states} == {"taken before the point was asked for"}
    assert states[-1].state is PalpationState.WAITING
    states = rest(palpation, (0, 0, 0), 4.9)
    assert [status.new_point.label for status in states if status.new_point] == ["B"]
    assert states[-1].new_point.lines == 11  # of 13


def test_asked_for_again_a_point_takes_lines_from_then_on():
    palpation = Palpation(LABELS)
    rest(palpation, (0, 0, 0), 0.0)
    palpation.undo()
    palpation.aim(0, asked_s=1.0)
    assert not any(status.new_point for status in rest(palpation, (0, 0, 0), 0.6, seconds=0.85))
    assert palpation.add(a_line(1.5)).new_point is not None


def test_points_that_do_not_exist_are_refused():
    with pytest.raises(InputError, match="no point 3 in a protocol of 3"):
        Palpation(LABELS).aim(3)
    with pytest.raises(InputError, match="no points to palpate"):
        Palpation(())


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 10_000))
def test_whatever_comes_a_taken_point_was_stable_and_good(seed):
    rng, palpation, lines = np.random.default_rng(seed), Palpation(LABELS), {}
    place = np.zeros(3)
    for k in range(300):
        place = place + rng.normal(size=3) * rng.choice([0.02, 1.0, 20.0], p=[0.9, 0.08, 0.02])
        lines[k] = a_line(k * 0.05, place, rng.choice([0.95, 0.2], p=[0.95, 0.05]), bool(rng.random() < 0.97), "no echo", k)
        status = palpation.add(lines[k])
        if status.reason:  # weak, or too near to a point taken before
            del lines[k]
        if point := status.new_point:
            dwell = [line for j, line in lines.items() if k - 10 <= j <= k]
            assert len(dwell) <= point.lines
            assert np.ptp([line.position_mm for line in dwell], axis=0).max() <= 2 * palpation.settings.stable_mm
            assert point.line.accepted
            assert point.line.quality >= 0.85
    assert len({point.target for point in palpation.taken}) == len(palpation.taken)


# Sweep


def test_a_sweep_is_thinned_to_an_even_density():
    sweep, rng = Sweep(PalpationSettings(sweep_spacing_mm=2.0)), np.random.default_rng(1)
    for k in range(4000):  # a slow wander over 40 x 40 mm, twenty times denser than wanted
        place = (20 + 20 * np.sin(0.004 * k), 20 + 20 * np.sin(0.0171 * k), rng.normal() * 0.1)
        sweep.add(a_line(k * 0.02, place, quality=rng.uniform(0.86, 1.0)))
    places = np.array([line.position_mm for line in sweep.lines])
    gaps = np.linalg.norm(places[:, None] - places[None], axis=2) + 1e3 * np.eye(len(places))
    assert gaps.min() >= 2.0
    nearest = gaps.min(axis=1)
    assert np.quantile(nearest, 0.9) < 4.0
    assert len(sweep) > 100
    assert sweep.refused["near a point already kept"] > 2000


def test_of_two_lines_in_one_place_the_surer_stays():
    sweep = Sweep()
    assert sweep.add(a_line(0.0, (0, 0, 0), 0.9, frame=0)) == ""
    assert sweep.add(a_line(0.1, (0.3, 0, 0), 0.99, frame=1)) == ""
    assert sweep.add(a_line(0.2, (0.6, 0, 0), 0.95, frame=2)) == "near a point already kept"
    assert [line.frame for line in sweep.lines] == [1]


def test_a_probe_that_is_too_fast_gives_no_points():
    sweep = Sweep()
    reasons = [sweep.add(a_line(0.05 * k, (10.0 * k, 0, 0))) for k in range(5)]  # 200 mm/s
    assert reasons == ["", *["probe too fast"] * 4]


@pytest.mark.parametrize("rate_hz", [40, 200, 1000])
def test_the_trackers_noise_is_not_taken_for_speed(rate_hz):
    sweep, rng = Sweep(), np.random.default_rng(rate_hz)
    for k in range(600):  # 40 mm/s; noise of a poor tracker
        sweep.add(a_line(k / rate_hz, np.array([40 * k / rate_hz, 0, 0]) + rng.normal(0, 0.35, 3)))
    assert sweep.refused["probe too fast"] == 0
    for k in range(rate_hz):
        sweep.add(a_line(10 + k / rate_hz, np.array([250 * k / rate_hz, 0, 0]) + rng.normal(0, 0.35, 3)))
    assert sweep.refused["probe too fast"] > 0.85 * rate_hz - 2


def test_lines_of_a_sweep_that_are_not_good_are_counted_by_reason():
    sweep = Sweep()
    sweep.add(a_line(0.0, accepted=False, reason="no contact"))
    sweep.add(a_line(0.1, quality=0.3))
    sweep.add(a_line(0.2, (np.nan, 0, 0)))
    assert len(sweep) == 0
    assert sweep.refused == {"no contact": 1, "echo not sure enough": 1, "pose missing": 1}


# To registration


def test_lines_become_bone_points_with_all_that_is_known():
    points = to_bone_points([a_line(0.0, (1, 2, 3)), a_line(1.0, (4, 5, 6))], ("A", "B"), 1500.0, 20.0)
    assert points.labels == ("A", "B")
    assert np.allclose(points.positions_mm, [[1, 2, 3], [4, 5, 6]])
    assert points.has_beam.all()
    assert points.at_speed(1515.0).positions_mm[0] == pytest.approx([1, 2, 3 - 5.0 * 0.01])
    with pytest.raises(InputError, match="palpate before registering"):
        to_bone_points([])


def test_measured_frames_become_lines():
    measured = LineMeasurements(
        depths_mm=np.array([5.0, np.nan]),
        depth_sds_mm=np.array([0.1, np.nan]),
        positions_mm=np.array([[1.0, 2, 3], [np.nan] * 3]),
        covariances_mm2=np.tile(np.eye(3), (2, 1, 1)),
        beam_directions=np.tile([0.0, 0, 1], (2, 1)),
        qualities=np.array([0.97, 0.0]),
        accepted=np.array([True, False]),
        reasons=("", "no echo"),
        alternative_depths_mm=np.empty((2, 0)),
        alternative_probabilities=np.empty((2, 0)),
        skin_times_s=np.zeros(2),
        speed_of_sound_m_s=1540.0,
        speed_of_sound_sd_m_s=52.0,
    )
    good, bad = lines_of(measured, [10.0, 10.1], first_frame=40)
    assert (good.accepted, good.quality, good.depth_mm, good.frame, good.time_s) == (True, 0.97, 5.0, 40, 10.0)
    assert (bad.accepted, bad.reason, bad.frame) == (False, "no echo", 41)
    with pytest.raises(InputError, match="one time for each of 2"):
        lines_of(measured, [1.0])
