"""Where the rotor of a dynamically tuned gyro is stable, and where an integrator makes it look so.

The speeds are those of a rotor whose D is held constant. The answer of "rk4" is one about the integrator: it damps the
nutation by (H dt / A)^6 / (144 dt) and blows it up from H dt / A = 2.83 on. It is not a property of the instrument.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from nav.errors import HilError
from nav.exponential import ComplexArray
from nav.instruments.dtg import Rotor

Kind = Literal["continuous", "exact", "rk4"]
SPINS = (2.0 * math.pi * 20.0, 2.0 * math.pi * 2000.0)
"""Rotor speeds that are searched, rad/s."""
_SEARCH = 2000


@dataclass(frozen=True, eq=False)
class Stability:
    """How a rotor's free motion goes on.

    Attributes
    ----------
    eigenvalues : (2,) complex
        Of nutation and lag: 1/s for "continuous", factors a step for the others.
    growth : float
        Of the mode that grows most or falls least, 1/s.
    intervals : tuple of (float, float)
        Rotor speeds of stability, rad/s, D held constant. One that ends where the search does goes on.
    """

    eigenvalues: ComplexArray
    growth: float
    intervals: tuple[tuple[float, float], ...]

    @property
    def stable(self) -> bool:
        """Whether nothing grows."""
        return self.growth <= 0.0


def stability(rotor: Rotor, method: Kind = "continuous", dt: float = 1e-3) -> Stability:
    """Eigenvalues of the free motion, and the rotor speeds between which it is stable.

    Parameters
    ----------
    rotor : Rotor
        The rotor.
    method : str
        "continuous", the rotor itself; "exact" or "rk4", as `nav.instruments.dtg.step_map` steps it.
    dt : float
        Step of "exact" and "rk4", s.

    Raises
    ------
    HilError
        There is no such method, or the step is not a positive number.
    """
    if method not in ("continuous", "exact", "rk4"):
        raise HilError(f"rotor stability: unknown method {method!r}; there is: continuous, exact, rk4")
    if not (math.isfinite(dt) and dt > 0.0):
        raise HilError(f"rotor stability: a step of {dt} s; expected a positive number")

    def at(spin: float) -> float:
        return growth(replace(rotor, spin=spin), method, dt)

    spins = np.geomspace(*SPINS, _SEARCH)
    grows = np.array([at(spin) for spin in spins])
    edges = [_crossing(at, spins[i], spins[i + 1]) for i in np.flatnonzero(np.diff(grows > 0.0))]
    if grows[0] <= 0.0:
        edges.insert(0, SPINS[0])
    if grows[-1] <= 0.0:
        edges.append(SPINS[1])
    intervals = tuple(zip(edges[::2], edges[1::2], strict=True))
    return Stability(_eigenvalues(rotor, method, dt), growth(rotor, method, dt), intervals)


def _crossing(function: Callable[[float], float], low: float, high: float) -> float:
    """Where `function` changes its sign, by halving to the last digits."""
    below = function(low) > 0.0
    while high - low > 1e-12 * high:
        middle = 0.5 * (low + high)
        if (function(middle) > 0.0) == below:
            low = middle
        else:
            high = middle
    return float(0.5 * (low + high))


def growth(rotor: Rotor, method: Kind, dt: float) -> float:
    """Of the mode that grows most or falls least, 1/s; arguments as in `stability`."""
    values = _eigenvalues(rotor, method, dt)
    if method == "continuous":
        return float(values.real.max())
    return float(np.log(np.abs(values)).max() / dt)


def _eigenvalues(rotor: Rotor, method: Kind, dt: float) -> ComplexArray:
    modes = np.array(rotor.modes(), np.complex128)
    if method == "continuous":
        return modes
    x: ComplexArray = dt * modes
    if method == "exact":
        return np.exp(x)
    factors: ComplexArray = 1.0 + x * (1.0 + x / 2.0 * (1.0 + x / 3.0 * (1.0 + x / 4.0)))
    return factors
