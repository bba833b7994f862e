"""Analytic alignment at rest (source 003): attitude from the means of specific force and rate.

At rest ``f = -g`` and ``w`` is the Earth rate U, both in body axes. Vertical ``u = f / |f|``, north
``n = (w - U sin(lat) u) / (U cos(lat))``, east ``e = n x u``; C_nb has the rows n, e, -u. The source has it in three forms,
`FORMS`: Euler angles (its eqs. 3-7), direction cosines (8-12), direction cosines of a body near level (13-15). Its rows are
made orthonormal from the vertical on, which a gyro must not bend: then angles and cosines are the same attitude for any data,
and the latitude enters the covariance alone.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from nav.alignment.rest import UNSTATED, Means, Sensors, gravity_verdict
from nav.earth import RATE
from nav.errors import HilError
from nav.frames import earth_rate_in_body
from nav.increments import FloatArray
from nav.rotation import dcm_from_euler, quaternion_from_dcm, quaternion_from_euler

Form = Callable[[FloatArray, FloatArray, float], FloatArray]
"""Mean specific force (3,), m/s^2, mean rate (3,), rad/s, latitude, rad, to C_nb (3, 3)."""

SIGMAS = 3.0
"""The horizontal Earth rate must exceed this many standard deviations of the mean rate, and stated ones of the bias."""
RATE_TOLERANCE = 0.3
"""Largest difference of the measured rate, and of its vertical part, from the Earth's, in Earth rates, where the gyro's bias
is not stated."""
ODD = 5.0
"""A vertical rate this many stated standard deviations off the latitude's is no accident."""
RESTLESS = 3.0
"""A scatter of the blocks this many times what the stated noise makes is motion."""
BLOCKS = 4
"""Blocks whose scatter says something."""
POLE = 1e-3
"""cos(lat) below which there is no north to speak of."""
SMALL_TILT = 0.1
"""Largest tilt for the small-angle form, rad: its attitude is then off by 0.03 deg."""

_HOW = 'give navigation.start.heading_deg with navigation.alignment = "level"'


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
    covariance : (3, 3) float
        Of the attitude error, a rotation vector in n (north, east, down) as of `nav.rotation.attitude_error`, rad^2: noise
        of the means and stated biases.
    """

    q_nb: FloatArray
    gyro_bias: FloatArray
    covariance: FloatArray

    @property
    def sigma_tilt(self) -> float:
        """Standard deviation of the vertical (worse axis), rad."""
        return math.sqrt(max(self.covariance[0, 0], self.covariance[1, 1]))

    @property
    def sigma_heading(self) -> float:
        """Standard deviation of the turn about the vertical, rad."""
        return math.sqrt(self.covariance[2, 2])


def angles(f_b: FloatArray, w_ib_b: FloatArray, lat: float) -> FloatArray:
    """Pitch and roll of the specific force, then heading = atan2(-w_right, w_forward) of the rate turned to the level."""
    pitch, roll = _tilt(f_b)
    forward, right, _ = dcm_from_euler(0.0, pitch, roll) @ w_ib_b
    return dcm_from_euler(math.atan2(-right, forward), pitch, roll)


def cosines(f_b: FloatArray, w_ib_b: FloatArray, lat: float) -> FloatArray:
    """Rows n, e, -u of the module's lines: orthonormal where the rate is the Earth's."""
    return _rows(f_b / np.linalg.norm(f_b), w_ib_b, lat)


def small_angles(f_b: FloatArray, w_ib_b: FloatArray, lat: float) -> FloatArray:
    """As `cosines` for a body near level: u = (pitch, -roll, -1) with the sines for the angles.

    At the tilt t, rows e and u are t^2/2 too long and n leans by tan(lat) t^2/2; what is left of it in the attitude, once
    the rows are orthonormal from u on, is a tilt of t^3/2 and, in heading, tan(lat) times its part about north.

    Raises
    ------
    AlignmentRefused
        The tilt is above `SMALL_TILT`.
    """
    pitch, right, down = f_b / np.linalg.norm(f_b)
    tilt = math.atan2(math.hypot(pitch, right), -down)
    if tilt > SMALL_TILT:
        raise AlignmentRefused(
            f"the small-angle form takes a body within {math.degrees(SMALL_TILT):.1f} deg of the level and this one is tilted "
            f"by {math.degrees(tilt):.1f} deg: use the form angles or cosines"
        )
    return _rows(np.array([pitch, right, -1.0]), w_ib_b, lat)


FORMS: dict[str, Form] = {"angles": angles, "cosines": cosines, "small-angles": small_angles}
"""The source's three, by name."""


def gyrocompass(
    mean: Means, lat: float, sensors: Sensors = UNSTATED, form: Form = cosines, asked: float = math.inf
) -> Alignment:
    """Vertical from the mean specific force, north from the mean rate.

    Parameters
    ----------
    mean : Means
        Averages at rest.
    lat : float
        Geodetic latitude, rad.
    sensors : Sensors
        For covariance and refusals.
    form : Form
        One of `FORMS`.
    asked : float
        Standard deviation of the heading that is needed, rad; positive.

    Raises
    ------
    AlignmentRefused
        A value is not finite; no rest (force not 1 g, or a scatter above the stated noise); a pole; averaging too short for
        the noise or for what is asked; a rate that is not the Earth's, or not that of the latitude.
    """
    _check(mean, sensors, lat)
    noise_f, noise_w = _noise(mean, sensors)
    _check_rate(mean, lat, sensors, noise_w)
    down, north = _upright(form(mean.f, mean.w, lat))
    q_nb = quaternion_from_dcm(np.stack([north, np.cross(down, north), down]))
    north_rate, g = RATE * math.cos(lat), float(np.linalg.norm(mean.f))
    by_force = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, math.tan(lat), 0.0]]) / g
    by_rate = np.array([[0.0], [0.0], [-1.0 / north_rate]])
    noise = noise_f**2 * by_force @ by_force.T + noise_w**2 * by_rate @ by_rate.T
    bias = sensors.accelerometer_bias**2 * by_force @ by_force.T + sensors.gyro_bias**2 * by_rate @ by_rate.T
    result = Alignment(q_nb, np.zeros(3), noise + bias)
    if not result.sigma_heading <= asked:
        text = (
            f"heading is known to {math.degrees(result.sigma_heading):.3g} deg, {math.degrees(asked):.3g} deg are asked"
        )
        left = asked**2 - bias[2, 2]
        if not (asked > 0.0 and left > 0.0):
            limit = math.degrees(math.sqrt(bias[2, 2]))
            raise AlignmentRefused(f"no averaging is long enough: {text}, and the biases alone leave {limit:.3g} deg")
        needed = mean.time_s * noise[2, 2] / left
        raise AlignmentRefused(
            f"averaging is too short: {text}; average {_seconds(needed)} instead of {mean.time_s:g} s"
        )
    return result


def level(
    mean: Means, lat: float, heading: float, sigma_heading: float = 0.0, sensors: Sensors = UNSTATED
) -> Alignment:
    """Vertical from the mean specific force, heading as given; what the rate has beyond the Earth's is gyro bias.

    Parameters
    ----------
    mean, lat, sensors
        As in `gyrocompass`.
    heading, sigma_heading : float
        Heading and its standard deviation, rad. The heading is an Euler angle: towards pitch +-90 deg the turn about the
        vertical that it leaves is less and less known.

    Raises
    ------
    AlignmentRefused
        A value is not finite, the force is not 1 g, or the scatter is above the stated noise.
    """
    _check(mean, sensors, lat, heading, sigma_heading)
    noise_f, _ = _noise(mean, sensors)
    pitch, roll = _tilt(mean.f)
    q_nb = quaternion_from_euler(heading, pitch, roll)
    tan = math.tan(pitch) / float(np.linalg.norm(mean.f))
    by_force = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 0.0]]) / float(np.linalg.norm(mean.f))
    by_force[2] = -tan * math.sin(heading), tan * math.cos(heading), 0.0
    covariance = (noise_f**2 + sensors.accelerometer_bias**2) * by_force @ by_force.T
    covariance[2, 2] += sigma_heading**2
    return Alignment(q_nb, mean.w - earth_rate_in_body(q_nb, lat), covariance)


def magnetic_heading(f_b: FloatArray, flux_b: FloatArray, declination: float) -> float:
    """Heading, rad, of a body at rest: the vertical by the force (3,), north by the level part of a magnetic flux (3,).

    `declination`, rad, is that of the flux, east of true north.

    Raises
    ------
    AlignmentRefused
        The flux has no level part.
    """
    pitch, roll = _tilt(f_b)
    north, east, down = dcm_from_euler(0.0, pitch, roll) @ flux_b
    if not math.hypot(north, east) > 0.1 * abs(down):
        raise AlignmentRefused(
            "the magnetic flux stands on the level: it tells no heading; give one, start.heading_deg"
        )
    return declination - math.atan2(east, north)


def _tilt(f_b: FloatArray) -> tuple[float, float]:
    """Pitch = asin(f_x / g), with all digits near +-90 deg, and roll."""
    x, y, z = f_b
    return math.atan2(x, math.hypot(y, z)), math.atan2(-y, -z)


def _rows(up: FloatArray, w_ib_b: FloatArray, lat: float) -> FloatArray:
    north = (w_ib_b - RATE * math.sin(lat) * up) / (RATE * math.cos(lat))
    return np.stack([north, np.cross(north, up), -up])


def _upright(c_nb: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Unit vectors down and north of rows n, e, -u: down as it is, north turned into the level."""
    down = c_nb[2] / np.linalg.norm(c_nb[2])
    north = c_nb[0] - (c_nb[0] @ down) * down
    return down, north / np.linalg.norm(north)


def _noise(mean: Means, sensors: Sensors) -> tuple[float, float]:
    """Standard deviations of mean specific force and rate: as stated, else from the scatter."""
    root = math.sqrt(mean.time_s)
    return sensors.velocity_random_walk / root or mean.sigma_f, sensors.angle_random_walk / root or mean.sigma_w


def _check(mean: Means, sensors: Sensors, *more: float) -> None:
    if not np.isfinite([*mean.f, *mean.w, mean.sigma_f, mean.sigma_w, mean.time_s, *more]).all():
        raise AlignmentRefused("a mean rate, a mean specific force or the latitude is not a number: mend the data")
    if mean.time_s <= 0.0:
        raise AlignmentRefused(f"averages over {mean.time_s:g} s say nothing: stand still for some seconds")
    wrong = gravity_verdict(mean.f)
    if wrong:
        raise AlignmentRefused(wrong)
    noise_f, noise_w = _noise(mean, sensors)
    for what, scatter, noise in (("rate", mean.sigma_w, noise_w), ("specific force", mean.sigma_f, noise_f)):
        if mean.blocks >= BLOCKS and scatter > RESTLESS * noise:
            raise AlignmentRefused(
                f"this is not rest: the {what} scatters {scatter / noise:.1f} times as much as the sensor's noise; stand "
                "still, or state the noise as it is"
            )


def _check_rate(mean: Means, lat: float, sensors: Sensors, noise_w: float) -> None:
    """Refuse a rate in which the Earth's does not show."""
    place, north_rate = f"latitude {math.degrees(lat):.3f} deg", RATE * math.cos(lat)
    if abs(lat) > 0.5 * math.pi - POLE:
        raise AlignmentRefused(
            f"gyrocompassing is impossible: {place} is at a pole or beyond, where there is no north; {_HOW}"
        )
    if north_rate < SIGMAS * noise_w:
        needed = _seconds(mean.time_s * (SIGMAS * noise_w / north_rate) ** 2)
        raise AlignmentRefused(
            f"gyrocompassing is impossible: the Earth rate has {_deg_h(north_rate)} towards north at {place} and the noise "
            f"of the mean rate is {_deg_h(noise_w)}; average longer ({needed}) or {_HOW}"
        )
    if north_rate < SIGMAS * sensors.gyro_bias:
        raise AlignmentRefused(
            f"gyrocompassing is impossible: the Earth rate has {_deg_h(north_rate)} towards north at {place} and the gyro "
            f"bias is {_deg_h(sensors.gyro_bias)}, which no averaging takes off; {_HOW}"
        )
    measured = float(np.linalg.norm(mean.w))
    if abs(measured / RATE - 1.0) > RATE_TOLERANCE:
        raise AlignmentRefused(
            f"gyrocompassing is impossible: the rate at rest is {measured / RATE:.3g} times the Earth's (gyro bias, or "
            f"units); {_HOW}"
        )
    up = mean.f / np.linalg.norm(mean.f)
    vertical = float(mean.w @ up)
    level_rate = float(np.linalg.norm(mean.w - vertical * up))
    if level_rate < max(SIGMAS * noise_w, POLE * RATE):
        raise AlignmentRefused(
            f"gyrocompassing is impossible: the measured rate stands upright, {_deg_h(level_rate)} lie in the level where "
            f"{place} has {_deg_h(north_rate)}; mend the latitude or the mounting"
        )
    allowed = RATE_TOLERANCE * RATE + SIGMAS * noise_w
    if sensors.gyro_bias > 0.0:
        tilt = math.hypot(_noise(mean, sensors)[0], sensors.accelerometer_bias) / float(np.linalg.norm(mean.f))
        allowed = ODD * math.hypot(noise_w, sensors.gyro_bias, sensors.upright_drift, RATE * tilt)
    if abs(vertical - RATE * math.sin(lat)) > allowed:
        fits = math.degrees(math.asin(max(-1.0, min(1.0, vertical / RATE))))
        raise AlignmentRefused(
            f"gyrocompassing is impossible: the upward part of the rate is {_deg_h(vertical)} where {place} has "
            f"{_deg_h(RATE * math.sin(lat))} (noise and bias allow {_deg_h(allowed)} more or less); it would fit latitude "
            f"{fits:.1f} deg: mend the latitude, its hemisphere or the signs of the gyros"
        )


def _deg_h(rate: float) -> str:
    return f"{math.degrees(rate) * 3600:.3g} deg/h"


def _seconds(time: float) -> str:
    return f"{time:.0f} s" if time < 1e5 else f"{time / 86400:.0f} days"
