"""End-to-end protection of payloads: AUTOSAR E2E Profile 5 and Profile 11, over batches of frames.

Profile 5: CRC-16 (polynomial 0x1021, start 0xFFFF) over the payload from byte 2 on, then the data id, low byte first; the
CRC stands in bytes 0..1, low byte first, an 8-bit counter in byte 2. Profile 11 (data id mode BOTH): CRC-8 (polynomial
0x1D, start 0) over the data id, low byte first, then the payload from byte 1 on; the CRC stands in byte 0, a 4-bit
counter in the low half of byte 1; AUTOSAR itself lets that counter run to 14 only. Source: AUTOSAR FO, E2E Protocol
Specification (PRS_E2EProtocol).

Which profile, data id and counter range a message has is declared in its DBC: attributes `E2EProfile` ("P05", "P11"),
`E2EDataId` and `E2ECounterModulus`. Payloads are rows of uint8, at least as wide as the message.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from drivers.can.codec import MessageCodec
from nav.errors import HilError
from nav.kernel import inline_kernel, kernel

Payloads = NDArray[np.uint8]
Flags = NDArray[np.bool_]


def _crc_table(polynomial: int, width: int) -> NDArray[np.int64]:
    table = np.empty(256, np.int64)
    for byte in range(256):
        crc = byte << (width - 8)
        for _ in range(8):
            crc = (crc << 1) ^ (polynomial if crc >> (width - 1) else 0)
            crc &= (1 << width) - 1
        table[byte] = crc
    return table


_CRC16 = _crc_table(0x1021, 16)
_CRC8 = _crc_table(0x1D, 8)
_LENGTHS = {"P05": range(3, 65), "P11": range(2, 65)}
_MODULI = {"P05": 256, "P11": 16}


@dataclass(frozen=True)
class Protection:
    """How one message is protected; `length` is in bytes, the counter runs from 0 to `counter_modulus` - 1."""

    profile: str
    data_id: int
    length: int
    counter_modulus: int

    def __post_init__(self) -> None:
        """Refuse what no profile allows."""
        if self.profile not in _MODULI:
            raise HilError(f"E2E profile {self.profile!r} is not known; known are {', '.join(_MODULI)}")
        if self.length not in _LENGTHS[self.profile]:
            raise HilError(f"{self.length} bytes cannot carry E2E profile {self.profile}")
        if not (0 <= self.data_id < 1 << 16 and 1 <= self.counter_modulus <= _MODULI[self.profile]):
            raise HilError(
                f"E2E {self.profile}: the data id {self.data_id} must be below 65536, "
                f"the counter modulus {self.counter_modulus} from 1 to {_MODULI[self.profile]}"
            )

    def protect(self, data: Payloads, counters: NDArray[np.int64]) -> None:
        """Write the counters (n,), reduced by the modulus, and then the CRC into every row of `data`, in place."""
        self._check_shape(data, counters)
        protect_rows = p05_protect if self.profile == "P05" else p11_protect
        protect_rows(data, self.length, self.data_id, counters, self.counter_modulus)

    def check(self, data: Payloads, good: Flags) -> Flags:
        """Fill `good` (n,) and return it: whether the CRC of each row is right and its counter below the modulus."""
        self._check_shape(data, good)
        check_rows = p05_check if self.profile == "P05" else p11_check
        check_rows(data, self.length, self.data_id, self.counter_modulus, good)
        return good

    def _check_shape(self, data: Payloads, column: NDArray[np.int64] | Flags) -> None:
        if data.shape[1] < self.length or column.shape != data.shape[:1]:
            raise HilError(
                f"payloads of shape {data.shape} and a column of shape {column.shape} do not fit {self.length} bytes"
            )


def protection(message: MessageCodec) -> Protection | None:
    """Protection that the DBC declares for `message`; None when it declares none.

    Raises
    ------
    HilError
        The declaration names an unknown profile or values out of range.
    """
    profile = str(message.attributes.get("E2EProfile", "none"))
    if profile == "none":
        return None
    data_id, modulus = (int(message.attributes.get(name, -1)) for name in ("E2EDataId", "E2ECounterModulus"))
    try:
        return Protection(profile, data_id, message.length, modulus)
    except HilError as error:
        raise HilError(f"message {message.name}: {error}") from error


@inline_kernel
def _p05_row(data: Payloads, i: int, length: int, data_id: int) -> int:
    crc = 0xFFFF
    for k in range(2, length):
        crc = ((crc << 8) & 0xFFFF) ^ _CRC16[(crc >> 8) ^ data[i, k]]
    crc = ((crc << 8) & 0xFFFF) ^ _CRC16[(crc >> 8) ^ (data_id & 0xFF)]
    return int(((crc << 8) & 0xFFFF) ^ _CRC16[(crc >> 8) ^ (data_id >> 8)])


@inline_kernel
def _p11_row(data: Payloads, i: int, length: int, data_id: int) -> int:
    crc = _CRC8[_CRC8[data_id & 0xFF] ^ (data_id >> 8)]
    for k in range(1, length):
        crc = _CRC8[crc ^ data[i, k]]
    return int(crc)


@kernel
def p05_crc(data: Payloads, length: int, data_id: int, out: NDArray[np.uint16]) -> None:
    """Profile 5 CRC of the first `length` bytes of every row of `data` into `out` (n,)."""
    for i in range(data.shape[0]):
        out[i] = _p05_row(data, i, length, data_id)


@kernel
def p11_crc(data: Payloads, length: int, data_id: int, out: Payloads) -> None:
    """Profile 11 CRC of the first `length` bytes of every row of `data` into `out` (n,)."""
    for i in range(data.shape[0]):
        out[i] = _p11_row(data, i, length, data_id)


@kernel
def p05_protect(data: Payloads, length: int, data_id: int, counters: NDArray[np.int64], modulus: int) -> None:
    """Write ``counters % modulus`` and the Profile 5 CRC into every row of `data`."""
    for i in range(data.shape[0]):
        data[i, 2] = counters[i] % modulus
        crc = _p05_row(data, i, length, data_id)
        data[i, 0] = crc & 0xFF
        data[i, 1] = crc >> 8


@kernel
def p11_protect(data: Payloads, length: int, data_id: int, counters: NDArray[np.int64], modulus: int) -> None:
    """Write ``counters % modulus`` (the high half of byte 1 is left) and the Profile 11 CRC into every row of `data`."""
    for i in range(data.shape[0]):
        data[i, 1] = (data[i, 1] & 0xF0) | (counters[i] % modulus)
        data[i, 0] = _p11_row(data, i, length, data_id)


@kernel
def p05_check(data: Payloads, length: int, data_id: int, modulus: int, good: Flags) -> None:
    """Fill `good` (n,): the Profile 5 CRC of the row is right and its counter below `modulus`."""
    for i in range(data.shape[0]):
        crc = _p05_row(data, i, length, data_id)
        good[i] = crc == data[i, 0] | (np.int64(data[i, 1]) << 8) and data[i, 2] < modulus


@kernel
def p11_check(data: Payloads, length: int, data_id: int, modulus: int, good: Flags) -> None:
    """Fill `good` (n,): the Profile 11 CRC of the row is right and its counter below `modulus` (AUTOSAR: 15)."""
    for i in range(data.shape[0]):
        good[i] = _p11_row(data, i, length, data_id) == data[i, 0] and (data[i, 1] & 0x0F) < modulus
