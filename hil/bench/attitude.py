"""Every attitude method: a whole record at once, and one sample a call."""

from collections.abc import Iterator
from functools import partial

import numpy as np

from hil.bench.timing import Row, Sizes, Work, rows_in_turns
from hil.study.orientation.measure import METHODS
from nav.attitude import AttitudeMethod, method
from nav.attitude.signals import Swinging
from nav.increments import FloatArray

STEP_S = 0.005
NAMES = tuple(name for name in METHODS if not name.startswith("high-order") or name[-1] in "468")


def rows(sizes: Sizes) -> list[Row]:
    """Rows of every method."""
    batch = sizes.batch // 10
    dtheta = Swinging().increments(STEP_S * np.arange(batch + 1))
    return rows_in_turns(list(_works(dtheta, sizes.calls)), sizes.repeats)


def _works(dtheta: FloatArray, calls: int) -> Iterator[Work]:
    step, q0 = np.full(len(dtheta), STEP_S), np.array([1.0, 0.0, 0.0, 0.0])
    pieces = [dtheta[i : i + 1] for i in range(calls)]
    for name in NAMES:
        chosen = method(name)
        whole = partial(chosen.integrate, q0, step, dtheta)
        yield Work(f"attitude-{name}", f"attitude, batch: {name}", whole, len(dtheta))
        single = partial(_one_by_one, chosen, q0, step[:1], pieces)
        yield Work(f"attitude-call-{name}", f"attitude, one sample a call: {name}", single, calls)


def _one_by_one(chosen: AttitudeMethod, q0: FloatArray, step: FloatArray, pieces: list[FloatArray]) -> None:
    stream, out = chosen.stream(q0), np.empty((1, 4))
    for piece in pieces:
        stream.push(step, piece, out)
