"""The other end of the wire of :mod:`drivers.serial.vectornav`: a VN-100 that sends increments and answers to its registers."""

import re
import struct
from collections.abc import Callable

import numpy as np

from drivers.serial import vectornav
from drivers.serial.chunks import to_chunks
from drivers.serial.increments import from_integrals
from drivers.serial.stream import ByteStream
from nav.increments import ImuIncrements

_RATES_MASKS = (0x0001, 0x0E10)
"""Without increments: time since start-up; temperature, compensated acceleration and rate, saturation."""
_BAD_CHECK, _BAD_PARAMETER, _UNKNOWN_REGISTER = 3, 7, 8


class _Commands(vectornav.VectorNav):
    """What a host sends: no binary packets."""

    sync = re.compile(rb"\$")


class VectorNavEmulator:
    """Bytes of one board.

    Parameters
    ----------
    model : str
        What register 1 says.
    increments : bool
        Send DeltaThetaVel; False: acceleration and rate.
    accept : callable
        Whether a value may be written to a register: ``accept(register, value)``.

    Attributes
    ----------
    commands : int
        Commands so far.
    """

    def __init__(
        self,
        model: str = "VN-100T-CR",
        *,
        increments: bool = True,
        accept: Callable[[str, str], bool] = lambda register, value: bool(value),
    ) -> None:
        self._increments = increments
        self._accept = accept
        self.commands = 0
        self._before = np.zeros((2, 3))
        self._stream = ByteStream(_Commands())
        self.registers = {"01": model, "06": "14", "75": "0,8,01,0029", "82": "0,0,0,0,0"}
        self.measuring = True

    def packets(self, imu: ImuIncrements, saturation: int = 0, temperature_c: float = 25.0) -> list[bytes]:
        """One binary packet for each sample."""
        phi, u = from_integrals(imu.dtheta, imu.dvel, self._before)
        out = []
        for k in range(len(imu)):
            time = struct.pack("<Q", round(imu.time[k] * 1e9))
            warm, full = struct.pack("<f", temperature_c), struct.pack("<H", saturation)
            if self._increments:
                data = time + struct.pack("<7f", imu.step[k], *np.degrees(phi[k]), *u[k]) + warm + full
                out.append(vectornav.packet_of(vectornav.GROUPS, vectornav.MASKS, data))
            else:
                rates = struct.pack("<6f", *(imu.dvel[k] / imu.step[k]), *(imu.dtheta[k] / imu.step[k]))
                out.append(vectornav.packet_of(vectornav.GROUPS, _RATES_MASKS, time + warm + rates + full))
        return out

    @property
    def bad_data(self) -> int:
        """Bytes of the host that are part of no good command."""
        return self._stream.skipped

    def answer(self, data: bytes) -> bytes:
        """What the board sends back for bytes of the host."""
        bad = self._stream.bad_checks
        lines = [packet for packet, _ in self._stream.take(to_chunks(data))]
        self.commands += len(lines)
        answers = [self._answer(vectornav.text_of(line)) for line in lines]
        answers += [f"VNERR,{_BAD_CHECK:02X}"] * (self._stream.bad_checks - bad)
        return b"".join(map(vectornav.line_of, answers))

    def _answer(self, text: str) -> str:
        name, _, rest = text.partition(",")
        if name == "VNASY" and rest in {"0", "1"}:
            self.measuring = rest == "1"
            return text
        register, _, value = rest.partition(",")
        number = register.zfill(2)
        if number not in self.registers:
            return f"VNERR,{_UNKNOWN_REGISTER:02X}"
        if name == "VNWRG":
            if not self._accept(number, value):
                return f"VNERR,{_BAD_PARAMETER:02X}"
            self.registers[number] = value
        return f"{name},{register},{self.registers[number]}"
