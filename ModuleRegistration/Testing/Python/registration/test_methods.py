from dataclasses import replace

import numpy as np
import pytest
from CranioNavLib.errors import InputError
from CranioNavLib.rigid import invert_rigid, transform_points
from ModuleRegistrationLib.registration.problem import METHODS

SURFACE_METHODS = ["icp", "random-icp", "trimmed-icp", "open3d", "cranionav"]


def test_the_built_in_methods_are_all_found() -> None:
    assert set(METHODS.names()) >= {*SURFACE_METHODS, "procrustes"}
    assert not [entry.problem for entry in METHODS.entries() if entry.problem]


@pytest.mark.parametrize("name", [*SURFACE_METHODS, "procrustes"])
def test_every_method_improves_or_keeps_a_good_start(name: str, a_case) -> None:
    case = a_case(8, noise_sd=0.1, offset=0.0, landmark_sd=0.5)
    result = METHODS.create(name).register(case.problem)
    assert result.method == name
    assert case.tre(result.reference_to_ras).mean() < 1.5
    assert result.residuals_mm.shape == result.used.shape == (len(case.problem.points),)
    assert result.covariance is not None
    assert np.linalg.eigvalsh(result.covariance).min() > 0
    assert result.stop_reason


@pytest.mark.parametrize("name", SURFACE_METHODS)
def test_too_few_points_are_refused(name: str, a_case) -> None:
    problem = a_case(0).problem
    with pytest.raises(InputError, match="at least 6 bone points, got 5"):
        METHODS.create(name).register(replace(problem, points=problem.points.subset(np.arange(5))))


@pytest.mark.parametrize("name", SURFACE_METHODS)
def test_a_start_in_another_frame_is_refused(name: str, a_case) -> None:
    problem = a_case(0).problem
    with pytest.raises(InputError, match="mm from the skull"):
        METHODS.create(name).register(replace(problem, initial_reference_to_ras=np.eye(4)))


def test_closest_points_never_raise_the_residual(a_case) -> None:
    case = a_case(1, landmark_sd=4.0)
    rms = [METHODS.create("icp", max_iterations=str(n)).register(case.problem).surface_rms_mm for n in (1, 3, 10, 100)]
    assert all(later <= earlier + 1e-6 for earlier, later in zip(rms, rms[1:]))


def test_random_starts_find_a_residual_at_least_as_low(a_case) -> None:
    case = a_case(1, landmark_sd=6.0)
    single, many = (METHODS.create(name).register(case.problem).surface_rms_mm for name in ("icp", "random-icp"))
    assert many <= single + 1e-6


def test_trimming_leaves_out_the_gross_outliers(a_case) -> None:
    case = a_case(11, outlier_share=0.15, landmark_sd=1.0)
    result = METHODS.create("trimmed-icp", keep_share="0.7").register(case.problem)
    assert case.outliers.any()
    assert not result.used[case.outliers].any()


def test_procrustes_without_landmarks_is_refused(a_case) -> None:
    problem = replace(a_case(0).problem, landmarks_ct_mm=np.empty((0, 3)), landmarks_patient_mm=np.empty((0, 3)))
    with pytest.raises(InputError, match="needs landmark pairs"):
        METHODS.create("procrustes").register(problem)


def test_procrustes_weighs_each_pair_by_its_own_covariance(a_case) -> None:
    case = a_case(0)
    planned = case.problem.landmarks_ct_mm
    touched = transform_points(invert_rigid(case.true_reference_to_ras), planned)
    along_view = np.tile(1e-2 * np.eye(3), (len(planned), 1, 1))
    along_view[0] = np.diag([1e-2, 1e-2, 100.0])  # seen at a flat angle: its depth is poor
    touched[0, 2] += 3.0
    plain = replace(case.problem, landmarks_patient_mm=touched)
    weighed = METHODS.create("procrustes").register(replace(plain, landmark_covariances_mm2=along_view))
    equal = METHODS.create("procrustes").register(plain)
    assert case.tre(weighed.reference_to_ras).max() < 0.05
    assert case.tre(equal.reference_to_ras).max() > 0.5
    assert weighed.covariance is not None


def test_features_of_a_sweep_that_has_nothing_of_a_skull_are_refused(a_case) -> None:
    problem = a_case(0, repeats=40).problem
    points = problem.points
    start = invert_rigid(problem.initial_reference_to_ras)[:3, 3]
    line = start + np.linspace(-300, 300, len(points))[:, None] * [1.0, 0, 0]
    method = METHODS.create("open3d", variant="features")
    with pytest.raises(InputError, match="variant features found no pose"):
        method.register(replace(problem, points=replace(points, positions_mm=line)))


def test_features_need_a_dense_sweep(a_case) -> None:
    with pytest.raises(InputError, match="at least 500 points, got 18"):
        METHODS.create("open3d", variant="features").register(a_case(0).problem)
