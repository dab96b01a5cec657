"""Makes the helpers beside the tests (scripted_tracker) importable; the tracking module's logic on an empty scene."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parent))


@pytest.fixture
def a_logic():
    """With a tracker that does what `Script` says; the stylus rests in the divot."""
    import numpy as np
    from CranioNavLib import host
    from CranioNavLib.rigid import rigid
    from obedient_tracker import DIVOT, Script

    import ModuleTracking as module

    host.scene().Clear(False)
    Script.silent = ()
    Script.refuse, Script.broken, Script.tools = "", False, {"Stylus": rigid(np.eye(3), DIVOT)}
    logic = module.ModuleTrackingLogic()
    logic.parameters().change(tracker="scripted", rest_s=0.1)
    yield logic
    logic.disconnect()
    host.scene().Clear(False)
