"""The runner of the modules' self-tests says honestly which passed; the real ones are run where time allows."""

from __future__ import annotations

import sys
from types import ModuleType

import pytest
from CranioNavLib import host, scene
from CranioNavLib.selftest import MODULES, run_selftest, run_selftests


def a_module(monkeypatch, name, scenario):
    """A module of 3D Slicer's making whose self-test is `scenario`."""
    loaded = ModuleType(name)
    module = type(name, (host.ScriptedLoadableModule,), {"__module__": name})
    test = type(f"{name}Test", (host.ScriptedLoadableModuleTest,), {"runTest": lambda self: scenario(), "__module__": name})
    setattr(loaded, name, module)
    setattr(loaded, f"{name}Test", test)
    loaded.__file__ = __file__
    monkeypatch.setitem(sys.modules, name, loaded)


def fail():
    raise AssertionError("the skull is a cube")


def test_a_test_that_passes_passed(monkeypatch):
    a_module(monkeypatch, "ModuleGood", lambda: scene.find_or_create("CT"))
    outcome = run_selftest("ModuleGood")
    assert (outcome.passed, outcome.message) == (True, "")
    assert scene.find("CT") is None, "the scene is left clean"


def test_a_test_that_fails_failed_and_the_next_one_is_still_run(monkeypatch):
    a_module(monkeypatch, "ModuleBad", fail)
    a_module(monkeypatch, "ModuleGood", lambda: None)
    bad, good = run_selftests(["ModuleBad", "ModuleGood"])
    assert not bad.passed
    assert "the skull is a cube" in bad.message
    assert "in fail" in bad.details
    assert good.passed


def test_an_error_without_words_is_a_failure_all_the_same(monkeypatch):
    def silent():
        raise AssertionError

    a_module(monkeypatch, "ModuleSilent", silent)
    assert not run_selftest("ModuleSilent").passed


def test_a_module_without_a_self_test_fails(monkeypatch):
    a_module(monkeypatch, "ModuleUntested", lambda: None)
    delattr(sys.modules["ModuleUntested"], "ModuleUntestedTest")
    assert not run_selftest("ModuleUntested").passed


def test_each_test_starts_with_an_empty_scene(monkeypatch):
    host.scene().AddNewNodeByClass("vtkMRMLModelNode", "left over")
    seen = []
    a_module(monkeypatch, "ModuleCurious", lambda: seen.append(host.scene().GetFirstNodeByName("left over")))
    run_selftest("ModuleCurious")
    assert seen == [None]


@pytest.mark.slow
@pytest.mark.parametrize("module", MODULES)
def test_the_modules_own_self_tests_pass(module):
    outcome = run_selftest(module)
    assert outcome.passed, outcome.details
