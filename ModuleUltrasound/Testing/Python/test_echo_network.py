from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from ModuleUltrasoundLib.echo.network import (
    BLOCKS,
    DOUBTFUL,
    ROWS,
    Calibration,
    Committee,
    Likelihood,
    Network,
    learnt,
    probabilities,
    read_likelihood,
    write_likelihood,
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


@pytest.fixture
def a_network():
    rng = np.random.default_rng(0)
    sizes = ((3, 4), (4, 1))
    return Network(
        tuple((rng.normal(size=size).astype(np.float32), rng.normal(size=size[1]).astype(np.float32)) for size in sizes)
    )


def test_network_is_a_plain_perceptron(a_network):
    (w, b), (v, c) = a_network.layers
    x = np.random.default_rng(1).normal(size=(2, 5, 3))
    assert Committee((a_network,)).scores(x) == pytest.approx(np.maximum(x @ w + b, 0) @ v[:, 0] + c[0], abs=1e-5)


def test_committee_scores_by_the_mean_of_its_members(a_network):
    b_network = Network(tuple((-2 * weights, biases + 1) for weights, biases in a_network.layers))
    x = np.random.default_rng(1).normal(size=(2, 5, 3))
    mean = (Committee((a_network,)).scores(x) + Committee((b_network,)).scores(x)) / 2
    assert Committee((a_network, b_network)).scores(x) == pytest.approx(mean, abs=1e-6)


@given(st.integers(0, 7), st.integers(0, 2 * BLOCKS * ROWS // 7))
def test_scores_are_those_of_each_candidate_alone_however_many_there_are(a, b):
    layers = (
        (np.eye(3, dtype=np.float32), np.zeros(3, dtype=np.float32)),
        (np.ones((3, 1), dtype=np.float32), np.zeros(1, dtype=np.float32)),
    )
    features = np.random.default_rng(a).random((a, b, 3))
    assert Committee((Network(layers),)).scores(features) == pytest.approx(features.sum(axis=-1), abs=1e-5)


def test_likelihood_comes_back_from_its_file_to_four_digits(a_network, tmp_path):
    b_network = Network(tuple((weights + 1, biases) for weights, biases in a_network.layers))
    quality = Calibration(np.array([0.0, 0.31, 1.0]), np.array([0.0, 0.25, 0.999]), 0.47)
    write_likelihood(
        tmp_path / "w.json", Likelihood((Committee((a_network,)), Committee((b_network, a_network))), quality), 'a "note"'
    )
    back = read_likelihood(tmp_path / "w.json")
    assert back.quality.stated == pytest.approx(quality.stated)
    assert back.quality.right == pytest.approx(quality.right)
    assert back.quality.doubtful == quality.doubtful
    assert [len(turn.members) for turn in back.turns] == [1, 2]
    for read, written in zip(back.turns[1].members, (b_network, a_network)):
        for (weights, biases), (w, b) in zip(read.layers, written.layers):
            assert weights.shape == w.shape
            assert weights == pytest.approx(w, rel=5e-4)
            assert biases == pytest.approx(b, rel=5e-4)


@given(st.floats(0, 1))
def test_doubtful_lines_are_told_by_one_number_and_the_others_by_the_map(stated):
    fine = Calibration(np.array([0.0, 0.3, 1.0]), np.array([0.0, 0.2, 1.0]))
    levelled = replace(fine, doubtful=0.47).probability(np.array([stated]))[0]
    mapped = fine.probability(np.array([stated]))[0]
    assert mapped == np.interp(stated, [0, 0.3, 1], [0, 0.2, 1])
    assert levelled == (0.47 if DOUBTFUL[0] < mapped < DOUBTFUL[1] else mapped)


def test_networks_that_were_learnt_take_the_features_that_are_made():
    from ModuleUltrasoundLib.echo.features import NAMES
    from ModuleUltrasoundLib.echo.likelihood import SHARED_NAMES

    own, shared = len(NAMES), len(NAMES) + len(SHARED_NAMES)
    for number, turn in enumerate(learnt().turns):
        assert {member.layers[0][0].shape[0] for member in turn.members} == {shared if number else own}
