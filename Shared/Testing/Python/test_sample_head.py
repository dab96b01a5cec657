"""The sample head: whole or refused, and the right way round."""

from __future__ import annotations

import io
import plistlib
import tarfile

import numpy as np
import pytest
from CranioNavLib import sample_head
from CranioNavLib.errors import InputError


@pytest.fixture
def empty_cache(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setattr(sample_head, "INSTALLED", tmp_path / "not-installed.inv3")
    return tmp_path / "cranionav"


@pytest.fixture
def a_sample_head():
    try:
        return sample_head.load_sample_head()
    except InputError as error:
        pytest.skip(f"sample head not to be had here: {error}")


def write_project(path, shape, content):
    plist = plistlib.dumps({"matrix": {"shape": list(shape)}})
    with tarfile.open(path, "w:gz") as archive:
        for name, data in (("x/main.plist", plist), ("x/matrix.dat", content)):
            info = tarfile.TarInfo(name)
            info.size = len(data)
            archive.addfile(info, io.BytesIO(data))


def test_a_half_done_fetch_is_not_taken_for_whole(empty_cache):
    empty_cache.mkdir()
    cached = empty_cache / "sample-head.int16"
    cached.write_bytes(b"\0" * 1000)
    assert sample_head.cached_sample_head() is None
    cached.write_bytes(b"\0" * int(np.prod(sample_head.SHAPE) * 2))  # right size, wrong content
    assert sample_head.cached_sample_head() is None


def test_without_apt_the_message_says_how_to_get_the_head(empty_cache, monkeypatch):
    monkeypatch.setattr(sample_head.shutil, "which", lambda tool: None)
    with pytest.raises(InputError, match=r"no apt-get; install it with `apt install invesalius-examples`"):
        sample_head.load_sample_head()


def test_an_apt_that_does_not_know_the_package_is_quoted(empty_cache, tmp_path, monkeypatch):
    fake = tmp_path / "bin"
    fake.mkdir()
    for tool, text in (("apt-get", "#!/bin/sh\necho 'E: Unable to locate package' >&2\nexit 100\n"), ("dpkg-deb", "#!/bin/sh\n")):
        (fake / tool).write_text(text)
        (fake / tool).chmod(0o755)
    monkeypatch.setenv("PATH", f"{fake}:/bin:/usr/bin")
    with pytest.raises(InputError, match=r"`apt-get download` says: E: Unable to locate package.*apt-get update"):
        sample_head.fetch_sample_head()


def test_an_installed_package_is_used(empty_cache, tmp_path, monkeypatch):
    content = np.arange(24, dtype="<i2").tobytes()
    project = tmp_path / "Cranium.inv3"
    write_project(project, (2, 3, 4), content)
    monkeypatch.setattr(sample_head, "INSTALLED", project)
    monkeypatch.setattr(sample_head, "SHAPE", (2, 3, 4))
    monkeypatch.setattr(sample_head, "SHA256", sample_head.hashlib.sha256(content).hexdigest())
    assert sample_head.fetch_sample_head().read_bytes() == content
    assert sample_head.cached_sample_head() is not None


@pytest.mark.parametrize("damage", ["cut", "other"])
def test_a_damaged_or_foreign_project_is_refused_and_nothing_is_cached(empty_cache, tmp_path, monkeypatch, damage):
    project = tmp_path / "Cranium.inv3"
    write_project(project, (2, 3, 4), np.arange(24, dtype="<i2").tobytes())
    if damage == "cut":
        project.write_bytes(project.read_bytes()[:60])
    monkeypatch.setattr(sample_head, "INSTALLED", project)
    with pytest.raises(InputError, match="is damaged" if damage == "cut" else "is not the head"):
        sample_head.fetch_sample_head()
    assert sample_head.cached_sample_head() is None


def test_the_nose_points_forwards_and_the_vault_up(a_sample_head):
    tissue = np.argwhere(a_sample_head.hu > -300)[:, ::-1]
    ras = tissue @ a_sample_head.ijk_to_ras[:3, :3].T + a_sample_head.ijk_to_ras[:3, 3]
    front = ras[ras[:, 1] > 105]  # only the nose reaches this far to the front
    assert np.ptp(front[:, 0]) < 40
    assert front[:, 2].max() < 0
    bone = ras[a_sample_head.hu[a_sample_head.hu > -300] > 700]
    assert np.ptp(bone[bone[:, 2] > 72][:, 0]) < 60 < np.ptp(bone[bone[:, 2] < 40][:, 0])  # the vault narrows upwards


def test_axes_are_those_of_a_dicom_series(a_sample_head):
    assert (np.diag(a_sample_head.ijk_to_ras)[:3] * (-1, -1, 1) > 0).all()
    assert a_sample_head.hu.dtype == np.int16
    assert -1024 <= a_sample_head.hu.min() < -900
    assert a_sample_head.hu.max() > 1500
