"""Coarse by optimisation, then fine by the filter: at a mooring, whose place is all that is measured, and in flight."""

import numpy as np
from numpy.typing import NDArray

from hil.study.alignment.records import FIX_S, STEP, fixes, ideal, sensed, sensors
from hil.study.alignment.standing import (
    DEG,
    HEIGHT_M,
    LAT_DEG,
    LOOK_S,
    SWAY_M,
    Answers,
    answers,
    asked,
    curves,
    described,
    ship,
)
from hil.study.navigation.flights import flight
from hil.study.report import Plot, Row
from hil.world.motion import Motion
from nav.alignment.analytic import Alignment
from nav.alignment.optimization import MotionAlignment, mooring
from nav.filter.aided import AidedNavigator, Settings
from nav.filter.states import GYRO_BIAS, SENSOR_BLOCKS, tuning
from nav.increments import FloatArray, ImuIncrements
from nav.instruments.axis_drift import axis_variances, body_drift
from nav.instruments.grades import GRADES
from nav.instruments.gyro_errors import DTG_HEAD
from nav.strapdown import Strapdown

COARSE_S = 60.0
"""From here on the filter goes on."""
RATIO = 0.75
"""The filter's sigma may be so far from the rms: gravity's drift in turns and flicker are white noise and random walks to it."""
LEAST_SIGMA = np.array([5.0, 5.0, 5.0, 0.05, 0.05, 0.05, *np.radians([0.01, 0.01, 0.2])])
"""Of the filter's start. The bias is in the coarse heading already; a sigma that much larger keeps it from counting twice."""


def _filter(name: str) -> AidedNavigator:
    grade = GRADES[name]
    belief = tuning(grade, SENSOR_BLOCKS, bias_removed=True)
    if grade.gyro_channels == DTG_HEAD:
        belief.sigma[GYRO_BIAS] = body_drift(axis_variances(grade, np.eye(3), bias_removed=True), np.eye(3), 0.0)
    return AidedNavigator(Strapdown("two-sample", "wander"), belief, Settings(predict_s=0.1, buffer_s=1.0))


def refined(
    name: str, imu: ImuIncrements, rows: NDArray[np.void], place: FloatArray
) -> tuple[FloatArray, list[Alignment | str]]:
    """Times and answers every `LOOK_S`: until `COARSE_S` by optimisation, from then on by the filter.

    `place` (3,) is where the filter begins, rad and m; the velocity is that of the coarse alignment.
    """
    found, filtered = MotionAlignment(sensors(GRADES[name])), _filter(name)
    times, results, started = [], list[Alignment | str](), False
    stride, last = round(LOOK_S / STEP), -np.inf
    for first in range(0, len(imu), stride):
        some = imu.rows(first, first + stride)
        time = float(some.time[-1])
        new = rows[(rows["time"] > last) & (rows["time"] <= time + 1e-9)]
        last = time + 1e-9
        if started:
            filtered.aid(new)
            filtered.process(some)
            results.append(_answer(filtered))
        else:
            found.add(some, new)
            result = asked(found.result)
            results.append(result)
            if time > COARSE_S - 1e-9 and isinstance(result, Alignment):
                vel_n, sigma_velocity = found.velocity(result)
                attitude = np.sqrt(np.diag(result.covariance))
                sigma = np.maximum(LEAST_SIGMA, [0.0, 0.0, 0.0, *[sigma_velocity] * 3, *attitude])
                where = place if np.isinf(rows["sigma"][0, 3:]).any() else new[-1]["value"][:3]
                lat, lon, height = (float(value) for value in where)
                filtered.start(time, lat, lon, height, vel_n, result.q_nb, sigma)
                started = True
        times.append(time)
    return np.array(times), results


def _answer(filtered: AidedNavigator) -> Alignment:
    return Alignment(filtered.solution[6:10], filtered.estimates[GYRO_BIAS].copy(), np.diag(filtered.sigma[6:9] ** 2))


def _truth(motion: Motion, times: FloatArray) -> FloatArray:
    attitudes: FloatArray = motion.truth(times)["q_nb"]
    return attitudes


def moored(name: str, seeds: int, duration: float) -> Answers:
    """The ship at its mooring, each run at a heading of its own."""

    def one(seed: int) -> tuple[FloatArray, list[Alignment | str], FloatArray]:
        motion = Motion(ship(360.0 * (seed + 0.5) / seeds))
        imu = sensed(ideal(motion, duration), GRADES[name], seed)
        rows = mooring(imu, LAT_DEG * DEG, HEIGHT_M, SWAY_M)
        times, results = refined(name, imu, rows, np.array([LAT_DEG * DEG, 0.0, HEIGHT_M]))
        return times, results, _truth(motion, times)

    return answers(seeds, one)


def flown_on(name: str, seeds: int, duration: float) -> Answers:
    """The built-in flight with GNSS."""
    motion, grade = flight("smooth"), GRADES[name]
    true = ideal(motion, duration)
    truth: NDArray[np.void] = motion.truth(FIX_S * np.arange(1, round(duration / FIX_S) + 1))

    def one(seed: int) -> tuple[FloatArray, list[Alignment | str], FloatArray]:
        imu, rows = sensed(true, grade, seed), fixes(truth, np.random.default_rng([seed, 6]))
        times, results = refined(name, imu, rows, np.zeros(3))
        return times, results, _truth(motion, times)

    return answers(seeds, one)


def fine(seeds: int, duration: float, flight_s: float) -> tuple[list[Row], list[Plot]]:
    """All of it: the head at a mooring, every grade in flight."""
    ship_words = f"{GRADES['dtg'].name}, swaying, coarse {COARSE_S:g} s, then filter to {duration:g} s, {seeds} runs"
    at_mooring = moored("dtg", seeds, duration)
    rows = described("fine-sway-dtg", ship_words, at_mooring, ratio=RATIO)
    found = {name: flown_on(name, seeds, flight_s) for name in GRADES}
    for name, one in found.items():
        words = f"{GRADES[name].name}, in flight, coarse {COARSE_S:g} s, then filter to {flight_s:g} s, {seeds} runs"
        rows += described(f"fine-flight-{name}", words, one, ratio=RATIO)
    title = "Heading, coarse by optimisation and fine by the filter"
    return rows, [curves("fine", title, {"swaying, dtg": at_mooring, **found})]
