"""The aided loop: what the error-state filter takes beside the core, at the rates of real sensors."""

import statistics
import time
from collections.abc import Callable
from functools import partial

import numpy as np
from numpy.typing import NDArray

from hil.bench.timing import Row, Sizes, row
from nav.aiding import Kind, aiding_rows
from nav.filter.aided import AidedNavigator, Settings
from nav.filter.states import SENSOR_BLOCKS, Block, tuning
from nav.instruments.grades import GRADES
from nav.strapdown import Strapdown

RATE_HZ, PREDICT_HZ = 1000, 50
FIELD_N = (20e-6, 3e-6, 44e-6)
STATES = {27: SENSOR_BLOCKS, 35: tuple(Block)}
_REST = 0.9, 0.6, 500.0, np.zeros(3), np.array([1.0, 0.0, 0.0, 0.0])
_SENSORS = (
    (5, Kind.GNSS, (0.9, 0.6, 500.0, 0.0, 0.0, 0.0), (1.5, 1.5, 2.5, 0.05, 0.05, 0.08)),
    (10, Kind.BARO, (500.0,), (1.0,)),
    (25, Kind.MAGNETIC, FIELD_N, (3e-7,) * 3),
)
"""Hz, and what they measure at rest."""


def rows(sizes: Sizes) -> list[Row]:
    """The core alone, with the filter, and what the filter takes beside the core: ns of processor time a sample."""
    record = AidedRecord(4 * sizes.calls)
    core = _cost(record.core, len(record.samples), sizes.repeats)
    found = [row("aided-core", "1 kHz, one sample a call: core alone, processor time", core)]
    for states, blocks in STATES.items():
        what = f"the same with the filter: {states} states at 50 Hz, GNSS 5 Hz, barometer 10 Hz, magnetometer 25 Hz"
        cost = _cost(partial(record.aided, blocks), len(record.samples), sizes.repeats)
        found.append(row(f"aided-{states}", what, cost))
        found.append(row(f"aided-{states}-beside", "the filter of it: 10 000 ns are 1 % of a processor", cost - core))
    return found


def _cost(run: Callable[[], object], count: int, repeats: int) -> float:
    """Median of the processor time, ns a sample: the share of a processor does not depend on what else runs on it."""
    run()
    times = []
    for _ in range(repeats):
        began = time.thread_time_ns()
        run()
        times.append((time.thread_time_ns() - began) / count)
    return statistics.median(times)


class AidedRecord:
    """A unit at rest: its samples as numbers of Python, and the measurements that come right behind them."""

    def __init__(self, count: int) -> None:
        step = 1.0 / RATE_HZ
        noise = np.random.default_rng(0).standard_normal((count, 6)) * np.repeat([1e-6, 1e-4], 3)
        noise[:, 5] -= 9.812 * step
        self.samples = [(step * (k + 1), step, *one) for k, one in enumerate(noise.tolist())]
        self._behind: list[list[NDArray[np.void]]] = [[] for _ in self.samples]
        for rate, kind, value, sigma in _SENSORS:
            stride = RATE_HZ // rate
            for k in range(stride - 1, count, stride):
                self._behind[k].append(aiding_rows([self.samples[k][0]], kind, value, sigma))

    def core(self) -> None:
        """All of it by the core."""
        core = Strapdown()
        core.start(*_REST)
        for _, *sample in self.samples:
            core.push(*sample)

    def aided(self, blocks: tuple[Block, ...]) -> AidedNavigator:
        """All of it by the core and the filter."""
        settings = Settings(predict_s=1.0 / PREDICT_HZ, field_n=FIELD_N)
        navigator = AidedNavigator(Strapdown(), tuning(GRADES["tactical"], blocks), settings)
        navigator.start(0.0, *_REST, np.array([1.5, 1.5, 2.5, 0.05, 0.05, 0.08, 2e-3, 2e-3, 1e-2]))
        for sample, behind in zip(self.samples, self._behind, strict=True):
            navigator.push(*sample)
            for one in behind:
                navigator.aid(one)
        return navigator
