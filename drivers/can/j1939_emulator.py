"""The other end of :mod:`drivers.can.j1939`: increments to the frames of a J1939 sensor, rounded as it rounds them."""

import numpy as np

from drivers.can.emulation import EndRates, check_period, put, rounded, stamp
from drivers.can.frames import FrameArray, frames
from drivers.can.j1939 import FORCES, RATES, j1939_database, node_of
from drivers.can.samples import FLIP
from nav.increments import FloatArray, ImuIncrements, IntArray

ZERO = 32000
"""Raw value of a rate or acceleration of zero."""


class J1939Emulator:
    """Rates and accelerations of one node; satisfies `drivers.BoardEmulator`.

    Parameters
    ----------
    period_us : int
        Sample period.
    source : int
        Source address.
    option : str
        That of the driver: the address and the axes that it expects.

    Raises
    ------
    HilError
        The sensor has no such period.
    """

    frames_per_sample = 2

    def __init__(self, period_us: int, source: int = 0xE2, *, option: str = "") -> None:
        check_period("a J1939 sensor", period_us, least_us=5000, grid_us=5000)
        database = j1939_database()
        followed, self._turn = node_of(option)
        self._source = source if followed is None else followed
        self._rates, self._forces = database["ARI"], database["ACCS"]
        self._ends = EndRates()

    def slow(self) -> FrameArray:
        """Nothing: all that the sensor says comes with each sample."""
        return frames(0)

    def samples(self, imu: ImuIncrements) -> FrameArray:
        """Frames of n samples, stamped with the board's time; the calls follow one another."""
        ends = self._ends.rates(imu)
        batch = frames(2 * len(imu))
        put(
            self._rates,
            _raw(RATES, np.degrees(self._turn * ends[:, :3]), 1.0 / 128.0) | {"latency": np.full(len(imu), 10)},
            batch[0::2],
        )
        put(self._forces, _raw(FORCES, FLIP * ends[:, 3:], 0.01), batch[1::2])
        batch["can_id"] = batch["can_id"] & np.uint32(0xFFFFFF00) | np.uint32(self._source)
        stamp(batch, imu.time, 2)
        return batch


def _raw(names: tuple[str, ...], values: FloatArray, lsb: float) -> dict[str, IntArray]:
    """Raw values by name: held within +-32000 LSB, so that none reads as an error."""
    counts = np.clip(rounded(values, lsb)[0], -ZERO, ZERO) + ZERO
    return {name: counts[:, i] for i, name in enumerate(names)}
