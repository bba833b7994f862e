"""Driver of the dual-DTG head: frames of `fixtures/can/dtg_head.dbc`, FD or classic, to `HeadIncrements`.

What is dropped is counted (`drivers.Counters`). The order of samples is judged by the 32-bit counter and the device's
clock: the next one or a later one is taken (what is missing counts as lost); one of the last 63 that was not seen yet
comes late, one that was seen is a duplicate, both are dropped; one whose counter stands still while its time goes on is
dropped too; anything else is a head that started anew. Device time is unwrapped from its 32 bits of microseconds; where it
jumps and the counter goes on, the clock was set, and time goes on with the counter. A sample after a gap covers one nominal
period, not the gap.
"""

from functools import cache, partial
from importlib.resources import files

import numpy as np
from numpy.typing import NDArray

from drivers import Counters
from drivers.can.aiding import is_aiding
from drivers.can.codec import Database, MessageCodec, decode_rows, load_database
from drivers.can.frames import EFF, ERR, FDF, RTR, FrameArray, as_bytes
from drivers.can.integrity import Protection, p05_check, protection
from drivers.can.samples import signed
from nav.cut import Cut
from nav.errors import HilError
from nav.increments import FloatArray, HeadIncrements, IntArray, Validity
from nav.kernel import inline_kernel, kernel

PROTOCOL = 1
"""Version of the message set that this driver reads."""
FAULTS = 0x03FF
"""Status bits that make a sample suspect."""
ROTOR_VALID = 0x8000
"""Status bit: the rotor angles are there."""
# What the slow frames have said, a row for each frame: sample period (us), status bits of the built-in test, rotor speeds (Hz),
# temperatures (degrees Celsius).
_PERIOD, _BIT, _SPIN, _TEMPERATURE, _SAID = 0, 1, 2, 4, 7
_BUILT_IN = ("bit_g1", "bit_g2", "bit_ax", "bit_ay", "bit_az")
"""Signals of HEAD_BIT, in the order of the status bits that say the same."""
WINDOW = 64
"""How far back a sample counts as late or duplicate rather than as a restart."""

CLASSIC = tuple(f"HEAD_C{k}" for k in range(6))
SLOW = ("HEAD_IDENTITY", "HEAD_CONFIG", "HEAD_TEMPERATURE", "HEAD_ROTOR", "HEAD_BIT")
# Columns of a sample: protocol, counter, time, status, four increments, four rotor angles, three velocity increments.
_PROTOCOL, _COUNTER, _TIME, _STATUS, _DTHETA, _ROTOR, _DVEL, _COLUMNS = 0, 1, 2, 3, 4, 8, 12, 15
_AXES = ("g1x", "g1y", "g2y", "g2z")
_FD_SIGNALS = (
    *("protocol", "sample_counter", "device_time", "status"),
    *(f"dtheta_{axis}" for axis in _AXES),
    *(f"rotor_{axis}" for axis in _AXES),
    *("dvel_x", "dvel_y", "dvel_z"),
)
_Work = tuple[NDArray[np.uint8], FloatArray, FloatArray, NDArray[np.bool_], FloatArray, IntArray, IntArray, IntArray]
"""Payloads, values in the order of the DBC and in ours, checks, what was said, stamps; rows and stamps of samples."""
_Samples = tuple[FloatArray, FloatArray, IntArray, IntArray]
_Sensed = tuple[FloatArray, FloatArray, FloatArray, IntArray, FloatArray, FloatArray]
_Parts = tuple[tuple[int, int, int, int], FloatArray, IntArray, IntArray, _Work, IntArray, IntArray, _Samples, _Sensed]
"""Identifier, length, data id and counter modulus of a sample; what was said; table and order of its signals; room; tracker and
its outcomes; samples."""
# State of the tracker.
_STARTED, _LAST_COUNTER, _SEQUENCE, _LAST_US, _TIME_US, _SEEN = range(6)
# Outcomes of the tracker.
_SAMPLES, _LOST, _DUPLICATED, _LATE, _CRC, _VERSION, _RESTARTS, _FROZEN, _CLOCK_STEPS, _OUTCOMES = range(10)


def head_database_text() -> str:
    """The DBC of the head's message set, the one truth for driver, emulator and firmware."""
    return (files("fixtures") / "can" / "dtg_head.dbc").read_text("cp1252")


@cache
def head_database() -> Database:
    """The codecs of the head's message set."""
    return load_database(head_database_text())


@kernel
def _track(
    values: FloatArray,
    good: NDArray[np.bool_],
    said: FloatArray,
    state: IntArray,
    outcome: IntArray,
    time: FloatArray,
    step: FloatArray,
    sequence: IntArray,
    validity: IntArray,
    rows: IntArray,
) -> int:
    """Judge samples by their check, version, counter and time; the accepted ones go to the front of the outputs."""
    n = 0
    for k in range(values.shape[0]):
        if not good[k]:
            outcome[_CRC] += 1
            continue
        if values[k, _PROTOCOL] != PROTOCOL:
            outcome[_VERSION] += 1
            continue
        counter, us = int(values[k, _COUNTER]), int(values[k, _TIME])
        delta = signed(counter - state[_LAST_COUNTER], 32)
        elapsed = signed(us - state[_LAST_US], 32)
        period = said[k, _PERIOD]
        if state[_STARTED] == 0:
            state[_STARTED] = 1
            state[_SEQUENCE], state[_TIME_US] = counter, us
            state[_SEEN] = -1  # one from before the first was never counted as lost
            step_us = float(period)
        elif delta == 0 and elapsed != 0:
            outcome[_FROZEN] += 1
            continue
        elif delta > 0 and (elapsed > 0 or (delta < WINDOW and period > 0)):
            if (
                delta < WINDOW
                and period > 0
                and (elapsed <= 0 or abs(elapsed - delta * period) > (1 + delta // 8) * period)
            ):
                outcome[_CLOCK_STEPS] += 1
                elapsed = int(delta * period)
            outcome[_LOST] += delta - 1
            state[_SEQUENCE] += delta
            state[_TIME_US] += elapsed
            state[_SEEN] = (state[_SEEN] << delta) | 1 if delta < WINDOW else 1
            step_us = float(elapsed) if delta == 1 else float(period) if period > 0 else elapsed / delta
        elif -WINDOW < delta <= 0 and elapsed <= 0:
            if (state[_SEEN] >> -delta) & 1:
                outcome[_DUPLICATED] += 1
            else:
                state[_SEEN] |= 1 << -delta
                outcome[_LATE] += 1
                outcome[_LOST] -= 1
            continue
        else:
            outcome[_RESTARTS] += 1
            state[_SEQUENCE] += 2  # any jump: the navigator sees that time does not go on
            state[_TIME_US] = us
            state[_SEEN] = -1
            step_us = float(period)
        state[_LAST_COUNTER], state[_LAST_US] = counter, us
        if step_us <= 0.0:  # the first sample of a head that has not said its period: it only sets the clock
            continue
        time[n], step[n] = state[_TIME_US] * 1e-6, step_us * 1e-6
        sequence[n] = state[_SEQUENCE]
        validity[n] = Validity.SENSOR.value if int(values[k, _STATUS]) & FAULTS else 0
        rows[n] = k
        n += 1
    outcome[_SAMPLES] += n
    return n


@inline_kernel
def _is_same(one: NDArray[np.uint8], other: NDArray[np.uint8]) -> bool:
    same = True
    for i in range(8):
        same = same and one[i] == other[i]
    return same


@kernel
def _fill(
    count: int,
    rows: IntArray,
    values: FloatArray,
    said: FloatArray,
    times: IntArray,
    dtheta: FloatArray,
    rotor: FloatArray,
    dvel: FloatArray,
    validity: IntArray,
    status: IntArray,
    spin: FloatArray,
    temperature: FloatArray,
    arrivals: IntArray,
) -> None:
    """What the accepted samples hold, and what the slow frames had said when they came."""
    for n in range(count):
        k = rows[n]
        there = (int(values[k, _STATUS]) & ROTOR_VALID) != 0
        for i in range(4):
            dtheta[n, i] = values[k, _DTHETA + i]
            rotor[n, i] = values[k, _ROTOR + i] if there else np.nan
        for i in range(3):
            dvel[n, i] = values[k, _DVEL + i]
            temperature[n, i] = said[k, _TEMPERATURE + i]
        spin[n, 0], spin[n, 1] = said[k, _SPIN], said[k, _SPIN + 1]
        status[n] = int(values[k, _STATUS]) | int(said[k, _BIT])
        if said[k, _BIT] != 0.0:
            validity[n] |= Validity.SENSOR.value
        arrivals[n] = times[k]


@inline_kernel
def _are_samples(
    frames: NDArray[np.uint8], can_id: int, now: FloatArray, data: NDArray[np.uint8], said: FloatArray, stamps: IntArray
) -> bool:
    """Whether all `frames` (n, 80) are FD samples; then their payloads, stamps and what was said are taken over."""
    for k in range(frames.shape[0]):
        found = frames[k, 8] | frames[k, 9] << 8 | frames[k, 10] << 16 | frames[k, 11] << 24
        if found != can_id or frames[k, 12] != 64 or frames[k, 13] & FDF == 0:
            return False
        for i in range(64):
            data[k, i] = frames[k, 16 + i]
        for i in range(_SAID):
            said[k, i] = now[i]
        stamp = np.int64(0)
        for i in range(8):
            stamp |= np.int64(frames[k, i]) << (8 * i)
        stamps[k] = stamp
    return True


@kernel
def _reorder(raw: FloatArray, columns: IntArray, values: FloatArray) -> None:
    for k in range(raw.shape[0]):
        for i in range(columns.shape[0]):
            values[k, i] = raw[k, columns[i]]


@kernel
def take(parts: _Parts, frames: NDArray[np.uint8]) -> int:
    """The accepted samples of frames (n, 80) that are all FD samples; -1, and nothing has changed, when they are not.

    `parts`: those of the `DtgHead`.
    """
    what, now, table, columns, work, state, outcome, samples, sensed = parts
    n = frames.shape[0]
    data, raw, values, good, said, stamps, rows, times = work
    can_id, length, data_id, modulus = what
    if not _are_samples(frames, can_id, now, data, said, stamps):
        return -1
    p05_check(data[:n], length, data_id, modulus, good[:n])
    decode_rows(data[:n], table, length, raw[:n])
    _reorder(raw[:n], columns, values)
    time, step, sequence, validity = samples
    count = _track(values[:n], good, said, state, outcome, time, step, sequence, validity, rows)
    dtheta, rotor, dvel, status, spin, temperature = sensed
    _fill(count, rows, values, said, stamps, dtheta, rotor, dvel, validity, status, spin, temperature, times)
    return count


@kernel
def _join(
    kind: IntArray,
    data: NDArray[np.uint8],
    partial: NDArray[np.uint8],
    state: IntArray,
    joined: NDArray[np.uint8],
    last: IntArray,
) -> tuple[int, int]:
    """Collect the six classic frames of a sample; returns (complete samples, duplicate frames).

    A head sends them in rising order. One that comes behind a later one begins another sample with the same four bits of
    counter: what is open lacks it, and would be completed with what is not its own.
    """
    n = duplicates = 0
    for k in range(kind.shape[0]):
        if kind[k] < 0:
            continue
        number = data[k, 1] & 0x0F
        bit = 1 << kind[k]
        is_held = state[1] & bit or (
            state[0] < 0 and kind[k] == state[2]
        )  # also the one that completed the last sample
        if is_held and (number == state[0] or state[0] < 0) and _is_same(partial[kind[k]], data[k]):
            duplicates += 1
            continue
        if number != state[0] or state[1] >= bit:
            state[0], state[1] = number, 0
        state[1] |= bit
        for i in range(8):
            partial[kind[k], i] = data[k, i]
        if state[1] == 0x3F:
            for j in range(6):
                for i in range(8):
                    joined[n, j, i] = partial[j, i]
            last[n] = k
            n += 1
            state[0], state[1], state[2] = -1, 0, kind[k]
    return n, duplicates


class DtgHead:
    """See the module; satisfies `drivers.FrameDriver`."""

    def __init__(self) -> None:
        database = head_database()
        self._sample = database["HEAD_SAMPLE"]
        self._classic = [database[name] for name in CLASSIC]
        self._slow = {database[name].can_id: database[name] for name in SLOW}
        self._protection: dict[str, Protection] = {}
        for name in ("HEAD_SAMPLE", *CLASSIC, *SLOW):
            declared = protection(database[name])
            if declared is None:
                raise HilError(f"dtg_head.dbc: message {name} has no E2EProfile")
            self._protection[name] = declared
        sample = self._protection["HEAD_SAMPLE"]
        self._what = self._sample.can_id, sample.length, sample.data_id, sample.counter_modulus
        self._columns = np.array([self._sample.columns[name] for name in _FD_SIGNALS])
        self._kinds = {codec.can_id: k for k, codec in enumerate(self._classic)}
        self.counters = Counters()
        self.period_s: float | None = None
        self.world_id = 0
        self._identity: dict[str, object] = {}
        self._now = np.array([0.0, 0.0, *[np.nan] * 5])
        """What the slow frames have said so far."""
        self._state = np.zeros(6, np.int64)
        self._outcome = np.zeros(_OUTCOMES, np.int64)
        self._partial = np.zeros((6, 8), np.uint8)
        self._partial_state = np.array([-1, 0, -1], np.int64)
        self._arrivals: IntArray = np.zeros(0, np.int64)
        self._room(1024)

    def _room(self, n: int) -> None:
        self._batch = HeadIncrements.empty(n)
        self._data = np.zeros((n, 64), np.uint8)
        self._raw = np.zeros((n, len(self._sample.signals)))
        self._values = np.zeros((n, _COLUMNS))
        self._good = np.zeros(n, np.bool_)
        self._rows, self._times = np.zeros(n, np.int64), np.zeros(n, np.int64)
        self._views = Cut(partial(self._batch.rows, 0))
        self._said, stamps = np.zeros((n, _SAID)), np.zeros(n, np.int64)
        received = self._data, self._raw, self._values, self._good, self._said, stamps
        self._work = *received, self._rows, self._times
        batch = self._batch
        self._samples = batch.time, batch.step, batch.sequence, batch.validity
        self._sensed = batch.dtheta, batch.rotor, batch.dvel, batch.status, batch.spin, batch.temperature
        layout = self._what, self._now, self._sample.table, self._columns
        self.parts = *layout, self._work, self._state, self._outcome, self._samples, self._sensed
        """For kernels (`take`)."""

    def identity(self) -> dict[str, object]:
        """Serial, hardware, sample period, temperatures, rotor speeds, supply and built-in test, as last heard."""
        return dict(self._identity)

    def arrivals(self) -> IntArray:
        """Arrival (ns) of the last frame of each sample of the last `decode`."""
        return self._arrivals

    def decode(self, batch: FrameArray) -> HeadIncrements:
        """The samples that `batch` completes, in order; valid until the next call."""
        n = len(batch)
        if n > len(self._batch):
            self._room(2 * n)
        count = take(self.parts, as_bytes(batch))
        if count >= 0:
            return self.taken(n, count)
        self.counters.frames += n
        said = self._said[:n]
        ids = batch["can_id"]
        is_sample = (ids == self._sample.can_id) & (batch["length"] == 64) & ((batch["flags"] & FDF) != 0)
        said[:] = self._now
        self._others(batch, np.flatnonzero(~(is_sample | is_aiding(ids))), said)
        chosen = batch[is_sample]
        if len(chosen):
            self._data[: len(chosen)] = chosen["data"]
            n = len(chosen)
            self._protection["HEAD_SAMPLE"].check(self._data[:n], self._good[:n])
            self._sample.decode(self._data[:n], self._raw[:n])
            _reorder(self._raw[:n], self._columns, self._values)
            return self._accept(n, batch["time_ns"][is_sample], said[is_sample])
        return self._classic_samples(batch, said)

    def taken(self, n: int, count: int) -> HeadIncrements:
        """The `count` samples that `take` has found in `n` frames."""
        self.counters.frames += n
        return self._counted(count)

    def _accept(self, n: int, times: IntArray, said: FloatArray) -> HeadIncrements:
        values, (dtheta, rotor, dvel, status, spin, temperature) = self._values[:n], self._sensed
        count = _track(values, self._good[:n], said, self._state, self._outcome, *self._samples, self._rows)
        sensed = dtheta, rotor, dvel, self._batch.validity, status, spin, temperature
        _fill(count, self._rows, values, said, times, *sensed, self._times)
        return self._counted(count)

    def _counted(self, count: int) -> HeadIncrements:
        """The samples at the front of the batch, and what became of the others."""
        result = self._views[count]
        self._arrivals = self._times[:count]
        counters, outcome = self.counters, self._outcome.tolist()
        counters.samples, counters.lost, counters.late = outcome[_SAMPLES], outcome[_LOST], outcome[_LATE]
        counters.restarts, counters.frozen = outcome[_RESTARTS], outcome[_FROZEN]
        counters.clock_steps = outcome[_CLOCK_STEPS]
        if outcome[_DUPLICATED] or outcome[_CRC] or outcome[_VERSION]:
            counters.duplicated += outcome[_DUPLICATED]
            counters.crc_errors += outcome[_CRC]
            counters.version_errors += outcome[_VERSION]
            self._outcome[[_DUPLICATED, _CRC, _VERSION]] = 0
        return result

    def _others(self, batch: FrameArray, chosen: IntArray, said: FloatArray) -> None:
        """Count what is not a sample and read the slow frames; what one says holds for what follows it."""
        for k in chosen:
            row = batch[k]
            can_id, length = int(row["can_id"]), int(row["length"])
            if can_id in self._kinds and length == 8:
                continue
            codec = self._slow.get(can_id)
            if codec is not None and length == 8:
                self._read_slow(codec, row["data"][None, :8])
                said[k:] = self._now
            elif can_id & ERR or can_id & RTR or can_id & EFF or not self._is_ours(can_id):
                self.counters.foreign += 1
            else:
                self.counters.short += 1

    def _is_ours(self, can_id: int) -> bool:
        return can_id == self._sample.can_id or can_id in self._kinds or can_id in self._slow

    def _read_slow(self, codec: MessageCodec, data: NDArray[np.uint8]) -> None:
        if not self._protection[codec.name].check(np.ascontiguousarray(data), np.zeros(1, np.bool_))[0]:
            self.counters.crc_errors += 1
            return
        said = codec.unpack(data.tobytes())
        if codec.name == "HEAD_IDENTITY" and said["protocol"] != PROTOCOL:
            self.counters.version_errors += 1
            return
        if codec.name == "HEAD_CONFIG":
            self.world_id = int(said["world_id"])
            self._now[_PERIOD] = said["sample_period"]
            self.period_s = said["sample_period"] * 1e-6
        if codec.name == "HEAD_BIT":
            self._now[_BIT] = sum(1 << k for k, name in enumerate(_BUILT_IN) if said[name])
        if codec.name == "HEAD_ROTOR":
            self._now[_SPIN : _SPIN + 2] = said["rotor_speed_g1"], said["rotor_speed_g2"]
        if codec.name == "HEAD_TEMPERATURE":
            self._now[_TEMPERATURE:] = [said[f"temperature_{part}"] for part in ("g1", "g2", "acc")]
        self._identity.update({k: v for k, v in said.items() if k not in {"crc8", "e2e_counter"}})

    def _classic_samples(self, batch: FrameArray, said: FloatArray) -> HeadIncrements:
        ids, eight = batch["can_id"], batch["length"] == 8
        kind = np.full(len(batch), -1, np.int64)
        data = np.ascontiguousarray(batch["data"][:, :8])
        for can_id, k in self._kinds.items():
            chosen = np.flatnonzero((ids == can_id) & eight)
            if len(chosen):
                good = self._protection[CLASSIC[k]].check(data[chosen], np.zeros(len(chosen), np.bool_))
                self.counters.crc_errors += int(len(chosen) - good.sum())
                kind[chosen[good]] = k
        joined = np.zeros((len(batch) // 6 + 1, 6, 8), np.uint8)
        last = np.zeros(len(joined), np.int64)
        n, duplicates = _join(kind, data, self._partial, self._partial_state, joined, last)
        self.counters.duplicated += duplicates
        part = {}
        for k, codec in enumerate(self._classic):
            decoded = codec.decode(np.ascontiguousarray(joined[:n, k]), np.zeros((n, len(codec.signals))))
            part.update({name: decoded[:, column] for name, column in codec.columns.items()})
        values = self._values[:n]
        for column, name in enumerate(_FD_SIGNALS):
            if name.startswith("dvel"):
                values[:, column] = part[f"{name}_lo"] + part[f"{name}_hi"]
            else:
                values[:, column] = part.get(name, 0.0)
        self._good[:n] = True
        return self._accept(n, batch["time_ns"][last[:n]], said[last[:n]])
