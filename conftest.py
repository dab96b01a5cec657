"""For all tests: `import ModuleTracking` means the module's file, although a folder of that name stands beside this one."""

from __future__ import annotations

import os
import sys
from importlib.machinery import ModuleSpec, SourceFileLoader
from importlib.util import spec_from_file_location
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

ROOT = Path(__file__).parent


def pytest_configure(config: Any) -> None:
    """Where nobody reads the list of skipped tests, a missing sample head is a failure."""
    from CranioNavLib.sample_head import cached_sample_head

    if os.environ.get("CI") and cached_sample_head() is None:
        raise pytest.UsageError("the sample head is missing; run ./cranionav test, which fetches it")


class _OnDemand(ModuleType):
    """A module of 3D Slicer, loaded when something of it is asked for.

    pytest names test files by their folders (ModuleTracking.Testing.Python.test_tracker) and would put an empty package
    in the module's place. It leaves this one there, for it has a `__path__`.
    """

    __path__: list[str] = []  # noqa: RUF012

    def __init__(self, spec: ModuleSpec) -> None:
        super().__init__(spec.name)
        self.__spec__, self.__file__, self.__loader__ = spec, str(spec.origin), spec.loader

    def __getattr__(self, name: str) -> Any:
        loader = self.__dict__.pop("__loader__", None)
        if loader is None or name.startswith("__"):
            if loader is not None:
                self.__loader__ = loader
            raise AttributeError(f"module {self.__name__!r} has no attribute {name!r}")
        assert isinstance(loader, SourceFileLoader)
        loader.exec_module(self)
        return getattr(self, name)


for _name in ("ModuleTracking", "ModuleUltrasound", "ModuleRegistration"):
    _spec = spec_from_file_location(_name, ROOT / _name / f"{_name}.py")
    assert _spec is not None
    sys.modules.setdefault(_name, _OnDemand(_spec))
