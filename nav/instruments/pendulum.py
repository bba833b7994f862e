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
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from nav.errors import HilError
from nav.increments import FloatArray
from nav.kernel import inline_kernel, kernel

Vector = tuple[float, float, float]
Axes = tuple[Vector, Vector, Vector]

_HINGE, _RADIUS, _MIXED, _RANGE, _STOP, _GAINS, _WHOLE, _HALF = 9, 12, 13, 14, 15, 16, 19, 37
"""Where the kernels find the parameters of a pendulum: its axes, then these."""


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
def _apparent_force(
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
        c * f_xi - s * f_zeta - p[_RADIUS] * e_eta - p[_MIXED] * (c * wx - s * wz) * (s * wx + c * wz)  # w_xi' w_zeta'
    )
    return value


@kernel
def _apparent_forces(
    p: FloatArray, force: FloatArray, rate: FloatArray, acceleration: FloatArray, deflection: float, out: FloatArray
) -> None:
    for k in range(len(out)):
        e = acceleration[k]
        out[k] = _apparent_force(p, force[k], rate[k], e[0], e[1], e[2], deflection)


def _geometry(pendulum: Pendulum) -> FloatArray:
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
    _apparent_forces(_geometry(pendulum), inputs[0], inputs[1], inputs[2], float(deflection), out)
    return out


def _exponential(matrix: FloatArray) -> FloatArray:
    """Matrix exponential: Taylor series of the matrix over 2^k, squared k times."""
    squarings = max(0, math.ceil(math.log2(max(1e-300, float(np.abs(matrix).sum(axis=1).max())))) + 3)
    small = matrix / 2.0**squarings
    term = total = np.eye(len(matrix))
    for k in range(1, 16):
        term = term @ small / k
        total = total + term
    for _ in range(squarings):
        total = total @ total
    return total


def _parameters(pendulum: Pendulum, step: float) -> FloatArray:
    """Geometry and loop. The state is (int phi / step, phi, phi' step), its input step^2 F / (J / ml)."""
    turn = 2.0 * math.pi * pendulum.frequency_hz * step
    gains = np.array([turn * turn * pendulum.integral * step, turn * turn, 2.0 * pendulum.damping * turn])
    system = np.zeros((6, 6))  # the state, and the input with its two derivatives
    system[0, 1] = system[1, 2] = system[2, 3] = system[3, 4] = system[4, 5] = 1.0
    system[2, :3] -= gains
    parabola = np.array([[1.0, 0.0, 0.0], [-3.0, 4.0, -1.0], [4.0, -8.0, 4.0]])  # from start, middle and end
    whole, half = _exponential(system)[:3], _exponential(0.5 * system)[1]
    return np.concatenate(
        [
            _geometry(pendulum),
            [pendulum.limit, pendulum.stop],
            pendulum.percussion_radius / step**2 * gains,
            np.hstack([whole[:, :3], whole[:, 3:] @ parabola]).ravel(),
            half[:3],
            half[3:] @ parabola,
        ]
    )


@inline_kernel
def _row(p: FloatArray, at: int, s0: float, s1: float, s2: float, g0: float, gm: float, g1: float) -> float:
    value: float = p[at] * s0 + p[at + 1] * s1 + p[at + 2] * s2 + p[at + 3] * g0 + p[at + 4] * gm + p[at + 5] * g1
    return value


@kernel
def _sense(
    parameters: FloatArray,
    state: FloatArray,
    step: float,
    force: FloatArray,
    rate: FloatArray,
    dvel: FloatArray,
    saturated: FloatArray,
) -> None:
    """Steps of all pendulums; `saturated` counts the steps at the limit."""
    for j in range(len(parameters)):
        p = parameters[j]
        s0, s1, s2 = state[j, 0], state[j, 1], state[j, 2]
        limit, stop = p[_RANGE], p[_STOP]
        scale = step * step / p[_RADIUS]
        for k in range(len(dvel)):
            a, m, b = 2 * k, 2 * k + 1, 2 * k + 2
            ax, ay, az = rate[a, 0], rate[a, 1], rate[a, 2]
            mx, my, mz = rate[m, 0], rate[m, 1], rate[m, 2]
            bx, by, bz = rate[b, 0], rate[b, 1], rate[b, 2]
            # Slopes of the parabola of the rate; its integral of the angular acceleration is exactly the change of rate.
            cx, cy, cz = (bx - ax) / step, (by - ay) / step, (bz - az) / step
            dx, dy, dz = (
                2.0 * (ax - 2.0 * mx + bx) / step,
                2.0 * (ay - 2.0 * my + by) / step,
                2.0 * (az - 2.0 * mz + bz) / step,
            )
            f0 = _apparent_force(p, force[a], rate[a], cx - dx, cy - dy, cz - dz, s1)
            fm = _apparent_force(p, force[m], rate[m], cx, cy, cz, s1)
            f1 = _apparent_force(p, force[b], rate[b], cx + dx, cy + dy, cz + dz, s1)
            command = p[_GAINS] * s0 + p[_GAINS + 1] * s1 + p[_GAINS + 2] * s2
            if abs(command) > limit:  # the torque and the integral stand still
                torque = math.copysign(limit, command)
                g0, gm, g1 = scale * (f0 - torque), scale * (fm - torque), scale * (f1 - torque)
                s1 += s2 + (g0 + 2.0 * gm) / 6.0
                s2 += (g0 + 4.0 * gm + g1) / 6.0
                dvel[k, j] = torque * step
                saturated[j] += 1
            else:
                # F depends on the deflection so little that one prediction of it is exact to rounding.
                half = _row(p, _HALF, s0, s1, s2, scale * f0, scale * fm, scale * f1)
                end = _row(p, _WHOLE + 6, s0, s1, s2, scale * f0, scale * fm, scale * f1)
                fm = _apparent_force(p, force[m], rate[m], cx, cy, cz, half)
                f1 = _apparent_force(p, force[b], rate[b], cx + dx, cy + dy, cz + dz, end)
                g0, gm, g1 = scale * f0, scale * fm, scale * f1
                t0 = _row(p, _WHOLE, s0, s1, s2, g0, gm, g1)
                t1 = _row(p, _WHOLE + 6, s0, s1, s2, g0, gm, g1)
                t2 = _row(p, _WHOLE + 12, s0, s1, s2, g0, gm, g1)
                # The torque's integral by the equation of motion itself.
                total = (f0 + 4.0 * fm + f1) * step / 6.0 - p[_RADIUS] * (t2 - s2) / step
                dvel[k, j] = min(max(total, -limit * step), limit * step)
                s0, s1, s2 = t0, t1, t2
            if abs(s1) > stop:
                s1, s2 = math.copysign(stop, s1), 0.0
        state[j, 0], state[j, 1], state[j, 2] = s0, s1, s2


class PendulumBlock:
    """Pendulums of one block as they move: forces and rates in, velocity increments out.

    Over a step, the input is a parabola through its start, middle and end, for which the loop is solved exactly; a
    deflection changes the input by its own small share, which is predicted. The results do not depend on how the steps
    were split into calls.

    Parameters
    ----------
    pendulums : sequence of Pendulum
        p of them; at rest without deflection at first.
    step : float
        Length of a step, s; at most a quarter of the shortest natural period (8 kHz and more are meant).

    Raises
    ------
    HilError
        The step is too long.
    """

    def __init__(self, pendulums: Sequence[Pendulum], step: float) -> None:
        fastest = max(p.frequency_hz for p in pendulums)
        if not 0.0 < step * fastest <= 0.25:
            raise HilError(
                f"pendulum: a step of {step:g} s is too long for {fastest:g} Hz; take {0.25 / fastest:g} s or less"
            )
        self._step = step
        self._parameters = np.stack([_parameters(p, step) for p in pendulums])
        self._state = np.zeros((len(pendulums), 3))
        self.saturated = np.zeros(len(pendulums))
        """Steps that each pendulum has spent at its limit."""

    @property
    def deflection(self) -> FloatArray:
        """phi of each pendulum, rad: (p,)."""
        return self._state[:, 1].copy()

    def sense(self, force: FloatArray, rate: FloatArray) -> FloatArray:
        """Integrals of the outputs over the next n steps.

        Parameters
        ----------
        force, rate : (2 n + 1, 3) float
            Specific force at O, m/s^2, and rate, rad/s, in block axes, at the start, the middle and the end of each step;
            the last row is the first one of the next call.

        Returns
        -------
        (n, p) float
            m/s, each along its own xi.

        Raises
        ------
        HilError
            The shapes do not fit, or an input is not finite.
        """
        if force.shape != rate.shape or force.shape[1:] != (3,) or len(force) % 2 == 0:
            raise HilError(
                f"pendulum: expected two (2 n + 1, 3) arrays of force and rate, got {force.shape}, {rate.shape}"
            )
        if not (np.isfinite(force).all() and np.isfinite(rate).all()):
            raise HilError("pendulum: a force or a rate is not finite; mend the motion")
        dvel = np.empty((len(force) // 2, len(self._state)))
        _sense(
            self._parameters,
            self._state,
            self._step,
            np.ascontiguousarray(force, np.float64),
            np.ascontiguousarray(rate, np.float64),
            dvel,
            self.saturated,
        )
        return dvel
