"""`cranionav plausibility`: surface distance of points touched on the bone."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Optional

import typer


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
    from ModuleRegistrationLib.verification import plausibility as check

    from Workstation.outputs import write_table
    from Workstation.terminal import number, print_json, print_table

    if (surface is None) == (ct is None):
        raise InputError("plausibility needs the bone: give either --surface or --ct")
    if surface is not None:
        bone = Surface.read(surface)
    else:
        from ModuleRegistrationLib.anatomy.ct_reader import read_ct
        from ModuleRegistrationLib.anatomy.segmentation import segment_bone

        assert ct is not None
        bone = segment_bone(read_ct(ct)).closed
    touched = read_points(points)
    found = check.plausibility(read_transform(transform), touched.positions_mm, bone)
    distances = found.distances_mm.tolist()
    record = {
        "transform": str(transform), "labels": list(touched.labels), "distances_mm": distances,
        "mean_mm": found.mean_mm, "max_mm": found.max_mm, "plausible": found.plausible,
    }  # fmt: skip
    if output:
        write_table(output, "plausibility", record, ["point", "distance_mm"], list(zip(touched.labels, distances)))
    if json:
        print_json(record)
        return
    print_table(
        "Distance to the bone surface (mm), not an accuracy",
        ["point", "distance"],
        [[a, number(b)] for a, b in zip(touched.labels, distances)],
    )
    verdict = (
        "plausible" if found.plausible else f"not plausible: a point lies more than {check.SUSPICIOUS_MM:g} mm from the bone"
    )
    print(f"mean {found.mean_mm:.2f}, max {found.max_mm:.2f} mm: {verdict}")
