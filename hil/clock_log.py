"""`hil clock`: the clock of a recorded device against the host's, moment by moment."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from drivers import make_driver
from drivers.clock import STEP_S, ClockFit
from hil.samples import driver_of
from hil.source import FileSource
from nav.errors import HilError
from nav.increments import FloatArray, IntArray

IMPLAUSIBLE = 0.01
"""A relative drift from here on is no clock's: the arrivals are not those of real time."""
LATE_S = 1.0
"""The same for a short recording: what its first and last sample may be late."""
STEP_SEEN_S = 10.0
"""A step is looked for so long before the moment at which the fit noticed it."""


@dataclass(frozen=True, slots=True)
class ClockStep:
    """A step of one of the clocks."""

    time_s: float
    """Device time at which the fit noticed it."""
    step_s: float
    """Growth of device less host."""
    clock: str
    """``device``: its time and its count of samples part here; else ``host``, or a transport that was later for long."""


@dataclass(frozen=True, slots=True)
class ClockLog:
    """The fit over a recording; the arrays (n,) hold what was known at each sample, with that sample.

    Attributes
    ----------
    time : (n,) float
        Device time, s; begins anew with each life of the device.
    age : (n,) float
        Arrival over the line of the fit, s: the delay beyond the smallest one.
    bound : (n,) float
        Of the line, s; infinite while unknown.
    drift : (n,) float
        Of the device against the host, relative.
    offset_s : float
        Host less device at the end.
    steps : tuple of ClockStep
        In their order.
    restarts : int
        Lives of the device after the first.
    problem : str
        What was wrong with the recording; empty when nothing.
    """

    time: FloatArray
    age: FloatArray
    bound: FloatArray
    drift: FloatArray
    offset_s: float
    steps: tuple[ClockStep, ...]
    restarts: int
    problem: str

    def summary(self) -> dict[str, Any]:
        """As `hil clock --json` prints it."""
        p50, p99, largest = (1e6 * float(v) for v in np.percentile(self.age, (50.0, 99.0, 100.0)))
        known = bool(np.isfinite(self.bound[-1]))
        return {
            "samples": len(self.time),
            "offset_s": self.offset_s,
            "drift_ppm": 1e6 * float(self.drift[-1]) if known else None,
            "bound_us": 1e6 * float(self.bound[-1]) if known else None,
            "age_us": {"p50": p50, "p99": p99, "max": largest},
            "steps": [{"time_s": s.time_s, "step_s": s.step_s, "clock": s.clock} for s in self.steps],
            "restarts": self.restarts,
        }


def clock_log(path: Path, driver_name: str | None = None) -> ClockLog:
    """Fit the clock of the device in a recording.

    Raises
    ------
    HilError
        The file cannot be read, holds no samples, needs a driver's name, or its arrivals are not those of real time.
    """
    name = driver_name or driver_of(path)
    times, arrivals, counts, problem = _stamps(path, name)
    n = len(times)
    age, bound, drift = np.zeros(n), np.zeros(n), np.zeros(n)
    fit, steps, restarts, life = ClockFit(), list[ClockStep](), 0, 0
    for k in range(n):
        if k and times[k] < times[k - 1]:
            fit.reset()
            restarts, life = restarts + 1, k
        age[k] = fit.update(float(times[k]), int(arrivals[k]))
        bound[k], drift[k] = fit.bound_s, fit.drift
        if fit.steps > len(steps):
            whose = _whose(times[life : k + 1], counts[life : k + 1])
            steps.append(ClockStep(float(times[k]), -fit.step_s, whose))
    device_s, host_s = float(times[-1] - times[0]), int(arrivals[-1] - arrivals[0]) * 1e-9
    if not (restarts or steps) and abs(host_s - device_s) > IMPLAUSIBLE * device_s + LATE_S:
        raise HilError(
            f"{path}: {device_s:.6g} s of the device came in {host_s:.6g} s of the host: its arrivals are not of real time "
            "(--speed max); record a live run"
        )
    offset_s = fit.host_ns(float(times[-1])) * 1e-9 - float(times[-1])
    return ClockLog(times, age, bound, drift, offset_s, tuple(steps), restarts, problem)


def _stamps(path: Path, driver_name: str) -> tuple[FloatArray, IntArray, IntArray, str]:
    """Device time, arrival and count of each sample in a recording, and what was wrong with it."""
    driver, source = make_driver(driver_name), FileSource(path, paced=False)
    parts = []
    for batch in source.batches(1024):
        samples = driver.decode(batch)
        if len(samples):
            parts.append((samples.time.copy(), driver.arrivals().copy(), samples.sequence.copy()))
    if not parts:
        raise HilError(f"{path}: no samples of {driver_name} in it: give the board's driver with --imu")
    times, arrivals, counts = (np.concatenate(column) for column in zip(*parts, strict=True))
    return times, arrivals, counts, source.problem()


def _whose(times: FloatArray, counts: IntArray) -> str:
    """The clock that stepped before the newest sample."""
    first = max(int(np.searchsorted(times, times[-1] - STEP_SEEN_S)) - 1, 0)
    elapsed, counted = np.diff(times[first:]), np.diff(counts[first:])
    apart = np.abs(elapsed - counted * np.median(elapsed / counted))
    return "device" if apart.max() > 0.5 * STEP_S else "host"
