"""How the frames of :mod:`nav` lie to each other at a place on the Earth, and the Earth's rate in them."""

import math

import numpy as np

from nav.earth import RATE
from nav.increments import FloatArray
from nav.rotation import conjugate, rotated


def level_in_earth(lat: float, lon: float) -> FloatArray:
    """q_en (4,) at a geodetic place, rad: turn by the longitude about z, then by -(lat + 90 deg) about the new y."""
    a, b = 0.5 * lon, -0.5 * (lat + 0.5 * math.pi)
    return np.array(
        [math.cos(a) * math.cos(b), -math.sin(a) * math.sin(b), math.cos(a) * math.sin(b), math.sin(a) * math.cos(b)]
    )


def earth_rate_in_level(lat: float) -> FloatArray:
    """w_ie in n (3,), rad/s, at latitude `lat`, rad."""
    return np.array([RATE * math.cos(lat), 0.0, -RATE * math.sin(lat)])


def earth_rate_in_body(q_nb: FloatArray, lat: float) -> FloatArray:
    """w_ie in body axes (..., 3), rad/s, at latitude `lat` (rad) for the attitude `q_nb` (..., 4)."""
    return rotated(conjugate(q_nb), earth_rate_in_level(lat))
