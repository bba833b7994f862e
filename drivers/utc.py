"""The host's clock against UTC: by a pulse a second on a line of the machine, or by the times that a receiver sends.

Both give pairs of a UTC time and the host's stamp of its arrival, late by an interrupt or by a receiver's computation and its
wire, never early: the same fit as for a device (`drivers.clock`).
"""

import math
from pathlib import Path
from typing import Any

from drivers.clock import ClockFit

PULSES = Path("/sys/class/pps")
"""Where the kernel shows its pulse lines (`modprobe pps-gpio`, `pps-ldisc`)."""
CELL_S = 2.0
"""For one pair a second or more."""


class UtcFit:
    """Host clock less UTC."""

    def __init__(self) -> None:
        self._fit = ClockFit(CELL_S)
        self._first_ns: int | None = None
        self._newest_ns = 0
        self.pairs = 0

    def update(self, utc_ns: int, arrival_ns: int) -> None:
        """Take a UTC time and the host's stamp of its arrival, both ns since 1970."""
        if self._first_ns is None:
            self._first_ns = utc_ns
        self._newest_ns = utc_ns
        self._fit.update((utc_ns - self._first_ns) * 1e-9, arrival_ns)
        self.pairs += 1

    def summary(self) -> dict[str, Any]:
        """Host less UTC at the newest pair, drift of the host, bound of the offset (None: not known yet), steps, pairs."""
        fit, known = self._fit, math.isfinite(self._fit.bound_s)
        offset_ns = fit.host_ns((self._newest_ns - (self._first_ns or 0)) * 1e-9) - self._newest_ns
        return {
            "offset_us": offset_ns * 1e-3 if known else None,
            "drift_ppm": -1e6 * fit.drift if known else None,
            "bound_us": 1e6 * fit.bound_s if known else None,
            "steps": fit.steps,
            "pairs": self.pairs,
        }


class PulseClock:
    """The first pulse line of the kernel that pulses; call `poll` more than once a second.

    The number of the second is that of the host's clock, which must be within half a second of UTC.
    """

    def __init__(self, folder: Path = PULSES) -> None:
        self._lines = sorted(folder.glob("pps*/assert"))
        self._seen: dict[Path, int] = {}
        self._line: Path | None = None
        self._fit = UtcFit()

    def poll(self) -> None:
        """Take the newest pulse, if there is a new one."""
        for line in self._lines if self._line is None else (self._line,):
            stamp = _newest(line)
            if stamp is None:
                continue
            arrival_ns, number = stamp
            if number != self._seen.setdefault(line, number):  # the first one seen may be of long ago
                self._seen[line], self._line = number, line
                self._fit.update(round(arrival_ns, -9), arrival_ns)

    def summary(self) -> dict[str, Any] | None:
        """As `UtcFit.summary`, with the name of the line as ``source``; None without a pulse."""
        return None if self._line is None else {"source": self._line.parent.name, **self._fit.summary()}


def _newest(line: Path) -> tuple[int, int] | None:
    """Stamp (ns) and number of the newest pulse of a line, ``seconds.nanoseconds#number``; None before the first."""
    try:
        stamp, _, number = line.read_text().strip().partition("#")
        seconds, _, nanoseconds = stamp.partition(".")
        return int(seconds) * 1_000_000_000 + int(nanoseconds), int(number)
    except (OSError, ValueError):
        return None
