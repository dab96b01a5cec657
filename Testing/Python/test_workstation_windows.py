"""Browser windows come and go: one controls, the others watch, and whatever is lost on the way comes back."""

from __future__ import annotations

import asyncio
import signal
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from Testing.Python import workstation_cable as cable_module
from Testing.Python import workstation_user as user_module
from Workstation.web.session_windows import LOST_BYTES, STATE_TOPIC, Windows

needs_browser = pytest.mark.skipif(not Path(user_module.BROWSER).exists(), reason="no Chromium on this machine")
ASK_BEHIND_THE_PAGE = "trame.client.getConnection().getSession().call('trame.trigger', ['simulatedhand_run', ['layPatient'], {}])"


class State(dict):
    """As much of trame's state as the windows need."""

    __getattr__ = dict.__getitem__
    __setattr__ = dict.__setitem__
    has = dict.__contains__

    def __enter__(self) -> State:
        return self

    def __exit__(self, *_: object) -> None:
        pass


class Room:
    """Windows on a stand-in for the web server: what arrives, and what is sent to whom."""

    def __init__(self) -> None:
        self.state, self.done, self.sent, self.drawn, self.sizes = State(step="ct"), [], [], [], []
        self.windows = Windows(self.state, self.drawn.append)
        pictures = SimpleNamespace(push_content=None, publish=self.publish, update_size=lambda *size: self.sizes.append(size))
        self.handler = SimpleNamespace(
            onCompleteMessage=self.complete,
            sendWrappedError=None,
            sendWrappedMessage=self.answer,
            publish=self.publish,
            isClientAuthenticated=lambda client: True,
            serverProtocol=SimpleNamespace(getLinkProtocols=lambda: [pictures]),
        )
        self.windows.publish = self.publish
        self.windows.guard(SimpleNamespace(_ws_handlers=[self.handler]))

    def publish(self, topic: str, data: Any, client_id: str | None = None, **_: Any) -> None:
        self.sent.append((topic, data, client_id))

    async def complete(self, rpc: Any, client: str) -> None:
        self.done.append((client, rpc["method"], rpc.get("args")))
        if rpc["method"] == "cranionav.window.open":
            self.windows.open(*rpc["args"])
        if rpc["method"] == "cranionav.window.take":
            self.windows.take()

    async def answer(self, rpcid: Any, content: Any, method: str, client_id: str) -> None:
        self.sent.append(("answer", content, client_id))

    def connect(self, client: str, name: str, held: bool = False) -> SimpleNamespace:
        transport = SimpleNamespace(
            set_write_buffer_limits=lambda high: None,
            get_write_buffer_size=lambda: transport.waiting,
            abort=lambda: self.windows.onClose(client),
        )
        transport.waiting = 0
        self.windows.onConnect(SimpleNamespace(transport=transport, remote="10.0.0.7"), client)
        self.say(client, "cranionav.window.open", [name, held])
        return transport

    def say(self, client: str, method: str, arguments: list[Any]) -> None:
        asyncio.run(self.handler.onCompleteMessage({"id": 1, "method": method, "args": arguments}, client))

    def did(self, client: str, method: str) -> bool:
        return any(entry[:2] == (client, method) for entry in self.done)


def test_what_a_watcher_sends_is_not_carried_out():
    room = Room()
    room.connect("a", "first")
    room.connect("b", "second")
    for client in "ab":
        room.say(client, "trame.trigger", ["run", ["layPatient"], {}])
        room.say(client, "trame.rca.event", ["view", "x", {}])
    assert room.did("a", "trame.trigger")
    assert room.did("a", "trame.rca.event")
    assert not room.did("b", "trame.trigger")
    assert not room.did("b", "trame.rca.event")
    assert room.state["control"] == {"window": 1, "text": "Window 1, at 10.0.0.7, controls"}


def test_an_unknown_connection_can_do_nothing():
    room = Room()
    room.connect("a", "first")
    room.say("stranger", "trame.trigger", ["run", [], {}])
    assert not room.did("stranger", "trame.trigger")


def test_a_watchers_page_goes_back_to_what_is():
    room = Room()
    room.connect("a", "first")
    room.connect("b", "second")
    room.say("b", "trame.state.update", [[{"key": "step", "value": "report"}]])
    assert room.state["step"] == "ct"
    assert (STATE_TOPIC, {"step": "ct"}, "b") in room.sent


def test_a_windows_own_dialogs_are_not_shared():
    room = Room()
    room.connect("a", "first")
    room.say("a", "trame.state.update", [[{"key": "keys", "value": True}, {"key": "step", "value": "bone"}]])
    assert room.done[-1] == ("a", "trame.state.update", [[{"key": "step", "value": "bone"}]])


def test_control_passes_to_who_takes_it_with_the_size_of_his_views():
    room = Room()
    room.connect("a", "first")
    room.connect("b", "second")
    room.say("b", "trame.rca.size", ["axial", "x", {"w": 900, "h": 500, "p": 1}])
    assert room.sizes == []
    room.say("b", "cranionav.window.take", [])
    assert room.sizes == [("axial", "x", {"w": 900, "h": 500, "p": 1})]
    assert room.state["control"]["window"] == 2
    room.say("a", "trame.trigger", ["run", [], {}])
    assert not room.did("a", "trame.trigger")


def test_a_window_that_comes_back_controls_as_before():
    room = Room()
    room.connect("a", "first")
    room.connect("b", "second")
    room.windows.onClose("a")
    assert room.state["control"] == {"window": 1, "text": "The controlling window is gone"}
    room.connect("c", "first", held=True)
    assert room.windows.controls("c")
    assert not room.windows.controls("b")


def test_after_a_restart_the_control_is_his_who_had_it():
    room = Room()
    room.connect("b", "second")
    room.connect("a", "first", held=True)
    assert room.windows.controls("a")
    assert not room.windows.controls("b")


def test_a_control_that_was_taken_is_not_claimed_back_by_coming_back():
    room = Room()
    room.connect("a", "first")
    room.connect("b", "second")
    room.windows.onClose("a")
    room.say("b", "cranionav.window.take", [])
    room.connect("c", "first", held=True)
    assert room.windows.controls("b")
    assert not room.windows.controls("c")


def test_a_window_that_takes_nothing_is_let_go():
    room = Room()
    stalled = room.connect("a", "first")
    room.connect("b", "second")
    stalled.waiting = LOST_BYTES + 1
    room.windows.drop_stalled()
    assert not room.windows.is_open("first")
    assert room.windows.is_open("second")


def test_errors_reach_the_page_without_the_stack():
    room, sent = Room(), []

    async def send(*arguments: Any, **options: Any) -> None:
        sent.append((arguments, options))

    room.handler.sendWrappedError = send
    room.windows.guard(SimpleNamespace(_ws_handlers=[room.handler]))
    asyncio.run(room.handler.sendWrappedError(1, -32001, "Exception raised", {"trace": "/home/user/secret.py"}, client_id="a"))
    assert "secret" not in repr(sent)


def link_of(page: Any, state: str) -> None:
    page.locator(f"html[data-window={state}]").wait_for()


@needs_browser
def test_two_windows_share_a_session_and_survive_reload_and_a_pulled_cable(tmp_path):
    with (
        user_module.served(tmp_path / "session", True) as (url, _),
        cable_module.cabled(url) as (far_url, cable),
        user_module.browsing() as user,
    ):
        user.open(far_url)
        link_of(user.page, "controls")
        other = user_module.User(user.page.context.browser.new_page())
        other.open(url)
        link_of(other.page, "watches")
        assert "Window 1" in other.page.locator("[data-control]").inner_text()
        assert other.page.locator("[data-control]").bounding_box()["y"] > 600, "it covers the views' lower edge, no button"
        other.page.evaluate(ASK_BEHIND_THE_PAGE)
        user.step("bone")
        other.page.locator("[data-panel=bone]").wait_for()
        user.step("ct")
        assert "simulated patient: " not in user.page.locator("[data-panel=ct]").inner_text()
        user.step("bone")
        user.page.reload()
        link_of(user.page, "controls")
        user.page.locator("[data-panel=bone]").wait_for()
        assert user.defects == []
        cable.pull()
        user.page.locator(".link-lost", has_text="Connection lost").wait_for()
        assert "is gone" in other.page.locator("[data-control]", has_text="gone").inner_text()
        cable.plug()
        user.page.locator(".link-lost").wait_for(state="detached")
        link_of(user.page, "controls")
        other.page.locator("[data-take-control]").click()
        link_of(other.page, "controls")
        link_of(user.page, "watches")
        assert "Window 2" in user.page.locator("[data-control]").inner_text()
        other.step("devices")
        user.page.locator("[data-panel=devices]").wait_for()
        assert other.defects == []


@needs_browser
@pytest.mark.slow
def test_a_lost_radio_link_is_noticed_and_mended(tmp_path):
    with (
        user_module.served(tmp_path / "session", True) as (url, _),
        cable_module.cabled(url) as (far_url, cable),
        user_module.browsing() as user,
    ):
        user.open(far_url)
        other = user_module.User(user.page.context.browser.new_page())
        other.open(url)
        link_of(other.page, "watches")
        cable.stall()
        user.page.locator(".link-lost", has_text="Connection lost").wait_for()
        other.page.locator("[data-take-control]").click()
        link_of(other.page, "controls")
        other.press("ct", "layPatient")
        other.sees("ct", "simulated patient: synthetic head")  # the lost window holds up nothing
        cable.plug()
        user.page.locator(".link-lost").wait_for(state="detached")
        link_of(user.page, "watches")
        user.sees("ct", "simulated patient: synthetic head")


@needs_browser
@pytest.mark.slow
def test_a_killed_server_that_is_started_again_gets_its_window_back(tmp_path):
    folder = tmp_path / "session"
    with user_module.browsing() as user:
        with user_module.served(folder, True) as (url, process):
            user.open(url)
            user.press("ct", "layPatient")
            user.sees("ct", "simulated patient: synthetic head")
            while not (folder / "session.json").is_file():
                user.page.wait_for_timeout(200)
            process.send_signal(signal.SIGKILL)
            user.page.locator(".link-lost", has_text="Connection lost").wait_for()
        port = url.rsplit(":", 1)[1].strip("/")
        with user_module.served(folder, True, "--port", port):
            user.page.locator(".link-lost").wait_for(state="detached")
            link_of(user.page, "controls")
            user.press("ct", "resumeSession")
            user.sees("ct", "the session goes on where it was")
