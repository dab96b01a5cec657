"""Holds the file lists of the CMakeLists.txt to what is on disk: a file that is not listed lacks in the installed extension.

python Testing/cmake_lists.py            says what is missing from and what is dangling in the lists
python Testing/cmake_lists.py --write    brings the lists up to date
"""

from __future__ import annotations

import re
import sys
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
# folder of a CMakeLists.txt -> folders and files below it that belong into the extension
PARTS = {
    "Shared": ("CranioNavLib",),
    "ModuleTracking": ("ModuleTracking.py", "ModuleTrackingLib", "Resources"),
    "ModuleUltrasound": ("ModuleUltrasound.py", "ModuleUltrasoundLib", "Resources"),
    "ModuleRegistration": ("ModuleRegistration.py", "ModuleRegistrationLib", "Resources"),
}
LIST = re.compile(r"(set\(\w+_PYTHON_(SCRIPTS|RESOURCES)\n)(.*?)(^\))", re.DOTALL | re.MULTILINE)


@dataclass(frozen=True)
class Lists:
    """Python files and other files of one part, as paths from its folder."""

    scripts: tuple[str, ...]
    resources: tuple[str, ...]


def on_disk(part: str, root: Path = ROOT) -> Lists:
    """What belongs into the extension."""
    files: list[str] = []
    for name in PARTS[part]:
        top = root / part / name
        found = [top] if top.is_file() else sorted(top.rglob("*"))
        files += [path.relative_to(root / part).as_posix() for path in found if path.is_file() and _belongs(path)]
    return Lists(
        tuple(sorted(file for file in files if file.endswith(".py"))),
        tuple(sorted(file for file in files if not file.endswith(".py"))),
    )


def written(part: str, root: Path = ROOT) -> Lists:
    """What the part's CMakeLists.txt lists."""
    text = (root / part / "CMakeLists.txt").read_text(encoding="utf-8")
    found = {match[2]: tuple(match[3].split()) for match in LIST.finditer(text)}
    expanded = {key: tuple(file.replace("${MODULE_NAME}", part) for file in files) for key, files in found.items()}
    return Lists(expanded["SCRIPTS"], expanded["RESOURCES"])


def differences(part: str, root: Path = ROOT) -> list[str]:
    """One line a file that is missing from or dangling in the part's lists."""
    have, listed = on_disk(part, root), written(part, root)
    lines = []
    for kind in ("scripts", "resources"):
        there, said = set(getattr(have, kind)), set(getattr(listed, kind))
        lines += [f"{part}/CMakeLists.txt lacks {file}" for file in sorted(there - said)]
        lines += [f"{part}/CMakeLists.txt lists {file}, which is not there" for file in sorted(said - there)]
    return lines


def write(part: str, root: Path = ROOT) -> None:
    """Bring the part's lists up to date."""
    path, have = root / part / "CMakeLists.txt", on_disk(part, root)
    files = {"SCRIPTS": have.scripts, "RESOURCES": have.resources}
    text = LIST.sub(
        lambda match: match[1] + "".join(f"  {file}\n" for file in files[match[2]]) + match[4], path.read_text("utf-8")
    )
    path.write_text(text, encoding="utf-8")


def _belongs(path: Path) -> bool:
    return "__pycache__" not in path.parts and not path.name.startswith(".") and path.suffix not in (".pyc", ".md")


def main(arguments: list[str]) -> int:
    """Exit status 1 if the lists are not what they should be."""
    if "--write" in arguments:
        for part in PARTS:
            write(part)
    lines = [line for part in PARTS for line in differences(part)]
    print("\n".join(lines) or "the lists hold what is on disk")
    return 1 if lines else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
