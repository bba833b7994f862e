"""How exact each method is by flight and step, its order, and the reference frames side by side."""

import numpy as np

from hil.study.navigation.flights import DURATION_S, flight, fly
from hil.study.navigation.source import gravity_lag
from hil.study.report import Line, Plot, Row, at_most, near, shown
from nav.increments import FloatArray
from nav.strapdown import MECHANIZATIONS, Strapdown

METHODS = ("two-sample", "high-order:4", "high-order:6", "high-order:8")
LIMITS_M = {("agile", 10): 2e-3, ("agile", 1): 1e-6, ("smooth", 10): 1e-5, ("smooth", 1): 1e-6}
"""For high order, by flight and step in ms."""
ORDER_STEPS_S, ORDER_S = (0.025, 0.05, 0.1), 96.0
ORDERS = {
    "two-sample": 3,
    "high-order:3": 4,
    "high-order:4": 6,
    "high-order:5": 6,
    "high-order:6": None,
    "high-order:8": None,
}
"""By method, in blocks of the whole record; none where the error of steps so short is soon that of the mechanization."""


def exact_flights() -> tuple[list[Row], list[Plot]]:
    rows, plots = [], []
    for (name, step_ms), limit in LIMITS_M.items():
        cores = {method: Strapdown(method, whole_record=True) for method in METHODS}
        time, errors = fly(flight(name), 1e-3 * step_ms, cores)
        for method, error in errors.items():
            key, what = f"{name}-{step_ms}ms-{method}", f"{name} flight, {DURATION_S:g} s, {step_ms} ms: {method}"
            if method == "two-sample":
                rows.append(shown(key, what, error.max(), "m"))
            else:
                rows.append(at_most(key, what, error.max(), "m", limit))
        if step_ms == 10:
            lines = [Line(method, time, error) for method, error in errors.items()]
            title = f"Position error, {name} flight, 10 ms, geographic"
            plots.append(Plot(f"{name}-10ms", title, "s", "m", lines, log=True))
    return rows, plots


def frame_cores() -> dict[str, Strapdown]:
    """Every mechanization, with the body integrals of high order where it takes them."""
    cores = {name: Strapdown("high-order:6", name, whole_record=True) for name in MECHANIZATIONS[:-1]}
    return cores | {MECHANIZATIONS[-1]: Strapdown(mechanization=MECHANIZATIONS[-1])}


def frames() -> tuple[list[Row], list[Plot]]:
    """The source's comparison of reference frames, each with the body integrals of high order."""
    cores = frame_cores()
    time, errors = fly(flight("agile"), 0.01, cores)
    rows = []
    for name, error in errors.items():
        if name == "inertial-source":
            what = f"agile flight, 10 ms: {name}, its own attitude (reference: from the lag of gravity)"
            lag = 0.01 * gravity_lag(flight("agile"))[1].max()
            rows.append(shown(f"frame-{name}", what, error.max(), "m", reference=lag))
        else:
            what = f"agile flight, 10 ms, high-order:6: {name}"
            rows.append(at_most(f"frame-{name}", what, error.max(), "m", LIMITS_M["agile", 10]))
    lines = [Line(name, time, error) for name, error in errors.items()]
    return rows, [Plot("frames", "Position error by reference frame, agile flight, 10 ms", "s", "m", lines, log=True)]


def order(method: str, mechanization: str = "geographic") -> tuple[float, FloatArray]:
    """Slope of log(largest position error) over log(step) on the agile flight, and the errors by `ORDER_STEPS_S`, m."""
    core = Strapdown(method, mechanization, whole_record=True)
    found = np.array([fly(flight("agile"), step, {"": core}, ORDER_S)[1][""].max() for step in ORDER_STEPS_S])
    return float(np.polyfit(np.log(ORDER_STEPS_S), np.log(found), 1)[0]), found


def orders() -> tuple[list[Row], list[Plot]]:
    """The order of every method in position."""
    rows, lines = [], []
    for method, expected in ORDERS.items():
        slope, found = order(method)
        key, what = f"order-{method}", f"agile flight, {ORDER_S:g} s, steps of 25 to 100 ms: order of {method}"
        row = shown(key, what, slope, "1") if expected is None else near(key, what, slope, "1", 0.6, reference=expected)
        rows.append(row)
        lines.append(Line(method, np.array(ORDER_STEPS_S), found, ".-"))
    return rows, [Plot("order", f"Position error, agile flight, {ORDER_S:g} s", "step, s", "m", lines, log=True)]
