"""Runs the modules' self-tests as 3D Slicer does: one after the other, each on a fresh scene."""

from __future__ import annotations

import importlib
import time
import traceback
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from CranioNavLib import host

MODULES = ("ModuleTracking", "ModuleUltrasound", "ModuleRegistration")


@dataclass(frozen=True)
class SelfTestOutcome:
    """How one module's self-test ended."""

    module: str
    passed: bool
    message: str  # why it failed; "" if it passed
    duration_s: float
    details: str = ""  # the traceback of a failure


def run_selftests(modules: Sequence[str] = MODULES) -> list[SelfTestOutcome]:
    """One outcome a module, in order. A failure does not stop those that follow."""
    return [run_selftest(module) for module in modules]


def run_selftest(module: str) -> SelfTestOutcome:
    """The outcome of one module's `runTest`; the scene is cleared before and after."""
    started = time.monotonic()
    message = details = ""
    host.scene().Clear(False)
    try:
        loaded: Any = importlib.import_module(module)
        getattr(loaded, module)(None).runTest(msec=0)
    except Exception as error:  # whatever a module does wrong is its failure, not the runner's
        message, details = f"{type(error).__name__}: {error}".strip(), traceback.format_exc()
    host.scene().Clear(False)
    return SelfTestOutcome(module, not message, message, time.monotonic() - started, details)
