"""A panel is data: descriptions are held to what exists, and one model does for every renderer."""

from __future__ import annotations

import threading
from dataclasses import dataclass
from enum import Enum
from typing import Annotated, Optional

import numpy as np
import pytest
from CranioNavLib import host, scene, scene_data
from CranioNavLib.errors import InputError
from CranioNavLib.host import ScriptedLoadableModuleLogic
from CranioNavLib.module_logic import ParametersInScene
from CranioNavLib.panel import (
    Action,
    Cancelled,
    Entry,
    FileField,
    Level,
    ListField,
    NodeField,
    Panel,
    ParameterField,
    Picture,
    PluginField,
    Progress,
    Reading,
    ReadOut,
    Step,
    StepState,
    StepStatus,
    Task,
    label_of,
)
from CranioNavLib.panel_model import PanelModel
from CranioNavLib.parameters import Limits, Parameters
from CranioNavLib.plugins import Plugin, PluginKind


class Fruit(str, Enum):
    APPLE = "apple"
    PEAR = "pear"


class Juicer(Plugin):
    """A plugin kind of this test's own."""


JUICERS = PluginKind("test-juicer", Juicer)


@JUICERS.register
class Press(Juicer):
    name = "press"

    @dataclass(frozen=True)
    class Settings(Parameters):
        force_mm: Annotated[float, Limits(0, 10), "how far it is pressed"] = 2.0


@JUICERS.register
class Blender(Juicer):
    name = "blender"

    @dataclass(frozen=True)
    class Settings(Parameters):
        speed: Annotated[int, Limits(1, 5), "speed"] = 1


@dataclass(frozen=True)
class KitchenParameters(Parameters):
    amount_mm: Annotated[float, Limits(0, 100), "how much"] = 5.0
    count: Annotated[int, Limits(0, 9), "how many"] = 3
    fruit: Annotated[Fruit, "which"] = Fruit.APPLE
    sweet: Annotated[bool, "with sugar"] = False
    path: Annotated[str, "where to"] = ""
    limit_s: Annotated[Optional[float], Limits(0, 10), "stop after"] = None
    juicer: Annotated[str, "how"] = "press"


class BrokenJuicerError(RuntimeError):
    """What a device of this test raises."""


class KitchenLogic(ParametersInScene, ScriptedLoadableModuleLogic):
    parameterClass = KitchenParameters
    sessionRole = "RegistrationSession"
    refusals = (BrokenJuicerError,)

    def squeeze(self):
        if self.parameters().read().amount_mm == 0:
            raise InputError("there is nothing to squeeze; take more")
        scene_data.set_transform("ReferenceToRas", np.eye(4))
        return "squeezed"

    def squeezeBlocked(self):
        return "" if self.parameters().read().count else "no fruit left"

    def explode(self):
        raise BrokenJuicerError("the juicer broke; buy another")

    def cook(self):
        def compute(progress: Progress):
            progress("cooking", 0.5)
            return 42, threading.current_thread().name

        return Task("Cook", compute, lambda found: f"{found[0]} glasses by {found[1]}")

    def stumble(self):
        def compute(progress: Progress):
            raise ZeroDivisionError("oops")

        return Task("Stumble", compute, lambda found: None)

    def sweetness(self):
        return Reading("sweet", Level.GOOD) if self.parameters().read().sweet else None

    def status(self):
        done = scene.find("ReferenceToRas") is not None
        return StepStatus(StepState.DONE if done else StepState.TODO, "" if done else "squeeze")


KITCHEN = Panel(
    module="Kitchen",
    title="Kitchen",
    parameters=KitchenParameters,
    steps=(
        Step(
            "first",
            "Squeeze",
            "Squeeze some fruit.",
            (
                ParameterField("amount_mm"),
                ParameterField("count", "How many"),
                ParameterField("fruit"),
                ParameterField("sweet"),
                ParameterField("limit_s"),
                FileField("path", "File", ("Juice (*.juice)",), save=True),
                PluginField("juicer", "Juicer", "test-juicer"),
                NodeField("TargetsCT", "Targets"),
                Action("squeeze", "Squeeze", primary=True),
                Action("explode", "Explode"),
                ReadOut("sweetness", "Sweetness", large=True),
            ),
            status="status",
        ),
        Step("second", "Cook", "", (Action("cook", "Cook"), Action("stumble", "Stumble"))),
    ),
)


@pytest.fixture
def a_model():
    host.scene().Clear(False)
    yield PanelModel(KITCHEN, KitchenLogic())
    host.scene().Clear(False)


def item(name):
    return next(found for found in KITCHEN.items() if getattr(found, "name", getattr(found, "role", "")) == name)


# The description


@pytest.mark.parametrize(
    ("wrong", "says"),
    [
        (Action("fly", "Fly"), "no method fly"),
        (ReadOut("height", "Height"), "no method height"),
        (ParameterField("colour"), "no parameter 'colour'"),
        (PluginField("juicer", "Juicer", "oven"), "no plugin kind oven"),
        (NodeField("Skull", "Skull"), "no role 'Skull'"),
    ],
)
def test_a_description_that_names_what_is_not_there_is_refused(wrong, says):
    panel = Panel("Kitchen", "Kitchen", KitchenParameters, (Step("one", "One", "", (wrong,)),))
    with pytest.raises(InputError, match=says):
        PanelModel(panel, KitchenLogic())


def test_a_name_given_twice_is_refused():
    panel = Panel("Kitchen", "", KitchenParameters, (Step("a", "A", "", (Action("cook", "1"), Action("cook", "2"))),))
    with pytest.raises(InputError, match="cook stands twice"):
        PanelModel(panel, KitchenLogic())


def test_a_label_is_made_of_the_parameters_name_without_its_unit():
    assert label_of(KITCHEN, item("amount_mm")) == "Amount"
    assert label_of(KITCHEN, item("count")) == "How many"


# The model


def test_an_edit_is_kept_in_the_scene(a_model):
    assert a_model.change(item("fruit"), Fruit.PEAR)
    assert a_model.value(item("fruit")) is Fruit.PEAR
    assert KitchenLogic().parameters().read().fruit is Fruit.PEAR


def test_a_refused_edit_says_why_and_changes_nothing(a_model):
    assert not a_model.change(item("amount_mm"), 500.0)
    assert "expected 0 to 100" in a_model.errors["amount_mm"]
    assert a_model.value(item("amount_mm")) == 5.0
    assert a_model.change(item("amount_mm"), 6.0)
    assert a_model.errors == {}


def test_each_plugin_keeps_settings_of_its_own(a_model):
    juicer = item("juicer")
    assert a_model.choices(juicer) == ["blender", "press"]
    assert a_model.change_setting(juicer, "force_mm", 4.0)
    assert a_model.change(juicer, "blender")
    assert a_model.settings(juicer).read() == Blender.Settings(speed=1)
    assert not a_model.change_setting(juicer, "speed", 9)
    assert "expected 1 to 5" in a_model.errors["juicer.speed"]
    assert a_model.change(juicer, "press")
    assert a_model.settings(juicer).read() == Press.Settings(force_mm=4.0)
    assert a_model.logic.createPlugin("test-juicer", "press").settings.force_mm == 4.0


def test_a_plugin_that_is_not_installed_is_an_error_beside_the_field(a_model):
    a_model.change(item("juicer"), "squasher")
    assert a_model.settings(item("juicer")) is None
    assert "unknown test-juicer 'squasher'" in a_model.errors["juicer"]


def test_an_action_does_its_work_and_says_so(a_model):
    assert a_model.run(item("squeeze"))
    assert scene.find("ReferenceToRas") is not None
    assert (a_model.message.text, a_model.message.level) == ("squeezed", Level.GOOD)
    assert a_model.status(KITCHEN.steps[0]).state is StepState.DONE


@pytest.mark.parametrize(
    ("name", "change", "says", "level"),
    [
        ("squeeze", {"count": 0}, "no fruit left", Level.WARNING),
        ("squeeze", {"amount_mm": 0.0}, "nothing to squeeze", Level.BAD),
        ("explode", {}, "the juicer broke", Level.BAD),
    ],
)
def test_an_action_that_cannot_be_done_says_why(a_model, name, change, says, level):
    a_model.logic.parameters().change(**change)
    assert not a_model.run(item(name))
    assert says in a_model.message.text
    assert a_model.message.level is level
    assert scene.find("ReferenceToRas") is None


def test_a_defect_in_an_action_is_not_hidden(a_model):
    with pytest.raises(ZeroDivisionError):
        a_model.run(item("stumble"))


class LaterRunner:
    """Keeps the work until the test says go, and does it in another thread."""

    def start(self, compute, finished):
        self.compute, self.finished = compute, finished

    def go(self):
        outcome = []

        def work():
            try:
                outcome.append(self.compute())
            except BaseException as error:
                outcome.append(error)

        thread = threading.Thread(target=work, name="worker")
        thread.start()
        thread.join()
        self.finished(outcome[0])


def test_long_work_runs_in_the_runner_and_blocks_other_actions_meanwhile(a_model):
    a_model.runner = runner = LaterRunner()
    assert a_model.run(item("cook"))
    assert a_model.busy is item("cook")
    assert a_model.blocked(item("squeeze")) == "Cook is still running"
    runner.go()
    assert a_model.busy is None
    assert a_model.message.text == "42 glasses by worker"
    assert a_model.progress.share == 0.5


def test_cancelled_work_frees_the_user_at_once_and_changes_nothing(a_model):
    a_model.runner = runner = LaterRunner()
    a_model.run(item("cook"))
    a_model.cancel()
    assert a_model.busy is None
    assert a_model.blocked(item("squeeze")) == ""
    a_model.runner = after = LaterRunner()
    a_model.run(item("cook"))
    runner.go()
    assert a_model.busy is item("cook")  # the one begun since
    after.go()
    assert a_model.message.text == "42 glasses by worker"
    a_model.cancel()
    assert a_model.message.text == "42 glasses by worker"


def test_a_defect_in_long_work_is_shown_as_one(a_model, caplog):
    a_model.runner = runner = LaterRunner()
    a_model.run(item("stumble"))
    runner.go()
    assert "Stumble failed: ZeroDivisionError: oops; this is a defect" in a_model.message.text
    assert "ZeroDivisionError" in caplog.text


def test_listeners_hear_of_edits_and_messages_until_they_are_forgotten(a_model):
    heard = []
    listener = lambda: heard.append(1)  # noqa: E731
    a_model.listen(listener)
    a_model.change(item("count"), 4)
    a_model.run(item("squeeze"))
    assert len(heard) >= 2
    a_model.forget(listener)
    count = len(heard)
    a_model.change(item("count"), 5)
    assert len(heard) == count


def test_progress_is_kept_within_bounds_and_stops_when_cancelled():
    seen = []
    progress = Progress(lambda text, share: seen.append((text, share)))
    progress("a", 2.0)
    progress("b", -1.0)
    assert seen == [("a", 1.0), ("b", 0.0)]
    progress.cancel()
    with pytest.raises(Cancelled, match="cancelled while c"):
        progress("c", 0.5)


SHELF = Panel(
    "Shelf",
    "Shelf",
    KitchenParameters,
    (Step("first", "Jars", "", (ListField("path", "Jar", "jars"), Picture("label", "Its label"))),),
)


class ShelfLogic(KitchenLogic):
    def jars(self):
        return (Entry("plum", True), Entry("quince", note="empty"))

    def pathChosen(self):
        if self.parameters().read().path == "quince":
            raise InputError("the jar of quince is empty; fill it first")
        return "plum is opened"

    def label(self):
        if self.parameters().read().path != "plum":
            raise InputError("no jar is open")
        return "<svg/>"


def test_choosing_in_a_list_is_kept_and_the_logic_hears_of_it():
    model = PanelModel(SHELF, ShelfLogic())
    jar, picture = SHELF.steps[0].items
    assert [one.name for one in model.entries(jar)] == ["plum", "quince"]
    assert model.pick(jar, "plum")
    assert model.value(jar) == "plum"
    assert model.message.text == "plum is opened"
    assert model.drawing(picture) == "<svg/>"
    assert not model.pick(jar, "quince")
    assert "fill it first" in model.message.text
    assert model.message.level is Level.BAD
    assert model.drawing(picture) is None


def test_a_list_without_its_method_is_refused():
    with pytest.raises(InputError, match="jars"):
        PanelModel(SHELF, KitchenLogic())


def test_a_degree_sign_stands_close_to_its_number():
    assert [ReadOut("tilt", "Tilt", unit).spaced_unit for unit in ("°", "mm", "")] == ["°", " mm", ""]


def test_what_to_press_next_is_the_main_action_that_can_be_used(a_model):
    assert a_model.offered(KITCHEN.steps[0]) is item("squeeze")
    a_model.logic.parameters().change(count=0)
    assert a_model.offered(KITCHEN.steps[0]) is None, "no fruit left"
    a_model.logic.parameters().change(count=1)
    a_model.logic.status = lambda: StepStatus(StepState.ATTENTION, "bitter", "explode")
    assert a_model.offered(KITCHEN.steps[0]) is item("explode"), "the status names it"
    a_model.logic.status = lambda: StepStatus(StepState.DONE)
    assert a_model.offered(KITCHEN.steps[0]) is None


def test_an_action_may_bring_bad_news(a_model):
    a_model.logic.squeeze = lambda: Reading("half of it is on the floor", Level.BAD)
    assert a_model.run(item("squeeze"))
    assert (a_model.message.text, a_model.message.level) == ("half of it is on the floor", Level.BAD)
