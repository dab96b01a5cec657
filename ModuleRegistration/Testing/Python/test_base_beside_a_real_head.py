"""On a real head, the reference base takes none of the 18 points away: they are clear of it, or named."""

from __future__ import annotations

import numpy as np
import pytest
from CranioNavLib.phantom import make_patient
from ModuleRegistrationLib.anatomy.segmentation import segment_bone
from ModuleUltrasoundLib.palpation.clamp import clear_of_clamp
from ModuleUltrasoundLib.palpation.protocol import plan_protocol

MIDDLE = np.array([0.0, -15.0, 0.0])  # of the sample head, RAS
ZYGOMAS = {"Periorbital 2", "Periorbital 3"}  # small bones: no other place within reach


@pytest.fixture(scope="module")
def a_plan(a_sample_head):
    """Plans on the real head with a base at a place."""
    patient = make_patient(a_sample_head, 0)
    skull = segment_bone(a_sample_head).outer_table

    def plan(base_ras_mm=None):
        return plan_protocol(
            skull,
            patient.landmarks_ras_mm,
            patient.landmark_labels,
            None if base_ras_mm is None else np.atleast_2d(np.asarray(base_ras_mm, dtype=float)),
        )

    return plan, plan(), patient


def near(plan, base_ras_mm):
    """Labels of the points that a probe cannot be held at clear of the base."""
    clear = clear_of_clamp(plan.positions_ras_mm, plan.normals, np.atleast_2d(base_ras_mm))
    return tuple(label for label, free in zip(plan.labels, clear) if not free)


def test_the_base_of_the_simulated_patient_takes_no_point_away(a_plan):
    planned, free, patient = a_plan
    base = patient.true_reference_to_ras[:3, 3]  # a hand's breadth before the right cheek
    plan = planned(base)
    assert plan.labels == free.labels
    assert near(plan, base) == plan.too_near == ()
    index = plan.labels.index("Periorbital 3")
    assert np.linalg.norm(plan.positions_ras_mm[index] - free.positions_ras_mm[index]) < 12.0, "still on the zygoma"


@pytest.mark.parametrize("height_mm", [40.0, 100.0])
def test_a_base_over_any_point_takes_none_away(a_plan, height_mm):
    planned, free, _ = a_plan
    for label, position, normal in zip(free.labels, free.positions_ras_mm, free.normals):
        base = position + height_mm * normal
        plan = planned(base)
        assert plan.labels == free.labels
        assert near(plan, base) == plan.too_near
        assert set(plan.too_near) <= ({label} & ZYGOMAS), label
        moved = np.linalg.norm(plan.positions_ras_mm - free.positions_ras_mm, axis=1)
        assert moved.max() < 55.0  # from one end of the orbit's upper rim to the other, where it is very near
        apart = np.linalg.norm(plan.positions_ras_mm[:, None] - plan.positions_ras_mm[None], axis=2) + 1e3 * np.eye(18)
        assert apart.min() > 15.0


@pytest.mark.parametrize(
    "direction", [[0, 1, 0.3], [1, 0, 0.2], [-1, 0, 0.2], [1, -0.2, -0.2], [-1, -0.2, -0.2], [0.6, 0.8, 0], [0, 0, 1]]
)
@pytest.mark.parametrize("distance_mm", [120.0, 160.0, 220.0, 800.0])
def test_a_base_on_its_arm_takes_no_point_away(a_plan, direction, distance_mm):
    planned, free, _ = a_plan
    base = MIDDLE + distance_mm * np.array(direction) / np.linalg.norm(direction)
    plan = planned(base)
    assert plan.labels == free.labels
    assert near(plan, base) == plan.too_near
    assert set(plan.too_near) <= ZYGOMAS
