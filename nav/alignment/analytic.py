"""Analytic alignment at rest (source 003): attitude from the means of specific force and rate.

At rest ``f = -g`` and ``w`` is the Earth rate U, both in body axes. Vertical ``u = f / |f|``, north
``n = (w - U sin(lat) u) / (U cos(lat))``, east ``e = n x u``; C_nb has the rows n, e, -u.
"""

import math
from dataclasses import dataclass

import numpy as np

from nav.earth import RATE
from nav.errors import HilError
from nav.frames import earth_rate_in_body
from nav.increments import FloatArray
from nav.rotation import quaternion_from_dcm, quaternion_from_euler

SIGMAS = 3.0
"""The horizontal Earth rate must exceed this many standard deviations of the mean rate."""
RATE_TOLERANCE = 0.3
"""Largest relative difference between the measured rate at rest and the Earth's that gyrocompassing accepts."""


class AlignmentRefused(HilError):
    """The data cannot give the attitude; the message says why and what would."""


@dataclass(frozen=True, slots=True)
class Alignment:
    """Result of an alignment.

    Attributes
    ----------
    q_nb : (4,) float
        Attitude at the end of the averaging.
    gyro_bias : (3,) float
        Captured bias, rad/s (zero after gyrocompassing, which cannot tell it from the Earth rate).
    sigma_tilt, sigma_heading : float
        Standard deviations from the noise of the means alone, rad; biases come on top: tilt by accelerometer bias / g,
        heading by east gyro bias / (U cos lat).
    """

    q_nb: FloatArray
    gyro_bias: FloatArray
    sigma_tilt: float
    sigma_heading: float


def gyrocompass(
    f_b: FloatArray, w_ib_b: FloatArray, lat: float, sigma_f: float = 0.0, sigma_w: float = 0.0
) -> Alignment:
    """Vertical from the mean specific force, north from the mean rate.

    Parameters
    ----------
    f_b : (3,) float
        Mean specific force, m/s^2.
    w_ib_b : (3,) float
        Mean rate, rad/s.
    lat : float
        Geodetic latitude, rad.
    sigma_f, sigma_w : float
        Standard deviations of the means, m/s^2 and rad/s.

    Raises
    ------
    AlignmentRefused
        Near a pole, or when the rate is not the Earth's to `RATE_TOLERANCE` or hidden in its noise.
    """
    north_rate = RATE * math.cos(lat)
    if north_rate < max(SIGMAS * sigma_w, 1e-3 * RATE):
        raise AlignmentRefused(
            f"gyrocompassing is impossible: the Earth rate has {math.degrees(north_rate) * 3600:.3g} deg/h towards "
            f"north at latitude {math.degrees(lat):.3f} deg and the noise of the mean rate is "
            f"{math.degrees(sigma_w) * 3600:.3g} deg/h; average longer or give navigation.start.heading_deg with "
            'navigation.alignment = "level"'
        )
    measured = float(np.linalg.norm(w_ib_b))
    if abs(measured / RATE - 1.0) > RATE_TOLERANCE:
        raise AlignmentRefused(
            f"gyrocompassing is impossible: the rate at rest is {measured / RATE:.3g} times the Earth's (gyro bias, or "
            'units); give navigation.start.heading_deg with navigation.alignment = "level"'
        )
    f = float(np.linalg.norm(f_b))
    up = f_b / f
    north = w_ib_b - np.dot(w_ib_b, up) * up  # the vertical part is removed by geometry: exact for a noisy rate too
    level_rate = float(np.linalg.norm(north))
    if level_rate < max(SIGMAS * sigma_w, 1e-3 * RATE):
        raise AlignmentRefused(
            f"gyrocompassing is impossible: the measured rate stands upright, {math.degrees(level_rate) * 3600:.3g} deg/h "
            f"lie in the level where latitude {math.degrees(lat):.3f} deg has {math.degrees(north_rate) * 3600:.3g}; mend the "
            "latitude or the mounting"
        )
    north = north / level_rate
    east = np.cross(north, up)
    q_nb = quaternion_from_dcm(np.ascontiguousarray(np.stack([north, east, -up])))
    return Alignment(q_nb, np.zeros(3), sigma_f / f, math.hypot(sigma_w / north_rate, math.tan(lat) * sigma_f / f))


def level(
    f_b: FloatArray, w_ib_b: FloatArray, lat: float, heading: float, sigma_f: float = 0.0, sigma_heading: float = 0.0
) -> Alignment:
    """Vertical from the mean specific force, heading as given; what the rate has beyond the Earth's is gyro bias.

    Parameters
    ----------
    f_b, w_ib_b, lat, sigma_f
        As in `gyrocompass`.
    heading, sigma_heading : float
        Heading and its standard deviation, rad.
    """
    f = float(np.linalg.norm(f_b))
    pitch = math.asin(max(-1.0, min(1.0, f_b[0] / f)))
    roll = math.atan2(-f_b[1], -f_b[2])
    q_nb = quaternion_from_euler(heading, pitch, roll)
    return Alignment(q_nb, w_ib_b - earth_rate_in_body(q_nb, lat), sigma_f / f, sigma_heading)
