"""Aided navigation of the sensor grades: is the filter's own error estimate true, and how good is the picture?

Each run draws its instruments, its start and the noise of GNSS. Two kinds of instruments:

    own     what the filter believes: turn-on values of its sigmas, its white noise, its random walks
    full    the table of grades: flicker, misalignment and drift by force, which the filter knows as noise only
"""

import math
import os
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from hil.geometry import attitude_difference, position_error
from hil.scenario import Channel as ChannelConfig
from hil.scenario import MotionConfig, Sine
from hil.study.report import Band, Line, Plot, Row, Study, at_most, near, shown
from hil.world.motion import Motion
from nav.aiding import AIDING, Kind
from nav.earth import curvature_radii
from nav.filter.aided import AidedNavigator, Settings
from nav.filter.health import Channel
from nav.filter.states import GYRO_MISALIGNMENT, STATES, Tuning, tuning
from nav.increments import FloatArray, ImuIncrements
from nav.instruments.accelerometer_errors import Accelerometers
from nav.instruments.grades import GRADES, Grade
from nav.instruments.gyro_errors import Gyros
from nav.instruments.sources import combination
from nav.lever_arm import shift
from nav.rotation import attitude_error, product, quaternion_from_rotation_vector
from nav.strapdown import Strapdown

STEP, LOOK_S, GNSS_S = 0.01, 1.0, 0.2
"""Of the sensors, between comparisons, and of GNSS, s."""
GNSS_SIGMA = np.array([1.5, 1.5, 2.5, 0.05, 0.05, 0.08])
"""North, east, down: m, m/s."""
_DEG = math.pi / 180.0
TILT = {"dtg": (0.01 * _DEG, 0.1 * _DEG), "tactical": (0.1 * _DEG, 0.5 * _DEG), "mems": (0.5 * _DEG, 3.0 * _DEG)}
"""Sigma of tilt and heading at the start, rad."""
Instruments = Literal["own", "full"]
SEEDS, SETTLED_S, OUTAGE_S = 50, 60.0, (120.0, 180.0)
LIMITS_DEG = {"dtg": (0.01, 0.06), "tactical": (0.05, 0.2), "mems": (0.2, 1.0)}
"""Of tilt and heading, rms."""
_PARTS = ("position", "velocity", "attitude")


@dataclass(frozen=True, slots=True)
class Runs:
    """What some runs gave, a row a second.

    Attributes
    ----------
    time : (n,) float
        s.
    errors : (seeds, n, 9) float
        Position, velocity (n), attitude: m, m/s, rad.
    sigma : (seeds, n, STATES) float
        What the filter says of each state.
    nees : (seeds, n, 3) float
        e P^-1 e of position, velocity, attitude.
    tilt, heading : (seeds, n) float
        Attitude errors as a user sees them, rad.
    nis : (seeds, m, 2) float
        Of GNSS position and velocity, 3 degrees of freedom each.
    rejected : int
        Measurements rejected, of all runs.
    """

    time: FloatArray
    errors: FloatArray
    sigma: FloatArray
    nees: FloatArray
    tilt: FloatArray
    heading: FloatArray
    nis: list[FloatArray]
    rejected: int

    def inside(self, since: float, until: float, *, upper_only: bool = False) -> FloatArray:
        """(3,): share of the epochs `since` to `until`, s, whose NEES, averaged over the runs, is inside its 95 % bounds."""
        runs = len(self.errors)
        mean = self.nees[:, (self.time >= since) & (self.time <= until)].mean(axis=0)
        low, high = nees_bounds(runs)
        good = mean <= high if upper_only else (mean >= low) & (mean <= high)
        return np.asarray(good.mean(axis=0), np.float64)


def nees_bounds(runs: int) -> tuple[float, float]:
    """95 % bounds of the mean NEES of 3 states over independent runs: chi-square of 3 `runs` (Wilson and Hilferty)."""
    k = 3.0 * runs
    part = 2.0 / (9.0 * k)
    low, high = (k * (1.0 - part + z * math.sqrt(part)) ** 3 / runs for z in (-1.959964, 1.959964))
    return low, high


def fly(
    name: str,
    seeds: int,
    duration: float,
    instruments: Instruments = "full",
    outage: tuple[float, float] | None = None,
    settings: Settings | None = None,
) -> Runs:
    """Fly with instruments of the grade `name`, without GNSS in `outage`, s.

    The gyros' bias has been removed at rest as far as the grade says.
    """
    motion = turns()
    true = record(motion, duration)
    belief = tuning(GRADES[name], bias_removed=True)
    if instruments == "own":
        belief = replace(belief, by_rate=np.zeros((3, 3)))
    looks = motion.truth(np.arange(round(duration / LOOK_S) + 1) * LOOK_S)
    times = np.arange(1, round(duration / GNSS_S) + 1) * GNSS_S
    if outage is not None:
        times = times[(times <= outage[0] + 1e-9) | (times > outage[1] + 1e-9)]
    fixes = motion.truth(times)

    def one(seed: int) -> tuple[FloatArray, ...]:
        rng, *parts = np.random.default_rng(seed).spawn(4)
        if instruments == "own":
            data = _own(belief, true.dtheta, true.dvel, parts[0])
        else:
            data = _full(GRADES[name], true.dtheta, true.dvel, parts)
        navigator = AidedNavigator(Strapdown(), belief, settings)
        begin(navigator, looks[0], TILT[name], rng)
        navigator.aid(gnss_rows(fixes, rng))
        return _follow(navigator, looks, replace(true, dtheta=data[0], dvel=data[1]))

    with ThreadPoolExecutor(os.cpu_count()) as pool:
        found = list(pool.map(one, range(seeds)))
    errors, sigma, nees, tilt, heading = (np.array([run[k] for run in found]) for k in range(5))
    rejected = int(sum(run[6] for run in found))
    return Runs(looks["time"][1:].copy(), errors, sigma, nees, tilt, heading, [run[5] for run in found], rejected)


def turns() -> Motion:
    """Circles and straights in turn at 35 to 80 m/s, with banks up to 33 degrees."""
    return Motion(
        MotionConfig(
            attitude="coordinated",
            north=ChannelConfig(rate=50.0, sines=(Sine(amplitude=120.0, period_s=45.0),)),
            east=ChannelConfig(sines=(Sine(amplitude=250.0, period_s=40.0),)),
            up=ChannelConfig(offset=500.0, sines=(Sine(amplitude=30.0, period_s=70.0),)),
        )
    )


def record(motion: Motion, duration: float) -> ImuIncrements:
    """Exact increments of a motion."""
    n = round(duration / STEP)
    dtheta, dvel = np.empty((n, 3)), np.empty((n, 3))
    motion.increments(0, n, STEP, dtheta, dvel)
    time, step = np.asarray(STEP * np.arange(1, n + 1), np.float64), np.full(n, STEP)
    return ImuIncrements(time, step, dtheta, dvel, np.zeros(n, np.int64), np.arange(n))


def gnss_rows(
    truth: NDArray[np.void],
    rng: np.random.Generator,
    sigma: FloatArray = GNSS_SIGMA,
    arm: FloatArray | None = None,
) -> NDArray[np.void]:
    """Rows of `AIDING`, GNSS with white noise, of rows of `hil.world.motion.TRUTH`; `arm` to the antenna, b, m."""
    if arm is not None:
        truth = truth.copy()
        point = truth["lat"], truth["lon"], truth["height"], truth["vel_n"]
        shift(*point, truth["q_nb"], truth["w_ib_b"], arm)
    noise = sigma * rng.standard_normal((len(truth), 6))
    rows = np.zeros(len(truth), AIDING)
    rows["time"], rows["kind"], rows["sigma"] = truth["time"], Kind.GNSS, sigma
    lat, lon, height = moved(truth["lat"], truth["lon"], truth["height"], noise[:, :3])
    rows["value"][:, 0], rows["value"][:, 1], rows["value"][:, 2] = lat, lon, height
    rows["value"][:, 3:] = truth["vel_n"] + noise[:, 3:]
    return rows


def moved(
    lat: FloatArray, lon: FloatArray, height: FloatArray, ned: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Places (n,) moved north, east, down, (n, 3) m."""
    radii = np.array([curvature_radii(float(s)) for s in np.sin(lat)])
    east = lon + ned[:, 1] / ((radii[:, 1] + height) * np.cos(lat))
    return lat + ned[:, 0] / (radii[:, 0] + height), east, height - ned[:, 2]


def begin(navigator: AidedNavigator, truth: np.void, tilt: tuple[float, float], rng: np.random.Generator) -> None:
    """Start from a row of truth with drawn errors: position and velocity of GNSS, tilt and heading of `tilt`, rad."""
    sigma = np.array([*GNSS_SIGMA[:3], *GNSS_SIGMA[3:], tilt[0], tilt[0], tilt[1]])
    wrong = sigma * rng.standard_normal(9)
    place = moved(truth["lat"][None], truth["lon"][None], truth["height"][None], wrong[None, :3])
    lat, lon, height = (float(part[0]) for part in place)
    q_nb = product(quaternion_from_rotation_vector(wrong[6:]), truth["q_nb"])
    navigator.start(float(truth["time"]), lat, lon, height, truth["vel_n"] + wrong[3:6], q_nb, sigma)


def _own(
    belief: Tuning, dtheta: FloatArray, dvel: FloatArray, rng: np.random.Generator
) -> tuple[FloatArray, FloatArray]:
    """Increments by the filter's own model."""
    n, root = len(dtheta), math.sqrt(STEP)
    out = []
    skew = (belief.sigma[GYRO_MISALIGNMENT] * rng.standard_normal(6)).reshape(3, 2)
    for first, true in ((0, dtheta), (3, dvel)):
        bias, scale = (belief.sigma[part : part + 3] * rng.standard_normal(3) for part in (9 + first, 15 + first))
        walk = belief.walk[9 + first : 12 + first] * root * rng.standard_normal((n, 3))
        noise = belief.white[first : first + 3] * root * rng.standard_normal((n, 3))
        out.append((1.0 + scale) * true + STEP * (bias + np.cumsum(walk, axis=0)) + noise)
    out[0] += skew[:, 0] * np.roll(dtheta, -1, axis=1) + skew[:, 1] * np.roll(dtheta, -2, axis=1)
    return out[0], out[1]


def _full(
    grade: Grade, dtheta: FloatArray, dvel: FloatArray, rngs: list[np.random.Generator]
) -> tuple[FloatArray, FloatArray]:
    """Increments by the table of grades."""
    gyros, accelerometers = grade.draw(rngs[0], bias_removed=True)
    turned = Gyros(gyros, STEP, rngs[1]).sense(dtheta, dvel) @ combination(grade.gyro_channels).T
    return turned, Accelerometers(accelerometers, STEP, rngs[2]).sense(dvel)


def _follow(navigator: AidedNavigator, looks: NDArray[np.void], imu: ImuIncrements) -> tuple[FloatArray, ...]:
    """Run; errors, sigma and NEES at each look."""
    n, stride = len(looks) - 1, round(LOOK_S / STEP)
    solutions, sigma, covariance = np.empty((n, 10)), np.empty((n, STATES)), np.empty((n, 9, 9))
    for k in range(n):
        navigator.process(imu.rows(k * stride, (k + 1) * stride))
        solutions[k], sigma[k], covariance[k] = navigator.solution, navigator.sigma, navigator.covariance[:9, :9]
    truth, q = looks[1:], np.ascontiguousarray(solutions[:, 6:10])
    lat, lon, height = np.ascontiguousarray(solutions[:, :3].T)
    errors = np.hstack(
        [
            position_error(lat, lon, height, truth),
            solutions[:, 3:6] - truth["vel_n"],
            attitude_error(q, truth["q_nb"]),
        ]
    )
    nees = np.empty((n, 3))
    for block in range(3):
        part = slice(3 * block, 3 * block + 3)
        whitened = np.linalg.solve(covariance[:, part, part], errors[:, part, None])[:, :, 0]
        nees[:, block] = (errors[:, part] * whitened).sum(axis=1)
    _, tilt, heading = attitude_difference(q, truth["q_nb"])
    judged = navigator.judged()
    nis = [
        [one.nis for one in judged if one.channel == channel]
        for channel in (Channel.GNSS_POSITION, Channel.GNSS_VELOCITY)
    ]
    rejected = np.array(sum(not one.accepted for one in judged))
    return errors, sigma, nees, tilt, heading, np.array(nis).T, rejected


def run(seeds: int = SEEDS, settled: float = SETTLED_S, outage: tuple[float, float] = OUTAGE_S) -> Study:
    """All of it: consistency and accuracy from `settled` to the beginning of the outage, then the outage."""
    rows: list[Row] = []
    flown = {}
    for name, grade in GRADES.items():
        own = fly(name, seeds, outage[0], "own")
        full = fly(name, seeds, outage[1], "full", outage)
        flown[name] = own, full
        where = f"{grade.name}, {seeds} runs"
        for what, runs in (("own", own), ("full", full)):
            outside = 1.0 - runs.inside(settled, outage[0], upper_only=what == "full")
            for part, share in zip(_PARTS, outside, strict=True):
                say = "outside the" if what == "own" else "above the upper"
                words = f"{where}, {what} instruments: share of epochs with the NEES of {part} {say} 95 % bound"
                rows.append(at_most(f"{name}-{what}-{part}-outside", words, float(share), "1", 0.1))
        window = (full.time >= settled) & (full.time <= outage[0])
        for what, angle, limit in zip(("tilt", "heading"), (full.tilt, full.heading), LIMITS_DEG[name], strict=True):
            rms = math.degrees(math.sqrt(float((angle[:, window] ** 2).mean())))
            rows.append(at_most(f"{name}-{what}", f"{where}: rms of {what}", rms, "deg", limit))
        spread, said = growth(full)
        words = f"{where}: after {outage[1] - outage[0]:g} s without GNSS, rms of position over sigma"
        rows.append(near(f"{name}-outage-ratio", words, spread[-1] / said[-1], "1", 0.25, reference=1.0))
        rows.append(shown(f"{name}-outage", f"{where}: rms of position then", spread[-1], "m", reference=said[-1]))
        nis = np.concatenate(own.nis).mean(axis=0) / 3.0
        for what, value in zip(("position", "velocity"), nis, strict=True):
            rows.append(
                shown(f"{name}-nis-{what}", f"{where}, own: mean NIS / 3, GNSS {what}", value, "1", reference=1.0)
            )
    about = (
        "Circles and straights at 35 to 80 m/s, exact increments at 100 Hz, instruments drawn for each run, GNSS at 5 Hz with "
        "white noise of 1.5 m (2.5 m vertical) and 0.05 m/s (0.08). 27 states. Own: instruments by the filter's own model, the "
        "NEES inside both 95 % bounds of its mean. Full: by the table of grades, under the upper one."
    )
    return Study("aiding", "Aided navigation of the sensor grades", about, rows, _plots(flown, outage))


def growth(runs: Runs) -> tuple[FloatArray, FloatArray]:
    """(n,), (n,): 3-D position error, rms over the runs, and what the filter says, m."""
    rms = np.sqrt((runs.errors[:, :, :3] ** 2).sum(axis=2).mean(axis=0))
    return rms, np.sqrt((runs.sigma[:, :, :3] ** 2).sum(axis=2).mean(axis=0))


def _plots(flown: dict[str, tuple[Runs, Runs]], outage: tuple[float, float]) -> list[Plot]:
    plots = []
    for k, part in enumerate(_PARTS):
        lines = [
            Line(
                f"{name}, {what}",
                runs.time[runs.time <= outage[0]],
                runs.nees[:, runs.time <= outage[0], k].mean(axis=0),
            )
            for name, pair in flown.items()
            for what, runs in zip(("own", "full"), pair, strict=True)
        ]
        time = lines[0].x
        low, high = nees_bounds(len(next(iter(flown.values()))[0].errors))
        bounds = [Band("95 %", time, np.full(len(time), low), np.full(len(time), high))]
        plots.append(Plot(f"nees-{part}", f"Mean NEES of {part}", "s", "1", lines, bands=bounds))
    lines = []
    for name, (_, full) in flown.items():
        spread, said = growth(full)
        late = full.time >= outage[0]
        lines += [
            Line(f"{name}: rms", full.time[late], spread[late]),
            Line(f"{name}: sigma", full.time[late], said[late], "--"),
        ]
    plots.append(Plot("outage", "Growth of the position error without GNSS", "s", "m", lines))
    for name, (_, full) in flown.items():
        wide = np.degrees(3.0 * full.sigma[0, :, 8])
        shown_runs = [Line("", full.time, np.degrees(one)) for one in full.heading[:10]]
        band = Band("3 sigma", full.time, -wide, wide)
        plots.append(
            Plot(f"heading-{name}", f"Heading error, {GRADES[name].name}", "s", "deg", shown_runs, bands=[band])
        )
    return plots
