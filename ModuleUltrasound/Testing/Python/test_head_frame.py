import numpy as np
import pytest
from ModuleUltrasoundLib.palpation.head_frame import _first_dip


def test_the_nasion_is_the_uppermost_dip_of_the_profile_and_no_hole():
    z = np.arange(100.0)  # mm downwards
    face = 80 - 0.004 * (z - 40) ** 2 - 5.0 * np.exp(-(((z - 60) / 5) ** 2)) - 6.0 * np.exp(-(((z - 85) / 5) ** 2))
    assert _first_dip(face) == pytest.approx(60, abs=2)
    assert _first_dip(face + 0.2 * z) == pytest.approx(60, abs=2)  # nodding by 11 degrees
    holed = np.where((z > 25) & (z < 40), face - 30.0, face)
    assert _first_dip(holed) == pytest.approx(60, abs=2)
    assert _first_dip(80 - 0.004 * (z - 40) ** 2) is None
