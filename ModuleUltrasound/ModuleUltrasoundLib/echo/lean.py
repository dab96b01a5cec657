"""A few numpy calls written for small arrays.

One A-line alone passes through hundreds of calls on arrays of eight numbers. There numpy's own `clip`, `median`, `nan_to_num` and
`take_along_axis` spend 3 to 15 microseconds each on what they check; these spend one or two.
"""

from __future__ import annotations

from typing import Any, TypeVar

import numpy as np
import numpy.typing as npt

ONE_THREAD = 200_000  # products of numbers in a matrix product; OpenBLAS spreads larger ones, and its threads wait by spinning

Number = TypeVar("Number", bound="np.number[Any]")
Real = TypeVar("Real", bound="np.floating[Any]")
Scalar = TypeVar("Scalar", bound="np.generic")


def clip(values: npt.NDArray[Number], least: float, most: float) -> npt.NDArray[Number]:
    """Values between `least` and `most`; what is not a number stays so."""
    return np.asarray(np.minimum(np.maximum(values, least), most))


def without_nan(values: npt.NDArray[Real], instead: float = 0.0) -> npt.NDArray[Real]:
    """Values, with `instead` where they are not a number. Infinite ones stay."""
    return np.asarray(np.where(np.isnan(values), values.dtype.type(instead), values))


def median(values: npt.NDArray[np.floating[Any]]) -> float:
    """Median of values (n,), n >= 1, all of them numbers."""
    ordered = np.sort(values)
    count = len(ordered)
    return 0.5 * (float(ordered[(count - 1) // 2]) + float(ordered[count // 2]))


def pick(values: npt.NDArray[Scalar], index: npt.NDArray[np.int64]) -> npt.NDArray[Scalar]:
    """The columns `index` (n, K) of each row of values (n, M, ...)."""
    return np.asarray(values[np.arange(len(values))[:, None], index])


def at_samples(values: npt.NDArray[Scalar], samples: npt.NDArray[np.int64]) -> npt.NDArray[Scalar]:
    """Samples (..., n) of each line of values (n, M)."""
    return np.asarray(values.reshape(-1).take(samples + np.arange(0, values.size, values.shape[1])))


def product(left: npt.NDArray[np.float32], right: npt.NDArray[np.float32]) -> npt.NDArray[np.float32]:
    """left (n, M) @ right (M, K), piece by piece on this thread alone: others would have to wait for their share longer than
    the work takes, and to keep a second core busy meanwhile."""
    rows = max(ONE_THREAD // right.size, 1)
    whole = np.empty((len(left), right.shape[1]), dtype=np.float32)
    for start in range(0, len(left), rows):
        np.matmul(left[start : start + rows], right, out=whole[start : start + rows])
    return whole
