"""The JSON interface of ArduPilot SITL: servo packets come in by UDP, one line of sensors answers each.

A servo packet is little-endian: uint16 magic (18458 with 16 channels, 29569 with 32), uint16 frame rate (Hz), uint32 frame
count, uint16 pulse width of each channel (us). The answer is a line of JSON between two newlines: ``timestamp`` (s), ``imu``
with ``gyro`` (rad/s) and ``accel_body`` (m/s^2), ``position`` (m, north, east, down of SITL's home), ``velocity`` (m/s),
``quaternion``. SITL's parser looks for keys with ``strstr`` and for numbers with ``sscanf`` right behind the colon: no blanks.
Source: ArduPilot, libraries/SITL/examples/JSON/readme.md and SIM_JSON.cpp.
"""

import struct
from collections.abc import Iterable
from dataclasses import dataclass

from drivers.mavlink.solution import Solution, Vector

MAGICS = {18458: 16, 29569: 32}
"""Magic number to count of channels."""
_HEAD = struct.Struct("<HHI")


@dataclass(frozen=True, slots=True)
class Servos:
    """One servo packet.

    Attributes
    ----------
    rate_hz : int
        Frames a second of simulated time that the autopilot wants.
    count : int
        Number of the frame.
    pwm : tuple of int
        Pulse widths, us.
    """

    rate_hz: int
    count: int
    pwm: tuple[int, ...]


def parse_servos(packet: bytes) -> Servos | None:
    """The servos in a datagram; None when it is not a servo packet."""
    if len(packet) < _HEAD.size:
        return None
    magic, rate_hz, count = _HEAD.unpack_from(packet)
    channels = MAGICS.get(magic)
    if channels is None or len(packet) != _HEAD.size + 2 * channels:
        return None
    return Servos(rate_hz, count, struct.unpack_from(f"<{channels}H", packet, _HEAD.size))


def sensor_line(solution: Solution, position: Vector) -> bytes:
    """The answer to a servo packet; `position` is north, east, down of SITL's home, m. Numbers are exact to the last bit."""
    gyro, force, velocity = (_list(three) for three in (solution.w_ib_b, solution.f_b, solution.vel_n))
    return (
        f'\n{{"timestamp":{solution.time!r},"imu":{{"gyro":{gyro},"accel_body":{force}}},"position":{_list(position)},'
        f'"quaternion":{_list(solution.q_nb)},"velocity":{velocity}}}\n'
    ).encode()


def _list(values: Iterable[float]) -> str:
    return "[" + ",".join(map(repr, values)) + "]"


class FrameCounter:
    """What the frame counts of an autopilot say.

    Attributes
    ----------
    resent, restarts, lost : int
        Frames that came again, times that the count jumped back, frames that did not come.
    """

    def __init__(self) -> None:
        self._last: int | None = None
        self.resent = self.restarts = self.lost = 0

    def take(self, count: int) -> bool:
        """Whether the frame is a new one; False: one that came before, to be answered as before."""
        last, self._last = self._last, count
        if last is None:
            return True
        if count == last:
            self.resent += 1
            return False
        if count < last:
            self.restarts += 1
        else:
            self.lost += count - last - 1
        return True

    def forget(self) -> None:
        """The next frame is another autopilot's."""
        self._last = None
