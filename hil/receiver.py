"""A receiver of satellite navigation at a port of its own: a process that hands its fixes to the loop, as frames in a ring.

A fix has the device time of the inertial sensor at which it was true. On the host's clock that is its arrival, less the delay of
the scenario, and less what it came late beyond the fastest one by the receiver's own time. From the host's clock to the device's
the loop's fit leads (:mod:`hil.clock`): both steps take the fastest transport seen for a constant one.
"""

import contextlib
import math
import time
from dataclasses import dataclass, field
from multiprocessing.connection import Connection
from typing import Any

from drivers.can.aiding import AidingArray, AidingEncoder
from drivers.can.frames import frames
from drivers.clock import ClockFit
from drivers.serial.fixes import Fix, Stated
from drivers.serial.port import SerialPort
from drivers.serial.receiver import Receiver
from drivers.utc import CELL_S
from hil.control import Control
from hil.geoid import undulation
from hil.ring import Ring
from hil.scenario import ReceiverConfig
from hil.stats import Stats
from nav.aiding import AT_PORTS, Kind, aiding_rows
from nav.errors import HilError

WAIT_S = 0.1
"""Longest wait for bytes: how soon an order to stop is seen."""
BROKEN_S = 1.0
"""A receiver whose time departs by more from the host's, from one fix to the next, has set its clock."""
SETTLE_NS = 2_000_000_000
"""So long fixes only show how far their clock is from the host's: the first may have come late, and nobody could tell."""


@dataclass(slots=True)
class FixClock:
    """Arrivals of fixes on the host's clock, without what they came late.

    Attributes
    ----------
    offset_s : float
        Host clock less UTC by the receiver, s: the smallest seen, with the delay of the fastest fix in it; NaN before a fix.
    late_s : float
        The most that a fix came late beyond that, s.
    steps : int
        Times that the receiver's clock, or the host's, was set.
    """

    offset_s: float = math.nan
    late_s: float = 0.0
    steps: int = 0
    _fit: ClockFit = field(default_factory=lambda: ClockFit(CELL_S))
    _first_s: float = 0.0
    _last_s: float = math.nan
    _begun_ns: int = 0

    def settled(self, fix: Fix) -> bool:
        """Whether a fix that has been taken is of use; one without a time of its own always is."""
        return fix.utc_s is None or fix.arrival_ns - self._begun_ns >= SETTLE_NS

    def arrival_ns(self, fix: Fix) -> int:
        """When `fix` would have arrived by the fastest way, ns."""
        if fix.utc_s is None:
            return fix.arrival_ns
        offset_s = 1e-9 * fix.arrival_ns - fix.utc_s
        if not abs(offset_s - self._last_s) <= BROKEN_S:
            self.steps += math.isfinite(self._last_s)
            self._fit.reset()
            self.offset_s, self._first_s, self._begun_ns = math.nan, fix.utc_s, fix.arrival_ns
        self._last_s = offset_s
        self.offset_s = min(offset_s, self.offset_s) if math.isfinite(self.offset_s) else offset_s
        late_s = self._fit.update(fix.utc_s - self._first_s, fix.arrival_ns)
        self.late_s = max(self.late_s, late_s)
        return fix.arrival_ns - round(1e9 * late_s)


def device_s(stats: Stats, host_ns: int) -> float:
    """Device time of the inertial sensor at `host_ns`, s, by the fit of the loop; NaN while it has no bound."""
    if stats["clock_bound_ns"] < 0:
        return math.nan
    return 1e-9 * (host_ns - stats["clock_offset_ns"])


class Relay:
    """Fixes of receiver `number` into `ring`, and what is counted."""

    def __init__(self, config: ReceiverConfig, number: int, stats: Stats, ring: Ring) -> None:
        stated = Stated(config.range_error_m, config.speed_error_ms, math.radians(config.heading_error_deg))
        offset = math.radians(config.heading_offset_deg)
        self.receiver = Receiver(config.protocol, undulation, stated, offset)
        self._delay_ns, self._source, self._ring = round(1e9 * config.delay_s), AT_PORTS + number, ring
        self._clock, self._stats, self._encoder = FixClock(), stats, AidingEncoder()
        self.sent = 0

    def warm_up(self) -> None:
        """Load the kernels before the first fix."""
        AidingEncoder().frames(aiding_rows([0.0], Kind.GNSS, [0.0] * 6, [1.0] * 6, self._source))
        undulation(0.0, 0.0)

    def take(self, batch: Any) -> None:
        """Send on the fixes that `batch` completes."""
        for fix in self.receiver.take(batch):
            host_ns = self._clock.arrival_ns(fix) - self._delay_ns
            if fix.refused:
                continue
            time_s = device_s(self._stats, host_ns)
            settled = self._clock.settled(fix)
            if not (settled and time_s >= 0.0):
                self.receiver.refused["no inertial sample yet" if settled else "clock settles"] += 1
                continue
            fix.rows["time"], fix.rows["source"] = time_s, self._source
            self._send(fix.rows)

    def _send(self, rows: AidingArray) -> None:
        try:
            batch = self._encoder.frames(rows)
        except HilError:  # it does not fit the wire to the loop
            self.receiver.refused["out of range"] += 1
            return
        batch["time_ns"] = time.time_ns()
        self._ring.push(batch)
        self.sent += len(rows)

    def report(self, port: SerialPort) -> dict[str, Any]:
        """For the summary."""
        receiver, clock = self.receiver, self._clock
        stream = receiver.stream
        result: dict[str, Any] = {
            "port": port.url,
            "speaks": receiver.speaks,
            "fixes": receiver.fixes,
            "sent": self.sent,
            "refused": dict(receiver.refused),
            "packets": stream.packets,
            "foreign": receiver.foreign,
            "crc_errors": stream.bad_checks,
            "skipped_bytes": stream.skipped,
            "host_minus_utc_s": clock.offset_s if math.isfinite(clock.offset_s) else None,
            "late_s": clock.late_s,
            "clock_steps": clock.steps,
        }
        if port.failures:
            result["problem"] = f"{port.url} was lost {port.failures} times"
        elif not stream.packets:
            heard = stream.skipped + stream.waiting
            came = (
                f"{heard} bytes came and no packet was among them: is the baud rate right?" if heard else "nothing came"
            )
            result["problem"] = f"{port.url}: {came}"
        return result


def run_receiver(
    config: ReceiverConfig, number: int, stats: Stats, ring: Ring, control: Control, report: Connection
) -> None:
    """Relay the fixes of a receiver until `control` says stop; target of a spawned process.

    Sends through `report` dictionaries: ``ready`` when it listens, and at the end what was counted; or ``{"failed": message}``
    where the port cannot be opened.
    """
    try:
        relay = Relay(config, number, stats, ring)
        relay.warm_up()
        with contextlib.closing(SerialPort(config.port)) as port:
            batch = frames(256)
            report.send({"ready": True})
            while not control.stop:
                n = port.receive(batch, WAIT_S)
                relay.take(batch[:n])
            report.send(relay.report(port))
    except HilError as error:
        report.send({"failed": str(error)})
    finally:
        report.close()
