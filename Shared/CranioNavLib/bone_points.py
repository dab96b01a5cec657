"""BonePoints: points measured on the skull, with what is known of their error.

The one form in which palpation (stylus) and ultrasound hand their points to registration.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
import numpy.typing as npt

from CranioNavLib.errors import InputError
from CranioNavLib.rigid import Array, check_points, rotate_covariances, transform_directions, transform_points


@dataclass(frozen=True, eq=False)
class BonePoints:
    """N points on the bone, in one frame (mm).

    `covariances_mm2` holds each point's own error. What all points of a recording share (speed of sound,
    a common depth offset) is not in it: registration estimates that together with the pose, for which
    `depths_mm` and `beam_directions` say how a point moves. A point whose tissue depth is `d` at the speed
    `speed_of_sound_m_s` moves by `beam * d * (c / speed_of_sound_m_s - 1)` when the speed is really `c`.
    """

    positions_mm: Array  # (N, 3)
    covariances_mm2: Array  # (N, 3, 3)
    beam_directions: Array  # (N, 3) unit, from the probe into the bone; NaN rows: no beam (a stylus)
    depths_mm: Array  # (N,) tissue path along the beam; 0 for a stylus
    qualities: Array  # (N,) 0..1, probability that the depth is right to 0.5 mm
    labels: tuple[str, ...]
    speed_of_sound_m_s: float = float("nan")  # NaN: no sound was used
    speed_of_sound_sd_m_s: float = 0.0  # prior SD of the speed common to these points
    # Other echoes that may have been the bone: depth (N, K) in mm along the beam and probability; NaN pads.
    # The chosen echo is not among them; its probability is what is left to 1.
    alternative_depths_mm: Array = field(default_factory=lambda: np.empty((0, 0)))
    alternative_probabilities: Array = field(default_factory=lambda: np.empty((0, 0)))
    groups: npt.NDArray[np.int64] = field(default_factory=lambda: np.empty(0, dtype=np.int64))  # (N,) sweep or palpation point

    def __post_init__(self) -> None:
        count = len(check_points(self.positions_mm, "bone points"))
        if self.alternative_depths_mm.size == 0:
            object.__setattr__(self, "alternative_depths_mm", np.empty((count, 0)))
            object.__setattr__(self, "alternative_probabilities", np.empty((count, 0)))
        if self.groups.size == 0:
            object.__setattr__(self, "groups", np.arange(count))
        shapes = {
            "covariances_mm2": (count, 3, 3),
            "beam_directions": (count, 3),
            "depths_mm": (count,),
            "qualities": (count,),
            "groups": (count,),
            "alternative_probabilities": (count, self.alternative_depths_mm.shape[1]),
        }
        for name, shape in shapes.items():
            if getattr(self, name).shape != shape:
                raise InputError(f"expected {name} of shape {shape} for {count} bone points, got {getattr(self, name).shape}")
        if len(self.labels) != count:
            raise InputError(f"expected {count} labels for {count} bone points, got {len(self.labels)}")

    def __len__(self) -> int:
        return len(self.positions_mm)

    @classmethod
    def palpated(cls, positions_mm: npt.ArrayLike, sd_mm: float, labels: tuple[str, ...] | None = None) -> BonePoints:
        """Points touched with a stylus: equal error `sd_mm` on each axis, no beam, no depth."""
        positions = check_points(positions_mm, "palpated points")
        count = len(positions)
        return cls(
            positions_mm=positions,
            covariances_mm2=np.tile(np.eye(3) * sd_mm**2, (count, 1, 1)),
            beam_directions=np.full((count, 3), np.nan),
            depths_mm=np.zeros(count),
            qualities=np.ones(count),
            labels=labels if labels is not None else tuple(f"P{index + 1}" for index in range(count)),
        )

    @property
    def has_beam(self) -> npt.NDArray[np.bool_]:
        """(N,) whether a point was seen by ultrasound."""
        return np.asarray(np.isfinite(self.beam_directions).all(axis=1))

    def subset(self, which: npt.ArrayLike) -> BonePoints:
        """The points that a mask or index array picks, in its order."""
        index = np.arange(len(self))[np.asarray(which)]
        names = ["positions_mm", "covariances_mm2", "beam_directions", "depths_mm", "qualities",
                 "alternative_depths_mm", "alternative_probabilities", "groups"]  # fmt: skip
        return replace(self, labels=tuple(self.labels[i] for i in index), **{name: getattr(self, name)[index] for name in names})

    def transformed(self, matrix: npt.ArrayLike) -> BonePoints:
        """The same points in the frame that a rigid `matrix` (4, 4) maps to."""
        return replace(
            self,
            positions_mm=transform_points(matrix, self.positions_mm),
            covariances_mm2=rotate_covariances(matrix, self.covariances_mm2),
            beam_directions=transform_directions(matrix, self.beam_directions),
        )

    def at_speed(self, speed_of_sound_m_s: float) -> BonePoints:
        """The points as they lie if the speed of sound in the tissue is `speed_of_sound_m_s`.

        Raises
        ------
        InputError
            The points carry no speed of sound.
        """
        if not np.isfinite(self.speed_of_sound_m_s):
            raise InputError("these points were not measured by ultrasound; they have no speed of sound to change")
        factor = speed_of_sound_m_s / self.speed_of_sound_m_s
        shift = np.nan_to_num(self.beam_directions) * (self.depths_mm * (factor - 1))[:, None]
        return replace(
            self,
            positions_mm=self.positions_mm + shift,
            depths_mm=self.depths_mm * factor,
            alternative_depths_mm=self.alternative_depths_mm * factor,
            speed_of_sound_m_s=speed_of_sound_m_s,
        )
