"""What a flight log gives: samples of its inertial unit, what aids it, and the autopilot's own attitude."""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from drivers.can.aiding import AidingArray
from nav.aiding import AIDING, Kind
from nav.errors import HilError
from nav.increments import FloatArray, IntArray

LARGEST_TURN, LARGEST_PUSH = 0.25, 16.0
"""Increments beyond these (rad, m/s) over a nominal period are no motion but damage of the log."""

IRON_S = 1.0
"""How long the error of a magnetometer lasts, s: as noise of that correlation time it is taken."""


@dataclass(frozen=True, slots=True)
class ImuLog:
    """The sensors in a log, as a board would have sent them.

    Attributes
    ----------
    time_us : (n,) int
        Device time at the end of each sample, us.
    counter : (n,) int
        Sample counter: jumps where the log has gaps.
    period_us : int
        Nominal period: the median.
    rate : (n, 3) float
        Body rate, mean over the sample, rad/s.
    force : (n, 3) float
        Specific force, mean over the sample, m/s^2.
    attitude_us : (m,) int
        Times of the log's own attitude.
    attitude : (m, 4) float
        Its q_nb.
    aiding : (k,) array of AIDING
        Measurements in the order in which they arrived.
    arrival_us : (k,) int
        When they arrived, device time.
    declination : float, optional
        Magnetic, east, rad, as the autopilot took it.
    """

    time_us: IntArray
    counter: IntArray
    period_us: int
    rate: FloatArray
    force: FloatArray
    attitude_us: IntArray
    attitude: FloatArray
    aiding: AidingArray
    arrival_us: IntArray
    declination: float | None = None

    @property
    def step_us(self) -> IntArray:
        """Length of each sample, us: the time since the one before, the nominal period after a gap."""
        steps = np.diff(self.time_us, prepend=self.time_us[0] - self.period_us)
        return np.where(self.after_gap, self.period_us, steps)

    @property
    def after_gap(self) -> NDArray[np.bool_]:
        """Whether samples are missing before each; the first is not after a gap."""
        jumps: NDArray[np.bool_] = np.diff(self.counter, prepend=self.counter[0] - 1) != 1
        return jumps

    def shake(self, values: FloatArray) -> float:
        """Standard deviation of what shakes in `rate` or `force` (n, 3): what second differences leave of it.

        They reach over four samples, so that means of neighbours do not hide it.
        """
        second = values[4:] - 2.0 * values[2:-2] + values[:-4]
        whole = self.counter[4:] - self.counter[:-4] == 4
        return math.sqrt(float(np.mean(second[whole] ** 2)) / 6.0) if whole.any() else 0.0  # 1 + 4 + 1 of white noise

    @property
    def track(self) -> AidingArray:
        """The fixes of the first receiver, in the order of their times."""
        fixes = self.aiding[self.aiding["kind"] == Kind.GNSS]
        fixes = fixes[fixes["source"] == fixes["source"].min(initial=np.iinfo(np.int32).max)]
        track: AidingArray = fixes[np.argsort(fixes["time"], kind="stable")]
        return track

    @property
    def place(self) -> tuple[float, float, float] | None:
        """Latitude and longitude, rad, and height, m, of the first fix; None without one."""
        track = self.track
        return None if len(track) == 0 else tuple(track["value"][0, :3].tolist())


def make_log(
    time_us: IntArray,
    rate: FloatArray,
    force: FloatArray,
    attitude_us: IntArray,
    attitude: FloatArray,
    measured: list[tuple[AidingArray, IntArray]],
    declination: float | None = None,
) -> ImuLog:
    """A log from what was read; samples and measurements that cannot be are left out.

    Parameters
    ----------
    time_us, rate, force, attitude_us, attitude, declination
        As in `ImuLog`.
    measured : list of (rows of AIDING, arrivals in us)
        In any order.

    Raises
    ------
    HilError
        Fewer than two good samples or two good attitudes.
    """
    good = steady(time_us) & np.isfinite(rate).all(1) & np.isfinite(force).all(1)
    time_us, rate, force = time_us[good], rate[good], force[good]
    if len(time_us) < 2:
        raise HilError("it has no inertial samples")
    period_us = int(np.median(np.diff(time_us)))
    fits = (np.abs(rate) * period_us * 1e-6 < LARGEST_TURN).all(1) & (
        np.abs(force) * period_us * 1e-6 < LARGEST_PUSH
    ).all(1)
    time_us, rate, force = time_us[fits], rate[fits], force[fits]
    norm = np.linalg.norm(attitude, axis=1)
    right = steady(attitude_us) & (np.abs(norm - 1.0) < 1e-2)
    if len(time_us) < 2 or right.sum() < 2:
        raise HilError("it has no inertial samples, or no attitude of its own")
    missing = np.maximum(np.rint(np.diff(time_us) / period_us).astype(np.int64), 1)
    rows = np.concatenate([np.zeros(0, AIDING), *(part for part, _ in measured)])
    arrival_us = np.concatenate([np.zeros(0, np.int64), *(arrivals for _, arrivals in measured)])
    usable = np.isfinite(rows["value"]).all(1) & (rows["sigma"] > 0.0).all(1)
    usable &= (arrival_us >= time_us[0]) & (arrival_us <= time_us[-1])
    order = np.flatnonzero(usable)[np.argsort(arrival_us[usable], kind="stable")]
    rows, arrival_us = rows[order], arrival_us[order]
    _widen(rows)
    return ImuLog(
        time_us=time_us,
        counter=np.concatenate(([0], np.cumsum(missing))),
        period_us=period_us,
        rate=rate,
        force=force,
        attitude_us=attitude_us[right],
        attitude=attitude[right] / norm[right, None],
        aiding=rows,
        arrival_us=arrival_us,
        declination=declination,
    )


def _widen(rows: AidingArray) -> None:
    """Widen the deviations of magnetometers: what they err by, iron and currents, lasts `IRON_S` and is no white noise."""
    for source in np.unique(rows["source"]):
        of = (rows["kind"] == Kind.MAGNETIC) & (rows["source"] == source)
        if of.sum() > 1:
            period = float(np.median(np.diff(np.sort(rows["time"][of]))))
            rows["sigma"][of] *= math.sqrt(max(1.0, 2.0 * IRON_S / max(period, 1e-3)))


def steady(time_us: IntArray) -> NDArray[np.bool_]:
    """Which times go on from those before: later, and no lone leap (a damaged record) of more than a second."""
    near = np.ones(len(time_us), np.bool_)
    if len(time_us) >= 3:
        around = np.lib.stride_tricks.sliding_window_view(np.pad(time_us, 2, mode="reflect"), 5)
        near = np.abs(time_us - np.median(around, axis=1)) <= 1_000_000
    good: NDArray[np.bool_] = np.diff(np.maximum.accumulate(np.where(near, time_us, -1)), prepend=-1) > 0
    return good
