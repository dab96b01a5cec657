"""A simulated hand that tilts the probe, guided by the bull's-eye or by the echo alone. For studies, not for patients.

The hand with its eyes is the crossover model of manual control: it turns the probe at a speed in proportion to the
error it saw one reaction time ago. Tremor and a slow drift add to what it means to do. Tilts are in degrees off the
bone's normal, to the right and up as seen from outside.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from typing import Annotated, Optional

import numpy as np
from CranioNavLib.parameters import Limits, Parameters
from CranioNavLib.rigid import Array


@dataclass(frozen=True)
class HandParameters(Parameters):
    """What the hand and its owner are like. Sources: where none is named, a figure chosen by us and varied in the study."""

    # McRuer and Jex, "A review of quasi-linear pilot models", IEEE Trans. HFE 8(3), 1967: crossover at a few rad/s,
    # effective delay 0.2 to 0.35 s in visual tracking with the hand
    reaction_s: Annotated[float, Limits(0.05, 1), "from seeing to moving"] = 0.30
    crossover_rad_s: Annotated[float, Limits(0.2, 6), "speed of correction for each degree of error seen"] = 2.0
    fastest_deg_s: Annotated[float, Limits(1, 200), "a probe pressed on skin is not turned faster"] = 20.0
    # Physiological tremor lies at 8 to 12 Hz (Elble and Koller, "Tremor", 1990); about 0.1 mm RMS at the tip of a held
    # instrument (Riviere et al., Proc. IEEE EMBS, 1997), that is 0.1 degrees over the 60 mm between hand and contact
    tremor_hz: Annotated[float, Limits(1, 20), "tremor's frequency"] = 9.0
    tremor_sd_deg: Annotated[float, Limits(0, 5), "tremor, each axis"] = 0.15
    drift_sd_deg: Annotated[float, Limits(0, 10), "slow wander, each axis"] = 0.6
    drift_time_s: Annotated[float, Limits(0.1, 20), "time over which the wander changes"] = 1.5
    reading_sd_deg: Annotated[float, Limits(0, 5), "the bull's-eye is read to this"] = 0.4
    reading_share: Annotated[float, Limits(0, 1), "and to this share of its deflection"] = 0.15
    # Unguided: the tilt at which the probe is put down by eye, and the search for the echo
    first_tilt_sd_deg: Annotated[float, Limits(0, 30), "off the normal when the probe is put down by eye, each axis"] = 8.0
    search_deg_s: Annotated[float, Limits(0.5, 50), "speed of rocking in search of an echo"] = 8.0
    search_step_deg: Annotated[float, Limits(0.5, 10), "between the turns of the search"] = 3.0
    amplitude_sd_db: Annotated[float, Limits(0, 10), "an echo's height is judged to this"] = 1.5
    satisfied_s: Annotated[float, Limits(0.2, 10), "without a better echo: the user stays"] = 1.5


# Echo over tilt: a 5 mm disc at 5 MHz loses 6 dB at 1.2 degrees on a smooth plate; a diffuse floor 30 dB below
HALF_AMPLITUDE_DEG = 1.2
DIFFUSE_FLOOR_DB = -30.0
VISIBLE_DB = -20.0  # below the largest echo: a user takes it for an echo


def echo_db(tilt_deg: Array) -> float:
    """Height of the bone's echo at a tilt (2,), dB below that of a square beam."""
    return max(-6.0 * float(tilt_deg @ tilt_deg) / HALF_AMPLITUDE_DEG**2, DIFFUSE_FLOOR_DB)


class Hand:
    """A hand on the probe: the tilt that it holds, and what its unrest does to it."""

    def __init__(self, parameters: HandParameters, first_tilt_deg: Array, rng: np.random.Generator) -> None:
        self.parameters, self._rng = parameters, rng
        self._meant = np.array(first_tilt_deg, dtype=float)
        self._drift = parameters.drift_sd_deg * rng.standard_normal(2)
        self._phase = rng.uniform(0, 2 * np.pi, 2)
        self._time_s = 0.0
        self.tilt_deg = self._meant.copy()

    def turn(self, speed_deg_s: Array, step_s: float) -> Array:
        """Turn at a speed (2,) for a while; gives the tilt (2,) that comes of it."""
        p = self.parameters
        size = float(np.linalg.norm(speed_deg_s))
        self._meant += speed_deg_s * step_s * min(1.0, p.fastest_deg_s / max(size, 1e-12))
        keep = np.exp(-step_s / p.drift_time_s)
        self._drift = keep * self._drift + p.drift_sd_deg * np.sqrt(1 - keep**2) * self._rng.standard_normal(2)
        self._phase += 2 * np.pi * p.tremor_hz * step_s + 0.5 * np.sqrt(step_s) * self._rng.standard_normal(2)
        self._time_s += step_s
        self.tilt_deg = self._meant + self._drift + np.sqrt(2) * p.tremor_sd_deg * np.sin(self._phase)
        return self.tilt_deg


class GuidedUser:
    """Follows the bull's-eye: turns against the deflection that was seen one reaction time ago."""

    def __init__(self, parameters: HandParameters, rng: np.random.Generator) -> None:
        self.parameters, self._rng = parameters, rng
        self._seen: deque[tuple[float, Array]] = deque()
        self._acts_on: Optional[Array] = None

    def see(self, bulls_eye_deg: Array, time_s: float) -> None:
        """The display shows a deflection (2,)."""
        p = self.parameters
        error = p.reading_sd_deg + p.reading_share * float(np.linalg.norm(bulls_eye_deg))
        self._seen.append((time_s, np.asarray(bulls_eye_deg, dtype=float) + error * self._rng.standard_normal(2) / np.sqrt(2)))

    def speed(self, time_s: float) -> Array:
        """How fast (2,) the user turns the probe now, deg/s."""
        while self._seen and self._seen[0][0] <= time_s - self.parameters.reaction_s:
            self._acts_on = self._seen.popleft()[1]
        return np.zeros(2) if self._acts_on is None else -self.parameters.crossover_rad_s * self._acts_on


class UnguidedUser:
    """Has the echo alone: rocks in a widening spiral until it shows, then keeps what makes it larger."""

    def __init__(self, parameters: HandParameters, rng: np.random.Generator) -> None:
        self.parameters, self._rng = parameters, rng
        self._heard: deque[tuple[float, float]] = deque()
        self._now_db = DIFFUSE_FLOOR_DB
        self._angle = 0.0
        self._direction = self._random_direction()
        self._best_db, self._best_s = -np.inf, 0.0
        self._probe_from_db, self._probe_since_s = -np.inf, 0.0
        self.satisfied = False

    def see(self, height_db: float, time_s: float) -> None:
        """The A-line shows an echo of this height."""
        self._heard.append((time_s, height_db + self.parameters.amplitude_sd_db * float(self._rng.standard_normal())))

    def speed(self, time_s: float, step_s: float) -> Array:
        """How fast (2,) the user turns the probe now, deg/s."""
        while self._heard and self._heard[0][0] <= time_s - self.parameters.reaction_s:
            self._now_db = self._heard.popleft()[1]
        if self._best_db < VISIBLE_DB and self._now_db < VISIBLE_DB:
            return self._spiral(step_s)
        return self._climb(time_s)

    def _spiral(self, step_s: float) -> Array:
        p = self.parameters
        radius = p.search_step_deg * self._angle / (2 * np.pi)
        before = radius * np.array([np.cos(self._angle), np.sin(self._angle)])
        self._angle += p.search_deg_s * step_s / max(radius, p.search_step_deg / 2)
        radius = p.search_step_deg * self._angle / (2 * np.pi)
        after = radius * np.array([np.cos(self._angle), np.sin(self._angle)])
        speed: Array = (after - before) / step_s
        return speed

    def _climb(self, time_s: float) -> Array:
        """Small turns of one reaction time and a half each; one that made the echo smaller is taken back."""
        p = self.parameters
        if self._now_db > self._best_db + 0.5:
            self._best_db, self._best_s = self._now_db, time_s
        self.satisfied = time_s - self._best_s > p.satisfied_s and self._now_db > self._best_db - 6.0
        if self.satisfied:
            return np.zeros(2)
        if time_s - self._probe_since_s > 1.5 * p.reaction_s:
            if self._now_db < self._probe_from_db:
                turned = np.array([-self._direction[1], self._direction[0]])
                self._direction = turned if self._rng.random() < 0.5 else -self._direction
            self._probe_from_db, self._probe_since_s = self._now_db, time_s
        return 2.5 * self._direction

    def _random_direction(self) -> Array:
        angle = self._rng.uniform(0, 2 * np.pi)
        return np.array([np.cos(angle), np.sin(angle)])
