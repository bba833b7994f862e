"""What boards integrate themselves, and the integrals that the navigator takes.

A board with coning and sculling inside delivers for each step the rotation vector phi of its axes and the velocity
change u in the axes of the step's start. The navigator takes the plain integrals of rate and force in body axes and
does the coning itself; given phi it would do it twice. With rate and force linear in time over two steps (Savage 1998,
strapdown integration algorithms, parts 1 and 2):

    phi = dtheta + (dtheta' x dtheta) / 12
    u = J(phi) dvel + (dtheta' x dvel + dvel' x dtheta) / 12

where ' is the step before and J the left Jacobian of rotations. After a gap there is no step before: those terms stay
out.
"""

import math

import numpy as np

from nav.increments import FloatArray, IntArray
from nav.kernel import inline_kernel, kernel

PAST = 8
"""Length of what is kept of the step before: its sequence number, phi, u, and whether there is one."""


@inline_kernel
def _cross(a: FloatArray, b: FloatArray, i: int) -> float:
    j, k = (i + 1) % 3, (i + 2) % 3
    return float(a[j] * b[k] - a[k] * b[j])


@kernel
def to_integrals(phi: FloatArray, u: FloatArray, coned: IntArray, sequence: IntArray, past: FloatArray) -> None:
    """Turn board increments into integrals, in place.

    Parameters
    ----------
    phi, u : (n, 3) float
        Rotation vectors, rad, and velocity changes, m/s; on return the integrals of rate and force.
    coned : (n,) int
        0 where a row holds plain integrals already: it is left alone.
    sequence : (n,) int
        Sample numbers.
    past : (8,) float
        The step before the first row, see `PAST`; renewed. Zeros at first.
    """
    angle, velocity, product = np.empty(3), np.empty(3), np.empty(3)
    for n in range(phi.shape[0]):
        if not coned[n]:
            past[7] = 0.0
            continue
        angle[:], velocity[:] = phi[n], u[n]
        follows = past[7] != 0.0 and past[0] + 1.0 == sequence[n]
        if follows:
            before, before_u = past[1:4], past[4:7]
            for i in range(3):
                phi[n, i] -= _cross(before, angle, i) / 12.0
                u[n, i] -= (_cross(before, velocity, i) + _cross(before_u, angle, i)) / 12.0
        for i in range(3):
            product[i] = _cross(angle, u[n], i)
        size = angle[0] ** 2 + angle[1] ** 2 + angle[2] ** 2
        double = 1.0 / 12.0 + size / 720.0
        for i in range(3):
            u[n, i] += double * _cross(angle, product, i) - 0.5 * product[i]
        past[0], past[1:4], past[4:7], past[7] = sequence[n], angle, velocity, 1.0


def from_integrals(dtheta: FloatArray, dvel: FloatArray, before: FloatArray) -> tuple[FloatArray, FloatArray]:
    """What a board with coning and sculling inside delivers for integrals of rate and force, for the emulators.

    Parameters
    ----------
    dtheta, dvel : (n, 3) float
        Integrals of rate, rad, and force, m/s.
    before : (2, 3) float
        Both of the step before the first; renewed. Zeros at first.

    Returns
    -------
    phi, u : (n, 3) float
        Rotation vectors, rad, and velocity changes, m/s.
    """
    angles, velocities = np.concatenate([before[:1], dtheta]), np.concatenate([before[1:], dvel])
    phi, u = dtheta + np.cross(angles[:-1], angles[1:]) / 12.0, np.empty_like(dvel)
    for n, (angle, velocity) in enumerate(zip(phi, dvel, strict=True)):
        size = math.sqrt(angle @ angle)
        single = 0.5 if size < 1e-4 else (1.0 - math.cos(size)) / size**2
        double = 1.0 / 6.0 if size < 1e-4 else (size - math.sin(size)) / size**3
        turned = np.cross(angle, velocity)
        u[n] = velocity + single * turned + double * np.cross(angle, turned)
    u += (np.cross(angles[:-1], velocities[1:]) + np.cross(velocities[:-1], angles[1:])) / 12.0
    before[0], before[1] = angles[-1], velocities[-1]
    return phi, u
