"""The procedure as the page shows it: nine steps, each made of steps of the modules' panels."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class ProcedureStep:
    """One entry of the stepper; its state is that of its first part that is not done."""

    name: str
    title: str
    parts: tuple[tuple[str, str], ...]  # (module, step of its panel)


REGISTRATION, TRACKING, ULTRASOUND = "ModuleRegistration", "ModuleTracking", "ModuleUltrasound"
HAND, SESSION, NAVIGATION = "SimulatedHand", "Session", "Navigation"
DEVICES = "devices"

PROCEDURE: tuple[ProcedureStep, ...] = (
    ProcedureStep("ct", "CT", ((SESSION, "resume"), (HAND, "patient"), (REGISTRATION, "ct"))),
    ProcedureStep("bone", "Bone and landmarks", ((REGISTRATION, "bone"), (REGISTRATION, "plan"))),
    ProcedureStep(DEVICES, "Devices", ((TRACKING, "tracker"), (ULTRASOUND, "device"), (TRACKING, "sharing"))),
    ProcedureStep("calibration", "Calibration", ((HAND, "pivot"), (TRACKING, "calibration"), (TRACKING, "base"))),
    ProcedureStep("landmarks", "Landmarks", ((HAND, "landmarks"), (TRACKING, "points"), (REGISTRATION, "landmarks"))),
    ProcedureStep(
        "ultrasound",
        "Ultrasound",
        (
            (ULTRASOUND, "protocol"),
            (ULTRASOUND, "palpation"),
            (HAND, "palpation"),
            (ULTRASOUND, "measure"),
            (REGISTRATION, "surface"),
        ),
    ),
    ProcedureStep("verification", "Verification", ((HAND, "targets"), (TRACKING, "checks"), (REGISTRATION, "verification"))),
    ProcedureStep("navigation", "Navigation", ((NAVIGATION, "navigation"), (HAND, "tour"))),
    ProcedureStep("report", "Report and export", ((SESSION, "report"),)),
)


def modules_of(step: str) -> list[str]:
    """The modules whose panels a step shows."""
    return list(dict.fromkeys(module for one in PROCEDURE if one.name == step for module, _ in one.parts))
