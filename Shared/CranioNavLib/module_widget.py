"""What the widgets of the three modules have in common: a panel over a logic and, for a device, the timer that asks it."""

from __future__ import annotations

from typing import Any, ClassVar

from CranioNavLib.panel import Panel
from CranioNavLib.panel_model import PanelModel


class PanelOfModule:
    """To be mixed into a ScriptedLoadableModuleWidget, before it: draws `panelDescription` over the module's logic."""

    panelDescription: ClassVar[Panel]

    def createLogic(self) -> Any:
        """The module's logic; derived classes say which."""
        raise NotImplementedError(f"{type(self).__name__} has no createLogic")

    def setup(self) -> None:
        """Draw the panel."""
        super().setup()  # type: ignore[misc]
        from CranioNavLib.panel_qt import show_in

        self.logic = self.createLogic()
        self.panel = show_in(self, PanelModel(self.panelDescription, self.logic))

    def enter(self) -> None:
        """The user opened the module."""
        self.panel.start()
        self.panel.refresh()

    def exit(self) -> None:
        """The user left the module."""
        self.panel.stop()

    def cleanup(self) -> None:
        """The module is about to be unloaded."""
        self.panel.close()


class PanelOfDevice(PanelOfModule):
    """The same for a logic with a device: its `poll` is called while another module is shown, too."""

    pollMs: ClassVar[int]

    def setup(self) -> None:
        """Draw the panel and begin to poll."""
        super().setup()
        from CranioNavLib.panel_qt_widgets import Ticker

        widget: Any = self
        self.ticker = Ticker(widget.parent, self.pollMs, self.logic.poll)
        self.ticker.start()

    def cleanup(self) -> None:
        """The module is about to be unloaded."""
        self.ticker.stop()
        self.logic.disconnect()
        super().cleanup()
