import numpy as np
import pytest
from CranioNavLib.errors import InputError
from ModuleRegistrationLib.registration.pairing import pair_points

POINTS = np.array([[0.0, 0, 0], [10, 0, 0], [0, 10, 0]])


def test_lists_with_the_same_labels_pair_by_label() -> None:
    patient, ct, labels = pair_points(["c", "A ", "b"], POINTS, ["a", "b", "c"], POINTS + 1)
    assert np.array_equal(patient, POINTS[[1, 2, 0]])
    assert np.array_equal(ct, POINTS + 1)
    assert labels == ("a", "b", "c")


def test_lists_with_other_labels_pair_by_order() -> None:
    patient, _, labels = pair_points(["F-1", "F-2", "F-3"], POINTS, ["nasion", "left", "right"], POINTS)
    assert np.array_equal(patient, POINTS)
    assert labels == ("nasion", "left", "right")


def test_repeated_labels_pair_by_order() -> None:
    patient, _, _ = pair_points(["x", "x", "x"], POINTS, ["x", "x", "x"], POINTS)
    assert np.array_equal(patient, POINTS)


def test_unpaired_lists_are_refused_with_both_counts_and_the_missing_label() -> None:
    with pytest.raises(InputError, match=r"2 patient and 3 CT points.*'c' \(CT\)"):
        pair_points(["a", "b"], POINTS[:2], ["a", "b", "c"], POINTS)


def test_shared_labels_that_contradict_the_order_are_refused() -> None:
    with pytest.raises(InputError, match="'left' is number 2 of the patient list but number 3 of the CT list"):
        pair_points(["nose", "left", "right"], POINTS, ["nasion", "right", "left"], POINTS)


def test_as_many_labels_as_points_are_asked_for() -> None:
    with pytest.raises(InputError, match="one label per patient point"):
        pair_points(["a"], POINTS, ["a", "b", "c"], POINTS)
