"""From a CT to its bone surface and outer table: the steps that the segmentation plugins share."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Optional

from CranioNavLib.volume import Volume

from ModuleRegistrationLib.anatomy.barred import barred_cells
from ModuleRegistrationLib.anatomy.bone import BoneMesh, BoneVoxels, bone_mesh, bone_voxels, tissue_levels
from ModuleRegistrationLib.anatomy.head import Head, find_head
from ModuleRegistrationLib.anatomy.outer_table import Triangles, outer_table


@dataclass(frozen=True, eq=False)
class Extraction:
    """What the steps find."""

    head: Head
    voxels: BoneVoxels
    mesh: BoneMesh
    outer: Triangles  # (M, 3) the mesh's triangles that can be palpated
    bone_hu: float  # mean of dense bone


def extract(volume: Volume, threshold_hu: Optional[float] = None) -> Extraction:
    """Head, bone and outer table of a CT, at a threshold that is found from it unless given.

    Raises
    ------
    InputError
        The volume is no head CT in HU, or holds no bone that can be reached.
    """
    head = find_head(volume)
    soft_hu, automatic_hu, bone_hu = tissue_levels(volume, head)
    voxels = bone_voxels(volume, head, automatic_hu if threshold_hu is None else threshold_hu, soft_hu)
    with ThreadPoolExecutor(1) as beside:
        barred = beside.submit(barred_cells, volume, head, voxels, bone_hu)
        mesh = bone_mesh(voxels)
        return Extraction(head, voxels, mesh, outer_table(mesh, voxels, head, barred.result()), bone_hu)
