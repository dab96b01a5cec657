"""Probe calibration: the transducer's face centre and its beam, from echoes of known points and planes in a water bath."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated, Optional, Union

import numpy as np
import numpy.typing as npt
import scipy
from CranioNavLib.errors import InputError
from CranioNavLib.parameters import Limits, Parameters
from CranioNavLib.rigid import Array, check_rigid

from ModuleTrackingLib.calibration.spin import tool_to_marker

FEWEST_ECHOES = 15
OUTLIER_SDS = 4.0
MAD = 1.4826  # SD of normal numbers over the median of their magnitudes


@dataclass(frozen=True)
class ProbeSettings(Parameters):
    lateral_sd_mm: Annotated[float, Limits(0.05, 10), "how well a point echo is centred in the beam, per axis"] = 0.6
    depth_sd_mm: Annotated[float, Limits(0.01, 5), "error of the echo's depth, the tracked pose included"] = 0.3
    max_face_sd_mm: Annotated[float, Limits(0.01, 5), "refuse a face centre that is known less well, worst direction"] = 0.5
    max_beam_sd_deg: Annotated[float, Limits(0.01, 10), "refuse a beam axis that is known less well"] = 1.0


@dataclass(frozen=True, eq=False)
class PointTarget:
    """Echoes of one small target (a bead, a crossing of wires), with the probe aimed so that its echo was strongest."""

    marker_to_frame: Array  # (N, 4, 4) mm
    depths_mm: Array  # (N,) from the transducer's face, at the speed of sound of the bath
    position_mm: Optional[Array] = None  # (3,) in the frame, where touched with a stylus; None: found along with the probe
    position_sd_mm: float = 0.5


@dataclass(frozen=True, eq=False)
class PlaneTarget:
    """Echoes of one flat plate, seen within some degrees of straight on."""

    marker_to_frame: Array  # (N, 4, 4) mm
    depths_mm: Array  # (N,)
    normal: Array  # (3,) unit, towards the probe; as touched, or a rough guess
    offset_mm: float  # normal . x on the plate
    known: bool = True  # False: the plate is found along with the probe, starting from this guess


Target = Union[PointTarget, PlaneTarget]


@dataclass(frozen=True, eq=False)
class ProbeCalibration:
    """The Probe frame: origin at the centre of the transducer's face, +z along the beam."""

    probe_to_marker: Array  # (4, 4) mm
    covariance: Array  # (5, 5): face centre in the Probe frame (mm), then beam tilts about the Probe's x and y (rad)
    rms_depth_mm: float  # of the misses along the beam, echoes used only; it is not the error of the face
    used: int
    left_out: int  # echoes that do not fit
    targets: tuple[Array, ...] = field(default_factory=tuple)  # the points (3,), and planes (4,) normal and offset, as found

    @property
    def face_sd_mm(self) -> float:
        """SD of the face centre in its worst direction."""
        return float(np.sqrt(np.linalg.eigvalsh(self.covariance[:3, :3])[-1]))

    @property
    def beam_sd_deg(self) -> float:
        """SD of the beam's direction in its worst direction."""
        return float(np.degrees(np.sqrt(np.linalg.eigvalsh(self.covariance[3:, 3:])[-1])))


def calibrate_probe(
    targets: list[Target],
    beam_in_marker: npt.ArrayLike,
    face_in_marker_mm: npt.ArrayLike,
    settings: ProbeSettings = ProbeSettings(),
) -> ProbeCalibration:
    """Face centre and beam axis that best explain the echoes of all targets.

    Every echo says that face + depth * beam lies on its target. A point target also says so across the beam, to
    `lateral_sd_mm`. The misses are weighed by their errors; echoes off by more than 4 SDs are left out.

    Parameters
    ----------
    targets : list
        Points and planes, in any number and mixture.
    beam_in_marker, face_in_marker_mm : array-like, shape (3,)
        Rough direction and place, from the drawing or by eye: within 45 deg and some 50 mm.

    Raises
    ------
    InputError
        Too few echoes, or echoes that leave face or beam too uncertain; the message says which, and what to vary.

    References
    ----------
    Point and plane (wall) phantoms as in Mercier et al., "A review of calibration techniques for freehand 3-D ultrasound
    systems", Ultrasound in Medicine and Biology 2005, reduced to the one line of an A-mode probe.
    """
    _check(targets)
    problem = _Problem(targets, settings, np.asarray(beam_in_marker, dtype=float), np.asarray(face_in_marker_mm, dtype=float))
    solution, keep = problem.solve()
    used = int(keep.sum())
    if used < FEWEST_ECHOES or used < 0.5 * len(keep):
        raise InputError(
            f"only {used} of {len(keep)} echoes agree with each other; check the echo gate and the targets' positions"
        )
    return problem.result(solution, keep)


def water_speed_m_s(temperature_c: float) -> float:
    """Speed of sound in distilled water at normal pressure, 0 to 95 deg C; good to 0.02 m/s.

    Raises
    ------
    InputError
        A temperature outside that range.

    References
    ----------
    Marczak, "Water as a standard in the measurements of speed of sound in liquids", JASA 1997, eq. (2).
    """
    if not 0 <= temperature_c <= 95:
        raise InputError(f"water at {temperature_c} deg C; expected 0 to 95")
    terms = (1.402385e3, 5.038813, -5.799136e-2, 3.287156e-4, -1.398845e-6, 2.787860e-9)
    return float(sum(term * temperature_c**power for power, term in enumerate(terms)))


def _check(targets: list[Target]) -> None:
    total = 0
    for number, target in enumerate(targets):
        poses, depths = np.asarray(target.marker_to_frame), np.asarray(target.depths_mm)
        if poses.shape != (len(depths), 4, 4):
            raise InputError(f"target {number + 1}: {poses.shape} poses for {len(depths)} depths; give one pose an echo")
        if not np.isfinite(depths).all() or (depths <= 0).any():
            raise InputError(f"target {number + 1}: depths must be positive numbers in mm; leave lost echoes out")
        for pose in poses:
            check_rigid(pose, f"a pose of target {number + 1}")
        total += len(depths)
    if total < FEWEST_ECHOES:
        raise InputError(f"expected at least {FEWEST_ECHOES} echoes, got {total}; record more")


class _Problem:
    """The least-squares problem: parameters are face (3), beam tilts (2), then what is unknown of each target."""

    def __init__(self, targets: list[Target], settings: ProbeSettings, beam: Array, face: Array) -> None:
        self.targets, self.settings = targets, settings
        self.start_frame = tool_to_marker(face, beam)  # tilts are small turns of this frame's z
        self.start: list[float] = [*face, 0.0, 0.0]
        self.echo_of_row: list[Array] = []
        first = 0
        for target in targets:
            count = len(target.depths_mm)
            self.echo_of_row.append(np.repeat(np.arange(first, first + count), self._rows_an_echo(target)))
            first += count
            ends = target.marker_to_frame[:, :3, :3] @ face + target.marker_to_frame[:, :3, 3]
            ends = ends + (target.marker_to_frame[:, :3, :3] @ self.start_frame[:3, 2]) * target.depths_mm[:, None]
            if isinstance(target, PointTarget):
                self.start += list(np.median(ends, axis=0) if target.position_mm is None else target.position_mm)
            elif not target.known:
                self.start += [0.0, 0.0, target.offset_mm]
        self.echoes = first

    @staticmethod
    def _rows_an_echo(target: Target) -> int:
        return 3 if isinstance(target, PointTarget) else 1

    def beam(self, parameters: Array) -> Array:
        """Unit beam in the marker's frame."""
        tilted = self.start_frame[:3, :3] @ np.array([np.tan(parameters[4]), -np.tan(parameters[3]), 1.0])
        unit: Array = tilted / np.linalg.norm(tilted)
        return unit

    def misses(self, parameters: Array) -> tuple[list[Array], list[Array]]:
        """Of each target: misses in SDs, one row after the other (N * rows,), and their prior's (3,) or (0,)."""
        face, beam = parameters[:3], self.beam(parameters)
        settings, place = self.settings, 5
        rows, priors = [], []
        for target in self.targets:
            turn, origin = target.marker_to_frame[:, :3, :3], target.marker_to_frame[:, :3, 3]
            beams = turn @ beam
            ends = turn @ face + origin + beams * np.asarray(target.depths_mm)[:, None]
            if isinstance(target, PointTarget):
                miss = ends - parameters[place : place + 3]
                along = np.sum(miss * beams, axis=1, keepdims=True)
                # along / depth SD and across / lateral SD, written as one 3-vector without choosing axes across
                rows.append(((miss - along * beams) / settings.lateral_sd_mm + along * beams / settings.depth_sd_mm).ravel())
                known = target.position_mm
                priors.append(np.empty(0) if known is None else (parameters[place : place + 3] - known) / target.position_sd_mm)
                place += 3
                continue
            normal, offset = np.asarray(target.normal, dtype=float), target.offset_mm
            if not target.known:
                normal = tool_to_marker((0, 0, 0), normal)[:3, :3] @ np.array([*parameters[place : place + 2], 1.0])
                offset, place = float(parameters[place + 2]), place + 3
            normal = normal / np.linalg.norm(normal)
            rows.append((ends @ normal - offset) / settings.depth_sd_mm)
            priors.append(np.empty(0))
        return rows, priors

    def solve(self) -> tuple[Array, npt.NDArray[np.bool_]]:
        """Parameters and the echoes kept."""
        echo = np.concatenate(self.echo_of_row)
        keep: npt.NDArray[np.bool_] = np.ones(self.echoes, dtype=bool)
        parameters = np.array(self.start)

        def residuals(x: Array) -> Array:
            rows, priors = self.misses(x)
            return np.concatenate([np.concatenate(rows)[keep[echo]], *priors])

        # The problem is almost linear: plain least squares leads near from any start, and the robust loss from there.
        parameters = scipy.optimize.least_squares(residuals, parameters, x_scale="jac").x
        parameters = scipy.optimize.least_squares(residuals, parameters, loss="soft_l1", x_scale="jac", max_nfev=200).x
        for _ in range(20):
            lengths = np.sqrt(np.bincount(echo, np.concatenate(self.misses(parameters)[0]) ** 2, self.echoes))
            scale = max(MAD * float(np.median(lengths[keep])) / 1.2, 1.0)  # at least the stated errors
            again = lengths <= OUTLIER_SDS * scale
            if np.array_equal(again, keep):
                break
            keep = again
            if keep.sum() < FEWEST_ECHOES:
                break
            parameters = scipy.optimize.least_squares(residuals, parameters, x_scale="jac").x
        return np.asarray(scipy.optimize.least_squares(residuals, parameters, x_scale="jac").x), keep

    def result(self, parameters: Array, keep: npt.NDArray[np.bool_]) -> ProbeCalibration:
        echo = np.concatenate(self.echo_of_row)

        def residuals(x: Array) -> Array:
            rows, priors = self.misses(x)
            return np.concatenate([np.concatenate(rows)[keep[echo]], *priors])

        fit = scipy.optimize.least_squares(residuals, parameters, x_scale="jac", max_nfev=1)
        singular = np.linalg.svd(fit.jac / np.linalg.norm(fit.jac, axis=0), compute_uv=False)
        if not np.isfinite(singular).all() or singular[-1] < 1e-6:
            raise InputError(f"the echoes do not settle the probe; {WHAT_TO_VARY}")
        free = max(len(fit.fun) - len(parameters), 1)
        variance = max(2 * fit.cost / free, 1.0)  # echoes that scatter more than stated widen the result
        covariance = np.linalg.inv(fit.jac.T @ fit.jac)[:5, :5] * variance
        beam = self.beam(parameters)
        probe_to_marker = tool_to_marker(parameters[:3], beam)
        turn = np.eye(5)
        turn[:3, :3] = probe_to_marker[:3, :3].T
        turn[3:, 3:] = (probe_to_marker[:3, :3].T @ self.start_frame[:3, :3])[:2, :2]
        calibration = ProbeCalibration(
            probe_to_marker=probe_to_marker,
            covariance=turn @ covariance @ turn.T,
            rms_depth_mm=self._rms_depth(parameters, keep),
            used=int(keep.sum()),
            left_out=int((~keep).sum()),
            targets=tuple(self._targets(parameters)),
        )
        if calibration.face_sd_mm > self.settings.max_face_sd_mm:
            raise InputError(f"the face is only known to {calibration.face_sd_mm:.2f} mm; {WHAT_TO_VARY}")
        if calibration.beam_sd_deg > self.settings.max_beam_sd_deg:
            raise InputError(f"the beam is only known to {calibration.beam_sd_deg:.2f} deg; {WHAT_TO_VARY}")
        return calibration

    def _rms_depth(self, parameters: Array, keep: npt.NDArray[np.bool_]) -> float:
        face, beam, squares, first, place = parameters[:3], self.beam(parameters), [], 0, 5
        rows, _ = self.misses(parameters)
        for target, row in zip(self.targets, rows):
            count = len(target.depths_mm)
            if isinstance(target, PointTarget):
                turn = target.marker_to_frame[:, :3, :3]
                ends = turn @ face + target.marker_to_frame[:, :3, 3] + (turn @ beam) * np.asarray(target.depths_mm)[:, None]
                along = np.sum((ends - parameters[place : place + 3]) * (turn @ beam), axis=1)
                place += 3
            else:
                along = row * self.settings.depth_sd_mm
                place += 0 if target.known else 3
            squares.append(along[keep[first : first + count]] ** 2)
            first += count
        return float(np.sqrt(np.mean(np.concatenate(squares))))

    def _targets(self, parameters: Array) -> list[Array]:
        found, place = [], 5
        for target in self.targets:
            if isinstance(target, PointTarget):
                found.append(parameters[place : place + 3].copy())
                place += 3
            elif target.known:
                found.append(np.array([*target.normal, target.offset_mm], dtype=float))
            else:
                normal = tool_to_marker((0, 0, 0), target.normal)[:3, :3] @ np.array([*parameters[place : place + 2], 1.0])
                found.append(np.array([*(normal / np.linalg.norm(normal)), parameters[place + 2]]))
                place += 3
        return found


WHAT_TO_VARY = "vary the depth by 30 mm or more, tilt the probe to all sides and turn it about its beam"
