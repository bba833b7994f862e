"""Alignment in flight with GNSS, one epoch of four antennas, and the tracking correction against free inertial."""

import math
import os
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hil.geometry import attitude_difference, position_error
from hil.study.alignment.records import (
    FIX_S,
    PHASE_M,
    STEP,
    fixes,
    four_antennas,
    ideal,
    sensed,
    sensors,
    sky,
)
from hil.study.alignment.standing import DEG, LOOK_S, Answers, answers, asked, curves, described
from hil.study.navigation.flights import flight
from hil.study.report import Line, Plot, Row, at_most, near, shown
from hil.world.motion import TRUTH
from nav.alignment.analytic import Alignment
from nav.alignment.optimization import MotionAlignment
from nav.filter.gnss_attitude import start_from_epoch
from nav.filter.tracking import Tracking
from nav.filter.tracking_gains import Gains
from nav.increments import FloatArray, ImuIncrements
from nav.instruments.grades import GRADES
from nav.rotation import attitude_error, quaternion_from_euler
from nav.strapdown import Strapdown

SETTLED_S = 100.0
"""The tracking correction is judged from here on: five of its time constants."""
CONSTANTS_S = (10.0, 20.0, 40.0)
DRAWN = 1000
PARTS, UNITS, SCALES = ("tilt", "heading", "velocity", "position"), ("deg", "deg", "m/s", "m"), (DEG, DEG, 1.0, 1.0)


def in_flight(name: str, seeds: int, duration: float) -> Answers:
    """Alignments in the built-in flight, a GNSS fix every `FIX_S`."""
    motion, grade = flight("smooth"), GRADES[name]
    true = ideal(motion, duration)
    truth = motion.truth(FIX_S * np.arange(1, round(duration / FIX_S) + 1))

    def one(seed: int) -> tuple[FloatArray, list[Alignment | str], FloatArray]:
        imu, rows = sensed(true, grade, seed), fixes(truth, np.random.default_rng([seed, 6]))
        found = MotionAlignment(sensors(grade))
        results: list[Alignment | str] = []
        stride, looks = round(LOOK_S / STEP), round(LOOK_S / FIX_S)
        for k in range(len(imu) // stride):
            found.add(imu.rows(k * stride, (k + 1) * stride), rows[k * looks : (k + 1) * looks])
            results.append(asked(found.result))
        ends = truth[looks - 1 :: looks]
        return ends["time"], results, ends["q_nb"]

    return answers(seeds, one)


def epochs(count: int) -> tuple[FloatArray, FloatArray]:
    """Errors (count, 3), rad, of attitudes by four antennas at places and attitudes of all kinds, and their covariances."""
    errors, covariances = np.empty((count, 3)), np.empty((count, 3, 3))
    rng = np.random.default_rng(7)
    true = np.zeros(1, TRUTH)
    for k in range(count):
        true["lat"], true["lon"] = math.asin(rng.uniform(-1.0, 1.0)), rng.uniform(-math.pi, math.pi)
        true["q_nb"] = quaternion_from_euler(*rng.uniform(-1.0, 1.0, 3))
        q_nb, covariances[k] = four_antennas(true[0], sky(rng), rng).level(float(true["lat"][0]), float(true["lon"][0]))
        errors[k] = attitude_error(q_nb, true["q_nb"][0])
    return errors, covariances


@dataclass(frozen=True, slots=True)
class Flown:
    """Errors of one run at the times of the fixes.

    Attributes
    ----------
    time : (m,) float
        s.
    errors : (m, 4) float
        Tilt and heading, rad; velocity and position, 3-D, m/s and m.
    """

    time: FloatArray
    errors: FloatArray


def flown(imu: ImuIncrements, truth: NDArray[np.void], seed: int, constant: float | None) -> Flown:
    """Fly from one epoch of GNSS; then free, or tracked with the time constant, s. `truth`: start, then every fix."""
    rng = np.random.default_rng([seed, 8])
    stars, rows = sky(rng), fixes(truth, rng)
    core, first = Strapdown("two-sample", "wander"), rows[0]["value"]
    lat, lon, height = (float(value) for value in first[:3])
    start_from_epoch(core, lat, lon, height, first[3:], four_antennas(truth[0], stars, rng))
    tracking = None if constant is None else Tracking(core, Gains(constant, constant, constant, constant), 0.0)
    stride = round(FIX_S / STEP)
    out = np.empty((stride, 3)), np.empty((stride, 3)), np.empty((stride, 4))
    solved = np.empty((len(rows) - 1, 10))
    for k, (row, true) in enumerate(zip(rows[1:], truth[1:], strict=True)):
        some = slice(k * stride, (k + 1) * stride)
        core.advance(imu.step[some], imu.dtheta[some], imu.dvel[some], np.zeros(3), *out)
        if tracking is not None:
            place = float(row["value"][0]), float(row["value"][1])
            tracking.take(row)
            tracking.take(four_antennas(true, stars, rng).row(float(row["time"]), *place))
        solved[k] = core.solution
    _, tilt, heading = attitude_difference(solved[:, 6:], truth["q_nb"][1:])
    lats, lons, heights = np.ascontiguousarray(solved[:, :3].T)
    way = np.linalg.norm(position_error(lats, lons, heights, truth[1:]), axis=1)
    speed = np.linalg.norm(solved[:, 3:6] - truth["vel_n"][1:], axis=1)
    return Flown(truth["time"][1:], np.stack([tilt, heading, speed, way], axis=1))


def tracked(seeds: int, duration: float) -> tuple[list[Row], list[Plot]]:
    """The tracking correction, grade by grade."""
    motion = flight("smooth")
    true, truth = ideal(motion, duration), motion.truth(FIX_S * np.arange(round(duration / FIX_S) + 1))
    rows: list[Row] = []
    plots: list[Plot] = []
    for name, grade in GRADES.items():
        lines: list[Line] = []
        free = np.zeros(4)
        records = [sensed(true, grade, seed) for seed in range(seeds)]
        for constant in (None, *CONSTANTS_S):
            with ThreadPoolExecutor(os.cpu_count()) as pool:
                runs = list(pool.map(lambda s, c=constant, r=records: flown(r[s], truth, s, c), range(seeds)))
            settled = runs[0].time >= min(SETTLED_S, 0.5 * duration)
            errors = np.array([run.errors for run in runs])
            rms = np.sqrt((errors[:, settled] ** 2).mean(axis=(0, 1)))
            key = f"{'free' if constant is None else f'track-{constant:g}'}-{name}"
            how = "free inertial" if constant is None else f"tracking, 1/K = {constant:g} s"
            what = f"{grade.name}, flight with turns, {how}, {seeds} runs"
            for part, value, unit, alone in zip(PARTS, rms / SCALES, UNITS, free, strict=True):
                words = f"{what}: {part}, rms"
                if constant is None:
                    rows.append(shown(f"{key}-{part}", words, value, unit))
                else:
                    limits = {"limit": alone, "reference": alone}
                    rows.append(at_most(f"{key}-{part}", f"{words} (reference: free inertial)", value, unit, **limits))
            if constant is None:
                free = rms / SCALES
            lines.append(Line(how, runs[0].time, np.sqrt((errors[:, :, 1] ** 2).mean(axis=0)) / DEG))
        plots.append(Plot(f"track-{name}", f"Heading, {grade.name}: fixed gains and free inertial", "s", "deg", lines))
    return rows, plots


def flying(seeds: int, duration: float, flight_s: float, runs: int) -> tuple[list[Row], list[Plot]]:
    """All of it."""
    rows: list[Row] = []
    found = {name: in_flight(name, seeds, duration) for name in GRADES}
    for name, one in found.items():
        what = f"{GRADES[name].name}, in flight with GNSS, {duration:g} s, {seeds} runs"
        rows += described(f"flight-{name}", what, one, ratio=4.0 / math.sqrt(2.0 * seeds))
    plots = [curves("flight", "Heading of the alignment in flight with turns", found)]
    errors, covariances = epochs(DRAWN)
    distance = np.einsum("ki,kij,kj->k", errors, np.linalg.inv(covariances), errors).mean() / 3.0
    what = f"four antennas, 2 m, {PHASE_M * 1e3:g} mm, {DRAWN} epochs"
    rows.append(near("epoch-ratio", f"{what}: mean of e P^-1 e / 3", distance, "1", 0.1, reference=1.0))
    sigma = np.sqrt(np.einsum("kii->ki", covariances).mean(axis=0)) / DEG
    for axis, mine, theirs in zip(
        ("north", "east", "down"), np.sqrt((errors**2).mean(axis=0)) / DEG, sigma, strict=True
    ):
        words = f"{what}: rms about {axis} (reference: geometry)"
        rows.append(near(f"epoch-{axis}", words, mine, "deg", 0.1 * theirs, reference=theirs))
    more_rows, more_plots = tracked(runs, flight_s)
    return rows + more_rows, plots + more_plots
