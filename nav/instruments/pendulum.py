"""The pendulum accelerometer: a rebalanced pendulum in a turning block (source 002/Babich, sec. 1).

Pendulum axes, right-handed and fixed in the block: xi senses, eta is the hinge, the centre of mass lies at hinge - l zeta.
O is the navigated point of the block, f the specific force there, w the rate of the block, e its angular acceleration, phi
the deflection about eta. With J = B + m l^2 and the sensing axis xi' of the deflected pendulum, eq. 1.5 is

    (J / ml) phi'' = F(phi) - u / ml
    F(phi) = f_h . xi' - (J / ml) e_eta - (l + (A - C) / ml) w_xi' w_zeta'

where f_h is the specific force at the hinge and u the rebalance torque, proportional, damping and integral. The output is
u / (m l); without deflection it is F(0), the equilibrium form of eq. 1.7.
"""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from nav.errors import HilError
from nav.increments import FloatArray
from nav.kernel import inline_kernel, kernel

Vector = tuple[float, float, float]
Axes = tuple[Vector, Vector, Vector]

_HINGE, RADIUS, _MIXED, GEOMETRY = 9, 12, 13, 14
"""Where the kernels find the geometry of a pendulum: its axes, then these; J / (m l) at `RADIUS`; `GEOMETRY` floats."""


@dataclass(frozen=True, slots=True)
class Pendulum:
    """A pendulum accelerometer in its place in the block.

    Attributes
    ----------
    mass : float
        m, kg.
    arm : float
        l, hinge to centre of mass, m.
    inertia : (3,) tuple of float
        A, B, C: central moments of inertia about xi, eta, zeta, kg m^2.
    hinge : (3,) tuple of float
        Place of the hinge from O, in block axes, m.
    axes : (3, 3) tuple of float
        xi, eta, zeta as rows, in block axes.
    frequency_hz : float
        Natural frequency of proportional torque and inertia.
    damping : float
        Damping ratio of the loop without its integral.
    integral : float
        Integral over proportional torque, 1/s.
    limit : float
        Largest output, m/s^2.
    stop : float
        Deflection at which the pendulum rests on its stops, rad.

    Raises
    ------
    HilError
        A value is not possible, or the loop is not stable.
    """

    mass: float = 1.0e-3
    arm: float = 8.0e-3
    inertia: Vector = (2.2e-7, 1.744e-7, 0.6e-7)
    hinge: Vector = (0.0, 0.0, 0.0)
    axes: Axes = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
    frequency_hz: float = 800.0
    damping: float = 0.7
    integral: float = 400.0
    limit: float = 300.0
    stop: float = 5.0e-3

    def __post_init__(self) -> None:
        """Refuse what cannot be built."""
        a, b, c = self.inertia
        positive = ("mass", "arm", "frequency_hz", "damping", "limit", "stop")
        for name in positive:
            if not 0.0 < getattr(self, name) < math.inf:
                raise HilError(f"pendulum: {name} is {getattr(self, name):g}; it must be positive")
        if not (min(a, b, c) > 0.0 and 2.0 * max(a, b, c) <= (1.0 + 1e-9) * (a + b + c) < math.inf):
            raise HilError(
                f"pendulum: no body has the inertias {a:g}, {b:g}, {c:g}; each is at most the sum of the others"
            )
        if not 0.0 <= self.integral < 4.0 * math.pi * self.frequency_hz * self.damping:
            raise HilError(
                f"pendulum: the loop is unstable with integral {self.integral:g} 1/s; it must be 0 or more and below "
                f"4 pi frequency damping, {4.0 * math.pi * self.frequency_hz * self.damping:.0f} 1/s"
            )
        if not self.stop < 0.1:
            raise HilError(f"pendulum: stop is {self.stop:g} rad; it must be below 0.1")
        if not np.isfinite(self.hinge).all():
            raise HilError(f"pendulum: the place of the hinge, {self.hinge}, is not finite")
        axes = np.asarray(self.axes, np.float64)
        if axes.shape != (3, 3) or not np.allclose(axes @ axes.T, np.eye(3), atol=1e-9) or np.linalg.det(axes) < 0.0:
            raise HilError(
                "pendulum: axes must be xi, eta, zeta as rows, unit, mutually at right angles and right-handed"
            )

    @property
    def percussion_radius(self) -> float:
        """J / (m l), hinge to centre of percussion, m."""
        return self.inertia[1] / (self.mass * self.arm) + self.arm

    @property
    def centre_of_percussion(self) -> FloatArray:
        """Its place from O in block axes, m: (3,)."""
        place: FloatArray = np.asarray(self.hinge) - self.percussion_radius * np.asarray(self.axes)[2]
        return place

    @property
    def anisoinertia(self) -> float:
        """(B + C - A) / (m l), m: what is left of the size effect in the best place, by w_xi w_zeta (eq. 1.9)."""
        a, b, c = self.inertia
        return (b + c - a) / (self.mass * self.arm)

    @property
    def coefficients(self) -> tuple[float, float, float, float]:
        """M, N, L and eta0 of the equilibrium form, m (eq. 1.7).

        u / ml = f_xi + M w_xi w_zeta + N (w_eta^2 + w_zeta^2) + L e_eta + eta0 (w_xi w_eta - e_zeta)
        """
        xi0, eta0, zeta0 = map(float, np.asarray(self.axes) @ self.hinge)
        a, _, c = self.inertia
        return zeta0 - self.arm - (a - c) / (self.mass * self.arm), -xi0, zeta0 - self.percussion_radius, eta0


def best_hinge(pendulum: Pendulum) -> Vector:
    """Best place of the hinge: the centre of percussion in O, by which N = L = eta0 = 0 (eq. 1.8)."""
    x, y, z = pendulum.percussion_radius * np.asarray(pendulum.axes)[2]
    return float(x), float(y), float(z)


@inline_kernel
def apparent_force_at(
    p: FloatArray, force: FloatArray, rate: FloatArray, ex: float, ey: float, ez: float, deflection: float
) -> float:
    """F(phi) from force, rate and angular acceleration in block axes."""
    x, y, z = p[_HINGE], p[_HINGE + 1], p[_HINGE + 2]
    wx = p[0] * rate[0] + p[1] * rate[1] + p[2] * rate[2]
    wy = p[3] * rate[0] + p[4] * rate[1] + p[5] * rate[2]
    wz = p[6] * rate[0] + p[7] * rate[1] + p[8] * rate[2]
    e_xi = p[0] * ex + p[1] * ey + p[2] * ez
    e_eta = p[3] * ex + p[4] * ey + p[5] * ez
    e_zeta = p[6] * ex + p[7] * ey + p[8] * ez
    along = wx * x + wy * y + wz * z
    square = wx * wx + wy * wy + wz * wz
    f_xi = p[0] * force[0] + p[1] * force[1] + p[2] * force[2] + e_eta * z - e_zeta * y + wx * along - x * square
    f_zeta = p[6] * force[0] + p[7] * force[1] + p[8] * force[2] + e_xi * y - e_eta * x + wz * along - z * square
    s, c = math.sin(deflection), math.cos(deflection)
    value: float = (
        c * f_xi - s * f_zeta - p[RADIUS] * e_eta - p[_MIXED] * (c * wx - s * wz) * (s * wx + c * wz)  # w_xi' w_zeta'
    )
    return value


@kernel
def _apparent_forces(
    p: FloatArray, force: FloatArray, rate: FloatArray, acceleration: FloatArray, deflection: float, out: FloatArray
) -> None:
    for k in range(len(out)):
        e = acceleration[k]
        out[k] = apparent_force_at(p, force[k], rate[k], e[0], e[1], e[2], deflection)


def geometry(pendulum: Pendulum) -> FloatArray:
    """What `apparent_force_at` needs: (GEOMETRY,) floats."""
    a, _, c = pendulum.inertia
    mixed = pendulum.arm + (a - c) / (pendulum.mass * pendulum.arm)
    hinge = np.asarray(pendulum.axes) @ pendulum.hinge
    return np.concatenate([np.ravel(pendulum.axes), hinge, [pendulum.percussion_radius, mixed]])


def apparent_force(
    pendulum: Pendulum, force: ArrayLike, rate: ArrayLike, acceleration: ArrayLike, deflection: float = 0.0
) -> FloatArray:
    """F(phi): what drives the pendulum, and the output where nothing moves it.

    Parameters
    ----------
    pendulum : Pendulum
        In its place.
    force : (n, 3) array_like
        Specific force at O, block axes, m/s^2.
    rate, acceleration : (n, 3) array_like
        Rate and angular acceleration of the block, rad/s and rad/s^2.
    deflection : float
        phi, rad.

    Returns
    -------
    (n,) float
        m/s^2.
    """
    inputs = [
        np.ascontiguousarray(np.atleast_2d(np.asarray(value, np.float64))) for value in (force, rate, acceleration)
    ]
    out = np.empty(len(inputs[0]))
    _apparent_forces(geometry(pendulum), inputs[0], inputs[1], inputs[2], float(deflection), out)
    return out
