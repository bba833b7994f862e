"""A flight over the pole: every mechanization closes on the truth, the geographic one by handing over to wander."""

import math

import numpy as np

from hil.study.navigation.flights import fly
from hil.study.report import Line, Plot, Row, at_most, near, shown
from hil.world.pole import PoleFlight
from nav.earth import E2, A
from nav.mechanization.geographic import MAX_LAT
from nav.strapdown import Strapdown

POLE_S, POLE_STEP_S = 600.0, 0.01
LIMIT_M = 1e-6
"""For high order."""


def over_the_pole() -> tuple[list[Row], list[Plot]]:
    """600 s over the north pole, crossed in the middle of a step half way."""
    motion = PoleFlight(crossing_s=0.5 * (POLE_S + POLE_STEP_S))
    cores = {
        f"{mechanization}-{method}": Strapdown(method, mechanization, whole_record=True)
        for mechanization in ("geographic", "wander", "inertial", "earth")
        for method in ("two-sample", "high-order:4")
    }
    time, errors = fly(motion, POLE_STEP_S, cores, POLE_S)
    rows = [_hand_over(motion)]
    for name, error in errors.items():
        key, what = f"pole-{name}", f"over the pole, {POLE_S:g} s, 10 ms: {name.replace('-', ', ', 1)}"
        if "high-order" in name:
            rows.append(at_most(key, what, error.max(), "m", LIMIT_M))
        else:
            rows.append(shown(key, what, error.max(), "m"))
    lines = [Line(name, time, error) for name, error in errors.items()]
    return rows, [Plot("pole", "Position error over the pole, 10 ms", "s", "m", lines, log=True)]


def _hand_over(motion: PoleFlight) -> Row:
    """Where the geographic mechanization hands over."""
    core, n = Strapdown("high-order:4", whole_record=True), round(POLE_S / POLE_STEP_S)
    truth = motion.truth([0.0])[0]
    core.start(truth["lat"], truth["lon"], truth["height"], truth["vel_n"], truth["q_nb"])
    dtheta, dvel, position = np.empty((n, 3)), np.empty((n, 3)), np.empty((n, 3))
    motion.increments(0, n, POLE_STEP_S, dtheta, dvel)
    out = position, np.empty((n, 3)), np.empty((n, 4))
    done = core.advance(np.full(n, POLE_STEP_S), dtheta, dvel, np.zeros(3), *out)
    radius = A / math.sqrt(1.0 - E2)
    left = radius * math.cos(position[done - 1, 0])
    what = "over the pole: distance at which geographic hands over to wander (reference: where no step starts any more)"
    return near("pole-hand-over", what, left, "m", 5.0, reference=radius * math.cos(MAX_LAT))
