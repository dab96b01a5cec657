"""What a simulator of A-lines says of each line beside it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt


@dataclass(frozen=True, eq=False)
class Truth:
    """What was simulated in each of n lines."""

    depth_mm: npt.NDArray[np.float64]  # (n,) NaN: no bone
    tilt_deg: npt.NDArray[np.float64]  # (n,)
    speed_m_s: float
    snr_db: npt.NDArray[np.float64]  # (n,) of the bone's echo; -inf without
