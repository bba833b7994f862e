"""The methods, and the error of one on a motion in closed form."""

import numpy as np

from nav.attitude import method
from nav.attitude.signals import Signal
from nav.increments import FloatArray
from nav.rotation import attitude_error

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
METHODS = tuple(ORDERS)
"""All, but for the same arithmetic under another name (one sample) and high order beyond eight."""


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
