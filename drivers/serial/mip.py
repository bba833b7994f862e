"""MicroStrain (HBK) boards with the MIP protocol: sensor data packets to increments. Driver ``microstrain-mip``.

A packet is 75 65, a descriptor set, a length, fields (length, descriptor, big-endian data) and a Fletcher check of two
bytes. Sensor data is set 80; axes are forward-right-down. Increments (delta theta, delta velocity) are taken where they
are sent, else scaled gyro and accelerometer. Source: MicroStrain, MIP protocol and data communications manual.

The board counts no samples: what is missing is told by its time stamp, of its own clock (reference time) or of GPS.
"""

import re
import struct
from itertools import accumulate

from drivers.serial.dialog import Dialog, check_line
from drivers.serial.driver import Pairing, Reading, SerialDriver, Three
from drivers.serial.stream import MORE, NONE
from nav.earth import STANDARD_GRAVITY
from nav.errors import HilError

SYNC = b"\x75\x65"
SENSOR, BASE, DM3 = 0x80, 0x01, 0x0C
"""Descriptor sets: sensor data, base commands, 3DM commands."""
ACCELERATION, RATE, DELTA_THETA, DELTA_VELOCITY = 0x04, 0x05, 0x07, 0x08
GPS_TIME, GPS_TIME_SHARED, REFERENCE_TIME, REFERENCE_STEP, OVERRANGE = 0x12, 0xD3, 0xD5, 0xD6, 0x18
IDLE, RESUME, BASE_RATE, FORMAT, STREAM, ACKNOWLEDGE = 0x02, 0x06, 0x0E, 0x0F, 0x11, 0xF1
WRITE, READ = 0x01, 0x02
"""Function selectors."""
_WEEK_NS = 604_800 * 10**9
_LONGEST_STEP_NS = 100 * 10**9
_VECTORS = {ACCELERATION, RATE, DELTA_THETA, DELTA_VELOCITY}
_OVERRANGED = 0x0077
"""Bits of the overrange status: axes of the accelerometer and of the gyro."""
OUTPUTS = (REFERENCE_TIME, DELTA_THETA, DELTA_VELOCITY)
"""What `configure` asks for."""
SIZE = 44
"""Bytes of that packet."""


def packet_of(descriptor_set: int, fields: list[tuple[int, bytes]]) -> bytes:
    """A whole packet."""
    data = b"".join(bytes([len(part) + 2, name]) + part for name, part in fields)
    body = SYNC + bytes([descriptor_set, len(data)]) + data
    return body + check(body)


def check(data: bytes) -> bytes:
    """The Fletcher check of `data`."""
    return bytes([sum(data) & 0xFF, sum(accumulate(data)) & 0xFF])


def read_fields(packet: bytes) -> list[tuple[int, bytes]] | None:
    """(descriptor, data) of a whole packet; None when the fields do not fill it."""
    fields, at, end = [], 4, len(packet) - 2
    while at < end:
        length = packet[at]
        if length < 2 or at + length > end:
            return None
        fields.append((packet[at + 1], packet[at + 2 : at + length]))
        at += length
    return fields


class Mip:
    """See the module; satisfies `drivers.serial.driver.Board`."""

    sync = re.compile(b"\x75")
    clock_ns = 1 << 64
    turn = 0

    def __init__(self) -> None:
        self._pairing = Pairing(DELTA_THETA, DELTA_VELOCITY)

    def size(self, data: bytes, at: int) -> int:
        """See `Framing.size`."""
        if data[at + 1 : at + 2] not in {b"", SYNC[1:]}:
            return NONE
        return 6 + data[at + 3] if len(data) > at + 3 else MORE

    def good(self, packet: bytes) -> bool:
        """See `Framing.good`."""
        return check(packet[:-2]) == packet[-2:]

    def read(self, packet: bytes) -> Reading | str:
        """See `Board.read`."""
        if packet[2] != SENSOR:
            return "foreign"
        listed = read_fields(packet)
        if listed is None:
            return "short"
        fields = dict(listed)
        if fields.keys().isdisjoint(_VECTORS):
            return "foreign"
        coned = self._pairing.fits(fields.keys())
        turn, push = (DELTA_THETA, DELTA_VELOCITY) if coned else (RATE, ACCELERATION)
        time_ns = _time_ns(fields)
        if time_ns is None or not {turn, push} <= fields.keys():
            return "short"
        step = fields.get(REFERENCE_STEP, b"") if coned else b""
        step_ns = struct.unpack(">Q", step)[0] if len(step) == 8 else 0
        if any(len(fields[name]) != 12 for name in (turn, push)) or step_ns > _LONGEST_STEP_NS:
            return "short"
        force = _three(fields[push])
        overrange = fields.get(OVERRANGE, b"")
        return Reading(
            time_ns=time_ns,
            turn=_three(fields[turn]),
            push=(force[0] * STANDARD_GRAVITY, force[1] * STANDARD_GRAVITY, force[2] * STANDARD_GRAVITY),
            coned=coned,
            step_ns=step_ns,
            suspect=len(overrange) == 2 and bool(struct.unpack(">H", overrange)[0] & _OVERRANGED),
        )

    def identity(self) -> dict[str, object]:
        """Nothing: these packets say nothing of the board."""
        return {}

    def configure(self, dialog: Dialog, rate_hz: float, baud: int) -> dict[str, object]:
        """See `Board.configure`: reference time, delta theta and delta velocity; the format is read back."""
        check_line(rate_hz, SIZE, baud)
        _ask(dialog, "set to idle", BASE, IDLE)
        try:
            answer = _ask(dialog, "get base rate", DM3, BASE_RATE, bytes([SENSOR])).get(0x8E, b"")
            base = struct.unpack(">H", answer[1:])[0] if len(answer) == 3 else 0
            decimation = round(base / rate_hz) if rate_hz > 0 else 0
            if decimation < 1 or decimation * rate_hz != base:
                raise HilError(f"microstrain-mip: {rate_hz:g} Hz is not the board's {base} Hz by a whole number")
            wanted = bytes([SENSOR, len(OUTPUTS)]) + b"".join(struct.pack(">BH", name, decimation) for name in OUTPUTS)
            _ask(dialog, "message format", DM3, FORMAT, bytes([WRITE]) + wanted)
            there = _ask(dialog, "read message format", DM3, FORMAT, bytes([READ, SENSOR])).get(0x8F, b"")
            if there != wanted:
                raise HilError(
                    f"microstrain-mip: the message format reads back as {there.hex()}: the board did not take it"
                )
            _ask(dialog, "data stream on", DM3, STREAM, bytes([WRITE, SENSOR, 1]))
        finally:  # also where it is refused: the board was stopped
            _ask(dialog, "resume", BASE, RESUME)
        return {"rate_hz": base / decimation}


def _three(data: bytes) -> Three:
    x, y, z = struct.unpack(">3f", data)
    return x, y, z


def _time_ns(fields: dict[int, bytes]) -> int | None:
    """The board's clock; None where no time is sent that is right."""
    own = fields.get(REFERENCE_TIME, b"")
    if len(own) == 8:
        return int(struct.unpack(">Q", own)[0])
    gps = fields.get(GPS_TIME_SHARED, fields.get(GPS_TIME, b""))
    if len(gps) != 12:
        return None
    of_week, week, _ = struct.unpack(">dHH", gps)
    return week * _WEEK_NS + round(of_week * 1e9) if 0.0 <= of_week < 604_801.0 else None


def _ask(dialog: Dialog, what: str, descriptor_set: int, command: int, data: bytes = b"") -> dict[int, bytes]:
    """Send a command; the fields of the answer."""

    def answers(packet: bytes) -> bool:
        fields = read_fields(packet) or []
        return packet[2] == descriptor_set and any(
            name == ACKNOWLEDGE and part[:1] == bytes([command]) for name, part in fields
        )

    packet = dialog.ask(what, packet_of(descriptor_set, [(command, data)]), answers)
    fields = dict(read_fields(packet) or [])
    if fields[ACKNOWLEDGE][1:2] != b"\0":
        raise HilError(f"microstrain-mip: the board refuses to {what}: code {fields[ACKNOWLEDGE][1:2].hex()}")
    return fields


def microstrain_mip() -> SerialDriver:
    """The driver ``microstrain-mip``."""
    return SerialDriver(Mip())
