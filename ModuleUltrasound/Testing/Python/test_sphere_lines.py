"""The simulated A-lines over spheres of bone: where the echo stands, tilt, gel in air, soft places, what goes together."""

from dataclasses import replace

import numpy as np
import pytest
from simulated_peaks import peaks_off_mm, stated_skin_s

from Testing.Studies.simulators import sphere_hand, sphere_lines, sphere_plan

LINES = 20


@pytest.fixture(scope="module")
def some_recordings():
    return [sphere_lines.simulate(np.random.default_rng(98_000_000 + index), LINES) for index in range(12)]


@pytest.fixture(scope="module")
def a_plain_setup():
    """Bone everywhere, heard well, without a delay line."""
    drawn = (sphere_plan.draw_setup(np.random.default_rng(seed)) for seed in range(500))
    plainly = (one for one in drawn if not (one.without or one.delay.length_mm) and one.attenuation < 1)
    found = next(one for one in plainly if 4 < one.centre_mhz < 6 and one.sampling_mhz > 40)
    plain = {"sweeps": False, "spikes": False, "pickup": False, "saturated": False, "fill": 0.3, "bits": 14, "depth_gain": 0.0}
    return replace(found, snr_db=40.0, depths_mm=(6.0, 7.0, 8.0, 6.5), **plain)


@pytest.mark.parametrize(("asked", "given"), [(1, 8), (12, 12), (90, 90)])
def test_recording_has_as_many_lines_as_asked_for_but_never_very_few(asked, given):
    for seed in range(2):
        recording, truth, world = sphere_lines.simulate(np.random.default_rng(1000 * seed + asked), asked)
        assert len(recording) == given
        for values in (truth.depth_mm, truth.snr_db, truth.tilt_deg, world.kind, recording.statuses, recording.timestamps_s):
            assert len(values) == given
        assert (np.diff(recording.timestamps_s) > 0).all()


def test_peak_of_the_bones_envelope_stands_at_the_true_depth(a_plain_setup):
    off_mm = []
    for seed in range(4):
        recording, truth, world = sphere_lines.simulate(np.random.default_rng(seed), LINES, a_plain_setup)
        clear = np.flatnonzero((truth.snr_db > 25) & (truth.tilt_deg < 2) & (world.kind == "bone"))
        off_mm.extend(peaks_off_mm(recording, truth, clear, stated_skin_s(recording), 1e-6 / world.centre_mhz))
    assert len(off_mm) > 10
    assert abs(np.median(off_mm)) < 0.03
    assert np.quantile(np.abs(off_mm), 0.8) < 0.1


def test_delay_line_is_at_most_by_its_tolerance_off_the_stated_time(some_recordings):
    off_mm, tolerance_mm = [], []
    for recording, truth, world in some_recordings:
        skin_s = stated_skin_s(recording)
        clear = np.flatnonzero((truth.snr_db > 25) & (truth.tilt_deg < 3) & (world.kind == "bone"))
        tolerance_mm.extend(0.012 * skin_s[clear] * world.speed_m_s * 500 + 0.12)
        off_mm.extend(peaks_off_mm(recording, truth, clear, skin_s, 0.012 * skin_s[0] + 1e-6 / world.centre_mhz))
    assert len(off_mm) > 25
    assert np.mean(np.abs(off_mm) <= tolerance_mm) > 0.9


def test_lines_without_bone_have_no_truth(some_recordings):
    for _, truth, world in some_recordings:
        bone = np.isfinite(truth.depth_mm)
        np.testing.assert_array_equal(bone, np.isin(world.kind, ["bone", "landing"]))
        assert np.isfinite(truth.snr_db[bone]).all()
        assert (truth.snr_db[~bone] == -np.inf).all()
        assert not (world.without and bone.any())
    assert sum(np.isnan(truth.depth_mm).any() for _, truth, _ in some_recordings) > 3


def test_bone_is_as_loud_over_the_noise_as_the_truth_says(a_plain_setup):
    off_db = []
    for seed in range(4):
        recording, truth, world = sphere_lines.simulate(np.random.default_rng(seed), LINES, a_plain_setup)
        noise = recording.lines[:, -int(2 * world.sampling_mhz) :].astype(float).std(axis=1).mean()
        half = int(world.sampling_mhz / world.centre_mhz)
        for row in np.flatnonzero((truth.tilt_deg < 3) & (world.kind == "bone")):
            at = int(2 * truth.depth_mm[row] / world.mm_us * world.sampling_mhz)
            line = recording.lines[row] - np.median(recording.lines[row])
            off_db.append(20 * np.log10(np.abs(line[at - half : at + half]).max() / noise) - truth.snr_db[row])
    assert len(off_db) > 12
    assert abs(np.median(off_db)) < 2


def test_a_round_element_hears_less_of_tilted_bone_down_to_what_the_rough_bone_scatters(a_plain_setup):
    levels = {(0, 1): [], (2, 3): [], (8, 12): []}
    setup = replace(a_plain_setup, diffuse=10 ** (-20 / 20))
    for seed in range(6):
        _, truth, world = sphere_lines.simulate(np.random.default_rng(seed), 40, setup)
        for (low, high), found in levels.items():
            found.extend(truth.snr_db[(world.kind == "bone") & (truth.tilt_deg >= low) & (truth.tilt_deg < high)])
    square, tilted, askew = (np.median(found) for found in levels.values())
    assert tilted < square - 2
    assert square - 30 < askew < square - 10


def test_film_of_gel_in_air_answers_nearer_than_bone_and_again_at_its_multiples(a_plain_setup):
    setup = replace(a_plain_setup, without="gel", snr_db=40.0, fill=0.1)
    recording, truth, world = sphere_lines.simulate(np.random.default_rng(3), 12, setup)
    depth = np.arange(recording.lines.shape[1]) / world.sampling_mhz * world.mm_us / 2
    lines = np.abs(recording.lines - np.median(recording.lines, axis=1, keepdims=True))
    ladder, behind = (lines[:, (depth > low) & (depth < high)].max(axis=1) for low, high in ((1.9, 5), (16, 18)))
    assert np.median(ladder / behind) > 3
    assert np.isnan(truth.depth_mm).all()
    assert (world.kind == "gel").all()


def test_tissue_without_bone_is_seen_to_go_on_beyond_its_layers(a_plain_setup):
    shown = {}
    for without in ("soft", "air", "cable"):
        setup = replace(a_plain_setup, without=without, snr_db=40.0)
        recording, truth, world = sphere_lines.simulate(np.random.default_rng(2), 12, setup)
        depth = np.arange(recording.lines.shape[1]) / world.sampling_mhz * world.mm_us / 2
        lines = recording.lines - np.median(recording.lines, axis=1, keepdims=True)
        shown[without] = lines[:, (depth > 9) & (depth < 12)].std() / lines[:, (depth > 17) & (depth < 18.5)].std()
        assert np.isnan(truth.depth_mm).all()
        assert (world.kind == without).all()
    assert shown["soft"] > 1.4 > max(shown["air"], shown["cable"])


def test_face_of_the_delay_line_reflects_nearly_all_in_air_and_nothing_without_a_transducer():
    drawn = (sphere_plan.draw_setup(np.random.default_rng(seed)) for seed in range(500))
    setup = next(one for one in drawn if one.delay.length_mm and not one.without and one.bits > 12 and not one.saturated)
    heights = {}
    for without in ("air", "cable"):
        plain = {"fill": 0.05, "spikes": False, "pickup": False, "depth_gain": 0.0, "snr_db": 40.0}
        recording, _, world = sphere_lines.simulate(np.random.default_rng(4), 8, replace(setup, without=without, **plain))
        at = int(stated_skin_s(recording)[0] * world.sampling_mhz * 1e6)
        lines = recording.lines - np.median(recording.lines, axis=1, keepdims=True)
        heights[without] = np.abs(lines[:, at - 20 : at + 20].astype(float)).max()
    assert heights["air"] > 10 * heights["cable"]


def test_depth_loss_and_frequency_are_such_that_a_user_could_hear_bone():
    setups = [sphere_plan.draw_setup(np.random.default_rng(seed)) for seed in range(120)]
    for one in setups:
        assert one.loss_db_mm * max(one.depths_mm) + one.delay_db <= sphere_plan.MOST_LOSS_DB
        assert one.sampling_mhz >= sphere_plan.SAMPLES_A_CYCLE * one.centre_mhz
        assert not (one.without == "soft" and one.attenuation * one.centre_mhz > sphere_plan.SOFT_LOSS_DB)
    assert 0.05 < np.mean([one.without != "" for one in setups]) < 0.2
    assert 0.45 < np.mean([one.delay.length_mm > 0 for one in setups]) < 0.75
    assert 0.06 < np.mean([one.delay.short for one in setups]) < 0.26


def test_beam_meets_the_sphere_at_the_stated_depth_and_tilt():
    drawn = (sphere_plan.draw_setup(np.random.default_rng(seed)) for seed in range(100))
    setup = next(one for one in drawn if one.delay.length_mm and not one.without)
    hand = sphere_hand.draw_hand(np.random.default_rng(6), setup, 60)
    upright = replace(hand, along_mm=np.zeros(60), tilt_deg=np.zeros((60, 2)))
    poses, squarely = (sphere_hand.draw_poses(np.random.default_rng(7), setup, one) for one in (hand, upright))
    radius = hand.radius_mm[hand.place][:, None]
    centre = -squarely[:, :3, 2] * (sphere_hand.HEAD_MM - radius)
    bone = poses[:, :3, 3] + (setup.delay.length_mm + hand.depth_mm)[:, None] * poses[:, :3, 2]
    outward = bone - centre
    far = np.linalg.norm(outward, axis=1)
    assert np.abs(far - radius[:, 0])[hand.bone].max() < 0.6
    against = -(poses[:, :3, 2] * outward).sum(axis=1) / far
    tilt = np.degrees(np.arccos(np.clip(against, -1, 1)))
    off = np.abs(tilt - np.degrees(hand.incidence_rad))[hand.bone & (hand.incidence_rad > 0.03)]
    assert off.max() < 1


def test_longer_recording_goes_to_more_places(a_plain_setup):
    places = [len(np.unique(sphere_hand.draw_hand(np.random.default_rng(1), a_plain_setup, n).place)) for n in (12, 40, 90)]
    assert places[0] <= 2
    assert places[0] < places[1] < places[2]
