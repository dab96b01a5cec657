"""`cranionav plausibility`: surface distance of points touched on the bone."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Optional

import typer

if TYPE_CHECKING:
    from ModuleRegistrationLib.verification.held_out import DistanceCheck
    from ModuleRegistrationLib.verification.plausibility import Plausibility


def plausibility(
    transform: Annotated[Path, typer.Option(metavar="T", help="ReferenceToRas (.tfm or .h5)")],
    points: Annotated[Path, typer.Option(metavar="P", help="points touched on the bone, Reference frame")],
    surface: Annotated[Optional[Path], typer.Option(metavar="S", help="bone surface (.vtp, .ply, .stl, .vtk)")] = None,
    ct: Annotated[Optional[Path], typer.Option(metavar="CT", help="or the CT to segment it from")] = None,
    output: Annotated[
        Optional[Path], typer.Option("-o", "--output", metavar="DIR", help="also write plausibility.json and plausibility.csv")
    ] = None,
    json: Annotated[bool, typer.Option("--json", help="print the result as JSON")] = False,
) -> None:
    """Distance of each point to the bone. It can show that a registration is wrong, never that it is right."""
    from CranioNavLib.errors import InputError
    from CranioNavLib.slicer_files import read_points, read_transform
    from CranioNavLib.surface import Surface
    from ModuleRegistrationLib.procedure import STYLUS_POINT_SD_MM
    from ModuleRegistrationLib.verification import plausibility as check
    from ModuleRegistrationLib.verification.checks import expected_of
    from ModuleRegistrationLib.verification.given_surface import check_surface

    from Workstation.outputs import write_table
    from Workstation.results import check_record, read_stated_error
    from Workstation.terminal import print_json

    if (surface is None) == (ct is None):
        raise InputError("plausibility needs the bone: give either --surface or --ct")
    touched, matrix = read_points(points), read_transform(transform)
    if surface is not None:
        bone = check_surface(Surface.read(surface), str(surface), matrix, touched.positions_mm)
    else:
        from ModuleRegistrationLib.anatomy.ct_reader import read_ct
        from ModuleRegistrationLib.anatomy.segmentation import segment_bone

        assert ct is not None
        bone = segment_bone(read_ct(ct)).closed
    found = check.plausibility(matrix, touched.positions_mm, bone)
    expected = expected_of(found, touched.labels, read_stated_error(transform, matrix), STYLUS_POINT_SD_MM)
    distances = found.distances_mm.tolist()
    record = {
        "transform": str(transform), "labels": list(touched.labels), "distances_mm": distances,
        "mean_mm": found.mean_mm, "max_mm": found.max_mm, "plausible": found.plausible, "expected": check_record(expected),
    }  # fmt: skip
    if output:
        sds = [""] * len(distances) if expected is None else expected.expected_sd_mm.tolist()
        rows = list(zip(touched.labels, distances, sds))
        write_table(output, "plausibility", record, ["point", "distance_mm", "expected_sd_mm"], rows)
    if json:
        print_json(record)
    else:
        _say(found, touched.labels, expected)


def _say(found: Plausibility, labels: tuple[str, ...], expected: Optional[DistanceCheck]) -> None:
    from ModuleRegistrationLib.verification.plausibility import SUSPICIOUS_MM

    from Workstation.terminal import number, print_table

    sds = [None] * len(labels) if expected is None else expected.expected_sd_mm.tolist()
    print_table(
        "Distance to the bone surface (mm), not an accuracy",
        ["point", "distance", "expected SD"],
        [[label, number(distance), number(sd)] for label, distance, sd in zip(labels, found.distances_mm.tolist(), sds)],
    )
    verdict = "plausible" if found.plausible else f"not plausible: a point lies more than {SUSPICIOUS_MM:g} mm from the bone"
    print(f"mean {found.mean_mm:.2f}, max {found.max_mm:.2f} mm: {verdict}")
    if expected is None:
        print("no stated error is known: no registration.json of this transform lies beside it with one")
    else:
        print(f"{expected.words('the points')}; {expected.expectation}")
