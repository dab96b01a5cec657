"""The head's mask and skin: the patient alone, cavities filled."""

from __future__ import annotations

import numpy as np
import pytest
from CranioNavLib.errors import InputError
from CranioNavLib.volume import Volume
from ModuleRegistrationLib.anatomy.grid import Grid
from ModuleRegistrationLib.anatomy.head import find_head


def test_depth_is_the_distance_to_the_skin(a_shell):
    head = find_head(a_shell())
    directions = np.random.default_rng(0).normal(size=(400, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    radii = np.random.default_rng(1).uniform(20, 50, 400)
    assert head.depth_at(directions * radii[:, None]) == pytest.approx(46 - radii, abs=2.0)  # a cell is 2.5 mm
    assert np.array_equal(head.contains(directions * np.array([[43.0]])), np.ones(400, dtype=bool))


def test_the_way_to_the_skin_is_the_shortest(a_shell):
    volume = a_shell()
    head = find_head(volume)
    points = np.random.default_rng(0).normal(size=(300, 3))
    points *= 38 / np.linalg.norm(points, axis=1, keepdims=True)
    grid = Grid.of(volume)
    local = ((points - grid.ijk_to_ras[:3, 3]) @ grid.axes).astype(np.float32)
    towards = head.towards_skin[head.cells(local, grid)] @ grid.axes.T
    assert (np.einsum("ij,ij->i", towards, points / 38) > np.cos(np.radians(15))).all()


def test_a_holder_around_the_head_is_left_out(a_shell):
    volume = a_shell()
    hu = volume.hu.copy()
    _, j, i = np.indices(hu.shape)
    ring = np.hypot((j - hu.shape[1] / 2) * 0.42, (i - hu.shape[2] / 2) * 0.42)
    hu[(ring > 49) & (ring < 53) & (j < hu.shape[1] / 2)] = 600
    with_holder = find_head(Volume(hu, volume.ijk_to_ras))
    assert np.count_nonzero(with_holder.mask) == pytest.approx(np.count_nonzero(find_head(volume).mask), rel=0.01)


def test_an_air_filled_sinus_belongs_to_the_head(a_shell):
    volume = a_shell()
    hu = volume.hu.copy()
    hu[20:30, 60:110, 100:140] = -1000
    assert np.array_equal(find_head(Volume(hu, volume.ijk_to_ras)).mask, find_head(volume).mask)


def test_the_sample_heads_sinuses_and_airway_are_filled(a_sample_head):
    head = find_head(a_sample_head)
    litres = np.count_nonzero(head.mask) * head.grid.voxel_mm3 / 1e6
    assert 2.9 < litres < 3.5
    values = a_sample_head.hu[:, ::3, ::3]
    kji = np.argwhere(values < -800) * (1, 3, 3)
    points = Grid.of(a_sample_head).to_ras(kji)
    center = np.median(Grid.of(a_sample_head).to_ras(np.argwhere(a_sample_head.hu[:, ::5, ::5] > 800) * (1, 5, 5)), axis=0)
    in_skull = np.linalg.norm((points - center) / (45, 70, 60), axis=1) < 1  # an ellipsoid well inside the skin
    assert in_skull.sum() > 50
    assert head.contains(points[in_skull]).all()


def test_two_metres_of_tissue_are_no_head():
    hu = np.full((60, 80, 80), 40, dtype=np.int16)
    hu[:, :4] = -1000
    with pytest.raises(InputError, match="more than a head"):
        find_head(Volume(hu, np.diag([8.0, 8.0, 8.0, 1.0])))


def test_a_chest_is_no_head():
    z, y, x = np.indices((60, 90, 130)) * 3.0
    body = np.hypot((x - 195) / 160, (y - 135) / 110) < 1
    lungs = np.hypot((np.abs(x - 195) - 75) / 60, (y - 135) / 75) < 1
    hu = np.where(lungs & (z > 12) & (z < 165), -780, np.where(body, 40, -1000)).astype(np.int16)
    with pytest.raises(InputError, match=r"encloses 4\.\d l of air, as a chest does; give a CT of the head"):
        find_head(Volume(hu, np.diag([3.0, 3.0, 3.0, 1.0])))


def test_a_volume_without_air_is_refused(a_shell):
    with pytest.raises(InputError, match="shows no air"):
        find_head(Volume(a_shell().hu[20:30, 80:120, 80:120], np.eye(4)))
