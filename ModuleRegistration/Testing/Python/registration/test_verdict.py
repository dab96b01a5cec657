from dataclasses import replace

import numpy as np
import pytest
from CranioNavLib.bone_points import BonePoints
from CranioNavLib.rigid import invert_rigid, transform_points
from CranioNavLib.surface import Surface
from ModuleRegistrationLib.registration.landmarks import fit_rigid
from ModuleRegistrationLib.registration.next_point import plan_next_points, region_name
from ModuleRegistrationLib.registration.problem import METHODS, Minimum
from ModuleRegistrationLib.registration.verdict import Limits, judge
from vtkmodules.vtkFiltersSources import vtkSphereSource

METHOD = METHODS.create("cranionav")


def judged(problem, targets, **limits):
    return judge(problem, METHOD.register(problem), targets, Limits(**limits) if limits else None)


def test_a_good_registration_is_accepted_without_a_word(a_case) -> None:
    case = a_case(1, repeats=6, noise_sd=0.3, stated_sd=0.3)
    assert judged(case.problem, case.targets).status == "accepted"


def test_no_bad_registration_passes_unflagged(a_case) -> None:
    for seed in range(14):
        case = a_case(seed, landmark_sd=6.9, outlier_share=0.25)
        result = METHOD.register(case.problem)
        if case.tre(result.reference_to_ras).mean() > 3:
            assert judge(case.problem, result, case.targets).status != "accepted"


def test_an_error_above_the_limit_names_the_weak_motion_and_the_cure(a_case) -> None:
    case = a_case(2)
    verdict = judged(case.problem, case.targets, wanted_p95_mm=0.5, warn_p95_mm=0.6)
    text = " ".join(verdict.messages)
    assert verdict.status == "warning"
    assert "is poorly held" in text
    assert "would bring the 95% error from" in text
    assert len(verdict.next_points) > 0


def test_points_of_one_side_only_are_flagged(a_case) -> None:
    case = a_case(3, repeats=4)
    right = transform_points(case.true_reference_to_ras, case.problem.points.positions_mm)[:, 0] > 0
    verdict = judged(replace(case.problem, points=case.problem.points.subset(right)), case.targets)
    assert verdict.status != "accepted"
    assert "on the right side" in " ".join(verdict.messages)


def test_points_of_the_vault_only_are_flagged(a_case) -> None:
    case = a_case(3, regions=((18, (-170, 170), (50, 80)),))
    verdict = judged(case.problem, case.targets)
    assert verdict.status != "accepted"
    assert "vault" in " ".join(verdict.messages)


def test_points_of_the_forehead_only_are_flagged(a_case) -> None:
    case = a_case(3, regions=((18, (-40, 40), (-10, 40)),))
    verdict = judged(case.problem, case.targets)
    assert verdict.status != "accepted"
    assert "on the front of the head" in " ".join(verdict.messages)


def test_points_that_leave_nothing_to_check_them_by_are_never_accepted(a_case) -> None:
    case = a_case(3, noise_sd=0.1)
    few = replace(case.problem, points=case.problem.points.subset(np.arange(0, 18, 2)))
    verdict = judged(few, case.targets)
    assert verdict.status != "accepted"
    assert "only 9 points are used" in " ".join(verdict.messages)


def test_swapped_landmarks_are_refused_by_name(a_case) -> None:
    case = a_case(4, landmark_sd=1.0)
    swapped = case.problem.landmarks_patient_mm[[0, 2, 1, 3]]
    problem = replace(
        case.problem, landmarks_patient_mm=swapped, initial_reference_to_ras=fit_rigid(swapped, case.problem.landmarks_ct_mm)
    )
    verdict = judged(problem, case.targets)
    assert verdict.status == "refused"
    assert "look swapped" in " ".join(verdict.messages)


def test_contradicting_points_are_named(a_case) -> None:
    case = a_case(5, noise_sd=0.3)
    points = case.problem.points
    moved = points.positions_mm.copy()
    moved[6] += 6 * points.beam_directions[6]
    verdict = judged(replace(case.problem, points=replace(points, positions_mm=moved)), case.targets)
    assert "contradict the others: P7" in " ".join(verdict.messages)


def test_a_cloud_of_another_size_is_noticed(a_case) -> None:
    case = a_case(6, repeats=4, noise_sd=0.2)
    points = case.problem.points
    middle = points.positions_mm.mean(axis=0)
    larger = replace(points, positions_mm=middle + 1.04 * (points.positions_mm - middle))
    verdict = judged(replace(case.problem, points=larger), case.targets)
    assert verdict.status != "accepted"
    assert "mm outside the segmented bone" in " ".join(verdict.messages)


def test_a_reference_base_knocked_on_the_way_is_noticed(a_case) -> None:
    case = a_case(7, repeats=3, noise_sd=0.2, stated_sd=0.2)
    order = np.random.default_rng(0).permutation(len(case.problem.points))
    points = case.problem.points.subset(order)
    moved = points.positions_mm.copy()
    moved[len(moved) // 2 :] += [1.5, -1.0, 1.0]
    points = replace(points, positions_mm=moved, groups=np.arange(len(points)))
    verdict = judged(replace(case.problem, points=points), case.targets)
    assert "reference base may have moved" in " ".join(verdict.messages)


def test_points_in_their_right_place_are_never_called_moved(a_case) -> None:
    texts = [" ".join(judged(case.problem, case.targets).messages) for case in (a_case(seed) for seed in range(8))]
    assert not any("moved" in text for text in texts)


def test_two_poses_that_fit_alike_are_called_ambiguous(a_case) -> None:
    case = a_case(1)
    result = METHOD.register(case.problem)
    other = result.reference_to_ras.copy()
    other[:3, 3] += 4
    doubtful = replace(result, minima=(Minimum(result.reference_to_ras, 0.6), Minimum(other, 0.4)))
    verdict = judge(case.problem, doubtful, case.targets)
    assert verdict.status == "warning"
    assert "ambiguous: another pose, 6.9 mm away" in " ".join(verdict.messages)


def test_a_planned_point_brings_what_it_promises(a_case, a_skull) -> None:
    case = a_case(2)
    result = METHOD.register(case.problem)
    planned = plan_next_points(a_skull, case.bound, case.pivot, case.targets, 0.4, 0.1, most=3)
    assert planned[0].p95_mm > planned[1].p95_mm > planned[2].p95_mm
    assert result.covariance is not None


@pytest.mark.parametrize(
    ("point", "name"),
    [
        ([0, 0, 80], "vertex"),
        ([0, 90, 30], "forehead"),
        ([0, 60, 65], "frontal convexity"),
        ([-70, 0, 20], "left temporal"),
        ([70, 10, 20], "right temporal"),
        ([-30, 80, -10], "left periorbital"),
        ([0, -90, 10], "occiput"),
        ([60, -10, 60], "right parietal"),
    ],
)
def test_regions_are_named_as_a_surgeon_would(point: list[float], name: str) -> None:
    assert region_name(np.array(point, dtype=float), np.zeros(3)) == name


def test_points_on_a_sphere_are_never_accepted(a_case) -> None:
    source = vtkSphereSource()
    source.SetRadius(80)
    source.SetThetaResolution(120)
    source.SetPhiResolution(120)
    source.Update()
    problem = a_case(3).problem
    arms = np.random.default_rng(1).normal(size=(18, 3))
    touched = 80.3 * arms / np.linalg.norm(arms, axis=1, keepdims=True)
    points = BonePoints.palpated(transform_points(invert_rigid(problem.initial_reference_to_ras), touched), 0.5)
    on_ball = replace(problem, surface=Surface.from_polydata(source.GetOutput()), points=points)
    verdict = judged(on_ball, touched[:5])
    assert verdict.status != "accepted"
    assert "one sphere" in " ".join(verdict.messages)
