import numpy as np
import pytest
from CranioNavLib.errors import InputError
from CranioNavLib.sequence_metafile import Acquisition, Recording
from ModuleUltrasoundLib.echo import search as echo_search
from ModuleUltrasoundLib.echo.features import CLEAR_DB
from ModuleUltrasoundLib.echo.search import KEPT, check_length, search_lines
from ModuleUltrasoundLib.echo.timing import BEFORE

ACQUISITION = Acquisition(60e6, 5e6, 20.0, 2340.0)


@pytest.fixture
def a_recording():
    rng = np.random.default_rng(0)
    time = np.arange(2900) / ACQUISITION.sampling_hz
    skin = 2e-3 * 20 / 2340
    lines = rng.normal(0, 0.004, (60, 2900))
    for at, height in (
        (np.full(60, skin), 0.2),
        (skin + rng.uniform(5e-6, 15e-6, 60), 0.5),
        (skin + rng.uniform(2e-6, 4e-6, 60), 0.1),
    ):
        t = time - at[:, None]
        lines += height * np.exp(-0.5 * (t * 5e6 / 0.5) ** 2) * np.cos(2 * np.pi * 5e6 * t)
    return Recording(
        np.round(8000 * lines).astype(np.int16), ACQUISITION, np.tile(np.eye(4), (60, 1, 1)), ("OK",) * 60, np.arange(60) / 50,
        np.full(60, -1),
    )  # fmt: skip


def test_batches_do_not_change_what_is_found(a_recording, monkeypatch):
    whole = search_lines(a_recording, 1540.0, (1.4, 20.0), places=None)
    monkeypatch.setattr(echo_search, "CHUNK", 7)
    parts = search_lines(a_recording, 1540.0, (1.4, 20.0), places=None)
    assert parts.depths_mm[:, 0] == pytest.approx(whole.depths_mm[:, 0], abs=5e-3)


def test_candidates_stand_in_the_order_of_their_rank(a_recording):
    found = search_lines(a_recording, 1540.0, (1.4, 20.0), None, rank=lambda features: features[..., 0])
    snr = found.candidates.snrs_db
    assert (np.diff(np.where(found.possible, snr, -99), axis=1) <= 1e-6).all()
    assert found.features[..., 0][:, 0] * 20 == pytest.approx(np.minimum(snr[:, 0], CLEAR_DB), abs=1e-3)


def test_windows_are_cut_around_the_first_candidates(a_recording):
    found = search_lines(a_recording, 1540.0, (1.4, 20.0), None, rank=lambda features: features[..., 0])
    assert found.windows.shape[:2] == (60, KEPT)
    middle = np.abs(found.windows[:, 0, BEFORE])
    assert middle == pytest.approx(found.candidates.amplitudes[:, 0], rel=0.05)


def with_lines(recording, lines, acquisition=ACQUISITION):
    return Recording(
        lines, acquisition, recording.probe_to_reference, recording.statuses, recording.timestamps_s, recording.palpation_points
    )


@pytest.mark.parametrize("samples", [1, 30, 1025])
def test_lines_that_end_before_any_bone_are_refused(a_recording, samples):
    short = with_lines(a_recording, a_recording.lines[:, :samples])
    with pytest.raises(InputError, match=r"the lines end after .* us, before bone can be seen"):
        check_length(short, 1540.0, 1.4)
    assert np.isnan(search_lines(short, 1540.0, (1.4, 20.0), None).depths_mm).all()


def test_lines_that_reach_bone_pass(a_recording):
    check_length(a_recording, 1540.0, 1.4)


def test_hum_that_the_line_cuts_off_leaves_no_echo_at_its_end(a_recording):
    time = np.arange(2900) / ACQUISITION.sampling_hz
    hum = np.round(4000 * np.sin(2 * np.pi * 1e4 * time + np.arange(60)[:, None]))
    lines = a_recording.lines + hum.astype(np.int16)
    calm = search_lines(a_recording, 1540.0, (1.4, 20.0), None, rank=lambda features: features[..., 0])
    hummed = search_lines(with_lines(a_recording, lines), 1540.0, (1.4, 20.0), None, rank=lambda features: features[..., 0])
    assert hummed.depths_mm[:, 0] == pytest.approx(calm.depths_mm[:, 0], abs=0.02)


def test_depth_is_half_the_way_of_the_sound(a_recording):
    slow = search_lines(a_recording, 1500.0, (1.4, 20.0), None)
    assert slow.depths_mm == pytest.approx(slow.candidates.delays_s * 750e3, nan_ok=True)


def test_echoes_beyond_the_depths_of_bone_are_seen_and_are_no_bone(a_recording):
    found = search_lines(a_recording, 1540.0, (4.0, 9.0), None, rank=lambda features: features[..., 0])
    seen = found.depths_mm[np.isfinite(found.depths_mm)]
    assert seen.min() > 3.5
    assert 9.5 < seen.max() < 13.1
    np.testing.assert_array_equal(found.possible, (found.depths_mm >= 4.0) & (found.depths_mm <= 9.0))
    first_impossible = np.where(found.possible.all(axis=1), found.possible.shape[1], found.possible.argmin(axis=1))
    assert (found.possible.sum(axis=1) == first_impossible).all(), "what may be bone comes first"
