"""The virtual patient: a head with true surfaces, markers and tissue, in an unknown place before the tracker."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Optional

import numpy as np
import numpy.typing as npt
import scipy

from CranioNavLib.errors import InputError
from CranioNavLib.phantom import constants
from CranioNavLib.phantom.anatomy import HeadSurfaces, extract_head
from CranioNavLib.phantom.conditions import Condition, condition_named
from CranioNavLib.phantom.planning_ct import scan
from CranioNavLib.phantom.sites import LANDMARK_LABELS, SAMPLE_HEAD_LANDMARKS_MM, marker_positions, snap_to_bone
from CranioNavLib.phantom.tracking import TrackerError
from CranioNavLib.phantom.ultrasound import Tissue, acquisition, simulate_lines
from CranioNavLib.rigid import Array, invert_rigid, rigid, rigid_from_vector, transform_points
from CranioNavLib.sample_head import SHA256 as SAMPLE_SHA256
from CranioNavLib.sample_head import SHAPE as SAMPLE_SHAPE
from CranioNavLib.sequence_metafile import Acquisition
from CranioNavLib.surface import Surface
from CranioNavLib.volume import Volume


@dataclass(frozen=True, eq=False)
class Scanned:
    """What all patients made from one CT share: the head, its markers, and its planning CT. RAS, mm."""

    volume: Volume
    head: HeadSurfaces
    landmarks_ras_mm: Array  # (4, 3)
    markers_ras_mm: Array  # (10, 3) centres of the titanium spheres
    screws_ras_mm: Array  # (4, 3)
    stickers_ras_mm: Array  # (6, 3)
    ct_seed: int

    @cached_property
    def planning_ct(self) -> Volume:
        """The head at the study's scanner protocol, spheres on it."""
        return scan(self.volume, self.head.head_mask, self.markers_ras_mm, np.random.default_rng([self.ct_seed, 0xC7]))


@dataclass(frozen=True, eq=False)
class VirtualPatient:
    """One patient in one session. Everything drawn comes from the seed."""

    scanned: Scanned
    seed: int
    true_reference_to_ras: Array  # (4, 4)
    tissue: Tissue
    tracker_error: TrackerError
    acquisition: Acquisition
    probe_calibration_error: Array  # (4, 4) the reported Probe frame in the true one
    condition: Condition

    @property
    def planning_ct(self) -> Volume:
        """What a user is given of this head: a CT at the study's protocol."""
        return self.scanned.planning_ct

    @property
    def bone(self) -> Surface:
        """True bone, RAS."""
        return self.scanned.head.bone

    @property
    def skin(self) -> Surface:
        """True skin, RAS."""
        return self.scanned.head.skin

    @property
    def markers_ras_mm(self) -> Array:
        """(10, 3) true centres of the titanium spheres."""
        return self.scanned.markers_ras_mm

    @property
    def landmarks_ras_mm(self) -> Array:
        """(4, 3) true anatomical landmarks, on the bone."""
        return self.scanned.landmarks_ras_mm

    @property
    def landmark_labels(self) -> tuple[str, ...]:
        """Names of the landmarks."""
        return LANDMARK_LABELS

    @property
    def speed_of_sound_m_s(self) -> float:
        """True mean speed of sound in the scalp."""
        return self.tissue.speed_of_sound_m_s

    @property
    def ras_to_reference(self) -> Array:
        """The inverse of the true registration."""
        return invert_rigid(self.true_reference_to_ras)

    def rf_lines(self, probe_to_reference: npt.ArrayLike, rng: np.random.Generator) -> npt.NDArray[np.int16]:
        """RF lines (F, N) that the probe takes at its TRUE poses (F, 4, 4)."""
        poses = np.asarray(probe_to_reference, dtype=float)
        return simulate_lines(self.bone, self.skin, self.tissue, self.true_reference_to_ras @ poses, rng)

    def digitise(self, points_ras_mm: npt.ArrayLike, rng: np.random.Generator, sd_mm: float) -> Array:
        """Points (N, 3) of the head as a tracked tip touches them, in Reference.

        `sd_mm` (per axis) is how well the user finds each point; the tracker's own error comes on top.
        """
        points = transform_points(self.ras_to_reference, points_ras_mm)
        found = points + rng.normal(0.0, sd_mm, points.shape)
        return self.tracker_error.of_points(found, rng)


def make_patient(
    volume: Optional[Volume],
    seed: int,
    landmarks_ras_mm: Optional[npt.ArrayLike] = None,
    ct_seed: int = 0,
    condition: str = "phantom",
) -> VirtualPatient:
    """A virtual patient with the head in `volume`; None: the parametric synthetic head.

    Patients of one volume and `ct_seed` share head, markers and planning CT (a head is scanned once); `seed` draws the
    place in Reference, the tissue, and the tracker's axes. The landmarks are known for the sample head and the synthetic
    head, and must be given (4, 3; in the order of LANDMARK_LABELS, RAS) for another. `condition` names the kind of
    study: "phantom", "cadaver" or "patient".

    Raises
    ------
    InputError
        `volume` holds no head, its landmarks are neither known nor given, or there is no such condition.
    """
    drawn_for = condition_named(condition)
    if volume is None:
        scanned = _scan_synthetic(ct_seed)
    else:
        given = None if landmarks_ras_mm is None else np.asarray(landmarks_ras_mm, dtype=float)
        scanned = _scan_volume(_Keyed(volume, given), ct_seed)
    rng = np.random.default_rng([seed, 0x9A])
    distance = rng.uniform(*constants.REFERENCE_BASE_DISTANCE_MM)
    direction = rng.normal(size=3)
    base_to_ras = rigid(
        scipy.spatial.transform.Rotation.random(random_state=rng).as_matrix(),
        scanned.head.skin.center_mm + distance * direction / np.linalg.norm(direction),
    )
    return VirtualPatient(
        scanned=scanned,
        seed=seed,
        true_reference_to_ras=base_to_ras,
        tissue=Tissue.draw(rng, drawn_for),
        tracker_error=TrackerError(scipy.spatial.transform.Rotation.random(random_state=rng).as_matrix()),
        acquisition=acquisition(),
        probe_calibration_error=rigid_from_vector(
            np.radians(rng.normal(0.0, constants.PROBE_CALIBRATION_SD_DEG, 3)),
            rng.normal(0.0, constants.PROBE_CALIBRATION_SD_MM, 3),
        ),
        condition=drawn_for,
    )


class _Keyed:
    """A volume with its landmarks, hashed by content: equal CTs share one extraction."""

    def __init__(self, volume: Volume, landmarks: Optional[Array]) -> None:
        import hashlib

        self.volume, self.landmarks = volume, landmarks
        digest = hashlib.sha256(volume.hu.tobytes())
        digest.update(volume.ijk_to_ras.astype(float).tobytes())
        digest.update(b"" if landmarks is None else landmarks.tobytes())
        self.key = digest.hexdigest()

    def __hash__(self) -> int:
        return hash(self.key)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _Keyed) and other.key == self.key


@lru_cache(maxsize=2)
def _scan_volume(keyed: _Keyed, ct_seed: int) -> Scanned:
    landmarks = keyed.landmarks if keyed.landmarks is not None else _known_landmarks(keyed.volume)
    return _scanned(keyed.volume, landmarks, ct_seed)


@lru_cache(maxsize=2)
def _scan_synthetic(ct_seed: int) -> Scanned:
    from CranioNavLib.phantom.synthetic_head import synthetic_head

    volume, landmarks = synthetic_head()
    return _scanned(volume, landmarks, ct_seed)


def _scanned(volume: Volume, landmarks: Array, ct_seed: int) -> Scanned:
    head = extract_head(volume)
    on_bone = snap_to_bone(landmarks, head.bone)
    places = marker_positions(head.bone, head.skin, on_bone, np.random.default_rng([ct_seed, 0x3E]))
    return Scanned(volume, head, on_bone, *places, ct_seed=ct_seed)


def knows_landmarks(volume: Volume) -> bool:
    """Whether the landmarks of this CT are known without being told: it is the sample head."""
    try:
        _known_landmarks(volume)
    except InputError:
        return False
    return True


def _known_landmarks(volume: Volume) -> Array:
    """The landmarks of the sample head, wherever its volume was moved to."""
    import hashlib

    if volume.hu.shape == SAMPLE_SHAPE:
        raw = volume.hu[:, ::-1, :].astype("<i2")
        if hashlib.sha256(raw.tobytes()).hexdigest() == SAMPLE_SHA256:
            return np.array(SAMPLE_HEAD_LANDMARKS_MM)
    raise InputError("the landmarks of this CT are not known; give four in RAS: " + ", ".join(LANDMARK_LABELS))
