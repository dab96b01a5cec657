"""The gradient method: closer to the true edge than any one threshold, and honest about the rest."""

from __future__ import annotations

import numpy as np
import pytest
from ModuleRegistrationLib.plugins.gradient import GradientSegmentation
from ModuleRegistrationLib.plugins.threshold import ThresholdSegmentation

RADIUS_MM = 40.0
SHELLS = {
    "thin table": {"layers": ((1.5, 1400.0), (3.0, 600.0), (1.5, 1400.0))},
    "solid": {"layers": ((5.0, 1200.0),)},
    "coarse pixels": {"spacing_mm": (1.5, 0.957, 0.957), "fwhm_mm": 1.0},
}


@pytest.mark.parametrize("kind", SHELLS)
def test_the_same_mesh_is_nearer_the_true_edge_than_the_thresholds(a_shell, kind):
    shell = a_shell(RADIUS_MM, **SHELLS[kind])
    plain, edge = (method().segment(shell) for method in (ThresholdSegmentation, GradientSegmentation))
    assert np.array_equal(plain.closed.triangles, edge.closed.triangles)
    assert np.abs(plain.closed.vertices_mm - edge.closed.vertices_mm).max() <= 1.5
    errors = [np.linalg.norm(found.outer_table.vertices_mm, axis=1) - RADIUS_MM for found in (plain, edge)]
    for name, error in zip(("threshold", "gradient"), errors, strict=True):
        top = np.abs(error[np.abs(plain.outer_table.vertices_mm[:, 2]) > 0.85 * RADIUS_MM])
        print(f"{kind}, {name}: offset {error.mean():.3f}, SD {error.std():.3f}, at the top {top.mean():.3f} mm")
    assert abs(errors[1].mean()) < 0.5 * abs(errors[0].mean())
    assert errors[1].std() < 0.95 * errors[0].std()
    assert abs(errors[1].mean()) < 1.2 * edge.offset_sd_mm
    assert errors[1].std() < 1.2 * edge.position_sd_mm
