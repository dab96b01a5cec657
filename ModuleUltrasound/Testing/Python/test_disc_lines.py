"""The simulated A-lines of a disc over a rough sphere: where the echo stands, tilt, layers without bone, the face."""

from dataclasses import replace

import numpy as np
import pytest
from simulated_peaks import peaks_off_mm, stated_skin_s

from Testing.Studies.simulators import disc_lines, disc_plan

LINES = 20


@pytest.fixture(scope="module")
def some_recordings():
    return [disc_lines.simulate(np.random.default_rng(97_000_000 + index), LINES) for index in range(16)]


@pytest.fixture(scope="module")
def a_plain_setup():
    """Bone everywhere, heard well, without a delay line."""
    drawn = (disc_plan.draw_setup(np.random.default_rng(seed)) for seed in range(500))
    found = next(one for one in drawn if not (one.without or one.delay.length_mm) and one.depth_mm > 6 and one.attenuation < 1)
    plain = {"leaves": False, "sweeps": False, "places": 1, "spikes": False, "saturated": False, "fill": 0.3, "bits": 14}
    return replace(found, snr_db=40.0, **plain)


@pytest.mark.parametrize(("asked", "given"), [(1, 8), (12, 12), (90, 90)])
def test_recording_has_as_many_lines_as_asked_for_but_never_very_few(asked, given):
    for seed in range(3):
        recording, truth, world = disc_lines.simulate(np.random.default_rng(1000 * seed + asked), asked)
        assert len(recording) == given
        for values in (truth.depth_mm, truth.snr_db, truth.tilt_deg, world.kind, world.ignore, recording.statuses):
            assert len(values) == given


def test_peak_of_the_bones_envelope_stands_at_the_true_depth(some_recordings):
    off_mm = []
    for recording, truth, world in some_recordings:
        skin_s = stated_skin_s(recording) * (1 + world.delay.late)
        clear = np.flatnonzero((truth.snr_db > 25) & (truth.tilt_deg < 2) & ~world.ignore)
        off_mm.extend(peaks_off_mm(recording, truth, clear, skin_s, 1e-6 / world.centre_mhz))
    assert len(off_mm) > 40
    assert abs(np.median(off_mm)) < 0.04
    assert np.quantile(np.abs(off_mm), 0.8) < 0.1


def test_bone_is_as_loud_over_the_noise_as_the_truth_says(a_plain_setup):
    recording, truth, world = disc_lines.simulate(np.random.default_rng(1), 30, a_plain_setup)
    noise = recording.lines[:, -int(3 * world.sampling_mhz) :].astype(float).std(axis=1).mean()
    off_db = []
    for row in np.flatnonzero((truth.tilt_deg < 2) & (world.kind == "bone")):
        at = int(2 * truth.depth_mm[row] / world.mm_us * world.sampling_mhz)
        line = recording.lines[row] - np.median(recording.lines[row])
        near = slice(at - int(world.sampling_mhz / world.centre_mhz), at + int(world.sampling_mhz / world.centre_mhz))
        off_db.append(20 * np.log10(np.abs(line[near]).max() / noise) - truth.snr_db[row])
    assert len(off_db) > 5
    assert abs(np.median(off_db)) < 2


def test_lines_without_bone_have_no_truth(some_recordings):
    for _, truth, world in some_recordings:
        bone = np.isfinite(truth.depth_mm)
        assert np.isfinite(truth.snr_db[bone]).all()
        assert (truth.snr_db[~bone] == -np.inf).all()
        assert not (bone & np.isin(world.kind, ["soft", "air", "gel", "noise"])).any()
        assert not (world.without and bone.any())
    assert sum(np.isnan(truth.depth_mm).any() for _, truth, _ in some_recordings) > 3


def test_tilt_takes_the_echo_of_the_disc_away_and_leaves_what_the_rough_bone_scatters(a_plain_setup):
    lost_db = {low: [] for low in (1, 2, 3, 7)}
    for seed in range(3):
        _, truth, _ = disc_lines.simulate(np.random.default_rng(seed), 80, replace(a_plain_setup, places=4))
        square = np.nanmedian(truth.snr_db[truth.tilt_deg < 0.7]) if (truth.tilt_deg < 0.7).any() else np.nan
        for low, found in lost_db.items():
            rows = (truth.tilt_deg > low) & (truth.tilt_deg < low + 1) & np.isfinite(truth.depth_mm)
            found.extend(square - truth.snr_db[rows])
    lost = [np.nanmedian(found) for found in lost_db.values()]
    assert 0.5 < lost[0] < 9
    assert lost[0] < lost[1] < lost[2]
    assert lost[3] < 32  # 8 degrees: a mirror would have lost far more


def test_tissue_without_bone_goes_on_where_gel_is_silent(a_plain_setup):
    shown = {}
    for without in ("soft", "gel", "air", "noise"):
        setup = replace(a_plain_setup, without=without, snr_db=40.0, depth_mm=8.0)
        recording, truth, world = disc_lines.simulate(np.random.default_rng(2), 12, setup)
        early, late = (slice(*(int(2 * end / world.mm_us * world.sampling_mhz) for end in ends)) for ends in ((5, 12), (17, 19)))
        lines = recording.lines - np.median(recording.lines, axis=1, keepdims=True)
        shown[without] = lines[:, early].std() / lines[:, late].std()
        assert np.isnan(truth.depth_mm).all()
        assert (world.kind == without).all()
    assert shown["soft"] > 1.6
    assert max(shown[without] for without in ("gel", "air", "noise")) < 1.5


def test_face_of_the_delay_line_reflects_all_in_air():
    drawn = (disc_plan.draw_setup(np.random.default_rng(seed)) for seed in range(500))
    setup = next(
        one for one in drawn if one.delay.length_mm and not one.without and abs(one.delay.face_r) < 0.1 and one.bits == 14
    )
    heights = {}
    for without in ("gel", "air"):
        plain = {"saturated": False, "fill": 0.01, "spikes": False, "snr_db": 25.0}
        recording, _, world = disc_lines.simulate(np.random.default_rng(4), 8, replace(setup, without=without, **plain))
        at = int(2 * world.delay.length_mm / world.delay.speed_m_s * 1e3 * world.sampling_mhz)
        heights[without] = np.abs(recording.lines[:, at - 20 : at + 20].astype(float)).max()
    assert heights["air"] > 3 * heights["gel"]


def test_depth_and_frequency_are_such_that_a_user_could_hear_bone():
    setups = [disc_plan.draw_setup(np.random.default_rng(seed)) for seed in range(200)]
    for one in setups:
        most_db = disc_plan.SOFT_LOSS_DB if one.without == "soft" else disc_plan.MOST_LOSS_DB
        assert one.depth_mm * one.loss_db_mm <= max(most_db, (one.least_mm + 0.8) * one.loss_db_mm) + 1e-9
        assert one.sampling_mhz >= disc_plan.SAMPLES_A_CYCLE * one.centre_mhz
        assert 2 <= one.least_mm <= one.depth_mm <= one.most_mm <= 15
    assert 0.12 < np.mean([one.without != "" for one in setups]) < 0.29
    assert 0.5 < np.mean([one.delay.length_mm > 0 for one in setups]) < 0.7
    assert 0.05 < np.mean([one.delay.short for one in setups]) < 0.2
    assert 0.12 < np.mean([one.formalin for one in setups]) < 0.29


def test_beam_meets_the_sphere_at_the_stated_depth_and_tilt():
    drawn = (disc_plan.draw_setup(np.random.default_rng(seed)) for seed in range(100))
    setup = next(one for one in drawn if one.delay.length_mm and not one.without)
    recording, truth, _ = disc_lines.simulate(np.random.default_rng(6), 60, setup)
    seen = np.isfinite(truth.depth_mm) & np.isfinite(recording.probe_to_reference[:, 0, 0])
    poses = recording.probe_to_reference[seen]
    far = setup.delay.length_mm + truth.depth_mm[seen]
    bone = poses[:, :3, 3] + far[:, None] * poses[:, :3, 2]
    radius = np.linalg.norm(bone, axis=1)
    assert np.abs(radius - setup.head_mm).max() < 0.6
    against = np.einsum("ni,ni->n", -poses[:, :3, 2], bone / radius[:, None])
    tilt = np.degrees(np.arccos(np.clip(against, -1, 1)))
    assert np.abs(tilt - truth.tilt_deg[seen]).max() < 0.8


def test_longer_recording_goes_to_more_places():
    drawn = (disc_plan.draw_setup(np.random.default_rng(seed)) for seed in range(100))
    setup = next(one for one in drawn if not one.sweeps and one.places == 4 and one.usual_lines > 60)
    places = [len(np.unique(disc_plan.draw_hand(np.random.default_rng(1), setup, frames).place)) for frames in (12, 40, 90)]
    assert places[0] == 1
    assert places[0] < places[1] < places[2]
