"""What instruments of a grade make of a motion, and what GNSS receivers say on it."""

import math

import numpy as np
from numpy.typing import NDArray

from hil.world.motion import Motion
from nav.aiding import AIDING, Kind
from nav.alignment.rest import Sensors
from nav.earth import STANDARD_GRAVITY, curvature_radii
from nav.filter.gnss_attitude import GnssAttitude, attitude
from nav.frames import level_in_earth
from nav.increments import FloatArray, ImuIncrements
from nav.instruments import redundancy
from nav.instruments.accelerometer_errors import Accelerometers
from nav.instruments.axis_drift import axis_variances
from nav.instruments.grades import Grade
from nav.instruments.gyro_errors import DTG_HEAD, Gyros
from nav.instruments.sources import combination
from nav.rotation import rotated

STEP = 0.02
"""Of the sensors, s."""
FIX_S, PLACE_M, SPEED = 0.2, 1.5, 0.1
"""Of GNSS: time between fixes, s; noise of position and velocity an axis, m and m/s."""
PHASE_M, WAVELENGTH_M = 5e-3, 0.1903
ANTENNAS_B = np.array([[2.0, 0.0, 0.0], [0.0, 2.0, 0.0], [0.0, -2.0, 0.0], [0.0, 0.0, 0.0]])
"""Nose, right, left, middle: three baselines of 2 m in a plane."""


def weighted(grade: Grade) -> FloatArray:
    """(3, c): combination of the gyros' channels; those of a level head by what gravity drifts of each, as the product does."""
    if grade.gyro_channels != DTG_HEAD:
        return combination(grade.gyro_channels)
    variances = axis_variances(grade, np.eye(3), bias_removed=True)
    best = redundancy.combination(redundancy.layout(0.0), 1.0 / variances)
    assert best is not None  # four axes with weights span space
    return best


def sensors(grade: Grade) -> Sensors:
    """What an alignment is told of a level unit whose gyro bias has been removed at rest.

    Gravity drifts the level gyros like a bias, but for those of a head, see `weighted`.
    """
    by_gravity = grade.gyro_g * STANDARD_GRAVITY
    level = 0.0 if grade.gyro_channels == DTG_HEAD else by_gravity
    return Sensors(
        grade.gyro_white,
        grade.accelerometer_white,
        math.hypot(grade.gyro_bias_removed, level),
        grade.accelerometer_bias,
        by_gravity,
    )


def ideal(motion: Motion, duration: float) -> tuple[FloatArray, FloatArray]:
    """True increments (n, 3), rad and m/s."""
    n = round(duration / STEP)
    dtheta, dvel = np.empty((n, 3)), np.empty((n, 3))
    motion.increments(0, n, STEP, dtheta, dvel)
    return dtheta, dvel


def sensed(
    true: tuple[FloatArray, FloatArray], grade: Grade, seed: int, to_body: FloatArray | None = None
) -> ImuIncrements:
    """The same as instruments of a grade give it, drawn by the seed; `to_body` (3, c) in place of `weighted`."""
    turn_on, gyro_noise, force_noise = np.random.default_rng([seed, 5]).spawn(3)
    gyros, forces = grade.draw(turn_on, bias_removed=True)
    if to_body is None:
        to_body = weighted(grade)
    imu = ImuIncrements.empty(len(true[0]))
    imu.sequence[:] = np.arange(len(imu))
    imu.step[:], imu.time[:] = STEP, STEP * (imu.sequence + 1)
    imu.dtheta[:] = Gyros(gyros, STEP, gyro_noise).sense(*true) @ to_body.T
    imu.dvel[:] = Accelerometers(forces, STEP, force_noise).sense(true[1])
    return imu


def fixes(truth: NDArray[np.void], rng: np.random.Generator) -> NDArray[np.void]:
    """GNSS fixes at the times of `truth`."""
    rows = np.zeros(len(truth), AIDING)
    rows["time"], rows["kind"] = truth["time"], Kind.GNSS
    wrong = PLACE_M * rng.standard_normal((len(truth), 3))
    for row, true, (north, east, down) in zip(rows, truth, wrong, strict=True):
        meridian, prime = curvature_radii(math.sin(true["lat"]))
        east_radius = (prime + true["height"]) * math.cos(true["lat"])
        row["value"][0] = true["lat"] + north / (meridian + true["height"])
        row["value"][1] = true["lon"] + east / east_radius
        row["value"][2] = true["height"] - down
    rows["value"][:, 3:] = truth["vel_n"] + SPEED * rng.standard_normal((len(truth), 3))
    rows["sigma"][:, :3], rows["sigma"][:, 3:] = PLACE_M, SPEED
    return rows


def sky(rng: np.random.Generator, count: int = 9) -> FloatArray:
    """Directions (count, 3) in n of satellites all round, 15 to 80 deg high."""
    azimuth = 2.0 * math.pi * (np.arange(count) + 0.5 * rng.random(count)) / count
    height = np.radians(rng.uniform(15.0, 80.0, count))
    level = np.cos(height)
    return np.stack([level * np.cos(azimuth), level * np.sin(azimuth), -np.sin(height)], axis=1)


def four_antennas(true: np.void, directions_n: FloatArray, rng: np.random.Generator) -> GnssAttitude:
    """Attitude of an epoch by four antennas."""
    q_en = level_in_earth(float(true["lat"]), float(true["lon"]))
    noise = PHASE_M * rng.standard_normal((len(directions_n), 4))
    baselines = rotated(true["q_nb"], ANTENNAS_B[:3] - ANTENNAS_B[3])
    ranges = directions_n @ baselines.T + noise[:, :3] - noise[:, 3:]
    phases = 2.0 * math.pi / WAVELENGTH_M * ranges
    return attitude(rotated(q_en, directions_n), phases, ANTENNAS_B, WAVELENGTH_M, PHASE_M)
