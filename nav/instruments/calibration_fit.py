"""Fit of a calibration to positions at rest and to turns: weighted least squares with covariance.

Every stretch (:mod:`nav.instruments.calibration_stretch`) gives the mean outputs of the four gyro axes, and at rest those of
the three accelerometers. What they should be follows from gravity, the Earth's rate, the nominal attitude and the rate of the
turn. The outputs are linear in the coefficients of the error models. Products are not neglected: the terms take the true rate
and force.

The attitude of a stretch is known up to a small error, three unknowns in head axes with a given 1-sigma that are estimated
along. With a large sigma nothing is left of the table but |f| = g and the angle between force and Earth rate. They make the
problem not quite linear: it is solved anew about the last attitudes (Gauss-Newton). With a sigma of zero they are not estimated.

Weights: the white noise of the stretches at rest says how the axes compare; one factor for all gyro outputs and one for all
accelerometer outputs is taken from the residuals, each over its own redundancy (after Helmert). So repeatability from stretch to
stretch, which is more than white noise, is in the sigmas.

A coefficient is determined if its sigma, given all that come before it in `REQUIRED`, is below the
limit there; else it stays zero and is named. The sigmas of the others hold if it is zero indeed.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from nav import earth
from nav.errors import HilError
from nav.increments import FloatArray, IntArray
from nav.instruments.accelerometer_errors import AccelerometerErrors
from nav.instruments.calibration import CASES, Calibration, cases
from nav.instruments.calibration_stretch import Stretch
from nav.instruments.calibration_terms import KINDS, REQUIRED, Values, accelerometer_terms, as_errors, gyro_terms
from nav.instruments.channels import TRIAD
from nav.instruments.gyro_errors import GyroErrors
from nav.instruments.redundancy import AXES
from nav.rotation import dcm_from_rotation_vector

LEAST_POSITIONS = 6
SELECTING = 4
"""Solutions after which the determined coefficients are no longer chosen anew."""
NODES = 36
"""Places over a turn at which the terms are averaged."""
RANGE_MARGIN = 5.0
"""The calibrated range is that of the recordings and so much more on both sides, K."""
_AGAINST_SEQUENCE = np.repeat([math.radians(0.5), 0.5], [4, 3])
"""Outputs further from what the sequence says come of a wrong sequence, rad/s and m/s^2; 5 % of the rate more."""


@dataclass(frozen=True, slots=True)
class Fit:
    """A calibration and how good it is.

    Attributes
    ----------
    calibration : Calibration
        The values.
    gyro_sigma, accelerometer_sigma : Values
        1-sigma of every coefficient that is fitted; inf where it is not determined.
    undetermined : tuple of str
        Axis and name of these.
    determined : tuple of (str, str)
        Axis and name of the others.
    covariance : (d, d) float
        Of these, in SI units.
    residual : (7,) float
        Root mean square of what is left of each output, rad/s and m/s^2.
    factor : (2,) float
        Sigma of gyro and accelerometer outputs over that of their white noise.
    redundancy : (2,) float
        Observations of gyros and accelerometers less what they determine.
    attitude_error : (s, 3) float
        Estimated error of each stretch's attitude, head axes, rad.
    """

    calibration: Calibration
    gyro_sigma: Values
    accelerometer_sigma: Values
    undetermined: tuple[str, ...]
    determined: tuple[tuple[str, str], ...]
    covariance: FloatArray
    residual: FloatArray
    factor: FloatArray
    redundancy: FloatArray
    attitude_error: FloatArray


def fit(
    stretches: Sequence[Stretch],
    lat: float,
    height: float,
    *,
    skew: float = 0.0,
    attitude_sigma: float = 0.0,
) -> Fit:
    """Calibration of the head that gave `stretches`.

    Parameters
    ----------
    stretches : sequence of Stretch
        At least `LEAST_POSITIONS` of them stand.
    lat, height : float
        Where, rad and m.
    skew : float
        How far each gyro is turned about its spin axis, rad.
    attitude_sigma : float
        1-sigma of the nominal attitudes about each axis, rad; 0: they are exact.

    Raises
    ------
    HilError
        There are too few positions, or a stretch does not show what it is said to be.
    """
    standing = sum(one.stands for one in stretches)
    if standing < LEAST_POSITIONS:
        raise HilError(
            f"calibration: {standing} positions at rest; it takes {LEAST_POSITIONS} or more, 24 for the terms of higher order"
        )
    problem = _Problem(stretches, lat, height, skew)
    problem.check()
    return problem.solve(attitude_sigma)


class _Problem:
    """Observations and unknowns; an observation is (stretch, axis), an unknown (axis, name)."""

    def __init__(self, stretches: Sequence[Stretch], lat: float, height: float, skew: float) -> None:
        self.stretches = stretches
        sin_lat, cos_lat = math.sin(lat), math.cos(lat)
        self._force = np.array([0.0, 0.0, -earth.normal_gravity(sin_lat, height)])
        self._rate = earth.RATE * np.array([cos_lat, 0.0, -sin_lat])
        self._axes = np.concatenate([cases(skew), np.eye(3)[np.array(TRIAD)]])
        self._nodes = [self.nodes(one) for one in stretches]
        self.rows = [(s, axis) for s, one in enumerate(stretches) for axis in range(7 if one.stands else 4)]
        self.group: IntArray = np.array([axis // 4 for _, axis in self.rows])
        outputs = [np.concatenate([one.gyro, one.force]) for one in stretches]
        self.measured = np.array([outputs[s][axis] for s, axis in self.rows])
        white = np.sqrt(np.mean([one.white**2 for one in stretches if one.stands], axis=0))
        if not (white > 0.0).all():
            dead = [AXES[k] for k in np.flatnonzero(~(white > 0.0))]
            raise HilError(
                f"calibration: {', '.join(dead)} show no noise at all; an axis is dead or the record is made up"
            )
        self.white = np.array([white[axis] / math.sqrt(stretches[s].duration) for s, axis in self.rows])
        temperature = np.array([one.temperature for one in stretches])
        self.knows_temperature = bool(np.isfinite(temperature).all())
        self.temperature = temperature if self.knows_temperature else np.zeros_like(temperature)
        self.reference = self.temperature.mean(axis=0)
        self.unknowns = [(axis, name) for axis in range(7) for name in REQUIRED[KINDS[axis]]]

    def nodes(self, one: Stretch) -> tuple[FloatArray, FloatArray]:
        """Nominal rate and force (m, 3) in head axes over a stretch."""
        if one.stands:
            return (self._rate @ one.c_nh)[None], (self._force @ one.c_nh)[None]
        unit = one.turn / np.linalg.norm(one.turn)
        turned = dcm_from_rotation_vector(np.outer(2.0 * math.pi / NODES * np.arange(NODES), unit)) @ one.c_nh
        return (self._rate + one.turn) @ turned, self._force @ turned

    def check(self) -> None:
        """Refuse stretches that do not show what they are said to be."""
        for one, (s, axis), value in zip(
            (self.stretches[s] for s, _ in self.rows), self.rows, self.measured, strict=True
        ):
            expected = float((self._nodes[s][axis // 4] @ self._axes[axis, 0]).mean())
            allowed = _AGAINST_SEQUENCE[axis] + (0.05 * float(np.linalg.norm(one.turn)) if axis < 4 else 0.0)
            if abs(value - expected) > allowed:
                unit, size = ("deg/s", math.degrees(1.0)) if axis < 4 else ("m/s^2", 1.0)
                raise HilError(
                    f"{one.name}: {AXES[axis]} reads {value * size:.3f} {unit} and should read {expected * size:.3f}; "
                    "the recording does not show what the sequence says"
                )

    def design(self, errors: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Nominal outputs (n,), and their derivatives by the unknowns (n, u) about the attitude errors (s, 3)."""
        nominal, by = np.zeros(len(self.rows)), np.zeros((len(self.rows), len(self.unknowns)))
        first = np.searchsorted([axis for axis, _ in self.unknowns], np.arange(8))
        seen = -1
        for row, (s, axis) in enumerate(self.rows):
            if s != seen:
                seen, turn = s, dcm_from_rotation_vector(errors[s])
                rate, force = (vectors @ turn for vectors in self._nodes[s])
            t = self.temperature[s, min(axis // 2, 2)] - self.reference[min(axis // 2, 2)]
            terms = gyro_terms if axis < 4 else accelerometer_terms
            input_axis, values = terms(rate @ self._axes[axis].T, force @ self._axes[axis].T)
            values += [t, t * t, t * input_axis]
            nominal[row], by[row, first[axis] : first[axis + 1]] = input_axis, values
        return nominal, by

    def attitude_columns(self, errors: FloatArray) -> FloatArray:
        """Derivatives (n, 3 s) of the nominal outputs by the attitude errors: those of the coefficients' part are small."""
        columns = np.zeros((len(self.rows), 3 * len(self.stretches)))
        for row, (s, axis) in enumerate(self.rows):
            vector = self._nodes[s][axis // 4].mean(axis=0) @ dcm_from_rotation_vector(errors[s])
            columns[row, 3 * s : 3 * s + 3] = np.cross(self._axes[axis, 0], vector)
        return columns

    def solve(self, attitude_sigma: float) -> Fit:
        """Gauss-Newton over attitudes and weights."""
        n, u, count = len(self.rows), len(self.unknowns), len(self.stretches)
        required = np.array([REQUIRED[KINDS[axis]][name] for axis, name in self.unknowns])
        required *= [not name.endswith("]") or self.knows_temperature for _, name in self.unknowns]
        theta, errors, factor = np.zeros(u), np.zeros((count, 3)), np.ones(2)
        kept: list[int] = []
        moved = 3 * count if attitude_sigma > 0.0 else 0
        for turn in range(SELECTING + 6):
            nominal, by = self.design(errors)
            sigma = self.white * factor[self.group]
            rows = np.zeros((n + moved, moved + u))
            right = np.zeros(n + moved)
            rows[:n, moved:], right[:n] = by / sigma[:, None], (self.measured - nominal) / sigma
            if moved:
                turned = self.attitude_columns(errors)
                rows[:n, :moved] = turned / sigma[:, None]
                right[:n] += turned @ errors.ravel() / sigma
                rows[n:, :moved] = np.eye(moved) / attitude_sigma
            if turn < SELECTING:  # later the weights and the attitudes are known
                kept = _determined(rows, required, moved)
            chosen = [*range(moved), *(moved + k for k in kept)]
            q, r = np.linalg.qr(rows[:, chosen])
            solution = np.linalg.solve(r, q.T @ right)
            residual = (right - rows[:, chosen] @ solution)[:n]
            theta = np.zeros(u)
            theta[np.array(chosen[moved:]) - moved] = solution[moved:]
            errors = solution[:moved].reshape(-1, 3) if moved else errors
            leverage = np.sum(q[:n] ** 2, axis=1)
            redundancy = np.array([np.sum(1.0 - leverage[self.group == g]) for g in range(2)])
            change = np.array(
                [
                    math.sqrt(np.sum(residual[self.group == g] ** 2) / redundancy[g]) if redundancy[g] > 0.5 else 1.0
                    for g in range(2)
                ]
            )
            if turn >= SELECTING and np.abs(change - 1.0).max() < 1e-6:
                break
            factor = factor * change
        inverse = np.linalg.inv(r)
        covariance = (inverse @ inverse.T)[moved:, moved:]
        return self._fit(theta, kept, covariance, residual * sigma, factor, redundancy, errors)

    def _fit(
        self,
        theta: FloatArray,
        kept: list[int],
        covariance: FloatArray,
        residual: FloatArray,
        factor: FloatArray,
        redundancy: FloatArray,
        errors: FloatArray,
    ) -> Fit:
        sigma = np.full(len(theta), math.inf)
        sigma[kept] = np.sqrt(np.diag(covariance))
        gyro, force = (dict(self._values(theta, kind)) for kind in ("gyro", "accelerometer"))
        calibration = Calibration(
            GyroErrors(**as_errors(gyro), channels=CASES), AccelerometerErrors(**as_errors(force))
        )
        if self.knows_temperature:
            ends = (
                self.reference,
                self.temperature.min(axis=0) - RANGE_MARGIN,
                self.temperature.max(axis=0) + RANGE_MARGIN,
            )
            reference, coldest, warmest = ((float(a), float(b), float(c)) for a, b, c in ends)
            calibration = replace(calibration, reference=reference, coldest=coldest, warmest=warmest)
        axes = np.array([axis for _, axis in self.rows])
        missing = [self.unknowns[k] for k in range(len(theta)) if math.isinf(sigma[k])]
        return Fit(
            calibration,
            gyro_sigma=dict(self._values(sigma, "gyro")),
            accelerometer_sigma=dict(self._values(sigma, "accelerometer")),
            undetermined=tuple(f"{AXES[axis]} {name}" for axis, name in missing),
            determined=tuple((AXES[self.unknowns[k][0]], self.unknowns[k][1]) for k in kept),
            covariance=covariance,
            residual=np.array([np.sqrt(np.mean(residual[axes == axis] ** 2)) for axis in range(7)]),
            factor=factor,
            redundancy=redundancy,
            attitude_error=errors,
        )

    def _values(self, theta: FloatArray, kind: str) -> Iterator[tuple[str, FloatArray]]:
        for name in REQUIRED[kind]:
            yield (
                name,
                np.array(
                    [theta[k] for k, (axis, own) in enumerate(self.unknowns) if own == name and KINDS[axis] == kind]
                ),
            )


def _determined(rows: FloatArray, required: FloatArray, moved: int) -> list[int]:
    """Unknowns whose sigma, given those before them and the attitudes, reaches what is required."""
    basis = np.linalg.qr(rows[:, :moved])[0]
    kept = []
    for k, limit in enumerate(required):
        rest = rows[:, moved + k]
        for _ in range(2):
            rest = rest - basis @ (basis.T @ rest)
        size = float(np.linalg.norm(rest))
        if size * limit > 1.0:
            kept.append(k)
            basis = np.column_stack([basis, rest / size])
    return kept
