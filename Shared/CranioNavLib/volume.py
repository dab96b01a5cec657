"""Volume: a CT in Hounsfield units with its place in RAS."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from CranioNavLib.rigid import Array


@dataclass(frozen=True, eq=False)
class Volume:
    """Voxels in HU and the affine map from their indices to RAS.

    `hu[k, j, i]` lies at `ijk_to_ras @ (i, j, k, 1)` (mm): the order of SimpleITK's arrays and of MRML's IJKToRAS.
    """

    hu: npt.NDArray[np.int16]  # (K, J, I)
    ijk_to_ras: Array  # (4, 4)
    description: str = ""
