"""Calibration of a magnetometer along the body axes: hard iron h, and soft iron, scale and misalignment in one matrix S.

    m = A B + h + noise,    B = S (m - h),    S = A^-1

B is the Earth's flux in b, of the known size F. Three fits, by what else is known of each reading:

    nothing     |S (m - h)| = F: the readings lie on an ellipsoid. A turn of S leaves the size as it is, so S is taken
                symmetric: 9 unknowns
    vertical    u the direction up in b (accelerometers at rest): the flux has one component along it, u . S (m - h) = c.
                This fixes the turn: 12 unknowns and c. The sensor's axes must be those of the body within some tens of degrees
    field       B itself, by a known attitude: linear in A and h

The first begins with the quadric m^T M m + 2 n^T m = 1 by linear least squares, which is not that of the noise, and goes on by
Gauss-Newton on the sizes themselves; the second goes on from there. A fit is refused where the flux corrected by it would
be uncertain in some direction by more than `UNSURE` of F: that is a direction to which the motion did not turn.
"""

import math
from dataclasses import dataclass
from itertools import product as every

import numpy as np

from nav.errors import HilError
from nav.increments import FloatArray

UNSURE = 0.02
"""Largest sigma of the corrected flux in any direction, of its size: 1 degree."""
FLAT = 0.1
"""Least ratio of the smallest spread of the readings to the largest."""
DISTURBED = 0.05
"""Largest rms of what is left, of the size of the flux."""
ITERATIONS = 50
_SYMMETRIC = np.array([[0, 1, 2], [1, 3, 4], [2, 4, 5]])
"""Places of the six unknowns in a symmetric matrix."""


class MagnetometerRefused(HilError):
    """The readings do not tell the calibration; the message says why."""


@dataclass(frozen=True, slots=True)
class MagnetometerCalibration:
    """Of one magnetometer.

    Attributes
    ----------
    matrix : (3, 3) float
        S, 1.
    hard_iron : (3,) float
        h, in the unit of the readings.
    covariance : (12, 12) float
        Of S by rows, then h.
    residual : float
        Rms of what the fit left of one component, in the unit of the readings.
    """

    matrix: FloatArray
    hard_iron: FloatArray
    covariance: FloatArray
    residual: float

    def take_off(self, flux: FloatArray) -> FloatArray:
        """Flux in b (n, 3) of readings (n, 3)."""
        taken: FloatArray = (flux - self.hard_iron) @ self.matrix.T
        return taken

    def sigma(self, flux_b: FloatArray) -> float:
        """Sigma of the corrected flux where it is `flux_b` (3,), in the worst direction."""
        off = np.linalg.solve(self.matrix, flux_b)
        by = np.hstack([np.kron(np.eye(3), off), -self.matrix])
        return math.sqrt(float(np.linalg.eigvalsh(by @ self.covariance @ by.T)[-1]))


def from_size(flux: FloatArray, size: float) -> MagnetometerCalibration:
    """Calibration from readings (n, 3) alone, where the Earth's flux has the size `size`, in one unit.

    Raises
    ------
    MagnetometerRefused
        A value is not finite, there are too few readings, they do not cover enough directions, or leave no ellipsoid.
    """
    _check(flux, size, 9)
    matrix, hard_iron = _quadric(flux, size)
    unknowns = np.concatenate([matrix[np.triu_indices(3)], hard_iron])
    spread = np.zeros((12, 9))
    spread[np.arange(9), _SYMMETRIC.ravel()] = 1.0
    spread[9:, 6:] = np.eye(3)
    step, trial, least = np.zeros(9), unknowns, math.inf
    for _ in range(ITERATIONS):
        matrix, hard_iron = (spread @ trial)[:9].reshape(3, 3), trial[6:]
        left, slope, through = _sizes(flux, matrix, hard_iron, size)
        share = np.linalg.norm(through, axis=1)
        squares = float(np.sum((left / share) ** 2))
        if squares > least * (1.0 + 1e-12):  # too far
            step *= 0.5
        else:
            unknowns, least = trial, squares
            step, normal = _solved(slope @ spread / share[:, None], left / share)
            if np.abs(step).max() < 1e-10 * size:
                break
        trial = unknowns - step
    residual = math.sqrt(float(np.sum((left / share) ** 2)) / (len(flux) - 9))
    covariance = spread @ (residual**2 * _inverse(normal)) @ spread.T
    return _judged(MagnetometerCalibration(matrix, hard_iron, covariance, residual), size)


def from_vertical(flux: FloatArray, up_b: FloatArray, size: float) -> MagnetometerCalibration:
    """Calibration from readings (n, 3) and the direction up in b (n, 3) at each, of any length.

    Raises
    ------
    MagnetometerRefused
        As `from_size`.
    """
    _check(np.hstack([flux, up_b]), size, 13)
    first = from_size(flux, size)
    up = up_b / np.linalg.norm(up_b, axis=1)[:, None]
    dip = float(np.mean(np.sum(up * first.take_off(flux), axis=1)))
    unknowns = np.concatenate([first.matrix.ravel(), first.hard_iron, [dip]])
    sigma, count = np.full(2, max(first.residual, 1e-12 * size)), len(flux)
    for _ in range(ITERATIONS):
        matrix, hard_iron = unknowns[:9].reshape(3, 3), unknowns[9:12]
        left, slope, through = _sizes(flux, matrix, hard_iron, size)
        share, off, upright = np.linalg.norm(through, axis=1), flux - hard_iron, up @ matrix
        # Both see the same noise: of the vertical only what is across the flux is new.
        common = np.sum(through * upright, axis=1) / share**2
        across = np.sqrt(np.maximum(np.sum(upright**2, axis=1) - (common * share) ** 2, 1e-12))
        seen = np.hstack([np.einsum("ki,kj->kij", up, off).reshape(-1, 9), -upright]) - common[:, None] * slope
        wrong = np.sum(up * (off @ matrix.T), axis=1) - unknowns[12] - common * left
        along, new = share * sigma[0], across * sigma[1]
        rows = np.zeros((2 * count, 13))
        rows[:count, :12], rows[count:, :12] = slope / along[:, None], seen / new[:, None]
        rows[count:, 12] = -1.0 / new
        step, normal = _solved(rows, np.concatenate([left / along, wrong / new]))
        squares = np.array([np.sum((left / share) ** 2), np.sum((wrong / across) ** 2)]) / (count - 6.5)
        sigma = np.sqrt(np.maximum(squares, 1e-24 * size**2))
        unknowns = unknowns - step
        if np.abs(step).max() < 1e-9 * size:
            break
    residual = math.sqrt(float(np.mean(sigma**2)))
    return _judged(MagnetometerCalibration(matrix, hard_iron, _inverse(normal)[:12, :12], residual), size)


def from_field(flux: FloatArray, field_b: FloatArray) -> MagnetometerCalibration:
    """Calibration from readings (n, 3) and the Earth's flux in b (n, 3) at each, in one unit.

    Raises
    ------
    MagnetometerRefused
        As `from_size`.
    """
    size = float(np.sqrt(np.mean(np.sum(field_b**2, axis=1))))
    _check(np.hstack([flux, field_b]), size, 4)
    rows = np.hstack([field_b, np.full((len(flux), 1), size)])
    normal = rows.T @ rows
    found = _inverse(normal) @ rows.T @ flux
    left = flux - rows @ found
    residual = math.sqrt(float(np.sum(left**2)) / (3 * (len(flux) - 4)))
    soft, hard_iron = found[:3].T, size * found[3]
    matrix = np.linalg.inv(soft)
    unit = residual**2 * _inverse(normal)
    apart = np.zeros((12, 12))  # of A by rows and h
    for i in range(3):
        own = [3 * i, 3 * i + 1, 3 * i + 2, 9 + i]
        apart[np.ix_(own, own)] = unit * np.outer([1.0, 1.0, 1.0, size], [1.0, 1.0, 1.0, size])
    turned = np.eye(12)
    turned[:9, :9] = np.kron(-matrix, matrix.T)
    return _judged(MagnetometerCalibration(matrix, hard_iron, turned @ apart @ turned.T, residual), size)


def _check(values: FloatArray, size: float, unknowns: int) -> None:
    flux = values[:, :3]
    if not (np.isfinite(values).all() and 0.0 < size < math.inf):
        raise MagnetometerRefused("magnetometer: a reading is not a number, or the size of the field is not positive")
    if len(flux) <= unknowns:
        raise MagnetometerRefused(f"magnetometer: {len(flux)} readings for {unknowns} unknowns; take some hundred")
    _, spread, axes = np.linalg.svd(flux - flux.mean(axis=0), full_matrices=False)
    if spread[2] < FLAT * spread[0]:
        thin = [_words(axes[2]), _words(-1.0 * axes[2])]
        raise MagnetometerRefused(
            f"magnetometer: the readings lie in a plane; turn the vehicle until the field points {' and '.join(thin)}"
        )


def _quadric(flux: FloatArray, size: float) -> tuple[FloatArray, FloatArray]:
    """S and h by the quadric through the readings."""
    middle = flux.mean(axis=0)
    x, y, z = ((flux - middle) / size).T
    rows = np.stack([x * x, 2 * x * y, 2 * x * z, y * y, 2 * y * z, z * z, 2 * x, 2 * y, 2 * z], axis=1)
    found = np.linalg.lstsq(rows, np.ones(len(flux)), rcond=None)[0]
    shape = found[:6][_SYMMETRIC]
    stretch = np.linalg.eigvalsh(shape)
    if stretch[0] < 1e-3 * stretch[2]:
        raise MagnetometerRefused(
            "magnetometer: no ellipsoid goes through the readings: turn the vehicle through all directions, far from iron"
        )
    centre = -np.linalg.solve(shape, found[6:])
    values, axes = np.linalg.eigh(shape / (1.0 + centre @ shape @ centre))
    matrix: FloatArray = axes @ np.diag(np.sqrt(values)) @ axes.T
    return matrix, middle + size * centre


def _sizes(
    flux: FloatArray, matrix: FloatArray, hard_iron: FloatArray, size: float
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """What is left of the sizes (n,), its slopes by S and h (n, 12), and by the readings (n, 3)."""
    off = flux - hard_iron
    taken = off @ matrix.T
    length: FloatArray = np.sqrt(np.sum(taken**2, axis=1))
    unit = taken / length[:, None]
    through = unit @ matrix
    slope = np.hstack([np.einsum("ki,kj->kij", unit, off).reshape(-1, 9), -through])
    return length - size, slope, through


def _solved(rows: FloatArray, left: FloatArray) -> tuple[FloatArray, FloatArray]:
    """The step of Gauss-Newton, and the normal matrix."""
    return np.asarray(np.linalg.lstsq(rows, left, rcond=None)[0], np.float64), rows.T @ rows


def _inverse(normal: FloatArray) -> FloatArray:
    """Inverse; what is not determined gets a large variance and no infinite one."""
    scale = np.sqrt(np.maximum(np.diag(normal), 1e-300))
    values, axes = np.linalg.eigh(normal / np.outer(scale, scale))
    inverse: FloatArray = (axes / np.maximum(values, 1e-15)) @ axes.T / np.outer(scale, scale)
    return inverse


def _judged(found: MagnetometerCalibration, size: float) -> MagnetometerCalibration:
    """Refuse what is not known everywhere."""
    if not (np.isfinite(found.matrix).all() and found.residual <= DISTURBED * size):
        raise MagnetometerRefused(
            f"magnetometer: {found.residual / size:.0%} of the flux is left unexplained: stay far from iron and currents, "
            "and check the size of the field"
        )
    ways = sorted((np.array(way, np.float64) for way in every((0, 1, -1), repeat=3) if any(way)), key=np.linalg.norm)
    unsure = [_words(way) for way in ways if found.sigma(size * way / np.linalg.norm(way)) > UNSURE * size]
    if unsure:
        unsure = [one for one in unsure if "-" not in one] or unsure
        raise MagnetometerRefused(
            f"magnetometer: not known where the field points {', '.join(unsure)}: turn the vehicle there"
        )
    return found


def _words(way: FloatArray) -> str:
    """A direction in b."""
    names = (("forward", "back"), ("right", "left"), ("down", "up"))
    strong = np.abs(way) > 0.4 * np.linalg.norm(way)
    return "-".join(pair[int(one < 0.0)] for pair, one, is_in in zip(names, way, strong, strict=True) if is_in)
