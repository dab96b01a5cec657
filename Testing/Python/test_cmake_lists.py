"""The extension, configured by real CMake against a stand-in for Slicer's build: nothing lacks, nothing dangles."""

from __future__ import annotations

import importlib.util
import json
import shutil
import subprocess
import sys
from collections import defaultdict
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
STAND_IN = Path(__file__).parent / "slicer_stand_in"
MODULES = ("ModuleTracking", "ModuleUltrasound", "ModuleRegistration")
SCHEMA_KEYS = {
    "$schema": str,
    "category": str,
    "scm_url": str,
    "scm_revision": str,
    "scm_type": str,
    "build_dependencies": list,
    "build_subdirectory": str,
    "enabled": bool,
    "tier": int,
}

spec = importlib.util.spec_from_file_location("cmake_lists", ROOT / "Testing" / "cmake_lists.py")
cmake_lists = importlib.util.module_from_spec(spec)  # a script, not in a package
sys.modules["cmake_lists"] = cmake_lists  # dataclasses look their module up by name
spec.loader.exec_module(cmake_lists)

needs_cmake = pytest.mark.skipif(shutil.which("cmake") is None, reason="cmake is not installed")


def configure(source: Path, build: Path, *options: str) -> subprocess.CompletedProcess[str]:
    command = ["cmake", "-S", str(source), "-B", str(build), f"-DSlicer_DIR={STAND_IN}", *options]
    return subprocess.run(
        [*command, f"-DCRANIONAV_RECORD={build}/record.txt"], capture_output=True, text=True, check=False, timeout=120
    )


def calls_in(build: Path) -> dict[str, list[tuple[Path, list[str]]]]:
    """Macro -> (folder, arguments) of each call."""
    calls = defaultdict(list)
    for line in (build / "record.txt").read_text().splitlines():
        macro, folder, arguments = line.split("|", 2)
        calls[macro].append((Path(folder), arguments.split(";")))
    return calls


def files_of(arguments: list[str]) -> tuple[set[str], set[str]]:
    """Scripts and resources given to a macro."""
    scripts, resources = arguments.index("SCRIPTS"), arguments.index("RESOURCES")
    end = arguments.index("DESTINATION_DIR") if "DESTINATION_DIR" in arguments else len(arguments)
    return set(arguments[scripts + 1 : resources]), set(arguments[resources + 1 : end])


@pytest.fixture(scope="module")
def configured(tmp_path_factory):
    build = tmp_path_factory.mktemp("build")
    done = configure(ROOT, build, "-DBUILD_TESTING=ON")
    assert done.returncode == 0, done.stderr
    return calls_in(build)


@needs_cmake
def test_all_that_is_listed_is_given_to_slicers_macro(configured):
    calls = configured["slicerMacroBuildScriptedModule"]
    assert [arguments[1] for _, arguments in calls] == list(MODULES)
    for folder, arguments in calls:
        listed = cmake_lists.written(folder.name)
        assert files_of(arguments) == (set(listed.scripts), set(listed.resources))
        assert f"{folder.name}.py" in listed.scripts
        assert f"Resources/Icons/{folder.name}.png" in listed.resources


@needs_cmake
def test_the_shared_package_is_installed_beside_the_modules(configured):
    ((folder, arguments),) = configured["ctkMacroCompilePythonScript"]
    listed = cmake_lists.written("Shared")
    assert folder == ROOT / "Shared"
    assert files_of(arguments) == (set(listed.scripts), set(listed.resources))
    assert arguments[arguments.index("INSTALL_DIR") + 1] == "lib/Slicer-5.8/qt-scripted-modules"
    assert arguments[arguments.index("DESTINATION_DIR") + 1].endswith("/lib/Slicer-5.8/qt-scripted-modules")


@needs_cmake
def test_each_modules_own_test_becomes_a_ctest_and_only_when_asked_for(configured, tmp_path):
    assert [arguments for _, arguments in configured["slicer_add_python_unittest"]] == [["SCRIPT", f"{m}.py"] for m in MODULES]
    done = configure(ROOT, tmp_path, "-DBUILD_TESTING=OFF")
    assert done.returncode == 0, done.stderr
    assert "slicer_add_python_unittest" not in calls_in(tmp_path)


@needs_cmake
def test_the_extensions_metadata_is_complete(configured):
    values = {name: ";".join(calls[0][1]) for name, calls in configured.items() if name.startswith("EXTENSION_")}
    assert values["EXTENSION_CATEGORY"] == "IGT"
    for name in ("HOMEPAGE", "CONTRIBUTORS", "DESCRIPTION", "ICONURL", "DEPENDS"):
        assert values[f"EXTENSION_{name}"], name
    assert values["EXTENSION_ICONURL"].endswith("/CranioNav.png")
    assert (ROOT / "CranioNav.png").is_file()
    assert len(configured["CPACK"]) == 1


@needs_cmake
def test_without_slicer_the_configuration_stops_and_says_so(tmp_path):
    done = subprocess.run(
        ["cmake", "-S", str(ROOT), "-B", str(tmp_path), "-DCMAKE_FIND_USE_CMAKE_SYSTEM_PATH=OFF"],
        capture_output=True, text=True, check=False, timeout=120,
    )  # fmt: skip
    assert done.returncode != 0
    assert "Slicer" in done.stderr


@needs_cmake
def test_a_listed_file_that_is_not_there_stops_the_configuration(tmp_path):
    copy = tmp_path / "source"
    for part in (*MODULES, "Shared"):
        shutil.copytree(ROOT / part, copy / part, ignore=shutil.ignore_patterns("__pycache__", "Testing"))
    shutil.copy(ROOT / "CMakeLists.txt", copy)
    (copy / "ModuleTracking" / "ModuleTrackingLib" / "tracker.py").unlink()
    done = configure(copy, tmp_path / "build")
    assert done.returncode != 0
    assert "ModuleTrackingLib/tracker.py" in done.stderr


def test_the_lists_are_up_to_date():
    lines = [line for part in cmake_lists.PARTS for line in cmake_lists.differences(part)]
    assert lines == [], "a listed file is all that is installed; mend with: python Testing/cmake_lists.py --write"


def test_a_missing_and_a_dangling_file_are_named_and_mended(tmp_path):
    part = tmp_path / "ModuleTracking"
    (part / "ModuleTrackingLib").mkdir(parents=True)
    (part / "Resources").mkdir()
    (part / "ModuleTracking.py").touch()
    (part / "ModuleTrackingLib" / "new.py").touch()
    (part / "Resources" / "new.png").touch()
    (part / "CMakeLists.txt").write_text(
        "set(MODULE_PYTHON_SCRIPTS\n  ${MODULE_NAME}.py\n  old.py\n)\n\nset(MODULE_PYTHON_RESOURCES\n  old.png\n)\n"
    )
    assert cmake_lists.differences("ModuleTracking", tmp_path) == [
        "ModuleTracking/CMakeLists.txt lacks ModuleTrackingLib/new.py",
        "ModuleTracking/CMakeLists.txt lists old.py, which is not there",
        "ModuleTracking/CMakeLists.txt lacks Resources/new.png",
        "ModuleTracking/CMakeLists.txt lists old.png, which is not there",
    ]
    cmake_lists.write("ModuleTracking", tmp_path)
    assert cmake_lists.differences("ModuleTracking", tmp_path) == []


@pytest.mark.parametrize("module", MODULES)
def test_each_module_has_its_icon(module):
    data = (ROOT / module / "Resources" / "Icons" / f"{module}.png").read_bytes()
    assert data.startswith(b"\x89PNG")
    assert int.from_bytes(data[16:20], "big") == int.from_bytes(data[20:24], "big") == 128


def test_the_extensions_index_entry_keeps_to_its_schema():
    """Keys and types of slicer-extension-catalog-entry-schema-v1.0.1, which allows no others."""
    entry = json.loads((ROOT / "CranioNav.json").read_text())
    assert set(entry) <= set(SCHEMA_KEYS)
    assert {"$schema", "category", "scm_url"} <= set(entry)
    for key, value in entry.items():
        assert isinstance(value, SCHEMA_KEYS[key]), key
    assert entry["$schema"].endswith("/slicer-extension-catalog-entry-schema-v1.0.1.json#")
    assert entry["tier"] in (1, 3, 5)
