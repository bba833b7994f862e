"""Counters of a run in shared memory: written by the loop alone, read by the status line, the publisher and the summary."""

from collections.abc import Sequence
from enum import IntEnum
from typing import Any

import numpy as np

from hil.ring import Shared

LATENCY_BINS = 100_000
"""Bins of 1 us; the last one holds everything longer."""


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
    "age_us",
    "position_error_mm",  # -1: no truth
    "covered_us",  # device time from the first sample on, all lives of the device together
    "warm_loop",  # steps of `hil.warmup` that are done
    "warm_head",
)
STATS = np.dtype([(name, "<i8") for name in _FIELDS] + [("latency", "<i8", LATENCY_BINS), ("latency_max_us", "<i8")])


class Stats:
    """The block; picklable to a spawned process."""

    def __init__(self, shared: Shared | None = None) -> None:
        self._shared = shared or Shared(STATS.itemsize)
        self.record: Any = np.frombuffer(self._shared.memory, STATS, 1)
        self._latency = self.record["latency"][0]
        self._words = np.frombuffer(self._shared.memory, np.int64, len(_FIELDS))
        if shared is None:
            self.record["position_error_mm"] = -1

    def __reduce__(self) -> Any:
        return Stats, (self._shared,)

    def set_block(self, first: str, values: Sequence[int]) -> None:
        """Set the fields from `first` on."""
        start = _FIELDS.index(first)
        self._words[start : start + len(values)] = values

    def __getitem__(self, name: str) -> int:
        return int(self.record[name][0])

    def __setitem__(self, name: str, value: int) -> None:
        self.record[name][0] = value

    def add_latencies(self, latencies_ns: np.ndarray[Any, np.dtype[np.int64]]) -> None:
        """Count latencies (n,), ns."""
        for value in latencies_ns:
            microseconds = max(0, int(value) // 1000)
            self._latency[min(microseconds, LATENCY_BINS - 1)] += 1
            self.record["latency_max_us"][0] = max(self.record["latency_max_us"][0], microseconds)

    def latency_us(self) -> dict[str, float]:
        """p50, p99, p999 and max of the latency, us; zeros when none was counted."""
        total = int(self._latency.sum())
        if total == 0:
            return {"p50": 0.0, "p99": 0.0, "p999": 0.0, "max": 0.0}
        cumulated = np.cumsum(self._latency)
        result = {
            name: float(np.searchsorted(cumulated, np.ceil(part * total)))
            for name, part in (("p50", 0.5), ("p99", 0.99), ("p999", 0.999))
        }
        longest = float(self["latency_max_us"])
        if longest >= LATENCY_BINS - 1:  # the last bin says no more than that
            result = {name: longest if value >= LATENCY_BINS - 1 else value for name, value in result.items()}
        return {**result, "max": longest}
