"""Allan deviation of a sensor at rest, and the coefficients that it shows (IEEE Std 952, appendix C).

Of the integral theta of the output, at every T s, the overlapping deviation over tau = m T is

    sigma^2(tau) = 1 / (2 tau^2 (n - 2 m)) sum (theta_(k+2m) - 2 theta_(k+m) + theta_k)^2

and the coefficients of :mod:`nav.instruments.noise`, with the rounding Q of an output that does not carry its residue, make of it

    sigma^2(tau) = 3 Q^2 / tau^2 + N^2 / tau + B^2 2 ln 2 / pi + K^2 tau / 3 + R^2 tau^2 / 2

They are fitted to all taus at once by least squares of the relative error, none negative; a tau counts as much as there are
clusters of its length in the record.
"""

import math
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from nav.errors import HilError
from nav.increments import FloatArray
from nav.kernel import kernel

FEWEST = 9
"""Clusters of a length that tell anything of it: the longest tau is a ninth of the record."""
PER_DECADE = 10


@dataclass(frozen=True, slots=True)
class AllanFit:
    """What a record shows; u is the unit of the sensor's rate (rad/s, m/s^2). Zero: it does not show.

    Attributes
    ----------
    rounding, white, flicker, walk, ramp : float
        Q in u s, N in u / sqrt(Hz), B in u, K in u sqrt(Hz), R in u / s.
    tau, deviation : (m,) float
        s, u.
    """

    rounding: float
    white: float
    flicker: float
    walk: float
    ramp: float
    tau: FloatArray
    deviation: FloatArray

    def curve(self, tau: FloatArray) -> FloatArray:
        """Deviation of the fitted coefficients at `tau` (n,), s."""
        size = np.array([self.rounding, self.white, self.flicker, self.walk, self.ramp])
        result: FloatArray = np.sqrt(_shapes(tau) @ size**2)
        return result


def allan(increments: FloatArray, period: float, shortest: float = 0.0) -> AllanFit:
    """Deviation and coefficients of a record.

    Parameters
    ----------
    increments : (n,) float
        Of one axis at rest, without a gap: u s.
    period : float
        s.
    shortest : float
        Shortest tau, s: what lies below the lag of a rotor or a filter in the sensor is not its noise.

    Raises
    ------
    HilError
        Too short, not finite, or no step above zero.
    """
    n = len(increments)
    if n < 2 * FEWEST or not np.isfinite(increments).all() or not 0.0 < period < math.inf:
        raise HilError(
            f"Allan deviation: {n} samples; it needs {2 * FEWEST} and more, finite, with a period above zero"
        )
    integral = np.concatenate([[0.0], np.cumsum(increments - increments.mean())])  # the mean shows in no difference
    first, longest = max(1.0, math.ceil(shortest / period)), n // FEWEST
    if longest < first:
        raise HilError(
            f"Allan deviation: {n * period:g} s tell nothing from {shortest:g} s on: a ninth of the record counts"
        )
    decades = np.arange(math.log10(first), math.log10(longest) + 1e-9, 1.0 / PER_DECADE)
    sizes = np.unique(np.rint(10.0**decades).astype(np.int64))
    tau = np.asarray(sizes * period, np.float64)
    variance = np.array([_variance(integral, int(m)) for m in sizes]) / tau**2
    rounding, white, flicker, walk, ramp = np.sqrt(_fitted(tau, variance, n * period)).tolist()
    return AllanFit(rounding, white, flicker, walk, ramp, tau, np.sqrt(variance))


@kernel
def _variance(integral: FloatArray, m: int) -> float:
    total, count = 0.0, len(integral) - 2 * m
    for k in range(count):
        total += (integral[k + 2 * m] - 2.0 * integral[k + m] + integral[k]) ** 2
    return total / (2.0 * count)


def _shapes(tau: FloatArray) -> FloatArray:
    level = np.full_like(tau, 2.0 * math.log(2.0) / math.pi)
    return np.stack([3.0 / tau**2, 1.0 / tau, level, tau / 3.0, tau**2 / 2.0], axis=1)


def _fitted(tau: FloatArray, variance: FloatArray, length: float) -> FloatArray:
    """(5,) squares of the coefficients: the best of all choices of those that are not zero, none of them negative."""
    if not variance.any():
        return np.zeros(5)
    used = variance > 0.0
    weight = np.sqrt(length / tau[used])
    rows = _shapes(tau[used]) / variance[used, None] * weight[:, None]
    scale = np.linalg.norm(rows, axis=0)
    best, found = math.inf, np.zeros(5)
    for count in range(1, 6):
        for chosen in combinations(range(5), count):
            columns = list(chosen)
            solved = np.linalg.lstsq(rows[:, columns] / scale[columns], weight, rcond=None)[0]
            left = float(np.sum((rows[:, columns] / scale[columns] @ solved - weight) ** 2))
            if (solved >= 0.0).all() and left < best:
                best, found = left, np.zeros(5)
                found[columns] = solved / scale[columns]
    return found
