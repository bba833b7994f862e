"""Driver of IMUs that speak SAE J1939: PGN 61482 (angular rates) and 61485 (accelerations) of one node to `ImuIncrements`.

The messages (`fixtures/can/j1939_imu.dbc`) have neither time nor counter. A sample is one of each that come within three quarters
of a period; the period is that of their arrival, a whole multiple of 5 ms if that fits, and time goes in such periods. The node
is the one that is chosen or the first that is heard sending rates or accelerations; frames of all others are foreign. A frame
with a value that is "not available" or an "error" is counted (`identity`) and not used. PGN 61481 (slope) is only shown.

Accelerations have their axes forward, left, up. Rates are those about forward, right, down: right wing down, nose up and
to the right are positive; with ``z-up`` the rates too are those about forward, left, up. See `docs/boards/j1939-imu.md`.
"""

from functools import cache
from importlib.resources import files

import numpy as np
from numpy.typing import NDArray

from drivers import Counters
from drivers.can.aiding import is_aiding
from drivers.can.codec import Database, MessageCodec, load_database
from drivers.can.frames import EFF, ERR, FDF, RTR, FrameArray
from drivers.can.lacking import HEARD, LACK, LACKS, made, told, wait
from drivers.can.samples import BAD, FLIP, NUMBER, PUSH, PUSH_IS, RATE, RAW, TICKS, TURN, TURN_IS, Samples
from nav.errors import HilError
from nav.increments import FloatArray, ImuIncrements, IntArray
from nav.kernel import inline_kernel, kernel

TICK_S = 1e-6
GRID_S, USUAL_S = 5e-3, 10e-3
RATES = ("roll_rate", "pitch_rate", "yaw_rate")
FORCES = ("longitudinal", "lateral", "vertical")
HIGHEST = 0xFAFF
"""Raw 16-bit values above are reserved, errors or not available; of 24-bit ones those above this and eight ones."""
DEGRADED, FAILED = 1, 2
"""Figures of merit: suspect; an error. 0 is good, 3 says nothing."""
_TURN, _PUSH, _NONE = 0, 1, 2
"""Kinds of frames; what is not available is of the kind that it would be and `_NONE`."""
NAMES = ("PGN 61482 (rates)", "PGN 61485 (accelerations)")
_HELD, _HELD_NS, _LAST_NS, _SPAN_NS = 0, 1, 2, 4  # the last two for each kind


@cache
def j1939_database() -> Database:
    """The messages that are read here."""
    return load_database((files("fixtures") / "can" / "j1939_imu.dbc").read_text("cp1252"))


def pgn_of(can_id: NDArray[np.uint32]) -> NDArray[np.uint32]:
    """Parameter group of broadcast messages (PDU 2), of 29-bit identifiers; the priority is left out."""
    return (can_id >> np.uint32(8)) & np.uint32(0x3FFFF)


@inline_kernel
def _usual(span: int, latest: int) -> int:
    """Follows the median of the distances between frames, so that neither a lost frame nor two that were held up move it far."""
    if span <= 0:
        return max(latest, 0)
    return span + span // 16 if latest > span else span - span // 16


@kernel
def _pair(
    kind: IntArray,
    value: FloatArray,
    arrival: IntArray,
    state: IntArray,
    held: FloatArray,
    lack: IntArray,
    raw: FloatArray,
    rows: IntArray,
) -> tuple[int, int]:
    """Raw samples out of frames of rates and accelerations in the order of their arrival; (samples, frames that make none)."""
    n = useless = 0
    for k in range(kind.shape[0]):
        what, now = kind[k], arrival[k]
        useless += wait(what, now, lack)
        if what >= _NONE:
            continue
        if state[_LAST_NS + what]:
            state[_SPAN_NS + what] = _usual(state[_SPAN_NS + what], now - state[_LAST_NS + what])
        state[_LAST_NS + what] = now
        span = min(state[_SPAN_NS], state[_SPAN_NS + 1])
        if state[_HELD] != 1 - what or 0 < 3 * span < 4 * (now - state[_HELD_NS]):
            state[_HELD], state[_HELD_NS] = what, now
            held[:] = value[k]
            continue
        turn, push = (value[k], held) if what == _TURN else (held, value[k])
        for i in range(3):
            raw[n, TURN + i], raw[n, PUSH + i] = turn[i], push[i]
        raw[n, BAD] = 1.0 if value[k, 3] + held[3] > 0.0 else 0.0
        raw[n, TICKS], raw[n, NUMBER] = (now // 1000) % (1 << 32), -1.0
        raw[n, TURN_IS] = raw[n, PUSH_IS] = RATE
        made(lack)
        rows[n] = k
        n += 1
        state[_HELD] = -1
    return n, useless


def node_of(option: str) -> tuple[int | None, FloatArray]:
    """Source address (None: any) and signs of the rates (3,) that follow ``@``. Another text is a `HilError`."""
    words = option.split(",") if option else []
    try:
        sources = [int(word, 0) for word in words if word != "z-up"]
    except ValueError:
        sources = [-1]
    if len(sources) > 1 or any(not 0 <= source < 254 for source in sources):
        raise HilError(f"j1939-imu@{option}: give a source address 0..253, z-up, or both as 226,z-up")
    return sources[0] if sources else None, FLIP if "z-up" in words else np.ones(3)


class J1939Imu:
    """See the module; satisfies `drivers.FrameDriver`.

    Parameters
    ----------
    option : str
        What follows ``@`` in the driver's name: the node's source address (``226``, ``0xE2``), ``z-up``, or both with a comma.

    Raises
    ------
    HilError
        The option says anything else.
    """

    world_id = 0

    def __init__(self, option: str = "") -> None:
        self._source, turn = node_of(option)
        database = j1939_database()
        self._slope = database["SSI2"]
        self._codecs = [(database["ARI"], RATES), (database["ACCS"], FORCES)]
        self._scale = np.radians(1.0) * turn, FLIP
        self.counters = Counters()
        self._samples = Samples(self.counters, TICK_S, GRID_S, USUAL_S)
        self._state, self._held, self._lack = np.array([-1, 0, 0, 0, 0, 0]), np.zeros(4), np.zeros(LACK, np.int64)
        self._unavailable = 0
        self._identity: dict[str, object] = {}
        self._arrivals: IntArray = np.zeros(0, np.int64)

    @property
    def period_s(self) -> float | None:
        """Sample period, s, once learnt."""
        return self._samples.period_s

    def identity(self) -> dict[str, object]:
        """Source address, frames that were not available or errors, pitch and roll as last heard."""
        return self._identity | {"source_address": self._source, "unavailable": self._unavailable}

    def lacking(self) -> str:
        """See `drivers.Selective`."""
        for what, name in enumerate(NAMES):
            if self._lack[LACKS] and self._lack[HEARD] >> what & 0b101 == 0b100:
                return f"{name}: every frame says that its values are not available, or errors"
        return told(self._lack, ((1 << what, name) for what, name in enumerate(NAMES)))

    def arrivals(self) -> IntArray:
        """Arrival (ns) of the last frame of each sample of the last `decode`."""
        return self._arrivals

    def decode(self, batch: FrameArray) -> ImuIncrements:
        """The samples that `batch` completes, in order; valid until the next call."""
        ids = batch["can_id"]
        plain = (ids & np.uint32(EFF | ERR | RTR)) == EFF
        group = np.where(plain, pgn_of(ids), 0)
        kind, value = np.full(len(batch), -1, np.int64), np.zeros((len(batch), 4))
        whole = (batch["length"] == 8) & ((batch["flags"] & FDF) == 0)
        is_kind = [group == pgn_of(np.array([codec.can_id], np.uint32))[0] for codec, _ in self._codecs]
        source, before = ids & np.uint32(0xFF), 0
        if self._source is None and (speaks := (is_kind[0] | is_kind[1]) & whole).any():
            before = int(speaks.argmax())
            self._source = int(source[before])
        ours = source == self._source
        ours[:before] = False
        is_slope = (group == pgn_of(np.array([self._slope.can_id], np.uint32))[0]) & ours
        known = ours & (is_kind[0] | is_kind[1]) | is_slope
        self.counters.frames += len(batch)
        self.counters.short += int((known & ~whole).sum())
        self.counters.foreign += int((~known & ~is_aiding(ids)).sum())
        for what, (codec, names) in enumerate(self._codecs):
            rows = np.flatnonzero(is_kind[what] & ours & whole)
            if len(rows):
                good, value[rows, 3], vectors = _said(codec, names, batch["data"][rows, :8])
                value[rows, :3] = self._scale[what] * vectors
                kind[rows] = np.where(good, what, what + _NONE)
                self._unavailable += int(len(rows) - good.sum())
        if (rows := np.flatnonzero(is_slope & whole)).size:
            self._show(batch["data"][rows[-1:], :8])
        return self._join(kind, value, batch["time_ns"])

    def _join(self, kind: IntArray, value: FloatArray, arrival: IntArray) -> ImuIncrements:
        used = np.flatnonzero(kind >= 0)
        raw, rows = np.empty((len(used), RAW)), np.empty(len(used), np.int64)
        n, useless = _pair(kind[used], value[used], arrival[used], self._state, self._held, self._lack, raw, rows)
        self.counters.short += useless
        imu, taken = self._samples.take(raw[:n])
        self._arrivals = arrival[used[rows[taken]]]
        return imu

    def _show(self, data: NDArray[np.uint8]) -> None:
        raw = self._slope.decode_raw(np.ascontiguousarray(data), np.empty((1, len(self._slope.signals)), np.int64))[0]
        said = self._slope.unpack(data.tobytes())
        for name in ("pitch", "roll"):
            good = raw[self._slope.columns[name]] <= HIGHEST << 8 | 0xFF and said[f"{name}_merit"] != FAILED
            self._identity[f"{name}_deg"] = said[name] if good else None


def _said(
    codec: MessageCodec, names: tuple[str, ...], data: NDArray[np.uint8]
) -> tuple[NDArray[np.bool_], NDArray[np.bool_], FloatArray]:
    """Whether each frame may be used, whether it is suspect, and its vector (n, 3) in the units of the DBC."""
    data = np.ascontiguousarray(data)
    raw = codec.decode_raw(data, np.empty((len(data), len(codec.signals)), np.int64))
    values = codec.decode(data, np.empty((len(data), len(codec.signals))))
    merit = raw[:, [codec.columns[f"{name}_merit"] for name in names]]
    columns = [codec.columns[name] for name in names]
    good = (raw[:, columns] <= HIGHEST).all(axis=1) & (merit != FAILED).all(axis=1)
    return good, (merit == DEGRADED).any(axis=1), values[:, columns]
