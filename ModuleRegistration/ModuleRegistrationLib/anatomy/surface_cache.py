"""What was segmented once is kept: in memory, and in files of the cache folder, by the CT's content."""

from __future__ import annotations

import hashlib
import os
import zipfile
from collections import OrderedDict
from pathlib import Path
from typing import Optional

import numpy as np
from CranioNavLib.errors import InputError
from CranioNavLib.files import written_whole
from CranioNavLib.surface import Surface
from CranioNavLib.volume import Volume

from ModuleRegistrationLib.anatomy.segmentation import BoneSurfaces

IN_MEMORY = 2  # surfaces of a skull take about 50 MB
ON_DISK_BYTES = 1_000_000_000
ALGORITHM = 2  # raised whenever a segmentation gives another result: older files are not used any more

_memory: OrderedDict[str, BoneSurfaces] = OrderedDict()


def cache_folder() -> Path:
    """Where CranioNav keeps what it can make again: `$XDG_CACHE_HOME/cranionav` or `~/.cache/cranionav`."""
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "cranionav"


def content_key(volume: Volume, *what: str) -> str:
    """SHA-256 of a volume's voxels and place, and of what was done with them."""
    digest = hashlib.sha256(np.ascontiguousarray(volume.hu).data)
    digest.update(np.ascontiguousarray(volume.ijk_to_ras, dtype="<f8").tobytes())
    digest.update("\n".join((str(volume.hu.shape), str(ALGORITHM), *what)).encode())
    return digest.hexdigest()


def load(key: str) -> Optional[BoneSurfaces]:
    """What is kept under `key`, or None; a damaged file counts as nothing kept."""
    if key in _memory:
        _memory.move_to_end(key)
        return _memory[key]
    path = _path(key)
    try:
        with np.load(path) as file:
            surfaces = BoneSurfaces(
                closed=Surface(file["closed_vertices"].astype(float), file["closed_triangles"].astype(np.int64)),
                outer_table=Surface(file["outer_vertices"].astype(float), file["outer_triangles"].astype(np.int64)),
                threshold_hu=float(file["threshold_hu"]),
                position_sd_mm=float(file["position_sd_mm"]),
                offset_sd_mm=float(file["offset_sd_mm"]),
            )
        os.utime(path)
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile):
        return None
    _remember(key, surfaces)
    return surfaces


def save(key: str, surfaces: BoneSurfaces) -> None:
    """Keep `surfaces`; a cache folder that cannot be written to only costs time."""
    _remember(key, surfaces)
    path = _path(key)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with written_whole(path) as temporary:
            np.savez(
                temporary,
                closed_vertices=surfaces.closed.vertices_mm,
                closed_triangles=surfaces.closed.triangles.astype(np.int32),
                outer_vertices=surfaces.outer_table.vertices_mm,
                outer_triangles=surfaces.outer_table.triangles.astype(np.int32),
                threshold_hu=surfaces.threshold_hu,
                position_sd_mm=surfaces.position_sd_mm,
                offset_sd_mm=surfaces.offset_sd_mm,
            )
        _prune(path.parent)
    except (OSError, InputError):
        return


def forget() -> None:
    """Drop what is kept in memory."""
    _memory.clear()


def _path(key: str) -> Path:
    return cache_folder() / "bone" / f"{key}.npz"


def _remember(key: str, surfaces: BoneSurfaces) -> None:
    _memory[key] = surfaces
    _memory.move_to_end(key)
    while len(_memory) > IN_MEMORY:
        _memory.popitem(last=False)


def _prune(folder: Path) -> None:
    """Remove the files used longest ago until the folder is within its bound."""
    files = sorted(((item.stat().st_mtime, item.stat().st_size, item) for item in folder.glob("*.npz")), reverse=True)
    total = 0
    for _, size, item in files:
        total += size
        if total > ON_DISK_BYTES:
            item.unlink(missing_ok=True)
