"""The other end of the wire of :mod:`drivers.serial.xbus`: an MTi that sends increments and answers to its configuration."""

import struct

import numpy as np

from drivers.serial import xbus
from drivers.serial.chunks import to_chunks
from drivers.serial.increments import from_integrals
from drivers.serial.stream import ByteStream
from nav.increments import ImuIncrements, IntArray

_FORMS = {"float32": 0, "fp12.20": 1, "fp16.32": 2, "double": 3}


def encode_numbers(values: tuple[float, ...], form: int) -> bytes:
    """`values` in one of the four number formats, rounded to the nearest."""
    if form == 1:
        return struct.pack(f">{len(values)}i", *(round(value * 2**20) for value in values))
    if form == 2:
        whole = [divmod(round(value * 2**32), 2**32) for value in values]
        return b"".join(struct.pack(">Ih", fraction, high) for high, fraction in whole)
    return struct.pack(f">{len(values)}{'f' if form == 0 else 'd'}", *values)


def field(identifier: int, data: bytes) -> bytes:
    """One field of MTData2."""
    return struct.pack(">HB", identifier, len(data)) + data


class XbusEmulator:
    """Bytes of one board.

    Parameters
    ----------
    form : {"float32", "fp12.20", "fp16.32", "double"}
        Number format of all values.
    increments : bool
        Send DeltaQ and DeltaV; False: rate of turn and acceleration.
    first : int
        Packet counter of the first sample.
    device : int
        Device id.
    """

    def __init__(
        self, form: str = "float32", *, increments: bool = True, first: int = 0, device: int = 0x03720123
    ) -> None:
        self._form = _FORMS[form]
        self._increments = increments
        self._counter = first
        self._device = device
        self._before = np.zeros((2, 3))
        self._stream = ByteStream(xbus.Xbus())
        self.measuring = True
        self.outputs: dict[int, int] = {}
        """Output configuration as it was set: data identifier to rate, Hz."""

    def packets(
        self,
        imu: ImuIncrements,
        status: int = 0x03,
        temperature_c: float | None = 25.0,
        counters: IntArray | None = None,
    ) -> list[bytes]:
        """One MTData2 message for each sample; the increments are those of a board that does its own coning.

        `counters` (n,) are said in the place of its own; a temperature of None is left out.
        """
        phi, u = from_integrals(imu.dtheta, imu.dvel, self._before)
        half = np.linalg.norm(phi, axis=1, keepdims=True) / 2.0
        sine = np.sinc(half / np.pi) / 2.0
        delta_q = np.concatenate([np.cos(half), sine * phi * [1, -1, -1]], axis=1)
        rate, force = (part / imu.step[:, None] * [1, -1, -1] for part in (imu.dtheta, imu.dvel))
        out = []
        for k in range(len(imu)):
            ticks = round(imu.time[k] * 1e9 / xbus.TICK_NS)
            counter = self._counter if counters is None else int(counters[k])
            data = field(xbus.COUNTER, struct.pack(">H", counter & 0xFFFF))
            data += field(xbus.TIME_FINE, struct.pack(">I", ticks & 0xFFFFFFFF))
            if self._increments:
                data += self._reals(xbus.DELTA_Q, delta_q[k]) + self._reals(xbus.DELTA_V, u[k] * [1, -1, -1])
            else:
                data += self._reals(xbus.RATE, rate[k]) + self._reals(xbus.ACCELERATION, force[k])
            if temperature_c is not None:
                data += self._reals(xbus.TEMPERATURE, np.array([temperature_c]))
            data += field(xbus.STATUS, struct.pack(">I", status))
            out.append(xbus.message(xbus.MTDATA2, data))
            self._counter += 1
        return out

    def _reals(self, name: int, values: np.ndarray) -> bytes:
        return field(name | self._form, encode_numbers(tuple(values.tolist()), self._form))

    def answer(self, data: bytes) -> bytes:
        """What the board sends back for bytes of the host."""
        return b"".join(self._answer(packet) for packet, _ in self._stream.take(to_chunks(data)))

    def _answer(self, packet: bytes) -> bytes:
        mid, data = packet[2], xbus.payload(packet)
        if mid == xbus.GOTO_CONFIG:
            self.measuring = False
        elif mid == xbus.GOTO_MEASUREMENT:
            self.measuring = True
        elif self.measuring:
            return b""  # it hears nothing else while it measures
        elif mid == xbus.REQUEST_ID:
            return xbus.message(mid + 1, struct.pack(">I", self._device))
        elif mid == xbus.SET_OUTPUT and len(data) % 4 == 0:
            self.outputs = dict(struct.iter_unpack(">HH", data))
            self.outputs = {name: rate if rate <= 2000 else 0xFFFF for name, rate in self.outputs.items()}
            return xbus.message(mid + 1, b"".join(struct.pack(">HH", *entry) for entry in self.outputs.items()))
        else:
            return xbus.message(xbus.ERROR, b"\x04")
        return xbus.message(mid + 1)
