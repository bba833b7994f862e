"""Another autopilot as an IMU: HIGHRES_IMU, SCALED_IMU or RAW_IMU of its MAVLink stream. Driver ``mavlink-imu``.

The bytes come as chunks from a port (``mavlink:udpin:127.0.0.1:14560``, or a serial port). The first sender of an inertial
message is followed, and the first kind that it sends; ``mavlink-imu@SCALED_IMU`` names the kind. RAW_IMU has no units of its own
and is taken when it is named alone, in ArduPilot's: milli-g and milliradians a second, as SCALED_IMU.

Its ATTITUDE is kept for comparison.
"""

import re
from collections import deque
from typing import Any

from pymavlink.dialects.v20 import ardupilotmega as mav

from drivers.serial.dialog import Dialog
from drivers.serial.driver import Reading, SerialDriver
from drivers.serial.stream import MORE, NONE
from nav.earth import STANDARD_GRAVITY
from nav.errors import HilError
from nav.rotation import quaternion_from_euler

KINDS = ("HIGHRES_IMU", "SCALED_IMU", "RAW_IMU")
_ALL_SIX = 0b111111
_CLOCK_NS = 2**32 * 1_000_000
"""Milliseconds since the start, of 32 bits."""
_ATTITUDES = 256
_V1, _V2 = mav.PROTOCOL_MARKER_V1, mav.PROTOCOL_MARKER_V2


class MavlinkImu:
    """A MAVLink stream as a `drivers.serial.driver.Board`.

    Parameters
    ----------
    kind : str
        Which of `KINDS`; empty: the first that comes, RAW_IMU aside.
    """

    clock_ns = _CLOCK_NS
    turn = 0
    sync = re.compile(rb"[\xfd\xfe]")

    def __init__(self, kind: str = "") -> None:
        if kind and kind not in KINDS:
            raise HilError(f"driver 'mavlink-imu': unknown message {kind!r}; expected one of {', '.join(KINDS)}")
        self._kind = kind
        self._sender: tuple[int, int] | None = None
        self._parser = mav.MAVLink(None)
        self.attitudes: deque[tuple[float, Any]] = deque(maxlen=_ATTITUDES)
        """(its time, s, q_nb) of each ATTITUDE that nobody has taken yet."""

    def size(self, data: bytes, at: int) -> int:
        """See `drivers.serial.stream.Framing.size`."""
        if len(data) < at + 3:
            return MORE
        if data[at] == _V1:
            return data[at + 1] + 8
        flags = data[at + 2]
        return NONE if flags & ~mav.MAVLINK_IFLAG_SIGNED else data[at + 1] + 12 + 13 * flags

    def good(self, packet: bytes) -> bool:
        """Whether the checksum is right; a message that is not known is passed over as a whole."""
        if packet[0] == _V1:
            number, end = packet[5], len(packet) - 2
        else:
            number, end = int.from_bytes(packet[7:10], "little"), 10 + packet[1]
        kind = mav.mavlink_map.get(number)
        if kind is None:
            return True
        crc = mav.x25crc(bytearray(packet[1:end] + bytes([kind.crc_extra]))).crc
        return bool(crc == int.from_bytes(packet[end : end + 2], "little"))

    def read(self, packet: bytes) -> Reading | str:
        """See `drivers.serial.driver.Board.read`."""
        try:
            message = self._parser.decode(bytearray(packet))
        except mav.MAVError:
            return "short"
        name, sender = message.get_type(), (message.get_srcSystem(), message.get_srcComponent())
        if self._sender not in (None, sender):
            return "foreign"
        if name == "ATTITUDE" and self._sender is not None:
            q_nb = quaternion_from_euler(message.yaw, message.pitch, message.roll)
            self.attitudes.append((1e-3 * message.time_boot_ms, q_nb))
        if name not in KINDS or (name != self._kind if self._kind else name == "RAW_IMU"):
            return "foreign"
        if name == "HIGHRES_IMU" and message.fields_updated & _ALL_SIX != _ALL_SIX:
            return "short"
        self._sender, self._kind = sender, name
        turn, push = (message.xgyro, message.ygyro, message.zgyro), (message.xacc, message.yacc, message.zacc)
        if name == "HIGHRES_IMU":
            return Reading(1000 * message.time_usec % _CLOCK_NS, turn, push, coned=False)
        time_ns = 1000 * message.time_usec if name == "RAW_IMU" else 1_000_000 * message.time_boot_ms
        p, q, r = (1e-3 * rate for rate in turn)
        x, y, z = (1e-3 * STANDARD_GRAVITY * force for force in push)
        return Reading(time_ns % _CLOCK_NS, (p, q, r), (x, y, z), coned=False)

    def identity(self) -> dict[str, object]:
        """See `drivers.serial.driver.Board.identity`."""
        if self._sender is None:
            return {}
        return {"system": self._sender[0], "component": self._sender[1], "message": self._kind}

    def configure(self, dialog: Dialog, rate_hz: float, baud: int) -> dict[str, object]:
        """An autopilot is set up with its own tools."""
        raise HilError(
            "mavlink-imu: set the rate in the autopilot: SR0_RAW_SENS of ArduPilot, mavlink stream -s HIGHRES_IMU of PX4"
        )


class MavlinkImuDriver(SerialDriver):
    """The driver, with the other estimator's attitudes."""

    board: MavlinkImu

    def attitudes(self) -> list[tuple[float, Any]]:
        """(device time, s, q_nb) of each ATTITUDE since the last call."""
        found = list(self.board.attitudes)
        self.board.attitudes.clear()
        return found


def mavlink_imu(kind: str = "") -> MavlinkImuDriver:
    """The driver ``mavlink-imu``."""
    return MavlinkImuDriver(MavlinkImu(kind))
