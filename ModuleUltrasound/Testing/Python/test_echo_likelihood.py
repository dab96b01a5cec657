import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from ModuleUltrasoundLib.echo_likelihood import (
    Network,
    contact,
    neighbour_support,
    probabilities,
    relative_polarity,
)
from scipy.special import softmax


@settings(max_examples=50, deadline=None)
@given(arrays(float, (4, 5), elements=st.floats(-800, 800)))
def test_probabilities_are_a_softmax_with_none_as_a_choice(scores):
    valid = np.ones(scores.shape, dtype=bool)
    valid[0, 3] = False
    chance, none = probabilities(scores, valid)
    expected = softmax(np.column_stack([np.where(valid, scores, -np.inf), np.zeros(4)]), axis=1)
    assert chance == pytest.approx(expected[:, :-1], abs=1e-12)
    assert none == pytest.approx(expected[:, -1], abs=1e-12)


def test_line_without_candidates_has_no_bone():
    chance, none = probabilities(np.full((1, 3), 5.0), np.zeros((1, 3), dtype=bool))
    assert chance.sum() == 0
    assert none[0] == 1


def test_network_is_a_plain_perceptron():
    rng = np.random.default_rng(0)
    layers = tuple((rng.normal(size=(a, b)), rng.normal(size=b)) for a, b in ((3, 4), (4, 1)))
    x = rng.normal(size=(2, 5, 3))
    expected = np.maximum(x @ layers[0][0] + layers[0][1], 0) @ layers[1][0][:, 0] + layers[1][1][0]
    table = tuple((tuple(map(tuple, w)), tuple(b)) for w, b in layers)
    assert Network.from_table(table).scores(x) == pytest.approx(expected, abs=1e-5)


def test_polarity_is_that_of_the_likely_bones_and_silent_when_they_disagree():
    phases = np.tile([0.4, 0.4 + np.pi], (30, 1))
    chance = np.tile([0.9, 0.1], (30, 1))
    cosine, known = relative_polarity(phases, chance)
    assert cosine[:, 0] == pytest.approx(np.full(30, known))
    assert cosine[:, 1] == pytest.approx(np.full(30, -known))
    assert known > 0.9
    random = np.random.default_rng(1).uniform(0, 2 * np.pi, (30, 2))
    assert relative_polarity(random, chance)[1] < 0.1


def test_neighbours_of_the_same_stay_support_one_depth():
    depth = np.column_stack([np.full(9, 6.0), np.linspace(10, 18, 9)])
    chance = np.full((9, 2), 0.5)
    support, has = neighbour_support(chance, depth, np.zeros(9, dtype=int))
    assert support[4, 0] == pytest.approx(0.5, rel=0.1)
    assert support[4, 1] < 0.05
    assert has.all()
    alone, none = neighbour_support(chance, depth, np.arange(9))
    assert alone.max() == 0
    assert not none.any()


def test_forerun_echo_in_air_stands_out_of_the_recording():
    level = contact(np.array([1.0, 1.0, 1.0, 5.0, 0.0]))
    assert level[3] == pytest.approx(np.log10(5) * 2)
    assert level[:3] == pytest.approx(np.zeros(3))
    assert level[4] == 0
