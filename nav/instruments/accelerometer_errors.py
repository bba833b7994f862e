"""Errors of accelerometers by the model equation of IEEE Std 1293, on increments of a fast internal step.

With a the mean specific force of a step along the channel's input axis, b along its output (hinge) and c along its
pendulous axis (eta and zeta of :mod:`nav.instruments.pendulum`), the error is

    K0 + dK1 a + (K1'/2) |a| + Koq a |a| + K2 a^2 + K3 a^3 + mo b + mp c
    + Kio a b + Kip a c + Kpo b c + Koo b^2 + Kpp c^2 + Kv var(a) + polynomials of temperature + noise

then the limit, then whole pulses. K2 rectifies vibration that the step resolves; Kv is what rectifies besides, by the
variance of a about its mean over about `AVERAGE_S`.
"""

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike

from nav.increments import FloatArray, IntArray
from nav.instruments.channels import TRIAD, Channelwise, Triple, check, check_input, convert, polynomial, table
from nav.instruments.noise import Noise, NoiseModel
from nav.kernel import kernel

AVERAGE_S = 0.1
"""Time constant of the mean and the variance that Kv uses."""

_TERMS = (
    "bias",
    "scale",
    "asymmetry",
    "odd_quadratic",
    "quadratic",
    "cubic",
    "misalignment_output",
    "misalignment_pendulous",
    "cross_io",
    "cross_ip",
    "cross_po",
    "output_square",
    "pendulous_square",
    "rectification",
)


@dataclass(frozen=True, slots=True)
class AccelerometerErrors:
    """Coefficients of some channels; all zero is an ideal instrument.

    Attributes
    ----------
    bias : Channelwise
        K0, m/s^2.
    scale, asymmetry : Channelwise
        dK1, and K1', the scale factor of positive forces less that of negative ones.
    odd_quadratic, quadratic : Channelwise
        Koq and K2, s^2/m.
    cubic : Channelwise
        K3, s^4/m^2.
    misalignment_output, misalignment_pendulous : Channelwise
        mo, mp: share of the force along these axes that is sensed, rad.
    cross_io, cross_ip, cross_po, output_square, pendulous_square : Channelwise
        Kio, Kip, Kpo, Koo, Kpp, s^2/m.
    rectification : Channelwise
        Kv, s^2/m.
    bias_temperature, scale_temperature : tuple of Channelwise
        Coefficients of the first, second... power of the temperature less that of the calibration: m/s^2/K..., 1/K...
    noise : NoiseModel
        In m/s^2.
    limit : float
        m/s^2.
    pulse : float
        m/s; 0 for none.
    channels : tuple of (3,) int
        Input, output and pendulous axis of each channel.

    Raises
    ------
    HilError
        A value is not possible.
    """

    bias: Channelwise = 0.0
    scale: Channelwise = 0.0
    asymmetry: Channelwise = 0.0
    odd_quadratic: Channelwise = 0.0
    quadratic: Channelwise = 0.0
    cubic: Channelwise = 0.0
    misalignment_output: Channelwise = 0.0
    misalignment_pendulous: Channelwise = 0.0
    cross_io: Channelwise = 0.0
    cross_ip: Channelwise = 0.0
    cross_po: Channelwise = 0.0
    output_square: Channelwise = 0.0
    pendulous_square: Channelwise = 0.0
    rectification: Channelwise = 0.0
    bias_temperature: tuple[Channelwise, ...] = ()
    scale_temperature: tuple[Channelwise, ...] = ()
    noise: NoiseModel = field(default_factory=NoiseModel)
    limit: float = float("inf")
    pulse: float = 0.0
    channels: tuple[Triple, ...] = TRIAD

    def __post_init__(self) -> None:
        """Refuse what cannot be."""
        values: dict[str, object] = {name: getattr(self, name) for name in _TERMS}
        for name in ("bias_temperature", "scale_temperature"):
            values |= {f"{name}[{i}]": value for i, value in enumerate(getattr(self, name))}
        check("accelerometer errors", self.channels, values, self.limit, self.pulse)


@kernel
def _apply(
    coefficients: FloatArray,
    channels: IntArray,
    step: float,
    dvel: FloatArray,
    gain: FloatArray,
    average: FloatArray,  # (c, 2) mean and variance
    out: FloatArray,  # in: what is added; out: increments
) -> None:
    share = 1.0 - np.exp(-step / AVERAGE_S)
    for j in range(len(channels)):
        p = coefficients[j]
        x, y, z = channels[j, 0], channels[j, 1], channels[j, 2]
        mean, variance = average[j, 0], average[j, 1]
        for k in range(len(dvel)):
            a, b, c = dvel[k, x] / step, dvel[k, y] / step, dvel[k, z] / step
            size = abs(a)
            apart = a - mean
            mean += share * apart
            variance = (1.0 - share) * (variance + share * apart * apart)
            error = p[0] + (p[1] + gain[k, j]) * a + 0.5 * p[2] * size + p[3] * a * size + (p[4] + p[5] * a) * a * a
            error += p[6] * b + p[7] * c + p[8] * a * b + p[9] * a * c + p[10] * b * c + p[11] * b * b + p[12] * c * c
            out[k, j] += dvel[k, x] + (error + p[13] * variance) * step
        average[j, 0], average[j, 1] = mean, variance


class Accelerometers:
    """Accelerometers with errors, as a stream: the same bytes however it is split into calls.

    Parameters
    ----------
    errors : AccelerometerErrors
        Coefficients.
    step : float
        Length of the internal step, s.
    rng : numpy Generator
        Of the noise alone.
    """

    def __init__(self, errors: AccelerometerErrors, step: float, rng: np.random.Generator) -> None:
        count = len(errors.channels)
        self._errors, self._step = errors, step
        self._coefficients = table({name: getattr(errors, name) for name in _TERMS}, count)
        self._channels = np.array(errors.channels, np.int64)
        self._noise = Noise(errors.noise, step, count, rng)
        self._average, self._residue = np.zeros((count, 2)), np.zeros(count)
        self.saturated = np.zeros(count, np.int64)
        """Steps that each channel has spent at its limit."""

    def sense(self, dvel: FloatArray, temperature: ArrayLike = 0.0) -> FloatArray:
        """Increments that the channels give.

        Parameters
        ----------
        dvel : (n, 3) float
            True velocity increments, m/s.
        temperature : float or (n,) array_like
            Less that of the calibration, K.

        Returns
        -------
        (n, c) float
            m/s.

        Raises
        ------
        HilError
            The increments are not of this shape or not finite.
        """
        check_input("accelerometers", dvel)
        e, n, count = self._errors, len(dvel), len(self._channels)
        out = self._noise.increments(n) + self._step * polynomial(e.bias_temperature, temperature, n, count)
        gain = polynomial(e.scale_temperature, temperature, n, count)
        _apply(self._coefficients, self._channels, self._step, np.ascontiguousarray(dvel), gain, self._average, out)
        convert(out, self._step, e.limit, e.pulse, self._residue, self.saturated)
        return out
