"""Voxel indices, RAS and grid millimetres agree."""

from __future__ import annotations

import numpy as np
import pytest
from CranioNavLib.volume import Volume
from hypothesis import given
from hypothesis import strategies as st
from ModuleRegistrationLib.anatomy.grid import Grid, nearest_voxels, pooled, sample_linear, subsampled
from scipy.ndimage import map_coordinates
from scipy.spatial.transform import Rotation


def a_grid(seed: int) -> Grid:
    random = np.random.default_rng(seed)
    matrix = np.eye(4)
    matrix[:3, :3] = Rotation.random(random_state=seed).as_matrix() * random.uniform(0.3, 3, 3) * random.choice([-1, 1], 3)
    matrix[:3, 3] = random.uniform(-100, 100, 3)
    return Grid((11, 13, 17), matrix)


@given(st.integers(0, 10_000))
def test_an_index_comes_back_from_ras(seed):
    grid = a_grid(seed)
    index = np.random.default_rng(seed).uniform(0, 10, (5, 3))
    assert grid.to_index(grid.to_ras(index)) == pytest.approx(index, abs=1e-9)
    assert grid.grid_mm_to_ras((index * grid.spacing_mm)[:, ::-1]) == pytest.approx(grid.to_ras(index), abs=1e-9)


@given(st.integers(0, 10_000), st.tuples(*[st.integers(1, 4)] * 3))
def test_a_subsampled_voxel_keeps_its_place(seed, strides):
    grid = a_grid(seed)
    numbers = np.arange(11 * 13 * 17, dtype=np.int16).reshape(grid.shape)
    coarse = grid.coarser(strides)
    some = subsampled(numbers, strides)
    assert some.shape == coarse.shape
    place = np.array([[s - 1 for s in some.shape]])
    index = np.rint(grid.to_index(coarse.to_ras(place))).astype(int)[0]
    assert numbers[tuple(index)] == some[-1, -1, -1]


def test_linear_sampling_agrees_with_scipy():
    array = np.random.default_rng(0).normal(size=(6, 7, 8))
    index = np.random.default_rng(1).uniform(-1, 8, (200, 3))
    assert sample_linear(array, index) == pytest.approx(map_coordinates(array, index.T, order=1, mode="nearest"), abs=1e-9)


@given(st.tuples(*[st.integers(1, 4)] * 3))
def test_blocks_hold_any_of_their_voxels(strides):
    mask = np.random.default_rng(3).random((7, 9, 10)) > 0.95
    blocks = pooled(mask, strides)
    assert blocks.sum() <= mask.sum()
    for index in np.ndindex(*blocks.shape):
        block = tuple(slice(a * s, (a + 1) * s) for a, s in zip(index, strides, strict=True))
        assert blocks[index] == mask[block].any()


def test_nearest_voxels_outside_go_to_the_border():
    flat = nearest_voxels(np.array([[-5.0, 0.9, 99.0]], dtype=np.float32), np.array([2.0, 1.0, 1.0]), (3, 4, 5))
    assert np.unravel_index(flat[0], (3, 4, 5)) == (2, 1, 0)


def test_the_axis_nearest_to_a_direction_is_found():
    grid = Grid.of(
        Volume(np.zeros((2, 2, 2), dtype=np.int16), np.array([[0, 0, 2.0, 0], [1, 0, 0, 0], [0, -1, 0, 0], [0, 0, 0, 1]]))
    )
    assert grid.axis_of((0, 0, 1)) == (1, -1)
    assert grid.axis_of((1, 0, 0)) == (0, 1)
    assert grid.axis_of((0, 1, 0)) == (2, 1)
