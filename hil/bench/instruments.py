"""The instruments: what the core takes off, and what the simulated head is made of."""

from collections.abc import Iterator
from dataclasses import replace
from functools import partial

import numpy as np

from hil.bench.timing import Row, Sizes, Work, rows_in_turns
from nav.increments import HeadIncrements
from nav.instruments.accelerometer_errors import Accelerometers
from nav.instruments.calibration import CASES, Calibration, Calibrator
from nav.instruments.dtg_compensation import LagCompensator
from nav.instruments.grades import GRADES
from nav.instruments.gyro_errors import Gyros
from nav.instruments.layout import ideal_layout
from nav.instruments.pendulum import Pendulum
from nav.instruments.rebalance import PendulumBlock
from nav.instruments.size_effect import MEMORY, compensate, size_coefficients


def rows(sizes: Sizes) -> list[Row]:
    """Rows of every instrument."""
    n = min(sizes.batch, 20_000)
    block, (gyro_errors, force_errors) = ideal_layout(Pendulum()), GRADES["dtg"].draw(np.random.default_rng(0))
    step, rng = 1e-3, np.random.default_rng(1)
    dtheta, dvel = rng.normal(0.0, 1e-3, (n, 3)), rng.normal(0.0, 1e-2, (n, 3))
    steps, out = np.full(n, step), np.empty_like(dvel)
    memory, coefficients = np.zeros(MEMORY), size_coefficients(block)
    moving = PendulumBlock(block, 1.0 / 8000.0)
    force, rate = rng.normal(0.0, 1.0, (2, 2 * n + 1, 3))
    gyros, forces = Gyros(gyro_errors, step, rng), Accelerometers(force_errors, step, rng)
    works = [
        *_lag(n, rng),
        _calibration(n, rng),
        Work(
            "size-effect",
            "size effect of three pendulums, compensated",
            lambda: compensate(memory, coefficients, steps, dtheta, dvel, out),
            n,
        ),
        Work("pendulums", "three pendulums in full, a step of 1/8000 s", lambda: moving.sense(force, rate), n),
        Work("gyro-errors", "errors of four gyro channels, DTG head", lambda: gyros.sense(dtheta, dvel), n),
        Work("force-errors", "errors of three accelerometers, DTG head", lambda: forces.sense(dvel), n),
    ]
    return rows_in_turns(works, sizes.repeats)


def _calibration(n: int, rng: np.random.Generator) -> Work:
    gyros, forces = replace(GRADES["dtg"], gyro_channels=CASES).draw(rng)
    calibrator, head = Calibrator(Calibration(gyros, forces), 0.0), HeadIncrements.empty(n)
    head.step[:], head.temperature[:] = 1e-3, 40.0
    gyro, dvel = rng.normal(0.0, 1e-3, (n, 4)), rng.normal(0.0, 1e-2, (n, 3))
    what = "calibration of four gyro axes and three accelerometers, batch"
    return Work("calibration", what, lambda: calibrator.take_off(head, gyro, dvel), n)


def _lag(n: int, rng: np.random.Generator) -> Iterator[Work]:
    for name, what, angle in (("wire", "rotor angles on the wire", 0.0), ("cubic", "increments alone", np.nan)):
        head, compensator, out = HeadIncrements.empty(n), LagCompensator(), np.empty((n, 4))
        head.step[:], head.sequence[:] = 1e-3, np.arange(n)
        head.dtheta[:], head.rotor[:] = rng.normal(0.0, 1e-3, (n, 4)), angle
        run = partial(compensator.compensate, head, out)
        yield Work(f"lag-{name}", f"lag compensation of both gyros, batch: {what}", run, n)
