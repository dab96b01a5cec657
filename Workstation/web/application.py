"""The workstation's application: one scene, Slicer's views, the three modules' panels as one procedure."""

from __future__ import annotations

import asyncio
import contextlib
import itertools
import logging
import time
from pathlib import Path
from typing import Any

from CranioNavLib import host, scene
from CranioNavLib.errors import InputError
from CranioNavLib.panel import Panel
from CranioNavLib.panel_model import PanelModel
from CranioNavLib.sequence_metafile import put_aside
from CranioNavLib.sounds import Cues, TiltTone, situation
from trame.app import TrameApp
from trame_slicer.app.logic import get_view_trame_id

from Workstation.web.background import BackgroundRunner, load_soon_needed, make_later_needed
from Workstation.web.built_once import built_once
from Workstation.web.drawings import drawings
from Workstation.web.page import Page
from Workstation.web.panel_view import PanelView
from Workstation.web.pictures import Pictures
from Workstation.web.procedure import HAND, NAVIGATION, PROCEDURE, REGISTRATION, SESSION, TRACKING, ULTRASOUND, modules_of
from Workstation.web.session_files import Places
from Workstation.web.session_files_view import FilesDialog
from Workstation.web.session_folder import SessionFolder, new_folder
from Workstation.web.session_panel import SessionLogic
from Workstation.web.session_resume_view import Resuming
from Workstation.web.session_windows import Windows
from Workstation.web.sharpness import Sharpness, resize_slice
from Workstation.web.tool_models import registered
from Workstation.web.view_controls import ViewControls, layout_grid
from Workstation.web.view_frame import SliceSliders
from Workstation.web.views import ViewFollower

POLL_S = 0.03  # views that follow a tool look for a newer pose just before they are painted
REFRESH_EVERY = 6  # polls between two looks at the read-outs
AHEAD_S = 1.0  # after the first window has come, whose first pictures go first
LATER_S = 10.0  # after that
STANDS_S = 0.6  # without a new pose: nothing moves
SAVE_EVERY = 33  # polls between two looks at what is to be saved
PICTURE_QUALITY = 90  # JPEG; one quality for moving and still pictures, so that none is sent twice
LOG = logging.getLogger(__name__)


class WorkstationApp(TrameApp):
    """Server side of the page. Everything that touches the scene runs in the event loop's thread."""

    def __init__(self, server: Any = None, folder: Path | None = None, data: Path | None = None, confined: bool = False) -> None:
        super().__init__(server)
        from trame_slicer import module as slicer_views

        self.server.enable_module(slicer_views)
        self.windows = Windows(self.server.state, self._draw_again)
        self.server.add_protocol_to_configure(lambda protocol: protocol.registerLinkProtocol(self.windows))
        self.pictures, self.sliders = Pictures(), SliceSliders()
        with host.quiet(), built_once():
            self._make_views()
        self.runner = BackgroundRunner()
        self.session = SessionFolder(folder or new_folder(), self._parameter_nodes)
        self.places = Places(self.session, data, confined)
        self.logics: dict[str, Any] = {}
        self.panels: dict[str, PanelView] = {}
        for panel, logic in _modules(self.session, self.logics, self._go_to):
            self.logics[panel.module] = logic
            key = panel.module.replace("Module", "").lower()
            model = PanelModel(panel, logic, self.runner)
            self.panels[panel.module] = PanelView(
                self.server, model, key, self.places.shown, self.places.meant, self.places.typed, self._poll
            )
        self._place: tuple[Any, ...] = ()  # that the slices show
        self._moves, self._moved_s, self._sharpness = False, 0.0, Sharpness(self._sharpen)
        self._polled_s = 0.0
        self._in_turn = itertools.cycle(self.panels)  # of panels that are not shown, one at a time is looked at
        self._use_folder()
        self.views, self.cues, self.tilt = ViewFollower(self.slicer, self.runner.start), Cues(), TiltTone()
        self.resuming = Resuming(self.server.state)
        self.controls = ViewControls(self.server, self.layouts, self.slicer.view_manager, self.views.fit)
        self.server.state.legend, self.server.state.cue, self.server.state.muted = None, {}, False
        self.server.state.tilt = self.tilt.next(None)
        self.server.state.live = drawings(self.logics[ULTRASOUND])
        self.server.state.files, self.server.state.simulated, self.server.state.unsaved = [], False, ""
        self.files = FilesDialog(self.server, self.places, self._load_ct, self.runner.start)
        with built_once():
            self.page = Page(self.server, self.panels, self.layouts, PROCEDURE)
        self.server.controller.on_server_ready.add_task(self._keep_fresh)
        self.server.controller.on_server_ready.add_task(self.painter.run)
        self.server.controller.on_server_ready.add_task(self._load_ahead)

    @property
    def ui(self) -> Any:
        """The page's layout, as trame's tools expect it."""
        return self.page.layout

    def open_case(self) -> None:
        """Load the case that the session's folder holds already. In the event loop."""
        panel = self.panels[REGISTRATION]
        self.logics[REGISTRATION].parameters().change(case_folder=str(self.session.folder))
        panel.model.run(next(action for action in panel.model.panel.actions() if action.name == "loadCase"))

    def _load_ct(self, path: str, series: str) -> None:
        self.logics[REGISTRATION].parameters().change(ct_path=path, ct_series=series)
        self.panels[REGISTRATION].run("loadCt")

    def _make_views(self) -> None:
        from trame_slicer.core import LayoutManager, SlicerApp

        from Workstation.web.moving import MovingPicture
        from Workstation.web.pacing import Painter, pace, register_quiet_factories
        from Workstation.web.slicing import SlicePicture

        self.slicer = SlicerApp()
        host.adopt_scene(self.slicer.scene, self.slicer.app_logic)
        self._slices, _ = register_quiet_factories(self.slicer.view_manager, self.server, self.sliders)
        self.layouts = LayoutManager(self.slicer.scene, self.slicer.view_manager, self.server)
        # the views are made here: made inside the page, their widgets would land between the page's own
        self.layouts.register_layout_dict(layout_grid())
        self.layouts.set_layout("four")
        self.painter = Painter(self.pictures)
        self.painter.before_round = self._lead
        manager = self.slicer.view_manager
        for view in manager.get_slice_views():
            cut = SlicePicture(view, lambda: self.views.sphere())
            pace(view, get_view_trame_id(self.server, view), self.painter, PICTURE_QUALITY, cut)
        for view in manager.get_threed_views():
            still = MovingPicture(view, lambda: self.views.moving_models())
            pace(view, get_view_trame_id(self.server, view), self.painter, PICTURE_QUALITY, still)

    def _sharpen(self, share: float) -> None:
        """Another number of pixels for the slices."""
        for view in self._slices.get_views():
            resize_slice(view, self._slices.get_factory_view(view.get_singleton_tag()).view_adapter, share)
        self._place = ()

    def _use_folder(self) -> None:
        """The modules write into the session's folder unless the user says otherwise."""
        self.logics[TRACKING].parameters().change(calibration_folder=str(self.session.folder))
        self.logics[ULTRASOUND].parameters().change(recording_path=self.session.recording_path)
        self.logics[REGISTRATION].parameters().change(output_folder=str(self.session.folder))

    def _parameter_nodes(self) -> list[Any]:
        kept = (REGISTRATION, TRACKING, ULTRASOUND, HAND, NAVIGATION)
        return [self.logics[name].parameters().node for name in kept]

    def _go_to(self, step: str) -> None:
        self.server.state.step = step

    async def _keep_fresh(self, **_: Any) -> None:
        """Bring the devices' news into the scene, and the scene's into the panels."""
        loop = asyncio.get_running_loop()

        def tell() -> None:
            with contextlib.suppress(RuntimeError):  # the loop has ended before the device's thread
                loop.call_soon_threadsafe(self._hear)

        for turn in itertools.count():
            await asyncio.sleep(POLL_S)
            if time.monotonic() > self._polled_s + POLL_S:  # or a round of pictures has just done it
                self._poll()
            if self.logics[TRACKING].stream is not None:
                self.logics[TRACKING].stream.on_news = tell
            for part in (self._move, self._turn, self._keep):
                try:
                    part(turn)
                except Exception:  # a read-out's defect must not end tracking
                    LOG.exception("the page could not be brought up to date")

    async def _load_ahead(self, **_: Any) -> None:
        """Load what will soon be needed, once a window shows the page."""
        while not self.server.state.control["window"]:
            await asyncio.sleep(POLL_S)
        await asyncio.sleep(AHEAD_S)
        self.runner.start(load_soon_needed, _raise_if_failed)
        await asyncio.sleep(LATER_S)
        self.runner.start(make_later_needed, _raise_if_failed)

    def _draw_again(self, area: str) -> None:
        """Send the picture of a view, or of all, to a window that has none yet."""
        for view in self.slicer.view_manager.get_views():
            if not area or get_view_trame_id(self.server, view) == area:
                view.schedule_render()

    def _poll(self) -> None:
        """Take over what the devices have to say. Not drawn while a tool's place in the CT is not known."""
        self._polled_s = time.monotonic()
        self.painter.muted = not registered()
        for name in (TRACKING, ULTRASOUND, REGISTRATION, HAND):
            moving = self.painter.while_moving() if name == TRACKING else contextlib.nullcontext()
            with moving, contextlib.suppress(InputError):  # the logic keeps the reason and its panel shows it
                self.logics[name].poll()
        self.painter.muted = False

    def _hear(self) -> None:
        """A pose has come: its picture is begun now, and not when the devices are looked at next."""
        if registered() and not self.painter.waits:
            self._poll()
            if self._followed() != self._place:
                self._draw_moving()

    def _move(self, turn: int) -> None:
        """Hide lost tools; have the views drawn anew that follow the leading one."""
        self.views.show_tools(self._forerun_mm())
        place = self._followed()
        if place != self._place:
            self._draw_moving()

    def _draw_slices(self) -> None:
        """What stands still is Slicer's own picture."""
        for view in self._slices.get_views():
            view.schedule_render()

    def _draw_moving(self) -> None:
        with self.painter.while_moving():
            for view in self.slicer.view_manager.get_views():
                view.schedule_render()

    def _lead(self) -> None:
        """Just before the views are painted: the newest poses, and the slices where the leading tool is now."""
        self.views.hide_large()
        self._poll()
        place = self._followed()
        if place != self._place:
            self._place, self._moved_s = place, time.monotonic()
            with self.painter.while_moving():
                if place:
                    self._navigate()
                else:
                    self.views.ring(None, None)  # the step is another one; a ring that stays behind would be about nothing
            self._draw_moving()

    def _followed(self) -> tuple[Any, ...]:
        """What the slices follow in navigation."""
        if self.server.state.step != "navigation":
            return ()
        logic = self.logics[NAVIGATION]
        found = logic.tip()
        return (found is not None and tuple(found[1]), logic.parameters().read())

    def _turn(self, turn: int) -> None:
        if turn % REFRESH_EVERY == 0:
            now_s = time.monotonic()
            moves = bool(self._place) and now_s < self._moved_s + STANDS_S
            self._sharpness.look(now_s, self.painter.late_s, moves)
            if self._moves and not moves:
                self._draw_slices()
            self._moves = moves
            with self.server.state as state:
                drawn = not (self.painter.waits or self.views.waits)  # what the last look has asked for
                self._refresh_views(state)
                back = self.resuming.refresh(self.panels[SESSION].model, drawn and not self.views.waits, now_s)
                self.controls.look()
                self.sliders.refresh()
                if state.step in ("devices", "ultrasound"):
                    state.live = drawings(self.logics[ULTRASOUND])
                state.files = self.logics[SESSION].offered()
                state.simulated = self._is_simulated()
            for name in self.panels if back else modules_of(self.server.state.step):
                self.panels[name].refresh()
            if not moves or turn % (3 * REFRESH_EVERY) == 0:
                self.panels[next(self._in_turn)].refresh()

    def _keep(self, turn: int) -> None:
        """Save what is new; let go of windows that take nothing."""
        if turn % SAVE_EVERY == 0:
            self._save()
            self.windows.drop_stalled()

    def _refresh_views(self, state: Any) -> None:
        """Views, legend and sounds as the open step needs them."""
        ultrasound = self.logics[ULTRASOUND]
        state.legend = self.views.refresh(state.step, state.error_shown, self._forerun_mm(), self._asked_for(state.step))
        cue = self.cues.next(situation([view.model for view in self.panels.values()], len(ultrasound.taken())))
        if cue is not None:
            state.cue = cue
        state.tilt = self.tilt.next(ultrasound.guide() if state.step == "ultrasound" else None)

    def _asked_for(self, step: str) -> str:
        """The point that the open step asks for; "" if none."""
        index, node = self.logics[ULTRASOUND].currentIndex(), scene.find("ProtocolPoints")
        if step == "ultrasound":
            return str(node.GetNthControlPointLabel(index)) if node is not None and index >= 0 else ""
        if step == "landmarks":
            return str(self.logics[TRACKING].nextPoint().text)
        return str(self.logics[REGISTRATION].parameters().read().landmark) if step == "bone" else ""

    def _forerun_mm(self) -> float:
        """Of the probe that is connected, else 0."""
        stream = self.logics[ULTRASOUND].stream
        return float(stream.acquisition.forerun_length_mm) if stream is not None else 0.0

    def _navigate(self) -> None:
        logic = self.logics[NAVIGATION]
        wanted, found = logic.parameters().read(), logic.tip()
        if found is not None and wanted.follow:
            self.views.follow(found[1], wanted.zoom)
        error = logic.error_mm(found[1]) if found is not None and wanted.ring else None
        self.views.ring(found[1] if found is not None else None, error)

    def _is_simulated(self) -> bool:
        from CranioNavLib.phantom.session import running_session

        if running_session() is None:
            return False
        if self.session.simulated_seed is None:
            self.session.simulated_seed = self.logics[HAND].parameters().read().seed
        return True

    def _save(self) -> None:
        try:
            if self.logics[TRACKING].stream is not None:  # a calibration is written into it at once
                self.session.folder.mkdir(parents=True, exist_ok=True)
            volume = self.session.ct_to_write()
            if volume is not None:
                self.runner.start(lambda: self.session.write_ct(volume), self._ct_written)
            self.session.save(self.server.state.step)
            if self.session.is_saved:
                self._unsaved("")
        except (InputError, OSError) as error:
            self._unsaved(_reason(error))

    def _ct_written(self, outcome: Any) -> None:
        if isinstance(outcome, (InputError, OSError)):
            self._unsaved(_reason(outcome))
        else:
            _raise_if_failed(outcome)

    def _unsaved(self, reason: str) -> None:
        """Tell every window that nothing of the session is kept on the disk, and why."""
        said = self.places.shown(reason)
        if said and said != self.server.state.unsaved:
            LOG.error("the session cannot be saved: %s", reason)
        with self.server.state as state:
            state.unsaved = said


def _reason(error: InputError | OSError) -> str:
    return str(error) if isinstance(error, InputError) else f"{error.filename}: {error.strerror}"


def _raise_if_failed(outcome: Any) -> None:
    if isinstance(outcome, BaseException):
        raise outcome


def _modules(session: SessionFolder, logics: dict[str, Any], go_to: Any) -> list[tuple[Panel, Any]]:
    """Each panel with a logic on the host's scene."""
    from ModuleRegistrationLib.panel_description import PANEL as REGISTRATION_PANEL
    from ModuleTrackingLib.panel_description import PANEL as TRACKING_PANEL
    from ModuleUltrasoundLib.panel_description import PANEL as ULTRASOUND_PANEL

    from ModuleRegistration import ModuleRegistrationLogic
    from ModuleTracking import ModuleTrackingLogic
    from ModuleUltrasound import ModuleUltrasoundLogic
    from Workstation.web import navigation, session_panel, simulated_hand

    registration, tracking, ultrasound = ModuleRegistrationLogic(), ModuleTrackingLogic(), ModuleUltrasoundLogic()

    def take_patient(volume: Any) -> None:
        for device in (tracking, ultrasound):  # the simulated ones look at the patient who was there when they were connected
            if device.stream is not None:
                device.disconnect()
        registration.forgetPatient()
        registration.takeCt(volume)
        put_aside(ultrasound.parameters().read().recording_path or session.recording_path)

    hand = simulated_hand.SimulatedHandLogic(
        ultrasound.nextPoint,
        lambda: len(ultrasound.taken()) if ultrasound.recorded() else None,
        lambda: ultrasound.sweep is not None,
        take_patient,
    )
    return [
        (REGISTRATION_PANEL, registration),
        (TRACKING_PANEL, tracking),
        (ULTRASOUND_PANEL, ultrasound),
        (simulated_hand.PANEL, hand),
        (navigation.PANEL, navigation.NavigationLogic()),
        (session_panel.PANEL, SessionLogic(session, logics, go_to)),
    ]
