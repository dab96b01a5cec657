import numpy as np
import pytest
from ModuleUltrasoundLib.echo.likelihood import DepthMap, Echoes, Neighbours, contact, relative_polarity, relative_strength


def test_polarity_is_that_of_the_likely_bones_and_silent_when_they_disagree():
    phases = np.tile([0.4, 0.4 + np.pi], (30, 1))
    chance = np.tile([0.9, 0.1], (30, 1))
    cosine, known = relative_polarity(phases, chance)
    assert cosine[:, 0] == pytest.approx(np.full(30, known))
    assert cosine[:, 1] == pytest.approx(np.full(30, -known))
    assert known > 0.9
    random = np.random.default_rng(1).uniform(0, 2 * np.pi, (30, 2))
    assert relative_polarity(random, chance)[1] < 0.1


def test_layer_as_strong_as_the_bone_behind_so_much_tissue_is_too_weak_for_a_bone():
    depth = np.column_stack([np.linspace(8, 10, 20), np.full(20, 3.0)])
    strength, known, _ = relative_strength(np.full((20, 2), 100.0), np.tile([0.95, 0.02], (20, 1)), depth, 5.0)
    assert known == 1
    at_least_db = 0.2 * 0.3 * 5 * 6  # the clearest scalp, 6 mm of it, there and back
    assert (15 * strength[:, 1] < -at_least_db + 0.1).all()
    assert np.abs(15 * strength[:, 0]).max() < 2


@pytest.mark.parametrize("fading", [0.6, 1.2, 2.4])  # dB/cm/MHz
def test_bone_s_fading_with_depth_is_read_from_the_recording(fading):
    rng = np.random.default_rng(2)
    depth = rng.uniform(3, 13, (60, 1))
    amplitude = 1000 * 10 ** (-0.2 * fading * 5 * depth / 20 + rng.normal(0, 0.05, (60, 1)))
    strength, known, slope = relative_strength(amplitude, np.full((60, 1), 0.9), depth, 5.0)
    assert (known, slope) == (1, pytest.approx(-0.2 * fading * 5, rel=0.15))
    assert np.abs(strength).max() < 0.4


def test_neighbours_of_the_same_stay_support_one_depth():
    depth = np.column_stack([np.full(9, 6.0), np.linspace(10, 18, 9)])
    chance = np.full((9, 2), 0.5)
    support = DepthMap.of(chance, depth).mean(Neighbours.within(np.zeros(9, dtype=int), 4), 0.35)
    assert support[4, 0] == pytest.approx(0.5, rel=0.1)
    assert support[4, 1] < 0.05
    assert DepthMap.of(chance, depth).mean(Neighbours.within(np.arange(9), 4), 0.35).max() == 0


def test_neighbours_end_with_the_stay_and_the_reach_and_leave_the_line_itself_out():
    runs = np.array([0, 0, 0, 0, 1, 1, 2])
    neighbours = Neighbours.within(runs, 2)
    values = np.arange(7.0)[:, None] ** 2
    expected = []
    for i in range(7):
        others = [j for j in range(7) if j != i and runs[j] == runs[i] and abs(i - j) <= 2]
        expected.append(np.mean([values[j, 0] for j in others]) if others else 0.0)
    assert neighbours.mean(values)[:, 0] == pytest.approx(expected)


def test_echo_that_shows_at_every_place_is_found_elsewhere_and_bone_of_one_place_is_not():
    runs = np.repeat(np.arange(5), 4)
    depth = np.column_stack([3.0 + 2.0 * runs, np.full(20, 14.5)])
    echoes = Echoes.of(depth, runs)
    assert echoes.presence == pytest.approx(np.ones((20, 2)), abs=0.05)
    assert echoes.elsewhere[:, 0].max() < 0.05
    assert echoes.elsewhere[:, 1] == pytest.approx(np.ones(20), abs=0.05)
    assert (echoes.elsewhere_known == 1).all()


def test_forerun_echo_in_air_stands_out_of_the_recording():
    level = contact(np.array([1.0, 1.0, 1.0, 5.0, 0.0]))
    assert level[3] == pytest.approx(np.log10(5) * 2)
    assert level[:3] == pytest.approx(np.zeros(3))
    assert level[4] == 0


def test_layer_that_also_shows_where_bone_lies_behind_it_is_covered_and_bone_is_not():
    depth = np.array([[2.0, 6.0]] * 10 + [[2.0, np.nan]] * 4)
    chance = np.where(np.isnan(depth), 0.0, [0.05, 0.9])
    runs = np.zeros(14, dtype=int)
    covered = Echoes.of(depth, runs).covered(DepthMap.of(chance, depth))
    assert covered[-4:, 0] == pytest.approx(np.full(4, 0.9 * 10 / 13 / 1.05), rel=0.05)
    assert np.nanmax(covered[:10, 1]) == 0
    alone = Echoes.of(depth, np.arange(14)).covered(DepthMap.of(chance, depth))
    assert alone.max() < 1e-4, "other places say nothing about this one's layers"
