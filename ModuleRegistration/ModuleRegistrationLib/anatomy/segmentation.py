"""The segmentation plugin kind: a CT in, the skull's outer table out."""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import dataclass
from typing import Any

from CranioNavLib.errors import InputError
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


def segment_bone(volume: Volume, method: str = "threshold", cached: bool = True, **settings: Any) -> BoneSurfaces:
    """The bone of a head CT, by a segmentation plugin; a CT segmented before is not segmented again.

    Parameters
    ----------
    volume
        The CT.
    method
        Name of the plugin.
    cached
        False: segment anew and keep nothing.
    **settings
        The plugin's settings, by name.

    Raises
    ------
    InputError
        Unknown method or setting; the volume is no head CT, or holds no bone.
    """
    from ModuleRegistrationLib.anatomy import surface_cache

    plugin_class = SEGMENTATIONS.find(method)
    known = [info.name for info in plugin_class.Settings.describe()]
    unknown = sorted(set(settings) - set(known))
    if unknown:
        raise InputError(f"segmentation {method!r} has no setting {unknown[0]!r}; known: {', '.join(known) or 'none'}")
    plugin = plugin_class(plugin_class.Settings(**settings))
    if not cached:
        return plugin.segment(volume)
    key = surface_cache.content_key(volume, method, repr(plugin.settings), plugin_class.__module__)
    kept = surface_cache.load(key)
    if kept is None:
        kept = plugin.segment(volume)
        surface_cache.save(key, kept)
    return kept
