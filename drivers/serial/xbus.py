"""Xsens (Movella) MTi on a serial port: the Xbus protocol, MTData2 packets to increments. Driver ``xsens-xbus``.

A message is FA, bus id, message id, length (FF: two more bytes of it), data, checksum: the sum of all bytes behind FA
is 0 modulo 256. MTData2 holds fields: a data identifier of 16 bits, a length, big-endian values. The low bits of an
identifier name the number format (float, fixed point 12.20 or 16.32, double) and, of orientations, the axes they refer
to (ENU, NED, NWU). Sensor axes are x forward, y left, z up; samples leave here forward-right-down. Source: Xsens, MT
Low-Level Communication Protocol.

Increments (DeltaQ, DeltaV) are taken where they are sent, else rate of turn and acceleration.
"""

import math
import re
import struct
from collections.abc import Callable
from functools import lru_cache
from typing import NamedTuple

from drivers.serial.dialog import Dialog, check_line
from drivers.serial.driver import Pairing, Reading, SerialDriver, Three, rotation_vector
from drivers.serial.stream import MORE, NONE
from nav.errors import HilError

PREAMBLE, BUS = 0xFA, 0xFF
MTDATA2 = 0x36
GOTO_CONFIG, GOTO_MEASUREMENT, SET_OUTPUT, ERROR, REQUEST_ID = 0x30, 0x10, 0xC0, 0x42, 0x00
"""Messages of the host (`ERROR`: of the board); the acknowledgement of each is its number and one."""
LONGEST = 2048
"""Most bytes of data in a message."""
TICK_NS = 100_000
"""Of SampleTimeFine."""
TEMPERATURE, COUNTER, TIME_FINE, STATUS = 0x0810, 0x1020, 0x1060, 0xE020
DELTA_Q, DELTA_V, RATE, ACCELERATION = 0x8030, 0x4010, 0x8020, 0x4020
_VECTORS = {ACCELERATION, RATE, DELTA_Q, DELTA_V}
NO_RATE = 0xFFFF
"""In the place of a rate: with each message, for counter, time and status; that it grants none, for increments."""
SIZE = 65
"""Bytes of the longest message that `configure` asks for."""
_SELF_TEST, _CLIPPED = 0x01, 0x3F00
"""Bits of the status word: the self-test was passed; an accelerometer or gyro is clipped."""
AXES = {0x0: "ENU", 0x4: "NED", 0x8: "NWU"}
_ORIENTED = {0x2010, 0x2020, 0x2030}
_REALS = {TEMPERATURE, *_ORIENTED, DELTA_V, ACCELERATION, 0x4030, 0x4040, RATE, DELTA_Q, 0x8040, 0xC020}
_WHOLE = {COUNTER: ">H", TIME_FINE: ">I", 0x1070: ">I", 0x3010: ">I", 0xE010: ">B", STATUS: ">I"}
_SIZES = (4, 4, 6, 8)


class Field(NamedTuple):
    """One field of MTData2: `values` in units of the protocol, `axes` of an orientation (else empty)."""

    values: tuple[float, ...]
    axes: str = ""


def message(mid: int, data: bytes = b"") -> bytes:
    """A whole Xbus message."""
    length = bytes([len(data)]) if len(data) < 0xFF else b"\xff" + struct.pack(">H", len(data))
    body = bytes([BUS, mid]) + length + data
    return bytes([PREAMBLE]) + body + bytes([-sum(body) & 0xFF])


def payload(packet: bytes) -> bytes:
    """The data of a whole message."""
    return packet[6:-1] if packet[3] == 0xFF else packet[4:-1]


@lru_cache(256)
def _form(identifier: int, length: int) -> tuple[int, str, struct.Struct, int] | None:
    """Name, axes, layout and number format of a field; None for a name that is not known.

    Raises
    ------
    ValueError
        The length does not fit the format.
    """
    name, form = identifier & 0xFFF0, identifier & 0x3
    if name in _WHOLE:
        layout, form, size = _WHOLE[name], 0, length
        if struct.calcsize(layout) != length:
            raise ValueError
    elif name in _REALS:
        size = _SIZES[form]
        layout = ">" + ("f", "i", "Ih", "d")[form] * (
            length // size
        )  # 16.32: the fraction stands before the whole part
    else:
        return None
    if length == 0 or length % size:
        raise ValueError
    return name, AXES.get(identifier & 0xC, "") if name in _ORIENTED else "", struct.Struct(layout), form


def read_fields(data: bytes) -> dict[int, Field] | None:
    """Fields of the data of MTData2 by identifier (without format and axes); None when they do not fill it evenly.

    Fields of unknown identifiers are left out.
    """
    fields: dict[int, Field] = {}
    at = 0
    try:
        while at < len(data):
            length = data[at + 2]
            known = _form(data[at] << 8 | data[at + 1], length)
            at += 3 + length
            if known is not None:
                name, axes, layout, form = known
                values = layout.unpack_from(data, at - length)
                if form == 1:
                    values = tuple(value * 2.0**-20 for value in values)
                elif form == 2:
                    values = tuple(w + f * 2.0**-32 for f, w in zip(values[::2], values[1::2], strict=True))
                fields[name] = Field(values, axes)
    except (IndexError, ValueError, struct.error):
        return None
    return fields if at == len(data) else None


def _body(values: tuple[float, ...]) -> Three:
    """Forward-left-up to forward-right-down."""
    return values[0], -values[1], -values[2]


class Xbus:
    """See the module; satisfies `drivers.serial.driver.Board`."""

    sync = re.compile(b"\xfa")
    clock_ns = TICK_NS << 32
    turn = 1 << 16

    def __init__(self) -> None:
        self._said: dict[str, object] = {}
        self._pairing = Pairing(DELTA_Q, DELTA_V)

    def size(self, data: bytes, at: int) -> int:
        """See `Framing.size`."""
        there = len(data) - at
        if there > 1 and data[at + 1] != BUS:
            return NONE
        if there < 4 or (data[at + 3] == 0xFF and there < 6):
            return MORE
        if data[at + 3] != 0xFF:
            return data[at + 3] + 5
        length = data[at + 4] << 8 | data[at + 5]
        return length + 7 if length <= LONGEST else NONE

    def good(self, packet: bytes) -> bool:
        """See `Framing.good`."""
        return sum(packet[1:]) & 0xFF == 0

    def read(self, packet: bytes) -> Reading | str:
        """See `Board.read`."""
        if packet[2] != MTDATA2:
            return "foreign"
        fields = read_fields(payload(packet))
        if fields is None:
            return "short"
        if TEMPERATURE in fields and math.isfinite(fields[TEMPERATURE].values[0]):
            self._said["temperature_c"] = fields[TEMPERATURE].values[0]
        status = int(fields[STATUS].values[0]) if STATUS in fields else _SELF_TEST
        self._said["status"] = status
        if fields.keys().isdisjoint(_VECTORS):
            return "foreign"  # a packet of slower outputs
        coned = self._pairing.fits(fields.keys())
        turn, push = (DELTA_Q, DELTA_V) if coned else (RATE, ACCELERATION)
        if not {turn, push, COUNTER, TIME_FINE} <= fields.keys():
            return "short"
        if len(fields[turn].values) != (4 if coned else 3) or len(fields[push].values) != 3:
            return "short"
        rotation = fields[turn].values
        return Reading(
            time_ns=int(fields[TIME_FINE].values[0]) * TICK_NS,
            turn=_body(rotation_vector(*rotation) if coned else rotation),
            push=_body(fields[push].values),
            coned=coned,
            counter=int(fields[COUNTER].values[0]),
            suspect=bool(status & _CLIPPED) or not status & _SELF_TEST,
        )

    def identity(self) -> dict[str, object]:
        """Temperature and status word as last said, and what `configure` was told."""
        return dict(self._said)

    def configure(self, dialog: Dialog, rate_hz: float, baud: int) -> dict[str, object]:
        """See `Board.configure`: counter, time, DeltaQ, DeltaV and status at `rate_hz`, temperature once a second."""
        if not (1 <= rate_hz < NO_RATE and rate_hz == int(rate_hz)):
            raise HilError(f"xsens-xbus: {rate_hz:g} Hz is not a whole number of hertz from 1 to {NO_RATE - 1}")
        check_line(rate_hz, SIZE, baud)
        _ask(dialog, "GotoConfig", GOTO_CONFIG)
        try:
            device = payload(_ask(dialog, "ReqDID", REQUEST_ID))
            wanted = [(COUNTER, NO_RATE), (TIME_FINE, NO_RATE), (STATUS, NO_RATE), (TEMPERATURE, 1)]
            wanted += [(DELTA_Q, int(rate_hz)), (DELTA_V, int(rate_hz))]
            order = b"".join(struct.pack(">HH", *entry) for entry in wanted)
            answer = payload(_ask(dialog, "SetOutputConfiguration", SET_OUTPUT, order))
            granted = dict(struct.iter_unpack(">HH", answer)) if len(answer) % 4 == 0 else {}
            for name in (DELTA_Q, DELTA_V):
                if (rate := granted.get(name, NO_RATE)) != int(rate_hz):
                    said = "none" if rate == NO_RATE else f"{rate} Hz"
                    raise HilError(f"xsens-xbus: asked for {rate_hz:g} Hz, the board grants {said}: take another rate")
        finally:  # also where it is refused: the board was stopped
            _ask(dialog, "GotoMeasurement", GOTO_MEASUREMENT)
        return {"device_id": device.hex().upper(), "rate_hz": rate_hz}


def _ask(dialog: Dialog, what: str, mid: int, data: bytes = b"") -> bytes:
    answers: Callable[[bytes], bool] = lambda packet: packet[2] in (mid + 1, ERROR)  # noqa: E731
    packet = dialog.ask(what, message(mid, data), answers)
    if packet[2] == ERROR:
        raise HilError(f"xsens-xbus: the board refuses {what}: error {payload(packet).hex()}")
    return packet


def xsens_xbus() -> SerialDriver:
    """The driver ``xsens-xbus``."""
    return SerialDriver(Xbus())
