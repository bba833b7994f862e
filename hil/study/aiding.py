"""Aided navigation of the sensor grades: is the filter's own error estimate true, and how good is the picture?

Each run draws its instruments, its start and the noise of GNSS, apart for each grade and kind. Two kinds of instruments:

    own     what the filter believes: turn-on values of its sigmas, its noise, its random walks
    full    the table of grades: flicker and drift by force, which the filter knows as noise only
"""

import math
import os
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from hil.geometry import attitude_difference, position_error
from hil.scenario import Channel as ChannelConfig
from hil.scenario import MotionConfig, Sine
from hil.study.aiding_runs import GAINS, KINDS, PARTS, Runs, gains, growth, plots
from hil.study.report import Row, Study, at_most, near, shown
from hil.world.motion import Motion
from nav.aiding import AIDING, Kind
from nav.earth import curvature_radii
from nav.filter.aided import AidedNavigator, Settings
from nav.filter.health import Channel
from nav.filter.states import GYRO_MISALIGNMENT, LEVEL, STATES, Tuning, tuning
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
OWN = Settings(predict_s=0.1)
"""For the own instruments: five times longer intervals than usual, for there are many runs."""
CAMPAIGNS = 30
"""Of the own instruments: errors live for half a minute, so that the epochs of one campaign are few that are independent."""
SEEDS, SETTLED_S, OUTAGE_S = 50, 60.0, (120.0, 180.0)
LIMITS_DEG = {"dtg": (0.01, 0.06), "tactical": (0.05, 0.2), "mems": (0.2, 1.0)}
"""Of tilt and heading, rms."""


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
    looks = motion.truth(np.arange(round(duration / LOOK_S) + 1) * LOOK_S)
    times = np.arange(1, round(duration / GNSS_S) + 1) * GNSS_S
    if outage is not None:
        times = times[(times <= outage[0] + 1e-9) | (times > outage[1] + 1e-9)]
    fixes = motion.truth(times)

    def one(seed: int) -> tuple[FloatArray, ...]:
        apart = np.random.SeedSequence(seed, spawn_key=(list(GRADES).index(name), KINDS.index(instruments)))
        rng, *parts = np.random.default_rng(apart).spawn(4)
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
    return Runs(looks["time"][1:].copy(), *(np.array(part) for part in zip(*found, strict=True)))


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
    w, f = dtheta / STEP, dvel / STEP + np.array([0.0, 0.0, LEVEL])
    density = np.tile(belief.white**2, (n, 1))
    density[:, :3] += w**2 @ belief.by_rate.T + f**2 @ belief.by_force.T
    out = []
    skew = (belief.sigma[GYRO_MISALIGNMENT] * rng.standard_normal(6)).reshape(3, 2)
    for first, true in ((0, dtheta), (3, dvel)):
        bias, scale = (belief.sigma[part : part + 3] * rng.standard_normal(3) for part in (9 + first, 15 + first))
        walk = belief.walk[9 + first : 12 + first] * root * rng.standard_normal((n, 3))
        noise = np.sqrt(density[:, first : first + 3]) * root * rng.standard_normal((n, 3))
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
    """Run; what `Runs` holds of one."""
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
    # P of after an update is also that of the gain, P H^T R^-1.
    height = covariance[:, 2, 2] / GNSS_SIGMA[2] ** 2
    lean, turn = (
        np.linalg.norm(covariance[:, part, 3:5], axis=(1, 2)) / GNSS_SIGMA[3] ** 2
        for part in (slice(6, 8), slice(8, 9))
    )
    return errors, sigma, nees, tilt, heading, np.array(nis).T, np.stack([height, lean, turn], axis=1)


def run(seeds: int = SEEDS, settled: float = SETTLED_S, outage: tuple[float, float] = OUTAGE_S) -> Study:
    """All of it: consistency and accuracy from `settled` to the beginning of the outage, then the outage."""
    rows: list[Row] = []
    flown = {}
    for name in GRADES:
        own = fly(name, CAMPAIGNS * seeds, outage[1], "own", settings=OWN)
        full = fly(name, seeds, outage[1], "full", outage)
        flown[name] = own, full
        rows += _consistency(name, "own", own, seeds, settled, outage[1])
        rows += _consistency(name, "full", full, seeds, settled, outage[0])
        rows += _accuracy(name, full, settled, outage)
    about = (
        "Circles and straights at 35 to 80 m/s, exact increments at 100 Hz, instruments drawn for each run, GNSS at 5 Hz with "
        "white noise of 1.5 m (2.5 m vertical) and 0.05 m/s (0.08). 27 states. Own: instruments by the filter's own model, GNSS "
        "to the end, the mean NEES of a campaign inside both 95 % bounds. Full: by the table of grades, under the upper one."
    )
    return Study("aiding", "Aided navigation of the sensor grades", about, rows, plots(flown, outage, GNSS_S))


def _consistency(name: str, kind: Instruments, runs: Runs, campaign: int, settled: float, until: float) -> list[Row]:
    rows = []
    words = f"{GRADES[name].name}, {len(runs.errors) // campaign} x {campaign} runs, {kind} instruments: "
    say = "outside the" if kind == "own" else "above the upper"
    outside = 1.0 - runs.inside(settled, until, campaign, upper_only=kind == "full")
    nees = runs.nees[:, (runs.time >= settled) & (runs.time <= until)].mean(axis=(0, 1)) / 3.0
    for k, part in enumerate(PARTS):
        share = f"{words}share of epochs with the NEES of {part} {say} 95 % bound"
        rows.append(at_most(f"{name}-{kind}-{part}-outside", share, outside[k], "1", 0.1))
        mean = f"{words}mean NEES / 3 of {part}"
        rows.append(shown(f"{name}-{kind}-{part}-nees", mean, nees[k], "1", reference=1.0))
    for part, nis in zip(PARTS[:2], runs.nis.mean(axis=(0, 1)) / 3.0, strict=True):
        rows.append(shown(f"{name}-{kind}-{part}-nis", f"{words}mean NIS / 3, GNSS {part}", nis, "1", reference=1.0))
    return rows


def _accuracy(name: str, full: Runs, settled: float, outage: tuple[float, float]) -> list[Row]:
    rows = []
    where = f"{GRADES[name].name}, {len(full.errors)} runs"
    window = (full.time >= settled) & (full.time <= outage[0])
    for what, angle, limit in zip(("tilt", "heading"), (full.tilt, full.heading), LIMITS_DEG[name], strict=True):
        rms = math.degrees(math.sqrt(float((angle[:, window] ** 2).mean())))
        rows.append(at_most(f"{name}-{what}", f"{where}: rms of {what}", rms, "deg", limit))
    spread, said = growth(full)
    words = f"{where}: after {outage[1] - outage[0]:g} s without GNSS, rms of position over sigma"
    rows.append(near(f"{name}-outage-ratio", words, spread[-1] / said[-1], "1", 0.25, reference=1.0))
    rows.append(shown(f"{name}-outage", f"{where}: rms of position then", spread[-1], "m", reference=said[-1]))
    gain = gains(full)[full.time <= outage[0]][-1]
    for (id, of, unit), value in zip(GAINS, gain, strict=True):
        rows.append(shown(f"{name}-gain-{id}", f"{where}: Kalman gain of {of} at {outage[0]:g} s", value, unit))
    return rows
