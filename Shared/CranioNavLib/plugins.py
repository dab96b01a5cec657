"""Plugin kinds and their discovery. A plugin is one class in one file, and every kind has one door.

A kind is declared once, by the library that uses it:

    TRACKERS = PluginKind("tracker", Tracker, folder="ModuleTrackingLib.plugins")

and a plugin is a subclass of the kind's base with a `name`. Three places are searched, by name:
classes registered by code that was imported (`TRACKERS.register`), files in the kind's folder (built
in), and entry points of the group `cranionav.<kind>` (third parties). Files and entry points are only
imported when asked for, so that a missing vendor package hurts that plugin alone.
"""

from __future__ import annotations

import importlib
import importlib.util
import inspect
import pkgutil
import sys
from abc import ABC
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path
from types import ModuleType
from typing import Any, ClassVar, Generic, TypeVar

from CranioNavLib.errors import InputError
from CranioNavLib.parameters import Parameters


class Plugin(ABC):  # noqa: B024 - the abstract methods are those of each kind's base
    """What every plugin has, whatever its kind."""

    name: ClassVar[str] = ""  # as the user types it: lower case, digits, hyphens
    title: ClassVar[str] = ""  # one line for a list
    Settings: ClassVar[type[Parameters]] = Parameters

    def __init__(self, settings: Parameters | None = None) -> None:
        self.settings: Any = settings if settings is not None else self.Settings()
        if not isinstance(self.settings, self.Settings):
            raise InputError(f"plugin {self.name}: expected {self.Settings.__name__}, got {type(settings).__name__}")


T = TypeVar("T", bound=Plugin)

KINDS: dict[str, PluginKind[Any]] = {}


@dataclass(frozen=True)
class PluginEntry:
    """One line of `cranionav plugins`."""

    kind: str
    name: str
    source: str  # "built in", "registered", or the distribution that brought it
    title: str
    problem: str = ""  # why it cannot be used, if it cannot


class PluginKind(Generic[T]):
    """All plugins of one kind."""

    def __init__(self, kind: str, base: type[T], folder: str | None = None) -> None:
        self.kind, self.base, self.folder = kind, base, folder
        self._registered: dict[str, type[T]] = {}
        KINDS[kind] = self

    def register(self, plugin: type[T]) -> type[T]:
        """Add a class (also as a decorator). It is checked here, and refused whole.

        Raises
        ------
        InputError
            Not a subclass of the kind's base, no name, a method still missing, or the name is taken.
        """
        checked = self._checked(plugin)
        taken = self._registered.get(checked.name)
        if taken is not None and taken.__qualname__ != checked.__qualname__:
            raise InputError(
                f"{self.kind} plugin name {checked.name!r} is already used by "
                f"{taken.__module__}.{taken.__qualname__}; choose another name"
            )
        self._registered[checked.name] = checked
        return plugin

    def names(self) -> list[str]:
        """Names of all plugins, nothing imported but what was already."""
        return sorted({*self._registered, *self._files(), *self._entry_points()})

    def find(self, name: str) -> type[T]:
        """The plugin class of that name.

        Raises
        ------
        InputError
            No such plugin (the message lists what there is), or it cannot be imported.
        """
        if name in self._registered:
            return self._registered[name]
        if name in self._files():
            return self._from_module(name, importlib.import_module(f"{self.folder}.{self._files()[name]}"))
        if name in self._entry_points():
            entry = self._entry_points()[name]
            try:
                return self._checked(entry.load(), expected_name=name)
            except (ImportError, AttributeError) as error:
                raise InputError(
                    f"{self.kind} plugin {name!r} ({entry.value}) cannot be loaded: {error}; install what it needs"
                ) from error
        raise InputError(f"unknown {self.kind} {name!r}; installed: {', '.join(self.names()) or 'none'}")

    def create(self, name: str, **settings: str) -> T:
        """A plugin made with settings given as text."""
        plugin = self.find(name)
        return plugin(plugin.Settings.from_strings(settings))

    def entries(self) -> list[PluginEntry]:
        """Every plugin with its source; one that cannot be loaded says why instead of stopping the list."""
        listed = []
        for name in self.names():
            points = self._entry_points()
            source = "registered" if name in self._registered else "built in"
            if name not in self._registered and name not in self._files():
                source = points[name].dist.name if points[name].dist else "entry point"
            try:
                listed.append(PluginEntry(self.kind, name, source, self.find(name).title))
            except (InputError, ImportError) as error:
                listed.append(PluginEntry(self.kind, name, source, "", str(error)))
        return listed

    def _files(self) -> dict[str, str]:
        """Plugin name -> module name, of the files in the kind's folder that are plugins of this kind."""
        if not self.folder:
            return {}
        folder = importlib.import_module(self.folder)
        kinds: dict[str, str] = getattr(folder, "KIND_OF", {})
        default: str = getattr(folder, "DEFAULT_KIND", self.kind)
        names = [info.name for info in pkgutil.iter_modules(folder.__path__) if not info.name.startswith("_")]
        return {name.replace("_", "-"): name for name in names if kinds.get(name, default) == self.kind}

    def _entry_points(self) -> dict[str, Any]:
        if sys.version_info >= (3, 10):
            found = metadata.entry_points(group=f"cranionav.{self.kind}")
        else:
            found = metadata.entry_points().get(f"cranionav.{self.kind}", ())
        return {entry.name: entry for entry in found}

    def _from_module(self, name: str, module: ModuleType) -> type[T]:
        for _, member in inspect.getmembers(module, inspect.isclass):
            if issubclass(member, self.base) and member.name == name and member.__module__ == module.__name__:
                return self._checked(member)
        raise InputError(f"{module.__name__} holds no {self.kind} plugin named {name!r}; its class needs name = {name!r}")

    def _checked(self, plugin: Any, expected_name: str = "") -> type[T]:
        where = f"{getattr(plugin, '__module__', '?')}.{getattr(plugin, '__qualname__', plugin)}"
        if not (inspect.isclass(plugin) and issubclass(plugin, self.base)):
            raise InputError(
                f"{where} is not a {self.kind} plugin; expected a subclass of {self.base.__module__}.{self.base.__name__}"
            )
        if not plugin.name:
            raise InputError(f'{self.kind} plugin {where} has no name; give it name = "..."')
        if expected_name and plugin.name != expected_name:
            raise InputError(
                f"{self.kind} plugin {where} is named {plugin.name!r} but its entry point {expected_name!r}; make them equal"
            )
        missing = sorted(getattr(plugin, "__abstractmethods__", ()))
        if missing:
            raise InputError(
                f"{self.kind} plugin {plugin.name!r} ({where}) lacks {', '.join(missing)}; add what {self.base.__name__} asks for"
            )
        if not (inspect.isclass(plugin.Settings) and issubclass(plugin.Settings, Parameters)):
            raise InputError(
                f"{self.kind} plugin {plugin.name!r} ({where}): Settings must be a subclass of CranioNavLib.parameters.Parameters"
            )
        return plugin


def load_file(path: str | Path) -> ModuleType:
    """Import a file by its path, so that the plugins it registers are known.

    Raises
    ------
    InputError
        The file is missing or fails to import.
    """
    path = Path(path)
    spec = importlib.util.spec_from_file_location(path.stem, path)
    if spec is None or spec.loader is None or not path.is_file():
        raise InputError(f"no Python file {path}; give the path of a plugin file")
    module = importlib.util.module_from_spec(spec)
    sys.modules[path.stem] = module
    try:
        spec.loader.exec_module(module)
    except InputError:
        del sys.modules[path.stem]
        raise
    except Exception as error:
        del sys.modules[path.stem]
        raise InputError(f"plugin file {path} fails to import: {type(error).__name__}: {error}") from error
    return module
