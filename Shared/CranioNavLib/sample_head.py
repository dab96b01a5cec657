"""The sample head: a real head CT that Debian ships (package invesalius-examples), fetched once and cached.

The project file Cranium.inv3 is a gzipped tar with `matrix.dat` (int16, 108 x 256 x 256) and `main.plist`.
What is cached is `matrix.dat` alone; it is taken for whole only when its SHA-256 is right.
"""

from __future__ import annotations

import hashlib
import os
import plistlib
import shutil
import subprocess
import tarfile
import tempfile
from pathlib import Path

import numpy as np

from CranioNavLib.errors import InputError
from CranioNavLib.files import output_folder, written_whole
from CranioNavLib.volume import Volume

PACKAGE = "invesalius-examples"
INSTALLED = Path("/usr/share/doc/invesalius-examples/examples/Cranium.inv3")
SHAPE = (108, 256, 256)  # slices, rows, columns; main.plist: matrix/shape
SPACING_MM = (0.957031, 0.957031, 1.5)  # column, row, slice; main.plist: spacing
SHA256 = "d87fd5e6aaf2c4fdf4f3fe28ee3335192fc2464ed8e9682fc78530cb837938da"  # of matrix.dat, 3.1.99998-4
FETCH_TIMEOUT_S = 300.0  # 19 MB
HOW_TO_GET = "install it with `apt install invesalius-examples`, or give a CT of your own, or use the synthetic head"


def cache_folder() -> Path:
    """$XDG_CACHE_HOME/cranionav, or ~/.cache/cranionav."""
    base = os.environ.get("XDG_CACHE_HOME", "")
    return (Path(base) if base else Path.home() / ".cache") / "cranionav"


def cached_sample_head() -> Path | None:
    """The cached matrix file if it is there and whole, else None."""
    path = cache_folder() / "sample-head.int16"
    expected = int(np.prod(SHAPE)) * 2
    if not path.is_file() or path.stat().st_size != expected:
        return None
    return path if hashlib.sha256(path.read_bytes()).hexdigest() == SHA256 else None


def fetch_sample_head() -> Path:
    """Path of the cached sample head; fetched with apt (no root needed) if it is not there yet.

    Raises
    ------
    InputError
        Neither the cache nor an installed package has it, and apt cannot bring it; says how to get it.
    """
    cached = cached_sample_head()
    if cached is not None:
        return cached
    folder = output_folder(cache_folder())
    if INSTALLED.is_file():
        return _store(INSTALLED, folder)
    with tempfile.TemporaryDirectory(prefix="cranionav-") as work:
        return _store(_download(Path(work)), folder)


def load_sample_head() -> Volume:
    """The sample head in HU, with its place in RAS (origin at the middle of the volume).

    InVesalius keeps the axial DICOM image with its rows reversed: rows grow towards the front (the nose stands at
    a high row, which can be seen), slices upwards (seen too). Columns are assumed to be as DICOM has them, growing
    to the patient's left: nothing in the file says so, and a skull shows no side. Were it wrong, the head would be
    a mirror image of the person scanned, which no registration notices. Rows are turned back here, so that the
    volume has the axes of a DICOM series (left, posterior, superior).

    Raises
    ------
    InputError
        The sample head cannot be had; says how to get it.
    """
    raw = np.fromfile(fetch_sample_head(), dtype="<i2").reshape(SHAPE)
    hu = np.ascontiguousarray(raw[:, ::-1, :]).astype(np.int16)
    hu.setflags(write=False)
    steps = np.array(SPACING_MM) * (-1, -1, 1)
    ijk_to_ras = np.diag([*steps, 1.0])
    ijk_to_ras[:3, 3] = -steps * (np.array(SHAPE[::-1]) - 1) / 2
    return Volume(hu, ijk_to_ras, "sample head (Debian invesalius-examples, Cranium.inv3)")


def _store(project: Path, folder: Path) -> Path:
    """The matrix out of an .inv3 project, put into `folder` whole."""
    try:
        with tarfile.open(project) as archive:
            members = {Path(member.name).name: member for member in archive.getmembers() if member.isfile()}
            plist, matrix = (archive.extractfile(members[name]) for name in ("main.plist", "matrix.dat"))
            if plist is None or matrix is None:
                raise KeyError("matrix.dat")
            shape = tuple(plistlib.loads(plist.read())["matrix"]["shape"])
            content = matrix.read()
    except (tarfile.TarError, EOFError, OSError, KeyError, plistlib.InvalidFileException) as error:
        raise InputError(f"{project} is damaged ({type(error).__name__}: {error}); {HOW_TO_GET}") from None
    if shape != SHAPE or hashlib.sha256(content).hexdigest() != SHA256:
        raise InputError(f"{project} is not the head that CranioNav knows (shape {shape}); {HOW_TO_GET}")
    target = folder / "sample-head.int16"
    with written_whole(target) as temporary:
        temporary.write_bytes(content)
    return target


def _download(work: Path) -> Path:
    """Cranium.inv3, taken out of the package that apt downloads into `work`."""
    for tool in ("apt-get", "dpkg-deb"):
        if shutil.which(tool) is None:
            raise InputError(f"the sample head cannot be fetched: this machine has no {tool}; {HOW_TO_GET}")
    work.chmod(0o755)  # apt drops its rights to the user _apt and must reach the folder
    _run(["apt-get", "download", "-q", "-o", "APT::Sandbox::User=root", PACKAGE], work)
    packages = sorted(work.glob(f"{PACKAGE}_*.deb"))
    if not packages:
        raise InputError(f"apt-get download brought no {PACKAGE}; {HOW_TO_GET}")
    _run(["dpkg-deb", "-x", str(packages[-1]), "content"], work)
    found = sorted((work / "content").rglob("Cranium.inv3"))
    if not found:
        raise InputError(f"the package {packages[-1].name} holds no Cranium.inv3; {HOW_TO_GET}")
    return found[0]


def _run(command: list[str], folder: Path) -> None:
    try:
        done = subprocess.run(command, cwd=folder, capture_output=True, text=True, timeout=FETCH_TIMEOUT_S, check=False)
    except (OSError, subprocess.TimeoutExpired) as error:
        raise InputError(f"the sample head cannot be fetched: {command[0]} failed ({error}); {HOW_TO_GET}") from None
    if done.returncode != 0:
        said = (done.stderr.strip() or done.stdout.strip() or "no message").splitlines()[-1]
        raise InputError(
            f"the sample head cannot be fetched: `{' '.join(command[:2])}` says: {said}; "
            f"if apt does not know the package, run `apt-get update` as root; {HOW_TO_GET}"
        )


if __name__ == "__main__":  # what the set-up of a checkout calls
    import sys

    try:
        print(f"sample head: {fetch_sample_head()}")
    except InputError as missing:
        print(f"cranionav: {missing}", file=sys.stderr)
        sys.exit(2)
