"""Measurements that aid the navigator, on CAN FD: rows of `AIDING` to frames of `fixtures/can/aiding.dbc` and back.

One frame a measurement, AUTOSAR E2E as for the head; a relay (:data:`nav.aiding.RELAYED`) and each receiver at a port of
its own (:data:`nav.aiding.AT_PORTS`) count their frames for themselves. A standard deviation of 0 on the wire is an infinite
one: the value is not there. The frames carry 32 bits of the inertial sensor's clock in us; they are unwrapped next to the
newest time of that sensor. A classic bus cannot carry them.
"""

from dataclasses import dataclass
from functools import cache
from importlib.resources import files

import numpy as np
from numpy.typing import NDArray

from drivers import Counters
from drivers.can.codec import MessageCodec, load_database
from drivers.can.frames import BRS, FDF, FrameArray, frames
from drivers.can.integrity import Protection, protection
from nav.aiding import AIDING, AT_PORTS, RELAYED, Kind
from nav.errors import HilError
from nav.increments import FloatArray, IntArray
from nav.kernel import kernel

PROTOCOL = 1
"""Version of the message set."""
FIRST_ID, RESERVED_IDS = 0x150, 16
"""The identifiers that are reserved for aiding."""
_BLOCK = 0xFFFFFFFF - (RESERVED_IDS - 1)
"""What of an identifier says that it is one of them."""
_COMMON = ("crc16", "e2e_counter", "protocol", "source", "device_time")
_TURN_US = 1 << 32

AidingArray = NDArray[np.void]
"""Rows of `AIDING`."""


@dataclass(frozen=True, slots=True)
class _Message:
    """One kind of measurement on the wire: columns of the codec in the order of a row's values and deviations."""

    kind: Kind
    codec: MessageCodec
    protection: Protection
    values: IntArray
    sigmas: IntArray


def aiding_database_text() -> str:
    """The DBC of the aiding message set."""
    return (files("fixtures") / "can" / "aiding.dbc").read_text("cp1252")


@cache
def _messages() -> dict[Kind, _Message]:
    found = {}
    for codec in load_database(aiding_database_text()).messages.values():
        declared, kind = protection(codec), Kind[codec.name.removeprefix("AID_")]
        if declared is None:
            raise HilError(f"aiding.dbc: message {codec.name} has no E2EProfile")
        names = [name for name in codec.columns if name not in _COMMON]
        values = [codec.columns[name] for name in names if not name.startswith("sigma_")]
        sigmas = [codec.columns[name] for name in names if name.startswith("sigma_")]
        found[kind] = _Message(kind, codec, declared, np.array(values), np.array(sigmas))
    return found


def is_aiding(can_ids: NDArray[np.uint32]) -> NDArray[np.bool_]:
    """Whether each identifier (with its flags) is one of those reserved for aiding."""
    found: NDArray[np.bool_] = (can_ids & np.uint32(_BLOCK)) == FIRST_ID
    return found


@kernel
def has_aiding(can_ids: NDArray[np.uint32]) -> bool:
    """Whether there is one among identifiers."""
    found = False
    for can_id in can_ids:
        found |= can_id & _BLOCK == FIRST_ID
    return found


def merge(samples: FrameArray, aiding: FrameArray, behind: IntArray, per_sample: int = 1) -> FrameArray:
    """Frames of samples with those of measurements between them.

    Parameters
    ----------
    samples : (n per_sample,) array of FRAME
        n samples.
    aiding : (m,) array of FRAME
        Measurements.
    behind : (m,) int
        The sample behind which each stands; those of other samples than 0 to n - 1 are left out.
    per_sample : int
        Frames of one sample.
    """
    chosen = (behind >= 0) & (behind < len(samples) // per_sample)
    return np.insert(samples, (behind[chosen] + 1) * per_sample, aiding[chosen])


class AidingEncoder:
    """Frames of one sender of measurements; remembers the counter of each message."""

    def __init__(self) -> None:
        self._counts = dict.fromkeys(_messages(), 0)

    def frames(self, rows: AidingArray) -> FrameArray:
        """A frame for each row of `AIDING`, in their order.

        Raises
        ------
        HilError
            A kind or source that the wire does not know, a value that is not finite or does not fit, a standard
            deviation that is not positive.
        """
        batch = frames(len(rows))
        for kind in np.unique(rows["kind"]).tolist():
            if kind not in self._counts:
                raise HilError(
                    f"aiding: kind {kind} has no message; those that have one: {', '.join(k.name for k in _messages())}"
                )
            chosen = np.flatnonzero(rows["kind"] == kind)
            batch[chosen] = self._encoded(_messages()[Kind(kind)], rows[chosen])
        return batch

    def _encoded(self, message: _Message, rows: AidingArray) -> FrameArray:
        n, codec = len(rows), message.codec
        sigma = rows["sigma"][:, : len(message.sigmas)]
        if not (sigma > 0.0).all():
            raise HilError(f"{codec.name}: a standard deviation is not positive; that of a missing value is infinite")
        values = np.zeros((n, len(codec.signals)))
        values[:, codec.columns["protocol"]] = PROTOCOL
        values[:, codec.columns["source"]] = rows["source"]
        values[:, codec.columns["device_time"]] = np.rint(rows["time"] * 1e6) % _TURN_US
        values[:, message.values] = rows["value"][:, : len(message.values)]
        limits = np.finfo(np.float32)
        values[:, message.sigmas] = np.where(sigma <= limits.max, np.maximum(sigma, limits.tiny), 0.0)
        data = codec.encode(values, np.zeros((n, 64), np.uint8))
        first = self._counts[message.kind]
        message.protection.protect(data, np.arange(first, first + n))
        self._counts[message.kind] = first + n
        batch = frames(n)
        batch["can_id"], batch["length"], batch["flags"], batch["data"] = codec.can_id, codec.length, FDF | BRS, data
        return batch


class AidingDecoder:
    """Rows of `AIDING` from frames. What is dropped is counted; other frames are passed over."""

    def __init__(self) -> None:
        self._by_id = {message.codec.can_id: message for message in _messages().values()}
        self._last: dict[tuple[Kind, int], int] = {}
        self.counters = Counters()
        """As for a board: `samples` are measurements, `restarts` counters that went back, `foreign` unused reserved ids."""
        self.heard = dict.fromkeys(_messages(), 0)
        """Good measurements of each kind."""

    def decode(self, batch: FrameArray, now: float | None) -> tuple[AidingArray, IntArray]:
        """The measurements in `batch`, in its order, and the place of each in `batch`.

        Parameters
        ----------
        batch : (n,) array of FRAME
            Frames of any kind.
        now : float or None
            Newest device time of the inertial sensor, s; the times of the rows are the ones nearest to it. None: no sample yet;
            the clock is taken to be in its first turn.
        """
        ids, eligible = batch["can_id"], is_aiding(batch["can_id"])
        rows = np.zeros(len(batch), AIDING)
        kept = np.zeros(len(batch), np.bool_)
        self.counters.frames += int(eligible.sum())
        for can_id in np.unique(ids[eligible]).tolist():
            chosen = np.flatnonzero(ids == can_id)
            message = self._by_id.get(can_id)
            if message is None:
                self.counters.foreign += len(chosen)
                continue
            whole = (batch["length"][chosen] == message.codec.length) & ((batch["flags"][chosen] & FDF) != 0)
            self.counters.short += int((~whole).sum())
            chosen = chosen[whole]
            data = np.ascontiguousarray(batch["data"][chosen])
            good = self._accepted(message, data)
            chosen = chosen[good]
            rows[chosen] = _decoded(message, data[good], now)
            kept[chosen] = True
            self.heard[message.kind] += len(chosen)
            self.counters.samples += len(chosen)
        return rows[kept], np.flatnonzero(kept)

    def _accepted(self, message: _Message, data: NDArray[np.uint8]) -> NDArray[np.bool_]:
        """Which payloads pass the check, are of our version and no repetition of the one before."""
        good = message.protection.check(data, np.zeros(len(data), np.bool_))
        self.counters.crc_errors += int((~good).sum())
        ours = data[:, 3] == PROTOCOL
        self.counters.version_errors += int((good & ~ours).sum())
        good &= ours
        source = data[:, 4]
        senders = np.where(source >= AT_PORTS, source, np.where(source >= RELAYED, RELAYED, 0))
        for sender in np.unique(senders[good]).tolist():
            chosen = np.flatnonzero(good & (senders == sender))
            good[chosen] = self._counted((message.kind, sender), data[chosen, 2].astype(np.int64))
        return good

    def _counted(self, key: tuple[Kind, int], numbers: IntArray) -> NDArray[np.bool_]:
        """Which of the counters of one sender are new."""
        steps = np.diff(numbers, prepend=self._last.get(key, numbers[0] - 1)) % 256
        self._last[key] = int(numbers[-1])
        on = (steps > 0) & (steps < 128)
        self.counters.lost += int((steps[on] - 1).sum())
        self.counters.restarts += int((steps >= 128).sum())
        self.counters.duplicated += int((steps == 0).sum())
        new: NDArray[np.bool_] = steps > 0
        return new


def _decoded(message: _Message, data: NDArray[np.uint8], now: float | None) -> AidingArray:
    codec = message.codec
    values: FloatArray = codec.decode(data, np.empty((len(data), len(codec.signals))))
    rows = np.zeros(len(data), AIDING)
    us = values[:, codec.columns["device_time"]].astype(np.int64)
    if now is not None:
        us += (round(now * 1e6) - us + _TURN_US // 2) // _TURN_US * _TURN_US
    rows["time"], rows["kind"] = us * 1e-6, message.kind
    rows["source"] = values[:, codec.columns["source"]]
    rows["value"][:, : len(message.values)] = values[:, message.values]
    sigma = values[:, message.sigmas]
    rows["sigma"] = np.inf
    rows["sigma"][:, : len(message.sigmas)] = np.where(sigma > 0.0, sigma, np.inf)
    return rows
