"""The gap policy: what the navigator gets where samples are missing.

A gap is seen in the sample counter and sized by it and by device time. Up to `interpolate_s` the missing steps are
interpolated between the rate and force before and after; up to `realign_s` they are interpolated too but marked
`BRIDGED`, because nobody knows what happened in between; beyond that nothing is filled and the caller aligns again.
The result depends on the samples alone, never on how they were batched.
"""

from dataclasses import dataclass

import numpy as np

from nav.increments import FloatArray, ImuIncrements, Validity, joined
from nav.kernel import kernel

MAX_FILL = 4096
"""Most steps put into one gap; a longer one gets longer steps."""


@kernel
def rates(
    step: FloatArray, dtheta: FloatArray, dvel: FloatArray, row: int, rate: FloatArray, force: FloatArray
) -> None:
    """Rate and force of a sample."""
    while row >= 0 and step[row] <= 0.0:  # a sample without length has no rate: the one before it counts
        row -= 1
    if row >= 0:
        for i in range(3):
            rate[i], force[i] = dtheta[row, i] / step[row], dvel[row, i] / step[row]


@dataclass(frozen=True, slots=True)
class GapPolicy:
    """Limits of the policy, s; a gap is the time that no sample covers."""

    interpolate_s: float = 0.1
    realign_s: float = 10.0


@dataclass(frozen=True, slots=True)
class Gap:
    """A gap that was met.

    Attributes
    ----------
    row : int
        Row of the result where the filled steps begin (or where the sample after the gap stands).
    time, length_s : float
        Device time of the last sample before, s, and length of the gap, s.
    missing : int
        Samples missing by the counter.
    realign : bool
        Longer than the policy bridges.
    """

    row: int
    time: float
    length_s: float
    missing: int
    realign: bool


class GapFiller:
    """Fills gaps in a stream of batches.

    Attributes
    ----------
    rate, force : (3,) float
        Of the last sample, rad/s and m/s^2.
    """

    def __init__(self, policy: GapPolicy) -> None:
        self.policy = policy
        self._sequence: int | None = None
        self._time = 0.0
        self.rate = np.zeros(3)
        self.force = np.zeros(3)

    @property
    def expected(self) -> int:
        """Number of the sample that comes next; -1 before the first."""
        return -1 if self._sequence is None else self._sequence + 1

    def passed(self, sequence: int, time: float) -> None:
        """The sample that came next needed no filling; `rate` and `force` are told already."""
        self._sequence, self._time = sequence, time

    def fill(self, imu: ImuIncrements) -> tuple[ImuIncrements, list[Gap]]:
        """The batch with its gaps filled; the batch itself where there is none."""
        if len(imu) == 0:
            return imu, []
        before = self._sequence
        last = len(imu) - 1
        first, newest = int(imu.sequence[0]), int(imu.sequence[last])
        follows = before is None or first == before + 1
        result = imu
        gaps: list[Gap] = []
        if not follows or newest - first != last:  # the driver hands samples on in rising order
            jumps = np.flatnonzero(np.diff(imu.sequence) != 1) + 1
            result, gaps = self._filled(imu, jumps if follows else np.concatenate(([0], jumps)))
        self._sequence = newest
        self._time = float(imu.time[last])
        self._keep(imu, last)
        return result, gaps

    def _keep(self, imu: ImuIncrements, row: int) -> None:
        rates(imu.step, imu.dtheta, imu.dvel, row, self.rate, self.force)

    def _filled(self, imu: ImuIncrements, jumps: np.ndarray) -> tuple[ImuIncrements, list[Gap]]:
        parts: list[ImuIncrements] = []
        gaps: list[Gap] = []
        rows = start = 0
        for jump in jumps:
            stop = int(jump)
            if stop > start:
                parts.append(imu.rows(start, stop))
                rows += stop - start
            if stop > 0:
                time, sequence = float(imu.time[stop - 1]), int(imu.sequence[stop - 1])
                self._keep(imu, stop - 1)
            else:
                time, sequence = self._time, self._sequence or 0
            step = float(imu.step[stop])
            length = float(imu.time[stop]) - step - time
            missing = int(imu.sequence[stop]) - sequence - 1
            realign = length > self.policy.realign_s or length < -1e-9 or step <= 0.0
            gaps.append(Gap(rows, time, length, missing, realign))
            if not realign and length > 1e-9:
                bridged = length > self.policy.interpolate_s
                fill = self._interpolated(imu, stop, time, length, sequence, missing, bridged)
                parts.append(fill)
                rows += len(fill)
            start = stop
        parts.append(imu.rows(start, len(imu)))
        return joined(parts), gaps

    def _interpolated(
        self, imu: ImuIncrements, row: int, time: float, length: float, sequence: int, missing: int, bridged: bool
    ) -> ImuIncrements:
        count = min(max(missing, 1), MAX_FILL)
        step = length / count
        after_rate, after_force = imu.dtheta[row] / imu.step[row], imu.dvel[row] / imu.step[row]
        weight = ((np.arange(count) + 0.5) / count)[:, None]
        rate: FloatArray = self.rate * (1.0 - weight) + after_rate * weight
        force: FloatArray = self.force * (1.0 - weight) + after_force * weight
        mark = int(Validity.INTERPOLATED | (Validity.BRIDGED if bridged else Validity.GOOD))
        numbers = sequence + 1 + (np.arange(count) * max(missing, 1)) // count
        return ImuIncrements(
            time + step * np.arange(1.0, count + 1.0),
            np.full(count, step),
            rate * step,
            force * step,
            np.full(count, mark, np.int64),
            numbers,
        )
