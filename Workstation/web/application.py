"""The workstation's application: one scene, Slicer's views, the three modules' panels as one procedure."""

from __future__ import annotations

import asyncio
import contextlib
import itertools
from typing import Any

from CranioNavLib import host
from CranioNavLib.errors import InputError
from CranioNavLib.panel import Panel
from CranioNavLib.panel_model import PanelModel
from trame.app import TrameApp

from Workstation.web.background import BackgroundRunner
from Workstation.web.page import Page
from Workstation.web.panel_view import PanelView
from Workstation.web.procedure import PROCEDURE
from Workstation.web.views import ViewFollower

POLL_S = 0.04  # devices: at least 20 updates a second reach the views
REFRESH_EVERY = 5  # polls between two looks at the read-outs


class WorkstationApp(TrameApp):
    """Server side of the page. Everything that touches the scene runs in the event loop's thread."""

    def __init__(self, server: Any = None) -> None:
        super().__init__(server)
        from trame_slicer import module as slicer_views
        from trame_slicer.core import LayoutManager, SlicerApp
        from trame_slicer.rca_view import register_rca_factories

        self.server.enable_module(slicer_views)
        with host.quiet():
            self.slicer = SlicerApp()
            host.adopt_scene(self.slicer.scene, self.slicer.app_logic)
            register_rca_factories(self.slicer.view_manager, self.server)
            self.layouts = LayoutManager(self.slicer.scene, self.slicer.view_manager, self.server)
            # the views are made here: made inside the page, their widgets would land between the page's own
            self.layouts.register_layout_dict(LayoutManager.default_grid_configuration())
            self.layouts.set_layout("Quad View")
        self.runner = BackgroundRunner()
        self.panels: dict[str, PanelView] = {}
        self._polled: list[Any] = []
        for panel, logic in _modules():
            key = panel.module.replace("Module", "").lower()
            self.panels[panel.module] = PanelView(self.server, PanelModel(panel, logic, self.runner), key)
            if hasattr(logic, "poll"):
                self._polled.append(logic)
        self.views = ViewFollower(self.slicer)
        self.page = Page(self.server, self.panels, self.layouts, PROCEDURE)
        self.server.controller.on_server_ready.add_task(self._keep_fresh)

    @property
    def ui(self) -> Any:
        """The page's layout, as trame's tools expect it."""
        return self.page.layout

    async def _keep_fresh(self, **_: Any) -> None:
        """Bring the devices' news into the scene, and the scene's into the panels."""
        for turn in itertools.count():
            await asyncio.sleep(POLL_S)
            for logic in self._polled:
                with contextlib.suppress(InputError):  # the logic keeps the reason and its panel shows it
                    logic.poll()
            if turn % REFRESH_EVERY == 0:
                self.views.refresh()
                for panel in self.panels.values():
                    panel.refresh()


def _modules() -> list[tuple[Panel, Any]]:
    """Each module's panel with a logic on the host's scene."""
    from ModuleRegistrationLib.panel_description import PANEL as REGISTRATION
    from ModuleTrackingLib.panel_description import PANEL as TRACKING
    from ModuleUltrasoundLib.panel_description import PANEL as ULTRASOUND

    from ModuleRegistration import ModuleRegistrationLogic
    from ModuleTracking import ModuleTrackingLogic
    from ModuleUltrasound import ModuleUltrasoundLogic
    from Workstation.web.simulated_hand import PANEL as HAND
    from Workstation.web.simulated_hand import SimulatedHandLogic

    return [
        (REGISTRATION, ModuleRegistrationLogic()),
        (TRACKING, ModuleTrackingLogic()),
        (ULTRASOUND, ModuleUltrasoundLogic()),
        (HAND, SimulatedHandLogic()),
    ]
