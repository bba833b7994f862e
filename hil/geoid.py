"""The geoid: height of mean sea level above the ellipsoid, EGM96.

Six-point Lagrange interpolation, both ways, in the 15-minute grid (`fixtures/geoid/README.md`). Against the 5-minute
grid of the same model the error is 4 mm rms and 4 cm at worst; the model itself is good to about half a metre.
"""

import math
from functools import lru_cache
from importlib.resources import files

import numpy as np
from numpy.typing import NDArray

_NODES_PER_DEG = 4
_REACH = 3
"""Nodes needed on each side of a point."""


def undulation(lat: float, lon: float) -> float:
    """Height of the EGM96 geoid above the WGS-84 ellipsoid, m.

    Height above mean sea level is ellipsoidal height less this.

    Parameters
    ----------
    lat : float
        Geodetic latitude, rad; beyond a pole it is taken at the pole.
    lon : float
        Longitude, rad, any turn.
    """
    row = (min(90.0, max(-90.0, math.degrees(lat))) + 90.0) * _NODES_PER_DEG
    column = (math.degrees(lon) + 180.0) % 360.0 * _NODES_PER_DEG
    i, j = int(row), int(column)
    block = _grid_cm()[i + 1 : i + 1 + 2 * _REACH, j + 1 : j + 1 + 2 * _REACH]
    return 0.01 * float(_weights(row - i) @ block @ _weights(column - j))


def _weights(t: float) -> NDArray[np.float64]:
    """Lagrange weights of the nodes -2..3 for the point `t` in [0, 1)."""
    a, b, c, d, e, f = t + 2.0, t + 1.0, t, t - 1.0, t - 2.0, t - 3.0
    return np.array(
        [
            -b * c * d * e * f / 120.0,
            a * c * d * e * f / 24.0,
            -a * b * d * e * f / 12.0,
            a * b * c * e * f / 12.0,
            -a * b * c * d * f / 24.0,
            a * b * c * d * e / 120.0,
        ]
    )


@lru_cache(maxsize=1)
def _grid_cm() -> NDArray[np.float32]:
    """The grid in centimetres, continued over both poles and across the date line by `_REACH` nodes."""
    with (files("fixtures") / "geoid" / "egm96-15.npz").open("rb") as file, np.load(file) as data:
        difference = data["second_difference_cm"].astype(np.int32)
    grid = difference.cumsum(axis=0).cumsum(axis=1)
    half_turn = grid.shape[1] // 2
    south = np.roll(grid[1 : _REACH + 1], half_turn, axis=1)[::-1]
    north = np.roll(grid[-_REACH - 1 : -1], half_turn, axis=1)[::-1]
    grid = np.vstack([south, grid, north])
    return np.hstack([grid[:, -_REACH:], grid, grid[:, : _REACH + 1]]).astype(np.float32)
