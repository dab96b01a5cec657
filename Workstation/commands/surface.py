"""`cranionav surface`: the bone surface of a CT."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Optional

import typer


def surface(
    ct: Annotated[Path, typer.Argument(metavar="CT", help="DICOM folder, .nrrd, .nii(.gz) or .mha")],
    output: Annotated[Path, typer.Option("-o", "--output", help="the surface to write (.vtp, RAS, mm)")],
    threshold: Annotated[
        Optional[float], typer.Option(metavar="HU", help="bone from here up; default: found from the CT")
    ] = None,
    method: Annotated[str, typer.Option(help="segmentation plugin")] = "threshold",
    series: Annotated[Optional[str], typer.Option(help="which series of a DICOM folder")] = None,
    outer: Annotated[bool, typer.Option("--outer-table", help="only what a probe on the skin can reach")] = False,
    json: Annotated[bool, typer.Option("--json", help="print the result as JSON")] = False,
) -> None:
    """Segment the skull and write it as a closed surface with outward normals; holder and table are left out."""
    from CranioNavLib.errors import InputError
    from ModuleRegistrationLib.anatomy.ct_reader import read_ct
    from ModuleRegistrationLib.anatomy.segmentation import segment_bone

    from Workstation.terminal import print_json, progress_bar

    if output.suffix.lower() != ".vtp":
        raise InputError(f"cannot write {output}: bone surfaces are written as .vtp; name the output something.vtp")
    with progress_bar() as say:
        say("reading the CT", 0.0)
        volume = read_ct(ct, series=series)
        say("segmenting bone", 0.3)
        settings = {} if threshold is None else {"threshold_hu": threshold}
        bone = segment_bone(volume, method=method, **settings)
        mesh = bone.outer_table if outer else bone.closed
        say("writing", 0.95)
        mesh.write(output)
    if json:
        print_json(
            {
                "surface": str(output),
                "vertices": len(mesh.vertices_mm),
                "triangles": len(mesh.triangles),
                "threshold_hu": bone.threshold_hu,
            }
        )
    else:
        print(f"{output}: {len(mesh.triangles)} triangles, bone from {bone.threshold_hu:.0f} HU")
