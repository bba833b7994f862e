"""Alignment at rest, as a link of the chain: averages in blocks, then analytic (:mod:`nav.alignment.analytic`)."""

import math
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from nav.aiding import Kind
from nav.alignment import rest
from nav.alignment.analytic import Alignment, AlignmentRefused, gyrocompass, level
from nav.alignment.plan import GIVEN_UP, Plan, Start, Word, place_of_sensor
from nav.earth import STANDARD_GRAVITY
from nav.increments import FloatArray, ImuIncrements
from nav.state import Health

GYROCOMPASS_LIMIT = math.radians(1.0)
"""A heading that is found and not given must be known to this, one sigma, rad."""


class AtRest:
    """The ways ``gyrocompass`` and ``level``. Motion starts the averages anew.

    A heading source that sends during the averaging gives ``level`` its heading where none is given: the mean of its rows,
    as sure as the best of them, because their errors may be one and the same.

    Parameters
    ----------
    plan : Plan
        How.
    place : (3,) float
        Where the navigated point stands: lat, lon (rad), height (m).
    """

    def __init__(self, plan: Plan, place: FloatArray) -> None:
        self._plan, self._place = plan, place
        # The noise is what the blocks scatter: around a standing vehicle there is more of it than in the sensors.
        self._sensors = replace(plan.sensors, angle_random_walk=0.0, velocity_random_walk=0.0)
        self._sums, self._towards = np.zeros(rest.SUMS), np.zeros(2)
        self._sigma_heading = math.inf
        self._looked = False
        """The user has been told how the vehicle seems to lie."""

    @property
    def progress(self) -> float:
        """See `Aligner`."""
        return rest.progress(self._sums, self._plan.align_s)

    def aid(self, rows: NDArray[np.void]) -> None:
        """See `Aligner`."""
        for row in rows[rows["kind"] == Kind.HEADING]:
            heading, sigma = float(row["value"][0]), float(row["sigma"][0])
            self._towards += np.array([math.cos(heading), math.sin(heading)]) / sigma**2
            self._sigma_heading = min(self._sigma_heading, sigma)

    def take(self, imu: ImuIncrements, start: int, stop: int) -> tuple[int, Word | None]:
        """See `Aligner`."""
        some = slice(start, stop)
        used, event = rest.accumulate(self._sums, imu.step[some], imu.dtheta[some], imu.dvel[some], self._plan.align_s)
        if event == 3:
            self._anew()
            return used, Word(((Health.MOVING, "alignment waits: the vehicle moves"),))
        return used, self._judged(float(imu.time[start + used - 1]), event == 2) if event else None

    def _anew(self) -> None:
        self._sums[:], self._towards[:], self._sigma_heading = 0.0, 0.0, math.inf

    def _judged(self, time: float, complete: bool) -> Word:
        mean = rest.means(self._sums)
        wrong = rest.gravity_verdict(mean.f)
        complaints = ((Health.UNITS, wrong),) if wrong else ()
        notice = "" if self._looked or wrong else rest.upright_verdict(mean.f) or ""
        self._looked = True
        if not complete:
            return Word(complaints, Health.MOVING, notice)
        try:
            result = self._result(mean)
        except AlignmentRefused as refusal:
            self._anew()
            complaints = complaints or ((Health.RATE_TOO_SMALL, str(refusal)),)
            return Word(complaints, Health.MOVING, notice)
        sigma = np.concatenate([np.zeros(6), np.sqrt(np.diag(result.covariance))])
        place = place_of_sensor(self._place, result.q_nb, self._plan.lever_arm)
        remark = f"{np.linalg.norm(mean.f) / STANDARD_GRAVITY:.3f} g"
        start = Start(time, place, np.zeros(3), result.q_nb, result.gyro_bias, sigma, mean.time_s, remark)
        return Word(complaints, GIVEN_UP, notice, start)

    def _result(self, mean: rest.Means) -> Alignment:
        plan, lat = self._plan, float(self._place[0])
        if plan.way == "gyrocompass":
            return gyrocompass(mean, lat, self._sensors, asked=GYROCOMPASS_LIMIT)
        if plan.heading is not None:
            return level(mean, lat, plan.heading, 0.0, self._sensors)
        if not self._towards.any():
            raise AlignmentRefused(
                "the vertical is known and the heading is not: no heading source has sent; mend it, or give "
                "navigation.start.heading_deg"
            )
        north, east = self._towards
        return level(mean, lat, math.atan2(east, north), self._sigma_heading, self._sensors)
