"""Where the real A-mode recordings are, if this computer has them."""

from __future__ import annotations

import os
import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parent))  # for what several test files share
from echo_logic import a_head, a_logic, a_recording_logic  # noqa: F401 (fixtures)


@pytest.fixture
def amode_recordings() -> Path:
    """Folder with the recordings of open-hardware boards; they may not be kept in this repository."""
    named = os.environ.get("CRANIONAV_AMODE_DATA")
    folder = Path(named) if named else Path(__file__).resolve().parents[4] / "shared" / "data" / "amode"
    if not (folder / "pic0rick-water-steel-steps.npz").is_file():
        pytest.skip(f"no recordings in {folder}; set CRANIONAV_AMODE_DATA to the folder with pic0rick-water-steel-steps.npz")
    return folder
