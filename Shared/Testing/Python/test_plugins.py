"""Plugins: one class, one name, three doors, and a refusal that names what is missing."""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import dataclass
from importlib import metadata
from typing import Annotated, Optional

import pytest
from CranioNavLib.errors import InputError
from CranioNavLib.parameters import Limits, Parameters
from CranioNavLib.plugins import Plugin, PluginKind, load_file


class Instrument(Plugin):
    @abstractmethod
    def play(self) -> str: ...


@dataclass(frozen=True)
class Tuning(Parameters):
    pitch_hz: Annotated[float, Limits(20, 20000), "concert pitch"] = 440.0
    voices: Annotated[int, Limits(1, 8)] = 1
    muted: bool = False
    label: Optional[str] = None


class Flute(Instrument):
    name = "flute"
    title = "A flute"
    Settings = Tuning

    def play(self) -> str:
        return f"{self.settings.pitch_hz} Hz"


@pytest.fixture
def instruments() -> PluginKind[Instrument]:
    return PluginKind("instrument", Instrument)


def test_a_registered_plugin_is_found_and_made_from_text(instruments):
    instruments.register(Flute)
    assert instruments.names() == ["flute"]
    assert instruments.create("flute", pitch_hz="442").play() == "442.0 Hz"


def test_an_unknown_name_lists_what_is_installed(instruments):
    instruments.register(Flute)
    with pytest.raises(InputError, match=r"unknown instrument 'oboe'; installed: flute"):
        instruments.find("oboe")


def test_a_plugin_that_lacks_a_method_is_refused_by_name_and_not_kept(instruments):
    class Drum(Instrument):
        name = "drum"

    with pytest.raises(InputError, match=r"'drum'.*lacks play"):
        instruments.register(Drum)
    assert instruments.names() == []


def test_a_plugin_without_a_name_and_a_foreign_class_are_refused(instruments):
    class Nameless(Instrument):
        def play(self) -> str:
            return ""

    with pytest.raises(InputError, match="has no name"):
        instruments.register(Nameless)
    with pytest.raises(InputError, match="is not a instrument plugin"):
        instruments.register(str)


def test_two_classes_cannot_share_a_name(instruments):
    class Other(Flute):
        pass

    instruments.register(Flute)
    with pytest.raises(InputError, match="already used by"):
        instruments.register(Other)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"pitch_hz": "5"}, r"parameter pitch_hz is 5.0; expected 20 to 20000 Hz"),
        ({"pitch_hz": "high"}, r"parameter pitch_hz: expected a number, got 'high'"),
        ({"pitsch": "5"}, r"unknown parameter 'pitsch'; known: pitch_hz, voices, muted, label"),
        ({"muted": "perhaps"}, r"parameter muted: expected true or false"),
    ],
)
def test_settings_outside_their_type_are_refused(instruments, settings, message):
    instruments.register(Flute)
    with pytest.raises(InputError, match=message):
        instruments.create("flute", **settings)


def test_settings_survive_the_round_trip_through_text():
    tuning = Tuning(pitch_hz=415.0, voices=3, muted=True, label="baroque")
    assert Tuning.from_strings(tuning.to_strings()) == tuning
    assert Tuning.from_strings(Tuning().to_strings()) == Tuning()


def test_an_entry_point_is_a_door_and_is_imported_only_when_asked_for(instruments, monkeypatch):
    point = metadata.EntryPoint("bassoon", f"{__name__}:Bassoon", "cranionav.instrument")
    monkeypatch.setattr(metadata, "entry_points", lambda group: [point] if group == "cranionav.instrument" else [])
    assert instruments.names() == ["bassoon"]
    with pytest.raises(InputError, match="cannot be loaded"):
        instruments.find("bassoon")
    assert instruments.entries()[0].problem != ""


def test_an_imported_file_registers_its_plugins(tmp_path, instruments):
    file = tmp_path / "my_instrument.py"
    file.write_text("raise RuntimeError('no licence')\n")
    with pytest.raises(InputError, match="RuntimeError: no licence"):
        load_file(file)
    with pytest.raises(InputError, match="no Python file"):
        load_file(tmp_path / "absent.py")


def test_every_built_in_plugin_loads():
    from ModuleRegistrationLib.anatomy.segmentation import SEGMENTATIONS
    from ModuleRegistrationLib.registration.problem import METHODS
    from ModuleTrackingLib.tracker import TRACKERS
    from ModuleUltrasoundLib.devices.device import AMODE_DEVICES

    for kind in (TRACKERS, AMODE_DEVICES, METHODS, SEGMENTATIONS):
        assert kind.names()
        assert [entry for entry in kind.entries() if entry.problem] == []
