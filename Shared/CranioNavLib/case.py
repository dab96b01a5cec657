"""The case folder: one registration on disk, as `register` and `batch` read it and the workstation saves it."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from difflib import get_close_matches
from pathlib import Path
from typing import Optional

from CranioNavLib.errors import InputError
from CranioNavLib.files import write_text
from CranioNavLib.slicer_files import LabelledPoints, read_points

# name of a thing in case.json -> the file names it may have in the folder
FILES = {
    "ct": ("ct.nrrd", "ct.nii.gz", "ct.nii", "ct.mha", "ct"),
    "landmarks-ct": ("landmarks-ct.mrk.json", "landmarks-ct.fcsv"),
    "landmarks-patient": ("landmarks-patient.mrk.json", "landmarks-patient.fcsv"),
    "points": ("points.mrk.json", "points.fcsv"),
    "palpation": ("palpation.igs.mha", "palpation.igs.mhd", "palpation.mha"),
    "targets-ct": ("targets-ct.mrk.json", "targets-ct.fcsv"),
    "targets-patient": ("targets-patient.mrk.json", "targets-patient.fcsv"),
    "plausibility": ("plausibility.mrk.json", "plausibility.fcsv"),
}
NOTE = "note"  # name in case.json of a sentence for the report
LONGEST_PATH = 256  # a longer text under an unknown name is a note; systems refuse to look for a file of such a name
REQUIRED = ("ct", "landmarks-ct", "landmarks-patient")
MODES = ("Ia", "Ib", "IIa", "IIb", "III")


@dataclass(frozen=True, eq=False)
class Case:
    """What a case folder holds. Point lists are in RAS (…-ct) or Reference (the others), mm."""

    folder: Path
    ct: Path
    landmarks_ct: LabelledPoints
    landmarks_patient: LabelledPoints
    points: Optional[LabelledPoints] = None
    palpation: Optional[Path] = None
    targets_ct: Optional[LabelledPoints] = None
    targets_patient: Optional[LabelledPoints] = None
    plausibility: Optional[LabelledPoints] = None
    note: str = ""  # what the report has to say of it first: that the patient is a simulated one

    @property
    def name(self) -> str:
        """The folder's name."""
        return self.folder.resolve().name

    def mode(self, wanted: Optional[str] = None) -> str:
        """The registration mode: the wanted one if the folder has what it needs, else the richest there is.

        Raises
        ------
        InputError
            An unknown mode, or one whose file is missing.
        """
        if wanted is None:
            return "III" if self.palpation else "IIb" if self.points else "IIa"
        known = {mode.lower(): mode for mode in MODES}
        if wanted.lower() not in known:
            raise InputError(f"unknown mode {wanted!r}; choose one of {', '.join(MODES)}")
        mode = known[wanted.lower()]
        if mode == "III" and self.palpation is None:
            raise InputError(
                f"mode III needs an A-mode recording, and {self.folder} has none; add palpation.igs.mha or choose --mode IIa"
            )
        if mode == "IIb" and self.points is None:
            raise InputError(
                f"mode IIb needs palpated points, and {self.folder} has none; add points.mrk.json or choose --mode IIa"
            )
        return mode


def find_files(folder: Path) -> dict[str, Path]:
    """Path of everything the case names or holds.

    Raises
    ------
    InputError
        No folder, a broken case.json, a mistyped name in it, a redirection that leads nowhere, or something required is missing.
    """
    if not folder.is_dir():
        raise InputError(f"no case folder {folder}; give a folder that holds a CT and the landmark lists")
    redirected = _redirections(folder, _read_json(folder))
    found: dict[str, Path] = {}
    for thing, names in FILES.items():
        if thing in redirected:
            path = folder / redirected[thing]
            if not path.exists():
                raise InputError(
                    f"{folder / 'case.json'} says {thing} is {redirected[thing]}, but there is no {path}; correct the path"
                )
            found[thing] = path
        else:
            present = [folder / name for name in names if (folder / name).exists()]
            if present:
                found[thing] = present[0]
    for thing in REQUIRED:
        if thing not in found:
            raise InputError(
                f"case folder {folder} has no {FILES[thing][0]} (or {', '.join(FILES[thing][1:])}); "
                "add it, or say in case.json where it is"
            )
    return found


def _read_json(folder: Path) -> dict[str, object]:
    path = folder / "case.json"
    if not path.exists():
        return {}
    try:
        redirected: object = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise InputError(f'cannot read {path}: {error}; expected JSON such as {{"ct": "../ct.nrrd"}}') from None
    if not isinstance(redirected, dict):
        raise InputError(f'{path} must hold one JSON object such as {{"ct": "../ct.nrrd"}}')
    return redirected


def _redirections(folder: Path, redirected: dict[str, object]) -> dict[str, str]:
    path = folder / "case.json"
    # a name may be given as the thing ("ct") or as the file it stands for ("landmarks-ct.mrk.json")
    by_name = {name: thing for thing, names in FILES.items() for name in (thing, *names)}
    known = {by_name[key]: value for key, value in redirected.items() if key in by_name}
    for key in redirected.keys() - by_name.keys():
        _check_no_redirection(path, key, redirected[key], by_name)
    for thing, value in known.items():
        if not isinstance(value, str):
            raise InputError(f"{path}: {thing} must be a path in quotes, got {value!r}")
    return {thing: str(value) for thing, value in known.items()}


def note_in_case(folder: Path, changes: Mapping[str, str]) -> None:
    """Set names in the folder's case.json; what else stands there stays."""
    known = _read_json(folder)
    if {**known, **changes} != known:
        write_text(folder / "case.json", json.dumps({**known, **changes}, indent=1) + "\n")


def _check_no_redirection(path: Path, key: str, value: object, names: Iterable[str]) -> None:
    """Refuse a mistyped name, or a file under an unknown one; a note of another kind (a seed, a date) may stand there."""
    if not isinstance(value, str):
        return
    meant = get_close_matches(key.lower(), [name.lower() for name in names], n=1, cutoff=0.7)
    if meant or (value.strip(" ./") and len(value) < LONGEST_PATH and (path.parent / value).exists()):
        hint = f"; did you mean {meant[0]!r}?" if meant else ""
        raise InputError(f"{path}: unknown name {key!r}{hint} (known: {', '.join(FILES)})")


def read_case(folder: str | Path) -> Case:
    """The case in `folder`: point lists read, CT and recording found but not yet read.

    Raises
    ------
    InputError
        What find_files refuses, or a point list that cannot be read.
    """
    folder = Path(folder)
    files = find_files(folder)
    lists = {
        thing.replace("-", "_"): read_points(path)
        for thing, path in files.items()
        if thing not in ("ct", "palpation")
    }  # fmt: skip
    note = _read_json(folder).get(NOTE, "")
    return Case(folder=folder, ct=files["ct"], palpation=files.get("palpation"), note=str(note), **lists)
