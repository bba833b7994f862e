"""Sensor noise and quantisation through every order of the strapdown core, beside what its polynomials leave out.

An error due to noise is the difference at the end between a run on noisy increments and one on exact increments by the
same method; its rms is over draws. Every method gets the same draws, so that ratios need few of them. Angle errors add up
as the increments do; a method can amplify them only through its products of increments.
"""

import math
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass

import numpy as np

from drivers.can.dtg_head_emulator import ANGLE_LSB, VELOCITY_LSB
from hil.geometry import position_error
from hil.scenario import Cone, MotionConfig
from hil.study.navigation.flights import configuration
from hil.study.report import Line, Plot, Row, Study, at_most, near, shown
from hil.world.motion import Motion
from nav.earth import STANDARD_GRAVITY as G
from nav.increments import FloatArray
from nav.rotation import attitude_error, dcm_from_quaternion
from nav.strapdown import Strapdown

RATES_HZ = (100, 1000)
ORDERS = (3, 4, 5, 6, 7, 8)
METHODS = (("two-sample", False), *((f"high-order:{n}", whole) for whole in (False, True) for n in ORDERS))
"""Name, and whether it works in blocks of the whole record; else it is a stream."""
AMPLIFIED_S, DRAWS = 60.0, 8
CHOICE_S, CHOICE_DRAWS = 600.0, 24
SHARE = 0.1
"""A method is exact enough where it leaves out less than this share of the error due to noise."""


@dataclass(frozen=True)
class Grade:
    """White noise of a grade of sensors (1 sigma).

    Attributes
    ----------
    name : str
        As in the tables.
    angle, velocity : float
        Angle random walk, rad/sqrt(s); velocity random walk, m/s/sqrt(s).
    """

    name: str
    angle: float
    velocity: float


GRADES = (
    Grade("dtg", math.radians(0.002) / 60.0, 5e-6 * G),
    Grade("tactical", math.radians(0.05) / 60.0, 50e-6 * G),
    Grade("mems", math.radians(0.3) / 60.0, 120e-6 * G),
)

Increments = tuple[FloatArray, FloatArray]
Disturb = Callable[[Increments, float, np.random.Generator], Increments]


def motion(name: str) -> Motion:
    """`rest`, `agile`, or `shaken`: the agile flight with coning of 1 deg at 10 Hz. All begin at rest."""
    if name == "rest":
        return Motion(MotionConfig())
    cone = Cone(half_angle_deg=1.0, frequency_hz=10.0) if name == "shaken" else None
    return Motion(configuration("agile").model_copy(update={"rest_s": 1.0, "ramp_s": 9.0, "cone": cone}))


def white(grade: Grade) -> Disturb:
    """Independent errors of all increments."""

    def disturb(exact: Increments, step: float, random: np.random.Generator) -> Increments:
        root, (dtheta, dvel) = math.sqrt(step), exact
        return (
            dtheta + grade.angle * root * random.standard_normal(dtheta.shape),
            dvel + grade.velocity * root * random.standard_normal(dvel.shape),
        )

    return disturb


def quantised(exact: Increments, _step: float, random: np.random.Generator) -> Increments:
    """Rounded to the wire's units, the residue carried from sample to sample, from a random one on."""
    dtheta, dvel = (
        lsb * np.diff(np.rint(np.cumsum(x, axis=0) / lsb + random.uniform(-0.5, 0.5, 3)), axis=0, prepend=0.0)
        for x, lsb in zip(exact, (ANGLE_LSB, VELOCITY_LSB["fd"]), strict=True)
    )
    return dtheta, dvel


class Record:
    """Exact increments of a motion, and the truth at both ends."""

    def __init__(self, motion: Motion, rate_hz: int, duration: float) -> None:
        n = round(duration * rate_hz)
        self._motion, self.step = motion, 1.0 / rate_hz
        self.exact = np.empty((n, 3)), np.empty((n, 3))
        motion.increments(0, n, self.step, *self.exact)
        self.start, self.end = motion.truth([0.0, duration])
        self._steps, self._out = np.full(n, self.step), (np.empty((n, 3)), np.empty((n, 3)), np.empty((n, 4)))

    def error(self, core: Strapdown, increments: Increments) -> FloatArray:
        """Position (3), m, and attitude (3), rad, off the truth at the end."""
        row = self.start
        core.start(row["lat"], row["lon"], row["height"], row["vel_n"], row["q_nb"])
        core.advance(self._steps, *increments, np.zeros(3), *self._out)
        lat, lon, height = (core.solution[i : i + 1] for i in range(3))
        off = position_error(lat, lon, height, np.array([self.end]))[0]
        return np.concatenate([off, attitude_error(core.solution[6:], self.end["q_nb"])])

    def draws(self, disturb: Disturb, count: int) -> Iterator[Increments]:
        """The same `count` disturbed records at every call."""
        random = np.random.default_rng(20)
        return (disturb(self.exact, self.step, random) for _ in range(count))

    def plain(self, disturbed: Iterable[Increments]) -> FloatArray:
        """Plain sums of the angle errors, turned into level axes, (count, 3) rad."""
        middle = (np.arange(len(self.exact[0])) + 0.5) * self.step
        c_nb = np.array([dcm_from_quaternion(q) for q in self._motion.truth(middle)["q_nb"]])
        return np.array([np.einsum("kij,kj->i", c_nb, dtheta - self.exact[0]) for dtheta, _ in disturbed])


def responses(record: Record, disturb: Disturb, count: int, method: str, *, whole: bool) -> FloatArray:
    """Errors due to the disturbance, (count, 6): position, m, and attitude, rad, at the end."""
    core = Strapdown(method, "inertial", whole_record=whole)
    clean = record.error(core, record.exact)
    return np.array([record.error(core, noisy) - clean for noisy in record.draws(disturb, count)])


def rms(vectors: FloatArray) -> float:
    """Root of the mean squared length of the rows."""
    return float(np.sqrt((vectors**2).sum(axis=1).mean()))


def name_of(method: str, *, whole: bool) -> str:
    """With its form, where there are two."""
    return method if method == "two-sample" else f"{method}-{'blocks' if whole else 'stream'}"


def amplification(name: str, rate_hz: int, kind: str) -> tuple[list[Row], dict[str, float]]:
    """Rows of a motion, rate and kind of disturbance; attitude error over that of two-sample by method."""
    record = Record(motion(name), rate_hz, AMPLIFIED_S)
    disturb = quantised if kind == "quantised" else white(GRADES[0])
    found = {name_of(m, whole=w): responses(record, disturb, DRAWS, m, whole=w) for m, w in METHODS}
    base = found.pop("two-sample")
    plain = rms(record.plain(record.draws(disturb, DRAWS)))
    key, where = f"{kind}-{name}-{rate_hz}hz", f"{kind} increments, {name}, {rate_hz} Hz"
    what = f"{where}: attitude error of two-sample over the plain sum of the increments' errors"
    rows = [near(f"{key}-plain", what, rms(base[:, 3:]) / plain, "1", 0.02, reference=1.0)]
    ratios: dict[str, float] = {}
    for quantity, part in (("position", slice(0, 3)), ("attitude", slice(3, 6))):
        ratios = {method: rms(errors[:, part]) / rms(base[:, part]) for method, errors in found.items()}
        if name == "rest" or kind == "white":
            change = max(abs(ratio - 1.0) for ratio in ratios.values())
            what = f"{where}: {quantity} error over that of two-sample, less 1, the largest of all N"
            rows.append(at_most(f"{key}-{quantity}", what, change, "1", 0.01))
        else:
            what = f"{where}: {quantity} error over that of two-sample"
            rows += [shown(f"{key}-{quantity}-{m}", f"{what}: {m}", ratio, "1") for m, ratio in ratios.items()]
    return rows, ratios


def _amplification() -> tuple[list[Row], list[Plot]]:
    rows, lines = [], []
    for kind in ("white", "quantised"):
        for name in ("rest", "agile", "shaken"):
            for rate in RATES_HZ:
                more, ratios = amplification(name, rate, kind)
                rows += more
                for form in ("stream", "blocks"):
                    y = np.array([ratios[f"high-order:{n}-{form}"] for n in ORDERS])
                    lines.append(Line(f"{kind}, {name}, {rate} Hz, {form}", np.array(ORDERS, float), y, ".-"))
    return rows, [Plot("amplification", "Attitude error due to noise, over that of two-sample", "N", "1", lines)]


def _theory() -> list[Row]:
    """At rest the errors have closed forms: random walks, the fall of a tilted platform, a residue at both ends."""
    record, t = Record(motion("rest"), 100, AMPLIFIED_S), AMPLIFIED_S
    rows = []
    for grade in GRADES:
        errors = responses(record, white(grade), CHOICE_DRAWS, "two-sample", whole=False)
        turn = grade.angle * math.sqrt(3.0 * t)
        place = math.sqrt(grade.velocity**2 * t**3 + (G * grade.angle) ** 2 * t**5 / 10.0)
        for quantity, ours, closed, unit in (
            ("attitude", rms(errors[:, 3:]), turn, "rad"),
            ("position", rms(errors[:, :3]), place, "m"),
        ):
            what = f"rest, 60 s, white noise of {grade.name}: {quantity} error (reference: closed form)"
            rows.append(near(f"rest-{grade.name}-{quantity}", what, ours, unit, 0.25 * closed, reference=closed))
    residue = rms(responses(record, quantised, CHOICE_DRAWS, "two-sample", whole=False)[:, 3:])
    closed = ANGLE_LSB * math.sqrt(0.5)
    what = "rest, 60 s, quantised: attitude error (reference: of the residues at both ends)"
    rows.append(near("rest-quantised-attitude", what, residue, "rad", 0.25 * closed, reference=closed))
    return rows


def _choice() -> tuple[list[Row], list[Plot]]:
    """What each order leaves out beside the noise of each grade, and the least N that is exact enough."""
    rows, plots = [], []
    for name in ("agile", "shaken"):
        lines = []
        records = {rate: Record(motion(name), rate, CHOICE_S) for rate in RATES_HZ}
        noise = {}
        for grade in GRADES:  # white noise of a density: the same at every rate
            errors = responses(records[100], white(grade), CHOICE_DRAWS, "two-sample", whole=False)
            noise[grade.name] = place, turn = rms(errors[:, :3]), rms(errors[:, 3:])
            what = f"{name} flight, {CHOICE_S:g} s, white noise of {grade.name}"
            rows.append(shown(f"noise-{name}-{grade.name}-attitude", f"{what}: attitude error", turn, "rad"))
            rows.append(shown(f"noise-{name}-{grade.name}-position", f"{what}: position error", place, "m"))
            lines.append(Line(f"noise of {grade.name}", np.array([2.0, 8.0]), np.array([turn, turn]), "--"))
        for rate, record in records.items():
            for form in ("stream", "blocks"):
                left = {n: _left_out(record, n, whole=form == "blocks") for n in (2, *ORDERS)}
                key, where = f"{name}-{rate}hz-{form}", f"{name} flight, {CHOICE_S:g} s, {rate} Hz, {form}"
                for n, (place, turn) in left.items():
                    what = f"{where}: N = {n}, error-free increments"
                    rows.append(shown(f"left-{key}-{n}-attitude", f"{what}: attitude error", turn, "rad"))
                    rows.append(shown(f"left-{key}-{n}-position", f"{what}: position error", place, "m"))
                rows += [_least(key, where, left, grade, noise[grade.name]) for grade in GRADES]
                y = np.array([turn for _, turn in left.values()])
                lines.append(Line(f"left out, {rate} Hz, {form}", np.array([*left], float), y, ".-"))
        title = f"Attitude error after {CHOICE_S:g} s, {name} flight"
        plots.append(Plot(f"choice-{name}", title, "N", "rad", lines, log=True))
    return rows, plots


def _left_out(record: Record, n: int, *, whole: bool) -> tuple[float, float]:
    """Position, m, and attitude error, rad, on error-free increments with N samples."""
    core = Strapdown("two-sample" if n == 2 else f"high-order:{n}", "inertial", whole_record=whole)
    off = record.error(core, record.exact)
    return float(np.linalg.norm(off[:3])), float(np.linalg.norm(off[3:]))


def _least(key: str, where: str, left: dict[int, tuple[float, float]], grade: Grade, noise: tuple[float, float]) -> Row:
    enough = [n for n, errors in left.items() if all(e <= SHARE * s for e, s in zip(errors, noise, strict=True))]
    what = f"{where}: least N that leaves out less than {SHARE:g} of the error due to the noise of {grade.name}"
    return shown(f"least-{key}-{grade.name}", what, min(enough, default=math.nan), "samples")


def run() -> Study:
    """All of it."""
    rows, plots = _amplification()
    rows += _theory()
    more_rows, more_plots = _choice()
    about = (
        "Noise and quantisation through the two-sample algorithm and high order, N = 3 to 8, as a stream and in blocks of "
        "the record; inertial mechanization. Agile: as in the study of navigation, from rest; shaken: with coning of 1 deg at "
        "10 Hz on top. Amplification after 60 s, each method on the same draws. Then what each N leaves out in 600 s "
        "beside the error due to the white noise of each grade."
    )
    return Study("noise", "Noise and the order of the core", about, rows + more_rows, [*plots, *more_plots])
