"""`hil navigate --aid`: logged increments navigated with measurements, and smoothed."""

from collections import Counter
from typing import Any

import numpy as np

from drivers.can.aiding import AidingArray
from hil.offline import NAV_HEADER, nav_rows, start_of, steps
from hil.offline_filter import FilterConfig
from nav.aiding import Kind
from nav.errors import HilError
from nav.filter.aided import AidedNavigator
from nav.filter.record import Recorder
from nav.filter.smoother import smooth
from nav.increments import FloatArray, ImuIncrements
from nav.strapdown import Strapdown

SIGMA_HEADER = (
    *("sigma_north_m", "sigma_east_m", "sigma_down_m"),
    *("sigma_vel_north", "sigma_vel_east", "sigma_vel_down"),
    *("sigma_tilt_north_deg", "sigma_tilt_east_deg", "sigma_heading_deg"),
)
"""One sigma; of the attitude about north, east and down."""
AIDED_HEADER = (*NAV_HEADER, *SIGMA_HEADER)


def navigate_aided(
    table: FloatArray,
    start: dict[str, float],
    config: FilterConfig,
    aiding: AidingArray,
    core: Strapdown,
    *,
    smoothed: bool,
) -> tuple[FloatArray, dict[str, Any]]:
    """Navigation rows (n, 19: `AIDED_HEADER`) of IMU rows (n, 7), and what became of the measurements.

    Parameters
    ----------
    table : (n, 7) float
        `hil.offline.IMU_HEADER`.
    start : dict
        `NAV_HEADER`.
    config : FilterConfig
        How the filter is set.
    aiding : (m,) array of AIDING
        In the order of their times.
    core : Strapdown
        The mechanization.
    smoothed : bool
        By all measurements; else by those up to each row.

    Raises
    ------
    HilError
        Time does not increase, an increment is not a number, or a magnetic row without a field to compare with.
    """
    n, time, step = len(table), np.ascontiguousarray(table[:, 0]), steps(table, start)
    if config.field is None and (aiding["kind"] == Kind.MAGNETIC).any():
        raise HilError('magnetic measurements need the field to compare with: field = "dipole" or "wmm" in [filter]')
    begin, recorder = start_of(start), Recorder() if smoothed else None
    navigator = AidedNavigator(core, config.tuning(), config.settings(*begin[:3]), recorder)
    navigator.start(start["time_s"], *begin, config.sigma)
    imu = ImuIncrements(
        time,
        step,
        np.ascontiguousarray(table[:, 1:4]),
        np.ascontiguousarray(table[:, 4:7]),
        np.zeros(n, np.int64),
        np.arange(n),
    )
    position, velocity, attitude, sigma = (np.empty((n, width)) for width in (3, 3, 4, 9))
    stride = max(1, round(navigator.settings.predict_s / float(np.median(step))))
    given = 0
    for first in range(0, n, stride):
        part = slice(first, min(first + stride, n))
        due = int(np.searchsorted(aiding["time"], time[part.stop - 1] + config.gnss_delay_s, side="right"))
        if due > given:
            navigator.aid(aiding[given:due])
            given = due
        position[part], velocity[part], attitude[part] = navigator.process(imu.rows(part.start, part.stop))
        sigma[part] = navigator.sigma[:9]
    if recorder is not None:
        found = smooth(recorder)
        position, velocity, attitude = found.correct(time, position, velocity, attitude)
        for k in range(9):
            sigma[:, k] = np.interp(time, found.time, found.sigma[:, k])
    sigma[:, 6:] = np.degrees(sigma[:, 6:])
    report = _report(navigator) | {"unused": navigator.too_late + len(aiding) - given}
    return np.column_stack([nav_rows(time, position, velocity, attitude), sigma]), report


def _report(navigator: AidedNavigator) -> dict[str, Any]:
    """Measurements by channel and source, and the restarts of the filter."""
    counted = Counter((f"{one.channel.name.lower()}.{one.source}", one.accepted) for one in navigator.judged())
    names = sorted({name for name, _ in counted})
    aiding = {name: {"accepted": counted[name, True], "rejected": counted[name, False]} for name in names}
    return {"aiding": aiding, "restarts": [restart.time for restart in navigator.restarts()]}
