"""What a solution is compared with while it runs: the truth of a simulated world, or another estimator's attitude from a log."""

import numpy as np
from numpy.typing import NDArray

from hil.bridge import LoopOrder
from hil.geometry import position_error
from hil.reference import interpolate_attitude
from hil.world.motion import Motion
from nav.errors import HilError
from nav.increments import FloatArray
from nav.rotation import attitude_error, euler_from_quaternion
from nav.state import Mode


class Comparison:
    """Truth or reference at the time of a solution, computed from the scenario or the log: the loop has no work with it."""

    def __init__(self, order: LoopOrder) -> None:
        self._motion = Motion(order.scenario.motion)
        self._motion.truth([0.0])
        self._reference = order.reference

    def of(self, rows: NDArray[np.void], *, own_world: bool) -> tuple[FloatArray | None, FloatArray | None]:
        """What the newest solution should be, and by how much it is not.

        Parameters
        ----------
        rows : (1,) array of NAV_STATE
            The solution.
        own_world : bool
            Its samples are of the scenario's own world.

        Returns
        -------
        angles : (3,) float or None
            Heading, pitch, roll of truth or reference, degrees; None: neither is known.
        errors : (9,) float or None
            Ours less the true position (m), velocity (m/s) and attitude (degrees), each north, east, down; NaN where not
            known; None before the alignment is complete.
        """
        row, errors = rows[0], np.full(9, np.nan)
        reference, time = self._reference, rows["time"]
        if own_world:
            try:
                truth = self._motion.truth(time)
            except HilError:  # the path has crossed a pole
                return None, None
            q_true = truth["q_nb"][0]
            errors[:3] = position_error(rows["lat"], rows["lon"], rows["height"], truth)[0]
            errors[3:6] = row["vel_n"] - truth["vel_n"][0]
        elif reference is not None and reference.time[0] <= time[0] <= reference.time[-1]:
            q_true = interpolate_attitude(reference.time, reference.q_nb, time)[0]
        else:
            return None, None
        if row["mode"] < Mode.NAVIGATE:
            return angles_deg(q_true), None
        errors[6:] = np.degrees(attitude_error(row["q_nb"], q_true))
        return angles_deg(q_true), errors


def angles_deg(q_nb: FloatArray) -> FloatArray:
    """Heading, pitch, roll (3,), degrees."""
    angles: FloatArray = np.degrees(euler_from_quaternion(q_nb))
    return angles
