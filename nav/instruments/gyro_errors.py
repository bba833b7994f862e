"""Errors of gyros by the drift model of IEEE Std 813 (dynamically tuned gyros), on increments of a fast internal step.

With w and f the mean rate and specific force of a step along the channel's input axis (i), its other input axis (o) and its
spin axis (s), the error is

    D0 + dS w_i + (S'/2) |w_i| + mo w_o + ms w_s + Di f_i + Dq f_o + Ds f_s + Dis f_i f_s + Dos f_o f_s
    + (Dn + dSn w_i) n + polynomials of temperature + noise

n is the relative error of the rotor speed. Then come the limit of the torquer and whole pulses.
"""

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike

from nav.increments import FloatArray, IntArray
from nav.instruments.channels import TRIAD, Channelwise, Triple, check, check_input, convert, polynomial, table
from nav.instruments.noise import Noise, NoiseModel
from nav.kernel import kernel

DTG_HEAD: tuple[Triple, ...] = ((0, 1, 2), (1, 0, 2), (1, 2, 0), (2, 1, 0))
"""Channels of a head with two DTGs, g1x, g1y, g2y, g2z: gyro 1 spins along z, gyro 2 along x."""

_TERMS = (
    "bias",
    "scale",
    "asymmetry",
    "misalignment_other",
    "misalignment_spin",
    "unbalance",
    "quadrature",
    "axial",
    "anisoelasticity",
    "anisoelasticity_quadrature",
)
_SPEED = ("bias_speed", "scale_speed")


@dataclass(frozen=True, slots=True)
class GyroErrors:
    """Coefficients of some channels; all zero is an ideal instrument.

    Attributes
    ----------
    bias : Channelwise
        D0, rad/s.
    scale, asymmetry : Channelwise
        dS, and S', the scale factor of positive rates less that of negative ones.
    misalignment_other, misalignment_spin : Channelwise
        mo, ms: share of the rate about these axes that is sensed, rad.
    unbalance, quadrature, axial : Channelwise
        Di, Dq, Ds: drift by the force along the input, the other input and the spin axis, rad/s / (m/s^2).
    anisoelasticity, anisoelasticity_quadrature : Channelwise
        Dis, Dos, rad/s / (m/s^2)^2.
    bias_speed, scale_speed : Channelwise
        Dn, rad/s, and dSn, for a rotor speed wrong by its own size.
    bias_temperature, scale_temperature : tuple of Channelwise
        Coefficients of the first, second... power of the temperature less that of the calibration: rad/s/K..., 1/K...
    noise : NoiseModel
        In rad/s.
    limit : float
        Of the torquer, rad/s.
    pulse : float
        rad; 0 for none.
    channels : tuple of (3,) int
        Input, other input and spin axis of each channel; `DTG_HEAD` for a head of two.

    Raises
    ------
    HilError
        A value is not possible.
    """

    bias: Channelwise = 0.0
    scale: Channelwise = 0.0
    asymmetry: Channelwise = 0.0
    misalignment_other: Channelwise = 0.0
    misalignment_spin: Channelwise = 0.0
    unbalance: Channelwise = 0.0
    quadrature: Channelwise = 0.0
    axial: Channelwise = 0.0
    anisoelasticity: Channelwise = 0.0
    anisoelasticity_quadrature: Channelwise = 0.0
    bias_speed: Channelwise = 0.0
    scale_speed: Channelwise = 0.0
    bias_temperature: tuple[Channelwise, ...] = ()
    scale_temperature: tuple[Channelwise, ...] = ()
    noise: NoiseModel = field(default_factory=NoiseModel)
    limit: float = float("inf")
    pulse: float = 0.0
    channels: tuple[Triple, ...] = TRIAD

    def __post_init__(self) -> None:
        """Refuse what cannot be."""
        values: dict[str, object] = {name: getattr(self, name) for name in (*_TERMS, *_SPEED)}
        for name in ("bias_temperature", "scale_temperature"):
            values |= {f"{name}[{i}]": value for i, value in enumerate(getattr(self, name))}
        check("gyro errors", self.channels, values, self.limit, self.pulse)


@kernel
def _apply(
    coefficients: FloatArray,
    channels: IntArray,
    step: float,
    dtheta: FloatArray,
    dvel: FloatArray,
    gain: FloatArray,
    out: FloatArray,  # in: what is added; out: increments
) -> None:
    for j in range(len(channels)):
        p = coefficients[j]
        i, o, s = channels[j, 0], channels[j, 1], channels[j, 2]
        for k in range(len(dtheta)):
            x = dtheta[k, i]
            fi, fo, fs = dvel[k, i] / step, dvel[k, o] / step, dvel[k, s] / step
            drift = p[0] + p[5] * fi + p[6] * fo + p[7] * fs + p[8] * fi * fs + p[9] * fo * fs
            turned = (1.0 + p[1] + gain[k, j]) * x + 0.5 * p[2] * abs(x) + p[3] * dtheta[k, o] + p[4] * dtheta[k, s]
            out[k, j] += turned + drift * step


class Gyros:
    """Gyros with errors, as a stream: the same bytes however it is split into calls.

    Parameters
    ----------
    errors : GyroErrors
        Coefficients.
    step : float
        Length of the internal step, s.
    rng : numpy Generator
        Of the noise alone.
    """

    def __init__(self, errors: GyroErrors, step: float, rng: np.random.Generator) -> None:
        count = len(errors.channels)
        self._errors, self._step = errors, step
        self._coefficients = table({name: getattr(errors, name) for name in _TERMS}, count)
        self._channels = np.array(errors.channels, np.int64)
        self._noise = Noise(errors.noise, step, count, rng)
        self._residue = np.zeros(count)
        self.saturated = np.zeros(count, np.int64)
        """Steps that each channel has spent at its limit."""

    def sense(
        self, dtheta: FloatArray, dvel: FloatArray, temperature: ArrayLike = 0.0, speed: ArrayLike = 0.0
    ) -> FloatArray:
        """Increments that the channels give.

        Parameters
        ----------
        dtheta, dvel : (n, 3) float
            True angle and velocity increments, rad and m/s.
        temperature : float or (n,) array_like
            Less that of the calibration, K.
        speed : float or (n,) array_like
            Relative error of the rotor speed.

        Returns
        -------
        (n, c) float
            rad.

        Raises
        ------
        HilError
            The increments are not of this shape or not finite.
        """
        check_input("gyros", dtheta, dvel)
        e, n, count = self._errors, len(dtheta), len(self._channels)
        drift = polynomial(e.bias_temperature, temperature, n, count) + polynomial((e.bias_speed,), speed, n, count)
        gain = polynomial(e.scale_temperature, temperature, n, count) + polynomial((e.scale_speed,), speed, n, count)
        out = self._noise.increments(n) + self._step * drift
        _apply(
            self._coefficients,
            self._channels,
            self._step,
            np.ascontiguousarray(dtheta),
            np.ascontiguousarray(dvel),
            gain,
            out,
        )
        convert(out, self._step, e.limit, e.pulse, self._residue, self.saturated)
        return out
