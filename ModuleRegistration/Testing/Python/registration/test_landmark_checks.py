import numpy as np
import pytest
from CranioNavLib.errors import InputError
from CranioNavLib.rigid import rigid, transform_points
from ModuleRegistrationLib.registration.landmark_checks import check_landmarks, misfit
from ModuleRegistrationLib.registration.landmarks import register_landmarks
from scipy.spatial.transform import Rotation

LABELS = ("Nasion", "Left frontozygomatic", "Right frontozygomatic", "Anterior nasal spine")
CT = np.array([[0.0, 92, -20], [-46, 60, -20], [46, 58, -21], [0, 85, -55]])
PATIENT = transform_points(rigid(Rotation.from_rotvec([0.4, -1.1, 2.0]).as_matrix(), [300, -200, 80]), CT)


def test_good_landmarks_pass_without_a_warning() -> None:
    assert check_landmarks(PATIENT, CT, LABELS)[2] == ()


@pytest.mark.parametrize(
    ("patient", "ct", "message"),
    [
        (PATIENT[:2], CT[:2], "at least 3 landmark pairs, got 2"),
        (PATIENT[:3], CT, "got 3 patient and 4 CT"),
        (PATIENT / 1000, CT, "patient landmarks look like metres"),
        (PATIENT, CT / 1000, "CT landmarks look like metres"),
        (PATIENT / 1000, CT / 1000, "look like metres"),
        (PATIENT / 10, CT, "look like centimetres"),
        (PATIENT / 25.4, CT, "look like inches"),
        (PATIENT * 2, CT, "2.00 times the size"),
        (PATIENT[[0, 0, 2, 3]], CT, "Nasion and Left frontozygomatic are duplicates"),
        (np.outer([1.0, 2, 3, 5], [20, 10, 5]), np.outer([1.0, 2, 3, 5], [20, 10, 5]), "collinear"),
        (PATIENT[[0, 2, 1, 3]], CT, "Left frontozygomatic and Right frontozygomatic look swapped"),
        (PATIENT[[1, 2, 0, 3]], CT, "paired in the wrong order"),
        (np.full((4, 3), np.nan), CT, "not a finite number"),
        (PATIENT * 0, CT, "duplicates"),
    ],
)
def test_each_degenerate_set_is_refused_by_its_name(patient: np.ndarray, ct: np.ndarray, message: str) -> None:
    with pytest.raises(InputError, match=message):
        register_landmarks(patient, ct, LABELS)


def test_landmarks_that_are_only_inaccurate_are_never_called_swapped() -> None:
    rng = np.random.default_rng(0)
    for _ in range(300):
        check_landmarks(PATIENT + rng.normal(0, 3.0, PATIENT.shape), CT, LABELS)  # raises when it takes them for swapped


def test_a_swap_is_found_in_spite_of_landmark_errors() -> None:
    rng, found = np.random.default_rng(1), 0
    for _ in range(100):
        try:
            found += bool(check_landmarks(PATIENT[[0, 2, 1, 3]] + rng.normal(0, 2.0, PATIENT.shape), CT, LABELS)[2])
        except InputError:
            found += 1
    assert found >= 95


@pytest.mark.parametrize("wrong", range(4))
def test_a_landmark_read_somewhere_else_is_named(wrong: int) -> None:
    patient = PATIENT + np.random.default_rng(wrong).normal(0, 1.0, PATIENT.shape)
    patient[wrong] += (55.0, -20.0, 30.0)
    text, names = misfit(patient, CT, LABELS, 3.5)
    assert names == (LABELS[wrong],)
    assert text.startswith(f"{LABELS[wrong]} does not fit the other landmarks")


def test_landmarks_of_usual_error_are_no_misfits() -> None:
    rng = np.random.default_rng(2)  # 3.5 mm in space is 3.5 / sqrt(3) an axis
    found = [misfit(PATIENT + rng.normal(0, 3.5 / np.sqrt(3), PATIENT.shape), CT, LABELS, 3.5)[0] for _ in range(300)]
    assert found.count("") == 300
