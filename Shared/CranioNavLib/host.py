"""Where CranioNav runs: inside the 3D Slicer application, or in a plain Python with the slicer-core wheels.

Inside the application its scene and base classes are used. Outside, a real MRML scene is made on first use:
`slicer.mrmlScene` is set, and stand-ins for the four base classes of a scripted module make
`ModuleRegistrationLogic()` work in a plain console as it does in Slicer's. Modules import from here:

    from CranioNavLib.host import ScriptedLoadableModule, ScriptedLoadableModuleLogic, slicer
"""

from __future__ import annotations

import importlib
import importlib.util
import sys
import tempfile
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any

from CranioNavLib.errors import InputError

BASE_CLASSES = (
    "ScriptedLoadableModule",
    "ScriptedLoadableModuleWidget",
    "ScriptedLoadableModuleLogic",
    "ScriptedLoadableModuleTest",
)

# Logics that register the node classes and storage nodes that a bare vtkMRMLScene does not know.
MODULE_LOGICS = {
    "Markups": "vtkSlicerMarkupsLogic",
    "Volumes": "vtkSlicerVolumesLogic",
    "Models": "vtkSlicerModelsLogic",
    "Tables": "vtkSlicerTablesLogic",
    "Plots": "vtkSlicerPlotsLogic",
    "Transforms": "vtkSlicerTransformLogic",
    "Segmentations": "vtkSlicerSegmentationsModuleLogic",
    "Sequences": "vtkSlicerSequencesLogic",
    "Texts": "vtkSlicerTextsLogic",
    "SubjectHierarchy": "vtkSlicerSubjectHierarchyModuleLogic",
}

# What the libraries need beyond what the application brings, by the name of import.
PACKAGES = {"scipy": "scipy", "open3d": "open3d", "serial": "pyserial", "jinja2": "jinja2", "matplotlib": "matplotlib"}


@dataclass
class _Host:
    """The one scene of this process. A scene and its logics point at each other, so nothing of them is ever let go."""

    scene: Any = None
    thread: int = 0  # only this thread may write nodes
    application_logics: list[tuple[Any, Any]] = field(default_factory=list)  # (scene, its application logic)
    kept: list[Any] = field(default_factory=list)


_host = _Host()


def slicer_package() -> Any:
    """The `slicer` package: the application's, or the slicer-core wheels'.

    Raises
    ------
    InputError
        Neither is installed.
    """
    loaded = sys.modules.get("slicer")  # asked for at every pose
    if loaded is not None:
        return loaded
    try:
        return importlib.import_module("slicer")
    except ImportError as error:
        raise InputError(f"no MRML scene can be made: {error}; install slicer-core or run inside 3D Slicer") from None


def in_application() -> bool:
    """Whether this is the Python of a running 3D Slicer application."""
    loaded = "slicer" in sys.modules or importlib.util.find_spec("slicer") is not None
    return loaded and hasattr(slicer_package(), "app")


def scene() -> Any:
    """The one MRML scene (vtkMRMLScene); made on first use outside the application.

    The thread that asks first owns the scene: nodes are written from there alone.
    """
    package = slicer_package()
    if in_application():
        _host.thread = _host.thread or threading.main_thread().ident or 0
        return package.mrmlScene
    if _host.scene is None:
        _boot(package)
    return _host.scene


def adopt_scene(mrml_scene: Any, application_logic: Any = None) -> Any:
    """Make a scene that somebody else created (the web workstation's SlicerApp) the one scene of this process.

    `application_logic` is its vtkSlicerApplicationLogic (vtkMRMLApplicationLogic); node classes that it lacks are
    registered. The calling thread becomes the one that may write nodes. Returns the scene.
    """
    package = slicer_package()
    _host.scene, _host.thread = mrml_scene, threading.get_ident()
    known = [logic for scene_of_it, logic in _host.application_logics if scene_of_it is mrml_scene]
    if application_logic is None:
        application_logic = known[0] if known else _application_logic(package, mrml_scene)
    if application_logic not in known:
        _host.application_logics.append((mrml_scene, application_logic))
    _register_logics(package, application_logic)
    _allow_bundles(package, application_logic)
    package.mrmlScene = mrml_scene
    return mrml_scene


def check_thread() -> None:
    """Refuse to go on in a thread that does not own the scene.

    Raises
    ------
    RuntimeError
        Called from another thread than the one that made or adopted the scene.
    """
    scene()
    if threading.get_ident() != _host.thread:
        raise RuntimeError(
            f"node write from thread {threading.current_thread().name!r}; the scene belongs to another thread. "
            "Hand the sample over through a queue and write it there"
        )


def sound_effect_class() -> Any | None:
    """QSoundEffect of Qt Multimedia: the application's, or PySide6's where its add-ons are installed; None where it lacks.

    3D Slicer wraps it for Python since 5.0; builds of one's own may have left Qt Multimedia out.
    """
    try:
        home = importlib.import_module("qt" if in_application() else "PySide6.QtMultimedia")
    except ImportError:
        return None
    return getattr(home, "QSoundEffect", None)


def beep() -> None:
    """The computer's own beep; silent where there is no Qt, and where the computer's settings say so."""
    try:
        application: Any = importlib.import_module("qt" if in_application() else "PySide6.QtWidgets").QApplication
    except (ImportError, AttributeError):
        return
    if in_application() or application.instance() is not None:
        application.beep()


@contextmanager
def quiet() -> Iterator[Any]:
    """What VTK and MRML would print is kept; the object given has it as `GetOutput()`, for an exception's message."""
    from vtkmodules.vtkCommonCore import vtkLogger, vtkOutputWindow, vtkStringOutputWindow

    shown, verbosity, kept = vtkOutputWindow.GetInstance(), vtkLogger.GetCurrentVerbosityCutoff(), vtkStringOutputWindow()
    vtkOutputWindow.SetInstance(kept)
    vtkLogger.SetStderrVerbosity(vtkLogger.VERBOSITY_OFF)
    try:
        yield kept
    finally:
        vtkLogger.SetStderrVerbosity(verbosity)
        vtkOutputWindow.SetInstance(shown)


def missing_packages() -> list[str]:
    """What must still be installed for the libraries to work, by the name that pip knows."""
    return [pip_name for name, pip_name in PACKAGES.items() if importlib.util.find_spec(name) is None]


def install_missing_packages() -> None:
    """Inside the application: ask, then install what is missing with `slicer.util.pip_install`.

    Raises
    ------
    InputError
        Something is missing and the user declined, there is nobody to ask, or this is no application.
    """
    missing = missing_packages()
    if not missing:
        return
    wanted = " ".join(missing)
    if not in_application():
        raise InputError(f"Python packages are missing: {wanted}; install them with pip install {wanted}")
    util = slicer_package().util
    question = f"CranioNav needs these Python packages: {wanted}. Install them now? This takes some minutes."
    if not util.confirmOkCancelDisplay(question, windowTitle="CranioNav"):
        raise InputError(f"Python packages are missing: {wanted}; allow their installation, or pip_install them by hand")
    util.pip_install(wanted)


def _boot(package: Any) -> None:
    mrml_scene = package.vtkMRMLScene()
    with quiet():
        adopt_scene(mrml_scene, _application_logic(package, mrml_scene))


def _application_logic(package: Any, mrml_scene: Any) -> Any:
    logic = package.vtkSlicerApplicationLogic()
    logic.SetMRMLScene(mrml_scene)  # makes the selection and interaction nodes
    logic.GetColorLogic().SetMRMLScene(mrml_scene)
    logic.GetColorLogic().AddDefaultColorNodes()
    return logic


def _register_logics(package: Any, application_logic: Any) -> None:
    """Each logic that the application logic does not hold yet; setting its scene registers its node classes."""
    for name, class_name in MODULE_LOGICS.items():
        with quiet():
            known = application_logic.GetModuleLogic(name)
        if known is not None and known.GetMRMLScene() is _host.scene:
            continue
        logic = getattr(package, class_name)()
        logic.SetMRMLScene(_host.scene)
        logic.SetMRMLApplicationLogic(application_logic)
        application_logic.SetModuleLogic(name, logic)
        _host.kept.append(logic)


def _allow_bundles(package: Any, application_logic: Any) -> None:
    """Give the scene the input/output manager without which sequences and .mrb files cannot be read."""
    if _host.scene.GetDataIOManager() is not None:
        return
    folder = tempfile.TemporaryDirectory(prefix="cranionav-")  # removed when the process ends
    remote = package.vtkMRMLRemoteIOLogic()
    remote.SetMRMLScene(_host.scene)
    remote.SetMRMLApplicationLogic(application_logic)
    remote.GetCacheManager().SetRemoteCacheDirectory(folder.name)
    manager = package.vtkDataIOManagerLogic()
    manager.SetMRMLScene(_host.scene)
    manager.SetMRMLApplicationLogic(application_logic)
    manager.SetAndObserveDataIOManager(remote.GetDataIOManager())
    remote.AddDataIOToScene()
    _host.kept += [folder, remote, manager]


def __getattr__(name: str) -> Any:
    """`slicer` (with its scene ready) and the four base classes, resolved when first asked for."""
    if name == "slicer" or name in BASE_CLASSES:
        inside = in_application()
        if not inside:
            scene()
        if name == "slicer":
            return slicer_package()
        home = "slicer.ScriptedLoadableModule" if inside else "CranioNavLib.scripted_module"
        return getattr(importlib.import_module(home), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
