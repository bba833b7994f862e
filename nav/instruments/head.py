"""From the raw increments of a dual-DTG head to increments of one IMU in body axes.

The instrument is taken as ideal: rates as they are, the two y axes averaged, head axes turned into body axes. Lag
compensation and parity have their seat here, before the combination.
"""

import numpy as np

from nav.increments import FloatArray, HeadIncrements, ImuIncrements
from nav.kernel import kernel


@kernel
def _combine(
    head_dtheta: FloatArray, head_dvel: FloatArray, c_bh: FloatArray, dtheta: FloatArray, dvel: FloatArray
) -> None:
    for k in range(head_dtheta.shape[0]):
        x, y = head_dtheta[k, 0], 0.5 * (head_dtheta[k, 1] + head_dtheta[k, 2])
        z = head_dtheta[k, 3]
        u, v, w = head_dvel[k, 0], head_dvel[k, 1], head_dvel[k, 2]
        for i in range(3):
            dtheta[k, i] = c_bh[i, 0] * x + c_bh[i, 1] * y + c_bh[i, 2] * z
            dvel[k, i] = c_bh[i, 0] * u + c_bh[i, 1] * v + c_bh[i, 2] * w


class HeadCombiner:
    """Turns `HeadIncrements` into `ImuIncrements`.

    Parameters
    ----------
    c_bh : (3, 3) float
        Mounting: takes head axes to body axes.
    """

    def __init__(self, c_bh: FloatArray) -> None:
        self._c_bh = np.ascontiguousarray(c_bh, dtype=float)
        self._imu = ImuIncrements.empty(256)

    def combine(self, head: HeadIncrements) -> ImuIncrements:
        """The batch in body axes; valid until the next call."""
        n = len(head)
        if n > len(self._imu):
            self._imu = ImuIncrements.empty(2 * n)
        dtheta, dvel = self._imu.dtheta[:n], self._imu.dvel[:n]
        _combine(head.dtheta, head.dvel, self._c_bh, dtheta, dvel)
        return ImuIncrements(head.time, head.step, dtheta, dvel, head.validity, head.sequence)
