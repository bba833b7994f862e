"""The clocks of a live run: the device's against the host's, and whether the host's own was set.

Frames are stamped by the host's clock of the day, which NTP or a user may set. The monotonic clock is slewed like it and never
set, so the difference of the two tells a step of the host from one of the device, and the fit goes by the monotonic one.
"""

import math
import time
from collections.abc import Callable
from typing import Any

from drivers.clock import NEAR_S, ClockFit
from drivers.mavlink.messages import ClockReading
from hil.stats import NO_BOUND, NO_SAMPLE, Stats, Times
from nav.navigator import Severity

CLEAR_READ_NS = 50_000
"""Two readings of the host's clocks that lie further apart were interrupted and say nothing."""
UNCLEAR_NS = 1_000_000_000
"""Frames that come so soon after a step of the host's clock may carry stamps from before it."""


class HostClock:
    """The clock of the day less the monotonic one, and its steps."""

    def __init__(self) -> None:
        self.steps = 0
        """Steps of more than `NEAR_S`."""
        self.step_s = 0.0
        """The last one."""
        self._ahead_ns: int | None = None
        self._clear_ns = 0

    def look(self, before_ns: int, day_ns: int, after_ns: int) -> tuple[int, bool]:
        """Clock of the day less monotonic one, ns, by a reading between two; and whether stamps can be put to it now."""
        ahead = day_ns - (before_ns + after_ns) // 2
        if self._ahead_ns is None:
            self._ahead_ns = ahead
        elif after_ns - before_ns < CLEAR_READ_NS and abs(ahead - self._ahead_ns) > NEAR_S * 1e9:
            self.steps += 1
            self.step_s = (ahead - self._ahead_ns) * 1e-9
            self._ahead_ns, self._clear_ns = ahead, after_ns + UNCLEAR_NS
        return self._ahead_ns, after_ns >= self._clear_ns


class LoopClock:
    """Keeps the fit of a live loop, and what it says in the shared counters.

    Parameters
    ----------
    stats : Stats
        Gets age, offset, drift, bound and steps.
    tell : callable
        Called with device time, severity and text of a step.
    """

    def __init__(self, stats: Stats, tell: Callable[[float, Severity, str], None]) -> None:
        self._stats, self._tell = stats, tell
        self._fit, self._host = ClockFit(), HostClock()
        self._said = (0.0, 0.0, 0, 0)
        self._told = self._host_told = 0

    def take(self, device_s: float, arrival_ns: int) -> None:
        """Take the newest sample of a batch: of those that came together it has waited least."""
        fit, host = self._fit, self._host
        ahead_ns, clear = host.look(time.monotonic_ns(), time.time_ns(), time.monotonic_ns())
        if clear:
            age_s = fit.update(device_s, arrival_ns - ahead_ns)
            self._stats["age_us"] = round(1e6 * age_s)
            self._stats.count(Times.AGE, round(1e9 * age_s))
            self._stats["clock_offset_ns"] = fit.host_ns(device_s) + ahead_ns - round(1e9 * device_s)
        said = (fit.drift, fit.bound_s, fit.steps, host.steps)
        if said != self._said:  # a few times a second
            self._said = said
            drift, bound_s, *steps = said
            bound_ns = round(1e9 * bound_s) if bound_s < math.inf else NO_BOUND
            self._stats.set_block("clock_drift_e12", (round(1e12 * drift), bound_ns, *steps))
        if fit.steps != self._told:
            self._told = fit.steps
            self._tell(device_s, "warning", f"clock step: device less host changed by {-fit.step_s:+.4f} s")
        if host.steps != self._host_told:
            self._host_told = host.steps
            self._tell(device_s, "warning", f"clock step: the host's clock was set by {host.step_s:+.4f} s")

    def reset(self) -> None:
        """The device was restarted."""
        self._fit.reset()


def clock_reading(stats: Stats) -> ClockReading | None:
    """What the loop's clock says now; None while no bound is known."""
    bound_ns = stats["clock_bound_ns"]
    if bound_ns < 0:
        return None
    return ClockReading(
        stats["clock_offset_ns"],
        stats["clock_drift_e12"] * 1e-6,
        bound_ns * 1e-3,
        stats["device_steps"] + stats["host_steps"],
    )


def clock_summary(stats: Stats) -> dict[str, Any] | None:
    """What the summary says of the clocks; None where no live sample came."""
    if stats["clock_bound_ns"] == NO_SAMPLE:
        return None
    reading = clock_reading(stats)
    return {
        "offset_s": None if reading is None else reading.offset_ns * 1e-9,
        "drift_ppm": None if reading is None else reading.drift_ppm,
        "bound_us": None if reading is None else reading.bound_us,
        "steps": stats["device_steps"],
        "host_steps": stats["host_steps"],
    }
