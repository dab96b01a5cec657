"""The step that finds what registration needs in the CT: bone, titanium spheres, skin."""

from __future__ import annotations

from typing import TYPE_CHECKING

from CranioNavLib import scene, scene_data
from CranioNavLib.errors import InputError
from CranioNavLib.module_logic import done_or
from CranioNavLib.panel import Progress, StepStatus, Task
from CranioNavLib.slicer_files import LabelledPoints
from CranioNavLib.surface import Surface

from ModuleRegistrationLib.logic.given import OFFSET_SD, POSITION_SD, THRESHOLD, RegistrationStep, lacking_ct, of_this_ct

if TYPE_CHECKING:
    from ModuleRegistrationLib.anatomy.segmentation import BoneSurfaces
    from ModuleRegistrationLib.anatomy.spheres import SphereMarkers


class BoneStep(RegistrationStep):
    """Bone and OuterTable, TargetsCT from spheres, Skin."""

    def segmentBone(self) -> Task:
        """Find the skull in the CT of the scene; writes Bone and OuterTable."""
        from ModuleRegistrationLib.anatomy.segmentation import segment_bone

        volume = scene_data.get_volume("CT")
        name = self.parameters().read().segmentation
        settings = self.createPlugin("segmentation", name).settings
        values = {info.name: getattr(settings, info.name) for info in settings.describe()}

        def segment(progress: Progress) -> BoneSurfaces:
            progress("finding bone", 0.1)
            found = segment_bone(volume, method=name, **values)
            progress("preparing its surface for what comes", 0.8)
            return prepared(found)

        return Task("Find bone", segment, of_this_ct(self.takeBone))

    def segmentBoneBlocked(self) -> str:
        """Why bone cannot be segmented now."""
        return lacking_ct()

    def takeBone(self, bone: BoneSurfaces) -> str:
        """Make a bone the scene's, with what its segmentation promises of it."""
        scene_data.set_surface("Bone", bone.closed)
        table = scene_data.set_surface("OuterTable", bone.outer_table)
        table.GetDisplayNode().SetVisibility(False)  # it lies on Bone: drawn with it, both flicker
        promised = {POSITION_SD: bone.position_sd_mm, OFFSET_SD: bone.offset_sd_mm, THRESHOLD: bone.threshold_hu}
        for attribute, value in promised.items():
            table.SetAttribute(attribute, repr(float(value)))
        return f"skull found above {bone.threshold_hu:.0f} HU; the points will be laid on the outer table"

    def findMarkers(self) -> Task:
        """Find titanium spheres in the CT; their centres become TargetsCT."""
        from ModuleRegistrationLib.anatomy.spheres import find_spheres

        volume, diameter = scene_data.get_volume("CT"), self.parameters().read().marker_diameter_mm

        def search(progress: Progress) -> SphereMarkers:
            progress("looking for spheres", 0.1)
            return find_spheres(volume, diameter)

        def take(found: SphereMarkers) -> str:
            if not len(found):
                raise InputError(f"no spheres of {diameter:g} mm in the CT; check their diameter, or place targets by hand")
            labels = tuple(f"Sphere {number + 1}" for number in range(len(found)))
            scene_data.set_points("TargetsCT", LabelledPoints(labels, found.centers_ras_mm))
            return f"{len(found)} spheres found"

        return Task("Find spheres", search, of_this_ct(take))

    def findMarkersBlocked(self) -> str:
        """Why markers cannot be searched now."""
        return lacking_ct()

    def findSkin(self) -> Task:
        """Find the skin in the CT of the scene; writes Skin."""
        from ModuleRegistrationLib.anatomy.skin import skin_surface

        volume = scene_data.get_volume("CT")

        def find(progress: Progress) -> Surface:
            progress("finding the skin", 0.1)
            return skin_surface(volume)

        def take(skin: Surface) -> str:
            scene_data.set_surface("Skin", skin)
            return f"skin: {len(skin.triangles)} triangles"

        return Task("Find skin", find, of_this_ct(take))

    def findSkinBlocked(self) -> str:
        """Why the skin cannot be searched now."""
        return lacking_ct()

    def boneStatus(self) -> StepStatus:
        """Whether the outer table is there."""
        return done_or(scene.find("OuterTable") is not None, "find the bone in the CT")


def prepared(bone: BoneSurfaces) -> BoneSurfaces:
    """The surfaces of a bone with normals and index made, so that the thread of the scene need not make them."""
    for surface in (bone.closed, bone.outer_table):
        surface.prepare()
    return bone
