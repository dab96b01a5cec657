"""Faults on demand: their names, their numbers, and that they strike as often as asked."""

from __future__ import annotations

import pytest
from CranioNavLib.errors import InputError
from ModuleTrackingLib.ndi.emulator.faults import FAULTS, Faults
from ModuleTrackingLib.ndi.emulator.station import make_faults


@pytest.mark.parametrize("name", FAULTS)
def test_every_fault_can_be_switched_on_by_its_name_alone(name):
    assert name in make_faults([name]).active


def test_numbers_are_taken_in_both_spellings_and_filled_up_with_defaults():
    faults = make_faults(["disconnect=5:1", "delays:0.3", "byte-loss=0"])
    assert faults.active == {"disconnect": (5.0, 1.0), "delays": (0.3, 0.5), "byte-loss": (0.0,)}
    faults.switch_off("delays")
    assert "delays" not in faults.active
    faults.switch_off()
    assert not faults.active


@pytest.mark.parametrize(
    ("spec", "message"),
    [
        ("gremlins", "unknown fault 'gremlins'; known: byte-loss"),
        ("byte-loss=2", "between 0 and 1"),
        ("byte-loss=x", "takes share of replies"),
        ("byte-loss=-1", "takes share of replies"),
        ("disconnect=1:2:3", "seconds between"),
        ("bumped=1", "takes no numbers"),
    ],
)
def test_faults_that_cannot_be_understood_are_refused(spec, message):
    with pytest.raises(InputError, match=message):
        Faults().switch_on(spec)


@pytest.mark.parametrize("name", ["byte-loss", "bit-errors", "truncate", "silence", "stray-bytes"])
def test_faults_of_the_line_strike_as_often_as_asked(name):
    faults, reply = make_faults([f"{name}=0.25"], seed=1), bytes(range(100))
    struck = sum(faults.spoil(reply) != (0.0, reply) for _ in range(2000))
    assert 400 < struck < 600  # binomial: 500 +- 5 standard deviations of 19


def test_without_faults_nothing_is_spoilt():
    faults = Faults()
    assert all(faults.spoil(b"reply") == (0.0, b"reply") for _ in range(50))


def test_late_replies_are_as_late_as_asked():
    faults = make_faults(["delays=1:0.7"])
    assert faults.spoil(b"reply") == (0.7, b"reply")


def test_tools_are_affected_for_windows_of_time_and_independently():
    faults = make_faults(["missing=0.5"])
    pattern = {tool: [faults.tool_has("missing", tool, 0.5 * window + 0.1) for window in range(400)] for tool in "AB"}
    assert all(faults.tool_has("missing", "A", 0.5 * w + 0.4) == seen for w, seen in enumerate(pattern["A"]))
    for seen in pattern.values():
        assert 140 < sum(seen) < 260
    assert 120 < sum(a != b for a, b in zip(pattern["A"], pattern["B"])) < 280


def test_cable_and_power_fail_on_schedule():
    faults = make_faults(["disconnect=10:2", "brown-out=4"])
    assert [faults.cable_out(time) for time in (0.0, 9.9, 10.1, 11.9, 12.1, 22.1)] == [False, False, True, True, False, True]
    assert [faults.brown_outs(time) for time in (0.0, 3.9, 4.1, 12.5)] == [0, 0, 1, 3]
