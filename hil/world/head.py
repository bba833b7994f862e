"""The simulated sensor head: the scenario's motion through its instruments onto the bus, in a process of its own. What else the
simulated world measures goes out between the samples.

The frames depend on the scenario alone, and on faults injected while it runs: the same scenario gives the same bytes at any
speed. With a `driver` other than that of the DTG head they are those of the board of that driver: the same increments, as that
board rounds them.
"""

import math
import time
from collections.abc import Callable, Iterator
from itertools import chain
from multiprocessing.connection import Connection

import numpy as np

from drivers import BoardEmulator, make_emulator
from drivers.can.aiding import AidingEncoder, is_aiding, merge
from drivers.can.bus import Port, open_port
from drivers.can.dtg_head_emulator import SIMULATED, HeadEncoder
from drivers.can.frames import FrameArray, frames
from drivers.serial.chunks import is_chunk
from drivers.serial.pty import PtyPort
from hil.control import Control
from hil.pacing import Pacer
from hil.scenario import Scenario
from hil.stats import Stats
from hil.warmup import warm_head
from hil.wire_config import SERIAL, check_board
from hil.world.aiding import SimulatedAiding
from hil.world.faults import Wire
from hil.world.injection import Injection
from hil.world.instruments import instruments
from nav.errors import HilError
from nav.increments import FloatArray, ImuIncrements
from nav.instruments.redundancy import layout

CHUNK_S = 0.1
"""Motion is computed this far ahead."""


class SimulatedHead:
    """Frames of the head of a scenario, and of what aids the navigator."""

    def __init__(self, scenario: Scenario) -> None:
        head = scenario.head
        self.period_us = round(1e6 / head.rate_hz)
        self.step = self.period_us * 1e-6
        self._instruments = instruments(scenario, self.step)
        self._board = None if scenario.driver == "dtg-head" else board_of(scenario, self.period_us)
        self._axes = np.linalg.pinv(layout(math.radians(head.skew_deg)))
        self.frames_per_sample = (
            (1 if head.layout == "fd" else 6) if self._board is None else self._board.frames_per_sample
        )
        self._encoder = HeadEncoder(
            head.layout,
            self.period_us,
            serial=head.serial,
            world_id=scenario.world_id(),
            hardware=SIMULATED,
            rotor_hz=head.rotor.spin_hz,
        )
        check_board(scenario.driver, scenario.bus, scenario.wire)
        if scenario.bus.startswith(("pty:", "serial:")) and not _sends_bytes(scenario, self.period_us):
            raise HilError(
                f"a {scenario.driver} sends CAN frames, and {scenario.bus} is a serial line: give a CAN bus, "
                f"or a board of a serial port in the scenario: driver = {' | '.join(map(repr, SERIAL))}"
            )
        self.wire = Wire(scenario, self.period_us, self.frames_per_sample) if scenario.wire else None
        self.injection: Injection | None = None
        """Faults that it is told to have while it runs."""
        self._aiding, self._aiding_encoder = SimulatedAiding(scenario), AidingEncoder()
        self._slow_every = max(1, round(1.0 / self.step))
        self._chunk = max(1, min(self._slow_every, round(CHUNK_S / self.step)))

    def chunks(self, samples: int | None) -> Iterator[tuple[int, FrameArray, FrameArray]]:
        """(number of the first sample, slow frames before it, frames of its samples), until `samples` are out.

        A measurement stands behind the first sample that ends when it arrives, or later.
        """
        first = 0
        while samples is None or first < samples:
            until_slow = self._slow_every - first % self._slow_every
            count = min(self._chunk, until_slow, (samples or first + self._chunk) - first)
            slow = (self._board or self._encoder).slow() if first % self._slow_every == 0 else frames(0)
            if self._board is not None:
                slow["time_ns"] = 1 + first * self.period_us * 1000
            yield first, slow, self._samples(first, count)
            first += count

    def _samples(self, first: int, count: int) -> FrameArray:
        sensed = self._instruments.sense(first, count)
        if self.injection is not None:
            self.injection.sensed(first, sensed)
        counter = np.arange(first, first + count)
        ends = (counter + 1) * self.period_us
        said, shown = counter, ends
        if self.wire is not None:
            said, shown = self.wire.device.numbers(counter), ends + self.wire.device.clock_errors(counter)
        if self._board is None:
            batch = self._encoder.samples(said, shown, sensed.dtheta, sensed.dvel, sensed.status, sensed.rotor)
        else:
            dtheta: FloatArray = sensed.dtheta @ self._axes.T
            time = np.asarray(1e-6 * shown, np.float64)
            step = np.full(count, self.step)
            batch = self._board.samples(ImuIncrements(time, step, dtheta, sensed.dvel, sensed.status, said))
            batch["time_ns"] += np.repeat(1000 * (ends - shown), self.frames_per_sample)  # a wrong clock sends no later
        rows, arrivals = self._aiding.arrived(int(ends[-1]))
        if len(rows) == 0:
            return batch
        frames_of_rows = self._aiding_encoder.frames(rows)
        merged = merge(batch, frames_of_rows, np.searchsorted(ends, arrivals), self.frames_per_sample)
        if self._board is not None:
            np.maximum.accumulate(merged["time_ns"], out=merged["time_ns"])
        return merged


def board_of(scenario: Scenario, period_us: int) -> BoardEmulator:
    """The emulated board in the place of the head.

    Raises
    ------
    HilError
        The board cannot be emulated, has no such period, or the instruments are those of the DTG head.
    """
    if scenario.head.instruments != "ideal" or scenario.head.faults:
        raise HilError(
            f"an emulated {scenario.driver} has ideal instruments: leave head.instruments and head.faults out"
        )
    return make_emulator(scenario.driver, period_us)


def _sends_bytes(scenario: Scenario, period_us: int) -> bool:
    """Whether it is a board of a serial port, by its first sample."""
    if scenario.driver == "dtg-head":
        return False
    still = np.zeros((1, 3))
    imu = ImuIncrements(
        np.full(1, 1e-6 * period_us),
        np.full(1, 1e-6 * period_us),
        still,
        still,
        np.zeros(1, np.uint8),
        np.zeros(1, np.int64),
    )
    return bool(is_chunk(board_of(scenario, period_us).samples(imu)).any())


def stream(head: SimulatedHead, port: Port, samples: int | None, *, paced: bool, cancelled: Callable[[], bool]) -> int:
    """Send the head's frames, each sample at its time when `paced`; the number of samples sent."""
    pacer = Pacer()
    if head.wire is not None:
        for due_s, piece in faulty(head, head.wire, samples):
            if cancelled() or (paced and not pacer.wait(due_s, cancelled)):
                break
            if isinstance(port, PtyPort) and not len(piece):
                port.plug(head.wire.is_plugged(due_s))
            port.send(piece if head.injection is None else head.injection.sent(head.wire.samples, piece))
        return head.wire.samples
    k = head.frames_per_sample
    sent = 0
    for first, slow, batch in head.chunks(samples):
        if cancelled():
            break
        starts = np.flatnonzero(~is_aiding(batch["can_id"]))[::k]
        if not paced:
            port.send(np.concatenate([slow, batch]))
            sent += len(starts)
            continue
        if len(slow):
            port.send(slow)
        for i, piece in enumerate(np.split(batch, starts[1:])):
            if not pacer.wait((first + i + 1) * head.step, cancelled):
                return sent
            port.send(piece if head.injection is None else head.injection.sent(first + i, piece))
            sent += 1
    return sent


def faulty(head: SimulatedHead, wire: Wire, samples: int | None) -> Iterator[tuple[float, FrameArray]]:
    """(when they are due, s; frames) of the head as its faulty wire hands them on.

    None at all at the start of each chunk, so that a silent head keeps time, and where the port goes away or comes back.
    """
    edges, nothing = wire.plug_times(), frames(0)
    for first, slow, batch in head.chunks(samples):
        for due, piece in chain([(first * head.step, nothing)], wire.take(first, slow, batch)):
            while edges and edges[0] < due:
                yield edges.pop(0), nothing
            yield due, piece
    yield from wire.finish()


def run_head(scenario: Scenario, paced: bool, control: Control, stats: Stats, answer: Connection) -> None:
    """Target of the head's process: begins on `Control.go`.

    Answers ``{"sent": samples, "dropped": frames}``, with ``"wire"`` where it is faulty, or ``{"failed": message}``.
    """
    try:
        warm_head(scenario, lambda done: stats.__setitem__("warm_head", done))
        head = SimulatedHead(scenario)
        head.injection = Injection(control, head.step)
        while not (control.go or control.stop):
            time.sleep(0.005)
        answer.send(feed(head, scenario, paced=paced, cancelled=lambda: control.stop))
    except HilError as error:
        answer.send({"failed": str(error)})
    finally:
        answer.close()


def feed(head: SimulatedHead, scenario: Scenario, *, paced: bool, cancelled: Callable[[], bool]) -> dict[str, object]:
    """Run `head` on the scenario's bus to the scenario's end; samples sent, frames dropped, and what the wire did."""
    duration = scenario.duration_s
    samples = None if duration is None else math.ceil(duration / head.step - 1e-6)
    port = open_port(scenario.bus, listen=False, lossless=not paced)
    try:
        sent = stream(head, port, samples, paced=paced, cancelled=cancelled)
    finally:
        dropped = port.dropped
        port.close()
    wire = {} if head.wire is None else {"wire": head.wire.report()}
    return {"sent": sent, "dropped": dropped, **wire}
