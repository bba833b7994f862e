"""The flights of the study: what the instruments give, what GNSS and its four antennas say."""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hil.geometry import attitude_difference, position_error
from hil.scenario import Channel, MotionConfig
from hil.study.aiding import GNSS_SIGMA, gnss_rows, moved, turns
from hil.study.alignment.records import FIX_S, four_antennas, ideal, sensed, sky
from hil.world.motion import Motion
from nav.aiding import AIDING
from nav.earth import STANDARD_GRAVITY
from nav.filter.gnss_attitude import GnssAttitude
from nav.filter.tracking_gains import Noise
from nav.increments import FloatArray, ImuIncrements
from nav.instruments.grades import Grade

WANDER_M, WANDER_S = 3.0, 200.0
"""Sigma and time of the slow error of GNSS, where it has one."""


def motion(name: str) -> Motion:
    """`straight`: level at 70 m/s to the north-east; `turns`: circles and straights (:func:`hil.study.aiding.turns`)."""
    if name == "turns":
        return turns()
    east = north = Channel(rate=50.0)
    return Motion(MotionConfig(attitude="coordinated", north=north, east=east, up=Channel(offset=500.0)))


@dataclass(frozen=True, slots=True)
class Flight:
    """One flight as a navigator sees it.

    Attributes
    ----------
    imu : ImuIncrements
    truth : (n,) structured
        At the start and at every fix (`hil.world.motion.TRUTH`).
    fixes, attitudes : (n,) AIDING
        By the antennas, at the same times.
    heard : (n,) bool
        Whether there were any.
    start : GnssAttitude
        Of the first epoch.
    """

    imu: ImuIncrements
    truth: NDArray[np.void]
    fixes: NDArray[np.void]
    attitudes: NDArray[np.void]
    heard: NDArray[np.bool_]
    start: GnssAttitude

    def errors(self, solved: FloatArray) -> FloatArray:
        """(n - 1, 4): tilt and heading, rad, velocity and position, 3-D, m/s and m, of solutions (n - 1, 10) at the fixes."""
        true = self.truth[1:]
        _, tilt, heading = attitude_difference(np.ascontiguousarray(solved[:, 6:]), true["q_nb"])
        lat, lon, height = np.ascontiguousarray(solved[:, :3].T)
        way = position_error(lat, lon, height, true)
        speed = solved[:, 3:6] - true["vel_n"]
        return np.stack([tilt, heading, np.linalg.norm(speed, axis=1), np.linalg.norm(way, axis=1)], axis=1)


def fly(
    name: str, grade: Grade, seed: int, duration: float, outage: tuple[float, float] | None, *, wandering: bool
) -> Flight:
    """Draw a flight of the motion `name`; GNSS silent from `outage` to `outage`, s, and with a slow error if `wandering`."""
    path = motion(name)
    truth = path.truth(FIX_S * np.arange(round(duration / FIX_S) + 1))
    rng = np.random.default_rng([seed, 9])
    stars = sky(rng)
    fixes = gnss_rows(truth, rng)
    if wandering:
        lat, lon, height = np.ascontiguousarray(fixes["value"][:, :3].T)
        fixes["value"][:, :3] = np.stack(moved(lat, lon, height, _wander(len(truth), rng)), axis=1)
    found = [four_antennas(true, stars, rng) for true in truth]
    places = fixes["value"][:, :2].tolist()
    attitudes = np.array([one.row(t, *at) for one, t, at in zip(found, truth["time"], places, strict=True)], AIDING)
    heard = np.ones(len(truth), np.bool_)
    if outage is not None:
        heard = (truth["time"] <= outage[0] + 1e-9) | (truth["time"] > outage[1] + 1e-9)
    return Flight(sensed(ideal(path, duration), grade, seed), truth, fixes, attitudes, heard, found[0])


def _wander(count: int, rng: np.random.Generator) -> FloatArray:
    """A slow error (count, 3), m: first-order Gauss-Markov."""
    decay = math.exp(-FIX_S / WANDER_S)
    draws = WANDER_M * rng.standard_normal((count, 3))
    draws[1:] *= math.sqrt(1.0 - decay**2)
    for k in range(1, count):
        draws[k] += decay * draws[k - 1]
    return draws


def noise(grade: Grade, flight: Flight) -> Noise:
    """What the steady gains are told of the instruments, the motion and the antennas.

    Scale factor and misalignment drift with the rms of the flight's rate.
    """
    rate = math.sqrt(float(np.mean(flight.truth["w_ib_b"] ** 2)))
    by_rate = math.hypot(grade.gyro_scale, grade.gyro_misalignment) * rate
    covariance = flight.start.level(float(flight.truth["lat"][0]), float(flight.truth["lon"][0]))[1]
    north, east, down = np.diag(covariance)
    return Noise(
        gyro_white=grade.gyro_white,
        gyro_drift=math.hypot(grade.gyro_bias_removed, grade.gyro_g * STANDARD_GRAVITY, by_rate),
        accelerometer_white=grade.accelerometer_white,
        accelerometer_bias=math.hypot(grade.accelerometer_bias, grade.accelerometer_scale * STANDARD_GRAVITY),
        place=(float(GNSS_SIGMA[0]), float(GNSS_SIGMA[2])),
        velocity=(float(GNSS_SIGMA[3]), float(GNSS_SIGMA[5])),
        tilt=math.sqrt(0.5 * (north + east)),
        heading=math.sqrt(down),
        period=FIX_S,
    )
