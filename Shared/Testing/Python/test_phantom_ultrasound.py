"""RF lines against closed forms: times, losses, directivity, polarity."""

from __future__ import annotations

import numpy as np
import pytest
from CranioNavLib.phantom import constants
from CranioNavLib.phantom.beam import BEAM_WEIGHTS, OFFSETS_MM, look_at_bone
from CranioNavLib.phantom.fields import SmoothField
from CranioNavLib.phantom.ultrasound import (
    PULSE,
    LineSource,
    Tissue,
    _bone,
    _directivity,
    _loss_s,
    _reflection,
    _Texture,
    _through_forerun,
    acquisition,
    simulate_lines,
)
from CranioNavLib.rigid import rigid, rigid_from_vector
from CranioNavLib.surface import Surface
from scipy.signal import hilbert

RATE = constants.SAMPLING_HZ


def slab(z_mm: float, thickness_mm: float = 0.0) -> Surface:
    """A large flat bone (or skin) whose outer face is at z, seen from below (from smaller z)."""
    square = np.array([[-60.0, -60, 0], [60, -60, 0], [60, 60, 0], [-60, 60, 0]])
    faces = np.array([[0, 2, 1], [0, 3, 2]])
    if not thickness_mm:
        return Surface(square + [0, 0, z_mm], faces)
    both = np.vstack([square + [0, 0, z_mm], square + [0, 0, z_mm + thickness_mm]])
    return Surface(both, np.vstack([faces, faces[:, ::-1] + 4]))


def even_tissue(**changes) -> Tissue:
    """Tissue without differences from place to place."""
    flat = SmoothField(np.zeros((1, 3)), np.array([np.pi / 2]))  # cos(pi / 2) = 0 everywhere
    layers = tuple(flat for _ in constants.LAYER_SHARES)
    values = {
        "speed_of_sound_m_s": 1540.0,
        "attenuation_db_cm_mhz": 1.0,
        "bone_impedance_mrayl": 6.5,
        "diffuse_floor_db": -30.0,
        "full_scale": 1.0,
        "forerun_speed_m_s": 2340.0,
    }
    return Tissue(**{**values, **changes}, speed_field=flat, coupling_field=flat, share_fields=layers, amplitude_fields=layers)


def probe(tilt_deg: float = 0.0) -> np.ndarray:
    """The probe's face one forerun below z = 0, so that its contact is at z = 0; tilted about the contact."""
    turn = rigid_from_vector((np.radians(tilt_deg), 0, 0), np.zeros(3))
    return turn @ rigid(np.eye(3), (0, 0, -constants.FORERUN_LENGTH_MM))


def lines_at(depth_mm: float, tilt_deg: float = 0.0, count: int = 1, skin_mm: float = -0.1, **changes) -> np.ndarray:
    poses = np.tile(probe(tilt_deg), (count, 1, 1))
    skin = Surface(*_box(skin_mm))
    return simulate_lines(slab(depth_mm), skin, even_tissue(**changes), poses, np.random.default_rng(0)).astype(float)


def _box(skin_mm: float):
    """A closed block of scalp that begins at z = skin_mm."""
    low, high = np.array([-60.0, -60, skin_mm]), np.array([60.0, 60, 80])
    corners = np.array([[x, y, z] for z in (low[2], high[2]) for y in (low[1], high[1]) for x in (low[0], high[0])])
    quads = [(0, 2, 3, 1), (4, 5, 7, 6), (0, 1, 5, 4), (2, 6, 7, 3), (0, 4, 6, 2), (1, 3, 7, 5)]
    return corners, np.array([t for a, b, c, d in quads for t in ((a, b, c), (a, c, d))])


def envelope_peak_s(line: np.ndarray, begin_s: float, end_s: float) -> tuple[float, float]:
    """Time and height of the largest envelope in a window, relative to the pulse's own peak delay."""
    size = np.abs(hilbert(line))
    first, last = int(begin_s * RATE), int(end_s * RATE)
    top = first + int(np.argmax(size[first:last]))
    a, b, c = size[top - 1 : top + 2]
    top_s = (top + 0.5 * (a - c) / (a - 2 * b + c)) / RATE
    own = np.abs(hilbert(PULSE))
    return top_s - np.argmax(own) / RATE, float(b)


@pytest.mark.parametrize("depth_mm", [3.0, 5.0, 8.0, 12.0])
def test_the_bone_echo_comes_after_forerun_and_tissue(depth_mm):
    expected = 2e-3 * (constants.FORERUN_LENGTH_MM / 2340.0 + depth_mm / 1540.0)
    found, _ = envelope_peak_s(lines_at(depth_mm).mean(axis=0), expected - 0.4e-6, expected + 0.8e-6)
    # attenuation lowers the frequency and with it delays the peak of a causal pulse, by less than 0.05 us = 0.04 mm
    assert found == pytest.approx(expected, abs=0.05e-6)


def test_the_forerun_echo_comes_at_its_time_and_upside_down():
    line = lines_at(20.0)[0]
    expected = 2e-3 * constants.FORERUN_LENGTH_MM / 2340.0
    found, _ = envelope_peak_s(line, expected - 0.5e-6, expected + 1e-6)
    assert found == pytest.approx(expected, abs=0.02e-6)
    part = line[int(expected * RATE) : int(expected * RATE) + 40]
    assert np.dot(part, PULSE[:40]) < 0


def test_the_speed_of_sound_moves_the_echo_and_the_forerun_does_not():
    slow, fast = (
        envelope_peak_s(lines_at(8.0, speed_of_sound_m_s=c)[0], 19e-6 + 16e-3 / c, 21e-6 + 16e-3 / c)[0] for c in (1450.0, 1630.0)
    )
    assert slow - fast == pytest.approx(16e-3 * (1 / 1450 - 1 / 1630), abs=0.03e-6)


def spectrum_of_bone(tissue, depth_mm, tilt_deg=0.0):
    contact = probe(tilt_deg)[None] @ rigid(np.eye(3), (0, 0, constants.FORERUN_LENGTH_MM))
    seen = look_at_bone(slab(depth_mm), contact)
    nothing = _Texture(np.zeros((1, constants.LINE_SAMPLES), np.float32), np.zeros((1, len(BEAM_WEIGHTS))))
    one = np.ones(1)
    return np.abs(_bone(tissue, seen, 1540.0 * one, 20e-6 * one, one, nothing))[0]


@pytest.mark.parametrize("slope", [0.7, 2.59])
def test_tissue_takes_its_decibels_at_every_frequency(slope):
    tissue = even_tissue(attenuation_db_cm_mhz=slope)
    near, far = spectrum_of_bone(tissue, 3.0), spectrum_of_bone(tissue, 9.0)
    from CranioNavLib.phantom.ultrasound import BAND

    expected_db = slope * BAND / 1e6 * 2 * 0.6  # two ways through 6 mm more
    # the repetition between bone and forerun adds a ripple of up to 12 %, less where it is attenuated
    assert np.median(20 * np.log10(near / far) / expected_db) == pytest.approx(1.0, abs=0.05)


def test_tilt_of_one_point_two_degrees_costs_six_decibels_at_5_mhz():
    from CranioNavLib.phantom.ultrasound import BAND

    at_5_mhz = int(np.argmin(np.abs(BAND - 5e6)))
    loss = _directivity(np.array([0.0, 1.2, 2.2]), np.full(3, 1540.0))[:, at_5_mhz]
    assert loss[0] == pytest.approx(1.0, abs=1e-5)
    assert 20 * np.log10(loss[1]) == pytest.approx(-6.0, abs=0.7)
    assert abs(loss[2]) < 0.05  # first null


def test_a_tilted_flat_bone_is_seen_at_its_angle_and_range():
    contact = np.array([rigid_from_vector((np.radians(t), 0, 0), np.zeros(3)) for t in (0.0, 2.0, 5.0, 10.0)])
    seen = look_at_bone(slab(6.0), contact)
    assert seen.tilt_deg == pytest.approx([0, 2, 5, 10], abs=1e-3)
    assert seen.center_mm == pytest.approx(6.0 / np.cos(np.radians([0, 2, 5, 10])), abs=1e-3)
    assert seen.roughness_mm.max() < 1e-3
    assert np.allclose(seen.normals, (0, 0, -1), atol=1e-4)


def test_the_beam_is_1_2_mm_wide_at_half_amplitude():
    radius = np.linalg.norm(OFFSETS_MM, axis=1)
    # a Gaussian of half amplitude at 0.6 mm has the mean square radius 0.6^2 / ln 2
    assert (BEAM_WEIGHTS * radius**2).sum() == pytest.approx(0.36 / np.log(2), rel=0.1)


def test_the_echo_fades_with_tilt_but_never_below_the_diffuse_floor():
    heights = []
    for tilt in (0.0, 1.2, 4.0, 10.0):
        expected = 2e-3 * (constants.FORERUN_LENGTH_MM / 2340.0 + 6.0 / np.cos(np.radians(tilt)) / 1540.0)
        lines = lines_at(6.0, tilt, full_scale=0.3)
        heights.append(envelope_peak_s(lines[0], expected - 0.4e-6, expected + 0.8e-6)[1])
    assert heights[0] > 1.3 * heights[1] > 1.3 * heights[2]
    assert heights[3] > 0.01 * heights[0]


def test_a_hole_in_the_skull_returns_no_bone_echo():
    far = Surface(slab(6.0).vertices_mm + [200.0, 0, 0], slab(6.0).triangles)
    skin = Surface(*_box(-0.1))
    line = simulate_lines(far, skin, even_tissue(), probe()[None], np.random.default_rng(0))[0].astype(float)
    expected = 2e-3 * (constants.FORERUN_LENGTH_MM / 2340.0 + 6.0 / 1540.0)
    with_bone = envelope_peak_s(lines_at(6.0)[0], expected - 0.3e-6, expected + 0.6e-6)[1]
    assert envelope_peak_s(line, expected - 0.3e-6, expected + 0.6e-6)[1] < 0.15 * with_bone


def test_a_probe_off_the_skin_hears_only_its_forerun():
    line = lines_at(8.0, skin_mm=2.0)[0]
    forerun = 2e-3 * constants.FORERUN_LENGTH_MM / 2340.0
    tissue = line[int((forerun + 2e-6) * RATE) : int((2 * forerun - 1e-6) * RATE)]
    assert np.abs(tissue).max() <= 5  # noise alone
    assert envelope_peak_s(line, 2 * forerun - 1e-6, 2 * forerun + 1e-6)[1] > 50  # total reflection rings on


def test_the_inner_table_follows_the_outer():
    skin = Surface(*_box(-0.1))
    thick = 6.0
    lines = simulate_lines(
        slab(5.0, thick), skin, even_tissue(full_scale=0.05), np.tile(probe(), (60, 1, 1)), np.random.default_rng(1)
    )
    expected = 2e-3 * (constants.FORERUN_LENGTH_MM / 2340.0 + 5.0 / 1540.0 + thick / constants.BONE_SPEED_M_S)
    assert envelope_peak_s(lines.mean(axis=0), expected - 0.4e-6, expected + 1.2e-6)[0] == pytest.approx(expected, abs=0.4e-6)


def test_a_strong_echo_saturates_the_converter_and_a_weak_gain_does_not():
    top = 2 ** (constants.ADC_BITS - 1)
    start = int(15e-6 * RATE)
    strong = lines_at(3.0, full_scale=0.05)[0]
    assert strong[start:].max() == top - 1
    assert strong[start:].min() == -top
    assert np.abs(lines_at(3.0, full_scale=1.0)[0][start:]).max() < top - 1


def test_speckle_stays_while_the_probe_stands_and_changes_when_it_moves():
    source = LineSource(slab(12.0), Surface(*_box(-0.1)), even_tissue(full_scale=0.02), np.random.default_rng(5))
    moved = probe().copy()
    moved[0, 3] += 5.0
    lines = source.lines(np.stack([probe(), probe(), moved])).astype(float)[:, 1260:1900]  # behind the forerun, before bone

    def alike(a, b):
        return np.corrcoef(lines[a], lines[b])[0, 1]

    # the layers stay where they are, too: standing still must be clearly more alike
    assert alike(0, 1) > 0.9
    assert alike(1, 2) < alike(0, 1) - 0.15


def test_reflection_and_transmission_follow_the_impedances():
    assert _reflection(1.63, 6.5) == pytest.approx(0.599, abs=0.001)
    assert _through_forerun(np.ones(1))[0] == pytest.approx(1 - 0.2049**2, abs=0.001)
    assert 8.685889638 * _loss_s(even_tissue(), np.array([5.0]))[0] * 5e6 == pytest.approx(5.0)  # 1 dB/cm/MHz, 5 MHz, 1 cm


def test_lines_repeat_with_the_seed_and_the_acquisition_is_the_makers():
    assert np.array_equal(lines_at(5.0, count=3), lines_at(5.0, count=3))
    assert acquisition().forerun_speed_m_s == 2340.0
    assert acquisition().sampling_hz == RATE
