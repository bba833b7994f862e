"""Blocks of three pendulum accelerometers: the layouts of source 002/Babich, and the best centre of one that is built.

Channels 1, 2, 3 sense along the block's x, y, z.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from nav.errors import HilError
from nav.increments import FloatArray
from nav.instruments.pendulum import Axes, Pendulum, Vector, best_hinge
from nav.instruments.size_effect import size_coefficients

_X, _Y, _Z = np.eye(3)


def _vector(v: FloatArray) -> Vector:
    return float(v[0]), float(v[1]), float(v[2])


def _axes(xi: FloatArray, zeta: FloatArray) -> Axes:
    return _vector(xi), _vector(np.cross(zeta, xi)), _vector(zeta)


def _at_best(pendulum: Pendulum, zetas: Sequence[FloatArray]) -> tuple[Pendulum, ...]:
    turned = [replace(pendulum, axes=_axes(xi, zeta)) for xi, zeta in zip((_X, _Y, _Z), zetas, strict=True)]
    return tuple(replace(one, hinge=best_hinge(one)) for one in turned)


def ideal_layout(pendulum: Pendulum) -> tuple[Pendulum, ...]:
    """Every centre of percussion in O, hinges on z, x and y (source: fig. 1.4)."""
    return _at_best(pendulum, (_Z, _X, _Y))


def honeywell_layout(pendulum: Pendulum) -> tuple[Pendulum, ...]:
    """Every centre of percussion in O, the level pair opposite one another on z, the third aside (after fig. 1.5)."""
    return _at_best(pendulum, (_Z, -_Z, _X))


def common_layout(pendulum: Pendulum, offset: float, angle: float = 0.0) -> tuple[Pendulum, ...]:
    """The common layout: all three hinges at one height over O, the third one on z (source: fig. 1.6, eqs. 1.10-1.11).

    Parameters
    ----------
    pendulum : Pendulum
        Which kind.
    offset : float
        OR, how far the hinges of 1 and 2 lie out along x and y, m.
    angle : float
        alpha: zeta of the third is (-cos alpha, sin alpha, 0), rad.
    """
    height = pendulum.percussion_radius
    aside = -np.cos(angle) * _X + np.sin(angle) * _Y
    return (
        replace(pendulum, axes=_axes(_X, _Z), hinge=(offset, 0.0, height)),
        replace(pendulum, axes=_axes(_Y, _Z), hinge=(0.0, offset, height)),
        replace(pendulum, axes=_axes(_Z, aside), hinge=(0.0, 0.0, height)),
    )


def moved(pendulums: Sequence[Pendulum], centre: FloatArray) -> tuple[Pendulum, ...]:
    """The same block seen from another O, `centre` (3,) from the old one, m."""
    x, y, z = map(float, centre)
    return tuple(replace(one, hinge=(one.hinge[0] - x, one.hinge[1] - y, one.hinge[2] - z)) for one in pendulums)


def motion_gram(terms: FloatArray) -> FloatArray:
    """Mean products of the nine terms of the size effect over a motion.

    Parameters
    ----------
    terms : (n, 9) float
        Of `size_terms`; or their integrals, once for errors of velocity and twice for those of position.

    Returns
    -------
    (9, 9) float
        Squares of the unit of `terms`.
    """
    gram: FloatArray = terms.T @ terms / len(terms)
    return gram


def spectrum_gram(rate: FloatArray, acceleration: FloatArray) -> FloatArray:
    """The same for Gaussian vibration about rest, from its covariances (Isserlis' theorem).

    Parameters
    ----------
    rate, acceleration : (3, 3) float
        Covariances: the integrals over frequency of the rate's spectrum and of (2 pi f)^2 times it, (rad/s)^2, (rad/s^2)^2.

    Returns
    -------
    (9, 9) float
        1/s^4.
    """
    pairs = np.array([(0, 0), (1, 1), (2, 2), (1, 2), (2, 0), (0, 1)])
    i, j = pairs[:, :1], pairs[:, 1:]
    k, l = i.T, j.T  # noqa: E741
    gram = np.zeros((9, 9))
    gram[:6, :6] = rate[i, j] * rate[k, l] + rate[i, k] * rate[j, l] + rate[i, l] * rate[j, k]
    gram[6:, 6:] = acceleration
    return gram


def size_error(pendulums: Sequence[Pendulum], gram: FloatArray) -> float:
    """Root mean square of the uncompensated error vector over the motion of `gram`: m/s^2, m/s or m, as its terms were."""
    rows = size_coefficients(pendulums)
    return float(np.sqrt(max(0.0, np.einsum("ij,jk,ik->", rows, gram, rows))))


def best_centre(pendulums: Sequence[Pendulum], gram: FloatArray) -> FloatArray:
    """Centre from which a built block has the least uncompensated error.

    The nine coefficients are linear in the place of O, so that the mean square error is a parabola in it.

    Parameters
    ----------
    pendulums : sequence of Pendulum
        The block as it is placed about the present O.
    gram : (9, 9) float
        What the block goes through: `motion_gram`, `spectrum_gram`, or a weighted sum.

    Returns
    -------
    (3,) float
        The best O from the present one, in block axes, m. Where the motion does not fix a coordinate, it stays.

    Raises
    ------
    HilError
        `gram` is not of mean products.
    """
    values, vectors = np.linalg.eigh(gram)
    if not (np.isfinite(values).all() and values[0] >= -1e-9 * abs(values[-1])):
        raise HilError(
            "best centre: gram must be a symmetric matrix of mean products; take motion_gram or spectrum_gram"
        )
    root = vectors * np.sqrt(np.maximum(values, 0.0))
    now = size_coefficients(pendulums)
    slopes = [((size_coefficients(moved(pendulums, unit)) - now) @ root).ravel() for unit in np.eye(3)]
    found: FloatArray = np.linalg.lstsq(np.stack(slopes, axis=1), -(now @ root).ravel(), rcond=1e-9)[0]
    return found


def best_axes(pendulums: Sequence[Pendulum]) -> FloatArray:
    """Orthogonal axes nearest to the three sensing axes in the least squares (polar decomposition).

    Returns
    -------
    (3, 3) float
        Rows: the new x, y, z in block axes.

    Raises
    ------
    HilError
        The three do not span the space.
    """
    u, scale, v = np.linalg.svd(np.array([one.axes[0] for one in pendulums]))
    if scale[-1] < 1e-3:
        raise HilError("best axes: the sensing axes lie in one plane; turn one of the pendulums")
    axes: FloatArray = u @ v
    return axes
