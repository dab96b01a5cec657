"""Bone by one threshold over the whole CT: fast, the same level everywhere."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Optional

from CranioNavLib.parameters import Limits, Parameters
from CranioNavLib.volume import Volume

from ModuleRegistrationLib.anatomy.bone import bone_voxels, closed_surface, tissue_levels
from ModuleRegistrationLib.anatomy.grid import Grid
from ModuleRegistrationLib.anatomy.head import find_head
from ModuleRegistrationLib.anatomy.outer_table import outer_table
from ModuleRegistrationLib.anatomy.segmentation import BoneSurfaces, Segmentation


@dataclass(frozen=True)
class ThresholdSettings(Parameters):
    """What can be chosen."""

    threshold_hu: Annotated[Optional[float], Limits(100, 1500), "bone is denser than this; empty: found from the CT"] = None


class ThresholdSegmentation(Segmentation):
    """Iso-surface of the CT at a threshold that is found from the CT, or given."""

    name = "threshold"
    title = "Iso-surface at one threshold, found from the CT"
    Settings = ThresholdSettings

    def segment(self, volume: Volume) -> BoneSurfaces:
        """The bone of `volume`; see Segmentation.segment."""
        head = find_head(volume)
        soft_hu, automatic_hu, _ = tissue_levels(volume, head)
        threshold = automatic_hu if self.settings.threshold_hu is None else self.settings.threshold_hu
        voxels = bone_voxels(volume, head, threshold, soft_hu)
        grid = Grid.of(volume)
        closed = closed_surface(voxels, grid)
        return BoneSurfaces(
            closed=closed,
            outer_table=outer_table(closed, voxels, grid, head),
            threshold_hu=threshold,
            position_sd_mm=0.3,
            offset_sd_mm=0.3,
        )
