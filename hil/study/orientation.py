"""Attitude methods on motions in closed form: the figures of Fomichev 2011, coning, and the order of every method.

An error is the rotation from the true attitude to the computed one, the largest at block ends.
"""

import math
from importlib import import_module
from typing import Any

import numpy as np

from hil.study.report import Line, Plot, Row, Study, at_most, near, shown
from nav.attitude import method
from nav.attitude.signals import Coning, Precession, Signal, Swinging
from nav.increments import FloatArray
from nav.rotation import attitude_error

ARCSEC = math.pi / 648000.0
SOURCE_RATE_HZ = 40.0
"""Attitude rate of the source; four samples each."""
METHODS = (
    "poisson-rk4",
    "euler-vector-rk4",
    "picard3",
    "picard3-source",
    "four-sample",
    "four-sample-series",
    *(f"coning:{n}" for n in range(1, 6)),
    *(f"coning-uncompressed:{n}" for n in range(2, 6)),
    *(f"coning-stream:{n}" for n in range(2, 6)),
    *(f"high-order:{n}" for n in range(2, 9)),
    *(f"high-order-stream:{n}" for n in range(2, 9)),
)
"""All, but for the same arithmetic under another name (one sample; high order beyond eight)."""
CONES_DEG, FREQUENCIES_HZ = (1.0, 10.0), (1.0, 10.0, 74.0)
CONING_SAMPLE_HZ, CONING_S = 1000.0, 10.0
UNEQUAL = np.array([1.04, 1.4, 0.68, 1.2, 0.76])
"""Pattern of unequal steps."""
ORDERS: dict[str, tuple[float, float]] = {
    "poisson-rk4": (4, 4),
    "euler-vector-rk4": (4, 4),
    "picard3": (3, 3),
    "picard3-source": (3, 2),
    "four-sample": (4, 2),
    "four-sample-series": (4, 2),
    "coning:1": (2, 2),
    "coning:2": (4, 3),
    "coning:3": (3, 2),
    "coning:4": (3, 2),
    "coning:5": (3, 2),
    "coning-uncompressed:2": (4, 3),
    "coning-uncompressed:3": (4, 2),
    "coning-uncompressed:4": (4, 2),
    "coning-uncompressed:5": (4, 2),
    "coning-stream:2": (3, 3),
    "coning-stream:3": (3, 2),
    "coning-stream:4": (3, 2),
    "coning-stream:5": (3, 2),
    "high-order:2": (4, 3),
    "high-order:3": (4, 4),
    "high-order:4": (6, 5),
    "high-order:5": (6, 6),
    "high-order:6": (8, 7),
    "high-order:7": (8, 8),
    "high-order:8": (10, 9),
    "high-order-stream:2": (3, 3),
    "high-order-stream:3": (4, 4),
    "high-order-stream:4": (5, 5),
    "high-order-stream:5": (6, 6),
    "high-order-stream:6": (7, 7),
    "high-order-stream:7": (8, 8),
    "high-order-stream:8": (9, 9),
}
"""Order of the attitude error in the step, for equal and for unequal steps."""


def errors(name: str, signal: Signal, edges: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Attitude error at block ends.

    Parameters
    ----------
    name : str
        Attitude method.
    signal : Signal
        The motion.
    edges : (n + 1,) float
        Ends of the steps, s, the first at the start.

    Returns
    -------
    time, error : (n // block,) float
        s and rad.
    """
    chosen = method(name)
    q = chosen.block_ends(signal.attitude(edges[:1])[0], np.diff(edges), signal.increments(edges))
    time = edges[chosen.block :: chosen.block][: len(q)]
    return time, np.linalg.norm(attitude_error(q, signal.attitude(time)), axis=1)


def uniform(duration: float, rate_hz: float) -> FloatArray:
    """Ends of equal steps."""
    return np.arange(round(duration * rate_hz) + 1) / rate_hz


def _precession_error(
    name: str, pulsation: float, nutation_deg: float, duration: float
) -> tuple[FloatArray, FloatArray]:
    signal = Precession(pulsation, pulsation, math.radians(nutation_deg))
    time, error = errors(name, signal, uniform(duration, 4.0 * SOURCE_RATE_HZ))
    return time, error / ARCSEC


def _series_drift(spin: float, duration: float) -> float:
    """Error that the series quaternion of the source makes in a pure spin, in closed form, arc seconds."""
    angle = spin / SOURCE_RATE_HZ
    g = angle * angle
    turned = 2.0 * math.atan2(angle * (0.5 - g / 48.0 + g * g / 3840.0), 1.0 - g / 8.0 + g * g / 384.0)
    return abs(turned - angle) * SOURCE_RATE_HZ * duration / ARCSEC


def _spin_drift(name: str, spin: float, duration: float) -> float:
    _, error = errors(name, Precession(spin, 0.0, 0.0), uniform(duration, 4.0 * SOURCE_RATE_HZ))
    return float(error[-1]) / ARCSEC


def _published() -> tuple[list[Row], list[Plot]]:
    """The figures of the source, within 30 %: they are printed to one or two digits."""
    turn = 2.0 * math.pi
    time, error = _precession_error("four-sample", turn, 45.0, 1.0)
    peak = int(error.argmax())
    angles = np.arange(0.0, 181.0, 2.0)
    at_half = np.array([_precession_error("four-sample", turn, a, 0.5)[1][-1] for a in angles])
    rows = [
        near("fomichev-peak", "W = w = 2 pi, 45 deg: largest error", error[peak], '"', 0.75, published=2.5),
        near("fomichev-peak-time", "W = w = 2 pi, 45 deg: time of it", time[peak], "s", 0.025, published=0.5),
        at_most(
            "fomichev-whole-turn", "W = w = 2 pi, 45 deg: error after the turn", error[-1], '"', 0.1, published=0.0
        ),
        near(
            "fomichev-worst-angle",
            "W = w = 2 pi: worst nutation angle",
            angles[at_half.argmax()],
            "deg",
            6.0,
            published=60,
        ),
        near(
            "fomichev-worst", "W = w = 2 pi: error at the worst angle, 0.5 s", at_half.max(), '"', 0.81, published=2.7
        ),
    ]
    for key, pulsation, duration, published in (("1.5pi", 1.5, 0.75, 1.0), ("pi", 1.0, 1.0, 0.15)):
        ours = _precession_error("four-sample", pulsation * math.pi, 60.0, duration)[1][-1]
        what = f"W = w = {key.replace('pi', ' pi').strip()}, 60 deg: error at {duration:g} s"
        rows.append(near(f"fomichev-{key}", what, ours, '"', 0.3 * published, published=published))
    for key, spin, duration, published, what in (
        ("4pi", 4.0, 0.5, 0.029, "pure spin 4 pi, series quaternion: error in a turn"),
        ("2pi", 2.0, 60.0, 0.03, "pure spin 2 pi, series quaternion: error in 60 s"),
    ):
        ours = _spin_drift("four-sample-series", spin * math.pi, duration)
        closed = _series_drift(spin * math.pi, duration)
        rows.append(
            near(f"fomichev-spin-{key}", what, ours, '"', 0.3 * published, published=published, reference=closed)
        )
    exact = _spin_drift("four-sample", 2.0 * math.pi, 60.0)
    rows.append(at_most("fomichev-spin-exact", "the same with the exact quaternion", exact, '"', 1e-6, published=0.0))
    rows += _growth()
    _, better = _precession_error("high-order:4", turn, 60.0, 0.5)
    gain = better.max() / at_half.max()
    rows.append(at_most("precession-high-order", "high-order:4 over four-sample, the same samples", gain, "1", 0.01))
    plots = [
        Plot(
            "time",
            "Regular precession, W = w = 2 pi, 45 deg (source: fig. 1)",
            "s",
            "arc seconds",
            [Line("", time, error)],
        ),
        Plot(
            "angle",
            "W = w = 2 pi, error at 0.5 s (source: fig. 3)",
            "nutation, deg",
            "arc seconds",
            [Line("", angles, at_half)],
        ),
    ]
    return rows, plots


def _growth() -> list[Row]:
    """The source's incommensurate precession, of which it says that the error oscillates and does not grow.

    The errors of all blocks are the same in axes that turn with the precession, so what one block adds along the
    precession axis adds up. In the first seconds the oscillation hides it.
    """
    signal = Precession(2.0 * math.pi, math.sqrt(3.0) * math.pi, math.pi / 4.0)
    _, error = errors("four-sample", signal, uniform(120.0, 4.0 * SOURCE_RATE_HZ))
    half = len(error) // 2
    growth = (error[half:].max() - error[:half].max()) / 60.0 / ARCSEC
    edges = uniform(1.0 / SOURCE_RATE_HZ, 4.0 * SOURCE_RATE_HZ)
    q = method("four-sample").block_ends(signal.attitude(edges[:1])[0], np.diff(edges), signal.increments(edges))
    of_a_block = abs(attitude_error(q, signal.attitude(edges[-1:]))[0, 2]) * SOURCE_RATE_HZ / ARCSEC
    what = "W = 2 pi, w = sqrt 3 pi, 45 deg"
    return [
        shown("fomichev-swing", f"{what}: largest error of the first second", error[:40].max() / ARCSEC, '"'),
        near(
            "fomichev-growth",
            f"{what}: growth of the error (the source: none; reference: of one block, along the precession axis)",
            growth,
            '"/s',
            0.1 * of_a_block,
            reference=of_a_block,
        ),
    ]


def _coning() -> tuple[list[Row], list[Plot]]:
    ten = math.radians(10.0)
    rows = []
    for key, name, frequency, rate, duration, limit in (
        ("10hz-4", "high-order:4", 10.0, 1000.0, 10.0, 2e-8),
        ("10hz-6", "high-order:6", 10.0, 1000.0, 10.0, 1e-10),
        ("10hz-8", "high-order:8", 10.0, 1000.0, 10.0, 1e-10),
        ("2hz-100hz-4", "high-order:4", 2.0, 400.0, 6.0, 1e-9),
        ("15hz-100hz-8", "high-order:8", 15.0, 800.0, 6.0, 1e-9),
    ):
        _, error = errors(name, Coning(ten, frequency), uniform(duration, rate))
        what = f"coning 10 deg, {frequency:g} Hz, {rate:g} Hz samples, {duration:g} s: {name}"
        rows.append(at_most(f"coning-goal-{key}", what, error.max(), "rad", limit))
    edges = uniform(CONING_S, CONING_SAMPLE_HZ)
    for cone in CONES_DEG:
        for frequency in FREQUENCIES_HZ:
            signal = Coning(math.radians(cone), frequency)
            for name in METHODS:
                ours = errors(name, signal, edges)[1].max()
                peer = _pyins_error(signal, edges) if name == "coning-stream:2" else None
                of_peer = "" if peer is None else " (reference: pyins)"
                what = f"coning {cone:g} deg, {frequency:g} Hz, 1 kHz samples, 10 s: {name}{of_peer}"
                rows.append(shown(f"coning-{cone:g}deg-{frequency:g}hz-{name}", what, ours, "rad", reference=peer))
    frequencies = np.geomspace(1.0, 100.0, 21)
    edges = uniform(1.0, CONING_SAMPLE_HZ)
    lines = [
        Line(name, frequencies, np.array([errors(name, Coning(ten, f), edges)[1].max() for f in frequencies]))
        for name in (
            "poisson-rk4",
            "picard3",
            "four-sample",
            "coning:3",
            "coning-stream:4",
            "high-order:4",
            "high-order:8",
        )
    ]
    return rows, [
        Plot("coning", "Coning of 10 deg, 1 kHz samples, 1 s", "cone frequency, Hz", "error, rad", lines, log=True)
    ]


def _pyins_error(signal: Signal, edges: FloatArray) -> float | None:
    """Largest error of the peer's attitude increments, composed exactly; None where it is not installed."""
    try:
        pandas: Any = import_module("pandas")
        strapdown: Any = import_module("pyins.strapdown")
        util: Any = import_module("pyins.util")
    except ImportError:
        return None
    dtheta = signal.increments(np.concatenate([[2.0 * edges[0] - edges[1]], edges]))
    columns = [*util.GYRO_COLS, *util.ACCEL_COLS]
    imu = pandas.DataFrame(np.hstack([dtheta, np.zeros_like(dtheta)]), index=pandas.Index(edges), columns=columns)
    increments = strapdown.compute_increments_from_imu(imu, "increment")
    turns = increments[["theta_x", "theta_y", "theta_z"]].to_numpy()
    q = method("coning:1").integrate(signal.attitude(edges[:1])[0], np.diff(edges), turns)
    return float(np.linalg.norm(attitude_error(q, signal.attitude(edges[1:])), axis=1).max())


def order(name: str, *, unequal: bool, duration: float = 4.0) -> tuple[float, FloatArray, FloatArray]:
    """Order of a method on a motion without symmetry.

    Returns
    -------
    order : float
        Slope of log(error) over log(step), where the error is well above rounding.
    step, error : (4,) float
        Mean step, s, and largest error, rad.
    """
    counts = 240 * 2 ** np.arange(4) if ORDERS[name][0] < 7 else 96 * 2 ** np.arange(4)
    signal = Swinging()
    largest = []
    for count in counts:
        ends = np.arange(count + 1.0)
        if unequal:
            ends[1:] = np.cumsum(np.resize(UNEQUAL, count))
        largest.append(errors(name, signal, ends * (duration / ends[-1]))[1].max())
    step, error = duration / counts, np.array(largest)
    clear = error > 1e-12
    slope = np.polyfit(np.log(step[clear]), np.log(error[clear]), 1)[0]
    return float(slope), step, error


def _orders() -> tuple[list[Row], list[Plot]]:
    rows, lines = [], []
    for name, expected in ORDERS.items():
        for unequal in (False, True):
            slope, step, error = order(name, unequal=unequal)
            kind = "unequal" if unequal else "equal"
            key, what = f"order-{name}-{kind}", f"order of {name}, {kind} steps"
            if expected[unequal] == expected[0]:
                rows.append(near(key, what, slope, "1", 0.1 * expected[unequal], reference=expected[unequal]))
            else:  # what asymmetry costs shows in short steps only: the slope lies anywhere between the two orders
                rows.append(shown(key, what, slope, "1", reference=expected[unequal]))
            if not unequal:
                lines.append(Line(name, step, error, ".-"))
    return rows, [
        Plot("order", "Largest error on a motion without symmetry, 4 s", "step, s", "error, rad", lines, log=True)
    ]


def run() -> Study:
    """All of it."""
    rows: list[Row] = []
    plots: list[Plot] = []
    for part in (_published, _coning, _orders):
        more_rows, more_plots = part()
        rows += more_rows
        plots += more_plots
    about = (
        "Attitude from exact increments of motions known in closed form. Error: the largest rotation between computed and "
        "true attitude at block ends. Precession: 40 attitudes a second, four samples each, as in the source. Orders: slopes "
        "over three halvings of the step."
    )
    return Study("orientation", "Attitude methods", about, rows, plots)
