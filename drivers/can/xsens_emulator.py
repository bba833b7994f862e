"""The other end of :mod:`drivers.can.xsens`: increments to the frames that an MTi-600 sends, rounded as it rounds them."""

import math
from collections.abc import Collection

import numpy as np

from drivers.can.emulation import EndRates, axes, check_period, put, rounded, stamp, ticks_of
from drivers.can.frames import FrameArray, frames
from drivers.can.samples import FLIP
from drivers.can.xsens import SELF_TEST, TICK_S, xsens_database
from nav.increments import FloatArray, ImuIncrements, IntArray

FULL_SCALE = 100.0
"""Specific force, m/s^2, that the increments of velocity must hold."""
ACCELEROMETERS_CLIPPED, GYROS_CLIPPED = 0x0700, 0x3800


class XsensEmulator:
    """Frames of one unit; satisfies `drivers.BoardEmulator`.

    Parameters
    ----------
    period_us : int
        Sample period.
    messages : collection of str
        What is sent beside time, counter and status: of DeltaV, RateOfTurn, DeltaQ and Acceleration.

    Raises
    ------
    HilError
        The unit has no such period.
    """

    def __init__(self, period_us: int, messages: Collection[str] = ("DeltaV", "RateOfTurn")) -> None:
        check_period("an MTi-600", period_us, least_us=2500, grid_us=100)
        names = ("XCID_SampleTime", "XCID_GroupCounter", "XCDI_StatusWord")
        named = [f"XCDI_{name}" for name in messages]
        database = xsens_database()
        self._codecs = sorted((database[name] for name in (*names, *named)), key=lambda codec: codec.can_id)
        self._temperature = database["XCDI_Temperature"]
        self._exponent = math.floor(math.log2(2.0**15 / (FULL_SCALE * period_us * 1e-6)))
        self._ends = EndRates()
        self.frames_per_sample = len(self._codecs)

    def slow(self) -> FrameArray:
        """The temperature."""
        batch = frames(1)
        put(self._temperature, {"temperature": np.array([35 << 8])}, batch)
        return batch

    def samples(self, imu: ImuIncrements) -> FrameArray:
        """Frames of n samples in the order of their identifiers, stamped with the board's time; the calls follow one another."""
        ends = self._ends.rates(imu)
        turn, turns_fit = rounded(FLIP * ends[:, :3], 2.0**-9)
        push, pushes_fit = rounded(FLIP * ends[:, 3:], 2.0**-8)
        dvel, increments_fit = rounded(FLIP * imu.dvel, 2.0**-self._exponent)
        clipped = np.where(pushes_fit & increments_fit, 0, ACCELEROMETERS_CLIPPED) | np.where(
            turns_fit, 0, GYROS_CLIPPED
        )
        exponent = np.full(len(imu), self._exponent)
        raw: dict[str, dict[str, IntArray]] = {
            "XCID_SampleTime": {"ticks": ticks_of(imu.time, TICK_S)},
            "XCID_GroupCounter": {"counter": imu.sequence & 0xFFFF},
            "XCDI_StatusWord": {"status": SELF_TEST | clipped},
            "XCDI_DeltaV": axes(dvel, "xyz") | {"exponent": exponent},
            "XCDI_RateOfTurn": axes(turn, "xyz"),
            "XCDI_DeltaQ": axes(_quaternions(FLIP * imu.dtheta), ("q0", "q1", "q2", "q3")),
            "XCDI_Acceleration": axes(push, "xyz"),
        }
        parts = self.frames_per_sample
        batch = frames(parts * len(imu))
        for k, codec in enumerate(self._codecs):
            put(codec, raw[codec.name], batch[k::parts])
        stamp(batch, imu.time, parts)
        return batch


def _quaternions(rotation: FloatArray) -> IntArray:
    """Raw quaternions (n, 4) of rotation vectors (n, 3)."""
    half = 0.5 * np.sqrt((rotation**2).sum(axis=1))
    vector = 0.5 * np.sinc(half / np.pi)[:, None] * rotation
    return rounded(np.column_stack([np.cos(half), vector]), 1.0 / 32767.0)[0]
