"""The International Standard Atmosphere up to 47 km (ISO 2533:1975)."""

import math
from itertools import pairwise

EARTH_RADIUS = 6356766.0
"""Of the geopotential height, m."""
SEA_PRESSURE, SEA_TEMPERATURE = 101325.0, 288.15
"""Pa, K."""
_GRAVITY_OVER_GAS = 9.80665 / 287.05287
_LAYERS = ((0.0, -0.0065), (11000.0, 0.0), (20000.0, 0.001), (32000.0, 0.0028), (47000.0, 0.0))
"""Geopotential height at which a layer begins, m, and its gradient of temperature, K/m."""


def standard_atmosphere(altitude: float) -> tuple[float, float]:
    """Pressure, Pa, and temperature, K, at an altitude above the sea.

    ``p = p_b (T / T_b)^(-g / (R L))`` in a layer of gradient L, ``p = p_b exp(-g (H - H_b) / (R T_b))`` in one without
    (ISO 2533, eq. 12 and 13); the lowest layer goes on below the sea, the air ends at 47 km.

    Parameters
    ----------
    altitude : float
        Geometric, m.
    """
    bounded = min(max(altitude, -5000.0), 50000.0)
    height = min(EARTH_RADIUS * bounded / (EARTH_RADIUS + bounded), _LAYERS[-1][0])
    pressure, temperature = SEA_PRESSURE, SEA_TEMPERATURE
    for (base, gradient), (top, _) in pairwise(_LAYERS):
        rise = min(height, top) - base
        if gradient:
            warmer = temperature + gradient * rise
            pressure *= (warmer / temperature) ** (-_GRAVITY_OVER_GAS / gradient)
            temperature = warmer
        else:
            pressure *= math.exp(-_GRAVITY_OVER_GAS * rise / temperature)
        if height <= top:
            break
    return pressure, temperature
