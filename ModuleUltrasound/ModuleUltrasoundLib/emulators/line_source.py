"""Where an emulated device's lines come from: a recording, raw converter codes, or the virtual patient."""

from __future__ import annotations

from pathlib import Path
from typing import Optional, Protocol

import numpy as np
import numpy.typing as npt
from CranioNavLib.errors import InputError
from CranioNavLib.rigid import Array
from CranioNavLib.sequence_metafile import Acquisition, Recording

REFERENCE_GAIN_DB = 30.0  # at this gain a device gives its source's lines as they are


class LineSource(Protocol):
    """Lines one after the other, for ever. Sample 0 is the transmit pulse."""

    @property
    def acquisition(self) -> Acquisition:
        """How the lines are sampled."""

    def next_line(self) -> npt.NDArray[np.int16]:
        """The next line (N,)."""


class RecordedLines:
    """The lines of a recording, in a loop."""

    def __init__(self, recording: Recording) -> None:
        if len(recording) == 0 or recording.lines.shape[1] == 0:
            raise InputError("the recording holds no A-lines to play; give one of an A-mode device")
        self._recording, self._next = recording, 0

    @property
    def acquisition(self) -> Acquisition:
        """As in the recording."""
        return self._recording.acquisition

    def next_line(self) -> npt.NDArray[np.int16]:
        """The next line, the first again after the last."""
        line: npt.NDArray[np.int16] = self._recording.lines[self._next]
        self._next = (self._next + 1) % len(self._recording)
        return line


class RawCodes:
    """Whole buffers of a pic0rick's converter (F, 8000), codes 0..1023, in a loop."""

    def __init__(self, codes: npt.ArrayLike, sampling_hz: float = 60e6) -> None:
        self.codes = np.asarray(codes, dtype=np.int64)
        self.sampling_hz = sampling_hz
        self._next = 0

    def next_codes(self) -> npt.NDArray[np.int64]:
        """The next buffer, the first again after the last."""
        codes: npt.NDArray[np.int64] = self.codes[self._next]
        self._next = (self._next + 1) % len(self.codes)
        return codes


class PatientLines:
    """Lines of the virtual patient while a probe wanders over the 18 points of the protocol."""

    DWELL_LINES = 60
    TILT_SD_DEG = 1.5

    def __init__(self, seed: int = 0) -> None:
        from CranioNavLib.phantom import make_patient

        from ModuleUltrasoundLib.palpation.protocol import plan_protocol

        self._patient = make_patient(None, seed)
        self._rng = np.random.default_rng(seed)
        self._plan = plan_protocol(self._patient.bone, self._patient.landmarks_ras_mm, self._patient.landmark_labels)
        self._count = 0
        self._queue: list[npt.NDArray[np.int16]] = []

    @property
    def acquisition(self) -> Acquisition:
        """As the patient's probe has it."""
        acquisition: Acquisition = self._patient.acquisition
        return acquisition

    def next_line(self) -> npt.NDArray[np.int16]:
        """A line of the point that the probe dwells on."""
        if not self._queue:
            point = (self._count // self.DWELL_LINES) % len(self._plan)
            poses = np.array([self._pose(point) for _ in range(10)])
            self._queue = list(self._patient.rf_lines(poses, self._rng))
            self._count += 10
        return self._queue.pop(0)

    def _pose(self, point: int) -> Array:
        """ProbeToReference with the probe's face on the skin over a point, a little off the normal."""
        from CranioNavLib.rigid import invert_rigid, rigid

        normal = self._plan.normals[point] + np.tan(np.radians(self.TILT_SD_DEG)) * self._rng.standard_normal(3)
        z = -normal / np.linalg.norm(normal)
        x = np.cross([0.0, 0.0, 1.0] if abs(z[2]) < 0.9 else [1.0, 0.0, 0.0], z)
        x /= np.linalg.norm(x)
        bone = self._plan.positions_ras_mm[point]
        outside = bone - 60.0 * z
        skin = self._patient.skin.cast(outside[None], z[None]).distances_mm[0]
        face = outside + z * (skin if np.isfinite(skin) else 54.0)
        face -= z * self._patient.acquisition.forerun_length_mm
        probe_to_ras = rigid(np.column_stack([x, np.cross(z, x), z]), face)
        pose: Array = invert_rigid(self._patient.true_reference_to_ras) @ probe_to_ras
        return pose


def open_source(replay: Optional[Path], seed: int = 0) -> LineSource | RawCodes:
    """Lines of a recording (.igs.mha), of raw converter codes (.npz with `codes`), or of the virtual patient."""
    if replay is None:
        return PatientLines(seed)
    if Path(replay).suffix == ".npz":
        with np.load(replay) as stored:
            if "codes" not in stored:
                raise InputError(f"{replay} holds no array 'codes'; give an .igs.mha recording or converter codes")
            rate = float(stored["sampling_frequency_hz"].flat[0]) if "sampling_frequency_hz" in stored else 60e6
            return RawCodes(stored["codes"], rate)
    from CranioNavLib.sequence_metafile import read_recording

    return RecordedLines(read_recording(replay))
