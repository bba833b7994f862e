"""The feedback filter of pyins on the same flights, with the same belief, beside ours; rows only where pyins is installed.

Both estimate 27 states: position, velocity, attitude, biases, scale factors, misalignment of the gyros.
"""

import math
import time
from importlib import import_module
from importlib.util import find_spec
from typing import Any

import numpy as np

from hil.study.report import Row, shown
from hil.study.tracking.flights import Flight, fly
from hil.study.tracking.ways import PREDICT_S, STRIDE, filtered
from nav.filter.states import (
    ACCELEROMETER_BIAS,
    ACCELEROMETER_SCALE,
    GYRO_BIAS,
    GYRO_MISALIGNMENT,
    GYRO_SCALE,
    Tuning,
    tuning,
)
from nav.increments import FloatArray
from nav.instruments.grades import GRADES
from nav.rotation import euler_from_quaternion, quaternion_from_euler

PARTS = (("tilt", "deg"), ("heading", "deg"), ("velocity", "m/s"), ("position", "m"))
_UNITS = np.array([math.pi / 180.0, math.pi / 180.0, 1.0, 1.0])


def rows(length: float) -> list[Row]:
    """Errors and times of both filters, GNSS alone, a flight with turns of `length` s, judged from its middle on."""
    if find_spec("pyins") is None or find_spec("pandas") is None:
        return []
    found: list[Row] = []
    for name, grade in GRADES.items():
        belief, squares, cost = tuning(grade, bias_removed=True), np.zeros((2, 4)), np.zeros(2)
        flight = fly("turns", grade, 0, length, None, wandering=False)
        late = flight.truth["time"][1:] >= 0.5 * length
        for k, solve in enumerate((_ours, feedback)):
            began = time.thread_time()
            solved = solve(flight, belief)
            cost[k] = time.thread_time() - began
            squares[k] = (flight.errors(solved)[late] ** 2).mean(axis=0)
        ours, theirs = np.sqrt(squares) / _UNITS
        where = f"{grade.name}, turns, one run of {length:g} s, GNSS alone, 27 states"
        for (part, unit), mine, other in zip(PARTS, ours, theirs, strict=True):
            words = f"{where}: {part}, rms (reference: pyins)"
            found.append(shown(f"pyins-{name}-{part}", words, mine, unit, reference=other))
        mine, other = 1e6 * cost / (STRIDE * len(late))
        found.append(
            shown(
                f"pyins-{name}-time",
                f"{where}: processor time a sample (reference: pyins)",
                mine,
                "us",
                reference=other,
            )
        )
    return found


def _ours(flight: Flight, belief: Tuning) -> FloatArray:
    return filtered(flight, belief, antennas=False)


def feedback(flight: Flight, belief: Tuning) -> FloatArray:
    """Solutions (n - 1, 10) at the fixes by ``pyins.filters.run_feedback_filter``."""
    pandas, util = import_module("pandas"), import_module("pyins.util")
    filters, measurements, strapdown, sensor = (
        import_module(f"pyins.{name}") for name in ("filters", "measurements", "strapdown", "inertial_sensor")
    )

    def table(values: FloatArray, times: FloatArray, columns: list[str]) -> Any:
        return pandas.DataFrame(values, pandas.Index(np.round(times, 6), name="time"), columns)

    first, fixes, imu = flight.fixes[0], flight.fixes[1:][flight.heard[1:]], flight.imu
    q_nb, covariance = flight.start.level(float(first["value"][0]), float(first["value"][1]))
    place = np.array([*first["value"], *euler_from_quaternion(q_nb)[::-1]])
    degrees = np.where(np.isin(np.arange(9), [2, 3, 4, 5]), 1.0, 180.0 / math.pi)
    start = pandas.Series(degrees * place, util.TRAJECTORY_COLS, name=0.0)
    data = np.hstack([imu.dtheta, imu.dvel])
    readings = table(np.vstack([data[:1], data]), np.append(0.0, imu.time), [*util.GYRO_COLS, *util.ACCEL_COLS])
    measured = table(degrees[:6] * fixes["value"], fixes["time"], [*util.LLA_COLS, *util.VEL_COLS])
    position, velocity = measurements.Position(measured, 1.0), measurements.NedVelocity(measured, 1.0)
    position.R, velocity.R = np.diag(first["sigma"][:3] ** 2), np.diag(first["sigma"][3:] ** 2)
    sigma = first["sigma"][0], first["sigma"][3], *np.degrees(np.sqrt(np.diag(covariance)))[1:]
    result = filters.run_feedback_filter(
        start,
        *sigma,
        strapdown.compute_increments_from_imu(readings, "increment"),
        *_models(belief, sensor),
        [position, velocity],
        time_step=PREDICT_S,
    )
    found = result.trajectory.loc[np.round(flight.truth["time"][1:], 6)].to_numpy() / degrees
    attitudes = [quaternion_from_euler(*angles) for angles in found[:, 8:5:-1].tolist()]
    return np.hstack([found[:, :6], attitudes])


def _models(belief: Tuning, sensor: Any) -> tuple[Any, Any]:
    """What pyins estimates of gyros and accelerometers."""
    turned = np.diag(belief.sigma[GYRO_SCALE])
    for i, (one, other) in enumerate(belief.sigma[GYRO_MISALIGNMENT].reshape(3, 2)):
        turned[i, (i + 1) % 3], turned[i, (i + 2) % 3] = one, other
    gyros = belief.sigma[GYRO_BIAS], belief.white[:3], belief.walk[GYRO_BIAS], turned
    scale = np.diag(belief.sigma[ACCELEROMETER_SCALE])
    forces = belief.sigma[ACCELEROMETER_BIAS], belief.white[3:], belief.walk[ACCELEROMETER_BIAS], scale
    return sensor.EstimationModel(*gyros), sensor.EstimationModel(*forces)
