"""The probe step: lines with the probe's pose, what the last of them say of the depth, where the probe has to go."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Optional

import numpy as np
import numpy.typing as npt
from CranioNavLib import scene, scene_data
from CranioNavLib.errors import InputError
from CranioNavLib.panel import Level, Reading, StepStatus
from CranioNavLib.rigid import Array
from CranioNavLib.scene_guidance import get_guidance

from ModuleUltrasoundLib.devices.device import AModeDevice
from ModuleUltrasoundLib.devices.line_batches import LineBatch, LineBatches
from ModuleUltrasoundLib.devices.line_stream import LinePoser, LineStream, PosedLine
from ModuleUltrasoundLib.devices.linked_device import LinkedDevice
from ModuleUltrasoundLib.live_drawings import a_line, bulls_eye, draw_a_line, draw_bulls_eye
from ModuleUltrasoundLib.logic.planning import ProtocolStep

if TYPE_CHECKING:
    from CranioNavLib.surface import Surface

    from ModuleUltrasoundLib.measurement.measure import LineMeasurements
    from ModuleUltrasoundLib.palpation.guidance import Guide
    from ModuleUltrasoundLib.palpation.palpation import PalpationLine


class ProbeStep(ProtocolStep):
    """Live lines and guidance."""

    def __init__(self, parent: Any = None) -> None:
        super().__init__(parent)
        self.latest: Optional[PosedLine] = None  # the last one that came
        self.measured: Optional[LineMeasurements] = None  # what the last batch of lines says
        self.poser: Optional[LinePoser] = None
        self._observation: Optional[scene.Observation] = None
        self._batches = LineBatches()
        self._waiting: list[LineBatch] = []  # to be measured
        self._shown: Optional[PosedLine] = None  # the last line measured
        self._gain_db: Optional[float] = None  # as last set on the device
        self._guide: Optional[Guide] = None  # where the probe stands to the current point
        self._surface: tuple[int, Optional[Surface]] = (0, None)  # time stamp of the mesh; its index is worth keeping

    def connect(self) -> str:
        """Begin to take lines from the device that the parameters name. Returns a message."""
        device = self.createPlugin("amode", self.parameters().read().device)
        self.failure, self.poser = "", LinePoser()
        self._gain_db = getattr(device.settings, "gain_db", None)
        self._observation = scene.observe("ProbeToReference", self._takePose)
        self.stream = LineStream(device)
        self.stream.start()
        return str(device.title)

    def disconnect(self) -> None:
        """Let go of the device."""
        if self._observation is not None:
            self._observation.stop()
        if self.stream is not None:
            self.stream.stop()
        self.stream = self.poser = self._observation = self.measured = self._guide = self.latest = self._shown = None
        self.measureAnew()

    def measureAnew(self) -> None:
        """Lines that came so far say nothing of those to come."""
        self._batches, self._waiting = LineBatches(), []

    def takeLines(self) -> list[PosedLine]:
        """The lines whose pose is known by now, since the last call.

        Raises
        ------
        InputError
            The device refuses its settings; it is let go of.
        """
        try:
            lines = self.running.poll()
        except InputError as error:
            self.disconnect()
            self.failure = str(error)
            raise
        assert self.poser is not None  # there is one while there is a stream
        for line in lines:
            self.poser.add_line(line, self.indexAt(line.host_time_s))
        posed = self.poser.ready()
        if posed:
            self.latest = posed[-1]
        self._waiting += self._batches.add(posed)
        return posed

    def _takePose(self, node: Any) -> None:
        pose = scene_data.get_pose("ProbeToReference")
        if pose.host_time_s == pose.host_time_s and self.poser is not None:
            self.poser.add_pose(pose.matrix, pose.status, pose.host_time_s)

    def measureLive(self) -> list[PalpationLine]:
        """A few times a second: the last line as a table, and what each line since the last time says."""
        from ModuleUltrasoundLib.devices.line_stream import recording_of
        from ModuleUltrasoundLib.measurement.measure import measure_lines
        from ModuleUltrasoundLib.palpation.palpation import lines_of

        batches, self._waiting = self._waiting, []
        lines: list[PalpationLine] = []
        for batch in batches:
            recording = recording_of(batch.lines, self.running.acquisition)
            self.measured = measure_lines(recording, self.parameters().read().echo_settings())
            lines += lines_of(self.measured, [item.line.host_time_s for item in batch.lines])[-batch.new :]
            self._shown = batch.lines[-1]
        if self._shown is not None and batches:
            self._followGain(self.running.device)
            samples = self._shown.line.samples
            times = 1e6 / self.running.acquisition.sampling_hz * np.arange(len(samples))
            scene_data.set_table("ALine", {"time (µs)": times.tolist(), "amplitude": samples.tolist()})
        return lines

    def _followGain(self, device: AModeDevice) -> None:
        """A gain that the user changes while the device runs is set on it; all else counts from the next connection."""
        gain_db = getattr(self.pluginSettings("amode", device.name).read(), "gain_db", None)
        if isinstance(device, LinkedDevice) and gain_db is not None and gain_db != self._gain_db:
            device.set_gain_db(gain_db)
            self._gain_db = gain_db

    def steer(self) -> None:
        """Where the probe stands to the bone it has to see, under the registration that guidance rests on."""
        from ModuleUltrasoundLib.palpation.guidance import guide

        pose, table, rests = scene_data.get_pose("ProbeToReference"), scene.find("OuterTable"), get_guidance()
        self._guide = None
        if pose.matrix is None or rests is None or table is None:
            return
        probe_to_ras, surface = rests.reference_to_ras @ pose.matrix, self._surfaceOf(table)
        aim = self.aimAt(probe_to_ras, surface)
        if aim is None:
            return
        self._guide = guide(probe_to_ras, surface, *aim, None if rests.error is None else rests.error[0][:3, :3])

    def aimAt(self, probe_to_ras: Array, surface: Surface) -> Optional[tuple[Array, Array]]:
        """Where the beam has to meet the bone, and its outward normal there (RAS); None without a point that is asked for."""
        index = self.currentIndex()
        if index < 0:
            return None
        positions, normals, _ = self.protocolPoints()
        return positions[index], normals[index]

    def _surfaceOf(self, table: Any) -> Surface:
        stamp, surface = self._surface
        if surface is None or stamp != table.GetPolyData().GetMTime():
            surface = scene_data.get_surface("OuterTable")
            self._surface = (table.GetPolyData().GetMTime(), surface)
        return surface

    # What the panel shows

    def live(self) -> Optional[tuple[npt.NDArray[np.int16], float, LineMeasurements]]:
        """For a drawing of the last line: its samples, rate in Hz, and what was measured; None without one."""
        if self._shown is None or self.measured is None:
            return None
        return self._shown.line.samples, self.running.acquisition.sampling_hz, self.measured

    def guide(self) -> Optional[Guide]:
        """Where the probe stands to the current point; None without a registration or a live probe."""
        return self._guide

    def aLine(self) -> Optional[str]:
        """A drawing of the last line with what was found in it; None without one."""
        line = a_line(self.live(), self.parameters().read().echo_settings())
        return draw_a_line(line) if line is not None else None

    def bullsEye(self) -> Optional[str]:
        """A drawing of the probe's tilt; None without a registration or a live probe."""
        eye = bulls_eye(self._guide, self.live())
        return draw_bulls_eye(eye) if eye is not None else None

    def connection(self) -> Reading:
        """Connected, or why not."""
        if self.stream is None:
            return self.whyNoConnection()
        state = self.stream.state
        return Reading(state.problem or f"{state.lines} lines", Level.GOOD if state.connected else Level.WARNING)

    def probePose(self) -> Reading:
        """Whether the scene has a live pose of the probe."""
        status = scene_data.get_pose("ProbeToReference").status
        return Reading("in view", Level.GOOD) if status == "OK" else Reading(f"not in view ({status.lower()})", Level.BAD)

    def depth(self) -> Optional[Reading]:
        """The bone's depth under the probe now; None while there is no trustworthy echo."""
        from ModuleUltrasoundLib.measurement.quality import reason_in_words

        if self.measured is None:
            return None
        if not self.measured.accepted[-1]:
            return Reading(reason_in_words(self.measured.reasons[-1]), Level.WARNING)
        return Reading(f"{self.measured.depths_mm[-1]:.1f}", Level.GOOD)

    def quality(self) -> Optional[Reading]:
        """Probability that the depth is right to half a millimetre."""
        if self.measured is None:
            return None
        value = float(self.measured.qualities[-1])
        good = value >= self.parameters().read().quality_gate
        return Reading(f"{value:.2f}", Level.GOOD if good else Level.WARNING)

    def guidance(self) -> Optional[Reading]:
        """What to do with the probe now."""
        if self._guide is None:
            return None
        return Reading(self._guide.instruction, Level.GOOD if self._guide.on_target and self._guide.aligned else Level.WARNING)

    def tilt(self) -> Optional[Reading]:
        """Angle between the beam and the bone's normal, and how well the normal is known under the registration."""
        if self._guide is None:
            return None
        known = f" ± {self._guide.angle_sd_deg:.0f}" if np.isfinite(self._guide.angle_sd_deg) else ""
        return Reading(f"{self._guide.angle_deg:.0f}{known}", Level.GOOD if self._guide.aligned else Level.WARNING)

    def deviceStatus(self) -> StepStatus:
        """Whether lines arrive."""
        return self.statusOfDevice()
