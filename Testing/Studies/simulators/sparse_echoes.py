"""What answers the pulse of a single-element transducer: bone and what is behind it, the scalp's layers and speckle, the face.

Layers lie nearly along the bone, speckle is frozen on its place and ends at the bone, in whose shadow none is. sparse_lines.py
makes lines of it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.fft

from Testing.Studies.simulators.sparse_band import NEPER, Band, Complex, Floats, pulse_spectrum
from Testing.Studies.simulators.sparse_plan import Array, Beam, Bools, Ground, Hand, Rows, Setup, wander

ECHO_US, LAYERS_US = 8.0, 60.0  # no echo of bone, no pile of layers is longer
FACETS = 19  # of the bone, over two of the beam's widths
FROZEN = 997  # of them are kept; then they come again
DIPLOE_ECHOES = 10
SKULL_US_MM = 2 / 2.9
SPECKLE_MM, FIELD_MM = (0.1, -0.1), 4.0  # its ends, from skin and bone; a field of one loss, half its width
FIELDS = 6  # of speckle on a place, mixed as the beam moves
MARGIN_US = 2.5  # half a pulse is shorter
MULTIPLES, FILM_ECHOES = 8, 11


@dataclass(frozen=True, eq=False)
class Scene:
    """The lines of a recording under way, and what their parts need of it; arrays (n,)."""

    setup: Setup
    hand: Hand
    ground: Ground
    beam: Beam
    trigger_us: Array
    skin_us: Array
    coupling: Array  # height of what comes through the gel
    face_r: Array  # of the delay line: nearly total in air

    @property
    def bone(self) -> Bools:
        """Where bone is under the probe."""
        return np.isin(self.hand.state, ["bone", "hair", "edge"]) & (not self.setup.without)

    @property
    def soft(self) -> Bools:
        return self.hand.state == "soft"

    @property
    def tissue_db(self) -> float:
        """Loss of a millimetre there and back, in dB/MHz."""
        return 0.2 * self.ground.attenuation

    @property
    def delay_db(self) -> float:
        """Loss in the delay line there and back, in dB/MHz."""
        return 0.2 * self.setup.delay.attenuation * self.setup.delay.length_mm

    def arrival_us(self, depth_mm: Array) -> Array:
        return np.asarray(self.skin_us + depth_mm * self.setup.us_mm)


@dataclass(frozen=True, eq=False)
class Parts:
    """What comes back from under the skin."""

    bone: Complex  # (n, band) over the pulse, coupled
    behind: Complex  # (n, band) what follows bone, coupled
    layers: Complex  # (n, band), coupled
    speckle: Floats  # (n, samples) under perfect coupling
    bone_peak: Array  # (n,) of its envelope
    layer_peak: Array  # (n,)
    square: Array  # (k,) peak of bone met squarely on each place


def draw_parts(scene: Scene, band: Band, rng: np.random.Generator) -> Parts:
    lobe = band.lobe(scene.beam.tilt_rad)
    coupling = (scene.coupling[:, None] * band.loss(scene.delay_db)).astype(np.float32)
    bone = _bone(scene, band, rng, lobe) * coupling * scene.bone[:, None]
    behind = _behind_bone(scene, band, rng, lobe) * coupling * scene.bone[:, None]
    delay = scene.setup.delay
    if delay.length_mm:  # bone once more, from within the delay line
        way_us = scene.skin_us - scene.trigger_us
        late = scene.skin_us + way_us + scene.beam.square_mm * scene.setup.us_mm < band.last_us
        height = late * delay.face_r * scene.setup.back_r
        behind += bone * band.echoes(way_us[:, None], height[:, None], scene.delay_db)
    layers = _layers(scene, band, rng) * coupling
    ground = scene.ground
    lost = NEPER * (scene.tissue_db * ground.depth_mm + scene.delay_db)
    square = ground.bone_r[:, None] * np.exp(-np.outer(lost, band.mhz))
    return Parts(
        bone=bone,
        behind=behind,
        layers=layers,
        speckle=_speckle(scene, band, rng),
        bone_peak=band.peaks(bone, ECHO_US),
        layer_peak=band.peaks(layers, LAYERS_US),
        square=band.peaks(square.astype(np.float32), ECHO_US),
    )


def _bone(scene: Scene, band: Band, rng: np.random.Generator, lobe: Floats) -> Complex:
    """Bone over the pulse (n, band): the mirror at the nearest point, and the frozen facets that the beam sees."""
    setup, ground, beam, place = scene.setup, scene.ground, scene.beam, scene.hand.place
    square = beam.square_mm[:, None]
    mirror = lobe * band.echoes(scene.arrival_us(beam.square_mm)[:, None], 1.0, scene.tissue_db * square)
    apart_mm = setup.beam_mm / (FACETS // 2)
    number = np.rint(scene.hand.along_mm / apart_mm).astype(int)[:, None] + np.arange(FACETS) - FACETS // 2
    aside_mm = number * apart_mm - scene.hand.along_mm[:, None]
    kept = number - number.min()
    kept, width = kept % FROZEN, min(int(kept.max()) + 1, FROZEN)
    strength, relief = rng.normal(size=(2, len(ground.depth_mm), width))[:, place[:, None], kept]
    seen = np.exp(-0.5 * (aside_mm / (0.3 * setup.beam_mm)) ** 2)
    seen /= np.sqrt((seen**2).sum(axis=1, keepdims=True))
    height = seen * strength * (ground.diffuse[place] * np.cos(beam.tilt_rad) ** 2)[:, None]
    slope = np.tan(np.radians(scene.hand.tilt_deg[:, :1]))
    depth = beam.depth_mm[:, None] + aside_mm * slope + relief * ground.rough_mm[place][:, None]
    time = scene.skin_us[:, None] + depth * setup.us_mm
    facets = band.echoes(time, height, scene.tissue_db * beam.depth_mm[:, None])
    return np.asarray((mirror + facets) * ground.bone_r[place][:, None].astype(np.float32))


def _behind_bone(scene: Scene, band: Band, rng: np.random.Generator, lobe: Floats) -> Complex:
    """What follows bone (n, band): the ends of the outer table, the inner one, the diploe between; bone by way of the face."""
    setup, ground, beam, place = scene.setup, scene.ground, scene.beam, scene.hand.place
    places = len(ground.depth_mm)
    outer = rng.uniform(1.3, 3, places)
    between = outer[:, None] * rng.uniform(0.9, 3, (places, DIPLOE_ECHOES))
    way_mm = np.column_stack([outer, outer + rng.uniform(2, 4.5, places), between])
    ends = np.column_stack([-rng.uniform(0.12, 0.3, places), rng.uniform(-0.25, 0.25, places)])
    reflection = np.column_stack([ends, rng.normal(0, 0.03, (places, DIPLOE_ECHOES))])
    through = (1 - ground.bone_r**2)[:, None]
    lost = 0.2 * rng.uniform(2.5, 6, places)[:, None] * way_mm
    skull = band.echoes(way_mm * SKULL_US_MM, reflection * through, lost)[place]
    square = beam.square_mm[:, None]
    to_bone = band.echoes(scene.arrival_us(beam.square_mm)[:, None], 1.0, scene.tissue_db * square)
    face = abs(setup.delay.face_r) if setup.delay.length_mm else setup.back_r
    height = (-(ground.bone_r**2) * face)[place][:, None]
    again = band.echoes(scene.arrival_us(2 * beam.square_mm)[:, None], height, 2 * scene.tissue_db * square)
    mirrored = lobe**2
    return np.asarray(skull * to_bone * np.sqrt(mirrored + np.float32(0.02)) + again * mirrored)


def _layers(scene: Scene, band: Band, rng: np.random.Generator) -> Complex:
    """Reflections of the scalp's layers over the pulse (n, band). They lie askew by a few degrees: their lobe is blurred."""
    beam, place, soft = scene.beam, scene.hand.place, scene.soft
    total = np.zeros((len(place), len(band.mhz)), dtype=np.complex64)

    def add(depth_mm: Array, reflection: Array, askew_deg: Array, rows: Bools) -> None:
        chosen = np.flatnonzero(rows & (reflection != 0) & (scene.coupling > 0))
        if len(chosen):
            depth = depth_mm[chosen]
            lobe = band.lobe(np.hypot(beam.tilt_rad[chosen], np.radians(askew_deg[chosen])))
            time, height = scene.arrival_us(depth_mm)[chosen], reflection[chosen]
            echo = band.echoes(time[:, None], height[:, None], scene.tissue_db * depth[:, None])
            total[chosen] += echo * np.sqrt(lobe**2 + np.float32(0.03))

    for share, reflection, askew_deg in _draw_scalp_layers(scene, rng):
        add(share[place] * beam.square_mm, reflection[place], askew_deg[place], ~soft)
    for one in np.unique(place[soft]):  # no bone: several interfaces of one strength
        rows = soft & (place == one)
        depths = np.cumsum(rng.uniform(1.5, 4.5, 14))
        for depth in depths[depths < 34]:
            along = depth * (1 + 0.05 * scene.hand.slack) + 0.05 * rng.normal() * scene.hand.along_mm
            reflection = rng.choice([-1, 1]) * rng.uniform(0.03, 0.09)
            every = np.ones(len(place))
            add(np.maximum(along, 0.8), reflection * every, rng.normal(0, 3) * every, rows)
    return total


def _draw_scalp_layers(scene: Scene, rng: np.random.Generator) -> list[tuple[Array, Array, Array]]:
    """Layers over the bone of each place (k,): share of its depth, reflection, tilt against it in degrees.

    Skin over fat, the galea as a thin double layer, in thick scalp up to three fasciae.
    """
    depth = scene.ground.depth_mm
    places = len(depth)
    skin = np.minimum(rng.uniform(1.1, 2, places), 0.45 * depth) / depth
    layers = [(skin, -rng.uniform(0.03, 0.09, places), rng.normal(0, 2, places))]
    least, most = (0.09, 0.14) if scene.setup.strong_galea else (0.02, 0.07)
    galea_mm = depth - rng.uniform(0.8, np.maximum(np.minimum(2.5, 0.45 * depth), 0.8))
    galea_r = rng.uniform(least, most, places) * (depth > 3.2)
    askew = rng.normal(0, 2, places)
    layers.append((galea_mm / depth, galea_r, askew))
    layers.append(((galea_mm + rng.uniform(0.25, 0.6, places)) / depth, -0.7 * galea_r, askew))
    fasciae = rng.integers(1, 4, places) * (depth > 8)
    for number in range(int(fasciae.max())):
        reflection = rng.choice([-1, 1], places) * rng.uniform(0.02, 0.09, places) * (number < fasciae)
        layers.append((rng.uniform(0.35, 0.85, places), reflection, rng.normal(0, 3, places)))
    return layers


def _speckle(scene: Scene, band: Band, rng: np.random.Generator) -> Floats:
    """What scatters in the scalp (n, samples), from the skin to the bone, or on and on where there is none.

    Scatterers of one field of depth lose the same of each frequency; neighbouring fields are faded into each other.
    """
    setup, us_mm = scene.setup, scene.setup.us_mm
    lines = np.zeros((len(scene.skin_us), band.samples), dtype=np.float32)
    rows = np.flatnonzero(scene.coupling > 0)
    level = 10 ** (rng.uniform(-54, -44) / 20) / np.sqrt(0.375 / (setup.bandwidth * setup.centre_mhz) * setup.sampling_mhz)
    if not len(rows):
        return lines
    skin_us = float(scene.skin_us.mean())
    ends_mm = np.where(scene.bone, scene.beam.depth_mm + SPECKLE_MM[1], np.inf)[rows]
    first = int((skin_us + SPECKLE_MM[0] * us_mm) * setup.sampling_mhz) + 1
    last = int(min((skin_us + ends_mm.max() * us_mm) * setup.sampling_mhz, band.samples - 1)) + 1
    depth = (np.arange(first, last) / setup.sampling_mhz - skin_us) / us_mm
    scatterers = _scatterers(scene, rng, rows, last - first)
    scatterers *= depth < ends_mm[:, None]
    half, margin = int(FIELD_MM * us_mm * setup.sampling_mhz) + 1, int(MARGIN_US * setup.sampling_mhz)
    size = scipy.fft.next_fast_len(2 * half + 1 + 2 * margin, real=True)
    pulse = pulse_spectrum(setup, size) * np.float32(level)
    mhz = np.arange(len(pulse)) * (setup.sampling_mhz / size)
    for middle_mm in np.arange(0, depth[-1] + FIELD_MM, FIELD_MM):
        inside = slice(*np.searchsorted(depth, [middle_mm - FIELD_MM, middle_mm + FIELD_MM]))
        fade = 1 - np.abs(depth[inside] - middle_mm) / FIELD_MM
        spectra = scipy.fft.rfft(scatterers[:, inside] * fade.astype(np.float32), size, axis=1)
        lost = NEPER * (scene.tissue_db * middle_mm + scene.delay_db)
        filtered = np.exp(-(lost + 2j * np.pi * margin / setup.sampling_mhz) * mhz) * pulse
        waves = scipy.fft.irfft(spectra * filtered.astype(np.complex64), size, axis=1)
        start = first + inside.start - margin
        within = slice(max(start, 0), min(start + size, band.samples))
        lines[rows, within] += waves[:, within.start - start : within.stop - start]
    return lines


def _scatterers(scene: Scene, rng: np.random.Generator, rows: Rows, count: int) -> Floats:
    """Of the lines `rows` (len(rows), count): fields frozen on each place, mixed as the beam moves over it."""
    along = scene.hand.along_mm[rows, None] / scene.setup.beam_mm
    mixed = np.cos(2 * along * rng.uniform(0.2, 1.5, FIELDS) + rng.uniform(0, 2 * np.pi, FIELDS)) / np.sqrt(3)
    places = scene.hand.place[rows]
    found = np.empty((len(rows), count), dtype=np.float32)
    for one in np.unique(places):
        here = np.flatnonzero(places == one)
        if len(here) == 1:  # a mixture of fields that no other line sees is a field of its own
            found[here] = np.linalg.norm(mixed[here]) * rng.standard_normal((1, count), dtype=np.float32)
        else:
            found[here] = mixed[here].astype(np.float32) @ rng.standard_normal((FIELDS, count), dtype=np.float32)
    return found


def face_echoes(scene: Scene, band: Band, rng: np.random.Generator, gain: float) -> Complex:
    """The delay line's echo with its multiples, and gel that rings under a lifted probe, over the pulse (n, band)."""
    setup, hand, count = scene.setup, scene.hand, len(scene.skin_us)
    total = np.zeros((count, len(band.mhz)), dtype=np.complex64)
    dry = hand.state == "air"
    if setup.delay.length_mm:
        number = np.arange(1, MULTIPLES + 1)
        way_us = (scene.skin_us - scene.trigger_us)[:, None]
        height = scene.face_r[:, None] ** number * setup.back_r ** (number - 1) * np.where(hand.touches, gain, 1.0)[:, None]
        total += band.echoes(scene.trigger_us[:, None] + number * way_us, height, scene.delay_db * number)
    if rng.random() < 0.5 and dry.any():
        film_mm = rng.uniform(0.15, 0.8) * np.exp(wander(rng, count, 1 / setup.rate_hz, 0.5, 0.1))[dry]
        number = np.arange(1, FILM_ECHOES + 1)
        back = 0.15 if setup.delay.length_mm else setup.back_r
        time = scene.skin_us[dry, None] + number * film_mm[:, None] * setup.us_mm
        total[dry] += band.echoes(time, 0.8 * (-1.0) ** number * back ** (number - 1), scene.delay_db)
    return total
