"""The order of every method, for equal and for unequal steps."""

import numpy as np

from hil.study.orientation.measure import ORDERS, errors
from hil.study.report import Line, Plot, Row, near, shown
from nav.attitude.signals import Swinging
from nav.increments import FloatArray

UNEQUAL = np.array([1.04, 1.4, 0.68, 1.2, 0.76])
"""Pattern of unequal steps."""


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


def all_orders() -> tuple[list[Row], list[Plot]]:
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
