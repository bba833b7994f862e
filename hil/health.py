"""What the loop says of the sensor a few times a second, for whoever shows it: one record, no formatting, no waiting."""

import numpy as np
from numpy.typing import NDArray

from drivers.can.frames import FrameArray
from hil.ring import Ring
from nav.increments import FloatArray, HeadIncrements, ImuIncrements
from nav.instruments.head import HeadCombiner
from nav.kernel import kernel

EVERY_S = 0.1
"""Device time between two records."""
HEALTH = np.dtype(
    [
        ("time", "<f8"),  # device time, s
        ("temperature", "<f8", 3),  # gyro 1, gyro 2, accelerometers, degrees Celsius; NaN: not said
        ("spin", "<f8", 2),  # rotor speeds, Hz; NaN: not said
        ("parity_mean", "<f8"),  # parity residual since the last record, rad/s; NaN: none
        ("parity_peak", "<f8"),  # largest of a sample, without sign
        ("faults", "<i8", 7),  # `nav.instruments.redundancy.Fault` of each axis
        ("frames", "<i8"),  # since the start
        ("bytes", "<i8"),  # of data in them
        ("own_truth", "?"),  # the samples are of the scenario's own world
    ]
)


@kernel
def _total(lengths: NDArray[np.uint8]) -> int:
    total = 0
    for k in range(lengths.shape[0]):
        total += lengths[k]
    return total


@kernel
def _add(residual: FloatArray, step: FloatArray, sums: FloatArray) -> None:
    """Add to the sums: residuals (rad), time (s), largest rate (rad/s)."""
    for k in range(residual.shape[0]):
        if step[k] <= 0.0:
            continue
        sums[0] += residual[k]
        sums[1] += step[k]
        sums[2] = max(sums[2], abs(residual[k]) / step[k])


class HealthWriter:
    """Gathers what `HEALTH` holds and pushes a record every `EVERY_S`.

    Parameters
    ----------
    ring : Ring
        Of `HEALTH`.
    combiner : HeadCombiner
        Of the head, read only; its residual and its faults are those of the samples handed to `take`.
    """

    def __init__(self, ring: Ring, combiner: HeadCombiner) -> None:
        self._ring, self._combiner = ring, combiner
        self._row = np.zeros(1, HEALTH)
        self._sums = np.zeros(3)
        self._frames = self._bytes = 0

    def count(self, batch: FrameArray) -> None:
        """Count frames and their data."""
        self._frames += len(batch)
        self._bytes += _total(batch["length"])

    def take(self, raw: HeadIncrements | ImuIncrements, own_truth: bool) -> None:
        """Take samples that have been navigated."""
        row, sums, now = self._row, self._sums, raw.time[-1]
        if isinstance(raw, HeadIncrements):
            _add(self._combiner.residual, raw.step, sums)
        if 0.0 <= now - row["time"][0] < EVERY_S - 1e-6:
            return
        row["time"], row["frames"], row["bytes"], row["own_truth"] = now, self._frames, self._bytes, own_truth
        if isinstance(raw, HeadIncrements):
            row["temperature"], row["spin"], row["faults"] = raw.temperature[-1], raw.spin[-1], self._combiner.faults
        else:
            row["temperature"], row["spin"] = np.nan, np.nan
        row["parity_mean"], row["parity_peak"] = (sums[0] / sums[1], sums[2]) if sums[1] > 0.0 else (np.nan, np.nan)
        sums[:] = 0.0
        self._ring.push(row)
