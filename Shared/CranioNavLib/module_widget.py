"""What the widgets of the three modules have in common: a panel over a logic, heard too; for a device, the timer that asks it."""

from __future__ import annotations

from typing import Any, ClassVar

from CranioNavLib.panel import Panel
from CranioNavLib.panel_model import PanelModel


class PanelOfModule:
    """To be mixed into a ScriptedLoadableModuleWidget, before it: draws `panelDescription` over the module's logic."""

    panelDescription: ClassVar[Panel]
    isOpen: bool = False  # whether the user looks at it

    def createLogic(self) -> Any:
        """The module's logic; derived classes say which."""
        raise NotImplementedError(f"{type(self).__name__} has no createLogic")

    def setup(self) -> None:
        """Draw the panel."""
        super().setup()  # type: ignore[misc]
        from CranioNavLib.panel_qt import show_in
        from CranioNavLib.sounds_qt import SOUNDS, Source

        self.logic = self.createLogic()
        self.panel = show_in(self, PanelModel(self.panelDescription, self.logic))
        self.heard = Source(self.panel.model, self.palpated, self.probeGuide)
        SOUNDS.join(self.heard)
        self.panel.say_of_sounds(SOUNDS.limits)

    def palpated(self) -> int:
        """Points that this module has taken in the recording under way: one more is heard."""
        return 0

    def probeGuide(self) -> Any:
        """How the probe stands on its point, to be heard; None where this module does not know, or nobody looks at it."""
        return None

    def enter(self) -> None:
        """The user opened the module."""
        self.isOpen = True
        self.panel.start()
        self.panel.refresh()

    def exit(self) -> None:
        """The user left the module."""
        self.isOpen = False
        self.panel.stop()

    def cleanup(self) -> None:
        """The module is about to be unloaded."""
        from CranioNavLib.sounds_qt import SOUNDS

        SOUNDS.leave(self.heard)
        self.panel.close()


class PolledPanel(PanelOfModule):
    """The same for a logic whose `poll` is called while another module is shown, too."""

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
        super().cleanup()


class PanelOfDevice(PolledPanel):
    """The same for a logic with a device, which is let go of in the end."""

    def cleanup(self) -> None:
        """The module is about to be unloaded."""
        self.ticker.stop()
        self.logic.disconnect()
        super().cleanup()
