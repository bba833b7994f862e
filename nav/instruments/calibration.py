"""Calibration of a head: what its instruments were found to do wrong, and how it is taken off their increments.

A calibration is what :mod:`nav.instruments.gyro_errors` and :mod:`nav.instruments.accelerometer_errors` write, as measured:
the same names, with temperatures less the reference. It is taken off in the order accelerometers, gyros, because gyros drift
by the force. With x the raw mean output of a step, u = x - K0, and t the temperature less the reference,

    f = A^-1 (u - K(u)) / (1 + gain(t))
    r = m - (bias(t) + D f + Dis f_i f_s + Dos f_o f_s)
    c = (r - (S'/2) |r|) / (1 + gain(t))

K holds the terms of higher order, of the raw outputs: what that neglects is the product of two errors. Scale factors and
misalignments of the gyros stay in c = H w; the rows of H, `Calibration.gyro_matrix`, take the place of the nominal layout in
combination and parity.

Temperatures come once a second. Outside the calibrated range the values at its edge hold; before the first one, those at
the reference.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike

from nav.errors import HilError
from nav.increments import FloatArray, HeadIncrements
from nav.instruments.accelerometer_errors import AccelerometerErrors
from nav.instruments.channels import TRIAD, Channelwise, Triple, table
from nav.instruments.dtg import Rotor
from nav.instruments.gyro_errors import GyroErrors
from nav.instruments.redundancy import GYRO_AXES, layout
from nav.kernel import kernel

CASES: tuple[Triple, ...] = ((0, 1, 2), (1, 0, 2)) * 2
"""Channels g1x, g1y, g2y, g2z in the axes of their gyro's case: two input axes and the spin axis."""
GYRO_TERMS = (
    *("bias", "scale", "misalignment_other", "misalignment_spin", "unbalance", "quadrature", "axial"),
    *("asymmetry", "anisoelasticity", "anisoelasticity_quadrature"),
)
ACCELEROMETER_TERMS = (
    *("bias", "scale", "misalignment_output", "misalignment_pendulous", "quadratic", "cubic"),
    *("cross_io", "cross_ip", "cross_po", "asymmetry", "odd_quadratic", "output_square", "pendulous_square"),
)
"""What a calibration takes off; not what depends on the rotor speed or on the variance of vibration."""
POWERS = 3
"""Highest power of the temperature."""
_LAYOUT_TOLERANCE = 0.1
# Columns of a channel's row: polynomials of bias and gain, then the terms.
_BIAS, _GAIN, _TERM = 0, POWERS, 2 * POWERS


@dataclass(frozen=True, slots=True)
class Calibration:
    """Errors of the instruments of one head, as measured; all zero is an ideal head.

    Attributes
    ----------
    gyros : GyroErrors
        Of the channels `CASES`. Noise, limit, pulse and the terms of the rotor speed do not count.
    accelerometers : AccelerometerErrors
        Of the channels `TRIAD`. Noise, limit, pulse and rectification do not count.
    rotors : pair of Rotor, optional
        Measured rotors of G1 and G2, for the lag; None: those that the head is taken for.
    reference : (3,) float
        Temperatures of gyro 1, gyro 2 and the accelerometers to which the values belong, degrees Celsius.
    warmest, coldest : (3,) float
        Ends of the calibrated range, degrees Celsius.

    Raises
    ------
    HilError
        The channels are others, a power of the temperature is too high, or the range does not hold the reference.
    """

    gyros: GyroErrors = field(default_factory=lambda: GyroErrors(channels=CASES))
    accelerometers: AccelerometerErrors = field(default_factory=AccelerometerErrors)
    rotors: tuple[Rotor, Rotor] | None = None
    reference: tuple[float, float, float] = (0.0, 0.0, 0.0)
    coldest: tuple[float, float, float] = (-math.inf,) * 3
    warmest: tuple[float, float, float] = (math.inf,) * 3

    def __post_init__(self) -> None:
        """Refuse what cannot be taken off."""
        if self.gyros.channels != CASES or self.accelerometers.channels != TRIAD:
            raise HilError("calibration: the channels must be those of the head, CASES and TRIAD")
        for errors in (self.gyros, self.accelerometers):
            if max(len(errors.bias_temperature), len(errors.scale_temperature)) > POWERS:
                raise HilError(f"calibration: polynomials of temperature go to the power {POWERS}; take fewer")
        if not all(low <= t <= high for low, t, high in zip(self.coldest, self.reference, self.warmest, strict=True)):
            raise HilError(
                f"calibration: the reference temperatures {self.reference} lie outside {self.coldest}..{self.warmest}"
            )

    def gyro_matrix(self, skew: float) -> FloatArray:
        """H (4, 3): measurements of the gyro axes from rates in head axes, the gyros turned by `skew`, rad.

        Raises
        ------
        HilError
            The rows are far from those of the layout.
        """
        e = self.gyros
        turned = np.zeros((4, 3))
        for j, case in enumerate(cases(skew)):
            i, o, s = case
            row = [_of(value, j) for value in (e.scale, e.misalignment_other, e.misalignment_spin)]
            turned[j] = (1.0 + row[0]) * i + row[1] * o + row[2] * s
            if not np.abs(turned[j] - i).max() < _LAYOUT_TOLERANCE:
                raise HilError(
                    f"calibration: {GYRO_AXES[j]} lies {np.abs(turned[j] - i).max():.3g} from its nominal axis; "
                    "scale factors and misalignments must be small"
                )
        return turned

    def accelerometer_matrix(self) -> FloatArray:
        """A (3, 3): measurements of the accelerometers from force in head axes."""
        e = self.accelerometers
        matrix = np.eye(3)
        for j, (i, o, p) in enumerate(TRIAD):
            matrix[j, i] += _of(e.scale, j)
            matrix[j, o] += _of(e.misalignment_output, j)
            matrix[j, p] += _of(e.misalignment_pendulous, j)
        return matrix


def cases(skew: float) -> FloatArray:
    """Input, other input and spin axis (4, 3, 3) of each channel of `CASES` in head axes, the gyros turned by `skew`, rad."""
    h, spins = layout(skew), np.eye(3)[[2, 2, 0, 0]]
    axes: FloatArray = np.stack([h, h[[1, 0, 3, 2]], spins], axis=1)
    return axes


def _of(value: Channelwise, channel: int) -> float:
    return value[channel] if isinstance(value, tuple) else value


def _rows(errors: GyroErrors | AccelerometerErrors, names: tuple[str, ...], count: int) -> FloatArray:
    columns: Mapping[str, Channelwise] = {
        **{f"b{k}": errors.bias_temperature[k] if k < len(errors.bias_temperature) else 0.0 for k in range(POWERS)},
        **{f"g{k}": errors.scale_temperature[k] if k < len(errors.scale_temperature) else 0.0 for k in range(POWERS)},
        **{name: getattr(errors, name) for name in names},
    }
    return table(columns, count)


_ACCELEROMETER_ROW = (
    *("bias", "asymmetry", "odd_quadratic", "quadratic", "cubic"),
    *("cross_io", "cross_ip", "cross_po", "output_square", "pendulous_square"),
)
_GYRO_ROW = ("bias", "asymmetry", "unbalance", "quadrature", "axial", "anisoelasticity", "anisoelasticity_quadrature")


def _gyro_rows(errors: GyroErrors, skew: float) -> FloatArray:
    """Rows whose drifts by force stand in head axes: by f, and by f times the force along the spin axis."""
    rows = _rows(errors, _GYRO_ROW, 4)
    turned = np.zeros((4, _TERM + 8))
    turned[:, : _TERM + 2] = rows[:, : _TERM + 2]
    axes = cases(skew)
    turned[:, _TERM + 2 : _TERM + 5] = np.einsum("jk,jka->ja", rows[:, _TERM + 2 : _TERM + 5], axes)
    turned[:, _TERM + 5 :] = np.einsum("jk,jka->ja", rows[:, _TERM + 5 :], axes[:, :2])
    return turned


@kernel
def _at_temperature(
    temperature: FloatArray,
    reference: FloatArray,
    coldest: FloatArray,
    warmest: FloatArray,
    gyros: FloatArray,
    accelerometers: FloatArray,
    now: FloatArray,  # (2, 7) out: bias, 1 / (1 + gain) of each axis
) -> bool:
    """Values at a temperature; True when it lies outside the range."""
    outside = False
    for axis in range(7):
        part = min(axis // 2, 2)
        t = temperature[part]
        if t < coldest[part] or t > warmest[part]:
            outside = True
        t = 0.0 if math.isnan(t) else min(max(t, coldest[part]), warmest[part]) - reference[part]
        row = gyros[axis] if axis < 4 else accelerometers[axis - 4]
        bias = gain = 0.0
        for power in range(POWERS - 1, -1, -1):
            bias, gain = (bias + row[_BIAS + power]) * t, (gain + row[_GAIN + power]) * t
        now[0, axis], now[1, axis] = row[_TERM] + bias, 1.0 / (1.0 + gain)
    return outside


Parts = tuple[FloatArray, FloatArray, FloatArray, FloatArray, FloatArray, FloatArray]
"""Rows of the gyros and of the accelerometers; A^-1; reference, coldest, warmest (3, 3); temperatures of the last sample (3,),
and its biases and gains (2, 7)."""
UNCALIBRATED: Parts = (
    np.zeros((4, _TERM + 8)),
    np.zeros((3, len(_ACCELEROMETER_ROW))),
    np.zeros((3, 3)),
    np.zeros((3, 3)),
    np.zeros(3),
    np.zeros((2, 7)),
)
"""In the place of `Calibrator.parts` where there is none."""


@kernel
def take_off(parts: Parts, step: FloatArray, temperature: FloatArray, gyro: FloatArray, dvel: FloatArray) -> int:
    """`Calibrator.take_off` with its `parts`."""
    gyros, forces, inverse, ranges, last, now = parts
    left = -1
    for k in range(step.shape[0]):
        t = step[k]
        if t <= 0.0:
            continue
        a, b, c = temperature[k, 0], temperature[k, 1], temperature[k, 2]
        if not ((a == last[0] or a != a) and (b == last[1] or b != b) and (c == last[2] or c != c)):  # noqa: PLR0124 NaN
            if _at_temperature(temperature[k], ranges[0], ranges[1], ranges[2], gyros, forces, now) and left < 0:
                left = k
            last[0], last[1], last[2] = a, b, c

        rt = 1.0 / t
        x, y, z = dvel[k, 0] * rt - now[0, 4], dvel[k, 1] * rt - now[0, 5], dvel[k, 2] * rt - now[0, 6]
        for i in range(3):
            u, v, w = (x, y, z) if i == 0 else (y, z, x) if i == 1 else (z, x, y)
            size = abs(u)
            error = now[0, 4 + i] + 0.5 * forces[i, _TERM + 1] * size + forces[i, _TERM + 2] * u * size
            error += (forces[i, _TERM + 3] + forces[i, _TERM + 4] * u) * u * u
            error += forces[i, _TERM + 5] * u * v + forces[i, _TERM + 6] * u * w + forces[i, _TERM + 7] * v * w
            error += forces[i, _TERM + 8] * v * v + forces[i, _TERM + 9] * w * w
            dvel[k, i] = (dvel[k, i] - error * t) * now[1, 4 + i]
        vx, vy, vz = dvel[k, 0], dvel[k, 1], dvel[k, 2]
        for i in range(3):
            dvel[k, i] = inverse[i, 0] * vx + inverse[i, 1] * vy + inverse[i, 2] * vz

        fx, fy, fz = dvel[k, 0] * rt, dvel[k, 1] * rt, dvel[k, 2] * rt
        for j in range(4):
            uneven = gyros[j, _TERM + 5] * fx + gyros[j, _TERM + 6] * fy + gyros[j, _TERM + 7] * fz
            drift = now[0, j] + gyros[j, _TERM + 2] * fx + gyros[j, _TERM + 3] * fy + gyros[j, _TERM + 4] * fz
            r = gyro[k, j] - (drift + uneven * (fz if j < 2 else fx)) * t
            gyro[k, j] = (r - 0.5 * gyros[j, _TERM + 1] * abs(r)) * now[1, j]
    return left


class Calibrator:
    """Takes a calibration off as samples come; how they are split over calls changes no bit.

    Parameters
    ----------
    calibration : Calibration
        What is taken off.
    skew : float
        How far each gyro is turned about its spin axis, rad.

    Raises
    ------
    HilError
        The accelerometers do not span space.
    """

    def __init__(self, calibration: Calibration, skew: float) -> None:
        matrix = calibration.accelerometer_matrix()
        if not np.linalg.cond(matrix) < 10.0:
            raise HilError("calibration: the accelerometers' scale factors and misalignments must be small")
        gyros, forces = _gyro_rows(calibration.gyros, skew), _rows(calibration.accelerometers, _ACCELEROMETER_ROW, 3)
        ranges = np.array([calibration.reference, calibration.coldest, calibration.warmest])
        last, now = np.full(3, np.nan), np.empty((2, 7))
        _at_temperature(last, ranges[0], ranges[1], ranges[2], gyros, forces, now)
        self.parts: Parts = gyros, forces, np.linalg.inv(matrix).astype(np.float64), ranges, last, now
        """For kernels (`take_off`)."""

    def take_off(self, head: HeadIncrements, gyro: FloatArray, dvel: FloatArray) -> int:
        """Take the errors off a batch, in place; allocates nothing.

        Parameters
        ----------
        head : HeadIncrements
            Steps and temperatures of the samples.
        gyro : (n, 4) float
            Increments of the gyro axes without their lag, rad; afterwards those of an axis H w.
        dvel : (n, 3) float
            Velocity increments, m/s; afterwards along head x, y, z.

        Returns
        -------
        int
            The first sample whose temperature has just come to lie outside the range; -1 for none.
        """
        return int(take_off(self.parts, head.step, head.temperature, gyro, dvel))


def outside(calibration: Calibration, temperature: ArrayLike) -> str:
    """In words, which of the three temperatures lie outside the range."""
    names = ("gyro 1", "gyro 2", "the accelerometers")
    rows = zip(names, np.asarray(temperature, float).tolist(), calibration.coldest, calibration.warmest, strict=True)
    return ", ".join(
        f"{name} {t:.1f}, calibrated {low:.1f} to {high:.1f}" for name, t, low, high in rows if t < low or t > high
    )
