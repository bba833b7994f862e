"""The other end of :mod:`drivers.can.dronecan_imu`: increments to the transfers of a node that sends RawIMU."""

from binascii import crc_hqx

import numpy as np

from drivers.can.dronecan_imu import BASE_CRC, COUNTER, END, START, TOGGLE, TYPE, VALUES, node_of
from drivers.can.emulation import EndRates, check_period, stamp
from drivers.can.frames import EFF, FrameArray, frames
from nav.increments import ImuIncrements

PRIORITY = 16


class DronecanEmulator:
    """Frames of one node; satisfies `drivers.BoardEmulator`.

    Parameters
    ----------
    period_us : int
        Sample period.
    node : int
        Its id.
    integrals : bool
        Send integrals beside the latest rates; False: an interval of 0.
    stamped : bool
        Put its time into the messages.
    option : str
        That of the driver: the node which it follows.

    Raises
    ------
    HilError
        A bus of 1 Mbit/s does not carry it.
    """

    frames_per_sample = 7

    def __init__(
        self, period_us: int, node: int = 42, *, integrals: bool = True, stamped: bool = True, option: str = ""
    ) -> None:
        check_period("a DroneCAN node", period_us, least_us=1000, grid_us=1)
        self._can_id = EFF | PRIORITY << 24 | TYPE << 8 | (node_of(option) or node)
        self._integrals, self._stamped, self._ends, self._transfer = integrals, stamped, EndRates(), 0

    def slow(self) -> FrameArray:
        """Nothing: NodeStatus is not read."""
        return frames(0)

    def samples(self, imu: ImuIncrements) -> FrameArray:
        """Frames of n samples, stamped with the board's time; the calls follow one another."""
        ends, batch = self._ends.rates(imu), frames(self.frames_per_sample * len(imu))
        batch["can_id"], batch["length"] = self._can_id, 8
        rows = batch["data"][:, :8].reshape(len(imu), self.frames_per_sample, 8)
        for k in range(len(imu)):
            time_us = round(1e6 * float(imu.time[k])) if self._stamped else 0
            interval = float(imu.step[k]) if self._integrals else 0.0
            turn, push = (imu.dtheta[k], imu.dvel[k]) if self._integrals else (np.zeros(3), np.zeros(3))
            said = VALUES.pack(interval, *ends[k, :3], *turn, *ends[k, 3:], *push)
            payload = time_us.to_bytes(7, "little") + said
            rows[k] = _transfer(payload, self._transfer)
            self._transfer = (self._transfer + 1) & COUNTER
        stamp(batch, imu.time, self.frames_per_sample)
        return batch


def _transfer(payload: bytes, number: int) -> np.ndarray[tuple[int, ...], np.dtype[np.uint8]]:
    """The data (7, 8) of the frames of a transfer of 47 bytes."""
    whole = crc_hqx(payload, BASE_CRC).to_bytes(2, "little") + payload
    data = np.zeros((len(whole) // 7, 8), np.uint8)
    data[:, :7] = np.frombuffer(whole, np.uint8).reshape(-1, 7)
    data[:, 7] = number | TOGGLE * (np.arange(len(data)) & 1)
    data[0, 7] |= START
    data[-1, 7] |= END
    return data
