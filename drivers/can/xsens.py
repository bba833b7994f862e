"""Driver of Xsens MTi-600 units on CAN (also Avior, Sirius): frames of `fixtures/can/xsens_mti600.dbc` to `ImuIncrements`.

A sample is XCID_SampleTime, which opens it, XCID_GroupCounter where it is sent, and one message of velocity and one of the turn.
Velocity is taken from its increments (DeltaV) where they come, else from Acceleration. The turn is taken from RateOfTurn where it
comes, else from DeltaQ: above 32 Hz one step of the quaternion is more than one of the rate (0.024 rad/s against 0.002 at
400 Hz), and what lies below it is rounded to nothing. The vector of DeltaQ is turned into the angle of its rotation.

The board's axes are forward, left, up; they are turned into forward, right, down here. See `docs/boards/xsens-can.md`.
"""

from functools import cache
from importlib.resources import files

import numpy as np

from drivers import Counters
from drivers.can.codec import Database, load_database
from drivers.can.frames import FrameArray
from drivers.can.groups import (
    COUNTER,
    OPENING,
    OTHER,
    PUSH_DELTA,
    PUSH_RATE,
    STATUS,
    TURN_DELTA,
    TURN_RATE,
    GroupedBoard,
    Groups,
)
from drivers.can.samples import FLIP, INCREMENT
from nav.increments import FloatArray, ImuIncrements

TICK_S = 1e-4
SELF_TEST, CLIPPED = 0x0001, 0x3F00
"""Bits of the status word: self-test passed; an accelerometer or gyro is at the end of its range."""
MOST_EXPONENT = 30
"""A DeltaV with a larger one is damaged."""
KINDS = {
    "XCID_SampleTime": OPENING,
    "XCID_GroupCounter": COUNTER,
    "XCDI_StatusWord": STATUS,
    "XCDI_DeltaV": PUSH_DELTA,
    "XCDI_RateOfTurn": TURN_RATE,
    "XCDI_DeltaQ": TURN_DELTA,
    "XCDI_Acceleration": PUSH_RATE,
    "XCDI_Temperature": OTHER,
}
NAMES = ("SampleTime", "RateOfTurn", "DeltaV")
"""Messages without which there is no sample."""


@cache
def xsens_database() -> Database:
    """The part of the vendor's message set that is read here."""
    return load_database((files("fixtures") / "can" / "xsens_mti600.dbc").read_text("cp1252"))


def rotation_vector(q: FloatArray) -> FloatArray:
    """Rotation vectors (n, 3), rad, of quaternions (n, 4), scalar first, that need not be of length one; zero for a zero one."""
    length = np.sqrt((q[:, 1:] ** 2).sum(axis=1))
    half = np.arctan2(length, np.abs(q[:, 0]))
    scale = np.where(length > 0.0, 2.0 * half / np.where(length > 0.0, length, 1.0), 0.0)
    vector: FloatArray = (scale * np.where(q[:, 0] < 0.0, -1.0, 1.0))[:, None] * q[:, 1:]
    return vector


class Xsens(GroupedBoard):
    """See the module; satisfies `drivers.FrameDriver`."""

    def __init__(self) -> None:
        database = xsens_database()
        kinds = {database[name]: kind for name, kind in KINDS.items()}
        counters = Counters()
        super().__init__(counters, Groups(kinds, TICK_S, counters, turn_delta=False, delta_is=INCREMENT, names=NAMES))

    def decode(self, batch: FrameArray) -> ImuIncrements:
        """The samples that `batch` completes, in order; valid until the next call."""
        kind, found = self._groups.sorted(batch)
        value = np.zeros((len(batch), 3))
        for codec, (rows, data) in found.items():
            if len(rows) == 0:
                continue
            what = KINDS[codec.name]
            said = codec.decode(data, np.empty((len(rows), len(codec.signals))))
            columns = codec.columns
            if what == OPENING:
                value[rows, 0], value[rows, 1] = said[:, 0], -1.0
            elif what == COUNTER:
                value[rows, 0] = said[:, 0]
            elif what == STATUS:
                status = said[:, 0].astype(np.int64)
                value[rows, 0] = ((status & SELF_TEST) == 0) | ((status & CLIPPED) != 0)
                self._identity["status"] = int(status[-1])
            elif what == OTHER:
                self._identity["temperature"] = float(said[-1, 0])
            elif what == TURN_DELTA:
                value[rows] = FLIP * rotation_vector(said[:, [columns[f"q{i}"] for i in range(4)]])
            else:
                vector = FLIP * said[:, [columns[axis] for axis in "xyz"]]
                if what == PUSH_DELTA:
                    exponent = said[:, columns["exponent"]].astype(np.int64)
                    vector = np.ldexp(vector, -np.minimum(exponent, MOST_EXPONENT)[:, None])
                    damaged = exponent > MOST_EXPONENT
                    kind[rows[damaged]] = -1
                    self.counters.short += int(damaged.sum())
                value[rows] = vector
        return self._groups.take(kind, value, batch["time_ns"])
