"""The watch over the reference base: what it keeps, what it notices by itself, and what it leaves to the user."""

from __future__ import annotations

import numpy as np
import pytest
from CranioNavLib.errors import InputError
from ModuleTrackingLib.base_watch import NEAR_MM, BaseWatch

DIVOT = np.array([60.0, -20.0, 15.0])


def tips(place, sd_mm=0.1, count=40, seed=0):
    return list(np.asarray(place) + np.random.default_rng(seed).normal(0, sd_mm, (count, 3)))


def test_a_stylus_that_rests_in_the_divot_is_noticed_and_one_elsewhere_is_not():
    watch = BaseWatch()
    assert watch.notice(tips(DIVOT)) is None  # nothing to compare with
    watch.store(tips(DIVOT), "base 7")
    assert watch.notice(tips(DIVOT + [0, 0, NEAR_MM + 1])) is None
    assert watch.notice(tips(DIVOT, sd_mm=1.0)) is None  # not at rest
    assert watch.notice(tips(DIVOT)[:5]) is None  # not long enough
    assert watch.result is None
    assert not watch.notice(tips(DIVOT + [0.3, 0, 0], seed=1)).loose
    assert not watch.loose
    assert watch.notice(tips(DIVOT + [0, 2.5, 0], seed=2)).loose
    assert watch.loose
    assert "moved by 2.5 mm" in watch.words()


def test_asked_for_it_is_compared_however_far_it_is():
    watch = BaseWatch()
    with pytest.raises(InputError, match="no check point is stored"):
        watch.check(tips(DIVOT))
    watch.store(tips(DIVOT), "base 7")
    assert watch.check(tips(DIVOT + [40, 0, 0])).distance_mm == pytest.approx(40, abs=0.2)
    watch.store(tips(DIVOT + [40, 0, 0]), "base 7")
    assert not watch.loose  # tightened, and stored anew


def test_a_saved_point_is_taken_up_for_its_own_base_only(tmp_path):
    BaseWatch(str(tmp_path)).store(tips(DIVOT), "base 7")
    again, other = BaseWatch(str(tmp_path)), BaseWatch(str(tmp_path))
    again.load("base 7")
    assert again.point is not None
    assert "not checked since" in again.words()
    other.load("base 8")
    assert other.point is None
    assert "base 7" in other.words()
    again.folder = ""
    again.load("base 8")  # the tracker was changed meanwhile
    assert again.point is None
    assert "another reference tool" in again.words()
