"""VectorNav VN-100, VN-200, VN-300: binary output packets to increments. Driver ``vectornav``.

A packet is FA, a byte that names the groups in it, a mask of fields for each group, the fields, and a CRC-16 (CCITT,
start 0) that makes the CRC of all behind FA zero. Values are little-endian, axes forward-right-down. ASCII lines
(``$VN...*XX``) may come between and are counted. Source: VectorNav, UM001 and the interface control documents.

Taken are the time since start-up and, in this order: DeltaThetaVel, uncompensated or compensated accelerations and
rates. DeltaTheta is a rotation vector in degrees with coning, DeltaVel has sculling; `configure` sets them to body axes
without the filter's biases.
"""

import math
import re
import struct
from binascii import crc_hqx
from collections.abc import Iterable
from dataclasses import dataclass
from functools import lru_cache, reduce
from operator import xor

from drivers.serial.dialog import Dialog, check_line
from drivers.serial.driver import Reading, SerialDriver, Three
from drivers.serial.stream import MORE, NONE
from nav.errors import HilError

SYNC = 0xFA
_SIZES = (
    (8, 8, 8, 12, 16, 12, 24, 12, 12, 24, 20, 28, 2, 4, 8),
    (8, 8, 8, 2, 8, 8, 8, 4, 4, 1),
    (2, 12, 12, 12, 4, 4, 16, 12, 12, 12, 12, 2, 40),
    (8, 8, 2, 1, 1, 24, 24, 12, 12, 12, 4, 4, 2, 28),
    (2, 12, 16, 36, 12, 12, 12, 12, 12, 12, 28, 24),
    (2, 24, 24, 12, 12, 12, 12, 12, 12, 4, 4, 68, 64),
    (8, 8, 2, 1, 1, 24, 24, 12, 12, 12, 4, 4, 2, 28),
)
"""Bytes of each field of the groups common, time, IMU, GNSS1, attitude, INS, GNSS2."""
COMMON, TIME, IMU = 0, 1, 2
TIME_STARTUP, DELTA_THETA_VEL = (COMMON, 0), (COMMON, 11)
TEMPERATURE, SATURATION = (IMU, 4), (IMU, 11)
_RATES = (((IMU, 3), (IMU, 2)), ((COMMON, 9), (COMMON, 9)), ((IMU, 10), (IMU, 9)), ((COMMON, 5), (COMMON, 8)))
"""Pairs of fields with angular rate and acceleration, the uncompensated ones first; common 9 holds both, acceleration first."""
_INERTIAL = {DELTA_THETA_VEL, (IMU, 6), (IMU, 7)}.union(*_RATES)
_SATURATED = 0x01F8
"""Bits of SensSat: an accelerometer or a gyro."""
_LINE = re.compile(rb"\$VN[ -)+-~]{1,250}\*(?:[0-9A-Fa-f]{2}){1,2}\r\n")
_PART = re.compile(rb"\$(V(N[ -~]{0,256}\r?)?)?\Z")
GROUPS, MASKS = 0x05, (0x0801, 0x0810)
"""What `configure` asks for: time since start-up, DeltaThetaVel; temperature, saturation."""
SIZE = 50
"""Bytes of that packet."""
BOTH_PORTS = 3


@dataclass(frozen=True, slots=True)
class Layout:
    """Where the fields lie in packets of one header; -1 for what is not there."""

    length: int
    inertial: bool
    """A rate, force or increment is there, with its partner or without."""
    time: int
    step: int
    turn: int
    push: int
    coned: bool
    temperature: int
    saturation: int


@lru_cache(256)
def layout(header: bytes) -> Layout | None:
    """The layout behind a header (groups and masks); None when a field of it is unknown."""
    groups = [group for group in range(7) if header[0] >> group & 1]
    masks = struct.unpack(f"<{len(groups)}H", header[1:])
    at, places = 1 + len(header), {}
    for group, mask in zip(groups, masks, strict=True):
        for bit in range(16):
            if mask >> bit & 1:
                if bit >= len(_SIZES[group]):
                    return None
                places[group, bit] = at
                at += _SIZES[group][bit]
    time = places.get(TIME_STARTUP, places.get((TIME, 0), -1))
    step = turn = push = -1
    if DELTA_THETA_VEL in places:
        step = places[DELTA_THETA_VEL]
        turn, push = step + 4, step + 16
    elif (IMU, 6) in places and (IMU, 7) in places:
        step, push = places[IMU, 6], places[IMU, 7]
        turn = step + 4
    else:
        for rate, force in _RATES:
            if rate in places and force in places:
                turn, push = places[rate] + 12 * (rate == force), places[force]
                break
    inertial = not _INERTIAL.isdisjoint(places)
    warm, full = places.get(TEMPERATURE, -1), places.get(SATURATION, -1)
    return Layout(at + 2, inertial, time, step, turn, push, step >= 0, warm, full)


def packet_of(groups: int, masks: Iterable[int], data: bytes) -> bytes:
    """A whole binary packet."""
    body = bytes([groups]) + b"".join(struct.pack("<H", mask) for mask in masks) + data
    return bytes([SYNC]) + body + struct.pack(">H", crc_hqx(body, 0))


def line_of(text: str) -> bytes:
    """A whole ASCII line with its 8-bit check."""
    return f"${text}*{reduce(xor, text.encode()):02X}\r\n".encode()


def text_of(line: bytes) -> str:
    """What stands in an ASCII line between ``$`` and ``*``."""
    return line[1 : line.index(b"*")].decode()


class VectorNav:
    """See the module; satisfies `drivers.serial.driver.Board`."""

    sync = re.compile(rb"[\xfa$]")
    clock_ns = 1 << 64
    turn = 0

    def __init__(self) -> None:
        self._said: dict[str, object] = {}
        self._lines = 0

    def size(self, data: bytes, at: int) -> int:
        """See `Framing.size`."""
        if data[at] != SYNC:
            line = _LINE.match(data, at)
            return line.end() - at if line else MORE if _PART.match(data, at) else NONE
        groups = data[at + 1] if len(data) > at + 1 else 1
        if groups == 0 or groups & 0x80:  # bit 7: groups beyond those above
            return NONE
        head = 2 + 2 * groups.bit_count()
        if len(data) < at + head:
            return MORE
        found = layout(data[at + 1 : at + head])
        return found.length if found else NONE

    def good(self, packet: bytes) -> bool:
        """See `Framing.good`."""
        if packet[0] == SYNC:
            return crc_hqx(packet[1:], 0) == 0
        text, _, check = packet[1:].rpartition(b"*")
        return int(check, 16) == (crc_hqx(text, 0) if len(check) == 6 else reduce(xor, text))

    def read(self, packet: bytes) -> Reading | str:
        """See `Board.read`."""
        if packet[0] != SYNC:
            self._lines += 1
            return "foreign"
        where = layout(packet[1 : 2 + 2 * packet[1].bit_count()])
        if where is None or not where.inertial:
            return "foreign"  # a packet of slower outputs
        if where.turn < 0 or where.time < 0:
            return "short"
        if where.temperature >= 0 and math.isfinite(warm := struct.unpack_from("<f", packet, where.temperature)[0]):
            self._said["temperature_c"] = warm
        saturated = struct.unpack_from("<H", packet, where.saturation)[0] & _SATURATED if where.saturation >= 0 else 0
        turn = _three(packet, where.turn)
        step_ns = 0
        if where.coned:
            turn = math.radians(turn[0]), math.radians(turn[1]), math.radians(turn[2])
            step = struct.unpack_from("<f", packet, where.step)[0]
            if not 0.0 < step < 100.0:
                return "short"
            step_ns = round(step * 1e9)
        return Reading(
            time_ns=struct.unpack_from("<Q", packet, where.time)[0],
            turn=turn,
            push=_three(packet, where.push),
            coned=where.coned,
            step_ns=step_ns,
            suspect=saturated != 0,
        )

    def identity(self) -> dict[str, object]:
        """Temperature as last said, and how many ASCII lines came between."""
        return {**self._said, "ascii_lines": self._lines}

    def configure(self, dialog: Dialog, rate_hz: float, baud: int) -> dict[str, object]:
        """See `Board.configure`: registers 06 (no ASCII output), 82 (body axes, nothing taken off) and 75, which is read back."""
        check_line(rate_hz, SIZE, baud)
        _ask(dialog, "VNASY,0")
        try:
            model = _ask(dialog, "VNRRG,01").split(",")[-1]
            base = 400 if model.startswith("VN-3") else 800
            divisor = round(base / rate_hz) if rate_hz > 0 else 0
            if not (1 <= divisor <= base and math.isclose(divisor * rate_hz, base, rel_tol=1e-9)):
                raise HilError(f"vectornav: {rate_hz:g} Hz is not {base} Hz of a {model} by a whole number")
            _ask(dialog, "VNWRG,06,0")
            _ask(dialog, "VNWRG,82,0,0,0,0,0")
            _ask(dialog, f"VNWRG,75,{BOTH_PORTS},{divisor},{GROUPS:02X}," + ",".join(f"{mask:04X}" for mask in MASKS))
            answer = _ask(dialog, "VNRRG,75").split(",")[2:]
            there = [int(answer[0]), int(answer[1]), *(int(part, 16) for part in answer[2:])] if _is_75(answer) else []
            if there != [BOTH_PORTS, divisor, GROUPS, *MASKS]:
                raise HilError(f"vectornav: register 75 reads back as {','.join(answer)}: the board did not take it")
        finally:  # also where it is refused: the board was stopped
            _ask(dialog, "VNASY,1")
        return {"model": model, "rate_hz": base / divisor}


def _three(packet: bytes, at: int) -> Three:
    x, y, z = struct.unpack_from("<3f", packet, at)
    return x, y, z


def _is_75(fields: list[str]) -> bool:
    return (
        len(fields) > 2
        and all(part.isdecimal() for part in fields[:2])
        and all(re.fullmatch("[0-9A-Fa-f]+", part) for part in fields[2:])
    )


def _ask(dialog: Dialog, command: str) -> str:
    """Send a command; the answer without its check."""
    name, *fields = command.split(",")

    def answers(packet: bytes) -> bool:
        if packet[0] == SYNC:
            return False
        said, *rest = text_of(packet).split(",")
        if said == "VNERR":
            return True
        same = not fields or (bool(rest) and rest[0].lstrip("0") == fields[0].lstrip("0"))
        return said == name and same

    text = text_of(dialog.ask(f"${command}", line_of(command), answers))
    if text.startswith("VNERR"):
        raise HilError(f"vectornav: the board refuses ${command}: ${text}")
    return text


def vectornav() -> SerialDriver:
    """The driver ``vectornav``."""
    return SerialDriver(VectorNav())
