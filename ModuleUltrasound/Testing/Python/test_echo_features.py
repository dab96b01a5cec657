import numpy as np
import pytest
from ModuleUltrasoundLib.echo.candidates import CANDIDATES, Candidates
from ModuleUltrasoundLib.echo.features import NAMES, line_features
from ModuleUltrasoundLib.echo.forerun import Forerun

SPEED = 1540.0
SKIN_S = 17e-6


def candidates_at(depths_mm, snrs_db, **others):
    """One line with echoes at given depths and levels over noise of one."""
    count = len(depths_mm)

    def row(values):
        return np.concatenate([np.broadcast_to(values, count), np.full(CANDIDATES - count, np.nan)])[None].astype(float)

    given = {
        "delays_s": np.array(depths_mm) / (500 * SPEED), "amplitudes": 10 ** (np.array(snrs_db) / 20), "phases": 0.0,
        "widths_s": 1e-7, "frequencies_hz": 4.6e6, "saliences_db": 20.0, "before_db": 0.0, "after_db": 0.0,
        "before_all_db": 0.0, "after_all_db": 0.0, "rise_db": 20.0, "fall_db": 20.0, "end_db": 0.0, "static": 0.0,
        "half_db": -40.0, "further_db": -40.0, **others,
    }  # fmt: skip
    return Candidates(**{name: row(value) for name, value in given.items()}, noise=np.ones(1))


def features_of(candidates, forerun_amplitude=1000.0, jump_s=0.0):
    seen = np.array([forerun_amplitude > 0])
    forerun = Forerun(np.array([SKIN_S]), np.array([forerun_amplitude]), seen, seen, np.zeros(1), np.full(1, jump_s), np.zeros(1))
    values = line_features(candidates, forerun, SKIN_S, 5e6, SPEED)
    return {name: values[0, :, number] for number, name in enumerate(NAMES)}


def test_each_echo_is_compared_with_the_strongest_before_and_behind():
    found = features_of(candidates_at([4.0, 7.0, 11.0], [30.0, 45.0, 33.0]))
    assert found["stronger before"][1] * 15 == pytest.approx(-15, abs=1e-3)
    assert found["its distance"][1] * 5 == pytest.approx(3, abs=1e-3)
    assert found["stronger behind"][1] * 15 == pytest.approx(-12, abs=1e-3)
    assert found["its distance behind"][1] * 5 == pytest.approx(4, abs=1e-3)
    assert found["stronger behind"][0] * 15 == pytest.approx(15, abs=1e-3)


def test_shadow_is_the_drop_of_the_level_over_the_echo():
    found = features_of(candidates_at([5.0, 9.0], [40.0, 20.0], before_db=[18.0, 1.0], after_db=[1.0, 2.0]))
    assert found["drop"][0] * 10 == pytest.approx(17, abs=1e-3)
    assert found["drop"][1] * 10 == pytest.approx(-1, abs=1e-3)


def test_echo_where_the_forerun_repeats_is_marked_also_when_the_pulse_is_late():
    at = SKIN_S * 500 * SPEED
    found = features_of(candidates_at([at, at - 0.15, at - 3, at + 0.6], [30.0] * 4))
    assert found["multiple"][:2].min() > 0.9
    assert found["multiple"][2:4].max() < 0.1
    assert found["multiple share"][0] * 15 == pytest.approx(-30, abs=1)


def test_line_whose_trigger_jumped_shows_the_multiple_as_much_later():
    at = SKIN_S * 500 * SPEED
    late = candidates_at([at + 0.4, at - 3], [30.0] * 2)
    assert features_of(late)["multiple"][0] < 0.3
    assert features_of(late, jump_s=0.4 / (500 * SPEED))["multiple"][:2] == pytest.approx([1, 0], abs=0.05)


def test_first_reverberation_under_the_skin_names_its_source():
    found = features_of(candidates_at([5.0, 10.0, 13.0], [40.0, 25.0, 25.0]))
    assert found["reverberation"][1] * 15 == pytest.approx(15, abs=1e-3)
    assert found["reverberation"][[0, 2]].max() == 0


def test_echo_that_comes_again_at_twice_its_depth_is_marked_by_the_strength_of_the_second():
    found = features_of(candidates_at([5.0, 10.0, 13.0], [40.0, 25.0, 25.0]))
    assert found["own reverberation"][0] * 15 == pytest.approx(40 - 15, abs=1e-3)
    assert found["own reverberation"][1:3].max() == 0


def test_frequency_drawn_down_by_tissue_is_seen_against_the_echo_before():
    found = features_of(candidates_at([3.0, 9.0], [40.0, 38.0], frequencies_hz=[4.6e6, 4.1e6]))
    assert found["frequency against before"][1] == pytest.approx(-0.5, abs=1e-3)
    assert found["frequency against before"][0] == 0


def test_missing_candidates_and_forerun_leave_finite_numbers():
    found = features_of(candidates_at([6.0], [30.0]), forerun_amplitude=0.0)
    assert all(np.isfinite(values).all() for values in found.values())
    assert all((values[1:] == 0).all() for values in found.values())
    assert found["has forerun"][0] == 0


def test_film_that_sends_sound_to_and_fro_is_seen_at_half_the_delay_and_at_one_and_a_half():
    found = features_of(candidates_at([2.0, 6.0], [40.0, 40.0], half_db=[8.0, -35.0], further_db=[-6.0, -30.0]))
    assert found["half"][:2] * 15 == pytest.approx([8, -35], abs=1e-3)
    assert found["further"][:2] * 15 == pytest.approx([-6, -30], abs=1e-3)
