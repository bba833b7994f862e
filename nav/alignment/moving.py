"""Alignment of what moves, as links of the chain: by optimisation at a mooring or with GNSS, and from another navigator.

Samples are held back for `LATE_S`, so that a measurement may come late. The navigation begins at the newest fix; the samples
since then are handed over with the start.
"""

import math
from bisect import insort
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from nav.aiding import AIDING, Kind
from nav.alignment.analytic import Alignment, AlignmentRefused
from nav.alignment.held import LATE_S, Held, turn_between
from nav.alignment.optimization import Misfit, MotionAlignment, TooEarly, mooring
from nav.alignment.plan import GIVEN_UP, Plan, Start, Word, place_of_sensor
from nav.alignment.standing import GYROCOMPASS_LIMIT
from nav.earth import curvature_radii, normal_gravity
from nav.frames import earth_rate_in_level
from nav.increments import FloatArray, ImuIncrements, Validity
from nav.lever_arm import shift
from nav.rotation import product, quaternion_from_rotation_vector, rotated
from nav.state import Health

FEED_S = 1.0
"""Held samples are taken in pieces of this length, s."""
AGAIN_S = 10.0
"""Time to the next try, s."""


class InMotion:
    """The ways ``swaying`` and ``moving``: :class:`nav.alignment.optimization.MotionAlignment`, asked after the time of the plan.

    A gap that was bridged starts it anew: nobody knows how the body turned in it.

    Parameters
    ----------
    plan : Plan
        How.
    place : (3,) float
        Where the navigated point sways; not looked at in flight.
    """

    def __init__(self, plan: Plan, place: FloatArray) -> None:
        self._plan, self._place = plan, place
        self._swaying = plan.way == "swaying"
        self._held = Held()
        self._anew()

    def _anew(self) -> None:
        asked, antenna = (GYROCOMPASS_LIMIT, (0.0, 0.0, 0.0)) if self._swaying else (math.inf, self._plan.antenna)
        self._found = MotionAlignment(self._plan.sensors, asked, antenna)
        self._held.drop(len(self._held.rows))
        self._fixes: list[np.void] = []
        self._begun = self._now = self._feed_at = self._ask_at = -math.inf
        self._progress = 0.0

    @property
    def progress(self) -> float:
        """See `Aligner`."""
        return self._progress

    def aid(self, rows: NDArray[np.void]) -> None:
        """See `Aligner`."""
        if not self._swaying:
            for row in rows[(rows["kind"] == Kind.GNSS) & (rows["time"] > self._fed)]:
                insort(self._fixes, row.copy(), key=_time)

    @property
    def _fed(self) -> float:
        return self._found.time_s + self._begun

    def take(self, imu: ImuIncrements, start: int, stop: int) -> tuple[int, Word | None]:
        """See `Aligner`."""
        bridged = (imu.validity[start:stop] & Validity.BRIDGED) != 0
        if bridged[0]:
            if math.isfinite(self._begun):
                self._anew()
                return 1, Word(notice="aligning anew: a gap was bridged")
            return int(np.argmin(bridged)) or stop - start, None
        if bridged.any():
            stop = start + int(np.argmax(bridged))
        if not math.isfinite(self._begun):
            self._begun = self._now = float(imu.time[start] - imu.step[start])
            self._feed_at, self._ask_at = self._begun + FEED_S, self._begun + self._plan.align_s
        due = min(self._feed_at, self._ask_at) - 1e-9
        n = min(int(np.searchsorted(imu.time[start:stop], due)) + 1, stop - start)
        self._held.add(imu.rows(start, start + n))
        self._now = float(imu.time[start + n - 1])
        if self._now < due:
            return n, None
        self._progress = min(1.0, (self._now - self._begun) / self._plan.align_s)
        if self._now >= self._ask_at - 1e-9:
            return n, self._asked()
        self._feed_at = self._now + FEED_S
        self._feed(int(np.searchsorted(self._held.rows.time, self._now - LATE_S, "right")))
        return n, None

    def _feed(self, n: int) -> None:
        """Let go of the oldest `n` samples, with the fixes of their time."""
        some = self._held.rows.rows(0, n)
        if self._swaying:
            fixes = mooring(some, float(self._place[0]), float(self._place[2]), self._plan.sway)
        else:
            until = some.time[-1] + 1e-9 if n else -math.inf
            fixes = np.array([fix for fix in self._fixes if fix["time"] <= until], AIDING)
            self._fixes = self._fixes[len(fixes) :]
        self._found.add(some, fixes)
        self._held.drop(n)

    def _asked(self) -> Word:
        try:
            start = self._moored() if self._swaying else self._flying()
        except TooEarly as refusal:
            self._ask_at = self._now + AGAIN_S
            return Word(((Health.RATE_TOO_SMALL, str(refusal)),))
        except AlignmentRefused as refusal:
            self._anew()
            return Word(((Health.MOVING if isinstance(refusal, Misfit) else Health.RATE_TOO_SMALL, str(refusal)),))
        return Word(cleared=GIVEN_UP, start=start)

    def _moored(self) -> Start:
        self._feed(len(self._held.rows))
        result = self._found.result()
        velocity, sigma_velocity = self._found.velocity(result)
        place = place_of_sensor(self._place, result.q_nb, self._plan.lever_arm)
        sigma = np.repeat([self._plan.sway, sigma_velocity], 3)
        return self._start(self._now, place, velocity, sigma, result)

    def _flying(self) -> Start:
        there = [fix for fix in self._fixes if fix["time"] <= self._now and np.isfinite(fix["sigma"][:3]).all()]
        if not there:
            raise TooEarly(f"alignment in motion needs GNSS, and no fix is newer than {LATE_S:g} s: go on")
        fix, rows = there[-1], self._held.rows
        last = int(np.searchsorted(rows.time, fix["time"] - 1e-9))
        moved = _moved(rows, last)
        self._feed(last + 1)
        result = self._found.result()
        place, velocity, sigma = _carried(fix, moved, result.q_nb, self._plan)
        if not np.isfinite(sigma[3:]).all():
            velocity, sigma[3:] = self._found.velocity(result)
        return self._start(moved.time, place, velocity, sigma, result)

    def _start(
        self, time: float, place: FloatArray, velocity: FloatArray, sigma: FloatArray, result: Alignment
    ) -> Start:
        errors = np.concatenate([sigma, np.sqrt(np.diag(result.covariance))])
        remark = _known(result.sigma_heading)
        took_s = self._now - self._begun
        return Start(time, place, velocity, result.q_nb, np.zeros(3), errors, took_s, remark, self._held.rows)


class Transfer:
    """The way ``transfer``: at once, from an attitude and a fix of another navigator that are at most `LATE_S` apart.

    Parameters
    ----------
    plan : Plan
        How.
    """

    def __init__(self, plan: Plan) -> None:
        self._plan, self._held = plan, Held()
        self._newest: dict[int, np.void] = {}
        self._pair: tuple[np.void, np.void] | None = None
        self._now = -math.inf

    @property
    def progress(self) -> float:
        """See `Aligner`."""
        return 0.0

    def aid(self, rows: NDArray[np.void]) -> None:
        """See `Aligner`."""
        for row in rows:
            useful = row["kind"] == Kind.ATTITUDE or (row["kind"] == Kind.GNSS and np.isfinite(row["sigma"]).all())
            if not useful or row["time"] <= self._now - LATE_S:
                continue
            self._newest[int(row["kind"])] = row.copy()
            if len(self._newest) == 2:
                fix, attitude = self._newest[Kind.GNSS], self._newest[Kind.ATTITUDE]
                first = min(fix["time"], attitude["time"])
                if abs(fix["time"] - attitude["time"]) <= LATE_S and first > self._now - LATE_S:
                    self._pair = fix, attitude

    def take(self, imu: ImuIncrements, start: int, stop: int) -> tuple[int, Word | None]:
        """See `Aligner`."""
        due = math.inf if self._pair is None else float(max(row["time"] for row in self._pair)) - 1e-9
        n = min(int(np.searchsorted(imu.time[start:stop], due)) + 1, stop - start)
        self._held.add(imu.rows(start, start + n))
        self._now = float(imu.time[start + n - 1])
        if self._pair is not None and self._now >= due:
            return n, Word(cleared=GIVEN_UP, start=self._started(*self._pair))
        if self._pair is None and self._held.rows.time[0] < self._now - 2.0 * LATE_S:
            self._held.drop(int(np.searchsorted(self._held.rows.time, self._now - LATE_S)))
        return n, None

    def _started(self, fix: np.void, attitude: np.void) -> Start:
        rows = self._held.rows
        last = int(np.searchsorted(rows.time, fix["time"] - 1e-9))
        moved = _moved(rows, last)
        turned = turn_between(rows, float(attitude["time"]), moved.time)
        north = -(moved.time - attitude["time"]) * earth_rate_in_level(float(fix["value"][0]))
        q_nb = product(quaternion_from_rotation_vector(north), product(attitude["value"][:4], turned))
        place, velocity, sigma = _carried(fix, moved, q_nb, self._plan)
        errors = np.concatenate([sigma, attitude["sigma"][:3]])
        self._held.drop(last + 1)
        remark = _known(float(attitude["sigma"][2]))
        return Start(moved.time, place, velocity, q_nb, np.zeros(3), errors, 0.0, remark, self._held.rows)


class _Moved(NamedTuple):
    """What the body did in a sample: its end, s, rate and specific force, b."""

    time: float
    rate: FloatArray
    force: FloatArray


def _moved(imu: ImuIncrements, row: int) -> _Moved:
    step = float(imu.step[row]) or math.inf
    return _Moved(float(imu.time[row]), imu.dtheta[row] / step, imu.dvel[row] / step)


def _carried(fix: np.void, moved: _Moved, q_nb: FloatArray, plan: Plan) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Place and velocity of the sensor at the end of the sample in which the antenna's fix is; sigmas (6,) of both."""
    after, value = moved.time - float(fix["time"]), fix["value"]
    lat, lon, height, velocity = value[0:1].copy(), value[1:2].copy(), value[2:3].copy(), value[3:].copy()
    arm = -np.array(plan.antenna)
    shift(lat, lon, height, velocity.reshape(1, 3), q_nb.reshape(1, 4), moved.rate.reshape(1, 3), arm)
    meridian, prime = curvature_radii(math.sin(lat[0]))
    lat += after * velocity[0] / (meridian + height)
    lon += after * velocity[1] / ((prime + height) * np.cos(lat))
    height -= after * velocity[2]
    velocity += after * rotated(q_nb, moved.force)
    velocity[2] += after * normal_gravity(math.sin(lat[0]), float(height[0]))
    return np.concatenate([lat, lon, height]), velocity, fix["sigma"].copy()


def _known(sigma_heading: float) -> str:
    return f"heading known to {math.degrees(sigma_heading):.2g} deg"


def _time(fix: np.void) -> float:
    return float(fix["time"])
