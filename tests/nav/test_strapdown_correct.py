"""Corrections of a running core, and its memory."""

import numpy as np
import pytest

from hil.geometry import position_error
from hil.study.navigation.flights import flight
from nav.rotation import attitude_error
from nav.strapdown import MECHANIZATIONS, Strapdown

MOTION = flight("agile")
STEP = 0.01
N = 600
DTHETA, DVEL = np.empty((N, 3)), np.empty((N, 3))
MOTION.increments(0, N, STEP, DTHETA, DVEL)
CORES = [("two-sample", name) for name in MECHANIZATIONS] + [
    (name, "geographic") for name in ("high-order:6", "picard3", "coning:3")
]
ERRORS = np.array([30.0, -50.0, 20.0]), np.array([0.5, -1.0, 0.3]), np.array([0.02, -0.3, 0.1])


def started(attitude, mechanization):
    core, row = Strapdown(attitude, mechanization), MOTION.truth([0.0])[0]
    core.start(row["lat"], row["lon"], row["height"], row["vel_n"], row["q_nb"])
    return core


def advance(core, first, stop):
    n = stop - first
    out = np.empty((n, 3)), np.empty((n, 3)), np.empty((n, 4))
    core.advance(np.full(n, STEP), DTHETA[first:stop], DVEL[first:stop], np.zeros(3), *out)
    return np.hstack(out)


def difference(a, b):
    """Position, velocity, attitude of `a` less those of `b`."""
    place = np.zeros(1, [("lat", "<f8"), ("lon", "<f8"), ("height", "<f8")])
    place["lat"], place["lon"], place["height"] = b[:3]
    offset = position_error(a[0:1], a[1:2], a[2:3], place)[0]
    return offset, a[3:6] - b[3:6], attitude_error(a[6:10], b[6:10])


@pytest.mark.parametrize(("attitude", "mechanization"), CORES)
@pytest.mark.parametrize("at", [3, 301])
def test_what_is_taken_off_is_off_and_the_stream_goes_on(attitude, mechanization, at):
    """After the correction and its opposite the run is that of an undisturbed core."""
    core, calm = started(attitude, mechanization), started(attitude, mechanization)
    advance(core, 0, at)
    advance(calm, 0, at)
    before = core.solution.copy()
    core.correct(*ERRORS)
    for found, expected in zip(difference(before, core.solution), ERRORS, strict=True):
        np.testing.assert_allclose(found, expected, rtol=2e-5)
    core.correct(*(-part for part in difference(calm.solution, core.solution)))
    after, expected = advance(core, at, N)[-1], advance(calm, at, N)[-1]
    for found, size in zip(difference(after, expected), (1e-3, 1e-4, 1e-7), strict=True):
        assert np.abs(found).max() < size


@pytest.mark.parametrize(("attitude", "mechanization"), CORES)
def test_recalled_it_answers_the_same_bits(attitude, mechanization):
    core = started(attitude, mechanization)
    for at in (2, 250):
        advance(core, 0, at)
        memory = core.memory()
        first = advance(core, at, at + 50)
        for _ in range(2):
            core.recall(memory)
            assert (advance(core, at, at + 50) == first).all()


def test_push_goes_on_after_a_correction():
    core, other = started("two-sample", "geographic"), started("two-sample", "geographic")
    for k in range(50):
        if k == 25:
            core.correct(*ERRORS)
        core.push(STEP, *DTHETA[k], *DVEL[k])
    advance(other, 0, 25)
    other.correct(*ERRORS)
    advance(other, 25, 50)
    assert (core.solution == other.solution).all()
