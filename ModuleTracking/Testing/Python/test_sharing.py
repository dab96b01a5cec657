"""Sharing: seldom changing transforms are said when they change and now and then, and no longer when they are gone."""

from __future__ import annotations

from contextlib import closing

import numpy as np
import pytest
from CranioNavLib.errors import InputError
from CranioNavLib.rigid import rigid
from ModuleTrackingLib.sharing import Sharing


def test_a_transform_is_said_at_once_when_it_changes_and_every_second_otherwise(monkeypatch):
    now, said = [0.0], []
    with closing(Sharing(0, clock=lambda: now[0])) as sharing:
        monkeypatch.setattr(sharing.publisher, "publish_transform", lambda name, matrix: said.append((now[0], matrix[0, 3])))
        for now[0], x in ((0.0, 1), (0.5, 1), (0.9, 2), (1.5, 2), (1.95, 2)):
            sharing.add_transform("ReferenceToRas", rigid(np.eye(3), (x, 0, 0)))
        sharing.add_transform("ReferenceToRas", None)
        sharing.add_transform("ReferenceToRas", rigid(np.eye(3), (2, 0, 0)))  # there again
    assert said == [(0.0, 1), (0.9, 2), (1.95, 2), (1.95, 2)]


def test_a_port_that_is_taken_is_refused():
    with closing(Sharing(0)) as sharing, pytest.raises(InputError, match="choose another port"):
        Sharing(sharing.server.port)
