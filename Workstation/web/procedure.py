"""The procedure as the page shows it: nine steps, each made of steps of the modules' panels."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class ProcedureStep:
    """One entry of the stepper; its state is the most urgent of its parts."""

    name: str
    title: str
    parts: tuple[tuple[str, str], ...]  # (module, step of its panel)


PROCEDURE: tuple[ProcedureStep, ...] = (
    ProcedureStep("ct", "CT", (("ModuleRegistration", "ct"),)),
    ProcedureStep("bone", "Bone and markers", (("ModuleRegistration", "bone"),)),
    ProcedureStep("landmarks", "Landmarks", (("ModuleRegistration", "landmarks"),)),
    ProcedureStep("surface", "Surface", (("ModuleRegistration", "surface"),)),
    ProcedureStep("verification", "Verification", (("ModuleRegistration", "verification"),)),
    ProcedureStep("results", "Report and export", (("ModuleRegistration", "results"),)),
)
