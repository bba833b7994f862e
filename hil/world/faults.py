"""Faults of the wire behind the simulated head: what the frames of a scenario become before they reach the bus.

They are applied in this order, whatever theirs in the file, each within its time and with a random stream of its own:

- in the device (`DeviceFaults`): the clock steps or drifts, the counter stands still;
- ``drop``, ``bit-flip`` (one bit of the payload), ``crc-off`` (the check stays 0), ``silence`` (nothing goes out), and
  ``unplugged``: the same, and the port is gone;
- ``duplicate``: a frame goes out again right behind itself, as CAN repeats one whose end the sender did not see acknowledged;
- ``reorder``: a sample goes out behind the next one; ``delay`` and ``jitter`` hold frames up, and none overtakes another;
- ``babble``: frames of another node with the identifier that wins every arbitration; on a serial line noise.

On a serial line a frame is a packet.

The result depends on the scenario alone: the same frames in the same order at any speed. What was done is counted, and what a
bridge must count of it (:mod:`hil.world.ledger`).
"""

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, fields
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from drivers.can.aiding import is_aiding
from drivers.can.frames import FDF, FrameArray, frames
from drivers.serial.chunks import CHUNK
from hil.scenario import Scenario
from hil.wire_config import SERIAL, WireFault
from hil.world.ledger import Ledger
from hil.world.serial_ledger import SerialLedger
from nav.increments import FloatArray, IntArray

BABBLE_ID = 0
"""Wins every arbitration, and belongs to nobody here."""
_STREAM = 5
"""What sets the random streams of the wire apart from others of the scenario's seed."""
_CUT = ("samples", "lost", "skipped_bytes")
"""What cannot be said where a port is pulled out: bytes in it are lost too, and it is opened again when somebody looks."""
_SAMPLE, _SLOW, _AIDING, _FOREIGN = range(4)


class DeviceFaults:
    """Counter and clock of the head as they go wrong."""

    def __init__(self, faults: tuple[WireFault, ...], period_us: int) -> None:
        self._faults, self._period_us = faults, period_us

    def numbers(self, counter: IntArray) -> IntArray:
        """What the head says for the sample numbers `counter` (n,)."""
        said = counter.copy()
        for first, end in self._frozen():
            said[(counter >= first) & (counter < end)] = max(first - 1, 0)
        return said

    def clock_errors(self, counter: IntArray) -> IntArray:
        """How far the head's clock is ahead at the ends of the samples `counter` (n,), us."""
        begins, ends = counter * self._period_us, (counter + 1) * self._period_us
        error = np.zeros(len(ends))
        for fault in self._faults:
            since = np.clip(ends - fault.at_s * 1e6, 0.0, (fault.end_s - fault.at_s) * 1e6)
            if fault.kind == "clock-drift":
                error += 1e-6 * fault.drift_ppm * since
            if fault.kind == "clock-step":
                error += 1e6 * fault.step_s * ((begins >= fault.at_s * 1e6) & (begins < fault.end_s * 1e6))
        return np.rint(error).astype(np.int64)

    def is_frozen(self, counter: IntArray) -> NDArray[np.bool_]:
        """Which of the sample numbers (n,) say the number of another."""
        frozen: NDArray[np.bool_] = self.numbers(counter) != counter
        return frozen

    def _frozen(self) -> Iterator[tuple[int, float]]:
        for fault in self._faults:
            if fault.kind == "counter-freeze":
                first, end = (-(-round(edge * 1e6) // self._period_us) for edge in (fault.at_s, min(fault.end_s, 1e9)))
                yield first, end


@dataclass(slots=True)
class _Traffic:
    """Frames on their way, in columns (n,)."""

    frames: FrameArray
    kind: IntArray
    sample: IntArray
    """The sample in whose time the frame stands."""
    part: IntArray
    """Which of the frames of the sample it is."""
    due: FloatArray
    place: FloatArray
    """Order in which they go out."""
    intact: NDArray[np.bool_]
    frozen: NDArray[np.bool_]
    """The sample says the number of another."""
    clock_us: IntArray
    """Error of its time."""

    def chosen(self, index: NDArray[np.bool_] | IntArray) -> "_Traffic":
        return _Traffic(*(getattr(self, column.name)[index] for column in fields(self)))

    def with_more(self, other: "_Traffic") -> "_Traffic":
        return _Traffic(*(np.concatenate([getattr(self, one.name), getattr(other, one.name)]) for one in fields(self)))


class Wire:
    """The wire of one run; `take` it chunk by chunk, then `finish`."""

    def __init__(self, scenario: Scenario, period_us: int, frames_per_sample: int) -> None:
        self._faults = [
            (fault, np.random.default_rng([scenario.seed, _STREAM, k])) for k, fault in enumerate(scenario.wire)
        ]
        self.device = DeviceFaults(scenario.wire, period_us)
        self._step, self._parts = period_us * 1e-6, frames_per_sample
        self._serial = scenario.driver in SERIAL
        self._judged = self._serial or scenario.driver == "dtg-head"
        self._ledger = (
            SerialLedger.of(scenario.driver, period_us) if self._serial else Ledger(frames_per_sample, period_us)
        )
        self._injected, self._lost_by = Counter[str](), Counter[str]()
        self._fates: dict[int, str] = {}
        """What has become of the lost samples of the chunk that goes out."""
        self._held: _Traffic | None = None
        self._last_due, self._swapped = 0.0, -2
        self.samples = self._end = 0
        """Samples whose time has come, and at the end of the chunk."""

    def take(self, first: int, slow: FrameArray, batch: FrameArray) -> Iterator[tuple[float, FrameArray]]:
        """What goes out of a chunk of `SimulatedHead.chunks`: (when it is due, s; frames), in order.

        Frames count as sent when the next ones are asked for.
        """
        traffic = self._traffic(first, slow, batch)
        end = int(traffic.sample[-1]) + 1
        self._lost_by.update(self._fates.values())
        self.samples, self._end = max(self.samples, first), end
        frozen = np.unique(traffic.sample[traffic.frozen & (traffic.kind == _SAMPLE)]).tolist()
        self._fates = dict.fromkeys(frozen, "counter-freeze")
        self._injected["counter-freeze"] += len(frozen)
        now = [one for one in self._faults if one[0].at_s < end * self._step and one[0].end_s > first * self._step]
        for kind in ("drop", "bit-flip", "crc-off", "silence", "unplugged"):
            for fault, rng in now:
                traffic = self._lose(fault, rng, traffic) if fault.kind == kind else traffic
        for kind in ("duplicate", "reorder", "delay", "jitter", "babble"):
            for fault, rng in now:
                traffic = self._change(fault, rng, traffic, first, end) if fault.kind == kind else traffic
        if self._held is not None:
            traffic = self._held.with_more(traffic)
        ripe = traffic.place < end
        self._held = traffic.chosen(~ripe)
        yield from self._out(traffic.chosen(ripe))

    def finish(self) -> Iterator[tuple[float, FrameArray]]:
        """What is still on its way at the end."""
        held, self._held = self._held, None
        if held is not None:
            yield from self._out(held)
        self.samples = self._end

    def is_plugged(self, time_s: float) -> bool:
        """Whether the port is there."""
        return not any(fault.kind == "unplugged" and fault.holds(time_s) for fault, _ in self._faults)

    def plug_times(self) -> list[float]:
        """When the port goes away or comes back, in order."""
        return sorted({edge for one, _ in self._faults if one.kind == "unplugged" for edge in (one.at_s, one.end_s)})

    def report(self) -> dict[str, object]:
        """What was done, by kind: frames (samples for reorder and counter-freeze); samples lost by it; what must be counted."""
        lost = self._lost_by + Counter(kind for sample, kind in self._fates.items() if sample < self.samples)
        lost["clock-step"] += self._ledger.restarts
        result: dict[str, object] = {"samples": self.samples, "injected": dict(+self._injected), "lost": dict(+lost)}
        if self._judged:
            expected, cut = self._ledger.as_dict(), bool(self.plug_times())
            result["expected"] = {name: count for name, count in expected.items() if not (cut and name in _CUT)}
        return result

    def _traffic(self, first: int, slow: FrameArray, batch: FrameArray) -> _Traffic:
        aiding, many = is_aiding(batch["can_id"]), len(slow)
        number = np.maximum(np.cumsum(~aiding) - 1, 0)
        sample = first + np.concatenate([np.zeros(many, np.int64), number // self._parts])
        samples = np.arange(first, int(sample[-1]) + 1)
        return _Traffic(
            frames=np.concatenate([slow, batch]),
            kind=np.concatenate([np.full(many, _SLOW), np.where(aiding, _AIDING, _SAMPLE)]),
            sample=sample,
            part=np.concatenate([np.zeros(many, np.int64), number % self._parts]),
            due=(sample + 1) * self._step,
            place=sample.astype(float),
            intact=np.ones(len(sample), np.bool_),
            frozen=self.device.is_frozen(samples)[sample - first],
            clock_us=self.device.clock_errors(samples)[sample - first],
        )

    def _within(self, fault: WireFault, traffic: _Traffic) -> NDArray[np.bool_]:
        begins = traffic.sample * self._step + 1e-9
        within: NDArray[np.bool_] = (begins >= fault.at_s) & (begins < fault.end_s)
        return within

    def _lose(self, fault: WireFault, rng: np.random.Generator, traffic: _Traffic) -> _Traffic:
        """Take frames out or damage them, and note what became of their samples."""
        hit = self._within(fault, traffic)
        draws = rng.random((int(hit.sum()), 2))
        if fault.kind in {"drop", "bit-flip"}:
            hit[hit] = draws[:, 0] < fault.share
        if fault.kind == "bit-flip":
            rows = np.flatnonzero(hit)
            bit = (draws[draws[:, 0] < fault.share, 1] * 8 * traffic.frames["length"][rows]).astype(np.int64)
            traffic.frames["data"][rows, bit // 8] ^= (1 << bit % 8).astype(np.uint8)
        if fault.kind == "crc-off":
            hit &= (traffic.kind == _SAMPLE) | (traffic.kind == _SLOW)
            rows, data = np.flatnonzero(hit), traffic.frames["data"]
            wide = (traffic.frames["flags"][rows] & FDF) != 0
            hit[rows] = (data[rows, 0] != 0) | (wide & (data[rows, 1] != 0))  # a check that is 0 anyway stays right
            data[rows, 0] = 0
            data[rows[wide], 1] = 0
        self._injected[fault.kind] += int(hit.sum())
        if self._judged or fault.kind != "bit-flip":  # a board without a check does not see the damage
            for sample in np.unique(traffic.sample[hit & (traffic.kind == _SAMPLE)]).tolist():
                self._fates.setdefault(sample, fault.kind)
        if fault.kind in {"drop", "silence", "unplugged"}:
            return traffic.chosen(~hit)
        traffic.intact[hit] = False
        return traffic

    def _change(self, fault: WireFault, rng: np.random.Generator, traffic: _Traffic, first: int, end: int) -> _Traffic:
        """Send frames twice, later or in another order, or others among them; none is lost."""
        hit = self._within(fault, traffic)
        times = np.arange(first, end) * self._step + 1e-9
        slots = np.flatnonzero((times >= fault.at_s) & (times < fault.end_s)) + first
        if fault.kind == "duplicate":
            hit[hit] = rng.random(int(hit.sum())) < fault.share
            self._injected["duplicate"] += int(hit.sum())
            return traffic.chosen(np.repeat(np.arange(len(hit)), 1 + hit))
        if fault.kind == "reorder":
            for slot in slots[rng.random(len(slots)) < fault.share].tolist():
                if slot != self._swapped + 1:
                    self._swapped = slot
                    moved = (traffic.sample == slot) & (traffic.kind == _SAMPLE)
                    traffic.place[moved] += 1.5
                    traffic.due[moved] += self._step
                    self._injected["reorder"] += 1
            return traffic
        if fault.kind == "babble":
            return self._babbled(fault, rng, traffic, slots)
        held = np.zeros(end - first)
        held[slots - first] = fault.delay_s * (rng.random(len(slots)) if fault.kind == "jitter" else 1.0)
        traffic.due += held[traffic.sample - first]
        self._injected[fault.kind] += int(hit.sum())
        return traffic

    def _babbled(self, fault: WireFault, rng: np.random.Generator, traffic: _Traffic, slots: IntArray) -> _Traffic:
        since = np.maximum((slots[:, None] + np.array([0, 1])) * self._step - fault.at_s, 0.0)
        counts = np.diff(np.floor(since * fault.rate_hz + 1e-6).astype(np.int64), axis=1)[:, 0]
        sample = np.repeat(slots, counts)
        n = len(sample)
        batch = frames(n)
        batch["can_id"], batch["length"] = CHUNK if self._serial else BABBLE_ID, 8
        if self._serial:
            batch["data"][:, :8] = rng.integers(0, 256, (n, 8))
        if len(traffic.frames) and n and traffic.frames["time_ns"].any():  # frames that have their time already
            batch["time_ns"] = np.rint((sample + 1) * self._step * 1e9).astype(np.int64)
        self._injected["babble"] += n
        whole = np.ones(n, np.bool_)
        own = np.full(n, _FOREIGN)
        due: FloatArray = np.asarray((sample + 1) * self._step)
        zeros = np.zeros(n, np.int64)
        other = _Traffic(batch, own, sample, zeros, due, sample.astype(float), whole, zeros != 0, zeros)
        return other.with_more(traffic)

    def _out(self, traffic: _Traffic) -> Iterator[tuple[float, FrameArray]]:
        traffic = traffic.chosen(np.argsort(traffic.place, kind="stable"))
        if not len(traffic.frames):
            return
        due = np.maximum.accumulate(np.maximum(traffic.due, self._last_due))
        self._last_due = float(due[-1])
        stamped = traffic.frames["time_ns"] > 0
        late_ns = np.rint((due - (traffic.sample + 1) * self._step) * 1e9).astype(np.int64)
        traffic.frames["time_ns"][stamped] += late_ns[stamped]
        length = traffic.frames["length"]
        columns = (traffic.kind, traffic.sample, traffic.part, traffic.intact, traffic.frozen, traffic.clock_us, length)
        rows = list(zip(*(column.tolist() for column in columns), strict=True))
        for start, end in pairwise([0, *(np.flatnonzero(np.diff(due)) + 1).tolist(), len(due)]):
            yield float(due[start]), traffic.frames[start:end]
            for row in rows[start:end]:
                self._enter(*row)

    def _enter(self, kind: int, sample: int, part: int, intact: bool, frozen: bool, clock_us: int, length: int) -> None:
        ledger = self._ledger
        self.samples = max(self.samples, sample + 1)
        ledger.frames += 1
        if kind == _FOREIGN:
            ledger.foreign += 1
            ledger.skipped_bytes += length
        elif not intact:
            ledger.crc_errors += kind != _AIDING
            ledger.skipped_bytes += length * (kind != _AIDING)
        elif kind == _SAMPLE:
            ledger.add_part(sample, part, clock_us, frozen=frozen)
