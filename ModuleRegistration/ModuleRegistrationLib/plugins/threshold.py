"""Bone by one threshold over the whole CT: fast, the same level everywhere.

The surface lies outside the true edge by 0.3 to 0.5 mm on average: 0.14 to 0.3 mm on the sides of the head, 0.5 to
0.7 mm on its top (measured on analytic shells, 0.42 mm pixels, 2 mm slices). `gradient` takes most of that away.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Optional

from CranioNavLib.parameters import Limits, Parameters
from CranioNavLib.volume import Volume

from ModuleRegistrationLib.anatomy.extraction import extract
from ModuleRegistrationLib.anatomy.segmentation import BoneSurfaces, Segmentation

POSITION_SD_PER_SPACING = 0.1  # SD of the surface on analytic shells, relative to the largest voxel side: 0.06 to 0.1
OFFSET_SD_MM = 0.4  # their mean distance outside the true edge: 0.31 to 0.49 mm


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
        found = extract(volume, self.settings.threshold_hu)
        return BoneSurfaces(
            closed=found.mesh.surface(found.voxels.grid),
            outer_table=found.mesh.surface(found.voxels.grid, found.outer),
            threshold_hu=found.voxels.threshold_hu,
            position_sd_mm=POSITION_SD_PER_SPACING * float(found.voxels.grid.spacing_mm.max()),
            offset_sd_mm=OFFSET_SD_MM,
        )
