"""The other end of the wire: turns increments into the frames that a dual-DTG head sends, FD or classic.

Used by the simulated head and by the player of foreign recordings. What the wire cannot carry of an increment (its
quantisation residue) is carried to the next sample, so that rounding adds no bias.
"""

from typing import Literal

import numpy as np

from drivers.can.dtg_head import CLASSIC, PROTOCOL, ROTOR_VALID, SLOW, head_database
from drivers.can.frames import BRS, FDF, FrameArray, frames
from drivers.can.integrity import Protection, protection
from nav.errors import HilError
from nav.increments import FloatArray, IntArray
from nav.kernel import kernel

SIMULATED, REPLAY = 1, 2
"""Values of `hardware` in HEAD_IDENTITY."""
ANGLE_LSB = 2.0**-32
VELOCITY_LSB = {"fd": 2.0**-26, "classic": 2.0**-22}
VELOCITY_BITS = {"fd": 32, "classic": 24}


@kernel
def _quantise(values: FloatArray, lsb: float, bits: int, residue: FloatArray, out: IntArray) -> int:
    """Round `values` (n, m) to multiples of `lsb`, carrying `residue` (m,); the first row out of range, or -1."""
    limit = 2.0 ** (bits - 1)
    for k in range(values.shape[0]):
        for i in range(values.shape[1]):
            exact = values[k, i] / lsb + residue[i]
            rounded = np.rint(exact)
            if not -limit <= rounded < limit:
                return k
            residue[i] = exact - rounded
            out[k, i] = np.int64(rounded)
    return -1


def _rounded(angle: FloatArray) -> IntArray:
    """Rotor angles in LSB, held at the ends of the range: a rotor on its stops."""
    return np.clip(np.rint(angle / ANGLE_LSB), -(2.0**31), 2.0**31 - 1.0).astype(np.int64)


class HeadEncoder:
    """Frames of one head; remembers counters and residues.

    Parameters
    ----------
    layout : {"fd", "classic"}
        One 64-byte FD frame a sample, or six classic frames.
    period_us : int
        Nominal sample period that the head announces.
    serial, world_id, hardware : int
        What HEAD_IDENTITY and HEAD_CONFIG say.
    rotor_hz : float
        Rotor speeds that HEAD_ROTOR says.
    """

    def __init__(
        self,
        layout: Literal["fd", "classic"],
        period_us: int,
        *,
        serial: int = 1,
        world_id: int = 0,
        hardware: int = SIMULATED,
        rotor_hz: float = 228.0,
    ) -> None:
        if not 0 < period_us < 1 << 16:
            raise HilError(f"the head's sample period must be 1..65535 us, not {period_us}")
        self._layout: Literal["fd", "classic"] = layout
        database = head_database()
        names = ("HEAD_SAMPLE",) if layout == "fd" else CLASSIC
        self._codecs = [database[name] for name in names]
        self._slow = [database[name] for name in SLOW]
        self._protection: dict[str, Protection] = {}
        for codec in (*self._codecs, *self._slow):
            declared = protection(codec)
            if declared is None:
                raise HilError(f"dtg_head.dbc: message {codec.name} has no E2EProfile")
            self._protection[codec.name] = declared
        self._said: dict[str, dict[str, float]] = {
            "HEAD_IDENTITY": {"serial": serial, "protocol": PROTOCOL, "hardware": hardware},
            "HEAD_CONFIG": {"world_id": world_id, "sample_period": period_us},
            "HEAD_TEMPERATURE": {"temperature_g1": 40.0, "temperature_g2": 40.0, "temperature_acc": 35.0},
            "HEAD_ROTOR": {"rotor_speed_g1": rotor_hz, "rotor_speed_g2": rotor_hz, "supply": 27.0},
            "HEAD_BIT": {},
        }
        self._slow_count = 0
        self._angle_residue = np.zeros(4)
        self._velocity_residue = np.zeros(3)

    def samples(
        self,
        counter: IntArray,
        time_us: IntArray,
        dtheta: FloatArray,
        dvel: FloatArray,
        status: IntArray | int = 0,
        rotor: FloatArray | None = None,
    ) -> FrameArray:
        """Frames of n samples, in the order in which a head sends them.

        Parameters
        ----------
        counter, time_us : (n,) int
            Sample counter and device time at the sample's end; wrapped to 32 bits here.
        dtheta : (n, 4) float
            Increments of g1x, g1y, g2y, g2z, rad.
        dvel : (n, 3) float
            Increments of x, y, z, m/s.
        status : (n,) int
            Status bits; whether rotor angles are there is added.
        rotor : (n, 4) float, optional
            Rotor angles of the same axes at the end of each sample, rad; not carried by the classic layout.

        Raises
        ------
        HilError
            An increment does not fit the wire.
        """
        angles, velocities = np.empty((len(counter), 4), np.int64), np.empty((len(counter), 3), np.int64)
        bits = VELOCITY_BITS[self._layout]
        bad = _quantise(dtheta, ANGLE_LSB, 32, self._angle_residue, angles)
        if bad < 0:
            bad = _quantise(dvel, VELOCITY_LSB[self._layout], bits, self._velocity_residue, velocities)
        if bad >= 0:
            raise HilError(f"sample {int(counter[bad])}: an increment is too large for the {self._layout} layout")
        raw: dict[str, IntArray | int] = {
            "sample_counter": counter & 0xFFFFFFFF,
            "device_time": time_us & 0xFFFFFFFF,
            "protocol": PROTOCOL,
            "status": status | ROTOR_VALID if rotor is not None and self._layout == "fd" else status,
        }
        for i, axis in enumerate(("g1x", "g1y", "g2y", "g2z")):
            raw[f"dtheta_{axis}"] = angles[:, i]
            if rotor is not None:
                raw[f"rotor_{axis}"] = _rounded(rotor[:, i])
        for i, axis in enumerate("xyz"):
            raw[f"dvel_{axis}"] = velocities[:, i]
            raw[f"dvel_{axis}_lo"] = velocities[:, i] & 0xFFFF
            raw[f"dvel_{axis}_hi"] = velocities[:, i] >> 16
        n, parts = len(counter), len(self._codecs)
        batch = frames(n * parts)
        for k, codec in enumerate(self._codecs):
            values = np.zeros((n, len(codec.signals)), np.int64)
            for name, column in codec.columns.items():
                if name in raw:
                    values[:, column] = raw[name]
            data = codec.encode_raw(values, np.zeros((n, codec.length), np.uint8))
            self._protection[codec.name].protect(data, counter)
            rows = batch[k::parts]
            rows["can_id"], rows["length"] = codec.can_id, codec.length
            rows["flags"] = FDF | BRS if codec.is_fd else 0
            rows["data"][:, : codec.length] = data
        return batch

    def slow(self) -> FrameArray:
        """One set of the slow frames: identity, configuration, temperatures, rotor speeds, built-in test."""
        batch = frames(len(self._slow))
        for row, codec in zip(batch, self._slow, strict=True):
            data = np.frombuffer(codec.pack(self._said[codec.name]), np.uint8)[None, :].copy()
            self._protection[codec.name].protect(data, np.array([self._slow_count]))
            row["can_id"], row["length"] = codec.can_id, codec.length
            row["data"][: codec.length] = data[0]
        self._slow_count += 1
        return batch
