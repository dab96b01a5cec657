"""Slices get fewer pixels while a tool moves and time is short, and all of them again afterwards."""

from __future__ import annotations

from types import SimpleNamespace

import pytest
from CranioNavLib import host

from Workstation.web.sharpness import FIRST_TRIAL_S, SETTLING_S, STEPS, Sharpness, resize_slice


class Machine:
    """Rounds are late as long as there are more pixels than it can draw."""

    def __init__(self, affords: float) -> None:
        self.affords, self.share, self.shares = affords, 1.0, []
        self.sharpness = Sharpness(self._apply)
        self.now_s = 100.0

    def _apply(self, share: float) -> None:
        self.share = share
        self.shares.append(share)

    def runs(self, seconds: float, moving: bool = True) -> None:
        end_s = self.now_s + seconds
        while self.now_s < end_s:
            self.now_s += 0.16
            self.sharpness.look(self.now_s, 0.0 if self.share <= self.affords else 0.02, moving)


@pytest.mark.parametrize("affords", STEPS)
def test_slices_get_as_many_pixels_as_can_be_drawn_in_time(affords):
    machine = Machine(affords)
    machine.runs(len(STEPS) * (SETTLING_S + 0.2))
    assert machine.share == affords


def test_what_stands_still_is_drawn_in_full_and_what_moves_again_as_before():
    machine = Machine(0.6)
    machine.runs(10)
    machine.runs(1, moving=False)
    assert machine.share == 1.0
    machine.runs(1)
    assert machine.share == 0.6


def test_more_pixels_are_tried_again_ever_more_rarely():
    machine = Machine(0.85)
    machine.runs(600)
    assert 3 <= machine.shares.count(1.0) <= 6
    machine.affords = 1.0
    machine.runs(200)
    assert machine.share == 1.0
    assert FIRST_TRIAL_S > SETTLING_S


@pytest.mark.parametrize(("size", "share"), [((800, 600), 0.5), ((200, 200), 1.0)])
def test_a_slice_with_other_pixels_shows_the_same_and_keeps_enough_of_them(size, share):
    node = host.scene().AddNewNodeByClass("vtkMRMLSliceNode", "Red")
    node.SetFieldOfView(120.0, 90.0, 1.0)

    class Adapter:
        scale = 1.0

        def __setattr__(self, name, value):
            assert name == "scale"
            super().__setattr__(name, value)
            node.SetFieldOfView(120.0 * value, 90.0 * value, 1.0)  # as Slicer does it: the same millimetres a pixel

    adapter = Adapter()
    view = SimpleNamespace(
        get_view_node=lambda: node,
        render_window=lambda: SimpleNamespace(GetSize=lambda: [int(side * adapter.scale) for side in size]),
    )
    for asked, got in ((0.5, share), (0.5, share), (1.0, 1.0)):
        resize_slice(view, adapter, asked)
        assert adapter.scale == pytest.approx(got)
        assert node.GetFieldOfView()[:2] == pytest.approx((120.0, 90.0))
    host.scene().RemoveNode(node)
