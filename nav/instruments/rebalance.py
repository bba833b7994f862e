"""Pendulum accelerometers in motion: the rebalance loop of :mod:`nav.instruments.pendulum`, step by step.

The torque is proportional to the deflection, its rate and its integral, up to the limit; beyond it the torque and the
integral stand still and the pendulum moves to its stops. The output of a step is the integral of torque / (m l).
"""

import math
from collections.abc import Sequence

import numpy as np

from nav.errors import HilError
from nav.increments import FloatArray, IntArray
from nav.instruments.pendulum import GEOMETRY, RADIUS, Pendulum, apparent_force_at, geometry
from nav.kernel import inline_kernel, kernel

_RANGE, _STOP, _GAINS, _WHOLE, _HALF = GEOMETRY, GEOMETRY + 1, GEOMETRY + 2, GEOMETRY + 5, GEOMETRY + 23
"""Where the kernel finds the loop of a pendulum: after its geometry, limit, stop, gains, and the rows that take the state
and three inputs to the state after a step, and to the deflection after half of it."""


def _exponential(matrix: FloatArray) -> FloatArray:
    """Matrix exponential: Taylor series of the matrix over 2^8, squared eight times; exact for norms up to some tens."""
    small = matrix / 2.0**8
    term = total = np.eye(len(matrix))
    for k in range(1, 16):
        term = term @ small / k
        total = total + term
    for _ in range(8):
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
            geometry(pendulum),
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
    saturated: IntArray,
) -> None:
    """Steps of all pendulums; `saturated` counts the steps at the limit."""
    for j in range(len(parameters)):
        p = parameters[j]
        s0, s1, s2 = state[j, 0], state[j, 1], state[j, 2]
        limit, stop = p[_RANGE], p[_STOP]
        scale = step * step / p[RADIUS]
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
            f0 = apparent_force_at(p, force[a], rate[a], cx - dx, cy - dy, cz - dz, s1)
            fm = apparent_force_at(p, force[m], rate[m], cx, cy, cz, s1)
            f1 = apparent_force_at(p, force[b], rate[b], cx + dx, cy + dy, cz + dz, s1)
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
                fm = apparent_force_at(p, force[m], rate[m], cx, cy, cz, half)
                f1 = apparent_force_at(p, force[b], rate[b], cx + dx, cy + dy, cz + dz, end)
                g0, gm, g1 = scale * f0, scale * fm, scale * f1
                t0 = _row(p, _WHOLE, s0, s1, s2, g0, gm, g1)
                t1 = _row(p, _WHOLE + 6, s0, s1, s2, g0, gm, g1)
                t2 = _row(p, _WHOLE + 12, s0, s1, s2, g0, gm, g1)
                # The torque's integral by the equation of motion itself.
                total = (f0 + 4.0 * fm + f1) * step / 6.0 - p[RADIUS] * (t2 - s2) / step
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
        self.saturated = np.zeros(len(pendulums), np.int64)
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
