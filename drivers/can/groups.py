"""Boards that send a sample as several classic frames behind one that opens it: which frames belong together.

A sample is the frame that opens it and one frame of each kind that the board was seen sending in the two samples before; it
is complete with the last of these, and the first sample of all when the next one opens. A frame of the next sample whose
opening frame was lost is told by its arrival, more than one period after the opening one before it, or by a kind that
comes again with other content. What stays incomplete is dropped, and missing by time or counter; what never makes a sample
is counted as short, and the user is told (:mod:`drivers.can.lacking`).
"""

from collections.abc import Collection, Mapping

import numpy as np
from numpy.typing import NDArray

from drivers import Counters
from drivers.can.aiding import is_aiding
from drivers.can.codec import MessageCodec
from drivers.can.frames import FDF, FrameArray
from drivers.can.lacking import LACK, again, made, told, wait
from drivers.can.samples import (
    BAD,
    NUMBER,
    PUSH,
    PUSH_IS,
    RATE,
    RAW,
    TICKS,
    TURN,
    TURN_IS,
    Samples,
    signed,
)
from nav.increments import FloatArray, ImuIncrements, IntArray
from nav.kernel import inline_kernel, kernel

TURN_RATE, TURN_DELTA, PUSH_RATE, PUSH_DELTA, COUNTER, OPENING, STATUS, OTHER = range(8)
"""Kinds of frames: rates and increments of turn and velocity, counter, what opens a sample (ticks, whether it is bad), what says
whether samples from here on are bad, and what is not of a sample."""
_KINDS = 5
BACK = 3
"""Times that the clock may go back before there is a sample."""
_OPEN, _SENT, _HAVE, _BEFORE, _DUE, _TICKS, _BAD, _OPENED_NS, _SPAN_NS = range(9)


@inline_kernel
def _shortest(span: int, latest: int) -> int:
    """The shortest of the latest distances between samples, so that a lost one does not lengthen it; 0 while unknown."""
    if span <= 0 or latest <= 0:
        return max(latest, 0)
    return min(latest, span + span // 256)


@inline_kernel
def _is_whole(have: int) -> bool:
    return have & 0b0011 != 0 and have & 0b1100 != 0


@inline_kernel
def _put(state: IntArray, held: FloatArray, turn_delta: bool, delta_is: int, row: FloatArray) -> None:
    """The group as a raw sample: velocity by its increments where there are any, the turn as the board prefers."""
    have = state[_HAVE]
    by_delta = have & 0b0010 != 0 and (turn_delta or have & 0b0001 == 0)
    turn = TURN_DELTA if by_delta else TURN_RATE
    push = PUSH_DELTA if have & 0b1000 else PUSH_RATE
    row[TICKS], row[BAD] = state[_TICKS], state[_BAD]
    row[NUMBER] = held[COUNTER, 0] if have >> COUNTER & 1 else -1.0
    for i in range(3):
        row[TURN + i], row[PUSH + i] = held[turn, i], held[push, i]
    row[TURN_IS] = delta_is if turn == TURN_DELTA else RATE
    row[PUSH_IS] = delta_is if push == PUSH_DELTA else RATE


@kernel
def _join(
    kind: IntArray,
    value: FloatArray,
    arrival: IntArray,
    tick_ns: int,
    turn_delta: bool,
    delta_is: int,
    state: IntArray,
    held: FloatArray,
    lack: IntArray,
    raw: FloatArray,
    rows: IntArray,
) -> tuple[int, int, int]:
    """Raw samples out of frames in the order of their arrival; (samples, frames that came twice, frames that make no sample)."""
    n = duplicated = useless = 0
    for k in range(kind.shape[0]):
        what = kind[k]
        if what < 0 or what == OTHER:
            continue
        if what == STATUS:
            state[_BAD] = int(value[k, 0])
            continue
        useless += wait(what, arrival[k], lack)
        if what == OPENING:
            ticks = int(value[k, 0])
            if state[_OPEN]:
                elapsed = signed(ticks - state[_TICKS], 32)
                if elapsed == 0:
                    duplicated += 1
                    useless -= again(lack)
                    continue
                if state[_DUE] == 0 and state[_SENT] == 0 and _is_whole(state[_HAVE]):
                    _put(state, held, turn_delta, delta_is, raw[n])
                    made(lack)
                    rows[n] = k
                    n += 1
                state[_DUE], state[_BEFORE] = state[_HAVE] | state[_BEFORE], state[_HAVE]
                state[_SPAN_NS] = _shortest(state[_SPAN_NS], elapsed * tick_ns)
            state[_OPEN], state[_SENT], state[_HAVE] = 1, 0, 0
            state[_TICKS], state[_OPENED_NS] = ticks, arrival[k]
            if value[k, 1] >= 0.0:
                state[_BAD] = int(value[k, 1])
            continue
        since = arrival[k] - state[_OPENED_NS]
        if state[_OPEN] == 0 or 0 < state[_SPAN_NS] < since:
            continue
        bit = 1 << what
        if state[_HAVE] & bit:
            same = True
            for i in range(3):
                same = same and held[what, i] == value[k, i]
            if same:
                duplicated += 1
                useless -= again(lack)
            else:
                state[_SENT] = 1  # of another sample: what is open can no longer be trusted
            continue
        for i in range(3):
            held[what, i] = value[k, i]
        state[_HAVE] |= bit
        due = state[_DUE]
        if due != 0 and state[_SENT] == 0 and state[_HAVE] & due == due and _is_whole(state[_HAVE]):
            _put(state, held, turn_delta, delta_is, raw[n])
            made(lack)
            rows[n] = k
            n += 1
            state[_SENT] = 1
    return n, duplicated, useless


class Groups:
    """See the module; from frames to increments.

    Parameters
    ----------
    kinds : mapping
        Kind of each message that the driver reads, by its codec; `OTHER` for one that is not of a sample.
    names : (str, str, str)
        What the user calls the messages that open a sample, that carry the turn and that carry the velocity.
    others : collection of int
        Identifiers of the board's other messages.
    tick_s : float
        One tick of the board's 32-bit clock, s.
    turn_delta : bool
        Take turns from the increments where the board sends rates as well.
    delta_is : int
        What the board sends as increments: `samples.INCREMENT`, or `samples.MEAN_RATE`.
    """

    def __init__(
        self,
        kinds: Mapping[MessageCodec, int],
        tick_s: float,
        counters: Counters,
        *,
        turn_delta: bool,
        delta_is: int,
        names: tuple[str, str, str],
        others: Collection[int] = (),
    ) -> None:
        self._kinds, self._tick_ns = dict(kinds), round(tick_s * 1e9)
        self._ids, self._others = [codec.can_id for codec in kinds], list(others)
        self._turn_delta, self._delta_is, self._counters = turn_delta, delta_is, counters
        self._samples = Samples(counters, tick_s)
        self._state, self._held, self._lack = np.zeros(9, np.int64), np.zeros((_KINDS, 3)), np.zeros(LACK, np.int64)
        self._wanted = tuple(zip((1 << OPENING, 0b0011, 0b1100), names, strict=True))
        self._restarts = 0
        self.arrivals: IntArray = np.zeros(0, np.int64)
        """Arrival (ns) of the last frame of each sample of the last `take`."""

    @property
    def period_s(self) -> float | None:
        """Sample period, s, once learnt."""
        return self._samples.period_s

    def lacking(self) -> str:
        """Why there are no samples though frames come; empty while there are."""
        if self._counters.restarts - self._restarts > BACK:
            return "the clock of the samples goes back again and again: do two boards send the same messages?"
        return told(self._lack, self._wanted)

    def sorted(self, batch: FrameArray) -> tuple[IntArray, dict[MessageCodec, tuple[IntArray, NDArray[np.uint8]]]]:
        """Kind of each frame (-1: not of the board), and rows and payloads of each message; counts what is not of the board."""
        ids, counters = batch["can_id"], self._counters
        kind = np.full(len(batch), -1, np.int64)
        found = {}
        for codec, what in self._kinds.items():
            if (is_it := ids == codec.can_id).any():
                good = is_it & (batch["length"] == codec.length) & ((batch["flags"] & FDF) == 0)
                rows = np.flatnonzero(good)
                kind[rows] = what
                found[codec] = rows, np.ascontiguousarray(batch["data"][rows, : codec.length])
        counters.frames += len(batch)
        if (strange := kind < 0).any():
            ids = ids[strange & ~is_aiding(ids)]
            short = int(np.isin(ids, self._ids).sum())
            counters.short += short
            counters.foreign += len(ids) - short - int(np.isin(ids, self._others).sum())
        return kind, found

    def take(self, kind: IntArray, value: FloatArray, arrival: IntArray) -> ImuIncrements:
        """Increments out of frames of `kind` (n,) with what they say (n, 3), body axes; views until the next call."""
        raw, rows = np.empty((len(kind), RAW)), np.empty(len(kind), np.int64)
        n, duplicated, useless = _join(
            kind,
            value,
            arrival,
            self._tick_ns,
            self._turn_delta,
            self._delta_is,
            self._state,
            self._held,
            self._lack,
            raw,
            rows,
        )
        self._counters.duplicated += duplicated
        self._counters.short += useless
        imu, taken = self._samples.take(raw[:n])
        if len(imu):
            self._restarts = self._counters.restarts
        self.arrivals = arrival[rows[taken]]
        return imu


class GroupedBoard:
    """What drivers of such boards share; with a `decode` it satisfies `drivers.FrameDriver`."""

    world_id = 0

    def __init__(self, counters: Counters, groups: Groups) -> None:
        self.counters, self._groups = counters, groups
        self._identity: dict[str, object] = {}

    @property
    def period_s(self) -> float | None:
        """Sample period, s, once learnt."""
        return self._groups.period_s

    def lacking(self) -> str:
        """See `drivers.Selective`."""
        return self._groups.lacking()

    def identity(self) -> dict[str, object]:
        """Status and temperature, as last heard."""
        return dict(self._identity)

    def arrivals(self) -> IntArray:
        """Arrival (ns) of the last frame of each sample of the last `decode`."""
        return self._groups.arrivals
