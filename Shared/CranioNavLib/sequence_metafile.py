"""A-mode recordings and pose recordings as PLUS/IGSIO sequence metafiles (.igs.mha).

One RF line a frame (`DimSize = N 1 F`, MET_SHORT), with pose, status and time as text fields of each frame.
"""

from __future__ import annotations

from CranioNavLib.metafile_reader import read_recording
from CranioNavLib.metafile_recovery import put_aside, recover
from CranioNavLib.metafile_writer import RecordingWriter, write_recording
from CranioNavLib.recording import Acquisition, Recording, pixels_beside

__all__ = [
    "Acquisition",
    "Recording",
    "RecordingWriter",
    "pixels_beside",
    "put_aside",
    "read_recording",
    "recover",
    "write_recording",
]
