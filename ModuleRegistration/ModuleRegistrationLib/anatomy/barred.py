"""What a probe can touch but registration must not use: the jaw, which moves, and metal and enamel, which outshine bone."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from CranioNavLib.volume import Volume

from ModuleRegistrationLib.anatomy.bone import BoneVoxels
from ModuleRegistrationLib.anatomy.grid import Grid, Mask, subsampled
from ModuleRegistrationLib.anatomy.head import Head
from ModuleRegistrationLib.anatomy.spheres import dense_voxels, metal_threshold

CORE_SHARE = 0.62  # of the way from soft tissue to dense bone: at this level the jaw's joint and the open bite are gaps
JOINT_MM = 0.9  # grid on which those gaps (about 2 mm) are seen
SMALLEST_JAW_ML = 0.5
JAW_BELOW_TOP_MM = 95.0  # the jaw's condyles lie 105 to 125 mm under the top of the skull, nearly straight below it


def barred_cells(volume: Volume, head: Head, voxels: BoneVoxels, bone_hu: float) -> Mask:
    """The head's cells (its grid) near jaw, cervical spine, teeth and metal.

    Separate pieces of dense bone that lie wholly far below the top of the skull count as jaw or spine. Where
    the joint is fused in the CT, or the top of the skull is cut off, the jaw is not told apart.
    """
    barred = np.zeros(head.grid.shape, dtype=bool)
    for places in (_metal(volume), _jaw(voxels, bone_hu)):
        if len(places):
            barred.ravel()[head.cells(places.astype(np.float32), voxels.grid)] = True
    if not barred.any():
        return barred
    from scipy import ndimage

    return np.asarray(ndimage.binary_dilation(barred, np.ones((3, 3, 3))), dtype=bool)


def _metal(volume: Volume) -> npt.NDArray[np.float64]:
    """(N, 3) grid mm of voxels denser than bone."""
    index = dense_voxels(volume.hu, metal_threshold(volume.hu))
    places: npt.NDArray[np.float64] = (index * Grid.of(volume).spacing_mm)[:, ::-1]
    return places


def _jaw(voxels: BoneVoxels, bone_hu: float) -> npt.NDArray[np.float64]:
    """(N, 3) grid mm of dense bone that is jaw or cervical spine."""
    from scipy import ndimage

    strides = voxels.grid.strides(JOINT_MM)
    core = subsampled(voxels.hu, strides) >= voxels.soft_hu + CORE_SHARE * (bone_hu - voxels.soft_hu)
    labels, count = ndimage.label(core)
    sizes = np.bincount(labels.ravel(), minlength=count + 1)
    sizes[0] = 0
    large = sizes >= SMALLEST_JAW_ML * 1000 / (voxels.grid.voxel_mm3 * float(np.prod(strides)))
    cranium = int(np.argmax(sizes))
    boxes = ndimage.find_objects(labels)
    top = _height(boxes[cranium - 1], strides, voxels).max() if count else 0.0
    jaw = np.zeros(count + 1, dtype=bool)
    for label in np.flatnonzero(large):
        jaw[label] = label != cranium and _height(boxes[label - 1], strides, voxels).max() < top - JAW_BELOW_TOP_MM
    return _places(np.argwhere(jaw[labels]), strides, voxels)


def _places(index: npt.NDArray[np.int64], strides: tuple[int, int, int], voxels: BoneVoxels) -> npt.NDArray[np.float64]:
    """Grid mm of subscripts (N, 3) of the sub-sampled cut-out."""
    full = (index * np.array(strides) + np.array(strides) // 2) * voxels.grid.spacing_mm
    places: npt.NDArray[np.float64] = full[:, ::-1] + voxels.corner_mm
    return places


def _height(box: tuple[slice, slice, slice], strides: tuple[int, int, int], voxels: BoneVoxels) -> npt.NDArray[np.float64]:
    """Heights (superior, mm) of a box's eight corners."""
    corners = np.array([[box[a].stop - 1 if bits >> a & 1 else box[a].start for a in range(3)] for bits in range(8)])
    heights: npt.NDArray[np.float64] = voxels.grid.grid_mm_to_ras(_places(corners, strides, voxels))[:, 2]
    return heights
