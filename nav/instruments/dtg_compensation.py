"""Lag compensation of dynamically tuned gyros: from the increments of the torquer current to those of the rate.

The rotor's equation (:mod:`nav.instruments.dtg`), integrated over a step, needs no differentiation:

    Int w dt = -(1 + j (f/H - A (D + jk)/H^2)) dz - ((D + jk)/H) Int z dt

The term with A stands for the slow part of A (z'' + w'). A head sends -(D/H) Int z dt and z at the end of each step; where
it does not send z, that of the cubic through the last four increments is taken.
"""

import math

import numpy as np

from nav.errors import HilError
from nav.exponential import ComplexArray
from nav.increments import FloatArray, HeadIncrements, IntArray
from nav.instruments.dtg import HEAD, Rotor
from nav.kernel import inline_kernel, kernel

WINDOW = 4
"""Increments of the cubic."""
_ON_INCREMENT, _ON_ANGLE, _LAG = range(3)
_SEQUENCE, _FILLED, _KNOWN = 0, 1, 2  # _KNOWN, and one more for the second gyro: whether the last z is there


def coefficients(rotor: Rotor) -> ComplexArray:
    """What the increment of the torquer current, the change of z, and z / w_hat are multiplied by: (3,) complex.

    Raises
    ------
    HilError
        Nothing holds the rotor: D is 0 and the gyro gives no rate.
    """
    a, d, h = rotor.equatorial_inertia, rotor.cross_stiffness, rotor.angular_momentum
    if d == 0.0:
        raise HilError("lag compensation: the rotor's cross_stiffness is 0; close the loop with Rotor.with_loop_gain")
    on_angle = -(1.0 + 1j * (rotor.damping / h - a * complex(d, rotor.stiffness) / h**2))
    return np.array([complex(1.0, rotor.stiffness / d), on_angle, -rotor.lag])


@inline_kernel
def end_weights(h1: float, h2: float, h3: float, h4: float) -> tuple[float, float, float, float]:
    """Weights of the integrals over four steps of which the cubic with these integrals makes its value at the end.

    Parameters
    ----------
    h1, h2, h3, h4 : float
        Steps, s, the newest first, as are the weights, 1/s.
    """
    a, b, c, d = h1, h1 + h2, h1 + h2 + h3, h1 + h2 + h3 + h4
    at_d = a * b * c / (d * (d - a) * (d - b) * (d - c))
    at_c = a * b * d / (c * (c - a) * (c - b) * (d - c))
    at_b = a * c * d / (b * (b - a) * (c - b) * (d - b))
    at_a = b * c * d / (a * (b - a) * (c - a) * (d - a))
    return at_a - at_b + at_c - at_d, at_c - at_b - at_d, at_c - at_d, -at_d


@inline_kernel
def _at_edge(steps: FloatArray, increments: FloatArray, gyro: int, end: bool) -> complex:
    """Rate of the cubic through the window at its end, or at its start."""
    i0, i1, i2, i3 = (3, 2, 1, 0) if end else (0, 1, 2, 3)
    v0, v1, v2, v3 = end_weights(steps[i0], steps[i1], steps[i2], steps[i3])
    x, y = 2 * gyro, 2 * gyro + 1
    return complex(
        v0 * increments[i0, x] + v1 * increments[i1, x] + v2 * increments[i2, x] + v3 * increments[i3, x],
        v0 * increments[i0, y] + v1 * increments[i1, y] + v2 * increments[i2, y] + v3 * increments[i3, y],
    )


@inline_kernel
def _mean(steps: FloatArray, increments: FloatArray, gyro: int, filled: int) -> complex:
    """Mean rate over what there is of the window."""
    time, x, y = 0.0, 0.0, 0.0
    for i in range(WINDOW - filled, WINDOW):
        time += steps[i]
        x += increments[i, 2 * gyro]
        y += increments[i, 2 * gyro + 1]
    return complex(x / time, y / time)


@kernel
def take_off_lag(
    parts: tuple[ComplexArray, IntArray, ComplexArray, FloatArray, FloatArray],
    sequence: IntArray,
    step: FloatArray,
    dtheta: FloatArray,
    rotor: FloatArray,
    out: FloatArray,
) -> int:
    """`LagCompensator.compensate` with its `parts`; the row of the first sample that cannot be, or -1."""
    table, counts, last, steps, increments = parts
    for k in range(step.shape[0]):
        total = step[k] + dtheta[k, 0] + dtheta[k, 1] + dtheta[k, 2] + dtheta[k, 3]
        if not (math.isfinite(total) and step[k] > 0.0):
            return k
        if sequence[k] != counts[_SEQUENCE] + 1:
            counts[_FILLED] = counts[_KNOWN] = counts[_KNOWN + 1] = 0
        counts[_SEQUENCE] = sequence[k]
        for i in range(WINDOW - 1):
            steps[i] = steps[i + 1]
            for c in range(4):
                increments[i, c] = increments[i + 1, c]
        steps[WINDOW - 1] = step[k]
        for c in range(4):
            increments[WINDOW - 1, c] = dtheta[k, c]
        filled = counts[_FILLED] = min(counts[_FILLED] + 1, WINDOW)
        for gyro in range(2):
            x, y = 2 * gyro, 2 * gyro + 1
            lag = table[gyro, _LAG]
            z = complex(rotor[k, x], rotor[k, y])
            sent = math.isfinite(z.real + z.imag)
            if not sent and filled == WINDOW:
                z = lag * _at_edge(steps, increments, gyro, True)
            dz = complex(0.0, 0.0)
            if sent or filled == WINDOW:
                if counts[_KNOWN + gyro]:
                    dz = z - last[gyro]
                elif filled == WINDOW:
                    dz = z - lag * _at_edge(steps, increments, gyro, False)
                else:
                    dz = 2.0 * (z - lag * _mean(steps, increments, gyro, filled))
                last[gyro] = z
                counts[_KNOWN + gyro] = 1
            w = table[gyro, _ON_INCREMENT] * complex(dtheta[k, x], dtheta[k, y]) + table[gyro, _ON_ANGLE] * dz
            out[k, x], out[k, y] = w.real, w.imag
    return -1


class LagCompensator:
    """Compensates the four axes of a head as samples come; how they are split over calls changes no bit.

    Gyro 1 spins along head z and has the case axes x, y; gyro 2 spins along head x and has y, z. A sample whose
    number does not follow that of the one before begins anew. What the rotor did before is then taken from the
    mean of the first step (z linear in it), or, without z, from the cubic through the first four increments:
    the first three pass as they are, and the fourth carries the change of z over all of them.

    Parameters
    ----------
    gyro_1, gyro_2 : Rotor
        What the gyros are taken for.

    Raises
    ------
    HilError
        As `coefficients`.
    """

    def __init__(self, gyro_1: Rotor = HEAD, gyro_2: Rotor = HEAD) -> None:
        table, last = np.array([coefficients(gyro_1), coefficients(gyro_2)]), np.zeros(2, np.complex128)
        self.parts = table, np.zeros(4, np.int64), last, np.zeros(WINDOW), np.zeros((WINDOW, 4))
        """For kernels (`take_off_lag`): coefficients, what is known, last rotor angles, the window."""

    def compensate(self, head: HeadIncrements, out: FloatArray) -> None:
        """The increments of a batch without the lag; allocates nothing.

        Parameters
        ----------
        head : HeadIncrements
            Samples; rotor angles that are not finite count as not sent.
        out : (n, 4) float
            Out: integrals of the rate about g1x, g1y, g2y, g2z, rad. May be ``head.dtheta``.

        Raises
        ------
        HilError
            An increment is not finite, or a step is not positive.
        """
        bad = take_off_lag(self.parts, head.sequence, head.step, head.dtheta, head.rotor, out)
        if bad >= 0:
            raise HilError(
                f"lag compensation: sample {head.sequence[bad]} has a step of {head.step[bad]} s and increments "
                f"{head.dtheta[bad].tolist()} rad; expected a positive step and finite numbers"
            )
