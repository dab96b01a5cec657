"""The segmentation plugin kind: a CT in, the skull's outer table out."""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import dataclass

from CranioNavLib.plugins import Plugin, PluginKind
from CranioNavLib.surface import Surface
from CranioNavLib.volume import Volume


@dataclass(frozen=True, eq=False)
class BoneSurfaces:
    """What a segmentation finds."""

    closed: Surface  # the whole bone, closed, outward normals: for views and for the file
    outer_table: Surface  # only where a probe on the skin can reach, openings and hardware left out: for registration
    threshold_hu: float
    position_sd_mm: float  # random error of the surface along its normal
    offset_sd_mm: float  # SD of the common offset that the choice of threshold leaves


class Segmentation(Plugin):
    """Base of segmentation plugins."""

    @abstractmethod
    def segment(self, volume: Volume) -> BoneSurfaces:
        """The bone of `volume`.

        Raises
        ------
        InputError
            The volume holds no bone, or is no head.
        """


SEGMENTATIONS: PluginKind[Segmentation] = PluginKind("segmentation", Segmentation, folder="ModuleRegistrationLib.plugins")  # type: ignore[type-abstract]
