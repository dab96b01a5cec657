"""Simulated user study: how long a hand takes to set the probe square to the bone, guided and unguided.

    python Testing/Studies/guided_alignment.py [--trials N] [--seed N]

The guided hand follows the bull's-eye that `ModuleUltrasoundLib.palpation.guidance.guide` draws from a probe's pose on a bone
model whose registration is off by a rotation; the unguided one has the height of the echo alone. All users, heads
and errors are simulated; the figures say what guidance can do for such a hand, not what surgeons will reach.
"""

from __future__ import annotations

import argparse
import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np

ROOT = Path(__file__).resolve().parents[2]
for folder in ("Shared", "ModuleTracking", "ModuleUltrasound", "ModuleRegistration"):
    sys.path.insert(0, str(ROOT / folder))

from CranioNavLib.rigid import Array, rigid  # noqa: E402
from CranioNavLib.surface import Surface  # noqa: E402
from ModuleUltrasoundLib.palpation.guidance import guide, screen_axes  # noqa: E402
from ModuleUltrasoundLib.palpation.hand_model import GuidedUser, Hand, HandParameters, UnguidedUser, echo_db  # noqa: E402
from ModuleUltrasoundLib.palpation.protocol import ProtocolPoints, plan_protocol  # noqa: E402

STEP_S = 0.02
DISPLAY_EVERY = 2  # steps: 25 pictures a second
TRACKER_SD_DEG = 0.1  # orientation noise of a tool with markers 50 mm apart, 0.1 mm jitter each
GOAL_DEG = 3.0
HELD_S = 0.5  # the goal counts when the tilt stays within it for so long
LIMIT_S = 20.0
SETTLE_STEPS = 50  # the user goes on for a second after the goal
HANDS = {
    "typical hand": HandParameters(),
    "slow hand": HandParameters(
        reaction_s=0.5, crossover_rad_s=1.0, fastest_deg_s=10.0, tremor_sd_deg=0.4, drift_sd_deg=1.0, first_tilt_sd_deg=12.0
    ),
}
NORMAL_ERRORS_DEG = {"landmarks only": 1.5, "after six points": 0.7}  # rotation of the registration, each axis


@dataclass(frozen=True)
class Outcome:
    """One trial."""

    time_s: float  # to the goal, held; inf: not within the limit
    final_deg: float  # median tilt of the last half second, when the user stays


def guided_trial(
    surface: Surface, plan: ProtocolPoints, normal_error_deg: float, rng: np.random.Generator, hand: HandParameters
) -> Outcome:
    """One alignment with the bull's-eye, at a random point of the protocol."""
    point = int(rng.integers(len(plan)))
    normal, contact = plan.normals[point], plan.positions_ras_mm[point]
    truth = guide(pose_of(contact, normal, np.zeros(2)), surface, contact, normal).normal_ras  # what an aligned beam sees
    held, user = Hand(hand, first_tilt(hand, rng), rng), GuidedUser(hand, rng)
    error = normal_error_deg * rng.standard_normal(2)  # of the registration, in tilt
    tilts = []
    for step in range(round(LIMIT_S / STEP_S)):
        now = step * STEP_S
        if step % DISPLAY_EVERY == 0:
            believed = held.tilt_deg + error + TRACKER_SD_DEG * rng.standard_normal(2)
            seen = guide(pose_of(contact, truth, believed), surface, contact, normal)
            user.see(np.array(seen.bulls_eye_deg), now)
        tilts.append(float(np.linalg.norm(held.turn(user.speed(now), STEP_S))))
        if reached(tilts[:-SETTLE_STEPS]):
            break
    return outcome(tilts)


def unguided_trial(rng: np.random.Generator, hand: HandParameters) -> Outcome:
    """One alignment by the echo's height."""
    held, user = Hand(hand, first_tilt(hand, rng), rng), UnguidedUser(hand, rng)
    tilts = []
    for step in range(round(LIMIT_S / STEP_S)):
        now = step * STEP_S
        if step % DISPLAY_EVERY == 0:
            user.see(echo_db(held.tilt_deg), now)
        tilts.append(float(np.linalg.norm(held.turn(user.speed(now, STEP_S), STEP_S))))
        if user.satisfied and reached(tilts):
            break
    return outcome(tilts)


def first_tilt(hand: HandParameters, rng: np.random.Generator) -> Array:
    """Tilt (2,) at which the probe is put down by eye: the same for both kinds of user."""
    tilt: Array = hand.first_tilt_sd_deg * rng.standard_normal(2)
    return tilt


def pose_of(contact: Array, normal: Array, tilt_deg: Array) -> Array:
    """ProbeToRas of a probe whose back end leans by a tilt (2,) from a normal, 20 mm before the bone."""
    right, up = screen_axes(normal)
    angle = np.radians(np.linalg.norm(tilt_deg))
    towards = (tilt_deg[0] * right + tilt_deg[1] * up) / max(float(np.linalg.norm(tilt_deg)), 1e-12)
    z = -(np.cos(angle) * normal + np.sin(angle) * towards)
    x = np.cross(z, up)
    x /= np.linalg.norm(x)
    return rigid(np.column_stack([x, np.cross(z, x), z]), contact - 20.0 * z)


def reached(tilts: list[float]) -> bool:
    """Whether the last tilts have been within the goal for long enough."""
    count = round(HELD_S / STEP_S)
    return len(tilts) >= count and max(tilts[-count:]) < GOAL_DEG


def outcome(tilts: list[float]) -> Outcome:
    """Time from the start to the moment from which the goal is held."""
    count = round(HELD_S / STEP_S)
    within = np.array(tilts) < GOAL_DEG
    runs = np.convolve(within, np.ones(count), "valid") == count
    time_s = float(np.argmax(runs)) * STEP_S if runs.any() else float("inf")
    return Outcome(time_s, float(np.median(tilts[-count:])))


def a_head() -> Surface:
    """The synthetic head's bone."""
    from CranioNavLib.phantom import make_patient

    return make_patient(None, 0).bone


def study(trials: int, seed: int, surface: Surface, plan: ProtocolPoints) -> dict[str, list[Outcome]]:
    """Outcomes by condition; the same first tilts in each condition of a hand."""
    results: dict[str, list[Outcome]] = {}
    for who, hand in HANDS.items():
        for name, error_deg in NORMAL_ERRORS_DEG.items():
            results[f"{who}, guided, {name}"] = [
                guided_trial(surface, plan, error_deg, np.random.default_rng((seed, k)), hand) for k in range(trials)
            ]
        results[f"{who}, unguided"] = [unguided_trial(np.random.default_rng((seed, k)), hand) for k in range(trials)]
    return results


def main() -> None:
    """Run the study and print its table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--trials", type=int, default=200)
    parser.add_argument("--seed", type=int, default=0)
    given = parser.parse_args()
    surface = a_head()
    plan = plan_protocol(surface)
    print(f"{given.trials} simulated alignments a row, seed {given.seed}; goal: under {GOAL_DEG:g} deg held for {HELD_S:g} s")
    print(f"{'condition':40s} {'median s':>9s} {'90% s':>7s} {'reached':>8s} {'final tilt deg: median':>23s} {'90%':>6s}")
    for name, outcomes in study(given.trials, given.seed, surface, plan).items():
        times, tilts = np.array([o.time_s for o in outcomes]), np.array([o.final_deg for o in outcomes])
        slow = np.quantile(times, 0.9, method="inverted_cdf")
        print(
            f"{name:40s} {np.median(times):9.2f} {slow:7.2f} {np.mean(np.isfinite(times)):8.0%}"
            f" {np.median(tilts):23.2f} {np.quantile(tilts, 0.9):6.2f}"
        )


if __name__ == "__main__":
    main()
