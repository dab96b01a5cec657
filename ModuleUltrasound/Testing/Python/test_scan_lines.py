"""The simulated A-lines of a hand-held scan: where the echo stands, as many lines as asked, what loses the bone's echo."""

from dataclasses import replace

import numpy as np
import pytest
from simulated_peaks import peaks_off_mm

from Testing.Studies.simulators import scan_lines
from Testing.Studies.simulators.scan_plan import draw_setup


@pytest.fixture(scope="module")
def some_recordings():
    return [scan_lines.simulate(np.random.default_rng(96_000_000 + index), 24) for index in range(10)]


@pytest.fixture(scope="module")
def a_plain_setup():
    return replace(draw_setup(np.random.default_rng(3)), without="", sweeps=False, snr_db=38.0)


@pytest.mark.parametrize("frames", [8, 12, 40, 90])
def test_recording_has_about_as_many_lines_as_asked_for(frames):
    for seed in range(2):
        recording, _, world = scan_lines.simulate(np.random.default_rng(1000 * seed + frames), frames)
        assert max(8, 0.6 * frames) <= len(recording) <= 1.5 * frames
        assert len(world.kind) == len(world.ignore) == len(recording)


def test_echo_stands_where_the_truth_says(some_recordings):
    off = []
    for recording, truth, world in some_recordings:
        clear = (truth.snr_db > 25) & (truth.tilt_deg < 2) & (world.kind == "bone")
        skin_s = 1e-6 * world.probe.face_us(len(recording))
        off += peaks_off_mm(recording, truth, np.flatnonzero(clear), skin_s, 0.4e-6)
    assert len(off) > 20
    assert abs(np.median(off)) < 0.04
    assert np.median(np.abs(off)) < 0.06


def test_lines_without_bone_have_no_truth(some_recordings, a_plain_setup):
    for _, truth, world in some_recordings:
        bare = np.isin(world.kind, ["air", "gap", "soft", "gel"])
        np.testing.assert_array_equal(np.isnan(truth.depth_mm), bare)
        np.testing.assert_array_equal(truth.snr_db == -np.inf, bare)
    for without in ("soft", "gel", "air"):
        _, truth, _ = scan_lines.simulate(np.random.default_rng(3), 8, replace(a_plain_setup, without=without))
        assert np.isnan(truth.depth_mm).all()


def test_bone_stands_over_the_noise_as_drawn_and_fades_with_tilt(a_plain_setup):
    square, tilted = [], []
    for seed in range(4):
        _, truth, world = scan_lines.simulate(np.random.default_rng(seed), 32, a_plain_setup)
        whole = np.isin(world.kind, ["bone", "tilted"])
        square += list(truth.snr_db[whole & (truth.tilt_deg < 2)])
        tilted += list(truth.snr_db[whole & (truth.tilt_deg > 5)])
    assert abs(np.median(square) - a_plain_setup.snr_db) < 3
    assert np.median(tilted) < np.median(square) - 3


def test_echoes_get_fainter_with_depth_as_the_tissue_attenuates(a_plain_setup):
    deep = replace(a_plain_setup, without="air", attenuation=1.0)
    hand = scan_lines.draw_hand(np.random.default_rng(1), deep, 8)
    scene = scan_lines.draw_scene(np.random.default_rng(1), deep, hand)
    reflections = np.zeros((2, scene.size), dtype=np.float32)
    skin = scene.face_us.mean()
    for row, depth_mm in enumerate((3.0, 9.0)):
        reflections[row, round((skin + float(deep.echo_us(depth_mm))) * scene.rate_mhz)] = 1
    peak = np.abs(scan_lines._through(scene, reflections)).max(axis=1)
    assert 20 * np.log10(peak[0] / peak[1]) == pytest.approx(6 * deep.loss_db_mm, rel=0.1)  # a broad pulse loses its upper half


def test_hole_in_the_bone_takes_the_echo_by_the_share_of_the_beam(a_plain_setup):
    setup = replace(a_plain_setup, sweeps=True)
    drawn = (scan_lines.simulate(np.random.default_rng(seed), 60, setup) for seed in range(40))
    _, truth, world = next(one for one in drawn if one[2].ignore.any())
    assert np.isfinite(truth.depth_mm[world.ignore]).all()
    whole = (world.kind == "bone") & (truth.tilt_deg < 2)
    assert truth.snr_db[world.ignore].min() < np.median(truth.snr_db[whole]) - 3
