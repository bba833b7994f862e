"""The other end of the wire of :mod:`drivers.serial.mip`: a board that sends increments and answers to its configuration."""

import struct

import numpy as np

from drivers.serial import mip
from drivers.serial.chunks import to_chunks
from drivers.serial.increments import from_integrals
from drivers.serial.stream import ByteStream
from nav.earth import STANDARD_GRAVITY
from nav.increments import ImuIncrements

_UNKNOWN, _BAD_PARAMETER = 0x01, 0x03


class MipEmulator:
    """Bytes of one board with a base rate of 1000 Hz.

    Parameters
    ----------
    increments : bool
        Send delta theta and delta velocity with reference time; False: scaled gyro and accelerometer with GPS time.
    """

    base_hz = 1000

    def __init__(self, *, increments: bool = True) -> None:
        self._increments = increments
        self._before = np.zeros((2, 3))
        self._stream = ByteStream(mip.Mip())
        self.format = b""
        """Message format as it was set."""
        self.measuring = True

    def packets(self, imu: ImuIncrements, overrange: int = 0) -> list[bytes]:
        """One packet for each sample."""
        phi, u = from_integrals(imu.dtheta, imu.dvel, self._before)
        out = []
        for k in range(len(imu)):
            time = round(imu.time[k] * 1e9)
            if self._increments:
                fields = [
                    (mip.REFERENCE_TIME, struct.pack(">Q", time)),
                    (mip.DELTA_THETA, struct.pack(">3f", *phi[k])),
                    (mip.DELTA_VELOCITY, struct.pack(">3f", *(u[k] / STANDARD_GRAVITY))),
                ]
            else:
                rate, force = imu.dtheta[k] / imu.step[k], imu.dvel[k] / imu.step[k]
                fields = [
                    (mip.GPS_TIME, struct.pack(">dHH", imu.time[k], 2300, 7)),
                    (mip.RATE, struct.pack(">3f", *rate)),
                    (mip.ACCELERATION, struct.pack(">3f", *(force / STANDARD_GRAVITY))),
                ]
            if overrange:
                fields.append((mip.OVERRANGE, struct.pack(">H", overrange)))
            out.append(mip.packet_of(mip.SENSOR, fields))
        return out

    def answer(self, data: bytes) -> bytes:
        """What the board sends back for bytes of the host."""
        out = b""
        for packet, _ in self._stream.take(to_chunks(data)):
            for name, part in mip.read_fields(packet) or []:
                code, said = self._obey(packet[2], name, part)
                out += mip.packet_of(packet[2], [(mip.ACKNOWLEDGE, bytes([name, code])), *said])
        return out

    def _obey(self, descriptor_set: int, command: int, data: bytes) -> tuple[int, list[tuple[int, bytes]]]:
        order = (descriptor_set, command)
        if order in {(mip.BASE, mip.IDLE), (mip.BASE, mip.RESUME)}:
            self.measuring = command == mip.RESUME
        elif order == (mip.DM3, mip.BASE_RATE):
            return 0, [(0x8E, struct.pack(">BH", mip.SENSOR, self.base_hz))]
        elif order == (mip.DM3, mip.FORMAT) and data[:1] == bytes([mip.READ]):
            return 0, [(0x8F, self.format)]
        elif order == (mip.DM3, mip.FORMAT):
            if len(data) < 3 or len(data) != 3 + 3 * data[2]:
                return _BAD_PARAMETER, []
            self.format = data[1:]
        elif order != (mip.DM3, mip.STREAM):
            return _UNKNOWN, []
        return 0, []
