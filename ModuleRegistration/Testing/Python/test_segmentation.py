"""Choosing a segmentation by name, and not doing it twice."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest
from CranioNavLib.errors import InputError
from CranioNavLib.surface import Surface
from CranioNavLib.volume import Volume
from ModuleRegistrationLib.anatomy import surface_cache
from ModuleRegistrationLib.anatomy.segmentation import SEGMENTATIONS, BoneSurfaces, Segmentation, segment_bone


class Counting(Segmentation):
    """A segmentation that counts its calls and gives a tetrahedron."""

    name = "counting"
    calls = 0

    def segment(self, volume: Volume) -> BoneSurfaces:
        Counting.calls += 1
        corners = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]]) + float(volume.hu[0, 0, 0])
        surface = Surface(corners, np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [0, 3, 2]]))
        return BoneSurfaces(surface, surface, 300.0, 0.2, 0.4)


@pytest.fixture
def a_cache(tmp_path, monkeypatch) -> Path:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setitem(SEGMENTATIONS._registered, "counting", Counting)
    surface_cache.forget()
    Counting.calls = 0
    yield tmp_path
    surface_cache.forget()


@pytest.fixture
def a_volume() -> Volume:
    return Volume(np.zeros((3, 4, 5), dtype=np.int16), np.eye(4))


def test_the_same_ct_is_segmented_once(a_cache, a_volume):
    first = segment_bone(a_volume, "counting")
    assert segment_bone(Volume(a_volume.hu.copy(), a_volume.ijk_to_ras, "another name"), "counting") is first
    assert Counting.calls == 1


def test_what_is_on_disk_outlives_the_process(a_cache, a_volume):
    first = segment_bone(a_volume, "counting")
    surface_cache.forget()
    again = segment_bone(a_volume, "counting")
    assert Counting.calls == 1
    assert again.closed.content_hash == first.closed.content_hash
    assert dataclasses.astuple(again)[2:] == dataclasses.astuple(first)[2:]


@pytest.mark.parametrize("change", ["voxel", "place"])
def test_another_content_is_segmented_anew(a_cache, a_volume, change):
    segment_bone(a_volume, "counting")
    hu, matrix = a_volume.hu.copy(), a_volume.ijk_to_ras.copy()
    if change == "voxel":
        hu[0, 0, 0] = 1
    else:
        matrix[0, 3] = 0.001
    segment_bone(Volume(hu, matrix), "counting")
    assert Counting.calls == 2


def test_a_damaged_cache_file_is_replaced(a_cache, a_volume):
    segment_bone(a_volume, "counting")
    surface_cache.forget()
    (path,) = (a_cache / "cranionav" / "bone").glob("*.npz")
    path.write_bytes(path.read_bytes()[:100])
    segment_bone(a_volume, "counting")
    surface_cache.forget()
    segment_bone(a_volume, "counting")
    assert Counting.calls == 2


def test_a_cache_that_cannot_be_written_is_no_obstacle(a_cache, a_volume, monkeypatch):
    (a_cache / "file").touch()
    monkeypatch.setenv("XDG_CACHE_HOME", str(a_cache / "file"))
    assert segment_bone(a_volume, "counting").threshold_hu == 300


def test_the_cache_is_bounded(a_cache, a_volume, monkeypatch):
    monkeypatch.setattr(surface_cache, "ON_DISK_BYTES", 6000)
    for value in range(6):
        segment_bone(Volume(np.full((3, 4, 5), value, dtype=np.int16), np.eye(4)), "counting")
    sizes = [path.stat().st_size for path in (a_cache / "cranionav" / "bone").glob("*.npz")]
    assert 0 < sum(sizes) <= 6000


def test_uncached_means_anew(a_cache, a_volume):
    segment_bone(a_volume, "counting")
    segment_bone(a_volume, "counting", cached=False)
    assert Counting.calls == 2


def test_an_unknown_method_is_refused(a_volume):
    with pytest.raises(InputError, match="magic"):
        segment_bone(a_volume, "magic")


def test_an_unknown_setting_is_refused(a_volume):
    with pytest.raises(InputError, match="no setting 'level'; known: threshold_hu"):
        segment_bone(a_volume, "threshold", level=3)


def test_a_setting_outside_its_limits_is_refused(a_volume):
    with pytest.raises(InputError, match="threshold_hu"):
        segment_bone(a_volume, "threshold", threshold_hu=9000.0)


@pytest.mark.parametrize("name", ["threshold", "gradient"])
def test_the_methods_are_found_by_name(name):
    assert SEGMENTATIONS.find(name).name == name
