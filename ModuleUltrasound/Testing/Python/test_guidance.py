"""Guidance against closed forms: the information of a point, the angle to a sphere, words that lead the right way."""

from __future__ import annotations

import numpy as np
import pytest
from CranioNavLib.rigid import rigid
from CranioNavLib.surface import Surface
from hypothesis import given, settings
from hypothesis import strategies as st
from ModuleUltrasoundLib.palpation.guidance import (
    bone_normal,
    cue,
    direction_in_words,
    guide,
    screen_axes,
)
from vtkmodules.vtkFiltersSources import vtkSphereSource

CENTER = np.array([10.0, -60.0, 40.0])


@pytest.fixture(scope="module")
def a_sphere() -> Surface:
    source = vtkSphereSource()
    source.SetRadius(80)
    source.SetCenter(CENTER)
    source.SetThetaResolution(200)
    source.SetPhiResolution(200)
    source.Update()
    return Surface.from_polydata(source.GetOutput())


def a_pose(contact: np.ndarray, back: np.ndarray, off: float = 20.0) -> np.ndarray:
    """A probe `off` mm before a contact, its back end towards `back`."""
    z = -back / np.linalg.norm(back)
    x = np.cross(z, [0.3, 0.5, 0.8])
    x /= np.linalg.norm(x)
    return rigid(np.column_stack([x, np.cross(z, x), z]), contact - off * z)


@settings(max_examples=30, deadline=None)
@given(st.floats(0.0, 25.0), st.floats(0.0, 2 * np.pi), st.integers(0, 1000))
def test_the_angle_is_that_between_beam_and_radius_of_a_sphere(a_sphere, tilt_deg, turn, seed):
    radius = np.random.default_rng(seed).normal(size=3)
    radius /= np.linalg.norm(radius)
    right, up = screen_axes(radius)
    lean = np.cos(turn) * right + np.sin(turn) * up
    back = np.cos(np.radians(tilt_deg)) * radius + np.sin(np.radians(tilt_deg)) * lean
    contact = CENTER + 80 * radius
    seen = guide(a_pose(contact, back), a_sphere, contact, radius)
    assert seen.angle_deg == pytest.approx(tilt_deg, abs=0.7)  # facets of the sphere's mesh: 1.8 by 0.9 degrees
    assert np.hypot(*seen.bulls_eye_deg) == pytest.approx(seen.angle_deg, abs=1e-6)
    if tilt_deg > 5.0:
        assert np.subtract(seen.bulls_eye_deg, tilt_deg * np.array([np.cos(turn), np.sin(turn)])) == pytest.approx(0.0, abs=1.0)
    assert seen.on_target
    assert seen.distance_mm < 0.1


def test_following_the_bulls_eye_squares_the_probe(a_sphere):
    radius = np.array([0.6, 0.64, 0.48])
    right, up = screen_axes(radius)
    back, contact = radius + 0.2 * right - 0.15 * up, CENTER + 80 * radius
    first = guide(a_pose(contact, back), a_sphere, contact, radius)
    across, along = np.tan(np.radians(first.bulls_eye_deg))
    second = guide(a_pose(contact, back / (back @ radius) - across * right - along * up), a_sphere, contact, radius)
    assert first.angle_deg > 10.0
    assert second.angle_deg < 1.0
    assert second.instruction == "hold still"
    assert second.aligned


def test_the_instruction_first_leads_to_the_target_then_tilts_then_holds(a_sphere):
    top = np.array([0.0, 0.0, 1.0])
    contact = CENTER + 80 * top
    far = guide(a_pose(contact + [0.0, -30.0, 0.0], top), a_sphere, contact, top)
    assert far.instruction == "move 30 mm towards the face"
    assert not far.on_target
    tilted = guide(a_pose(contact, top + [0.2, 0.0, 0.0]), a_sphere, contact, top)
    assert tilted.instruction == "tilt the probe's back end 11° towards the patient's left"
    assert guide(a_pose(contact, top), a_sphere, contact, top).instruction == "hold still"


def test_a_beam_off_the_bone_is_led_by_the_targets_normal(a_sphere):
    normal = np.array([1.0, 0.0, 0.0])
    assert np.array_equal(bone_normal(a_sphere, CENTER + [200.0, 0, 0], normal, fallback=normal), normal)


def test_a_rough_bone_does_not_throw_the_normal(a_sphere):
    rng = np.random.default_rng(4)
    rough = Surface(a_sphere.vertices_mm + rng.normal(size=a_sphere.vertices_mm.shape) * 0.05, a_sphere.triangles)
    radius = np.array([0.0, 0.8, 0.6])
    normal = bone_normal(rough, CENTER + 100 * radius, -radius, radius)
    assert np.degrees(np.arccos(normal @ radius)) < 2.5


def test_the_normals_uncertainty_leaves_out_turns_about_itself(a_sphere):
    radius = np.array([0.0, 0.0, 1.0])
    contact = CENTER + 80 * radius
    about_z = guide(a_pose(contact, radius), a_sphere, contact, radius, np.diag([0.0, 0.0, 1.0]))
    assert about_z.angle_sd_deg == pytest.approx(0.0, abs=0.02)
    both = guide(a_pose(contact, radius), a_sphere, contact, radius, np.diag([0.02**2, 0.02**2, 0.0]))
    assert both.angle_sd_deg == pytest.approx(np.degrees(0.02 * np.sqrt(2)), rel=0.01)


def test_a_screen_seen_from_outside_has_the_crown_up_and_no_mirror():
    right, up = screen_axes([0.0, 1.0, 0.0])  # looking at the face
    assert np.allclose(up, [0, 0, 1])
    assert np.allclose(right, [-1, 0, 0])  # the patient's left is on the viewer's right
    right, up = screen_axes([1.0, 0.0, 0.0])  # looking at the right ear: the face is on the right
    assert np.allclose(right, [0, 1, 0])


def test_directions_are_said_in_the_patients_terms():
    assert direction_in_words([-1.0, 0.1, 0.0]) == "the patient's left"
    assert direction_in_words([0.0, 1.0, 0.9]) == "the face and the crown"
    assert direction_in_words([0.5, -1.0, 0.0]) == "the back of the head and the patient's right"
    assert direction_in_words([0.0, 0.0, -1.0]) == "the chin"


def test_the_cue_quickens_and_rises_until_it_is_one_long_tone():
    cues = [cue(angle) for angle in (40.0, 20.0, 12.0, 6.0, 2.1)]
    rates, pitches = [c.rate_hz for c in cues], [c.pitch_hz for c in cues]
    assert rates == sorted(rates)
    assert pitches == sorted(pitches)
    assert rates[0] == rates[1] == 2.0
    assert rates[-1] < 12.0
    assert cue(1.9).rate_hz == 0.0
    assert cue(1.9).pitch_hz == pytest.approx(pitches[-1], rel=0.02)
