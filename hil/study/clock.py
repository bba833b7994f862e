"""The fit of a device's clock against simulated clocks and transports: its bound, its drift, and how soon a change is over."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from drivers.clock import ClockFit
from hil.study.report import Line, Plot, Row, Study, at_most, shown
from nav.increments import FloatArray

RATE_HZ = 200.0
SECONDS = 200.0
SETTLED_S = 40.0
"""From here on the window is full."""
STEP_AT_S = 100.0
_START_NS = 1_700_000_000_000_000_000

_ABOUT = """Samples of 200 Hz come through six transports from devices whose clocks gain 30 ppm: what the fit says of the host's
time is compared with the truth at every sample. Then a clock steps, and the drift of a device changes at once."""

Delays = Callable[[np.random.Generator, int], FloatArray]
"""Delays (n,) of samples that follow each other, s, above the smallest one."""


@dataclass(frozen=True, slots=True)
class Fitted:
    """What the fit said at each sample, arrays (n,); the error is that of the host's time of the device's time, s."""

    time: FloatArray
    error: FloatArray
    bound: FloatArray
    drift: FloatArray
    age: FloatArray
    steps: FloatArray
    clock: ClockFit

    def outside(self) -> float:
        """Part of the moments with a stated bound in which it was not kept."""
        known = np.isfinite(self.bound)
        return float(np.mean(np.abs(self.error[known]) > self.bound[known]))


def fitted(host: FloatArray, device: FloatArray, delay: FloatArray) -> Fitted:
    """The fit of samples at the host's times `host` (n,), s, at which the device shows `device`."""
    clock, rows = ClockFit(), np.zeros((5, len(host)))
    stamps = _START_NS + np.rint((host + delay) * 1e9).astype(np.int64)
    for k, (true, shown_s, stamp) in enumerate(zip(host.tolist(), device.tolist(), stamps.tolist(), strict=True)):
        age = clock.update(shown_s, stamp)
        error = (clock.host_ns(shown_s) - _START_NS) * 1e-9 - true
        rows[:, k] = error, clock.bound_s, clock.drift, age, clock.steps
    error_s, bound, drift, ages, steps = rows
    return Fitted(host, error_s, bound, drift, ages, steps, clock)


def moments(seconds: float = SECONDS) -> FloatArray:
    """When samples are taken, s."""
    return np.arange(round(seconds * RATE_HZ)) / RATE_HZ


def exponential(mean: float) -> Delays:
    """Independent delays."""
    return lambda random, n: random.exponential(mean, n)


def queue(random: np.random.Generator, n: int) -> FloatArray:
    """Waiting in a queue that is busy for 80 % of the time (Lindley's recursion), and being served."""
    served = random.exponential(0.8 / RATE_HZ, n)
    waits = np.zeros(n)
    for k in range(1, n):
        waits[k] = max(0.0, waits[k - 1] + served[k - 1] - 1.0 / RATE_HZ)
    return waits + served


def bursts(random: np.random.Generator, n: int) -> FloatArray:
    """Every 15 s the transport stalls for 2 s, and what has waited comes at once."""
    return random.exponential(100e-6, n) + np.maximum(0.0, 2.0 - (np.arange(n) / RATE_HZ + 5.0) % 15.0)


def polled(random: np.random.Generator, n: int) -> FloatArray:
    """A USB adapter that is asked every 16 ms."""
    delay: FloatArray = -(np.arange(n) / RATE_HZ + random.uniform(0.0, 1e-3, n)) % 16e-3
    return delay


TRANSPORTS: dict[str, Delays] = {
    "exponential": exponential(300e-6),
    "gamma": lambda random, n: random.gamma(2.0, 150e-6, n),
    "heavy-tail": lambda random, n: 100e-6 * random.pareto(1.5, n),
    "queue": queue,
    "bursts": bursts,
    "polled": polled,
}


def _transports() -> tuple[list[Row], list[Line]]:
    rows, lines, host = [], [], moments()
    for name, delays in TRANSPORTS.items():
        found = fitted(host, host * (1.0 + 30e-6), delays(np.random.default_rng(7), len(host)))
        late = host > SETTLED_S
        drift = np.abs(found.drift[late] - 30e-6).max()
        error, bound = np.abs(found.error[late]).max(), np.median(found.bound[late])
        rows += [
            at_most(f"outside-{name}", f"{name}: moments outside the bound", 100.0 * found.outside(), "%", 1.0),
            shown(f"bound-{name}", f"{name}: bound from {SETTLED_S:g} s on, median", 1e6 * bound, "us"),
            shown(f"error-{name}", f"{name}: error from {SETTLED_S:g} s on, largest", 1e6 * error, "us"),
            at_most(
                f"drift-{name}", f"{name}: error of the drift from {SETTLED_S:g} s on, largest", 1e6 * drift, "ppm", 4.0
            ),
        ]
        lines.append(Line(name, host[1::20], 1e6 * np.where(np.isfinite(found.bound), found.bound, np.nan)[1::20]))
    return rows, lines


def _changes() -> list[Row]:
    rows, host, random = [], moments(), np.random.default_rng(3)
    after = np.maximum(host - STEP_AT_S, 0.0)
    for step_ms in (-1000.0, -2.0, 2.0, 1000.0):
        shift = np.where(after > 0.0, step_ms * 1e-3, 0.0)
        found = fitted(host, host, random.exponential(100e-6, len(host)) + shift)
        wrong = (np.abs(found.error - shift) > 1e-4) & (host > SETTLED_S)
        over = host[wrong].max(initial=STEP_AT_S) - STEP_AT_S
        what = f"step of host less device by {step_ms:g} ms"
        rows.append(at_most(f"steps{step_ms:+g}", f"{what}: not counted once", abs(found.clock.steps - 1), "", 0.0))
        rows.append(at_most(f"step{step_ms:+g}", f"{what}: over after", over, "s", 5.0))
    for change_ppm in (-200.0, -20.0, 20.0, 200.0):
        found = fitted(host, host + 1e-6 * change_ppm * after, random.exponential(100e-6, len(host)))
        wrong = (np.abs(1e6 * found.drift - change_ppm) > 0.05 * abs(change_ppm)) & (after > 0.0)
        beyond = (np.abs(found.error) - found.bound)[host > SETTLED_S].max()
        what = f"drift changes by {change_ppm:g} ppm at once"
        rows.append(at_most(f"bend{change_ppm:+g}", f"{what}: known to 5 % after", after[wrong].max(), "s", 35.0))
        rows.append(
            shown(f"beyond{change_ppm:+g}", f"{what}: beyond the bound meanwhile", max(0.0, 1e6 * beyond), "us")
        )
    return rows


def run() -> Study:
    """All of it; about half a minute."""
    rows, lines = _transports()
    plot = Plot("bound", "Bound of the host's time by transport", "s", "us", lines, log=True)
    return Study("clock", "Clock of a device", _ABOUT, [*rows, *_changes()], [plot])
