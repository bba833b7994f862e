"""The tracking correction of source 002 beside the unrestricted filter, on the same flights: where does each win?

Fixed gains, steady Kalman gains, and the error-state filter with and without the attitudes of the four antennas.
"""

import math
import os
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import partial

import numpy as np

from hil.study.alignment.records import FIX_S
from hil.study.report import Line, Plot, Row, Study, at_most, shown
from hil.study.tracking import peer
from hil.study.tracking.flights import Flight, fly, noise
from hil.study.tracking.ways import STRIDE, filtered, track
from nav.filter.states import tuning
from nav.filter.tracking_gains import Gains, steady
from nav.increments import FloatArray
from nav.instruments.grades import GRADES, Grade

SEEDS, OUTAGE_S, SETTLED_S = 4, (180.0, 240.0), 100.0
"""Runs; without GNSS; judged from here to the outage."""
CONSTANTS_S = (10.0, 20.0, 40.0)
FILTERS = {"filter": "filter, GNSS alone", "filter-antennas": "filter, GNSS and antennas"}
WAYS = {f"track-{one:g}": f"tracking, 1/K = {one:g} s" for one in CONSTANTS_S} | {
    "track-steady": "tracking, steady gains",
    **FILTERS,
}
"""What is compared, in words."""
PARTS = (("tilt", "deg"), ("heading", "deg"), ("velocity", "m/s"), ("position", "m"))
_UNITS = np.array([math.pi / 180.0, math.pi / 180.0, 1.0, 1.0])
MARGIN = 1.25
"""With white noise the filter with antennas may err so much more than the best tracking correction: there are few runs."""
TIMED_S, PEER_S = 20.0, 120.0
"""Flights on which the time is taken, and pyins flies: minutes."""


def navigate(flight: Flight, grade: Grade, way: str) -> FloatArray:
    """Solutions (n - 1, 10) at the fixes by one of `WAYS`."""
    if way in FILTERS:
        return filtered(flight, tuning(grade, bias_removed=True), antennas=way != "filter")
    if way == "track-steady":
        return track(flight, steady(noise(grade, flight)))
    constant = float(way.removeprefix("track-"))
    return track(flight, Gains(constant, constant, constant, constant))


def run(
    seeds: int = SEEDS,
    settled: float = SETTLED_S,
    outage: tuple[float, float] = OUTAGE_S,
    peer_s: float = PEER_S,
) -> Study:
    """All of it; some minutes."""
    rows: list[Row] = []
    plots: list[Plot] = []
    for motion in ("straight", "turns"):
        for name, grade in GRADES.items():
            more_rows, plot = _compared(motion, name, grade, seeds, settled, outage)
            rows += more_rows
            plots.append(plot)
            draw = partial(_wandering, motion, grade, outage[0])
            late = {way: errors[:, _time(errors) >= settled] for way, errors in _runs(grade, seeds, draw).items()}
            where = f"{grade.name}, {motion}, slow error of GNSS, {seeds} runs"
            rows += _settled(f"{name}-{motion}-wander", where, late, math.inf)
    rows += [*_times(), *peer.rows(peer_s)]
    about = (
        "Straight: level at 70 m/s. Turns: circles and straights at 35 to 80 m/s. Increments at 50 Hz by the table of "
        "grades, GNSS and four antennas (2 m, 5 mm) at 5 Hz, 1.5 m (2.5 m vertical) and 0.05 m/s (0.08), all started in "
        "one epoch. Slow error: 3 m, 200 s, an axis. The filter has 27 states. Reference: the best tracking correction."
    )
    return Study("tracking", "Tracking correction and the unrestricted filter", about, rows, plots)


def _compared(
    motion: str, name: str, grade: Grade, seeds: int, settled: float, outage: tuple[float, float]
) -> tuple[list[Row], Plot]:
    """White noise, then the outage."""
    runs = _runs(grade, seeds, lambda seed: fly(motion, grade, seed, outage[1], outage, wandering=False))
    time_s = _time(next(iter(runs.values())))
    window = (time_s >= settled) & (time_s <= outage[0] + 1e-9)
    where = f"{grade.name}, {motion}, {seeds} runs"
    rows = _settled(f"{name}-{motion}", where, {way: errors[:, window] for way, errors in runs.items()}, MARGIN)
    lines = []
    for way, words in WAYS.items():
        ends = np.sqrt((runs[way][:, -1] ** 2).mean(axis=0)) / _UNITS
        for part in (1, 3):
            what = f"{where}: {words}: {PARTS[part][0]} after {outage[1] - outage[0]:g} s without GNSS, rms"
            rows.append(shown(f"{name}-{motion}-{way}-outage-{PARTS[part][0]}", what, ends[part], PARTS[part][1]))
        lines.append(Line(words, time_s, np.sqrt((runs[way][:, :, 1] ** 2).mean(axis=0)) / _UNITS[1]))
    return rows, Plot(f"heading-{name}-{motion}", f"Heading, {grade.name}, {motion}", "s", "deg", lines)


def _wandering(motion: str, grade: Grade, duration: float, seed: int) -> Flight:
    return fly(motion, grade, seed, duration, None, wandering=True)


def _runs(grade: Grade, seeds: int, draw: Callable[[int], Flight]) -> dict[str, FloatArray]:
    """Errors (seeds, n, 4) by way."""

    def one(seed: int) -> list[FloatArray]:
        flight = draw(seed)
        return [flight.errors(navigate(flight, grade, way)) for way in WAYS]

    with ThreadPoolExecutor(os.cpu_count()) as pool:
        found = list(pool.map(one, range(seeds)))
    return {way: np.array([run[k] for run in found]) for k, way in enumerate(WAYS)}


def _time(errors: FloatArray) -> FloatArray:
    return FIX_S * np.arange(1, errors.shape[1] + 1, dtype=np.float64)


def _settled(key: str, where: str, runs: dict[str, FloatArray], margin: float) -> list[Row]:
    """Rows of the rms of each part by each way; the filter with antennas at most `margin` times the best of the others."""
    rms = {way: np.sqrt((errors**2).mean(axis=(0, 1))) / _UNITS for way, errors in runs.items()}
    best = np.min([value for way, value in rms.items() if way not in FILTERS], axis=0)
    rows = []
    for way, words in WAYS.items():
        for (part, unit), value, other in zip(PARTS, rms[way], best, strict=True):
            what, row = f"{where}: {words}: {part}, rms", f"{key}-{way}-{part}"
            if way == "filter-antennas" and margin < math.inf:
                rows.append(at_most(row, what, value, unit, margin * other, reference=other))
            else:
                rows.append(shown(row, what, value, unit))
    return rows


def _times() -> list[Row]:
    """What a sample costs, one way after the other, fixes and attitudes included."""
    grade = GRADES["tactical"]
    flight, rows = fly("turns", grade, 0, TIMED_S, None, wandering=False), []
    for way, words in WAYS.items():
        navigate(flight, grade, way)
        began = time.thread_time_ns()
        navigate(flight, grade, way)
        cost = 1e-3 * (time.thread_time_ns() - began) / (STRIDE * (len(flight.fixes) - 1))
        rows.append(
            shown(f"time-{way}", f"{words}: processor time a sample at 50 Hz, fixes at 5 Hz included", cost, "us")
        )
    return rows
