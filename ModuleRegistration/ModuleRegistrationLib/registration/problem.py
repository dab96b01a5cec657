"""The surface registration plugin kind: one problem type in, one result type out."""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import dataclass, field
from typing import Optional

import numpy as np
import numpy.typing as npt
from CranioNavLib.bone_points import BonePoints
from CranioNavLib.plugins import Plugin, PluginKind
from CranioNavLib.rigid import Array
from CranioNavLib.surface import Surface


@dataclass(frozen=True, eq=False)
class RegistrationProblem:
    """What a registration method is given. Points are in Reference, the surface and landmarks_ct in RAS, mm."""

    surface: Surface  # the outer table of the skull
    points: BonePoints  # Reference frame
    initial_reference_to_ras: Array  # (4, 4), the landmark registration
    landmarks_ct_mm: Array = field(default_factory=lambda: np.empty((0, 3)))  # (L, 3) RAS, paired with:
    landmarks_patient_mm: Array = field(default_factory=lambda: np.empty((0, 3)))  # (L, 3) Reference
    landmark_sd_mm: Optional[float] = None  # FLE per axis of the pairs; None: to be estimated or assumed by the method
    landmark_covariances_mm2: Optional[Array] = None  # (L, 3, 3) of landmarks_patient_mm, Reference axes, where each is known
    surface_sd_mm: float = 0.3  # how far the segmented surface is from the bone, common offset (threshold bias) left out
    surface_offset_sd_mm: float = 0.5  # prior SD of the segmentation's common offset along the normal
    seed: int = 0  # for methods that draw random starts


@dataclass(frozen=True, eq=False)
class Minimum:
    """One place where the search ended."""

    reference_to_ras: Array  # (4, 4)
    probability: float  # relative to the others found, given the data


@dataclass(frozen=True, eq=False)
class RegistrationResult:
    """What every registration method gives back."""

    method: str
    reference_to_ras: Array  # (4, 4)
    surface_rms_mm: float  # RMS distance of the used points to the surface; not an accuracy
    residuals_mm: Array  # (N,) distance of each point to the surface after registration, signed: + outside the bone
    used: npt.NDArray[np.bool_]  # (N,) False: rejected as an outlier
    iterations: int
    stop_reason: str  # in words: "change below 1e-6 mm", "iteration limit 100"
    points_ras_mm: Array  # (N, 3) the points as registered (speed of sound and offset applied)
    covariance: Optional[Array] = (
        None  # (6, 6) of a small motion (rotation rad about pivot_ras_mm, then translation mm), in RAS axes
    )
    pivot_ras_mm: Array = field(default_factory=lambda: np.zeros(3))  # (3,)
    speed_of_sound_m_s: float = float("nan")  # estimated or assumed; NaN: no sound was used
    speed_of_sound_sd_m_s: float = float("nan")
    surface_offset_mm: float = 0.0  # common distance of the points from the segmented surface
    minima: tuple[Minimum, ...] = ()  # all plausible ends of the search, best first
    degrees_of_freedom: Optional[float] = None  # behind the scale of `covariance`; None: enough, or already in it


class SurfaceRegistration(Plugin):
    """Base of surface registration plugins."""

    @abstractmethod
    def register(self, problem: RegistrationProblem) -> RegistrationResult:
        """Solve `problem`.

        Raises
        ------
        InputError
            The points cannot hold six degrees of freedom, or lie nowhere near the surface.
        """


METHODS: PluginKind[SurfaceRegistration] = PluginKind("registration", SurfaceRegistration, folder="ModuleRegistrationLib.plugins")  # type: ignore[type-abstract]
