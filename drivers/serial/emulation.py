"""Boards on a serial port in the place of the simulated head: each packet is one chunk, on any bus that carries chunks."""

from collections.abc import Callable

import numpy as np

from drivers.can.emulation import check_period
from drivers.can.frames import FrameArray, frames
from drivers.serial.chunks import to_chunks
from drivers.serial.mip_emulator import MipEmulator
from drivers.serial.vectornav_emulator import VectorNavEmulator
from drivers.serial.xbus_emulator import XbusEmulator
from nav.increments import ImuIncrements


class SerialEmulator:
    """Packets of a board as frames; satisfies `drivers.BoardEmulator`."""

    frames_per_sample = 1

    def __init__(self, packets: Callable[[ImuIncrements], list[bytes]]) -> None:
        self._packets = packets

    def slow(self) -> FrameArray:
        """Nothing: all is in the packets of the samples."""
        return frames(0)

    def samples(self, imu: ImuIncrements) -> FrameArray:
        """One chunk for each sample, stamped with the board's time; the calls follow one another."""
        batch = np.concatenate([to_chunks(packet) for packet in self._packets(imu)])
        batch["time_ns"] = np.rint(imu.time * 1e9).astype(np.int64)
        return batch


def vectornav_board(period_us: int) -> SerialEmulator:
    """A VN-100; its base rate is 800 Hz."""
    check_period("a VN-100", period_us, least_us=1250, grid_us=1250)
    return SerialEmulator(VectorNavEmulator().packets)


def mip_board(period_us: int) -> SerialEmulator:
    """A 3DM of MicroStrain; its base rate is 1000 Hz."""
    base_us = 1_000_000 // MipEmulator.base_hz
    check_period("a MicroStrain board", period_us, least_us=base_us, grid_us=base_us)
    return SerialEmulator(MipEmulator().packets)


def xbus_board(period_us: int) -> SerialEmulator:
    """An MTi of Xsens without the temperature, so that a packet fits a chunk."""
    check_period("an MTi", period_us, least_us=2500, grid_us=500)
    emulator = XbusEmulator()
    return SerialEmulator(lambda imu: emulator.packets(imu, temperature_c=None, counters=imu.sequence))
