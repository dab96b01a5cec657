"""How the hand moves over faceted bone: it dwells and searches the perpendicular, or sweeps over the head.

The ray of each line meets a sphere of bone, so that depth, tilt, the place of the footprint and the pose belong together.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import scipy.signal
from CranioNavLib.rigid import rigid, rigid_from_vector

from Testing.Studies.simulators.facet_plan import Array, Place, World

POSE_MM, POSE_DEG = 0.08, 0.08  # noise of the tracker


def wander(rng: np.random.Generator, count: int, step_s: float, sigma: float, tau_s: float, columns: int = 1) -> Array:
    """Slow wandering of a hand (an Ornstein-Uhlenbeck process), shape (count, columns)."""
    keeps = np.exp(-step_s / tau_s)
    fresh = rng.normal(0, sigma, (count, columns))
    fresh[1:] *= np.sqrt(1 - keeps**2)
    return np.asarray(scipy.signal.lfilter([1.0], [1.0, -keeps], fresh, axis=0))


@dataclass(frozen=True, eq=False)
class Hand:
    """Where the beam goes in n lines, in the frame of a sphere of bone."""

    depth_mm: Array  # (n,) along the beam
    tilt: Array  # (n,) rad
    tilt_xy: Array  # (n, 2) its components
    at_mm: Array  # (n, 2) where the beam meets the bone, along the surface
    skin_mm: Array  # (n, 3)
    beam: Array  # (n, 3) unit vectors

    def take(self, rows: npt.NDArray[np.int64]) -> Hand:
        """Some of the lines."""
        return Hand(*(getattr(self, name)[rows] for name in self.__dataclass_fields__))


def _hand_dwells(rng: np.random.Generator, thick: float, time: Array, step: float) -> tuple[Array, Array, Array]:
    """Angles, deg (n, 2), position on the skin (n, 2) and its distance from the bone (n,): the perpendicular is searched."""
    n = len(time)
    off = rng.uniform(3, 11) * np.exp(-time / rng.uniform(0.15, 0.45)) * (rng.random() < 0.8)
    heading = rng.uniform(0, 2 * np.pi)
    angles = np.outer(off, [np.cos(heading), np.sin(heading)])
    angles = angles + wander(rng, n, step, rng.uniform(0.5, 1.1), 0.8, 2) + rng.normal(0, 0.6, 2)
    position = wander(rng, n, step, 0.25, 0.5, 2)
    distance = thick * (1 + 0.03 * np.exp(-time / 0.4) + wander(rng, n, step, 0.015, 1.0)[:, 0])
    return angles, position, distance


def _hand_sweeps(rng: np.random.Generator, thick: float, time: Array, step: float) -> tuple[Array, Array, Array]:
    """The same for a hand that moves on; the scalp's thickness changes along its way."""
    n = len(time)
    angles = wander(rng, n, step, rng.uniform(1.3, 2.4), 0.6, 2) + rng.normal(0, 0.5, 2)
    position = wander(rng, n, step, 0.5, 0.7, 2)
    position[:, 0] += rng.uniform(8, 25) * time
    long, short = rng.uniform(12, 40, 2)
    waves = 0.12 * np.sin(position[:, 0] / long + rng.uniform(0, 6)) + 0.05 * np.sin(position[:, 0] / short)
    return angles, position, thick * (1 + waves + wander(rng, n, step, 0.015, 0.8)[:, 0])


def draw_hand(rng: np.random.Generator, world: World, place: Place, lines: int) -> Hand:
    """The hand's way over one place; the contact with the skin is its pivot."""
    step = 1 / world.rate_hz
    time = np.arange(lines) * step
    angles, position, distance = (_hand_sweeps if world.sweeps else _hand_dwells)(rng, place.thick_mm, time, step)
    tremor = np.sin(2 * np.pi * rng.uniform(7, 11) * time + rng.uniform(0, 6))
    lean = np.tan(np.radians(angles + np.outer(tremor, rng.normal(0, 0.15, 2))))
    distance = distance + 0.02 * np.sin(2 * np.pi * 1.1 * time)  # pulse of the arteries
    radius = float(place.radii_mm.mean())
    turned, raised = (position / radius).T
    radial = np.stack([np.sin(turned), np.sin(raised) * np.cos(turned), np.cos(turned) * np.cos(raised)], axis=1)
    across = np.cross([0.0, 1.0, 0.0], radial)
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    along = np.cross(radial, across)
    beam = -radial + lean[:, :1] * across + lean[:, 1:] * along
    beam /= np.linalg.norm(beam, axis=1, keepdims=True)
    skin = radial * (radius + distance)[:, None]
    inward = (skin * beam).sum(axis=1)
    depth = -inward - np.sqrt(np.maximum(inward**2 - (skin**2).sum(axis=1) + radius**2, 0))
    hit = skin + depth[:, None] * beam
    tilt = np.arccos(np.clip(-(hit / radius * beam).sum(axis=1), -1, 1))
    direction = np.arctan2((beam * along).sum(axis=1), (beam * across).sum(axis=1))
    tilt_xy = tilt[:, None] * np.stack([np.cos(direction), np.sin(direction)], axis=1)
    at = radius * np.arctan2(hit[:, :2], hit[:, 2:])
    return Hand(depth, tilt, tilt_xy, at, skin, beam)


def _any_turn(rng: np.random.Generator) -> Array:
    """A rotation drawn from all."""
    turn = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    return np.asarray(turn * np.linalg.det(turn))


def draw_poses(rng: np.random.Generator, world: World, hands: list[Hand]) -> Array:
    """ProbeToReference (n, 4, 4) with the tracker's noise: places of a dwelling hand lie anywhere on the head."""
    head, offset = _any_turn(rng), rng.normal(0, 60, 3)
    poses = []
    for hand in hands:
        turn = head if world.sweeps else head @ _any_turn(rng)
        x = np.cross([0.2, 1.0, 0.1], hand.beam)
        x /= np.linalg.norm(x, axis=1, keepdims=True)
        axes = np.stack([x, np.cross(hand.beam, x), hand.beam], axis=2)
        noise = rigid_from_vector(np.radians(rng.normal(0, POSE_DEG, x.shape)), np.zeros(x.shape))[:, :3, :3]
        origin = (hand.skin_mm - world.acquisition.forerun_length_mm * hand.beam) @ turn.T + offset
        poses.append(rigid(turn @ axes @ noise, origin + rng.normal(0, POSE_MM, origin.shape)))
    return np.concatenate(poses)
