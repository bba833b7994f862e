"""Rotor of a dynamically tuned gyro (DTG): its motion, how a record of rates moves it, and where it is stable.

alpha, beta are the small tilts of the rotor about the case axes x, y; x, y and the spin axis are right-handed. With
z = alpha + j beta and the case rate w = w_x + j w_y (source 001, eq. 1)

    A z'' + (f - jH) z' + (k - jD) z = -A w' + jH w,   H = J Omega,  D = f Omega + K

and the current of the torquers reads the rate w_hat = -(D/H) z, a lag of T = H/D. With the rotor's rate among the
stars, y = z' + w, the derivative of the input is gone:

    z' = y - w,   A y' = -(f - jH) y - (k - jD) z + f w

One step over which the rate is linear is a constant linear map of (z, y, mean rate, change of the rate). The exact map
is stable where the rotor is; the map of the fourth-order Runge-Kutta method is what the source integrated.
"""

import math
from dataclasses import dataclass, fields, replace
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from nav.errors import HilError
from nav.exponential import ComplexArray, exponential_differences, exponential_integrals
from nav.increments import FloatArray
from nav.kernel import kernel

Method = Literal["exact", "rk4"]


@dataclass(frozen=True, slots=True)
class Rotor:
    """A rotor, its suspension and its rebalance loop. The motion knows only the ratios of the first five.

    Attributes
    ----------
    equatorial_inertia : float
        A: of the rotor and half the gimbal ring, kg m^2.
    polar_inertia : float
        J: of rotor and ring, kg m^2.
    damping : float
        f: of the flexures, N m s.
    stiffness : float
        k: what the tuning leaves, N m.
    cross_stiffness : float
        D: all of the torque across the tilt, f Omega and that of the loop, N m.
    spin : float
        Omega, rad/s.

    Raises
    ------
    HilError
        A value is not finite, an inertia or the spin is not positive, damping or D is negative.
    """

    equatorial_inertia: float
    polar_inertia: float
    damping: float
    stiffness: float
    cross_stiffness: float
    spin: float

    def __post_init__(self) -> None:
        for field in fields(self):
            value = getattr(self, field.name)
            if not math.isfinite(value):
                raise HilError(f"rotor: {field.name} is {value}; expected a finite number")
        for name in ("equatorial_inertia", "polar_inertia", "spin"):
            if getattr(self, name) <= 0.0:
                raise HilError(f"rotor: {name} is {getattr(self, name):g}; expected more than 0")
        for name in ("damping", "cross_stiffness"):
            if getattr(self, name) < 0.0:
                raise HilError(f"rotor: {name} is {getattr(self, name):g}; expected 0 or more")

    @staticmethod
    def from_ratios(spin: float, polar: float, cross: float, damping: float, stiffness: float = 0.0) -> "Rotor":
        """The rotor with A = 1 from the ratios that fix its motion.

        Parameters
        ----------
        spin : float
            Omega, rad/s.
        polar, cross, damping, stiffness : float
            J/A; D/J, 1/s^2; f/A, 1/s; k/A, 1/s^2.
        """
        return Rotor(1.0, polar, damping, stiffness, cross * polar, spin)

    @property
    def angular_momentum(self) -> float:
        """H = J Omega, N m s."""
        return self.polar_inertia * self.spin

    @property
    def lag(self) -> float:
        """T = H/D of the rate output, s; infinite where nothing holds the rotor."""
        return self.angular_momentum / self.cross_stiffness if self.cross_stiffness > 0.0 else math.inf

    @property
    def loop_gain(self) -> float:
        """K = D - f Omega, N m."""
        return self.cross_stiffness - self.damping * self.spin

    def with_loop_gain(self, gain: float) -> "Rotor":
        """The rotor in a loop of gain K, N m; K = 0 opens the loop, and the tilts integrate the rate with a leak."""
        return replace(self, cross_stiffness=self.damping * self.spin + gain)

    def modes(self) -> tuple[complex, complex]:
        """Eigenvalues of the free motion, 1/s: nutation near jH/A, and the lag near -D/H."""
        p = complex(self.damping, -self.angular_momentum) / self.equatorial_inertia
        q = complex(self.stiffness, -self.cross_stiffness) / self.equatorial_inertia
        half = np.sqrt(0.25 * p * p - q)
        fast = -0.5 * p + (half if (half * np.conj(p)).real <= 0.0 else -half)
        return complex(fast), complex(q / fast)

    def angle_per_rate(self, s: ArrayLike) -> ComplexArray:
        """z / w for rates that go as exp(s t), rad per rad/s: (jH - A s) / (A s^2 + (f - jH) s + k - jD).

        Raises
        ------
        HilError
            s is one of the modes: under that rate z grows without end.
        """
        s = np.asarray(s, np.complex128)
        h = 1j * self.angular_momentum
        below = (self.equatorial_inertia * s + self.damping - h) * s + complex(self.stiffness, -self.cross_stiffness)
        if not below.all():
            raise HilError("rotor: the rate is at one of its modes, z has no bound; give it damping or a loop")
        ratio: ComplexArray = (h - self.equatorial_inertia * s) / below
        return ratio

    def settled(self, rate: tuple[float, float] = (0.0, 0.0)) -> ComplexArray:
        """State (z, y) under a rate (w_x, w_y) that has been constant for long, rad/s."""
        w = complex(*rate)
        return np.array([w * self.angle_per_rate(0.0) if w else 0.0, w], np.complex128)


SOURCE = Rotor.from_ratios(2.0 * math.pi * 228.0, 4.0 / 3.0, 10694.0, 2.9)
"""Fitted to the two tables of source 001. Its nutation grows: only RK4 at 1 ms keeps it down."""
HEAD = replace(SOURCE, damping=9.0)
"""The simulated head's: the same with enough damping to be stable."""


def generator(rotor: Rotor, step: float) -> ComplexArray:
    """Motion under a linear rate as (Int z dt, z, y, w, change of w over a step)' = G (...), (5, 5)."""
    a = rotor.equatorial_inertia
    g = np.zeros((5, 5), np.complex128)
    g[0, 1] = g[1, 2] = 1.0
    g[1, 3] = -1.0
    g[2, 1] = complex(-rotor.stiffness, rotor.cross_stiffness) / a
    g[2, 2] = complex(-rotor.damping, rotor.angular_momentum) / a
    g[2, 3] = rotor.damping / a
    g[3, 4] = 1.0 / step
    return g


def step_map(rotor: Rotor, step: float, method: Method = "exact") -> ComplexArray:
    """One step as a linear map.

    Parameters
    ----------
    rotor : Rotor
        The rotor.
    step : float
        s.
    method : str
        "exact": the matrix exponential in closed form. "rk4": what a step of the Runge-Kutta method does with (z, y).

    Returns
    -------
    (3, 4) complex
        (z, y, Int z dt) after the step of (z, y) before it, the mean rate in the step, and its change from start to end.

    Raises
    ------
    HilError
        The step is not a positive number, or there is no such method.
    """
    if not (math.isfinite(step) and step > 0.0):
        raise HilError(f"rotor: a step of {step} s; expected a positive number")
    if method == "exact":
        whole = _exponential(rotor, step)
    elif method == "rk4":
        x = step * generator(rotor, step)
        one = np.eye(5)
        whole = one + x @ (one + x @ (one + x @ (one + x / 4.0) / 3.0) / 2.0)
    else:
        raise HilError(f"rotor: unknown method {method!r}; there is: exact, rk4")
    from_start = whole[np.ix_((1, 2, 0), (1, 2, 3, 4))]
    from_start[:, 3] -= 0.5 * from_start[:, 2]  # the rate at the start is the mean less half the change
    return np.ascontiguousarray(from_start)


def _exponential(rotor: Rotor, step: float) -> ComplexArray:
    """exp(step G) by functions of the 2 x 2 part N: phi_k(N) = phi_k(a) + phi_k[a, b] (N - a), a and b its eigenvalues.

    phi and their divided differences are those of :mod:`nav.exponential`: equal eigenvalues are no exception.
    """
    g = generator(rotor, step)
    n, drive = step * g[1:3, 1:3], step * g[1:3, 3]
    b, a = (step * mode for mode in rotor.modes())
    at_a, between = exponential_integrals(a), exponential_differences(a, b)
    phi = [at_a[k] * np.eye(2) + between[k] * (n - a * np.eye(2)) for k in range(4)]
    whole = np.eye(5, dtype=np.complex128)
    whole[1:3, 1:3] = phi[0]
    whole[1:3, 3], whole[1:3, 4] = phi[1] @ drive, phi[2] @ drive
    whole[0, 1:3] = step * phi[1][0]
    whole[0, 3], whole[0, 4] = step * (phi[2] @ drive)[0], step * (phi[3] @ drive)[0]
    whole[3, 4] = 1.0
    return whole


@kernel
def move(
    table: ComplexArray, state: ComplexArray, mean: FloatArray, change: FloatArray, angle: FloatArray, swept: FloatArray
) -> None:
    """Move a rotor through a record of rates; how the record is split over calls changes no bit.

    Parameters
    ----------
    table : (3, 4) complex
        Of `step_map`.
    state : (2,) complex
        z, rad, and y = z' + w, rad/s; advanced in place. Begin with `Rotor.settled`.
    mean : (n, 2) float
        Mean rates in the steps about x and y of the case, rad/s.
    change : (n, 2) float
        Rate at the end of each step less that at its start, rad/s.
    angle : (n, 2) float
        Out: alpha and beta at the end of each step, rad.
    swept : (n, 2) float
        Out: their integrals over each step, rad s.
    """
    z, y = state[0], state[1]
    for k in range(mean.shape[0]):
        w, dw = complex(mean[k, 0], mean[k, 1]), complex(change[k, 0], change[k, 1])
        s = table[2, 0] * z + table[2, 1] * y + table[2, 2] * w + table[2, 3] * dw
        z, y = (
            table[0, 0] * z + table[0, 1] * y + table[0, 2] * w + table[0, 3] * dw,
            table[1, 0] * z + table[1, 1] * y + table[1, 2] * w + table[1, 3] * dw,
        )
        angle[k, 0], angle[k, 1] = z.real, z.imag
        swept[k, 0], swept[k, 1] = s.real, s.imag
    state[0], state[1] = z, y


def respond(
    rotor: Rotor, rate: ArrayLike, step: float, method: Method = "exact", state: ComplexArray | None = None
) -> tuple[FloatArray, FloatArray]:
    """Tilts of a rotor under sampled rates, linear between the samples.

    Parameters
    ----------
    rotor : Rotor
        The rotor.
    rate : (n + 1, 2) float
        Rates about x and y of the case at the start and at the end of each step, rad/s.
    step : float
        s.
    method : str
        As in `step_map`.
    state : (2,) complex, optional
        As in `move`; at rest where it is not given.

    Returns
    -------
    angle, swept : (n, 2) float
        Tilts at the end of each step, rad, and their integrals over it, rad s.

    Raises
    ------
    HilError
        As `step_map`; the rates do not have the shape, or the tilts outgrow all numbers.
    """
    w = np.asarray(rate, np.float64)
    if w.ndim != 2 or w.shape[1] != 2 or len(w) < 1:
        raise HilError(f"rotor: rates of shape {w.shape}; expected (n + 1, 2)")
    angle, swept = np.empty((len(w) - 1, 2)), np.empty((len(w) - 1, 2))
    table = step_map(rotor, step, method)
    move(table, rotor.settled() if state is None else state, 0.5 * (w[1:] + w[:-1]), np.diff(w, axis=0), angle, swept)
    if len(angle) and not np.isfinite(angle[-1] + swept[-1]).all():
        raise HilError("rotor: the tilts are not finite; see that the rates are and that the rotor is stable")
    return angle, swept
