"""The simulated A-lines of a hand that takes single lines, too: where the echo stands, the disc's lobe, lines without bone."""

from dataclasses import replace

import numpy as np
import pytest
from simulated_peaks import peaks_off_mm

from Testing.Studies.simulators import sparse_band, sparse_lines, sparse_plan

LINES = 20


@pytest.fixture(scope="module")
def some_recordings():
    return [
        sparse_lines.simulate(np.random.default_rng(98_000_000 + index), 2 * LINES if index < 4 else LINES) for index in range(14)
    ]


@pytest.fixture(scope="module")
def a_plain_setup():
    """Bone everywhere, without a delay line, not clipped."""
    drawn = (sparse_plan.draw_setup(np.random.default_rng(seed)) for seed in range(500))
    found = next(one for one in drawn if not one.without and not one.delay.length_mm and one.centre_mhz < 6)
    return replace(found, snr_db=38.0, saturated=False, spikes=False, strong_galea=False, bits=14)


@pytest.mark.parametrize(("asked", "given"), [(1, 8), (12, 12), (90, 90)])
def test_recording_has_as_many_lines_as_asked_for_but_never_very_few(asked, given):
    for seed in range(3):
        recording, truth, world = sparse_lines.simulate(np.random.default_rng(1000 * seed + asked), asked)
        assert len(recording) == given
        for values in (truth.depth_mm, truth.snr_db, truth.tilt_deg, world.kind, world.ignore, world.demanded):
            assert len(values) == given


def test_peak_of_the_bones_envelope_stands_at_the_true_depth(some_recordings):
    off_mm = []
    for recording, truth, world in some_recordings:
        clear = np.flatnonzero((truth.snr_db > 20) & world.demanded)
        off_mm.extend(peaks_off_mm(recording, truth, clear, world.skin_us * 1e-6, 1e-6 / world.centre_mhz))
    assert len(off_mm) > 40
    assert abs(np.median(off_mm)) < 0.03
    assert np.quantile(np.abs(off_mm), 0.8) < 0.1


def test_bone_is_as_loud_over_the_noise_as_the_truth_says(a_plain_setup):
    off_db = []
    for seed in range(4):
        recording, truth, world = sparse_lines.simulate(
            np.random.default_rng(seed), LINES, replace(a_plain_setup, window_mm=38.0)
        )
        lines = recording.lines - np.median(recording.lines, axis=1, keepdims=True)
        noise = lines[:, -int(6 * world.sampling_mhz) :].std(axis=1).mean()
        cycle = int(world.sampling_mhz / world.centre_mhz)
        for row in np.flatnonzero(world.demanded):
            at = int(truth.depth_mm[row] * world.us_mm * world.sampling_mhz)
            bone = np.ptp(lines[row, at - cycle : at + cycle]) / 2
            off_db.append(20 * np.log10(bone / noise) - truth.snr_db[row])
    assert len(off_db) > 10
    assert abs(np.median(off_db)) < 2


def test_lines_without_bone_have_no_truth(some_recordings):
    for _, truth, world in some_recordings:
        bone = np.isfinite(truth.depth_mm)
        assert np.isfinite(truth.snr_db[bone]).all()
        assert (truth.snr_db[~bone] == -np.inf).all()
        assert not (bone & np.isin(world.kind, ["soft", "air", "water", "unplugged"])).any()
        assert not (world.without and bone.any())
        assert not (world.demanded & ~bone).any()
    assert sum(np.isnan(truth.depth_mm).any() for _, truth, _ in some_recordings) > 3


def test_single_lines_of_sparse_recordings_stand_on_many_places(a_plain_setup):
    places, jumps = {}, {}
    for style in ("sparse", "dwell", "sweep"):
        _, truth, _ = sparse_lines.simulate(np.random.default_rng(3), 30, replace(a_plain_setup, style=style))
        hand = sparse_plan.draw_hand(np.random.default_rng(3), replace(a_plain_setup, style=style), 30)
        places[style] = len(np.unique(hand.place))
        jumps[style] = np.nanmedian(np.abs(np.diff(truth.depth_mm)))
    assert places["sparse"] > 15 > 8 > places["dwell"] >= places["sweep"]
    assert jumps["sparse"] > 0.5 > 0.15 > max(jumps["dwell"], jumps["sweep"])


def test_wider_beam_of_a_focused_element_answers_a_tilt_more():
    setup = sparse_plan.draw_setup(np.random.default_rng(1))
    answers = []
    for aperture in (setup.element_mm, 0.5 * setup.element_mm):
        band = sparse_band.Band(replace(setup, aperture_mm=aperture), 2000)
        answers.append(band.lobe(np.radians([0.0, 2.0, 30.0])))
    assert answers[0][0] == pytest.approx(1.0)
    assert (answers[1][1] > answers[0][1]).all()
    assert (np.diff(answers[1][1]) < 0).all()  # of high frequencies, less is left
    assert np.abs(answers[0][2]).max() < 0.14


def test_pulse_rises_faster_than_it_decays_and_has_its_peak_at_time_zero():
    setup = replace(sparse_plan.draw_setup(np.random.default_rng(2)), decay=1.4)
    setup = replace(setup, acquisition=replace(setup.acquisition, sampling_hz=125e6), bandwidth=0.5)
    band = sparse_band.Band(setup, 4000)
    spectrum = np.zeros(band.size, dtype=complex)
    spectrum[band.bins] = band.pulse
    envelope = np.abs(np.fft.fftshift(np.fft.ifft(spectrum)))
    peak = int(envelope.argmax())
    assert abs(peak - band.size // 2) <= 0.15 * setup.sampling_mhz / setup.centre_mhz
    above = np.flatnonzero(envelope > 0.2 * envelope[peak])
    assert above[-1] - peak > 1.15 * (peak - above[0])


def test_tissue_without_bone_goes_on_where_water_is_silent(a_plain_setup):
    shown = {}
    for without in ("soft", "water", "unplugged"):
        setup = replace(a_plain_setup, without=without, window_mm=38.0)
        recording, truth, world = sparse_lines.simulate(np.random.default_rng(0), 12, setup)
        early, late = (slice(*(int(end * world.us_mm * world.sampling_mhz) for end in ends)) for ends in ((4, 8), (34, 37)))
        lines = recording.lines - np.median(recording.lines, axis=1, keepdims=True)
        shown[without] = lines[:, early].std() / lines[:, late].std()
        assert np.isnan(truth.depth_mm).all()
        assert (world.kind == without).all()
    assert shown["soft"] > 1.5 > max(shown["water"], shown["unplugged"])


def test_face_of_the_delay_line_reflects_nearly_all_in_air():
    drawn = (sparse_plan.draw_setup(np.random.default_rng(seed)) for seed in range(500))
    setup = next(one for one in drawn if one.delay.length_mm and abs(one.delay.face_r) < 0.1)
    heights = {}
    for without in ("water", "air"):
        plain = {"saturated": False, "spikes": False, "bits": 16, "snr_db": 25.0, "without": without}
        recording, _, world = sparse_lines.simulate(np.random.default_rng(4), 8, replace(setup, **plain))
        at = int(world.skin_us[0] * world.sampling_mhz)
        heights[without] = np.abs(recording.lines[:, at - 20 : at + 20].astype(float)).max()
    assert heights["air"] > 1.5 * heights["water"]  # in air, the converter clips


def test_a_user_takes_a_transducer_that_hears_the_deepest_place():
    for seed in range(60):
        rng = np.random.default_rng(seed)
        setup = sparse_plan.draw_setup(rng)
        ground = sparse_plan.draw_ground(rng, setup, int(rng.integers(1, 40)))
        loss_db = 0.2 * ground.attenuation * setup.centre_mhz * ground.depth_mm
        assert loss_db.max() <= sparse_plan.MOST_LOSS_DB
        assert np.ptp(loss_db) <= sparse_plan.APART_DB
        assert setup.sampling_mhz >= sparse_plan.SAMPLES_A_CYCLE * setup.centre_mhz
        assert ground.depth_mm.min() >= sparse_plan.SHALLOWEST_MM


def test_beam_meets_the_bone_where_the_pose_and_the_depth_say():
    drawn = (sparse_plan.draw_setup(np.random.default_rng(seed)) for seed in range(100))
    setup = replace(next(one for one in drawn if one.delay.length_mm and not one.without), style="dwell")
    rng = np.random.default_rng(6)
    hand = sparse_plan.draw_hand(rng, setup, 60)
    ground = sparse_plan.draw_ground(rng, setup, int(hand.place[-1]) + 1)
    beam = sparse_plan.draw_beam(rng, setup, hand, ground)
    poses = sparse_plan.draw_poses(rng, setup, hand, ground, beam)
    bone = poses[:, :3, 3] + (setup.delay.length_mm + beam.depth_mm)[:, None] * poses[:, :3, 2]
    centre = ground.position_mm - ground.radius_mm[:, None] * ground.axes[:, :, 2]
    outward = bone - centre[hand.place]
    radius = np.linalg.norm(outward, axis=1)
    on_skin = np.isin(hand.state, ["bone", "soft", "hair", "edge"])
    assert np.abs(radius - ground.radius_mm[hand.place])[on_skin].max() < 0.7
    cosine = -(poses[:, :3, 2] * outward).sum(axis=1) / radius
    tilt = np.degrees(np.arccos(np.clip(cosine, -1, 1)))
    assert np.median(np.abs(tilt - np.degrees(beam.tilt_rad))[on_skin]) < 1.0
