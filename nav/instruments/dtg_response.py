"""What a dynamically tuned gyro makes of rates over frequency, in closed form: raw, compensated, with wrong parameters.

The rotor's answer to exp(j w t) is exact; increments and compensation are the digital filters that the head and
:mod:`nav.instruments.dtg_compensation` run, at equal steps. A rate about one axis is the sum of w and -w, so both
axes follow from the answers of the complex rate to either sign.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from nav.exponential import ComplexArray
from nav.increments import FloatArray
from nav.instruments.dtg import Rotor
from nav.instruments.dtg_compensation import coefficients, end_weights


@dataclass(frozen=True, eq=False)
class Response:
    """Answer to a harmonic rate about one axis, over frequency.

    Attributes
    ----------
    same : (n,) complex
        Output about the same axis over the rate.
    cross : (n,) complex
        Output about y over the rate about x, which is minus that about x over the rate about y.
    """

    same: ComplexArray
    cross: ComplexArray

    @property
    def amplitude_error(self) -> FloatArray:
        """|same| - 1."""
        return np.asarray(np.abs(self.same) - 1.0)

    @property
    def phase(self) -> FloatArray:
        """Of the same axis, rad."""
        return np.angle(self.same)

    @property
    def leak(self) -> FloatArray:
        """|cross|."""
        return np.abs(self.cross)


@dataclass(frozen=True, eq=False)
class Taps:
    """The compensation at equal steps as a filter, newest sample first.

    Attributes
    ----------
    increment : (1,) or (5,) complex
        On the increments of the torquer current.
    angle : (2,) complex
        On z, rad per rad; zero where the wire does not carry it.
    """

    increment: ComplexArray
    angle: ComplexArray


def taps(rotor: Rotor, step: float, *, with_angles: bool) -> Taps:
    """The filter of `LagCompensator`.

    Parameters
    ----------
    rotor : Rotor
        What the gyro is taken for.
    step : float
        s.
    with_angles : bool
        Whether the wire carries z.

    Raises
    ------
    HilError
        As `coefficients`.
    """
    on_increment, on_angle, lag = coefficients(rotor)
    if with_angles:
        return Taps(np.array([on_increment]), on_angle * np.array([1.0, -1.0]))
    weights = np.array(end_weights(step, step, step, step))
    on = on_angle * lag * np.diff(weights, prepend=0.0, append=0.0)
    on[0] += on_increment
    return Taps(on, np.zeros(2, np.complex128))


def raw_response(rotor: Rotor, frequency: ArrayLike) -> Response:
    """Of the increments of the torquer current, at `frequency` (n,) rad/s; no step changes it."""
    return _both_axes(*(-rotor.angle_per_rate(1j * w) / rotor.lag for w in _signs(frequency)))


def compensated_response(
    rotor: Rotor,
    frequency: ArrayLike,
    step: float,
    *,
    with_angles: bool,
    taken_for: Rotor | None = None,
    angle_scale: float = 1.0,
) -> Response:
    """Of the compensated increments.

    Parameters
    ----------
    rotor : Rotor
        The gyro. Its torquer current is taken as calibrated: a constant rate comes out right.
    frequency : (n,) float
        rad/s.
    step : float
        s.
    with_angles : bool
        Whether the wire carries z.
    taken_for : Rotor, optional
        What the compensation takes the gyro for, where its parameters are wrong.
    angle_scale : float
        z on the wire over the true one.

    Raises
    ------
    HilError
        As `coefficients`.
    """
    filters = taps(taken_for or rotor, step, with_angles=with_angles)

    def answer(w: FloatArray) -> ComplexArray:
        z = rotor.angle_per_rate(1j * w)
        change = filters.angle[0] * angle_scale * 1j * w * z  # of z over a step, over the increment of the true angle
        both: ComplexArray = change - _spectrum(filters.increment, w, step) * z / rotor.lag
        return both

    return _both_axes(*(answer(w) for w in _signs(frequency)))


@dataclass(frozen=True)
class NoiseGain:
    """What white noise of 1 rad in each sample of an input becomes in the output.

    Attributes
    ----------
    increment : float
        Rms of an output increment, rad.
    angle : float
        Rms of what the sum of the output has more than the sum of the input, rad: it does not grow with time.
    """

    increment: float
    angle: float


def noise_gain(rotor: Rotor, step: float, *, with_angles: bool) -> tuple[NoiseGain, NoiseGain]:
    """Gains of the noise of the torquer increments and of that of z; arguments as in `taps`."""
    filters = taps(rotor, step, with_angles=with_angles)
    surplus = filters.increment.copy()
    surplus[0] -= coefficients(rotor)[0]
    return (
        NoiseGain(_norm(filters.increment), _norm(np.cumsum(surplus))),
        NoiseGain(_norm(filters.angle), _norm(np.cumsum(filters.angle))),
    )


def noise_spectrum(
    rotor: Rotor, frequency: ArrayLike, step: float, *, with_angles: bool
) -> tuple[FloatArray, FloatArray]:
    """Amplitude of the output over that of noise in the torquer increments, and in z; arguments as `compensated_response`."""
    filters, w = taps(rotor, step, with_angles=with_angles), _signs(frequency)
    power = [[np.abs(_spectrum(t, x, step)) ** 2 for x in w] for t in (filters.increment, filters.angle)]
    increments, angles = (np.sqrt(0.5 * (plus + minus)) for plus, minus in power)
    return increments, angles


def _signs(frequency: ArrayLike) -> tuple[FloatArray, FloatArray]:
    w = np.asarray(frequency, np.float64)
    return w, -w


def _both_axes(plus: ComplexArray, minus: ComplexArray) -> Response:
    """x + jy of the answers to w and -w."""
    back = np.conj(minus)
    return Response(0.5 * (plus + back), -0.5j * (plus - back))


def _spectrum(on: ComplexArray, w: FloatArray, step: float) -> ComplexArray:
    delay = np.exp(-1j * step * w)
    total: ComplexArray = sum((tap * delay**i for i, tap in enumerate(on)), np.zeros_like(delay))
    return total


def _norm(x: ComplexArray) -> float:
    return float(np.linalg.norm(x))
