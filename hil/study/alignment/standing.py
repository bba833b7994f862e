"""Alignment at rest and on a swaying base, grade by grade, beside its theory."""

import math
import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np

from hil.scenario import Channel, MotionConfig, Sine
from hil.study.alignment.records import ideal, sensed, sensors
from hil.study.report import Line, Plot, Row, at_most, near, shown
from hil.world.motion import Motion
from nav.alignment.analytic import Alignment, AlignmentRefused
from nav.alignment.optimization import MotionAlignment, mooring
from nav.alignment.recursive import RestAlignment
from nav.earth import RATE
from nav.increments import FloatArray, ImuIncrements
from nav.instruments.grades import GRADES
from nav.instruments.sources import combination
from nav.rotation import attitude_error

LAT_DEG, HEIGHT_M, SWAY_M = 50.0, 20.0, 0.3
LOOK_S = 10.0
"""Between answers."""
ASKED_DEG = 0.1
DEG = math.pi / 180.0


@dataclass(frozen=True, slots=True)
class Answers:
    """Answers of some runs over time.

    Attributes
    ----------
    time : (m,) float
        s.
    errors, sigmas : (seeds, m, 2) float
        Tilt (both axes together) and heading, rad; NaN where the answer was refused.
    reasons : tuple of str
        Last refusal of each run; empty where the last answer was given.
    """

    time: FloatArray
    errors: FloatArray
    sigmas: FloatArray
    reasons: tuple[str, ...]

    def rms(self) -> FloatArray:
        """(m, 2) of the runs that answer."""
        return _rms(self.errors)

    def sigma(self) -> FloatArray:
        """(m, 2): root of their mean variance."""
        return _rms(self.sigmas)

    def reached(self, values: FloatArray) -> float:
        """Time from which the heading's `values` (m, 2) stay below `ASKED_DEG`, s; infinite for never."""
        late = np.flatnonzero(~(values[:, 1] <= ASKED_DEG * DEG))
        after = late[-1] + 1 if len(late) else 0
        return float(self.time[after]) if after < len(self.time) else math.inf


def _rms(values: FloatArray) -> FloatArray:
    """Over the runs, without the NaN among them; NaN where there is nothing else."""
    there = np.isfinite(values)
    squares = (np.where(there, values, 0.0) ** 2).sum(axis=0)
    mean: FloatArray = np.divide(squares, there.sum(axis=0), out=np.full_like(squares, np.nan), where=there.any(axis=0))
    return np.sqrt(mean)


def answers(seeds: int, one: Callable[[int], tuple[FloatArray, list[Alignment | str], FloatArray]]) -> Answers:
    """Run `one` for every seed: times, answers or reasons of refusal, and the true attitudes."""
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        runs = list(pool.map(one, range(seeds)))
    errors = np.full((seeds, len(runs[0][0]), 2), np.nan)
    sigmas = errors.copy()
    for s, (_, results, true) in enumerate(runs):
        for k, result in enumerate(results):
            if isinstance(result, Alignment):
                north, east, heading = attitude_error(result.q_nb, true[k])
                errors[s, k] = math.hypot(north, east), heading
                sigmas[s, k] = math.sqrt(result.covariance[0, 0] + result.covariance[1, 1]), result.sigma_heading
    last = (results[-1] for _, results, _ in runs)
    return Answers(runs[0][0], errors, sigmas, tuple("" if isinstance(x, Alignment) else x for x in last))


def asked(result: Callable[[], Alignment]) -> Alignment | str:
    """The answer, or why there is none."""
    try:
        return result()
    except AlignmentRefused as refusal:
        return str(refusal)


def ship(heading_deg: float) -> MotionConfig:
    """A ship at its mooring: roll, pitch and yaw of degrees, heave and sway of decimetres, periods of 5 to 10 s."""

    def swing(amplitude: float, period: float, phase: float, offset: float = 0.0) -> Channel:
        return Channel(offset=offset, sines=(Sine(amplitude=amplitude, period_s=period, phase_deg=phase),))

    return MotionConfig(
        latitude_deg=LAT_DEG,
        height_m=HEIGHT_M,
        heading=swing(1.5, 9.7, 0.0, heading_deg),
        pitch=swing(2.0, 6.1, 40.0),
        roll=swing(5.0, 8.3, 100.0),
        up=swing(0.3, 7.3, 20.0),
        north=swing(0.2, 9.1, 0.0),
        east=swing(0.2, 5.7, 70.0),
    )


def stand(heading_deg: float) -> MotionConfig:
    """A level body at rest."""
    return MotionConfig(latitude_deg=LAT_DEG, height_m=HEIGHT_M, heading=Channel(offset=heading_deg))


def aligned(name: str, seeds: int, duration: float, *, swaying: bool, to_body: FloatArray | None = None) -> Answers:
    """Alignments of a grade, each at a heading of its own."""
    grade, lat = GRADES[name], LAT_DEG * DEG

    def one(seed: int) -> tuple[FloatArray, list[Alignment | str], FloatArray]:
        heading = 360.0 * (seed + 0.5) / seeds
        motion = Motion(ship(heading) if swaying else stand(heading))
        imu = sensed(ideal(motion, duration), grade, seed, to_body)
        in_motion, at_rest = MotionAlignment(sensors(grade)), RestAlignment(lat, sensors(grade))
        stride = round(LOOK_S / imu.step[0])
        results: list[Alignment | str] = []
        for first in range(0, len(imu), stride):
            some: ImuIncrements = imu.rows(first, first + stride)
            if swaying:
                in_motion.add(some, mooring(some, lat, HEIGHT_M, SWAY_M))
            else:
                at_rest.add(some)
            results.append(asked(in_motion.result if swaying else at_rest.result))
        times = imu.time[stride - 1 :: stride]
        return times, results, motion.truth(times)["q_nb"]

    return answers(seeds, one)


def described(key: str, what: str, found: Answers, *, ratio: float | None = None) -> list[Row]:
    """Rows of the last answers: heading and tilt beside theory, the largest, and the time to `ASKED_DEG`."""
    if all(found.reasons):
        return [at_most(f"{key}-answers", f"{what}: answers; refused: {found.reasons[0]}", 0.0, "1", 0.0)]
    (tilt, heading), (sigma_tilt, sigma) = found.rms()[-1] / DEG, found.sigma()[-1] / DEG
    refused = sum(map(bool, found.reasons))
    rows = [
        shown(f"{key}-refused", f"{what}: runs refused at the end", refused, "1"),
        shown(f"{key}-heading", f"{what}: heading, rms (reference: sigma)", heading, "deg", reference=sigma),
        shown(f"{key}-tilt", f"{what}: tilt, rms (reference: sigma)", tilt, "deg", reference=sigma_tilt),
    ]
    if ratio is not None:
        words = f"{what}: heading, rms over sigma"
        rows.append(near(f"{key}-ratio", words, heading / sigma, "1", ratio, reference=1.0))
    by_theory = found.reached(found.sigma())
    words = f"{what}: time to {ASKED_DEG:g} deg of heading, rms (reference: sigma; blank: never)"
    rows.append(shown(f"{key}-time", words, found.reached(found.rms()), "s", reference=by_theory))
    return rows


def curves(key: str, title: str, found: dict[str, Answers]) -> Plot:
    """Heading over time, rms and sigma, of those that answer."""
    lines = []
    for name, one in found.items():
        if np.isfinite(one.rms()[-1]).all():
            lines.append(Line(f"{name}: rms", one.time, one.rms()[:, 1] / DEG))
            lines.append(Line(f"{name}: sigma", one.time, one.sigma()[:, 1] / DEG, "--"))
    return Plot(key, title, "s", "deg", lines, log=True)


def standing(seeds: int, duration: float) -> tuple[list[Row], list[Plot]]:
    """All grades at rest and swaying."""
    rows: list[Row] = []
    plots: list[Plot] = []
    for key, words in (("rest", "at rest"), ("sway", "swaying")):
        found = {name: aligned(name, seeds, duration, swaying=key == "sway") for name in GRADES}
        for name, one in found.items():
            what = f"{GRADES[name].name}, {words}, {duration:g} s, {seeds} runs"
            rows += described(f"{key}-{name}", what, one, ratio=4.0 / math.sqrt(2.0 * seeds))
        plots.append(curves(key, f"Heading of the alignment {words}, latitude {LAT_DEG:g} deg", found))
        if key == "sway":
            rows += _goal(found["dtg"], seeds, duration)
    halves = aligned("dtg", seeds, duration, swaying=True, to_body=combination(GRADES["dtg"].gyro_channels))
    what = "DTG head, swaying, both y channels alike: the upright rotor's and one that gravity drifts"
    rows += described("sway-dtg-halves", what, halves)
    return rows, plots


def _goal(found: Answers, seeds: int, duration: float) -> list[Row]:
    what = f"DTG head, swaying, {duration:g} s: heading of {seeds} runs"
    bias = GRADES["dtg"].gyro_bias / (RATE * math.cos(LAT_DEG * DEG)) / DEG
    heading = np.abs(found.errors[:, -1, 1]) / DEG
    rms = float(np.sqrt((heading**2).mean()))
    return [
        at_most("sway-dtg-goal", f"{what}, rms (reference: bias alone)", rms, "deg", 0.09, reference=bias),
        at_most("sway-dtg-worst", f"{what}, largest", float(heading.max()), "deg", 0.18),
    ]
