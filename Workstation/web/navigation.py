"""Navigation: where a tool's tip is in the CT, how far from bone and target, and how far off it may be."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Any

import numpy as np
from CranioNavLib import scene, scene_data
from CranioNavLib.module_logic import ParametersInScene
from CranioNavLib.panel import Level, Panel, ParameterField, Reading, ReadOut, Step, StepState, StepStatus
from CranioNavLib.parameters import Parameters
from CranioNavLib.rigid import Array, transform_points
from CranioNavLib.scripted_module import ScriptedLoadableModuleLogic

TOOLS = ("Stylus", "Probe", "Sphere")  # the first one in view leads


@dataclass(frozen=True)
class NavigationParameters(Parameters):
    """What navigation keeps in the scene."""

    follow: Annotated[bool, "slices go through the tool's tip"] = True
    zoom: Annotated[bool, "slices show what is near the tip, so that a millimetre is seen"] = True
    ring: Annotated[bool, "the 95% error is drawn about the tip"] = True


PANEL = Panel(
    module="Navigation",
    title="Navigation",
    parameters=NavigationParameters,
    steps=(
        Step(
            "navigation",
            "Navigation",
            "Move a tool: the slices follow its tip. The ring holds the true place with 95% probability.",
            (
                ReadOut("leadingTool", "Tool"),
                ReadOut("boneDistance", "To the bone", "mm", large=True),
                ReadOut("nearestTarget", "To the nearest target", large=True),
                ReadOut("expectedError", "Error here, 95%", "mm", large=True),
                ReadOut("position", "Tip in the CT (right, front, up)", "mm"),
                ParameterField("follow", "Slices follow the tip"),
                ParameterField("zoom", "Zoom on the tip"),
                ParameterField("ring", "Ring of the 95% error"),
            ),
            status="navigationStatus",
        ),
    ),
)


class NavigationLogic(ParametersInScene, ScriptedLoadableModuleLogic):
    """Reads the scene alone; shows nothing by itself."""

    parameterClass = NavigationParameters
    sessionRole = "NavigationSession"

    def __init__(self, parent: Any = None) -> None:
        super().__init__(parent)
        self._bone: tuple[int, Any] = (0, None)

    def tip(self) -> tuple[str, Array] | None:
        """The leading tool and its tip (3,) in RAS; None without a registration or a tool in view."""
        node = scene.find("ReferenceToRas")
        if node is None or not node.GetAttribute(scene.STATUS_ATTRIBUTE):
            return None
        for tool in TOOLS:
            pose = scene_data.get_pose(f"{tool}ToReference")
            if pose.matrix is not None:
                return tool, transform_points(scene_data.get_transform("ReferenceToRas"), pose.matrix[:3, 3][None])[0]
        return None

    def error_mm(self, position_ras_mm: Array) -> float | None:
        """The 95% error to expect there; None where the registration says nothing of it."""
        from ModuleRegistrationLib.registration.error_theory import predict_tre

        known = scene_data.get_motion_error()
        if known is None:
            return None
        covariance, pivot, freedom = known
        return float(predict_tre(covariance, pivot, position_ras_mm[None], freedom).p95_mm[0])

    def leadingTool(self) -> Reading | None:
        """Which tool leads."""
        found = self.tip()
        return Reading(found[0], Level.GOOD) if found else None

    def position(self) -> Reading | None:
        """The tip in RAS."""
        found = self.tip()
        return Reading(", ".join(f"{value:.1f}" for value in found[1])) if found else None

    def boneDistance(self) -> Reading | None:
        """Distance from the tip to the skull."""
        found, surface = self.tip(), self._surface()
        if found is None or surface is None:
            return None
        return Reading(f"{float(surface.closest(found[1][None]).distances_mm[0]):.1f}")

    def nearestTarget(self) -> Reading | None:
        """The target nearest to the tip, and its distance."""
        found, node = self.tip(), scene.find("TargetsCT")
        if found is None or node is None or not node.GetNumberOfControlPoints():
            return None
        targets = scene_data.get_points("TargetsCT")
        distances = np.linalg.norm(targets.positions_mm - found[1], axis=1)
        return Reading(f"{targets.labels[int(np.argmin(distances))]}: {distances.min():.1f} mm")

    def expectedError(self) -> Reading | None:
        """The predicted 95% error at the tip."""
        found = self.tip()
        error = self.error_mm(found[1]) if found else None
        if error is None:
            return None
        return Reading(f"{error:.1f}", Level.GOOD if error < 3.0 else Level.WARNING)

    def navigationStatus(self) -> StepStatus:
        """Whether there is something to navigate by."""
        node = scene.find("ReferenceToRas")
        status = (node.GetAttribute(scene.STATUS_ATTRIBUTE) or "") if node is not None else ""
        if not status:
            return StepStatus(StepState.TODO, "register first (steps 5 and 6)")
        if status != "accepted":
            words = "by landmarks alone" if status == "landmarks" else "with a warning"
            return StepStatus(StepState.ATTENTION, f"registered {words}; see the verdict before trusting the tip")
        return StepStatus(StepState.DONE, "" if self.tip() else "Show a tool to the camera")

    def _surface(self) -> Any:
        node = scene.find("Bone")
        if node is None or node.GetPolyData() is None:
            return None
        stamp = node.GetPolyData().GetMTime()
        if self._bone[0] != stamp:
            self._bone = (stamp, scene_data.get_surface("Bone"))
        return self._bone[1]
