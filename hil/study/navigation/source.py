"""The method of source 000 as printed, and what explains its first order."""

import math

import numpy as np
from numpy.typing import NDArray

from hil.study.navigation.flights import DURATION_S, flight, fly
from hil.study.report import Line, Plot, Row, near, shown
from hil.world.motion import Motion
from nav.earth import E2, GM, RATE, curvature_radii
from nav.gravitation import NORMAL, gravitation_cartesian
from nav.increments import FloatArray
from nav.strapdown import Strapdown

SOURCE_STEPS_MS = (1, 2, 5, 10)
PUBLISHED_M = {1: 5.5, 10: 55.0}
"""Source 000: largest position error by step in ms; its flight is not given."""


def gravity_lag(motion: Motion, duration: float = DURATION_S, every: float = 0.5) -> tuple[FloatArray, FloatArray]:
    """Position error, per second of step, of a mechanization that takes gravitation at the start of each step.

    Gravitation then lags by half a step: the acceleration is wrong by -(T/2) dg/dt along the flight, seen from inertial
    axes, and the error grows by the gradient of a sphere's gravitation.

    Returns
    -------
    time, error : (n,), (n,) float
        s, and m per s of step.
    """
    time: FloatArray = np.asarray(np.arange(round(duration / every) + 1) * every, np.float64)
    place, g = _inertial_places(motion.truth(time), time)
    lag = -0.5 * np.gradient(g, every, axis=0)
    offset, speed = np.zeros(3), np.zeros(3)
    error = np.zeros(len(time))
    for k in range(len(time) - 1):  # leapfrog: half a kick, a drift, half a kick
        speed = speed + 0.5 * every * (lag[k] + _gradient(place[k], offset))
        offset = offset + every * speed
        speed = speed + 0.5 * every * (lag[k + 1] + _gradient(place[k + 1], offset))
        error[k + 1] = np.linalg.norm(offset)
    return time, error


def _inertial_places(truth: NDArray[np.void], time: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Places and gravitation in inertial axes."""
    place, g = np.empty((len(time), 3)), np.empty((len(time), 3))
    for k, row in enumerate(truth):
        s, c, angle = math.sin(row["lat"]), math.cos(row["lat"]), float(row["lon"]) + RATE * float(time[k])
        prime = curvature_radii(s)[1]
        p = (prime + row["height"]) * c
        place[k] = p * math.cos(angle), p * math.sin(angle), (prime * (1.0 - E2) + row["height"]) * s
        x, y, z = place[k]
        g[k] = gravitation_cartesian(NORMAL, x, y, z, s, c)
    return place, g


def _gradient(place: FloatArray, offset: FloatArray) -> FloatArray:
    r2 = float(place @ place)
    change: FloatArray = -GM / (r2 * math.sqrt(r2)) * (offset - 3.0 * (place @ offset) / r2 * place)
    return change


def source_method() -> tuple[list[Row], list[Plot]]:
    smooth = flight("smooth")
    lag_time, lag = gravity_lag(smooth)
    largest, lines, rows = [], [], []
    for step_ms in SOURCE_STEPS_MS:
        step = 1e-3 * step_ms
        time, errors = fly(smooth, step, {"": Strapdown(mechanization="inertial-source")})
        ours, predicted = errors[""].max(), step * lag.max()
        largest.append(ours)
        lines.append(Line(f"{step_ms} ms", time, errors[""]))
        rows.append(
            near(
                f"source-{step_ms}ms",
                f"smooth flight, {step_ms} ms: inertial-source (reference: from the lag of gravity)",
                ours,
                "m",
                0.1 * predicted,
                reference=predicted,
            )
        )
        if step_ms in PUBLISHED_M:
            published = PUBLISHED_M[step_ms]
            what = f"the same beside the source's figure: {published / ours:.0f} times ours; its flight is not given"
            rows.append(shown(f"source-published-{step_ms}ms", what, ours, "m", published=published))
    agile = fly(flight("agile"), 0.005, {"": Strapdown(mechanization="inertial-source")})[1][""].max()
    lag_agile = 0.005 * gravity_lag(flight("agile"))[1].max()
    what = "agile flight, 5 ms: inertial-source (reference: from the lag of gravity)"
    rows.append(shown("source-agile-5ms", what, agile, "m", reference=lag_agile))
    slope = np.polyfit(np.log(SOURCE_STEPS_MS), np.log(largest), 1)[0]
    rows.append(near("source-order", "inertial-source: order in the step", slope, "1", 0.1, published=1.0))
    lines.append(Line("10 ms, from the lag of gravity", lag_time, 0.01 * lag, "--"))
    return rows, [Plot("source", "Position error of the source's method, smooth flight", "s", "m", lines)]
