"""Driver of SBG Systems units on CAN (Ellipse and others): the IMU messages of the vendor's `sbgCan.dbc` to `ImuIncrements`.

A sample is IMU_INFO, which opens it with its time, and IMU_ACCEL and IMU_GYRO, or IMU_DELTA_VEL and IMU_DELTA_ANGLE. These two
are means over the sample, as rates; they are taken where they come. (Firmware of today sends in them what ACCEL and GYRO hold,
and calls them deprecated.) The board has no counter: what is missing is told by its time, us in 32 bits. Its axes are forward,
right, down as ours. See `docs/boards/sbg.md`.
"""

from functools import cache
from importlib.resources import files

import numpy as np

from drivers import Counters
from drivers.can.codec import Database, load_database
from drivers.can.frames import FrameArray
from drivers.can.groups import OPENING, PUSH_DELTA, PUSH_RATE, TURN_DELTA, TURN_RATE, GroupedBoard, Groups
from drivers.can.samples import MEAN_RATE
from nav.increments import ImuIncrements

TICK_S = 1e-6
HEALTHY = 0x03FF
"""Bits of the status that are all set while the IMU and its sensors pass their tests and are within their ranges."""
VECTORS = {
    "IMU_ACCEL": (PUSH_RATE, "ACCEL"),
    "IMU_GYRO": (TURN_RATE, "GYRO"),
    "IMU_DELTA_VEL": (PUSH_DELTA, "DELTA_VEL"),
    "IMU_DELTA_ANGLE": (TURN_DELTA, "DELTA_ANGLE"),
}
"""Kind of each message that carries a vector, and how its signals begin."""
NAMES = ("IMU_INFO", "IMU_GYRO", "IMU_ACCEL")
"""Messages without which there is no sample."""


@cache
def sbg_database() -> Database:
    """The vendor's message set."""
    return load_database((files("fixtures") / "can" / "sbgCan.dbc").read_text("cp1252"))


class Sbg(GroupedBoard):
    """See the module; satisfies `drivers.FrameDriver`."""

    def __init__(self) -> None:
        database = sbg_database()
        kinds = {database["SBG_ECAN_MSG_IMU_INFO"]: OPENING}
        self._columns: dict[str, list[int]] = {}
        for name, (kind, signal) in VECTORS.items():
            codec = database[f"SBG_ECAN_MSG_{name}"]
            kinds[codec] = kind
            self._columns[codec.name] = [codec.columns[f"{signal}_{axis}"] for axis in "XYZ"]
        counters, others = Counters(), database.by_id.keys() - {codec.can_id for codec in kinds}
        groups = Groups(kinds, TICK_S, counters, turn_delta=True, delta_is=MEAN_RATE, names=NAMES, others=others)
        super().__init__(counters, groups)

    def decode(self, batch: FrameArray) -> ImuIncrements:
        """The samples that `batch` completes, in order; valid until the next call."""
        kind, found = self._groups.sorted(batch)
        value = np.zeros((len(batch), 3))
        for codec, (rows, data) in found.items():
            said = codec.decode(data, np.empty((len(rows), len(codec.signals))))
            if codec.name in self._columns:
                value[rows] = said[:, self._columns[codec.name]]
            elif len(rows):
                status = said[:, codec.columns["STATUS"]].astype(np.int64)
                value[rows, 0] = said[:, codec.columns["TIME_STAMP"]]
                value[rows, 1] = status & HEALTHY != HEALTHY
                temperature = float(said[-1, codec.columns["TEMPERATURE"]])
                self._identity = {"status": int(status[-1]), "temperature": temperature}
        return self._groups.take(kind, value, batch["time_ns"])
