"""Vectors of a motion as the sensors have them: integrals of specific force in the body axes at the start, with derivatives.

With b0 the body axes at the start, held inertially, and a = C_b0b f:

    alpha = int a dt,   gamma = int alpha dt

A gyro bias turns C_b0b by Phi = int C_b0b dt times itself, so that alpha has the derivatives ``-int [a x] Phi dt`` by it
and Phi by the accelerometers' bias; those of gamma are their integrals.
"""

from nav.increments import FloatArray
from nav.kernel import kernel
from nav.turn import cross, matrix_from_quaternion, multiply, normalise, rotate

Q, ALPHA, GAMMA, MEAN = slice(0, 4), slice(4, 7), slice(7, 10), slice(10, 13)
TURNED, ALPHA_BY_GYRO, ALPHA_BY_FORCE = slice(13, 22), slice(22, 31), slice(13, 22)
GAMMA_BY_GYRO, GAMMA_BY_FORCE = slice(31, 40), slice(40, 49)
STATE = 68
"""q_b0b | alpha | gamma | mean of a over the last step | Phi and the other derivatives, (3, 3) row by row | room to work."""
_PHI, _ALPHA_BY, _GAMMA_BY, _PSI = 13, 22, 31, 40


@kernel
def carry(state: FloatArray, step: FloatArray, dq: FloatArray, dv: FloatArray, ds: FloatArray) -> None:
    """Carry the vectors over steps.

    Parameters
    ----------
    state : (STATE,) float
        Zeros but for q_b0b = (1, 0, 0, 0) at the start; updated in place.
    step : (n,) float
        s.
    dq, dv, ds : (n, 4), (n, 3), (n, 3) float
        Body integrals (:mod:`nav.body_integrals`).
    """
    q, alpha, gamma, mean = state[0:4], state[4:7], state[7:10], state[10:13]
    turn, pushed, moved = state[49:53], state[53:56], state[56:59]
    c = state[59:68].reshape((3, 3))
    for k in range(step.shape[0]):
        t = step[k]
        if t <= 0.0:
            continue
        rotate(q, dv[k], pushed)
        rotate(q, ds[k], moved)
        for i in range(3):
            gamma[i] += t * alpha[i] + moved[i]
            alpha[i] += pushed[i]
            mean[i] = pushed[i] / t
        turn[0], turn[1], turn[2], turn[3] = 1.0 + dq[k, 0], dq[k, 1], dq[k, 2], dq[k, 3]
        matrix_from_quaternion(q, c)
        multiply(q, turn, q)
        normalise(q)
        for j in range(3):  # in the middle of the step: the derivatives serve a covariance only
            x = state[_PHI + j] + 0.5 * t * c[0, j]
            y = state[_PHI + 3 + j] + 0.5 * t * c[1, j]
            z = state[_PHI + 6 + j] + 0.5 * t * c[2, j]
            x, y, z = cross(x, y, z, pushed[0], pushed[1], pushed[2])
            state[_GAMMA_BY + j] += t * (state[_ALPHA_BY + j] + 0.5 * x)
            state[_GAMMA_BY + 3 + j] += t * (state[_ALPHA_BY + 3 + j] + 0.5 * y)
            state[_GAMMA_BY + 6 + j] += t * (state[_ALPHA_BY + 6 + j] + 0.5 * z)
            state[_ALPHA_BY + j] += x
            state[_ALPHA_BY + 3 + j] += y
            state[_ALPHA_BY + 6 + j] += z
            for i in range(3):
                state[_PSI + 3 * i + j] += t * (state[_PHI + 3 * i + j] + 0.5 * t * c[i, j])
                state[_PHI + 3 * i + j] += t * c[i, j]
