"""`cranionav markers`: the titanium spheres of a CT."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Optional

import typer


def markers(
    ct: Annotated[Path, typer.Argument(metavar="CT", help="DICOM folder, .nrrd, .nii(.gz) or .mha")],
    output: Annotated[Path, typer.Option("-o", "--output", help="the marker list to write (.mrk.json)")],
    diameter: Annotated[float, typer.Option(metavar="MM", help="diameter of the spheres")] = 4.0,
    series: Annotated[Optional[str], typer.Option(help="which series of a DICOM folder")] = None,
    json: Annotated[bool, typer.Option("--json", help="print the result as JSON")] = False,
) -> int:
    """Find titanium spheres and write their centres, one point each. Exit status 2 when there are none."""
    from CranioNavLib.errors import InputError
    from CranioNavLib.slicer_files import LabelledPoints, write_points
    from ModuleRegistrationLib.anatomy.ct_reader import read_ct
    from ModuleRegistrationLib.anatomy.spheres import find_spheres

    from Workstation.terminal import print_json, progress_bar

    if not output.name.endswith(".mrk.json"):
        raise InputError(f"cannot write {output}: marker lists are written as Markups; name the output something.mrk.json")
    with progress_bar() as say:
        say("reading the CT", 0.0)
        volume = read_ct(ct, series=series)
        say("looking for spheres", 0.4)
        centers = find_spheres(volume, diameter_mm=diameter).centers_ras_mm
    if not len(centers):
        raise InputError(
            f"no titanium spheres of {diameter:g} mm found in {ct}; check --diameter, or that the CT shows the markers"
        )
    labels = tuple(f"M{number + 1}" for number in range(len(centers)))
    write_points(output, LabelledPoints(labels, centers), name="Markers")
    if json:
        print_json({"markers": str(output), "count": len(centers), "centers_ras_mm": centers.tolist()})
    else:
        print(f"{output}: {len(centers)} spheres")
    return 0
