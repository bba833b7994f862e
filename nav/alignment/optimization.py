"""Alignment in motion by optimisation: the attitude at the start as one constant rotation between vectors (Wu & Pan 2013).

With b0 the body axes at the start, held inertially, and i the Earth's axes at the start, the same motion is known twice:

    in b0   alpha = int C_b0b f dt,      gamma = int alpha dt           from gyros and accelerometers
    in i    epsilon = v_i - int G dt,    delta = r_i - int int G dt     from fixes; G is gravitation

    delta = C_ib0 gamma + r_0 + v_0 t,   epsilon = C_ib0 alpha + v_0

r_0 and v_0 are taken out by least squares, and with them how the motion began. The rotation is Davenport's: the eigenvector
of K that has the largest eigenvalue. Sums of a fixed size hold all that is needed, so there is an answer at any time.

On a swaying base the fixes are the mooring itself, wrong by the sway: gravity, turned by the Earth, shows the north.
"""

import math
from collections import deque

import numpy as np
from numpy.typing import ArrayLike, NDArray

from nav.aiding import AIDING, Kind
from nav.alignment import vectors
from nav.alignment.analytic import SIGMAS, Alignment, AlignmentRefused
from nav.alignment.rest import UNSTATED, Sensors
from nav.body_integrals import MEMORY, integrate_body
from nav.earth import E2, RATE, curvature_radii
from nav.frames import level_in_earth
from nav.gravitation import NORMAL, gravitation_cartesian
from nav.increments import FloatArray, ImuIncrements
from nav.rotation import conjugate, dcm_from_quaternion, product, rotated

LOOK_S = 1.0
"""Time between looks at a mooring, s: sway within a second is one and the same."""
FIXES = 4
"""Fewest fixes for an answer."""
LENGTH = 0.05
"""The specific force may be so far from what the fixes say, relative; the rest is units."""
MISFIT = 5.0
"""Residuals may be this many times what fixes and biases explain."""
RECENT = 60
"""Newest fixes that the velocity is fitted to."""
NOISE_AS_BIAS = 2100.0 / 1287.0
"""A white noise N of the rate turns the heading as a bias of the variance N^2 / T times this: integral of the squared
weight that the rate has on a swaying base, 140 s^3 (1 - s)^3."""

_MEASURED, _KNOWN, _FREE, _BY_GYRO, _BY_FORCE = slice(0, 3), slice(3, 6), slice(6, 8), slice(8, 17), slice(17, 26)
_ROW = 26
"""A row of the least squares: gamma, delta, (1, t), derivatives of gamma by both biases; or the rates of all these."""


class TooEarly(AlignmentRefused):
    """More of the same would do."""


class Misfit(AlignmentRefused):
    """The samples and the fixes are not of one motion."""


class MotionAlignment:
    """Alignment from samples and fixes as they come; the result does not depend on how they were batched.

    Parameters
    ----------
    sensors : Sensors
        For covariance and refusals.
    asked : float
        Standard deviation of the heading that is needed, rad.
    arm_b : (3,) float
        From the sensor to what the fixes are of (an antenna), b, m.
    """

    def __init__(
        self, sensors: Sensors = UNSTATED, asked: float = math.inf, arm_b: ArrayLike = (0.0, 0.0, 0.0)
    ) -> None:
        self._sensors, self._asked, self._arm = sensors, asked, np.array(arm_b, float)
        self._memory, self._body = np.zeros(MEMORY), np.zeros(vectors.STATE)
        self._body[0] = 1.0
        self._sums = np.zeros((_ROW, _ROW))
        self._pending = np.zeros(0, AIDING)
        self._start = self._time = -math.inf
        self._fixes, self._fix_time, self._place, self._height = 0, 0.0, (0.0, 0.0), 0.0
        self._origin, self._pull, self._fallen_speed, self._fallen = np.zeros((4, 3))
        self._recent: deque[tuple[float, float, FloatArray, FloatArray]] = deque(maxlen=RECENT)

    def add(self, imu: ImuIncrements, fixes: NDArray[np.void]) -> None:
        """Take samples, one or many, and fixes of their time or of later ones.

        Parameters
        ----------
        imu : ImuIncrements
            Samples without gaps.
        fixes : (m,) array of AIDING
            Of `Kind.GNSS`, in order of time. Without a velocity its sigmas are infinite.

        Raises
        ------
        AlignmentRefused
            An increment or a fix is not finite, a sigma is not positive, or a fix comes after the samples or fixes of its
            time; nothing is taken then.
        """
        bad = imu.first_bad()
        if bad >= 0:
            raise AlignmentRefused(f"increment {int(imu.sequence[bad])} is not a number: mend the driver or the file")
        waiting = np.concatenate([self._pending, fixes])
        self._check(waiting)
        n = len(imu)
        if n and not math.isfinite(self._start):
            self._start = float(imu.time[0] - imu.step[0])
        integrals = np.empty((n, 4)), np.empty((n, 3)), np.empty((n, 3))
        integrate_body(self._memory, 2, imu.step, imu.dtheta, imu.dvel, np.zeros(3), *integrals)
        ends = np.searchsorted(imu.time, waiting["time"] - 1e-9)
        done = 0
        for fix, end in zip(waiting[ends < n], ends, strict=False):
            vectors.carry(self._body, imu.step[done : end + 1], *(part[done : end + 1] for part in integrals))
            done = int(end) + 1
            if fix["time"] >= self._start:
                rate = imu.dtheta[end] / imu.step[end] if imu.step[end] > 0.0 else np.zeros(3)
                self._take(fix, float(imu.time[end] - fix["time"]), rate)
        vectors.carry(self._body, imu.step[done:], *(part[done:] for part in integrals))
        self._pending = waiting[ends == n]
        if n:
            self._time = float(imu.time[-1])

    @property
    def time_s(self) -> float:
        """From the start of the first sample to the end of the last, s."""
        return self._time - self._start if math.isfinite(self._start) else 0.0

    @property
    def observability(self) -> float:
        """How far the vectors spread: second largest over largest deviation, from 0 (parallel: no heading) to 1."""
        spread = np.linalg.eigvalsh(self._reduced()[_KNOWN, _KNOWN])
        return math.sqrt(max(spread[1], 0.0) / spread[2]) if spread[2] > 0.0 else 0.0

    def result(self) -> Alignment:
        """Attitude at the last sample, with the errors of fixes and biases in its covariance.

        Raises
        ------
        AlignmentRefused
            Too few fixes, all vectors parallel, a heading worse than a third of a radian or than asked, or residuals that
            neither fixes nor biases explain.
        """
        if self._fixes < FIXES:
            raise TooEarly(f"alignment in motion needs {FIXES} fixes and has {self._fixes}: go on")
        sums, s = self._reduced(), self._sensors
        known = sums[_KNOWN, _KNOWN]
        if self.observability < 1e-6:
            raise TooEarly("too little is seen: all vectors are parallel; go on, or turn the vehicle")
        q_ib0, fit = davenport(sums[_KNOWN, _MEASURED])
        by_fix = np.linalg.inv(np.trace(known) * np.eye(3) - known)
        c_ib0 = dcm_from_quaternion(q_ib0)
        by_gyro, by_force = (-by_fix @ _crossed(sums[_KNOWN, part], c_ib0) for part in (_BY_GYRO, _BY_FORCE))
        by_gyro += c_ib0 @ self._body[vectors.TURNED].reshape(3, 3)
        q_ni = conjugate(product(_turned(self.time_s), level_in_earth(*self._place)))
        c_ni = dcm_from_quaternion(q_ni)
        noise = NOISE_AS_BIAS / self.time_s
        gyro = s.gyro_bias**2 + noise * s.angle_random_walk**2
        force = s.accelerometer_bias**2 + noise * s.velocity_random_walk**2
        parts = [c_ni @ part @ c_ni.T for part in (by_fix, by_gyro @ by_gyro.T, by_force @ by_force.T)]
        covariance = parts[0] + gyro * parts[1] + force * parts[2]
        bias = s.gyro_bias**2 * parts[1] + s.accelerometer_bias**2 * parts[2]
        self._refuse_misfit(sums, fit, gyro)
        self._refuse_heading(math.sqrt(covariance[2, 2]), math.sqrt(bias[2, 2]))
        return Alignment(product(q_ni, product(q_ib0, self._body[vectors.Q])), np.zeros(3), covariance)

    def velocity(self, result: Alignment) -> tuple[FloatArray, float]:
        """Velocity of the sensor at the last sample, from the places of the newest fixes.

        Parameters
        ----------
        result : Alignment
            What `result` has answered there.

        Returns
        -------
        vel_n : (3,) float
            North, east, down, m/s.
        sigma : float
            Of each, m/s: places, and the tilt in which gravity is taken.
        """
        time, sigma, gamma, known = (np.array(column) for column in zip(*self._recent, strict=True))
        q_ni = conjugate(product(_turned(self.time_s), level_in_earth(*self._place)))
        q_ib0 = product(product(conjugate(q_ni), result.q_nb), conjugate(self._body[vectors.Q]))
        span = float(time[-1] - time[0])
        slope = np.polyfit(time - time[-1], known - rotated(q_ib0, gamma), 1, w=1.0 / sigma)[0]
        fallen = self._fallen_speed + (self.time_s - self._fix_time) * self._pull
        speed = fallen + rotated(q_ib0, self._body[vectors.ALPHA]) + slope
        here = np.zeros(1, AIDING)[0]
        here["value"][:3] = (*self._place, self._height)
        vel_n = rotated(q_ni, speed - _inertial(here, self.time_s)[1])
        by_place = math.sqrt(12.0 / float((sigma**-2.0).sum())) / span
        return vel_n, math.hypot(by_place, 0.5 * span * 9.8 * result.sigma_tilt)

    def _refuse_heading(self, sigma: float, by_bias: float) -> None:
        asked = min(self._asked, 1.0 / SIGMAS)
        if sigma <= asked:
            return
        text = f"heading is known to {math.degrees(sigma):.3g} deg, {math.degrees(asked):.3g} deg are asked"
        if by_bias > asked:
            raise AlignmentRefused(
                f"the sensors are too noisy: {text}, and their biases alone leave {math.degrees(by_bias):.3g} deg after "
                f"{self.time_s:.0f} s; give a heading, or turn the vehicle where fixes see it"
            )
        raise TooEarly(
            f"too little is seen in {self.time_s:.0f} s: {text} (observability {self.observability:.2g}); go on"
        )

    def _refuse_misfit(self, sums: FloatArray, fit: float, gyro: float) -> None:
        """Refuse residuals that nothing explains; the length of the vectors is free: the accelerometers' scale and bias."""
        length = fit / float(np.trace(sums[_KNOWN, _KNOWN]))
        if abs(length - 1.0) > LENGTH:
            raise Misfit(f"specific force is {length:.2g} times what the fixes say: units or signs?")
        left = float(np.trace(sums[_MEASURED, _MEASURED]) - fit**2 / np.trace(sums[_KNOWN, _KNOWN]))
        explained = 3.0 * self._fixes + gyro * float(np.trace(sums[_BY_GYRO, _BY_GYRO]))
        if left > MISFIT**2 * explained:
            raise Misfit(
                f"the motion does not fit the fixes: residuals are {math.sqrt(left / explained):.0f} times what their sigmas "
                "and the sensors' biases explain; mend the sigmas, the place or the axes"
            )

    def _check(self, fixes: NDArray[np.void]) -> None:
        before = self._time
        for fix in fixes:
            time, sigma = float(fix["time"]), fix["sigma"]
            if fix["kind"] != Kind.GNSS or not np.isfinite([time, *fix["value"]]).all():
                raise AlignmentRefused(f"the fix of {time:.3f} s is no finite GNSS position: mend what sends it")
            if not (sigma > 0.0).all() or abs(fix["value"][0]) > 0.5 * math.pi:
                raise AlignmentRefused(f"the fix of {time:.3f} s has no latitude, or a sigma that is not positive")
            if time < before - 1e-9:
                raise AlignmentRefused(
                    f"the fix of {time:.3f} s comes after samples or fixes of {before:.3f} s: hand it over in order of time"
                )
            before = time

    def _take(self, fix: NDArray[np.void], before: float, rate: FloatArray) -> None:
        """Add a fix that was true `before` s earlier than the last sample, which turns at `rate`."""
        time = float(fix["time"]) - self._start
        place, speed, pull = _inertial(fix, time)
        if self._fixes == 0:
            self._origin = place
        else:  # gravitation is linear between fixes
            h = time - self._fix_time
            self._fallen = self._fallen + h * self._fallen_speed + h * h * (self._pull / 3.0 + pull / 6.0)
            self._fallen_speed = self._fallen_speed + 0.5 * h * (self._pull + pull)
        self._fixes, self._fix_time, self._pull = self._fixes + 1, time, pull
        self._place, self._height = (float(fix["value"][0]), float(fix["value"][1])), float(fix["value"][2])
        body = self._body
        alpha = body[vectors.ALPHA] - before * body[vectors.MEAN]
        gamma = body[vectors.GAMMA] - before * body[vectors.ALPHA] + 0.5 * before**2 * body[vectors.MEAN]
        if self._arm.any():  # the fix is of the end of a lever that turns with the body
            swept = np.cross(rate, self._arm)
            gamma = gamma + rotated(body[vectors.Q], self._arm - before * swept)
            alpha = alpha + rotated(body[vectors.Q], swept)
        by_place = body[vectors.GAMMA_BY_GYRO], body[vectors.GAMMA_BY_FORCE]
        by_speed = body[vectors.ALPHA_BY_GYRO], body[vectors.ALPHA_BY_FORCE]
        known = place - self._origin - self._fallen
        sigma = math.sqrt(float((fix["sigma"][:3] ** 2).mean()))
        self._recent.append((time, sigma, gamma, known))
        self._weigh(fix["sigma"][:3], gamma, known, (1.0, time), *by_place)
        self._weigh(fix["sigma"][3:], alpha, speed - self._fallen_speed, (0.0, 1.0), *by_speed)

    def _weigh(self, sigma: FloatArray, *parts: FloatArray | tuple[float, float]) -> None:
        row = np.concatenate(parts) / math.sqrt(float((sigma**2).mean()))
        self._sums += np.outer(row, row)

    def _reduced(self) -> FloatArray:
        """The sums once r_0 and v_0 are taken out."""
        s = self._sums
        out: FloatArray = s - s[:, _FREE] @ np.linalg.pinv(s[_FREE, _FREE], hermitian=True) @ s[_FREE]
        return out


def mooring(imu: ImuIncrements, lat: float, height: float, sway: float) -> NDArray[np.void]:
    """Fixes of a base that only sways, at the whole multiples of `LOOK_S` of device time that the samples cover.

    Parameters
    ----------
    imu : ImuIncrements
        Samples.
    lat, height : float
        Of the base, rad and m. The longitude does not matter.
    sway : float
        How far the head moves about its mean place, one sigma an axis, m.
    """
    if not len(imu):
        return np.zeros(0, AIDING)
    first, last = (imu.time[0] - imu.step[0]) / LOOK_S, imu.time[-1] / LOOK_S
    times = LOOK_S * np.arange(math.floor(first + 1e-9) + 1, math.floor(last + 1e-9) + 1)
    rows = np.zeros(len(times), AIDING)
    rows["time"], rows["kind"] = times, Kind.GNSS
    rows["value"][:, 0], rows["value"][:, 2] = lat, height
    rows["sigma"][:, :3], rows["sigma"][:, 3:] = sway, np.inf
    return rows


def davenport(profile: FloatArray) -> tuple[FloatArray, float]:
    """The rotation q_ab that makes tr(C_ab^T B) largest, and that value.

    Parameters
    ----------
    profile : (3, 3) float
        B, the sum of v_a v_b^T over the vectors, with their weights.
    """
    k = np.empty((4, 4))
    k[0, 0] = np.trace(profile)
    k[0, 1:] = k[1:, 0] = profile[[2, 0, 1], [1, 2, 0]] - profile[[1, 2, 0], [2, 0, 1]]
    k[1:, 1:] = profile + profile.T - k[0, 0] * np.eye(3)
    values, columns = np.linalg.eigh(k)
    return columns[:, 3], float(values[3])


def _turned(time: float) -> FloatArray:
    """q_ie after `time` s."""
    return np.array([math.cos(0.5 * RATE * time), 0.0, 0.0, math.sin(0.5 * RATE * time)])


def _inertial(fix: NDArray[np.void], time: float) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Place, velocity and gravitation of a fix in i."""
    lat, lon, height = (float(value) for value in fix["value"][:3])
    s, c = math.sin(lat), math.cos(lat)
    _, prime = curvature_radii(s)
    x, y = (prime + height) * c * math.cos(lon), (prime + height) * c * math.sin(lon)
    z = (prime * (1.0 - E2) + height) * s
    speed = rotated(level_in_earth(lat, lon), fix["value"][3:]) + RATE * np.array([-y, x, 0.0])
    pull = gravitation_cartesian(NORMAL, x, y, z, s, c)
    turned = rotated(_turned(time), np.array([(x, y, z), speed, pull]))
    return turned[0], turned[1], turned[2]


def _crossed(moments: FloatArray, c_ib0: FloatArray) -> FloatArray:
    """Sum of [delta x] C_ib0 G from the moments (3, 9) of delta and G."""
    g = np.einsum("mk,jkl->jml", c_ib0, moments.reshape(3, 3, 3))
    return np.stack([g[1, 2] - g[2, 1], g[2, 0] - g[0, 2], g[0, 1] - g[1, 0]])
