"""The head's skin as a closed surface: for views, and to see what a probe touches."""

from __future__ import annotations

from typing import Optional

import numpy as np
from CranioNavLib.surface import Surface
from CranioNavLib.volume import Volume

from ModuleRegistrationLib.anatomy.bone import BoneVoxels, bone_mesh
from ModuleRegistrationLib.anatomy.grid import Grid, subsampled
from ModuleRegistrationLib.anatomy.head import Head, find_head
from ModuleRegistrationLib.anatomy.outer_table import patch_labels

SKIN_MM = 1.5  # grid of the surface: skin is smooth, and the grey values tell its place to a fraction of that
AIR_HU, TISSUE_HU = -1000, 40
SKIN_HU = (AIR_HU + TISSUE_HU) / 2  # half way: where an evenly blurred edge stays in place
NEAR_MM = 4.0  # from the edge of the head's mask, a cell and a half: farther in all is tissue, farther out all is air


def skin_surface(volume: Volume, head: Optional[Head] = None) -> Surface:
    """The closed skin surface in RAS, outward normals: sinuses filled, holder and outstanding ears left out.

    Where the volume cuts the head off, the cut closes the surface.

    Raises
    ------
    InputError
        The volume is no head (see `find_head`).
    """
    from scipy import ndimage

    head = find_head(volume) if head is None else head
    full = Grid.of(volume)
    strides = full.strides(SKIN_MM)
    grid = full.coarser(strides)
    hu = np.clip(subsampled(volume.hu, strides), AIR_HU, TISSUE_HU)
    depth = ndimage.affine_transform(
        head.depth_mm,
        grid.spacing_mm / head.grid.spacing_mm,
        head.grid.to_index(grid.to_ras(np.zeros((1, 3))))[0],
        output_shape=hu.shape,
        order=1,
        mode="nearest",
    )
    hu[depth > NEAR_MM] = TISSUE_HU
    hu[depth < -NEAR_MM] = AIR_HU
    mesh = bone_mesh(BoneVoxels(np.pad(hu, 1, constant_values=AIR_HU), (0, 0, 0), grid, SKIN_HU, float(TISSUE_HU)))
    parts = patch_labels(len(mesh.points), mesh.triangles)[mesh.triangles[:, 0]]
    return mesh.surface(grid, mesh.triangles[parts == np.bincount(parts).argmax()])
