"""Smooth random fields: what differs from place to place on one head, and stays the same when one comes back."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from CranioNavLib.rigid import Array

WAVES = 12


@dataclass(frozen=True, eq=False)
class SmoothField:
    """A stationary random function of position with mean 0 and SD 1: a sum of plane waves."""

    waves_per_mm: Array  # (W, 3) angular
    phases: Array  # (W,)

    @classmethod
    def draw(cls, rng: np.random.Generator, length_mm: float) -> SmoothField:
        """A field whose values are nearly unrelated at distances beyond `length_mm`."""
        return cls(rng.normal(0.0, 1.5 / length_mm, (WAVES, 3)), rng.uniform(0.0, 2 * np.pi, WAVES))

    def at(self, points_mm: npt.ArrayLike) -> Array:
        """(N,) values at points (N, 3)."""
        angles = np.asarray(points_mm, dtype=float) @ self.waves_per_mm.T + self.phases
        values: Array = np.cos(angles).sum(axis=1) * np.sqrt(2.0 / WAVES)
        return values

    def uniform_at(self, points_mm: npt.ArrayLike, low: float, high: float) -> Array:
        """(N,) values between `low` and `high`, uniformly distributed over many fields."""
        from scipy.special import ndtr

        share: Array = low + (high - low) * ndtr(self.at(points_mm))
        return share
