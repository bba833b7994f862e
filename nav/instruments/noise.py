"""Random errors of inertial sensors, by the coefficients of their Allan deviation (IEEE Std 952, 1293).

With u the unit of the sensor's rate (rad/s, m/s^2), the Allan deviation over a time tau is

    white    N / sqrt(tau)             angle or velocity random walk, N in u / sqrt(Hz)
    flicker  B sqrt(2 ln 2 / pi)       bias instability, B in u; level between the shortest and the longest time
    walk     K sqrt(tau / 3)           rate random walk, K in u sqrt(Hz)
    ramp     R tau / sqrt(2)           R in u / s

Flicker is a sum of first-order Gauss-Markov processes, each of variance B^2 ln(rho) / pi, whose correlation times lie in a
geometric progression of the ratio rho; the spectrum is then B^2 / (2 pi f) but for a ripple.
"""

import math
from dataclasses import dataclass

import numpy as np

from nav.errors import HilError
from nav.increments import FloatArray
from nav.kernel import kernel

_RATIO = 8.0
_LONGEST = 1.0e5
"""Longest correlation time of flicker, s: over longer times its deviation falls."""

_BLOCK = 4096
"""Steps whose random numbers are in memory at one time."""


@dataclass(frozen=True, slots=True)
class NoiseModel:
    """Coefficients of one kind of sensor; zero leaves a process out.

    Attributes
    ----------
    white, flicker, walk, ramp : float
        N, B, K, R as in the module's docstring.

    Raises
    ------
    HilError
        A coefficient is negative (a ramp may be) or not finite.
    """

    white: float = 0.0
    flicker: float = 0.0
    walk: float = 0.0
    ramp: float = 0.0

    def __post_init__(self) -> None:
        """Refuse what is no deviation."""
        for name in ("white", "flicker", "walk"):
            if not 0.0 <= getattr(self, name) < math.inf:
                raise HilError(f"noise: {name} is {getattr(self, name):g}; it must be 0 or more")
        if not math.isfinite(self.ramp):
            raise HilError(f"noise: ramp is {self.ramp:g}; it must be finite")


@kernel
def _run(
    normals: FloatArray,  # (n, channels, processes): white, walk, flicker...
    state: FloatArray,  # (channels, 1 + processes): time, white's (unused), walk's, flicker's
    decay: FloatArray,  # (processes,)
    drive: FloatArray,
    ramp: float,
    step: float,
    out: FloatArray,
) -> None:
    for k in range(out.shape[0]):
        for c in range(out.shape[1]):
            before = state[c, 0]
            state[c, 0] = before + 1.0
            total = drive[0] * normals[k, c, 0] + ramp * (before + 0.5) * step
            for i in range(1, len(decay)):
                value = decay[i] * state[c, i] + drive[i] * normals[k, c, i]
                # A walk moves within the step, a stationary process is held.
                total += 0.5 * (value + state[c, i]) if i == 1 else value
                state[c, i] = value
            out[k, c] = total * step


def flicker_processes(flicker: float, step: float) -> tuple[FloatArray, float]:
    """Correlation times (p,), s, of the Gauss-Markov processes that make up flicker, and the deviation of each.

    Parameters
    ----------
    flicker : float
        B; none are needed for 0.
    step : float
        Length of a step, s: the shortest of the times.
    """
    terms = math.ceil(math.log(_LONGEST / step) / math.log(_RATIO)) + 1 if flicker > 0.0 else 0
    times: FloatArray = np.asarray(step * _RATIO ** np.arange(terms), np.float64)
    return times, flicker * math.sqrt(math.log(_RATIO) / math.pi)


class Noise:
    """A stream of noise increments; the same bytes however it is split into calls.

    Parameters
    ----------
    model : NoiseModel
        Coefficients.
    step : float
        Length of a step, s.
    channels : int
        Independent channels.
    rng : numpy Generator
        Where the randomness comes from; the stream alone may use it.
    """

    def __init__(self, model: NoiseModel, step: float, channels: int, rng: np.random.Generator) -> None:
        if not 0.0 < step < math.inf:
            raise HilError(f"noise: a step of {step:g} s; it must be positive")
        times, sigma = flicker_processes(model.flicker, step)
        terms, decay = len(times), np.exp(-step / times)
        self._step, self._ramp, self._rng = step, model.ramp, rng
        self._decay = np.concatenate([[0.0, 1.0], decay])
        self._drive = np.concatenate(
            [[model.white / math.sqrt(step), model.walk * math.sqrt(step)], sigma * np.sqrt(1.0 - decay**2)]
        )
        self._state = np.zeros((channels, 2 + terms))
        self._state[:, 2:] = sigma * rng.standard_normal((channels, terms))

    def increments(self, n: int) -> FloatArray:
        """Integrals of the noise over the next `n` steps: (n, channels), u s."""
        out = np.empty((n, len(self._state)))
        for part in np.split(out, range(_BLOCK, n, _BLOCK)):
            normals = self._rng.standard_normal((len(part), *self._state.shape))
            _run(normals, self._state, self._decay, self._drive, self._ramp, self._step, part)
        return out
