"""A VectorNav VN-300 to an autopilot: register commands come in, binary outputs of a navigation solution go out.

ArduPilot's ExternalAHRS driver stops the output (``$VNASY,0``), reads the model (register 1) and writes binary outputs to
registers 75, 76 and 77: ports, divisor of 400 Hz, groups, a mask of fields for each group. Older firmware asks for
``34,072E,0106,0612`` and ``4E,0002,0010,20B8,0018``, newer for ``01,0721``, ``31,0001,0106,0613`` and ``49,0003,26B8,0018``;
any mask of the fields below is served. Packets and checks are those of :mod:`drivers.serial.vectornav`. ArduPilot takes
altitudes for heights above the sea, and so they are here, where a board sends heights above the ellipsoid.
Source: VectorNav, UM001; ArduPilot, libraries/AP_ExternalAHRS/AP_ExternalAHRS_VectorNav.cpp and SITL/SIM_VectorNav.cpp.
"""

import math
import struct
from collections.abc import Callable
from dataclasses import dataclass

from drivers.mavlink.px4 import SATELLITES, Claim
from drivers.mavlink.solution import Solution, Vector
from drivers.mavlink.surroundings import Surroundings
from drivers.serial.vectornav import TEMPERATURE, packet_of
from drivers.serial.vectornav_emulator import VectorNavEmulator
from nav.state import Mode

BASE_HZ = 400.0
"""Of a VN-300: outputs come at this over their divisor."""
OUTPUTS = ("75", "76", "77")
"""Registers of the binary outputs."""
_COMMON, _TIME, _IMU, _GNSS1, _ATTITUDE, _INS, _GNSS2 = range(7)
_GPS_EPOCH_S, _LEAP_S = 315964800, 18
_CELSIUS = 273.15


@dataclass(frozen=True, slots=True)
class Measured:
    """What a packet is made of.

    Attributes
    ----------
    solution : Solution
        Rates without the navigator's bias where that is wanted.
    raw_w_ib_b : (3,) float
        Rates with it, rad/s.
    around : Surroundings
        Air and field.
    claim : Claim
        Sigmas where the solution has none.
    """

    solution: Solution
    raw_w_ib_b: Vector
    around: Surroundings
    claim: Claim

    @property
    def fixed(self) -> bool:
        """The position is good."""
        return self.solution.mode == Mode.NAVIGATE


@dataclass(frozen=True, slots=True)
class Output:
    """A binary output that the autopilot has asked for."""

    divisor: int
    groups: int
    masks: tuple[int, ...]

    @property
    def period_s(self) -> float:
        """Time between two packets."""
        return self.divisor / BASE_HZ

    def packet(self, measured: Measured) -> bytes:
        """One packet."""
        data = b"".join(
            struct.pack("<" + form, *values(measured))
            for form, values in (FIELDS[field] for field in _fields(self.groups, self.masks))
        )
        return packet_of(self.groups, self.masks, data)


class Ahrs:
    """The emulated board: its registers, and the outputs that they ask for.

    Parameters
    ----------
    model : str
        What register 1 says.
    """

    def __init__(self, model: str = "VN-300") -> None:
        self._board = VectorNavEmulator(model, accept=_accept)
        self._board.registers |= dict.fromkeys(OUTPUTS, "0,400,00")
        self.outputs: tuple[Output, ...] = ()
        self.configured = 0
        """Times that the outputs were changed."""

    @property
    def measuring(self) -> bool:
        """Packets are wanted."""
        return self._board.measuring and bool(self.outputs)

    @property
    def commands(self) -> int:
        """Commands so far."""
        return self._board.commands

    @property
    def bad_data(self) -> int:
        """Commands with a wrong check, and bytes that are part of none."""
        return self._board.bad_data

    def answer(self, data: bytes) -> bytes:
        """What the board sends back for bytes of the autopilot."""
        answers = self._board.answer(data)
        outputs = [_output(self._board.registers[register]) for register in OUTPUTS]
        wanted = tuple(output for output in outputs if output is not None)
        if wanted != self.outputs:
            self.outputs, self.configured = wanted, self.configured + 1
        return answers


def _accept(register: str, value: str) -> bool:
    """Whether `value` may be written to `register`."""
    if register not in OUTPUTS:
        return register != "01"
    try:
        _output(value)
    except (ValueError, IndexError):
        return False
    return True


def _output(value: str) -> Output | None:
    """The output that stands in a register; None: none. ValueError for one that cannot be served."""
    parts = value.split(",")
    ports, divisor, groups = int(parts[0]), int(parts[1]), int(parts[2], 16)
    if ports == 0:
        return None
    masks = tuple(int(part, 16) for part in parts[3:])
    if not (0 < ports <= 3 and 1 <= divisor <= 65535 and 0 < groups < 0x80 and len(masks) == groups.bit_count()):
        raise ValueError(value)
    fields = _fields(groups, masks)
    if not fields or any(field not in FIELDS for field in fields) or max(masks) > 0xFFFF:
        raise ValueError(value)
    return Output(divisor, groups, masks)


def _fields(groups: int, masks: tuple[int, ...]) -> list[tuple[int, int]]:
    """(group, bit) of each field, in their order."""
    named = [group for group in range(7) if groups >> group & 1]
    return [(group, bit) for group, mask in zip(named, masks, strict=True) for bit in range(16) if mask >> bit & 1]


def _startup(m: Measured) -> tuple[int]:
    return (max(round(m.solution.time * 1e9), 0),)


def _gps_time(m: Measured) -> tuple[int]:
    return (max(m.solution.arrival_ns + (_LEAP_S - _GPS_EPOCH_S) * 1_000_000_000, 0),)


def _ypr(m: Measured) -> Vector:
    heading, pitch, roll = m.solution.euler
    yaw = heading - 2.0 * math.pi if heading > math.pi else heading
    return math.degrees(yaw), math.degrees(pitch), math.degrees(roll)


def _quaternion(m: Measured) -> tuple[float, float, float, float]:
    w, x, y, z = m.solution.q_nb
    return x, y, z, w


def _ypr_sigma(m: Measured) -> Vector:
    north, east, down = m.solution.sigma[6:9] if m.solution.has_sigma else (math.radians(1.0),) * 3
    tilt = math.degrees(math.hypot(north, east))
    return math.degrees(down), tilt, tilt


def _status(m: Measured) -> tuple[int]:
    return (0x0306 if m.fixed else 0x0001,)  # mode 2 with fix and heading, or mode 1


def _place(m: Measured) -> Vector:
    return math.degrees(m.solution.lat), math.degrees(m.solution.lon), m.solution.altitude


def _place_sigma(m: Measured) -> tuple[float]:
    horizontal, vertical, _ = m.claim.of(m.solution)
    return (max(horizontal, vertical),)


def _flux(m: Measured) -> tuple[float, ...]:
    return tuple(1e4 * b for b in m.around.flux_b)


_Field = tuple[str, Callable[[Measured], tuple[float, ...]]]
_RATE: _Field = ("3f", lambda m: m.solution.w_ib_b)
_RAW_RATE: _Field = ("3f", lambda m: m.raw_w_ib_b)
_FORCE: _Field = ("3f", lambda m: m.solution.f_b)
_FLUX: _Field = ("3f", _flux)
_WARMTH: _Field = ("f", lambda m: (m.around.temperature - _CELSIUS,))
_PRESSURE: _Field = ("f", lambda m: (1e-3 * m.around.pressure,))
_VELOCITY: _Field = ("3f", lambda m: m.solution.vel_n)
_VELOCITY_SIGMA: _Field = ("f", lambda m: (m.claim.of(m.solution)[2],))
_PLACE: _Field = ("3d", _place)


def _receiver(group: int) -> dict[tuple[int, int], _Field]:
    """Fields of a receiver, which the solution stands for: NumSats, Fix, PosLla, VelNed, PosU, VelU, DOP."""

    def place_sigma(m: Measured) -> Vector:
        horizontal, vertical, _ = m.claim.of(m.solution)
        return horizontal / math.sqrt(2.0), horizontal / math.sqrt(2.0), vertical

    return {
        (group, 3): ("B", lambda m: (SATELLITES,)),
        (group, 4): ("B", lambda m: (3 if m.fixed else 2,)),
        (group, 5): _PLACE,
        (group, 7): _VELOCITY,
        (group, 9): ("3f", place_sigma),
        (group, 10): _VELOCITY_SIGMA,
        (group, 13): ("7f", lambda m: (1.0,) * 7),
    }


FIELDS: dict[tuple[int, int], _Field] = {
    (_COMMON, 0): ("Q", _startup),
    (_COMMON, 1): ("Q", _gps_time),
    (_COMMON, 3): ("3f", _ypr),
    (_COMMON, 4): ("4f", _quaternion),
    (_COMMON, 5): _RATE,
    (_COMMON, 6): _PLACE,
    (_COMMON, 7): _VELOCITY,
    (_COMMON, 8): _FORCE,
    (_COMMON, 9): ("6f", lambda m: (*m.solution.f_b, *m.raw_w_ib_b)),
    (_COMMON, 10): ("5f", lambda m: (*_flux(m), m.around.temperature - _CELSIUS, 1e-3 * m.around.pressure)),
    (_COMMON, 12): ("H", _status),
    (_TIME, 0): ("Q", _startup),
    (_TIME, 1): ("Q", _gps_time),
    (_IMU, 1): _FLUX,
    (_IMU, 2): _FORCE,
    (_IMU, 3): _RAW_RATE,
    TEMPERATURE: _WARMTH,
    (_IMU, 5): _PRESSURE,
    (_IMU, 8): _FLUX,
    (_IMU, 9): _FORCE,
    (_IMU, 10): _RATE,
    **_receiver(_GNSS1),
    (_ATTITUDE, 1): ("3f", _ypr),
    (_ATTITUDE, 2): ("4f", _quaternion),
    (_ATTITUDE, 8): ("3f", _ypr_sigma),
    (_INS, 0): ("H", _status),
    (_INS, 1): _PLACE,
    (_INS, 4): _VELOCITY,
    (_INS, 9): ("f", _place_sigma),
    (_INS, 10): _VELOCITY_SIGMA,
    **_receiver(_GNSS2),
}
"""(group, bit) of each field that is served: its form for `struct`, and its values."""
