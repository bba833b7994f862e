"""Counters of a run in shared memory: written by the loop alone, read by the status line, the publisher and the summary."""

from collections.abc import Sequence
from enum import IntEnum
from typing import Any

import numpy as np

from hil.ring import Shared
from nav.increments import IntArray
from nav.kernel import kernel

BINS = 100_000
"""Bins of 1 us; the last one holds everything longer."""
NO_SAMPLE, NO_BOUND = -2, -1
"""In the place of a bound of the clock: no live sample came; too few came for a bound."""


class Phase(IntEnum):
    """Where the loop is in its life."""

    STARTING = 0
    READY = 1
    RUNNING = 2
    DONE = 3
    FAILED = 4


_FIELDS = (
    "phase",
    "beat_ns",  # host clock of the loop's last round
    "frames",
    "samples",
    "lost",
    "duplicated",
    "late",
    "crc_errors",
    "foreign",
    "short",
    "version_errors",
    "restarts",
    "frozen",
    "clock_steps",
    "interpolated",
    "silences",
    "recorder_lost",
    "overruns",  # rounds that took longer than the samples that they held
    "age_us",  # here to host_steps: set by `hil.clock`, live runs only
    "clock_offset_ns",  # host (clock of the day) less device
    "clock_drift_e12",  # of the device against the host, 1e-12
    "clock_bound_ns",  # NO_SAMPLE, NO_BOUND
    "device_steps",
    "host_steps",
    "position_error_mm",  # -1: no truth
    "covered_us",  # device time from the first sample on, all lives of the device together
    "warm_loop",  # steps of `hil.warmup` that are done
    "warm_head",
)
_INDEX = {name: k for k, name in enumerate(_FIELDS)}


class Times(IntEnum):
    """Durations of which there is a histogram."""

    LATENCY = 0
    """Arrival of a sample's last frame to its solution in the ring."""
    AGE = 1
    """How much later than the fastest one a sample arrived, by its device's clock."""
    WAKE = 2
    """Arrival of the last frame of a round to the loop's having it."""
    ROUND = 3
    """What the loop takes for all that it was woken for."""


STATS = np.dtype(
    [(name, "<i8") for name in _FIELDS] + [("bins", "<i8", (len(Times), BINS)), ("longest", "<i8", len(Times))]
)


@kernel
def _count(bins: IntArray, longest: IntArray, ns: int) -> None:
    us = max(0, ns // 1000)
    bins[min(us, BINS - 1)] += 1
    longest[0] = max(longest[0], us)


@kernel
def _count_since(bins: IntArray, longest: IntArray, now_ns: int, then_ns: IntArray) -> None:
    for ns in then_ns:
        _count(bins, longest, now_ns - ns)


class Stats:
    """The block; picklable to a spawned process."""

    def __init__(self, shared: Shared | None = None) -> None:
        self._shared = shared or Shared(STATS.itemsize)
        record: Any = np.frombuffer(self._shared.memory, STATS, 1)
        self._bins = [record["bins"][0, what] for what in Times]
        self._longest = [record["longest"][0, what : what + 1] for what in Times]
        self._words = np.frombuffer(self._shared.memory, np.int64, len(_FIELDS))
        if shared is None:
            self["position_error_mm"], self["clock_bound_ns"] = -1, NO_SAMPLE

    def __reduce__(self) -> Any:
        return Stats, (self._shared,)

    def set_block(self, first: str, values: Sequence[int]) -> None:
        """Set the fields from `first` on."""
        start = _INDEX[first]
        self._words[start : start + len(values)] = values

    def __getitem__(self, name: str) -> int:
        return int(self._words[_INDEX[name]])

    def __setitem__(self, name: str, value: int) -> None:
        self._words[_INDEX[name]] = value

    def count(self, what: Times, ns: int) -> None:
        """Count a duration, ns."""
        _count(self._bins[what], self._longest[what], ns)

    def count_since(self, what: Times, now_ns: int, then_ns: IntArray) -> None:
        """Count the durations from each of `then_ns` (n,) to now."""
        _count_since(self._bins[what], self._longest[what], now_ns, then_ns)

    def histogram(self, what: Times, edges_us: Sequence[int]) -> list[int]:
        """How many durations lie from each edge (rising, us) to the next; the last count is of all from the last edge on."""
        cumulated = np.concatenate(([0], np.cumsum(self._bins[what])))
        at = cumulated[np.minimum(edges_us, BINS)]
        return [int(n) for n in np.diff(np.append(at, cumulated[-1]))]

    def quantiles_us(self, what: Times) -> dict[str, float]:
        """p50, p99, p999 and max, us; zeros when none was counted."""
        bins = self._bins[what]
        total = int(bins.sum())
        if total == 0:
            return {"p50": 0.0, "p99": 0.0, "p999": 0.0, "max": 0.0}
        cumulated = np.cumsum(bins)
        result = {
            name: float(np.searchsorted(cumulated, np.ceil(part * total)))
            for name, part in (("p50", 0.5), ("p99", 0.99), ("p999", 0.999))
        }
        longest = float(self._longest[what][0])
        if longest >= BINS - 1:  # the last bin says no more than that
            result = {name: longest if value >= BINS - 1 else value for name, value in result.items()}
        return {**result, "max": longest}
