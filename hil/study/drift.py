"""Drift of the sensor grades: flights with drawn instruments against the linear covariance along the same path.

Increments of the built-in flight are exact; each run draws its instruments and starts from the truth. The vertical channel of
an inertial navigator is unstable and nothing damps it here; so it is shown free, and with the height held: height and
vertical velocity are set to the true ones every second, as an ideal altimeter would do.
"""

import math
import os
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hil.geometry import position_error
from hil.study.navigation.flights import CHUNK, DURATION_S, flight
from hil.study.report import Band, Line, Plot, Row, Study, near, shown
from hil.world.motion import Motion
from nav.covariance import Path, budget
from nav.increments import FloatArray
from nav.instruments.accelerometer_errors import Accelerometers
from nav.instruments.grades import GRADES, Grade
from nav.instruments.gyro_errors import Gyros
from nav.instruments.sources import combination, grade_sources
from nav.strapdown import Strapdown

STEP, PATH_STEP, LOOK_S = 0.01, 0.1, 1.0
"""Of the sensors, of the covariance, and between comparisons, s."""
SEEDS = 64
OTHERS = {"tactical": 600.0, "mems": 120.0}
"""Other grades, and for how long their errors stay small enough to be called linear, s."""
SHOWN_RUNS = 10
LIMIT = 0.2
_AXES = ("north", "east", "down")


@dataclass(frozen=True, slots=True)
class Drift:
    """Position errors of some runs, and what the covariance says of them; a row a second.

    Attributes
    ----------
    errors : (seeds, n, 3) float
        North, east, down, m.
    expected : dict of (n, 3, 3) float
        Covariance of the position error by source, m^2.
    """

    errors: FloatArray
    expected: dict[str, FloatArray]

    @property
    def covariance(self) -> FloatArray:
        """(n, 3, 3): of all sources together, m^2."""
        return np.asarray(sum(self.expected.values()), np.float64)

    def rms(self, axes: int) -> FloatArray:
        """(n,): of the first `axes` components over the runs, m."""
        return np.asarray(np.sqrt((self.errors[:, :, :axes] ** 2).sum(axis=2).mean(axis=0)))

    def sigma(self, axes: int) -> FloatArray:
        """(n,): the same from the covariance."""
        return np.asarray(np.sqrt(np.einsum("kii->k", self.covariance[:, :axes, :axes])))

    def consistency(self) -> float:
        """Mean of e P^-1 e / 3 at the end; 1 +- sqrt(2 / (3 seeds)) where the covariance is right."""
        end = self.errors[:, -1]
        return float(np.einsum("si,si->", end, np.linalg.solve(self.covariance[-1], end.T).T) / end.size)


def drift(grade: Grade, duration: float, seeds: int) -> tuple[Drift, Drift]:
    """Fly `seeds` runs with instruments of a grade: free, and with the height held.

    The bias of the gyros has been removed at rest as far as the grade says.
    """
    motion, n = flight("smooth"), round(duration / STEP)
    dtheta, dvel = np.empty((n, 3)), np.empty((n, 3))
    motion.increments(0, n, STEP, dtheta, dvel)
    with ThreadPoolExecutor(os.cpu_count()) as pool:  # kernels and generators let go of the interpreter
        runs = np.array(list(pool.map(lambda seed: _run(motion, grade, dtheta, dvel, seed), range(seeds))))
    middles = motion.truth((np.arange(round(duration / PATH_STEP)) + 0.5) * PATH_STEP)
    path = Path(PATH_STEP, *(middles[name] for name in ("lat", "height", "vel_n", "q_nb", "w_ib_b", "f_b")))
    sources, every = grade_sources(grade, STEP, bias_removed=True), round(LOOK_S / PATH_STEP)
    free, held = (
        {name: part[:, :3, :3] for name, part in budget(path, sources, every=every, height_held=height_held).items()}
        for height_held in (False, True)
    )
    return Drift(runs[:, 0], free), Drift(runs[:, 1], held)


def _run(motion: Motion, grade: Grade, dtheta: FloatArray, dvel: FloatArray, seed: int) -> FloatArray:
    """Position errors (2, n, 3) of one run, free and with the height held."""
    turn_on, gyro_noise, force_noise = np.random.default_rng(seed).spawn(3)
    gyro_errors, force_errors = grade.draw(turn_on, bias_removed=True)
    gyros, forces = Gyros(gyro_errors, STEP, gyro_noise), Accelerometers(force_errors, STEP, force_noise)
    to_body = combination(grade.gyro_channels).T
    turned, pushed = np.empty_like(dtheta), np.empty_like(dvel)
    for first in range(0, len(dtheta), CHUNK):
        some = slice(first, first + CHUNK)
        turned[some] = gyros.sense(dtheta[some], dvel[some]) @ to_body
        pushed[some] = forces.sense(dvel[some])
    stride = round(LOOK_S / STEP)
    truth = motion.truth(np.arange(len(dtheta) // stride + 1) * LOOK_S)
    return np.array([_navigate(truth, turned, pushed, length) for length in (len(dtheta), stride)])


def _navigate(truth: NDArray[np.void], dtheta: FloatArray, dvel: FloatArray, length: int) -> FloatArray:
    """Position errors (n, 3); height and vertical velocity become the true ones after each `length` steps."""
    n, stride, start = len(dtheta), round(LOOK_S / STEP), truth[0]
    core = Strapdown("two-sample")
    core.start(start["lat"], start["lon"], start["height"], start["vel_n"], start["q_nb"])
    position, velocity, attitude, steps = np.empty((n, 3)), np.empty((n, 3)), np.empty((n, 4)), np.full(n, STEP)
    for first in range(0, n, length):
        some = slice(first, first + length)
        out = position[some], velocity[some], attitude[some]
        core.advance(steps[some], dtheta[some], dvel[some], np.zeros(3), *out)
        row = truth[(first + length) // stride]
        core.solution[2], core.solution[5] = row["height"], row["vel_n"][2]
        core.hand_over("geographic")
    lat, lon, height = np.ascontiguousarray(position[stride - 1 :: stride].T)
    return position_error(lat, lon, height, truth[1:])


def _compared(key: str, what: str, found: Drift, axes: int, *, limited: bool) -> list[Row]:
    """Ratios of the runs' rms to the covariance's sigma, of the whole and at the end."""
    rms, sigma = found.rms(axes), found.sigma(axes)
    whole = math.sqrt(float((rms**2).sum() / (sigma**2).sum()))
    rows = []
    for part, ratio in (("whole", whole), ("end", rms[-1] / sigma[-1])):
        name, words = f"{key}-ratio-{part}", f"{what}: rms of the runs over sigma, {part}"
        if limited:
            rows.append(near(name, words, ratio, "1", LIMIT, reference=1.0))
        else:
            rows.append(shown(name, words, ratio, "1", reference=1.0))
    rows.append(shown(f"{key}-end", f"{what}: rms at the end (reference: sigma)", rms[-1], "m", reference=sigma[-1]))
    return rows


def _budget(found: Drift, held: Drift) -> list[Row]:
    rows = []
    for name in found.expected:
        key = name.replace(" ", "-")
        for what, part, axes in (
            ("horizontal, height held", held, slice(0, 2)),
            ("vertical", found, slice(2, 3)),
        ):
            sigma = math.sqrt(np.trace(part.expected[name][-1, axes, axes]))
            where = what.split(",", maxsplit=1)[0]
            rows.append(shown(f"budget-{where}-{key}", f"DTG head, at the end, {what}: sigma by {name}", sigma, "m"))
    return rows


def _plots(found: Drift, held: Drift) -> list[Plot]:
    time = np.arange(1.0, found.errors.shape[1] + 1.0)
    plots = []
    for i, (axis, part) in enumerate(zip(_AXES, (held, held, found), strict=True)):
        sigma = np.sqrt(part.covariance[:, i, i])
        lines = [Line("", time, run) for run in part.errors[:SHOWN_RUNS, :, i]]
        rms = np.sqrt((part.errors[:, :, i] ** 2).mean(axis=0))
        lines.append(Line(f"rms of {len(part.errors)} runs", time, rms))
        title = f"Position error, DTG head, {axis}{', height held' if part is held else ''}"
        plots.append(Plot(axis, title, "s", "m", lines, bands=[Band("1 sigma", time, -sigma, sigma)]))
    lines = []
    for what, part, axes in (("3-D", found, 3), ("horizontal, height held", held, 2)):
        lines += [Line(f"{what}: rms", time, part.rms(axes)), Line(f"{what}: sigma", time, part.sigma(axes), "--")]
    plots.append(Plot("rms", "Growth of the position error, DTG head", "s", "m", lines))
    return plots


def run(seeds: int = SEEDS, duration: float = DURATION_S) -> Study:
    """All of it; the other grades fly no longer than `duration`."""
    free, held = drift(GRADES["dtg"], duration, seeds)
    where = f"DTG head, {duration:g} s, {seeds} runs"
    rows = _compared("dtg-3d", f"{where}, 3-D", free, 3, limited=True)
    rows += _compared("dtg-horizontal", f"{where}, horizontal", free, 2, limited=True)
    rows += _compared("dtg-held", f"{where}, horizontal, height held", held, 2, limited=True)
    what = f"{where}: mean of e P^-1 e / 3 at the end"
    rows.append(shown("dtg-consistency", what, free.consistency(), "1", reference=1.0))
    for name, longest in OTHERS.items():
        other = min(longest, duration)
        found, _ = drift(GRADES[name], other, seeds)
        rows += _compared(f"{name}-3d", f"{GRADES[name].name}, {other:g} s, {seeds} runs, 3-D", found, 3, limited=False)
    rows += _budget(free, held)
    about = (
        "The built-in flight, 2050 s, exact increments at 100 Hz, instruments drawn for each run from the table of grades, true "
        "start, two-sample, geographic. Sigma: linear covariance of all sources along the true path. Free: the vertical channel "
        "is unstable and undamped. Height held: height and vertical velocity are set to the true ones every second."
    )
    return Study("drift", "Drift of the sensor grades", about, rows, _plots(free, held))
