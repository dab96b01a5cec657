"""How tools and hands move over time: smooth paths, and tremor as a function of time."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy

from CranioNavLib.phantom import constants
from CranioNavLib.rigid import Array, rigid

TREMOR_WAVES = 6
SWAY_HZ = (0.1, 1.0)  # slow sway of a held hand
TREMOR_SHARE = 0.2  # of the variance in physiological tremor, the rest in sway


@dataclass(frozen=True, eq=False)
class Tremor:
    """A random motion of SD 1 on each of some axes, defined for every time."""

    rates_rad_s: Array  # (W, A)
    phases: Array  # (W, A)
    weights: Array  # (W, A)

    @classmethod
    def draw(cls, rng: np.random.Generator, axes: int) -> Tremor:
        """Sway below 1 Hz and tremor of 8-12 Hz."""
        sway = rng.uniform(*SWAY_HZ, (TREMOR_WAVES, axes))
        shake = rng.uniform(constants.TREMOR_HZ, constants.TREMOR_HZ + 4.0, (TREMOR_WAVES, axes))
        shares = [np.full((TREMOR_WAVES, axes), share) for share in (1 - TREMOR_SHARE, TREMOR_SHARE)]
        return cls(
            2 * np.pi * np.vstack([sway, shake]),
            rng.uniform(0, 2 * np.pi, (2 * TREMOR_WAVES, axes)),
            np.sqrt(np.vstack(shares) * 2 / TREMOR_WAVES),
        )

    def at(self, time_s: float) -> Array:
        """(A,) displacement at a time."""
        moved: Array = (self.weights * np.sin(self.rates_rad_s * time_s + self.phases)).sum(axis=0)
        return moved


@dataclass(frozen=True, eq=False)
class Path:
    """From one pose to another, smoothly (minimum jerk), with a lift on the way."""

    start: Array  # (4, 4)
    goal: Array  # (4, 4)
    begin_s: float
    duration_s: float
    lift: Array  # (3,) largest displacement on the way, mm

    def at(self, time_s: float) -> Array:
        """(4, 4) pose at a time."""
        share = float(np.clip((time_s - self.begin_s) / max(self.duration_s, 1e-6), 0.0, 1.0))
        smooth = share**3 * (10 - 15 * share + 6 * share**2)
        if smooth >= 1.0:
            return self.goal
        turn = scipy.spatial.transform.Slerp(
            [0.0, 1.0], scipy.spatial.transform.Rotation.from_matrix([self.start[:3, :3], self.goal[:3, :3]])
        )(smooth).as_matrix()
        place = (1 - smooth) * self.start[:3, 3] + smooth * self.goal[:3, 3] + np.sin(np.pi * smooth) * self.lift
        return rigid(turn, place)

    def arrived(self, time_s: float) -> bool:
        """Whether the way is behind."""
        return time_s >= self.begin_s + self.duration_s


@dataclass(frozen=True, eq=False)
class Slide:
    """To the first of many poses as a `Path` goes, then through all of them at a steady pace."""

    approach: Path  # its goal is the first pose
    poses: Array  # (L >= 2, 4, 4)
    duration_s: float  # of the slide alone

    @property
    def begin_s(self) -> float:
        """When the approach begins."""
        return self.approach.begin_s

    def at(self, time_s: float) -> Array:
        """(4, 4) pose at a time."""
        if not self.approach.arrived(time_s):
            return self.approach.at(time_s)
        step = self._share(time_s) * (len(self.poses) - 1)
        before = min(int(step), len(self.poses) - 2)
        turns = scipy.spatial.transform.Rotation.from_matrix(self.poses[before : before + 2, :3, :3])
        share = step - before
        turn = scipy.spatial.transform.Slerp([0.0, 1.0], turns)(share).as_matrix()
        return rigid(turn, (1 - share) * self.poses[before, :3, 3] + share * self.poses[before + 1, :3, 3])

    def arrived(self, time_s: float) -> bool:
        """Whether the way is behind."""
        return self._share(time_s) >= 1.0

    def travelled_mm(self, time_s: float) -> float:
        """Length of the slide so far."""
        steps = np.linalg.norm(np.diff(self.poses[:, :3, 3], axis=0), axis=1)
        return float(self._share(time_s) * steps.sum())

    def _share(self, time_s: float) -> float:
        begun_s = self.approach.begin_s + self.approach.duration_s
        return float(np.clip((time_s - begun_s) / max(self.duration_s, 1e-6), 0.0, 1.0))
