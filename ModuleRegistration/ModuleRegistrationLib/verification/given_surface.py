"""A bone surface that comes from elsewhere: its unit, its axes and its sides are seen before it is measured against."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from CranioNavLib.errors import InputError
from CranioNavLib.rigid import check_rigid, transform_points
from CranioNavLib.surface import LPS_RAS, Surface

SMALLEST_MM, LARGEST_MM = 60.0, 600.0  # longest side of what may be the bone of a head, or of a part of it
UNITS = {"metres": 1000.0, "centimetres": 10.0}  # mm in each; micrometres are refused as points too far away
WRONG_AXES_MM = 20.0  # mean distance beyond which other axes are tried; a poor registration is better than this
RIGHT_AXES_MM = 5.0  # mean distance that then shows which axes are meant


def check_surface(surface: Surface, name: str, reference_to_ras: npt.ArrayLike, points_mm: npt.ArrayLike) -> Surface:
    """The surface with its normals outwards, if it can be the bone that the points (P, 3), Reference frame, were touched on.

    Raises
    ------
    InputError
        Its size is not that of a head, or the points lie on it only when it is turned from LPS to RAS.
    """
    size = float(np.ptp(surface.vertices_mm, axis=0).max())
    if not SMALLEST_MM <= size <= LARGEST_MM:
        fits = [f"; is it in {unit}?" for unit, mm in UNITS.items() if SMALLEST_MM <= size * mm <= LARGEST_MM]
        raise InputError(f"{name} is {size:.3g} mm large, which no head is{fits[0] if fits else ''}; give the bone in mm")
    points = transform_points(check_rigid(reference_to_ras, "ReferenceToRas"), points_mm)
    turned = float(surface.closest(points * LPS_RAS).distances_mm.mean())  # the same as to turn the surface
    found = float(surface.closest(points).distances_mm.mean())
    if found > WRONG_AXES_MM and turned < RIGHT_AXES_MM:
        raise InputError(
            f"{name} seems to be in LPS: the points lie {found:.0f} mm from it on average, and {turned:.1f} mm when it is "
            "turned to RAS; export it in RAS, or by 3D Slicer, whose files say their axes"
        )
    return outwards(surface)


def outwards(surface: Surface) -> Surface:
    """The surface itself, or turned inside out when its normals look inwards on the whole."""
    corners = surface.vertices_mm[surface.triangles] - surface.center_mm
    volume = float(np.einsum("ij,ij->i", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])).sum())
    return surface if volume >= 0 else Surface(surface.vertices_mm, surface.triangles[:, ::-1])
