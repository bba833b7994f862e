"""Non-holonomy of the wander azimuth (source 002, Babich): the azimuth A of a level that never turns about its vertical.

``A' = L' sin B`` cannot be integrated to a function of the place: A depends on the path, and around a closed one it changes
by the solid angle of the path's verticals, positive for a path run clockwise. The true heading A + psi_r depends on no
path; A and the gyroscopic heading psi_r form a family of one constant. A path of constant psi_r is a geodesic.

Latitudes are geodetic, angles rad.
"""

import math

import numpy as np

from nav.checks import read_array
from nav.earth import curvature_radii
from nav.errors import HilError
from nav.increments import FloatArray
from nav.kernel import kernel


def azimuth_change(lat: FloatArray, lon: FloatArray) -> FloatArray:
    """Change of A from the first point of a path to each.

    Parameters
    ----------
    lat, lon : (n,) float
        Points. Between two of them the vertical moves along a great circle of directions; for these the integral of
        ``A' = L' sin B`` is Napier's analogy, exact over any length below half a turn.

    Returns
    -------
    (n,) float
        rad, not reduced to a turn.

    Raises
    ------
    HilError
        There is no point, or one is not a number.
    """
    lat, lon = _points(lat, lon)
    half_lon, half_lat, mid = 0.5 * np.diff(lon), 0.5 * np.diff(lat), 0.5 * (lat[1:] + lat[:-1])
    half_lon = half_lon - np.pi * np.round(half_lon / np.pi)
    each = 2.0 * np.arctan2(np.sin(half_lon) * np.sin(mid), np.cos(half_lon) * np.cos(half_lat))
    return np.concatenate([[0.0], np.cumsum(each)])


def solid_angle(lat: FloatArray, lon: FloatArray) -> float:
    """Solid angle of the verticals inside a closed path, positive for one run clockwise (seen from above).

    Parameters
    ----------
    lat, lon : (n,) float
        Points; the last is joined to the first. The path lies in one hemisphere of its first point.

    Returns
    -------
    float
        Steradians: triangles from the first point, by their triple products (Van Oosterom & Strackee 1983).

    Raises
    ------
    HilError
        There is no point, or one is not a number.
    """
    lat, lon = _points(lat, lon)
    up = np.stack([np.cos(lat) * np.cos(lon), np.cos(lat) * np.sin(lon), np.sin(lat)], axis=1)
    a, b, c = up[0], up[1:-1], up[2:]
    # Differences from the first point: narrow triangles lose nothing to rounding.
    triple = np.cross(b - a, c - b) @ a
    base = 1.0 + b @ a + c @ a + np.einsum("ij,ij->i", b, c)
    return float(-2.0 * np.arctan2(triple, base).sum())


def family(azimuth: float, gyro_heading: float, vel_w: FloatArray, constant: float) -> tuple[float, float, FloatArray]:
    """Another member of the family of solutions: the same motion with A + C.

    Parameters
    ----------
    azimuth, gyro_heading : float
        A and psi_r.
    vel_w : (3,) float
        Velocity in w (X, Y, Z up), m/s.
    constant : float
        C.

    Returns
    -------
    azimuth, gyro_heading, vel_w
        A + C, psi_r - C, and the velocity in the turned level.
    """
    s, c = math.sin(constant), math.cos(constant)
    turned = np.array([c * vel_w[0] - s * vel_w[1], s * vel_w[0] + c * vel_w[1], vel_w[2]])
    return azimuth + constant, gyro_heading - constant, turned


def constant_gyro_heading(lat: float, lon: float, heading: float, length: float, count: int) -> FloatArray:
    """Path on the ellipsoid with a constant gyroscopic heading: a geodesic, found without using that it is one.

    Parameters
    ----------
    lat, lon, heading : float
        Start, and the true heading there (psi_r, with A = 0).
    length : float
        m.
    count : int
        Steps (Runge-Kutta 4 of B', L', A' by the length), 1 or more. The path must keep away from the poles.

    Returns
    -------
    (count + 1, 3) float
        lat, lon, A.

    Raises
    ------
    HilError
        A value is not a number, there is no step, or the path meets a pole.
    """
    if not np.isfinite([lat, lon, heading, length]).all() or count < 1:
        raise HilError(f"path of constant gyroscopic heading: {lat}, {lon}, {heading}, {length} m in {count} steps")
    path = _constant_gyro_heading(float(lat), float(lon), float(heading), float(length), count)
    if not (np.abs(path[:, 0]) < 0.5 * np.pi).all():
        raise HilError("path of constant gyroscopic heading: it meets a pole; shorten it")
    return path


@kernel
def _constant_gyro_heading(lat: float, lon: float, heading: float, length: float, count: int) -> FloatArray:
    out = np.empty((count + 1, 3))
    out[0, 0], out[0, 1], out[0, 2] = lat, lon, 0.0
    h = length / count
    slopes = np.empty((4, 3))
    for k in range(count):
        for stage in range(4):
            part = 0.0 if stage == 0 else h if stage == 3 else 0.5 * h
            before = max(stage - 1, 0)
            b = out[k, 0] + part * slopes[before, 0]
            azimuth = heading + out[k, 2] + part * slopes[before, 2]
            meridian, prime = curvature_radii(math.sin(b))
            slopes[stage, 0] = math.cos(azimuth) / meridian
            slopes[stage, 1] = math.sin(azimuth) / (prime * math.cos(b))
            slopes[stage, 2] = slopes[stage, 1] * math.sin(b)
        for j in range(3):
            out[k + 1, j] = out[k, j] + h / 6.0 * (slopes[0, j] + 2.0 * (slopes[1, j] + slopes[2, j]) + slopes[3, j])
    return out


def _points(lat: FloatArray, lon: FloatArray) -> tuple[FloatArray, FloatArray]:
    n = len(lat)
    points = read_array("path: lat", lat, n), read_array("path: lon", lon, n)
    if n == 0 or not np.isfinite(points).all():
        raise HilError("path: it has no points, or one is not a number")
    return points
