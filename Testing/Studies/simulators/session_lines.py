"""Simulated A-lines of palpation sessions as they go: the hand comes down, searches the perpendicular, holds, lifts.

The other families are drawn to be hard, and their lines hardly follow each other. Here they do: within a place the bone stays
where it is while its echo brightens and fades with the hand's tilt, layers keep their own orientation, what belongs to the probe
stands still in every line, and air, hair and holes in the bone look as they do on a head. Pulses are filtered by the attenuation
of their way in the spectrum. What a session is drawn from is in session_plan.py.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import scipy.fft
from CranioNavLib.recording import Recording

from Testing.Studies.simulators.line_truth import Truth
from Testing.Studies.simulators.session_plan import (
    BONE_R,
    DEPTH_MM,
    Array,
    Bools,
    Session,
    Way,
    draw_poses,
    draw_session,
    draw_way,
    response,
)

NEPER = np.log(10) / 20  # a decibel
FINE, CYCLES, BEFORE = 64, 32, 12  # points a cycle of a tabulated pulse, its length, and where its time zero is
PATHS_MM = np.linspace(0, 30, 13)  # depths for which the pulse is tabulated
SKULL_US_MM = 2 / 3.0  # there and back in bone
FAINT_DB = -60.0
LEAST_CODES = 0.5  # standard deviation of the noise: a converter that shows less shows no noise at all
RUNGS = 6  # of the ladder that a film of gel shows
HARD_SHARE = 0.2  # of the lines with bone: of which nobody could say where the bone is
CLEAR_DB, HEARD_DB = 3.0, 8.0  # over all before it, over the noise: what an expert asks of bone
SPECKLE_PEAK = 2.5  # its largest echoes over their RMS
NEAR_LINES = 4  # neighbours that tell where bone is
VISIBLE_DB = 6.0  # speckle over the noise, where it goes on behind the depth of the bone
SHOWN_MM = 3.0  # so far behind
MOST_SPECKLE_DB = -20.0


class Pulse:
    """The transmitted pulse after ways through tissue, tabulated from its spectrum; the envelope's height is 1 at the surface."""

    def __init__(self, session: Session) -> None:
        self.session, megahertz = session, session.centre_mhz
        self.step_us = 1 / (megahertz * FINE)
        time = (np.arange(FINE * CYCLES) - FINE * BEFORE) * self.step_us
        envelope, self.early = self._envelope(time)
        self.frequency = np.fft.fftfreq(len(time), self.step_us)
        spectrum = np.fft.fft(envelope * np.exp(2j * np.pi * megahertz * time + 1j * session.phase))
        half = session.acquisition.sampling_hz * 5e-7
        edge = np.clip((half - self.frequency) / (0.15 * half), 0, 1)  # the converter's filter; no transducer sends a constant
        spectrum *= np.where(self.frequency > 0, edge**2 * (3 - 2 * edge), 0) * -np.expm1(
            -((self.frequency / (0.3 * megahertz)) ** 2)
        )
        lost = np.exp(-0.2 * NEPER * session.attenuation * np.outer(PATHS_MM, np.maximum(self.frequency, 0)))
        table = np.fft.ifft(spectrum * lost, axis=1)
        peak = np.abs(table).max(axis=1)
        self.height = np.log(peak / peak[0])
        self.table = (table.real / peak[:, None]).astype(np.float32)
        self.density = np.abs(spectrum)
        high = np.flatnonzero((np.abs(table[[0, -1]]) > 2e-3 * peak[[0, -1], None]).any(axis=0))
        self.first, self.last = int(high[0]), int(high[-1])
        wide = np.flatnonzero(np.abs(table[0]) > 0.35 * peak[0])
        self.wide_us = float(wide[-1] - wide[0]) * self.step_us  # echoes nearer than this run into each other

    def _envelope(self, time_us: Array) -> tuple[Array, float]:
        """The envelope, and by how much its peak comes after time zero."""
        band = self.session.bandwidth * self.session.centre_mhz
        if self.session.pulse == "gauss":
            return np.exp(-0.5 * (2 * np.pi * band / np.sqrt(8 * np.log(2)) * time_us) ** 2), 0.0
        order = self.session.order
        tau = np.sqrt(2 ** (2 / (order + 1)) - 1) / (np.pi * band)
        late = 0.0 if self.session.onset else order * tau
        at = np.maximum(time_us + late, 0) / (order * tau)
        return at**order * np.exp(order * (1 - at)), order * tau - late

    def loss(self, path_mm: npt.ArrayLike) -> Array:
        """What attenuation leaves of the height of an echo from a depth."""
        return np.asarray(np.exp(np.interp(path_mm, PATHS_MM, self.height)))


class Sheet:
    """The lines of a recording under way."""

    def __init__(self, pulse: Pulse, late_us: Array, samples: int) -> None:
        self.pulse, self.late_us = pulse, late_us  # how late each line starts
        self.mhz = pulse.session.acquisition.sampling_hz * 1e-6
        self.rf = np.zeros((len(late_us), samples), dtype=np.float32)
        self.parts: list[Array] = []

    def add(self, time_us: npt.ArrayLike, height: npt.ArrayLike, path_mm: npt.ArrayLike = 0.0) -> None:
        """One echo in every line: when, its height before attenuation, how deep it has been; each (n,) or one for all."""
        rows = np.arange(len(self.rf))
        self.parts.append(np.stack([x.astype(float) for x in np.broadcast_arrays(rows, time_us, height, path_mm)]))

    def draw(self, least: float) -> None:
        """Put the echoes that are higher than `least` into the lines."""
        pulse, count = self.pulse, self.rf.shape[1]
        row, time, high, path = np.concatenate(self.parts, axis=1)
        high = high * pulse.loss(path)
        use = np.isfinite(time) & (np.abs(high) > least)
        row, time, high, path = row[use].astype(np.int64), (time + self.late_us[row.astype(np.int64)])[use], high[use], path[use]
        offset = pulse.first - FINE * BEFORE
        start = np.ceil((time + offset * pulse.step_us) * self.mhz).astype(np.int64)
        index = start[:, None] + np.arange(int((pulse.last - pulse.first) * pulse.step_us * self.mhz))
        point = (index / self.mhz - time[:, None]) * (1 / pulse.step_us) + (FINE * BEFORE + 0.5)
        which = np.minimum(np.rint(path / PATHS_MM[1]), len(PATHS_MM) - 1).astype(np.int64)
        flat_point = which[:, None] * pulse.table.shape[1] + np.clip(point, 0, pulse.table.shape[1] - 1).astype(np.int64)
        wave = pulse.table.ravel()[flat_point] * high[:, None]
        inside = (index >= 0) & (index < count)
        self.rf += np.bincount((row[:, None] * count + index)[inside], wave[inside], self.rf.size).reshape(self.rf.shape)

    def add_speckle(
        self, rng: np.random.Generator, way: Way, skin_us: Array, end_mm: Array, level: float, start_mm: Array | float = 0.0
    ) -> None:
        """What scatters from `start_mm` to `end_mm` (n,) behind the skin of each line."""
        session, per_us = self.pulse.session, self.pulse.session.speed_m_s * 5e-4
        skin_us = skin_us + self.late_us
        first = max(int(skin_us.min() * self.mhz), 0)
        last = min(int((skin_us + np.maximum(end_mm, 0) / per_us).max() * self.mhz) + 2, self.rf.shape[1])
        if last - first < 16 or not (end_mm > 0).any():
            return
        size = scipy.fft.next_fast_len(last - first, real=True)
        frequency = np.arange(size // 2 + 1) * self.mhz / size
        half = len(self.pulse.frequency) // 2
        density = np.interp(frequency, self.pulse.frequency[:half], self.pulse.density[:half])
        some = np.flatnonzero(density > 3e-3 * density.max())
        field = _follow(rng, way.place, (len(self.rf), 2 * len(some)), session.speckle_keeps)
        spectrum = np.zeros((len(self.rf), len(frequency)), dtype=np.complex64)
        knots = np.linspace(0, min(float(end_mm.max()), 20.0), 3)
        depth = (np.arange(first, last) / self.mhz - skin_us.mean()) * per_us
        total = np.zeros((len(self.rf), last - first), dtype=np.float32)
        for number, knot in enumerate(knots):
            shape = density[some] * np.exp(-0.2 * NEPER * session.attenuation * knot * frequency[some])
            spectrum[:, some] = field.view(np.complex64) * (shape * size / (2 * np.linalg.norm(shape))).astype(np.float32)
            share = (np.interp(depth, knots, np.eye(3)[number]) * self.pulse.loss(depth)).astype(np.float32)
            total += scipy.fft.irfft(spectrum, size, axis=1)[:, : last - first] * share
        index = np.arange(first, last)
        ends = (skin_us + np.maximum(end_mm, 0) / per_us) * self.mhz
        starts = (skin_us + start_mm / per_us) * self.mhz
        total *= (index > starts[:, None]) & (index < ends[:, None])
        self.rf[:, first:last] += total * (level / np.sqrt(2) * way.coupling).astype(np.float32)[:, None]


def _follow(
    rng: np.random.Generator, place: npt.NDArray[np.int64], shape: tuple[int, int], keeps: float
) -> npt.NDArray[np.float32]:
    """Normal numbers whose rows are like the row before, while the place is the same."""
    out = rng.standard_normal(shape, dtype=np.float32)
    fresh = np.float32(np.sqrt(1 - keeps**2))
    for row in np.flatnonzero(np.diff(place) == 0) + 1:
        out[row] *= fresh
        out[row] += np.float32(keeps) * out[row - 1]
    return out


def simulate(rng: np.random.Generator, frames: int, session: Session | None = None) -> tuple[Recording, Truth, Session]:
    """A recording of `frames` lines, and the truth about it."""
    session = session or draw_session(rng)
    pulse = Pulse(session)
    way, bone, noise, skin_us = _plan(session, pulse, rng, frames)
    reach = float(way.depth_mm.max()) + session.behind_mm
    samples = int((float(skin_us.max()) + reach * 2e3 / session.speed_m_s) * session.acquisition.sampling_hz * 1e-6) + 8
    sheet = Sheet(pulse, rng.uniform(-1e-3, 1e-3, frames) * session.jitter_ns, samples)
    arrival = skin_us + way.depth_mm * 2e3 / session.speed_m_s
    speckle, kind = _speckle(session, pulse, way, noise)
    tissue = (kind == "tissue") & (way.contact > 0)
    end = np.where(np.isfinite(bone) & (way.contact > 0), way.depth_mm, np.where(tissue, 99.0, 0.0))
    sheet.add_speckle(rng, way, skin_us, end, speckle)
    if session.diploe_db > FAINT_DB:
        inner = np.where(np.isfinite(bone), way.depth_mm + SKULL_US_MM * session.skull_mm * session.speed_m_s / 2e3, 0.0)
        sheet.add_speckle(rng, way, skin_us, inner, 10 ** (session.diploe_db / 20), way.depth_mm)
    for number in range(4):
        height = np.where(kind == "nothing", 0.0, way.layers[:, number] * way.coupling)
        sheet.add(skin_us + way.layers_mm[:, number] * 2e3 / session.speed_m_s, height, np.nan_to_num(way.layers_mm[:, number]))
    _bone(sheet, way, skin_us, arrival, np.nan_to_num(bone))
    _film(sheet, way, skin_us)
    _probe(sheet, way, skin_us, noise * 10 ** (session.snr_db / 20))
    sheet.draw(0.03 * noise)
    sheet.rf += _bang(session, samples)
    recording = Recording(
        lines=_receive(rng, session, sheet.rf, noise, float(skin_us.max())),
        acquisition=session.acquisition,
        probe_to_reference=draw_poses(session, rng, way),
        statuses=("OK",) * frames,
        timestamps_s=np.arange(frames) / float(rng.uniform(10, 60)),
        palpation_points=np.where(session.numbered, way.place, -1),
    )
    with np.errstate(divide="ignore"):
        snr = np.nan_to_num(20 * np.log10(np.abs(bone) * pulse.loss(way.depth_mm) / noise), nan=-np.inf, neginf=-np.inf)
    return recording, Truth(np.where(np.isfinite(bone), way.depth_mm, np.nan), way.angle_deg, session.speed_m_s, snr), session


def _plan(session: Session, pulse: Pulse, rng: np.random.Generator, frames: int) -> tuple[Way, Array, float, Array]:
    """The way, the echo of bone before attenuation (n,) (NaN: none), the noise, and when the skin answers (n,).

    Few of the lines may be such that nobody could say: until then the hand tries again, and tilts less.
    """
    nominal = 2e3 * session.acquisition.forerun_length_mm / (session.acquisition.forerun_speed_m_s or 1.0)
    plans = []
    for attempt in range(15):
        way = draw_way(session, rng, frames, 1 + 0.25 * attempt)
        strength = response(way.angle_deg, session.lobe_deg, session.floor_db) * way.coupling
        strength = strength * 10 ** (rng.uniform(-1, 1, frames) / 20)
        bone = np.where((way.kind == "bone") & (way.contact > 0), strength, np.nan)
        noise = float(pulse.loss(np.median(way.depth_mm)) * 10 ** (-session.snr_db / 20))
        if session.without == "tissue":  # no bone tells the noise, but one sees the tissue
            noise = min(noise, 10 ** (session.speckle_db / 20) / _needed(pulse, way, 1.0))
        skin_us = nominal * session.late * (1 + session.warming * np.linspace(0, 1, frames))
        share = float(undecided(session, pulse, way, bone, noise, skin_us).sum() / max(np.isfinite(bone).sum(), 1))
        plans.append((share, attempt, way, bone, noise, skin_us))
        if share < HARD_SHARE:
            break
    return min(plans, key=lambda plan: plan[:2])[2:]


def undecided(session: Session, pulse: Pulse, way: Way, bone: Array, noise: float, skin_us: Array) -> Bools:
    """Lines with bone of which an expert could not say where it is (n,)."""
    arrival = skin_us + way.depth_mm * 2e3 / session.speed_m_s
    received = np.nan_to_num(bone) * pulse.loss(way.depth_mm)
    faint = received < noise * 10 ** (HEARD_DB / 20)
    over = _bang_envelope(session, arrival) > 0.5 * received
    for time, height in _probe_echoes(session, way, skin_us, noise * 10 ** (session.snr_db / 20)):
        over |= (np.abs(time - arrival) < pulse.wide_us) & (np.abs(height) > 0.5 * received)
    above = np.where(way.layers_mm < way.depth_mm[:, None], np.abs(way.layers), 0.0).max(axis=1)
    above = np.maximum(above, SPECKLE_PEAK * 10 ** (session.speckle_db / 20)) * way.coupling
    clear = ~faint & ~over & (np.nan_to_num(bone) > above * 10 ** (CLEAR_DB / 20))
    index = np.arange(len(bone))
    near = (np.abs(index - index[:, None]) <= NEAR_LINES) & (way.place == way.place[:, None])
    return np.isfinite(bone) & (faint | over | ~(near & clear).any(axis=1))


def _needed(pulse: Pulse, way: Way, noise: float) -> float:
    """Level of speckle that one sees to go on behind the bone's depth."""
    return float(np.sqrt(2) * noise * 10 ** (VISIBLE_DB / 20) / pulse.loss(np.median(way.depth_mm) + SHOWN_MM))


def _speckle(session: Session, pulse: Pulse, way: Way, noise: float) -> tuple[float, npt.NDArray[np.str_]]:
    """Level of the speckle, and what lies under each line: tissue without bone that nobody could see is nothing."""
    level = 10 ** (session.speckle_db / 20)
    if not (way.kind == "tissue").any():
        return level, way.kind
    needed = _needed(pulse, way, noise)
    if needed > 10 ** (MOST_SPECKLE_DB / 20):
        return level, np.where(way.kind == "tissue", "nothing", way.kind)
    return max(level, needed), way.kind


def _bone(sheet: Sheet, way: Way, skin_us: Array, arrival: Array, height: Array) -> None:
    """Bone, its inner table, and what goes the way again from the face or within the delay line."""
    session = sheet.pulse.session
    sheet.add(arrival, height, way.depth_mm)
    sheet.add(arrival + SKULL_US_MM * session.skull_mm, -height * 10 ** (session.inner_db / 20), way.depth_mm)
    sheet.add(2 * arrival - skin_us, -height * 10 ** (session.again_db / 20), 2 * way.depth_mm)
    if session.acquisition.forerun_length_mm:
        sheet.add(arrival + skin_us, 2 * height * session.face_r * session.back, way.depth_mm)


def _film(sheet: Sheet, way: Way, skin_us: Array) -> None:
    """A thin film of gel sends sound to and fro between the air behind it and the probe's face: a ladder of echoes."""
    if np.isnan(way.film_mm).all():
        return
    once = np.nan_to_num(way.film_mm)
    height = np.where(once > 0, -way.coupling / BONE_R, 0.0)
    for rung in range(1, RUNGS + 1):
        sheet.add(skin_us + rung * once * 2e3 / sheet.pulse.session.speed_m_s, height, np.zeros_like(once))
        height = height * way.film_r


def _probe_echoes(session: Session, way: Way, skin_us: Array, typical: float) -> list[tuple[Array, Array]]:
    """What belongs to the probe, as times and heights (n,): the delay line's face, its multiples and trail; constant echoes."""
    echoes = []
    nominal = 2e3 * session.acquisition.forerun_length_mm / (session.acquisition.forerun_speed_m_s or 1.0)
    if nominal:
        reflection = session.face_r + (-1.0 - session.face_r) * (1 - way.coupling)
        face = reflection / (BONE_R * (1 - session.face_r**2))
        for number in range(6):
            echoes.append(((number + 1) * skin_us, face * (reflection * session.back) ** number))
        for after, level in session.trail:
            echoes.append((skin_us + after, face * 10 ** (level / 20)))
    for far, level, moves in session.static:
        time = (skin_us if moves else np.full(len(skin_us), nominal)) + far * 2e3 / session.speed_m_s
        echoes.append((time, np.full(len(skin_us), typical * 10 ** (level / 20))))
    return echoes


def _probe(sheet: Sheet, way: Way, skin_us: Array, typical: float) -> None:
    for time, height in _probe_echoes(sheet.pulse.session, way, skin_us, typical):
        sheet.add(time, height)


def _bang_envelope(session: Session, time_us: Array) -> Array:
    """The ring-down of the main bang."""
    tau = session.bang_us / (NEPER * (session.bang_db + 40))
    return np.asarray(10 ** (session.bang_db / 20) * np.exp(-np.maximum(time_us, 0) / tau))


def _bang(session: Session, samples: int) -> Array:
    """The main bang and its ring-down, the same in every line: two modes of the transducer."""
    time = np.arange(samples) / session.acquisition.sampling_hz * 1e6
    turns = 2 * np.pi * session.centre_mhz * time
    rings = 0.7 * np.cos(turns + session.phase) + 0.3 * np.cos(0.83 * turns + 2 * session.phase)
    return np.asarray(_bang_envelope(session, time) * rings)


def _receive(rng: np.random.Generator, session: Session, rf: Array, noise: float, skin_us: float) -> npt.NDArray[np.int16]:
    """Noise, hum, drift, spikes, and codes."""
    sampling = session.acquisition.sampling_hz * 1e-6
    frames, samples = rf.shape
    if session.noise_band and session.noise_band * session.centre_mhz < 0.5 * sampling:
        size = scipy.fft.next_fast_len(samples, real=True)
        some = int(session.noise_band * session.centre_mhz * size / sampling)
        spectrum = rng.standard_normal((frames, 2 * some), dtype=np.float32).view(np.complex64)
        white = scipy.fft.irfft(spectrum * np.float32(0.5 * size / np.sqrt(some)), size, axis=1)[:, :samples]
    else:
        white = rng.standard_normal(rf.shape, dtype=np.float32)
    rf = rf + white * np.float32(noise)
    time = (np.arange(samples) / samples).astype(np.float32)
    if session.hum:
        phase = rng.uniform(0, 2 * np.pi, (frames, 1)).astype(np.float32)
        rf += np.float32(session.hum * noise) * np.sin(phase + np.float32(rng.uniform(0.6, 9)) * time)
    if session.drift:
        rf += session.drift * noise * (np.exp(-time * 6) + rng.normal(0, 0.3, (frames, 1)).astype(np.float32))
    count = rng.poisson(session.spikes * frames)
    rf[rng.integers(frames, size=count), rng.integers(samples, size=count)] += rng.normal(0, 25 * noise, count)
    codes = 2 ** (session.bits - 1) - 1
    start = min(int((skin_us + 2e3 * DEPTH_MM[0] / session.speed_m_s) * sampling), samples // 2)
    largest = float(np.percentile(np.abs(rf[:, start:]).max(axis=1), 80))
    unrest = 1.5 * noise * (4 + session.hum + 1.6 * session.drift)  # echoes clip; what is below them does not
    scale = max(codes / max(largest / session.fill, unrest), LEAST_CODES / noise)
    return np.asarray(np.clip(np.rint(rf * scale), -codes - 1, codes), dtype=np.int16)
