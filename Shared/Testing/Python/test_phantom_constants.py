"""No inverse crime: nothing that estimates may read what the simulator knows."""

from __future__ import annotations

import ast
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[3]
# the simulated devices, the emulators, and the studies and self-tests that score estimators against the truth
MAY_USE_THE_PHANTOM = {
    "ModuleTracking/ModuleTrackingLib/plugins/simulated.py",
    "ModuleUltrasound/ModuleUltrasoundLib/plugins/simulated.py",
    "ModuleTracking/ModuleTrackingLib/ndi/emulator/patient.py",
    "ModuleRegistration/ModuleRegistrationLib/verification/simulated_patient.py",
    "ModuleUltrasound/ModuleUltrasoundLib/emulators/line_source.py",
    "ModuleRegistration/ModuleRegistrationLib/verification/studies.py",
    "ModuleRegistration/ModuleRegistrationLib/verification/study_figure.py",
    "ModuleTracking/ModuleTrackingLib/selftest.py",
    "ModuleRegistration/ModuleRegistrationLib/selftest.py",
    "Shared/CranioNavLib/module_selftest.py",
}
LIB_FILES = sorted(path for lib in ROOT.glob("Module*/Module*Lib") for path in lib.rglob("*.py"))
LIB_FILES += sorted(path for path in (ROOT / "Shared/CranioNavLib").glob("*.py"))


def imported(path: Path) -> set[str]:
    names: set[str] = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            names |= {node.module} | {f"{node.module}.{alias.name}" for alias in node.names}
    return names


def test_there_are_library_files_to_check():
    assert len(LIB_FILES) > 30


@pytest.mark.parametrize("path", LIB_FILES, ids=lambda path: str(path.relative_to(ROOT)))
def test_no_estimator_imports_the_simulator(path):
    used = {name for name in imported(path) if name.startswith("CranioNavLib.phantom")}
    assert not {name for name in used if name.startswith("CranioNavLib.phantom.constants")}, f"{path} reads the constants"
    if str(path.relative_to(ROOT)) not in MAY_USE_THE_PHANTOM:
        assert not used, f"{path} imports {used}"


def test_every_constant_names_its_source():
    text = (ROOT / "Shared/CranioNavLib/phantom/constants.py").read_text(encoding="utf-8").splitlines()
    for number, line in enumerate(text):
        if line[:1].isupper() and "=" in line:
            above = []
            for before in reversed(text[:number]):
                if before.startswith("#") or (above and before[:1].isupper()) or before[:1].isupper():
                    above.append(before)
                else:
                    break
            assert any(mark in f"{line}{above}" for mark in ("[S]", "[C]", "[M]")), f"line {number + 1}: {line}"
