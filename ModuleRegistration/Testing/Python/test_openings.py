"""Openings of the skull, cut into the CT of a real head: nothing is matched into them, and no point is planned there."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest
from CranioNavLib.bone_points import BonePoints
from CranioNavLib.rigid import Array, invert_rigid, rigid_from_vector, transform_points
from CranioNavLib.volume import Volume
from ModuleRegistrationLib.anatomy.landmark_suggestions import suggest_landmarks
from ModuleRegistrationLib.anatomy.segmentation import BoneSurfaces, segment_bone
from ModuleRegistrationLib.plugins.threshold import ThresholdSegmentation
from ModuleRegistrationLib.registration.landmarks import register_landmarks
from ModuleRegistrationLib.registration.problem import METHODS, RegistrationProblem
from ModuleRegistrationLib.registration.verdict import judge
from ModuleUltrasoundLib.palpation.protocol import ProtocolPoints, plan_protocol

TRUTH = rigid_from_vector([0.3, -0.2, 0.4], [20, -30, 40])  # ReferenceToRas
BURR_HOLE, BURR_RADIUS_MM = "Frontal convexity 1", 7.0
CRANIOTOMY, CRANIOTOMY_RADIUS_MM = "Right lateral 3", 25.0


@dataclass(frozen=True, eq=False)
class OpenedHead:
    """A head with a burr hole and a craniotomy, and the plan made before they were cut."""

    before: ProtocolPoints
    landmarks: Array
    labels: tuple[str, ...]
    bone: BoneSurfaces

    def radii(self, points: Array, label: str) -> Array:
        """Distance of points from the axis of the opening cut at a planned point; inf on the other side of the head."""
        place = self.before.labels.index(label)
        apart, axis = points - self.before.positions_ras_mm[place], self.before.normals[place]
        along = apart @ axis
        return np.where(np.abs(along) < 25, np.linalg.norm(apart - along[:, None] * axis, axis=1), np.inf)


def cut(volume: Volume, position: Array, axis: Array, radius_mm: float) -> Volume:
    """The CT with the bone in a cylinder through `position` replaced by soft tissue."""
    hu = volume.hu.copy()
    k, j, i = np.nonzero(hu > 100)
    ras = np.column_stack([i, j, k]) @ volume.ijk_to_ras[:3, :3].T + volume.ijk_to_ras[:3, 3] - position
    along = ras @ axis
    inside = (np.linalg.norm(ras - along[:, None] * axis, axis=1) < radius_mm) & (along > -20) & (along < 8)
    hu[k[inside], j[inside], i[inside]] = 40
    return Volume(hu, volume.ijk_to_ras, volume.description)


@pytest.fixture(scope="module")
def a_head(a_sample_head) -> OpenedHead:
    whole = segment_bone(a_sample_head)
    found = suggest_landmarks(whole)
    landmarks, labels = found.positions_ras_mm, tuple(found.labels)
    before, opened = plan_protocol(whole.outer_table, landmarks, labels), a_sample_head
    for label, radius_mm in ((BURR_HOLE, BURR_RADIUS_MM), (CRANIOTOMY, CRANIOTOMY_RADIUS_MM)):
        place = before.labels.index(label)
        opened = cut(opened, before.positions_ras_mm[place], before.normals[place], radius_mm)
    return OpenedHead(before, landmarks, labels, ThresholdSegmentation().segment(opened))


OPENINGS = [(BURR_HOLE, BURR_RADIUS_MM), (CRANIOTOMY, CRANIOTOMY_RADIUS_MM)]


@pytest.mark.parametrize(("label", "radius_mm"), OPENINGS)
def test_neither_wall_nor_inner_table_is_to_be_matched_in_an_opening(a_head, label, radius_mm):
    assert a_head.radii(a_head.bone.outer_table.vertices_mm, label).min() > radius_mm - 0.5  # a voxel of this CT


def test_no_point_is_planned_where_the_probe_would_stand_over_an_opening(a_head):
    plan = plan_protocol(a_head.bone.outer_table, a_head.landmarks, a_head.labels)
    for label, radius_mm in OPENINGS:
        assert a_head.radii(plan.positions_ras_mm, label).min() > radius_mm + 5.0
    assert len(plan) + len(plan.left_out) == 18


OVER, DEEP = "over an opening", "contradict the others"  # this deep, the rim is no longer what is nearest


@pytest.mark.parametrize(("depth_mm", "words"), [(0.0, OVER), (3.0, OVER), (7.0, OVER), (12.0, DEEP)])
def test_points_felt_in_an_opening_are_left_out_and_named(a_head, depth_mm, words):
    rng = np.random.default_rng(5)
    back = invert_rigid(TRUTH)
    over = [a_head.before.labels.index(label) for label, _ in OPENINGS]
    touched = a_head.before.positions_ras_mm + rng.normal(0, 0.4, (18, 3))
    touched[over] -= depth_mm * a_head.before.normals[over]
    patient = transform_points(back, a_head.landmarks + rng.normal(0, 2, a_head.landmarks.shape))
    start = register_landmarks(patient, a_head.landmarks, labels=a_head.labels, expected_fle_mm=3.5)
    problem = RegistrationProblem(
        surface=a_head.bone.outer_table,
        points=BonePoints.palpated(transform_points(back, touched), 0.4, labels=a_head.before.labels),
        initial_reference_to_ras=start.reference_to_ras,
        landmarks_ct_mm=a_head.landmarks,
        landmarks_patient_mm=patient,
    )
    result = METHODS.create("cranionav").register(problem)
    targets = a_head.before.positions_ras_mm.mean(axis=0) + np.array([[0.0, 0, 0], [20, 0, 30], [-30, -20, 20]])
    assert not result.used[over].any()
    assert result.used.sum() >= 14
    found = transform_points(result.reference_to_ras @ back, targets)
    assert np.linalg.norm(found - targets, axis=1).mean() < 2.0
    said = " ".join(judge(problem, result, targets).messages)
    assert BURR_HOLE in said
    assert CRANIOTOMY in said
    assert words in said
