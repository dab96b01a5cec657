import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from ModuleUltrasoundLib.echo.lean import ONE_THREAD, clip, median, pick, product, without_nan

NUMBERS = arrays(float, st.integers(1, 9), elements=st.floats(-1e6, 1e6))


@settings(max_examples=50, deadline=None)
@given(NUMBERS)
def test_lean_calls_give_what_numpy_gives(values):
    assert median(values) == pytest.approx(np.median(values))
    assert clip(values, -2.0, 3.0).tolist() == np.clip(values, -2, 3).tolist()
    values[0] = np.nan
    assert without_nan(values, 5.0).tolist() == np.nan_to_num(values, nan=5.0).tolist()
    assert np.isnan(clip(values, 0.0, 1.0)[0])


def test_columns_are_picked_from_each_row():
    rng = np.random.default_rng(0)
    values, index = rng.normal(size=(5, 7)), rng.integers(0, 7, (5, 3))
    assert pick(values, index).tolist() == np.take_along_axis(values, index, axis=1).tolist()


def test_product_by_pieces_is_the_product():
    rng = np.random.default_rng(1)
    left, right = rng.normal(size=(700, 30)).astype(np.float32), rng.normal(size=(30, 50)).astype(np.float32)
    assert left.size * right.shape[1] > 5 * ONE_THREAD
    assert product(left, right) == pytest.approx(left @ right, abs=1e-4)
    assert product(left[:0], right).shape == (0, 50)
