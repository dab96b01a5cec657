"""Typed parameters in a node of the scene: checked on both ways, restored with a saved scene."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum
from typing import Annotated, Optional

import pytest
from CranioNavLib import host, scene
from CranioNavLib.errors import InputError
from CranioNavLib.parameter_node import ParameterNode
from CranioNavLib.parameters import Limits, Parameters
from CranioNavLib.slicer_files import load_scene, save_scene
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st


class Side(str, Enum):
    LEFT = "left"
    RIGHT = "right"


@dataclass(frozen=True)
class Wanted(Parameters):
    rate_hz: Annotated[float, Limits(0, 1000), "rate"] = 60.0
    count: Annotated[int, Limits(-5, 5), "count"] = 1
    name: Annotated[str, "name"] = "default"
    side: Annotated[Side, "side"] = Side.LEFT
    on: Annotated[bool, "on"] = True
    limit_s: Annotated[Optional[float], Limits(0, 10), "limit"] = 2.5


@pytest.fixture
def a_door():
    host.scene().Clear(False)
    yield ParameterNode(scene.find_or_create("TrackingSession"), Wanted)
    host.scene().Clear(False)


def test_an_empty_node_gives_the_defaults(a_door):
    assert a_door.read() == Wanted()


wanted = st.builds(
    Wanted,
    rate_hz=st.floats(0, 1000),
    count=st.integers(-5, 5),
    name=st.text(st.characters(codec="utf-8", exclude_categories=("Cs", "Cc")), max_size=20),
    side=st.sampled_from(Side),
    on=st.booleans(),
    limit_s=st.none() | st.floats(0, 10),
)


@settings(max_examples=50, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(wanted)
def test_any_parameters_come_back_to_the_bit(a_door, parameters):
    a_door.write(parameters)
    assert a_door.read() == parameters


@pytest.mark.parametrize("name", ["", "(none)", 'a|b;c:d ^ "quoted" <tag> & 100 %20 ü\\'])
def test_a_saved_scene_restores_them(a_door, tmp_path, name):
    parameters = Wanted(rate_hz=1 / 3, name=name, side=Side.RIGHT, on=False, limit_s=None)
    a_door.write(parameters)
    save_scene(tmp_path / "s.mrb")
    load_scene(tmp_path / "s.mrb")
    assert ParameterNode(scene.find("TrackingSession"), Wanted).read() == parameters


def test_a_change_is_checked_before_anything_is_stored(a_door):
    a_door.change(count=2)
    with pytest.raises(InputError, match="count is 9; expected -5 to 5"):
        a_door.change(count=9, on=False)
    assert a_door.read() == Wanted(count=2)


def test_a_node_with_nonsense_is_refused_by_its_name(a_door):
    a_door.node.SetName("Session of Tuesday")
    a_door.node.SetParameter("count", "many")
    with pytest.raises(InputError, match=r"Session of Tuesday.*count"):
        a_door.read()
    a_door.reset()
    assert a_door.read() == Wanted()


def test_sets_with_prefixes_do_not_touch_each_other(a_door):
    other = ParameterNode(a_door.node, Wanted, "tracker.simulated.")
    other.change(count=4)
    assert a_door.read() == Wanted()
    assert other.read().count == 4


def test_a_write_of_many_fields_is_heard_of_once(a_door):
    heard = []
    observation = a_door.observe(heard.append)
    a_door.write(Wanted(count=3, on=False, name="x"))
    assert heard == [Wanted(count=3, on=False, name="x")]
    observation.stop()
    a_door.change(count=0)
    assert len(heard) == 1
