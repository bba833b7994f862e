"""Alignment at rest from increments: all at once, or as they come, with a result at any time.

Both take the sums of :mod:`nav.alignment.rest`, sample by sample: the result does not depend on how samples were batched.
"""

import math

import numpy as np

from nav.alignment import rest
from nav.alignment.analytic import BLOCKS, Alignment, AlignmentRefused, Form, cosines, gyrocompass
from nav.alignment.rest import UNSTATED, Sensors
from nav.increments import ImuIncrements


class RestAlignment:
    """Gyrocompassing that goes on averaging.

    Parameters
    ----------
    lat, sensors, form, asked
        As in :func:`nav.alignment.analytic.gyrocompass`.
    """

    def __init__(self, lat: float, sensors: Sensors = UNSTATED, form: Form = cosines, asked: float = math.inf) -> None:
        self._how = lat, sensors, form, asked
        self._sums = np.zeros(rest.SUMS)
        self.moved: float | None = None
        """Device time of the last motion, s: averages have started anew there."""

    def add(self, imu: ImuIncrements) -> None:
        """Take samples, one or many.

        Raises
        ------
        AlignmentRefused
            An increment is not finite; nothing is taken then.
        """
        bad = imu.first_bad()
        if bad >= 0:
            raise AlignmentRefused(f"increment {int(imu.sequence[bad])} is not a number: mend the driver or the file")
        start = 0
        while start < len(imu):
            used, event = rest.accumulate(self._sums, imu.step[start:], imu.dtheta[start:], imu.dvel[start:], math.inf)
            start += used
            if event == 3:
                self.moved = float(imu.time[start - 1])

    def result(self) -> Alignment:
        """The alignment from all complete blocks since the last motion.

        Raises
        ------
        AlignmentRefused
            As :func:`nav.alignment.analytic.gyrocompass`, and when no noise is stated and the blocks are too few to show it.
        """
        sensors = self._how[1]
        stated = sensors.angle_random_walk > 0.0 and sensors.velocity_random_walk > 0.0
        needed = 1 if stated else BLOCKS
        blocks = rest.blocks(self._sums)
        if blocks < needed:
            since = "" if self.moved is None else f" since the motion at {self.moved:.3f} s"
            raise AlignmentRefused(
                f"averaging is too short: {blocks} blocks of {rest.BLOCK_S:g} s{since}; stand still for "
                f"{needed * rest.BLOCK_S:g} s" + ("" if stated else ", or state the noise of the sensors")
            )
        return gyrocompass(rest.means(self._sums), *self._how)


def align_at_rest(
    imu: ImuIncrements, lat: float, sensors: Sensors = UNSTATED, form: Form = cosines, asked: float = math.inf
) -> Alignment:
    """Gyrocompassing of a whole record.

    Parameters
    ----------
    imu : ImuIncrements
        The record, at rest from end to end.
    lat, sensors, form, asked
        As in :func:`nav.alignment.analytic.gyrocompass`.

    Raises
    ------
    AlignmentRefused
        As :meth:`RestAlignment.result`, and when the vehicle moved during the record.
    """
    averaging = RestAlignment(lat, sensors, form, asked)
    averaging.add(imu)
    if averaging.moved is not None:
        raise AlignmentRefused(
            f"the vehicle moved during the averaging, last before {averaging.moved:.3f} s: cut the record to where it stands"
        )
    return averaging.result()
