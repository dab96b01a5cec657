import numpy as np
import pytest
from CranioNavLib.rigid import rigid_from_vector
from CranioNavLib.sequence_metafile import Acquisition
from ModuleUltrasoundLib.measurement.depth import bending_sd_deg, bone_positions, covariances, refracted_angle_deg


def test_refraction_follows_snell():
    assert refracted_angle_deg(30, 1500, 3000 / np.sqrt(3)) == pytest.approx(np.degrees(np.arcsin(0.5 * 2 / np.sqrt(3))))
    assert np.isnan(refracted_angle_deg(60, 1500, 3000))


def test_beam_is_not_bent_where_both_sides_have_one_speed():
    assert bending_sd_deg(Acquisition(60e6, 5e6, 20.0, 1540.0), 1540.0) == pytest.approx(0, abs=1e-9)
    assert bending_sd_deg(Acquisition(60e6, 5e6), 1540.0) == 0
    assert bending_sd_deg(Acquisition(60e6, 5e6, 20.0, 2670.0), 1540.0) > 1


def test_bone_lies_one_forerun_and_the_tissue_ahead_of_the_transducer():
    pose = rigid_from_vector([[0.3, -0.2, 1.0]], [[10.0, 20.0, 30.0]])
    position, beam = bone_positions(pose, np.array([6.0]), 25.0)
    assert position[0] == pytest.approx((pose[0] @ [0, 0, 31.0, 1])[:3])
    assert beam[0] == pytest.approx(pose[0, :3, 2])


def test_covariance_is_thin_along_the_beam_and_wide_across():
    beams = np.array([[0, 0.6, 0.8], [1.0, 0, 0]])
    acquisition = Acquisition(60e6, 5e6, 20.0, 2670.0)
    sd = np.array([2e-8, 5e-8])
    cov = covariances(beams, np.array([3.0, 12.0]), sd, acquisition, 1540.0, 1.2, 2.0, np.array([True, True]))
    for one, beam, time_sd in zip(cov, beams, sd):
        values, vectors = np.linalg.eigh(one)
        assert abs(vectors[:, 0] @ beam) == pytest.approx(1)
        assert values[0] == pytest.approx((500 * 1540 * time_sd) ** 2 + (0.3 * np.tan(np.radians(2))) ** 2)
        assert values[1] == pytest.approx(values[2])
        assert values[1] >= (1.2 / 2.3548) ** 2
    assert cov[1].trace() > cov[0].trace()  # the bent beam misses farther in thick tissue
