"""A flight over the pole: the frames without a singular place close on the truth, the geographic one refuses."""

import math

import numpy as np

from hil.study.navigation.flights import fly
from hil.study.report import Line, Plot, Row, at_most, near, shown
from hil.world.pole import PoleFlight
from nav.earth import E2, A
from nav.mechanization.geographic import POLAR_CAP
from nav.strapdown import Strapdown

POLE_S, POLE_STEP_S = 600.0, 0.01
LIMIT_M = 1e-6
"""For high order."""


def over_the_pole() -> tuple[list[Row], list[Plot]]:
    """600 s over the north pole, crossed in the middle of a step half way."""
    motion = PoleFlight(crossing_s=0.5 * (POLE_S + POLE_STEP_S))
    cores = {
        f"{mechanization}-{method}": Strapdown(method, mechanization, whole_record=True)
        for mechanization in ("wander", "inertial", "earth")
        for method in ("two-sample", "high-order:4")
    }
    time, errors = fly(motion, POLE_STEP_S, cores, POLE_S)
    rows = [_refusal(motion)]
    for name, error in errors.items():
        key, what = f"pole-{name}", f"over the pole, {POLE_S:g} s, 10 ms: {name.replace('-', ', ', 1)}"
        if "high-order" in name:
            rows.append(at_most(key, what, error.max(), "m", LIMIT_M))
        else:
            rows.append(shown(key, what, error.max(), "m"))
    lines = [Line(name, time, error) for name, error in errors.items()]
    return rows, [Plot("pole", "Position error over the pole, 10 ms", "s", "m", lines, log=True)]


def _refusal(motion: PoleFlight) -> Row:
    """Where the geographic mechanization stops."""
    core, n = Strapdown("high-order:4", whole_record=True), round(POLE_S / POLE_STEP_S)
    truth = motion.truth([0.0])[0]
    core.start(truth["lat"], truth["lon"], truth["height"], truth["vel_n"], truth["q_nb"])
    dtheta, dvel, position = np.empty((n, 3)), np.empty((n, 3)), np.empty((n, 3))
    motion.increments(0, n, POLE_STEP_S, dtheta, dvel)
    core.advance(np.full(n, POLE_STEP_S), dtheta, dvel, np.zeros(3), position, np.empty((n, 3)), np.empty((n, 4)))
    radius = A / math.sqrt(1.0 - E2)
    left = radius * math.cos(core.solution[0])
    what = "over the pole: geographic refuses; distance from the pole where it stops (reference: its polar cap)"
    return near("pole-geographic", what, left, "m", 5.0, reference=radius * POLAR_CAP)
