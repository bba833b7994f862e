"""Payload bytes to physical values and back, compiled at start-up from a DBC file.

cantools reads the file; from then on each message is two small tables that compiled kernels walk, a batch of frames at
a time, with the same arithmetic as cantools in doubles: ``raw * scale + offset``. A payload is a row of uint8, as in
:data:`drivers.can.frames.FRAME`, and at least as wide as the message; a signal is a column, by increasing start bit
(multiplexed ones before all others). Whether a received frame is long enough is for the receiver to check before it decodes.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, NoReturn

import cantools
import numpy as np
from numpy.typing import NDArray

from drivers.can.frames import EFF
from nav.errors import HilError
from nav.kernel import inline_kernel, kernel

Payloads = NDArray[np.uint8]
Doubles = NDArray[np.float64]
Integers = NDArray[np.int64]

_FIRST, _STEP, _BYTES, _SHIFT, _LENGTH, _KIND, _SELECTOR, _SELECTED = range(8)  # columns of a table: integers
_SCALE, _OFFSET, _LOW, _HIGH = range(8, 12)  # and the bits of doubles; a raw integer lies in [low, high)
_UNSIGNED, _SIGNED, _FLOAT32, _FLOAT64 = range(4)

_DONE, _MISFIT = -1, -2  # what a kernel returns; else row * signals + signal of the first value that does not fit


@dataclass(frozen=True)
class Signal:
    """One signal of a message, as the DBC states it.

    `start` is the DBC start bit: the least significant bit of a little-endian signal, the most significant bit (in
    sawtooth numbering) of a big-endian one. A multiplexed signal is present when the raw value of the signal
    `selector` is `selected`.
    """

    name: str
    start: int
    length: int
    big_endian: bool = False
    signed: bool = False
    is_float: bool = False
    scale: float = 1.0
    offset: float = 0.0
    unit: str = ""
    comment: str = ""
    choices: Mapping[int, str] | None = None
    selector: str | None = None
    selected: int = 0

    @property
    def is_plain_integer(self) -> bool:
        """Whether the physical value is the raw integer."""
        return not self.is_float and self.scale == 1.0 and self.offset == 0.0


@dataclass(frozen=True, eq=False)
class MessageCodec:
    """One message: its declaration, and the compiled conversions of its payload.

    `can_id` has the flag EFF of :mod:`drivers.can.frames` when the identifier has 29 bits; `length` is in bytes;
    `attributes` are those of the DBC (``BA_``) by name, an enumeration by its text, defaults included.

    The converting methods fill and return the array they are given. `data` is (n, at least `length`) uint8, values are
    (n, number of signals). They allocate nothing.
    """

    name: str
    can_id: int
    length: int
    is_fd: bool
    signals: tuple[Signal, ...]
    attributes: Mapping[str, int | float | str]
    comment: str = ""

    @cached_property
    def columns(self) -> dict[str, int]:
        """Column of each signal, by name."""
        return {signal.name: j for j, signal in enumerate(self.signals)}

    @cached_property
    def table(self) -> Integers:
        """A row a signal, in one array of two kinds: a call with one argument less is faster."""
        table = np.zeros((len(self.signals), 12), np.int64)
        for row, signal in zip(table, self.signals, strict=True):
            row[:8] = _layout(signal, self.columns)
            row[8:].view(np.float64)[:] = signal.scale, signal.offset, *_raw_range(signal)
        return table

    def decode(self, data: Payloads, out: Doubles) -> Doubles:
        """Physical values in the units of the DBC; a multiplexed signal that is absent is NaN."""
        if decode_rows(data, self.table, self.length, out) != _DONE:
            self._refuse(data, out)
        return out

    def decode_raw(self, data: Payloads, out: Integers) -> Integers:
        """Raw integers: unsigned 64-bit ones as their two's complement, floats as their bits, absent ones 0."""
        if _decode_raw(data, self.table, self.length, out) != _DONE:
            self._refuse(data, out)
        return out

    def encode(self, values: Doubles, out: Payloads) -> Payloads:
        """Write physical values, rounded to the nearest raw value (ties to even), into the first `length` bytes.

        Raises
        ------
        HilError
            A value is not finite, or does not fit the bits of its signal. (The DBC's minimum and maximum are not
            looked at: many files state them wrongly.) The rows before it are written by then.
        """
        failure = _encode(values, self.table, self.length, out)
        if failure != _DONE:
            self._refuse(out, values, failure)
        return out

    def encode_raw(self, values: Integers, out: Payloads) -> Payloads:
        """Write raw integers, as `decode_raw` gives them, into the first `length` bytes; errors as in `encode`."""
        failure = _encode_raw(values, self.table, self.length, out)
        if failure != _DONE:
            self._refuse(out, values, failure)
        return out

    def _refuse(self, data: Payloads, values: NDArray[Any], failure: int = _MISFIT) -> NoReturn:
        if failure == _MISFIT:
            raise HilError(
                f"{self.name}: payloads of shape {data.shape} and values of shape {values.shape} do not fit: "
                f"{self.length} bytes and {len(self.signals)} signals a row are expected"
            )
        row, column = divmod(failure, len(self.signals))
        signal = self.signals[column]
        kind = "float" if signal.is_float else "signed" if signal.signed else "unsigned"
        raise HilError(
            f"{self.name}.{signal.name}: {values[row, column]} of row {row} does not fit {signal.length} {kind} bits "
            f"of scale {signal.scale} and offset {signal.offset} {signal.unit}".rstrip()
        )

    def unpack(self, payload: bytes) -> dict[str, float]:
        """Values of one payload by name, for tools: ints where the value is the raw integer, absent signals left out."""
        if len(payload) < self.length:
            raise HilError(f"{self.name}: {len(payload)} bytes where {self.length} are expected")
        data = np.frombuffer(bytearray(payload), np.uint8)[None, :]
        physical = self.decode(data, np.empty((1, len(self.signals))))[0].tolist()
        raw = self.decode_raw(data, np.empty((1, len(self.signals)), np.int64))[0].tolist()
        values: dict[str, float] = {}
        for signal, value, integer in zip(self.signals, physical, raw, strict=True):
            if signal.selector is not None and raw[self.columns[signal.selector]] != signal.selected:
                continue
            exact = integer if signal.signed else integer % 2**signal.length
            values[signal.name] = exact if signal.is_plain_integer else value
        return values

    def pack(self, values: Mapping[str, float]) -> bytes:
        """One payload from values by name, for tools; a signal that is not named has the raw value 0.

        Raises
        ------
        HilError
            A name is unknown, or a value cannot be encoded.
        """
        if unknown := values.keys() - self.columns.keys():
            raise HilError(f"{self.name} has no signal {', '.join(sorted(unknown))}; it has {', '.join(self.columns)}")
        row = np.array([[values.get(s.name, s.offset) for s in self.signals]], np.float64).reshape(1, -1)
        return self.encode(row, np.zeros((1, self.length), np.uint8)).tobytes()


@dataclass(frozen=True, eq=False)
class Database:
    """The messages of one DBC file. `refused` says, by name, why some have no codec."""

    messages: Mapping[str, MessageCodec]
    refused: Mapping[str, str]

    @cached_property
    def by_id(self) -> dict[int, MessageCodec]:
        """Codec of each identifier (29-bit ones with the flag EFF)."""
        return {codec.can_id: codec for codec in self.messages.values()}

    def __getitem__(self, name: str) -> MessageCodec:
        """Codec of the message `name`; HilError when there is none."""
        if name in self.messages:
            return self.messages[name]
        if name in self.refused:
            raise HilError(f"message {name} cannot be decoded: {self.refused[name]}")
        raise HilError(f"the DBC has no message {name}; it has {', '.join(self.messages)}")


def load_database(source: Path | str) -> Database:
    """Read a DBC file, or its text (a string of several lines), and compile a codec for each of its messages.

    Raises
    ------
    HilError
        The file cannot be read, is not a DBC file, or contradicts itself (signals that overlap or do not fit).
    """
    is_text = isinstance(source, str) and "\n" in source
    origin = "the DBC text" if is_text else str(source)
    try:
        text = str(source) if is_text else Path(source).read_text("cp1252", "replace")
        database: Any = cantools.database.load_string(text, "dbc")
    except (OSError, ValueError, KeyError, cantools.Error) as error:
        raise HilError(f"{origin} cannot be read as a DBC file: {error}") from error
    messages, refused = {}, {}
    for message in database.messages:
        reason = _why_refused(message)
        if reason:
            refused[message.name] = reason
        else:
            messages[message.name] = _codec(message, database.dbc.attribute_definitions)
    return Database(messages, refused)


def _why_refused(message: Any) -> str:
    """What this module does not cover, or nothing."""
    if message.length > 64:
        return f"its {message.length} bytes do not fit one CAN frame"
    by_name = {signal.name: signal for signal in message.signals}
    for signal in message.signals:
        if signal.length not in ((32, 64) if signal.is_float else range(1, 65)):
            return f"signal {signal.name} has {signal.length} bits"
        if signal.scale == 0:
            return f"signal {signal.name} has scale 0"
        if signal.multiplexer_ids:
            selector = by_name[signal.multiplexer_signal]
            if len(signal.multiplexer_ids) > 1 or selector.multiplexer_ids or selector.is_float:
                return f"signal {signal.name} is multiplexed in more than one level or by several values"
    return ""


def _codec(message: Any, definitions: Mapping[str, Any]) -> MessageCodec:
    attributes = {n: d.default_value for n, d in definitions.items() if d.kind == "BO_" and d.default_value is not None}
    for name, attribute in message.dbc.attributes.items():
        choices = attribute.definition.choices
        is_index = choices and isinstance(attribute.value, int) and attribute.value < len(choices)
        attributes[name] = choices[attribute.value] if is_index else attribute.value
    return MessageCodec(
        name=message.name,
        can_id=message.frame_id | (EFF if message.is_extended_frame else 0),
        length=message.length,
        is_fd=message.is_fd,
        signals=tuple(sorted(map(_signal, message.signals), key=lambda s: s.selector is None)),
        attributes=attributes,
        comment=message.comment or "",
    )


def _signal(signal: Any) -> Signal:
    return Signal(
        name=signal.name,
        start=signal.start,
        length=signal.length,
        big_endian=signal.byte_order == "big_endian",
        signed=signal.is_signed,
        is_float=signal.is_float,
        scale=float(signal.scale),
        offset=float(signal.offset),
        unit=signal.unit or "",
        comment=signal.comment or "",
        choices={k: str(v) for k, v in signal.choices.items()} if signal.choices else None,
        selector=signal.multiplexer_signal if signal.multiplexer_ids else None,
        selected=signal.multiplexer_ids[0] if signal.multiplexer_ids else 0,
    )


def _layout(signal: Signal, columns: Mapping[str, int]) -> tuple[int, ...]:
    """Byte of the least significant bit, way to the next byte, bytes touched, bit in the first byte, and the rest."""
    if signal.big_endian:
        msb = 8 * (signal.start // 8) + 7 - signal.start % 8  # counted from the first bit on the wire
        first, bit = divmod(msb + signal.length - 1, 8)
        step, shift = -1, 7 - bit
    else:
        step = 1
        first, shift = divmod(signal.start, 8)
    if signal.is_float:
        kind = _FLOAT32 if signal.length == 32 else _FLOAT64
    else:
        kind = _SIGNED if signal.signed else _UNSIGNED
    selector = -1 if signal.selector is None else columns[signal.selector]
    return first, step, (shift + signal.length + 7) // 8, shift, signal.length, kind, selector, signal.selected


def _raw_range(signal: Signal) -> tuple[float, float]:
    if signal.signed and not signal.is_float:
        return -(2.0 ** (signal.length - 1)), 2.0 ** (signal.length - 1)
    return 0.0, 2.0**signal.length


@inline_kernel
def _misfit(data: Payloads, table: Integers, length: int, values: NDArray[Any]) -> bool:
    return bool(data.shape[1] < length or values.shape[0] != data.shape[0] or values.shape[1] != table.shape[0])


@inline_kernel
def _extract(data: Payloads, table: Integers, raw: Integers) -> None:
    """Bits of every signal, extended by the sign of signed ones."""
    for i in range(raw.shape[0]):
        for j in range(raw.shape[1]):
            first, step, count = table[j, _FIRST], table[j, _STEP], table[j, _BYTES]
            shift = np.uint64(table[j, _SHIFT])
            if count == 4 and step == 1:  # the usual ones, unrolled: a loop costs as much as the rest of the decoding
                at = np.uint64(first)  # what is unsigned is not asked whether it counts from the end
                bits = np.uint64(data[i, at]) | np.uint64(data[i, at + np.uint64(1)]) << np.uint64(8)
                bits |= np.uint64(data[i, at + np.uint64(2)]) << np.uint64(16)
                bits |= np.uint64(data[i, at + np.uint64(3)]) << np.uint64(24)
            else:
                bits = np.uint64(0)
                for k in range(min(count, 8) - 1, -1, -1):
                    bits = (bits << np.uint64(8)) | np.uint64(data[i, first + step * k])
            bits >>= shift
            if count == 9:
                bits |= np.uint64(data[i, first + 8 * step]) << (np.uint64(64) - shift)
            unused = np.uint64(64 - table[j, _LENGTH])
            bits <<= unused
            raw[i, j] = np.int64(bits) >> np.int64(unused) if table[j, _KIND] == _SIGNED else np.int64(bits >> unused)


@inline_kernel
def _put(out: Payloads, i: int, table: Integers, j: int, bits: np.uint64) -> None:
    """Write the low bits of `bits` into signal `j` of row `i`, which is zero there."""
    first, step, count = table[j, _FIRST], table[j, _STEP], table[j, _BYTES]
    shift = np.uint64(table[j, _SHIFT])
    unused = np.uint64(64 - table[j, _LENGTH])
    bits = (bits << unused) >> unused
    low = bits << shift
    for k in range(min(count, 8)):
        out[i, first + step * k] |= np.uint8((low >> np.uint64(8 * k)) & np.uint64(255))
    if count == 9:
        out[i, first + 8 * step] |= np.uint8(bits >> (np.uint64(64) - shift))


@kernel
def decode_rows(data: Payloads, table: Integers, length: int, out: Doubles) -> int:
    """`MessageCodec.decode` of a message's `table` and `length`, for kernels; 0 when all fits."""
    if _misfit(data, table, length, out):
        return _MISFIT
    scaling = table.view(np.float64)
    raw = out.view(np.int64)  # converted in place; a selector stands behind the signals it selects
    _extract(data, table, raw)
    for i in range(out.shape[0]):
        for j in range(out.shape[1]):
            selector, kind, bits = table[j, _SELECTOR], table[j, _KIND], raw[i, j]
            if selector >= 0 and raw[i, selector] != table[j, _SELECTED]:
                out[i, j] = math.nan
                continue
            if kind == _UNSIGNED:
                value = np.float64(np.uint64(bits))
            elif kind == _SIGNED:
                value = np.float64(bits)
            elif kind == _FLOAT32:
                value = np.float64(np.uint32(bits).view(np.float32))
            else:
                value = np.int64(bits).view(np.float64)
            scale, offset = scaling[j, _SCALE], scaling[j, _OFFSET]
            out[i, j] = value if scale == 1.0 and offset == 0.0 else value * scale + offset  # -0.0 + 0.0 is not -0.0
    return _DONE


@kernel
def _decode_raw(data: Payloads, table: Integers, length: int, out: Integers) -> int:
    if _misfit(data, table, length, out):
        return _MISFIT
    _extract(data, table, out)
    for i in range(out.shape[0]):
        for j in range(out.shape[1]):
            selector = table[j, _SELECTOR]
            if selector >= 0 and out[i, selector] != table[j, _SELECTED]:
                out[i, j] = 0
    return _DONE


@kernel
def _encode(values: Doubles, table: Integers, length: int, out: Payloads) -> int:
    if _misfit(out, table, length, values):
        return _MISFIT
    scaling = table.view(np.float64)
    n = values.shape[1]
    for i in range(values.shape[0]):
        out[i, :length] = 0
        for j in range(n):
            selector = table[j, _SELECTOR]
            if selector >= 0:
                chosen = np.rint((values[i, selector] - scaling[selector, _OFFSET]) / scaling[selector, _SCALE])
                if chosen != table[j, _SELECTED]:
                    continue
            raw = (values[i, j] - scaling[j, _OFFSET]) / scaling[j, _SCALE]
            kind = table[j, _KIND]
            if kind == _FLOAT32:
                single = np.float32(raw)
                bits = np.uint64(np.float32(raw).view(np.uint32))
                good = math.isfinite(single)
            elif kind == _FLOAT64:
                bits = np.float64(raw).view(np.uint64)
                good = math.isfinite(raw)
            else:
                raw = np.rint(raw)
                good = scaling[j, _LOW] <= raw < scaling[j, _HIGH]
                bits = np.uint64(np.int64(raw)) if raw < 0.0 else np.uint64(raw)
            if not good:
                return int(i * n + j)
            _put(out, i, table, j, bits)
    return _DONE


@kernel
def _encode_raw(values: Integers, table: Integers, length: int, out: Payloads) -> int:
    if _misfit(out, table, length, values):
        return _MISFIT
    scaling = table.view(np.float64)
    n = values.shape[1]
    for i in range(values.shape[0]):
        out[i, :length] = 0
        for j in range(n):
            selector = table[j, _SELECTOR]
            if selector >= 0 and values[i, selector] != table[j, _SELECTED]:
                continue
            raw = values[i, j]
            if table[j, _LENGTH] < 64 and not (scaling[j, _LOW] <= raw < scaling[j, _HIGH]):
                return int(i * n + j)
            _put(out, i, table, j, np.uint64(raw))
    return _DONE
