"""Which way the axes of a board point, where they lie along those of the body: signed permutations, and which of them fits.

``v_b = C v`` with one 1 or -1 in each row and column of C. Of the 48 such matrices 24 are rotations: ways to mount a board. The
others are left-handed: two axes are swapped, or a sign is wrong, in the board or in what reads it; no mounting mends that.

A rate is integrated before it is compared. Of -w the integral is another rotation than the inverse, so that both are needed: with
a left-handed ``C = -P`` the integral of C w is P times that of -w.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import permutations, product

import numpy as np
from numpy.typing import ArrayLike

from nav.earth import STANDARD_GRAVITY
from nav.errors import HilError
from nav.increments import FloatArray, ImuIncrements
from nav.rotation import dcm_from_quaternion, orthonormal, quaternion_from_rotation_vector
from nav.rotation import product as q_product

Names = tuple[str, str, str]
NAMES = ("x", "y", "z")
MISFIT = 1e-3
"""Largest element of C C' - I of a matrix that somebody has written down."""
HALF_S = 0.1
"""Half of the time over which a specific force is averaged where a board moves, s."""
APART = 5
"""Specific forces so many averages apart are compared: 1 s."""
LEAST_TURN = math.radians(10.0)
"""Gravity must have turned by so much between them."""
SHAKEN = 0.15
"""An average that is further from 1 g, as a share, is no gravity."""
_ALIKE, _CLOSE = 1.5, math.radians(5.0)
"""What fits as well as the best: by that factor, and that angle."""


def _signed() -> FloatArray:
    orders, signs = permutations(range(3)), list(product((1.0, -1.0), repeat=3))
    every = [np.diag(sign)[:, list(order)] for order in orders for sign in signs]
    return np.array(sorted(every, key=lambda c: -np.linalg.det(c)))


SIGNED = _signed()
"""(48, 3, 3): the signed permutations, the 24 rotations first."""
ROTATIONS = 24


def matrix(names: Sequence[str]) -> FloatArray:
    """C (3, 3) of the names of the board's axes that point forward, right and down, as ``("y", "x", "-z")``.

    Raises
    ------
    HilError
        An axis is named twice, or the three are left-handed.
    """
    c = np.zeros((3, 3))
    for row, name in enumerate(names):
        c[row, NAMES.index(name.removeprefix("-"))] = -1.0 if name.startswith("-") else 1.0
    if (np.abs(c).sum(axis=0) != 1.0).any():
        raise HilError(f"{list(names)}: each of x, y, z must stand there once, with or without a minus")
    if np.linalg.det(c) < 0.0:
        raise HilError(
            f"{list(names)} is left-handed: no way to turn a board does that; one sign is wrong, or two axes are swapped"
        )
    return c


def named(c: FloatArray) -> Names:
    """The names of a signed permutation, as `matrix` reads them."""
    column = np.abs(c).argmax(axis=1)
    x, y, z = (("-" if c[row, k] < 0.0 else "") + NAMES[k] for row, k in enumerate(column))
    return x, y, z


def rotation(rows: ArrayLike) -> FloatArray:
    """The rotation nearest to a matrix (3, 3) that was written down with a few digits.

    Raises
    ------
    HilError
        It is no rotation, by more than `MISFIT`, or left-handed.
    """
    c = np.asarray(rows, float)
    defect = float(np.abs(c @ c.T - np.eye(3)).max())
    if defect > MISFIT:
        raise HilError(
            f"rows are not of length 1 and at right angles: C C' leaves I by {defect:.2g}, {MISFIT:g} is allowed"
        )
    if np.linalg.det(c) < 0.0:
        raise HilError("the determinant is -1: left-handed, no way to turn a board does that; one sign is wrong")
    return orthonormal(c)


@dataclass(frozen=True, slots=True)
class Fit:
    """The signed permutation that fits best.

    Attributes
    ----------
    c : (3, 3) float
        It.
    off : float
        What it leaves: root of the mean squared angle, rad.
    alike : tuple of (3, 3) float
        All that fit about as well, with `c`: more than one where the directions do not tell.
    """

    c: FloatArray
    off: float
    alike: tuple[FloatArray, ...]

    @property
    def names(self) -> Names:
        """Of `c`."""
        return named(self.c)

    @property
    def left_handed(self) -> bool:
        """No rotation."""
        return bool(np.linalg.det(self.c) < 0.0)

    @property
    def certain(self) -> bool:
        """Nothing else fits."""
        return len(self.alike) == 1

    def allows(self, c: FloatArray) -> bool:
        """Whether `c` fits about as well as the best."""
        return any((one == c).all() for one in self.alike)


def fit(body: FloatArray, right: FloatArray, left: FloatArray) -> Fit:
    """The C that takes directions of a board to known ones of the body.

    Parameters
    ----------
    body : (n, 3) float
        Where they should point.
    right, left : (n, 3) float
        Where the board says that they point, if C is a rotation, and if it is left-handed (of forces the same; of turns see
        the module). Of any length but 0.
    """
    found = np.where(np.arange(len(SIGNED))[:, None, None] < ROTATIONS, right, left)
    return _best(_angles(np.einsum("cij,cnj->cni", SIGNED, found), body))


def gyro_fit(imu: ImuIncrements) -> Fit | None:
    """The C that takes a board's gyro axes to its accelerometer axes, by its motion alone; None where gravity turns too little.

    Gravity stands still while the board turns: in its axes ``du/dt = -w x u``. So the gyros say how the mean specific force turns
    in a second, and C is the one that says it best. The accelerometers are taken to be right-handed: gyros of opposite sign and
    left-handed accelerometers look the same.
    """
    u_before, u_after, right, left = _swings(imu)
    if len(u_before) == 0:
        return None
    turns = np.where(np.arange(len(SIGNED))[:, None, None, None] < ROTATIONS, right, left)
    said = np.einsum("cij,cnjk,clk,nl->cni", SIGNED, turns, SIGNED, u_before, optimize=True)
    return _best(_angles(said, u_after))


def turned(dtheta: FloatArray) -> FloatArray:
    """Quaternion (4,) of increments (n, 3), rad, one after the other: takes vectors from the last axes to the first."""
    q = quaternion_from_rotation_vector(dtheta)
    while len(q) > 1:
        if len(q) % 2:
            q = np.vstack([q, [1.0, 0.0, 0.0, 0.0]])
        q = q_product(q[0::2], q[1::2])
    return q[0] if len(q) else np.array([1.0, 0.0, 0.0, 0.0])


def _swings(imu: ImuIncrements) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Directions of gravity (n, 3) a second apart, and how the gyros turn the first into the second (n, 3, 3), by w and by -w."""
    half = np.floor(np.cumsum(imu.step) / HALF_S - 1e-9).astype(np.int64)
    edges = np.searchsorted(half, np.arange(2 * (half[-1] // 2) + 1)) if len(half) else np.zeros(1, np.int64)
    force, attitudes = [], ([np.eye(3)], [np.eye(3)])
    for k in range(len(edges) - 1):
        part = slice(edges[k], edges[k + 1])
        force.append(imu.dvel[part].sum(axis=0) / max(float(imu.step[part].sum()), 1e-9))
        for sign, chain in zip((1.0, -1.0), attitudes, strict=True):
            chain.append(chain[-1] @ dcm_from_quaternion(turned(sign * imu.dtheta[part])))
    mean = 0.5 * (np.array(force[0::2]).reshape(-1, 3) + np.array(force[1::2]).reshape(-1, 3))
    size = np.linalg.norm(mean, axis=1)
    u = mean / np.where(size > 0.0, size, 1.0)[:, None]
    good = np.abs(size / STANDARD_GRAVITY - 1.0) < SHAKEN
    before, after = u[:-APART], u[APART:]
    used = good[:-APART] & good[APART:] & (np.einsum("ij,ij->i", before, after) < math.cos(LEAST_TURN))
    right, left = (np.array(chain[1::2]).reshape(-1, 3, 3) for chain in attitudes)  # at the middles of the averages
    turns = (np.swapaxes(c[APART:], 1, 2) @ c[:-APART] for c in (right, left))
    return (before[used], after[used], *(c[used] for c in turns))


def _angles(found: FloatArray, expected: FloatArray) -> FloatArray:
    """Root of the mean squared angle (48,) between directions (48, n, 3) and (n, 3)."""
    cosine = np.einsum("cni,ni->cn", found, expected)
    cosine /= np.linalg.norm(found, axis=2) * np.linalg.norm(expected, axis=1)
    angles: FloatArray = np.sqrt(np.mean(np.arccos(np.clip(cosine, -1.0, 1.0)) ** 2, axis=1))
    return angles


def _best(off: FloatArray) -> Fit:
    best = int(off.argmin())
    alike = np.flatnonzero(off <= _ALIKE * off[best] + _CLOSE)
    return Fit(SIGNED[best], float(off[best]), tuple(SIGNED[k] for k in alike))
