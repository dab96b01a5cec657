"""The libraries are pure: they work where neither Qt nor trame nor slicer can be imported, and need no newer Python."""

from __future__ import annotations

import ast
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[3]
LIBRARIES = {
    "CranioNavLib": ROOT / "Shared" / "CranioNavLib",
    "ModuleTrackingLib": ROOT / "ModuleTracking" / "ModuleTrackingLib",
    "ModuleUltrasoundLib": ROOT / "ModuleUltrasound" / "ModuleUltrasoundLib",
    "ModuleRegistrationLib": ROOT / "ModuleRegistration" / "ModuleRegistrationLib",
}
FORBIDDEN = (
    "qt",
    "ctk",
    "PySide6",
    "PyQt5",
    "PyQt6",
    "trame",
    "trame_client",
    "trame_server",
    "trame_slicer",
    "slicer",
    "slicer_core",
)
# What the design lets know the scene and Qt; each is named for it.
IMPURE = {
    "CranioNavLib.host",
    "CranioNavLib.scripted_module",
    "CranioNavLib.panel_qt",
    "CranioNavLib.panel_qt_widgets",
}  # fmt: skip

BLOCK = """
import importlib, importlib.abc, sys
class Wall(importlib.abc.MetaPathFinder):
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in {forbidden!r}:
            raise ImportError("walled off: " + name)
sys.meta_path.insert(0, Wall())
failed = []
for name in {names!r}:
    try:
        importlib.import_module(name)
    except Exception as error:
        failed.append(name + ": " + type(error).__name__ + ": " + str(error))
print("\\n".join(failed))
"""


def modules_of(library: str) -> list[str]:
    folder = LIBRARIES[library]
    files = sorted(folder.rglob("*.py"))
    names = [".".join([library, *file.relative_to(folder).with_suffix("").parts]) for file in files]
    return [name.removesuffix(".__init__") for name in names if not name.endswith("__main__")]


def imports_of(path: Path) -> set[str]:
    """Top-level names that a file imports anywhere, in its functions too."""
    found = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            found |= {alias.name.partition(".")[0] for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.level == 0 and node.module:
            found.add(node.module.partition(".")[0])
    return found


@pytest.mark.parametrize("library", LIBRARIES)
def test_every_library_file_can_be_imported_without_qt_trame_and_slicer(library):
    code = BLOCK.format(forbidden=FORBIDDEN, names=modules_of(library))
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False, timeout=120)
    assert done.returncode == 0, done.stderr
    assert done.stdout.strip() == ""


@pytest.mark.parametrize("library", LIBRARIES)
def test_no_pure_library_file_imports_qt_trame_or_slicer_anywhere(library):
    guilty = {}
    for name, path in zip(modules_of(library), sorted(LIBRARIES[library].rglob("*.py"))):
        found = imports_of(path) & set(FORBIDDEN)
        if found and name not in IMPURE:
            guilty[name] = found
    assert guilty == {}


@pytest.mark.parametrize("library", LIBRARIES)
def test_every_file_for_slicer_is_grammar_of_its_oldest_python(library):
    """3D Slicer 5.6 has Python 3.9: no match statement, no newer grammar."""
    for path in [*sorted(LIBRARIES[library].rglob("*.py")), *LIBRARIES[library].parent.glob("Module*.py")]:
        ast.parse(path.read_text(encoding="utf-8"), filename=str(path), feature_version=(3, 9))


@pytest.mark.parametrize("library", LIBRARIES)
def test_no_file_for_slicer_uses_what_came_after_its_oldest_python(library):
    guilty = []
    for path in [*sorted(LIBRARIES[library].rglob("*.py")), *LIBRARIES[library].parent.glob("Module*.py")]:
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Call) and isinstance(node.func, ast.Name):
                newer = {"zip": {"strict"}, "dataclass": {"slots", "kw_only"}}.get(node.func.id, set())
                guilty += [f"{path.name}:{node.lineno} {word.arg}" for word in node.keywords if word.arg in newer]
            if isinstance(node, ast.Import):
                guilty += [f"{path.name}:{node.lineno} {name.name}" for name in node.names if name.name == "tomllib"]
    assert guilty == []
