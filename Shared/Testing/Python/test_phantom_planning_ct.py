"""The planning CT: the protocol's grid, exact interpolation, and spheres with the right amount of metal."""

from __future__ import annotations

import numpy as np
import pytest
from CranioNavLib.phantom import constants, make_patient
from CranioNavLib.phantom.planning_ct import _add_sphere, scan
from CranioNavLib.rigid import rigid_from_vector
from CranioNavLib.volume import Volume

NO_MARKERS = np.empty((0, 3))


class Silence:
    """A generator without noise."""

    def standard_normal(self, shape, dtype):
        return np.zeros(shape, dtype=dtype)


@pytest.fixture
def a_ramp():
    """A volume whose HU is linear in RAS, in an oblique place."""
    place = rigid_from_vector((0.2, -0.3, 0.5), (10.0, -20.0, 30.0)) @ np.diag([0.9, 1.0, 1.4, 1.0])
    k, j, i = np.mgrid[0:40, 0:60, 0:50]
    ras = np.stack([i, j, k], axis=-1) @ place[:3, :3].T + place[:3, 3]
    return Volume(np.rint(ras @ [8.0, -6.0, 7.0]).astype(np.int16), place), np.array([8.0, -6.0, 7.0])


def test_a_linear_volume_is_interpolated_exactly_on_an_oblique_grid(a_ramp):
    volume, slope = a_ramp
    mask = np.zeros(volume.hu.shape, dtype=bool)
    mask[15:25, 20:40, 18:32] = True
    ct = scan(volume, mask, NO_MARKERS, Silence())
    assert np.allclose(np.linalg.norm(ct.ijk_to_ras[:3, :3], axis=0), (0.42, 0.42, 2.0))
    k, j, i = np.mgrid[1 : ct.hu.shape[0] - 1, 0 : ct.hu.shape[1], 0 : ct.hu.shape[2]]
    ras = np.stack([i, j, k], axis=-1) @ ct.ijk_to_ras[:3, :3].T + ct.ijk_to_ras[:3, 3]
    assert np.abs(ct.hu[1:-1] - ras @ slope).max() < 1.1  # twice rounded to whole HU


def test_the_head_stays_inside_the_crop():
    patient = make_patient(None, 0)
    ct = patient.planning_ct
    corner = np.array(ct.hu.shape[::-1]) - 1
    ends = np.array([[0, 0, 0], corner]) @ ct.ijk_to_ras[:3, :3].T + ct.ijk_to_ras[:3, 3]
    low, high = ends.min(axis=0), ends.max(axis=0)
    assert (patient.skin.vertices_mm.min(axis=0) > low - 1e-6).all()
    assert (patient.skin.vertices_mm.max(axis=0) < high + 1e-6).all()
    assert ct.hu.max() == constants.CT_CLIP_HIGH_HU


@pytest.mark.parametrize("seed", range(4))
def test_a_sphere_holds_its_volume_of_metal_around_its_centre(seed):
    rng = np.random.default_rng(seed)
    place = rigid_from_vector(rng.normal(size=3), rng.normal(size=3)) @ np.diag([0.42, 0.42, 2.0, 1.0])
    hu = np.zeros((20, 60, 60), dtype=np.float32)
    center = np.array([30, 30, 10]) + rng.uniform(-0.5, 0.5, 3)
    center_ras = place[:3, :3] @ center + place[:3, 3]
    _add_sphere(hu, place, center_ras)
    share = hu / constants.TITANIUM_HU
    drawn = share.sum() * 0.42 * 0.42 * 2.0
    # a ball blurred on its outside by s holds 4/3 pi (r^3 + 3 r s^2)
    expected = 4 / 3 * np.pi * (2.0**3 + 3 * 2.0 * constants.MARKER_BLUR_MM**2)
    assert drawn == pytest.approx(expected, rel=0.02)
    index = np.argwhere(share > 0)
    middle = (index * share[share > 0][:, None]).sum(axis=0) / share.sum()
    assert np.abs((middle[::-1] - center) * (0.42, 0.42, 2.0)).max() < 0.03
