"""What the self-tests of the three modules have in common: a fresh scene, a simulated patient, an event loop."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, ClassVar

from CranioNavLib import host

if TYPE_CHECKING:
    from CranioNavLib.phantom.session import SimulatedSession


class ScenarioOnScene:
    """To be mixed into a ScriptedLoadableModuleTest, before it: each method `test_...` runs on a fresh scene."""

    delayDisplay: Callable[[str], None]  # the ScriptedLoadableModuleTest's

    def createLogic(self) -> Any:
        """The module's logic; derived classes say which."""
        raise NotImplementedError(f"{type(self).__name__} has no createLogic")

    def setUp(self) -> None:
        """A fresh scene and a logic on it."""
        host.scene().Clear(False)
        self.logic = self.createLogic()

    def tearDown(self) -> None:
        """Let go of what the scenario holds."""

    def runTest(self) -> None:
        """All scenarios, one after the other."""
        for name in [name for name in dir(self) if name.startswith("test_")]:
            self.setUp()
            try:
                getattr(self, name)()
            finally:
                self.tearDown()


class ScenarioWithPatient(ScenarioOnScene):
    """The same for a logic with a device: the simulated devices see a patient of the scenario's own."""

    patientSeed: ClassVar[int]
    pollMs: ClassVar[int]
    session: SimulatedSession

    def setUp(self) -> None:
        """A fresh scene, a logic on it, and a simulated patient."""
        from CranioNavLib.phantom import make_patient
        from CranioNavLib.phantom.session import SimulatedSession, use_session

        super().setUp()
        self.session = SimulatedSession(make_patient(None, seed=self.patientSeed), seed=self.patientSeed)
        use_session(self.session)

    def tearDown(self) -> None:
        """Let go of the device and the patient."""
        from CranioNavLib.phantom.session import use_session

        self.logic.disconnect()
        use_session(None)

    def runFor(self, seconds: float, before: Callable[[], None] = lambda: None) -> None:
        """The event loop, for some seconds; `before` is called before each poll."""
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            before()
            self.logic.poll()
            time.sleep(self.pollMs / 1000)
