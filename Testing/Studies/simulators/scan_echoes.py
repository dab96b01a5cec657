"""What reflects in a hand-held scan: bone, layers, scatterers and a delay line, as trains of reflections on a fine grid of time.

Bone is a rough, curved surface under the whole footprint of a beam that diffracts. A layer is a few facets, tilted on their own.
scan_lines.py makes lines of them.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import scipy.fft

from Testing.Studies.simulators.scan_plan import GAP, USUAL_LINES, Array, Hand, Probe, Rows, Setup, draw_probe, smooth

Floats = npt.NDArray[np.float32]

FINE_MHZ = 100.0  # the reflections' grid has at least so many samples a microsecond
PULSE_SAMPLES = 8192  # of that grid
BONE_MM_US, TABLE_DB = 2.9, 5.0  # in bone: speed; loss, dB/cm/MHz
TEXTURE, TEXTURE_MM = 512, 0.1  # of the bone's surface: places a side, their distance
FACET = 0.4  # wavelengths
DIPLOE_US, DIPLOE_ENDS = 1.2, 7.0  # its scatter falls by e in; simulated for so many times as long


@dataclass(frozen=True, eq=False)
class Ground:
    """What all lines of a recording have under them."""

    bone_r: float
    thick_mm: Array  # (n,) of the tissue that the layers share
    shares: Array  # (m,) of that thickness: where the layers lie
    reflections: Array  # (m,)
    texture_mm: Floats  # (TEXTURE + 1, TEXTURE + 1) the bone's surface, which repeats
    radii_mm: Array  # (2,) of the bone's curvature
    table_mm: float  # outer table
    skull_mm: float
    diploe: float
    hole: tuple[float, float] | None  # where on the path, radius


@dataclass(frozen=True, eq=False)
class Pulse:
    """Spectrum of the pulse over a reflection's."""

    probe: Probe
    centre_mhz: float
    late_us: float = 0.0
    height: float = 1.0
    energy: float = 1.0  # RMS over white scatterers of height 1

    def spectrum(self, mhz: Array) -> npt.NDArray[np.complex128]:
        """At frequencies from 0 on; of a reflection at time zero."""
        probe = self.probe
        off = (mhz - self.centre_mhz) / (probe.bandwidth * self.centre_mhz / 2.355)
        shape = np.exp(-0.5 * off**2 + 1j * (probe.phase + 2 * np.pi * mhz * self.late_us)) / self.height
        return np.asarray(shape * (1 + probe.ring * np.exp(-2j * np.pi * mhz * probe.ring_us + 1j * probe.ring_phase)))


def _pulse_of(probe: Probe, centre_mhz: float, rate_mhz: float) -> Pulse:
    """Its envelope's peak is 1 and stands at time zero."""
    raw = Pulse(probe, centre_mhz)
    mhz = np.asarray(np.fft.rfftfreq(PULSE_SAMPLES, 1 / rate_mhz), dtype=float)
    spectrum = raw.spectrum(mhz)
    level = np.abs(np.fft.ifft(spectrum, PULSE_SAMPLES))
    top = int(level.argmax())
    left, middle, right = level[[top - 1, top, (top + 1) % PULSE_SAMPLES]]
    whole = (top + PULSE_SAMPLES // 2) % PULSE_SAMPLES - PULSE_SAMPLES // 2
    late = (whole + 0.5 * (left - right) / (left - 2 * middle + right)) / rate_mhz
    energy = np.linalg.norm(spectrum) / np.sqrt(2 * PULSE_SAMPLES) / middle
    # of a real reflection one half goes to the frequencies above zero
    return Pulse(probe, centre_mhz, float(late), 2 * float(middle), float(energy))


@dataclass(frozen=True, eq=False)
class Scene:
    """A recording's grid of time, and when the skin comes in it."""

    setup: Setup
    probe: Probe
    hand: Hand
    ground: Ground
    pulse: Pulse
    face_us: Array  # (n,)
    skin_us: Array  # (n,) with the trigger's jitter
    finer: int  # samples of the reflections' grid a sample of the line
    samples: int  # of the line
    span_mm: float

    @property
    def rate_mhz(self) -> float:
        """Of the reflections' grid."""
        return self.setup.sampling_mhz * self.finer

    @property
    def size(self) -> int:
        """Of the reflections' grid."""
        return self.samples * self.finer

    @property
    def entered(self) -> Array:
        """Height of an echo from the tissue (n,): what passes the face, there and back."""
        passed = 1 - self.probe.face_r**2 if self.probe.material else 1.0
        return np.asarray(self.hand.coupling * passed)

    @property
    def bone_us(self) -> Array:
        return np.asarray(self.skin_us + self.setup.echo_us(self.hand.depth_mm))


def draw_scene(rng: np.random.Generator, setup: Setup, hand: Hand) -> Scene:
    """The probe that an operator takes for this hand, and what lies under it."""
    deepest = float(hand.depth_mm.max())
    probe = draw_probe(rng, setup, deepest)
    face = probe.face_us(len(hand.place))
    span = max(20.0, 1.25 * deepest + 5)
    finer = int(np.ceil(FINE_MHZ / setup.sampling_mhz))
    return Scene(
        setup=setup,
        probe=probe,
        hand=hand,
        ground=_draw_ground(rng, setup, hand),
        pulse=_pulse_of(probe, setup.centre_mhz, setup.sampling_mhz * finer),
        face_us=face,
        skin_us=face + rng.normal(0, probe.jitter_us, len(face)),
        finer=finer,
        samples=int((face.max() + 2 * span / setup.mm_us) * setup.sampling_mhz),
        span_mm=span,
    )


def _draw_ground(rng: np.random.Generator, setup: Setup, hand: Hand) -> Ground:
    impedance, coarse = rng.uniform(5.2, 7.8), rng.uniform(0.004, 0.045)
    bone_r = float((impedance - 1.63) / (impedance + 1.63))
    if setup.without == "soft":  # as of a neck or a cheek
        count = int(rng.integers(4, 8))
        shares: Array = np.sort(rng.uniform(0.08, 1.0, count))
        reflections = rng.choice([-1, 1], count) * rng.uniform(0.03, 0.1, count)
        thick: Array = np.full(len(hand.depth_mm), rng.uniform(16, 22))
    else:
        layers = [(rng.uniform(0.15, 0.3), -rng.uniform(0.04, 0.16)), (rng.uniform(0.5, 0.72), rng.uniform(0.03, 0.12))]
        if hand.depth_mm.max() > 8:
            layers.append((rng.uniform(0.35, 0.5), rng.uniform(0.02, 0.1)))
        if rng.random() < 0.5:  # close above bone
            layers.append((rng.uniform(0.85, 0.93), rng.uniform(0.02, 0.09)))
        shares, reflections = (np.array(column) for column in zip(*layers))
        thick = hand.depth_mm
    hole = None
    part = min(1.0, len(hand.place) / USUAL_LINES)  # a shorter way comes over fewer holes
    if not setup.without and rng.random() < part * (0.3 if setup.sweeps else 0.12):
        hole = (float(rng.choice(hand.along_mm[hand.coupling > 0.5])), float(rng.uniform(5, 10)))
    return Ground(
        bone_r=bone_r,
        thick_mm=thick,
        shares=shares,
        reflections=reflections,
        texture_mm=_draw_texture(rng, coarse, rng.uniform(0.004, 0.016)),
        radii_mm=rng.uniform(60, 130, 2),
        table_mm=float(rng.uniform(1.5, 3.0)),
        skull_mm=float(rng.uniform(5, 8)),
        diploe=float((1 - bone_r**2) * 10 ** (-rng.uniform(8, 18) / 20)),
        hole=hole,
    )


def _draw_texture(rng: np.random.Generator, coarse_mm: float, fine_mm: float) -> Floats:
    """Heights of the bone's surface: Gaussian fields of two scales, which repeat."""
    total = np.zeros((TEXTURE, TEXTURE // 2 + 1), dtype=np.complex64)
    for height_mm, places in ((coarse_mm, rng.uniform(6, 20)), (fine_mm, 1.5)):
        few = min(int(0.75 * TEXTURE / places), TEXTURE // 2)  # higher frequencies are gone
        turns = np.r_[0:few, -few:0] / TEXTURE
        bell = np.exp(-2 * np.pi**2 * places**2 * turns**2).astype(np.float32)
        drawn = rng.standard_normal((2 * few, 2 * few), dtype=np.float32).view(np.complex64)
        drawn *= bell[:, None]
        drawn *= bell[:few]
        drawn[0, 0] = 0
        power = 2 * np.linalg.norm(drawn) ** 2 - np.linalg.norm(drawn[:, 0]) ** 2
        drawn[:, 0] *= np.float32(np.sqrt(2))  # its imaginary half gets lost
        drawn *= np.float32(height_mm * TEXTURE**2 / np.sqrt(power))
        total[:few, :few] += drawn[:few]
        total[-few:, :few] += drawn[few:]
    return np.asarray(np.pad(scipy.fft.irfft2(total, (TEXTURE, TEXTURE), overwrite_x=True), ((0, 1), (0, 1)), mode="wrap"))


def draw_reflections(rng: np.random.Generator, scene: Scene) -> tuple[Floats, Floats, Array]:
    """On the fine grid: the bone's (n, size), those of all else, and the share of each beam that looks into a hole."""
    count, setup = len(scene.skin_us), scene.setup
    bone = np.zeros((count, scene.size), dtype=np.float32)
    rest = np.zeros_like(bone)
    missing = np.zeros(count)
    rows = np.flatnonzero(scene.hand.contact)
    if len(rows) and setup.without != "gel":
        if not setup.without:
            missing[rows] = _add_surface(scene, rows, bone)
            _add_behind(rng, scene, rows, missing, bone, rest)
        _add_layers(rng, scene, rows, rest)
        _add_scatter(rng, scene, rows, missing, rest)
    if scene.probe.material:
        _add_delay_line(scene, bone, rest)
    return bone, rest, missing


def _deposit(scene: Scene, into: Floats, rows: Rows, time_us: Array, height: Array) -> None:
    """Add reflections (len(rows), m) to `into`, split between the two nearest times."""
    at = time_us * scene.rate_mhz
    first = np.floor(at).astype(np.int64)
    part = at - first
    height = np.where((first >= 0) & (first < into.shape[1] - 1), height, 0.0)
    first = np.clip(first, 0, into.shape[1] - 2)
    np.add.at(into, (rows[:, None], first), (height * (1 - part)).astype(np.float32))
    np.add.at(into, (rows[:, None], first + 1), (height * part).astype(np.float32))


def _add_surface(scene: Scene, rows: Rows, bone: Floats) -> Array:
    """Facets of the bone under the beam; the share of each line's beam that meets none."""
    setup, probe, hand, ground = scene.setup, scene.probe, scene.hand, scene.ground
    wave_mm = setup.mm_us / setup.centre_mhz
    rayleigh = np.pi / wave_mm * probe.waist_mm**2
    depth = hand.depth_mm[rows]
    beyond = probe.length_mm * probe.line_m_s / setup.speed_m_s + depth - probe.waist_at_mm
    radius = probe.waist_mm * np.sqrt(1 + (beyond / rayleigh) ** 2)
    reach, spacing = 2 * float(radius.max()), FACET * wave_mm
    axis = np.arange(-reach, reach + spacing / 2, spacing)
    column, row = np.nonzero(axis[:, None] ** 2 + axis**2 < reach**2)
    x, y = axis[column].astype(np.float32), axis[row].astype(np.float32)
    off2 = x * x + y * y
    weight = np.exp(off2 * (-2 / radius[:, None] ** 2).astype(np.float32))
    weight[off2 >= (4 * radius[:, None] ** 2).astype(np.float32)] = 0
    weight /= weight.sum(axis=1, keepdims=True)
    slope = np.tan(np.radians(hand.tilt_deg[rows])).astype(np.float32)
    further = slope[:, :1] * x + slope[:, 1:] * y
    # curved wavefront: r^2 / (2 R) and back, and the bone's own curvature
    front = (0.5 * beyond / (beyond**2 + rayleigh**2)).astype(np.float32)
    curved = x * x * np.float32(0.5 / ground.radii_mm[0]) + y * y * np.float32(0.5 / ground.radii_mm[1])
    further += curved + front[:, None] * off2
    further += _heights(ground, hand.along_mm[rows, None] + axis, hand.aside_mm[rows, None] + axis, column, row)
    missing = np.zeros(len(rows))
    if ground.hole is not None:
        middle, hole_mm = ground.hole
        into = (hand.along_mm[rows, None] + x - middle) ** 2 + (hand.aside_mm[rows, None] + y) ** 2 <= hole_mm**2
        missing = (weight * into).sum(axis=1).astype(float)
        weight[into] = 0
    _bin(scene, bone, rows, further, weight * (scene.entered[rows, None] * ground.bone_r).astype(np.float32))
    return missing


def _heights(ground: Ground, along_mm: Array, aside_mm: Array, column: Rows, row: Rows) -> Floats:
    """Texture (n, facets) at axes (n, a) along and aside, linear between its places."""
    side = TEXTURE + 1
    places, parts = [], []
    for axis in (along_mm / TEXTURE_MM, aside_mm / TEXTURE_MM):
        whole = np.floor(axis)
        places.append((whole % TEXTURE).astype(np.int64))
        parts.append((axis - whole).astype(np.float32))
    at = np.take(places[0] * side, column, axis=1) + np.take(places[1], row, axis=1)
    u, v = np.take(parts[0], column, axis=1), np.take(parts[1], row, axis=1)
    heights = ground.texture_mm.ravel()
    near, far = np.take(heights, at), np.take(heights, at + side)
    near += v * (np.take(heights, at + 1) - near)
    far += v * (np.take(heights, at + side + 1) - far)
    return np.asarray(near + u * (far - near))


def _bin(scene: Scene, bone: Floats, rows: Rows, further_mm: Floats, height: Floats) -> None:
    """Add facets (len(rows), f) that lie further than the bone's typical depth; many, so they are counted line after line."""
    start = scene.bone_us[rows] * scene.rate_mhz
    base = np.floor(start).astype(np.int64) + int(np.floor(further_mm.min() * 2 / scene.setup.mm_us * scene.rate_mhz)) - 1
    base = np.maximum(base, 0)
    at = further_mm * np.float32(2 / scene.setup.mm_us * scene.rate_mhz) + (start - base).astype(np.float32)[:, None]
    first = at.astype(np.int64)
    at -= first
    width = int(first.max()) + 2
    first += (np.arange(len(rows)) * width)[:, None]
    upper = height * at
    flat = first.ravel()
    counted = np.bincount(flat, (height - upper).ravel(), len(rows) * width)
    counted[1:] += np.bincount(flat, upper.ravel(), len(rows) * width)[:-1]
    columns = np.minimum(base[:, None] + np.arange(width), bone.shape[1] - 1)
    bone[rows[:, None], columns] = counted.reshape(len(rows), width)


def _add_behind(rng: np.random.Generator, scene: Scene, rows: Rows, missing: Array, bone: Floats, rest: Floats) -> None:
    """Back of the outer table, diploe, the echo between bone and face; dura in a hole."""
    setup, probe, hand, ground = scene.setup, scene.probe, scene.hand, scene.ground
    table_us = 2 * ground.table_mm / BONE_MM_US
    lost = 10 ** (-TABLE_DB * setup.centre_mhz * 0.2 * ground.table_mm / 20)
    covered, bare = rows[missing[rows] < GAP], rows[missing[rows] > 0.03]
    shift = table_us * scene.rate_mhz
    whole, part = int(shift), shift % 1
    height = -0.5 * (1 - ground.bone_r**2) * lost
    surface = bone[covered, : scene.size - whole - 1] * np.float32(height)
    bone[covered, whole:-1] += surface * np.float32(1 - part)
    bone[covered, whole + 1 :] += surface * np.float32(part)
    left = scene.entered[covered] * (1 - missing[covered])
    begins = (scene.bone_us[covered] + table_us) * scene.rate_mhz
    since = np.arange(1, int(DIPLOE_ENDS * DIPLOE_US * scene.rate_mhz))
    at = np.floor(begins).astype(np.int64)[:, None] + since
    falls = np.exp(-since / (scene.rate_mhz * DIPLOE_US)).astype(np.float32)
    scatter = rng.standard_normal(at.shape, dtype=np.float32) * falls
    scatter *= (0.5 * ground.diploe * ground.bone_r * lost / scene.pulse.energy * left).astype(np.float32)[:, None]
    scatter[at >= scene.size] = 0
    bone[covered[:, None], np.minimum(at, scene.size - 1)] += scatter
    turned = 2 * np.pi / setup.mm_us * setup.centre_mhz * probe.waist_mm * np.radians(2 * np.hypot(*hand.tilt_deg[covered].T))
    face = -probe.face_r if probe.material else probe.face_r
    again = left * ground.bone_r**2 * face * np.exp(-0.5 * turned**2) / 7
    twice = scene.skin_us[covered, None] + setup.echo_us(
        2 * hand.depth_mm[covered, None] + rng.normal(0, 0.03, (len(covered), 7))
    )
    _deposit(scene, rest, covered, twice, np.repeat(again[:, None], 7, axis=1))
    dura = hand.depth_mm[bare, None] + ground.skull_mm + rng.normal(0, 0.05, (len(bare), 5))
    faint = scene.entered[bare] * missing[bare] * 0.05 / 5
    _deposit(scene, rest, bare, scene.skin_us[bare, None] + setup.echo_us(dura), np.repeat(faint[:, None], 5, axis=1))


def _add_layers(rng: np.random.Generator, scene: Scene, rows: Rows, rest: Floats) -> None:
    """Interfaces of five rough facets each, tilted on their own."""
    hand, ground, facets = scene.hand, scene.ground, 5
    along = hand.along_mm[rows]
    wide = 2 * np.pi / scene.setup.mm_us * scene.setup.centre_mhz * scene.probe.waist_mm
    for share, reflection in zip(ground.shares, ground.reflections):
        rough_mm = rng.normal(0, rng.uniform(0.01, 0.07), facets)
        strength = 1 + 0.6 * smooth(rng, along, 2.0, facets).T
        depth = ground.thick_mm[rows] * share * (1 + 0.05 * smooth(rng, along, 8.0)[0])
        tilt = hand.tilt_deg[rows] * share + 1.2 * smooth(rng, along, 15.0, 2).T
        answer = np.maximum(np.exp(-0.5 * (wide * np.radians(np.hypot(*tilt.T))) ** 2), 0.08)
        height = (scene.entered[rows] * reflection * answer / facets)[:, None] * strength
        _deposit(scene, rest, rows, scene.skin_us[rows, None] + scene.setup.echo_us(depth[:, None] + rough_mm), height)


def _add_scatter(rng: np.random.Generator, scene: Scene, rows: Rows, missing: Array, rest: Floats) -> None:
    """Scatterers: columns of them stand every beam's width on the path, and a line blends its two neighbours."""
    setup, ground, hand = scene.setup, scene.ground, scene.hand
    level = ground.bone_r * 10 ** (-rng.uniform(28, 42) / 20) / scene.pulse.energy
    knots = np.concatenate([[0.0], np.sort(ground.shares), [1.0]])
    heights = rng.uniform(0.4, 1.5, len(knots))
    depth_at = hand.depth_mm[rows]
    last = scene.size
    if not setup.without and missing.max() == 0:  # all lies in the bone's shadow
        last = min(last, int(scene.bone_us[rows].max() * scene.rate_mhz) + 2)
    first = max(int(scene.skin_us[rows].min() * scene.rate_mhz) - 1, 0)
    time = np.arange(first, last) / scene.rate_mhz
    depth = (time - scene.skin_us[rows, None]) * (setup.mm_us / 2)
    strength = np.interp(depth / ground.thick_mm[rows, None], knots, heights, left=0).astype(np.float32)
    strength[depth <= 0] = 0
    if not setup.without:
        gone = missing[rows]
        behind = depth > depth_at[:, None]
        shadow = np.where(gone < GAP, gone, 1.0)
        strength[behind] *= np.broadcast_to(shadow.astype(np.float32)[:, None], depth.shape)[behind]
        within = behind & (depth <= depth_at[:, None] + ground.skull_mm) & (gone > 0.03)[:, None]
        strength[within] *= np.float32(0.35)
    node = hand.along_mm[rows] / (1.2 * scene.probe.waist_mm)
    left = np.floor(node).astype(np.int64)
    used, index = np.unique(np.concatenate([left, left + 1]), return_inverse=True)
    columns = rng.standard_normal((len(used), len(time)), dtype=np.float32)
    angle = (node - left) * np.pi / 2
    gain = level * scene.entered[rows]
    blended = columns[index[: len(rows)]] * (gain * np.cos(angle)).astype(np.float32)[:, None]
    blended += columns[index[len(rows) :]] * (gain * np.sin(angle)).astype(np.float32)[:, None]
    rest[rows, first:last] += blended * strength


def _add_delay_line(scene: Scene, bone: Floats, rest: Floats) -> None:
    """What comes of the tissue comes again by the delay line; the face's own echo and its multiples."""
    probe, coupling = scene.probe, scene.hand.coupling
    later = round(float(scene.face_us.mean()) * scene.rate_mhz)
    if later < scene.size:
        again = np.float32(2 * probe.face_r * probe.back_r)
        rest[:, later:] += again * bone[:, : scene.size - later]
        rest[:, later:] += again * rest[:, : scene.size - later]
    number = np.arange(1, 7)
    face = (coupling * probe.face_r - (1 - coupling))[:, None]
    jitter = (scene.skin_us - scene.face_us)[:, None]
    height = face**number * probe.back_r ** (number - 1)
    _deposit(scene, rest, np.arange(len(coupling)), number * scene.face_us[:, None] + jitter, height)
