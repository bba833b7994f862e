"""The size effect of pendulum accelerometers and what is left of it: the figures of source 002/Babich, layouts, the best centre.

An error is the double integral of a channel's output less that of the specific force at O along its xi, without rotation;
for three channels the length of the three. Every record begins with `REST_S` of rest, as after an alignment.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from hil.study.report import Line, Plot, Row, Study, at_most, near, shown
from nav.increments import FloatArray
from nav.instruments.layout import (
    best_centre,
    common_layout,
    honeywell_layout,
    ideal_layout,
    motion_gram,
    moved,
    size_error,
    spectrum_gram,
)
from nav.instruments.pendulum import Pendulum, PendulumBlock
from nav.instruments.size_effect import MEMORY, compensate, integrate_twice, size_coefficients, size_terms

LEVER_M, DURATION_S, REST_S = 0.15, 10.0, 0.1
TURN_RATE, BANK, SPEED_MS, GRAVITY = 0.1, math.pi / 4.0, 100.0, 9.81
VIBRATION_RAD, PULSATION = 0.4e-3, 100.0 * math.pi
PUBLISHED_PULSATION = 300.0
"""The source's "50 Hz", rad/s."""
DYNAMIC_HZ = 8000
"""Steps a second of the pendulums' own motion, and of the exact integrals."""
FAST_HZ = (1000, 2000, 4000)
GOAL_MM = 0.1
"""Of position after 10 s, compensated."""
SKEW = np.array([0.36, -0.48, 0.8])
"""An axis that excites every term."""

Block = Sequence[Pendulum]
Motion = Callable[[FloatArray], tuple[FloatArray, FloatArray]]
"""Specific force at O and rate (n, 3) at times (n,); rest before zero."""


def turn(time: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Coordinated turn in full from time zero: bank of 45 degrees, 0.1 rad/s about the vertical."""
    on = (time >= 0.0)[:, None]
    rate = on * TURN_RATE * np.array([0.0, math.sin(BANK), math.cos(BANK)])
    return np.tile([0.0, 0.0, -GRAVITY / math.cos(BANK)], (len(time), 1)), rate


def rolling_turn(time: FloatArray) -> tuple[FloatArray, FloatArray]:
    """The same turn, rolled into in two seconds."""
    x = np.clip(0.5 * time, 0.0, 1.0)
    bank = BANK * x * x * x * (10.0 - 15.0 * x + 6.0 * x * x)
    roll_rate = BANK * 15.0 * x * x * (1.0 - x) ** 2
    around = GRAVITY * np.tan(bank) / SPEED_MS
    force = np.stack([0.0 * bank, 0.0 * bank, -GRAVITY / np.cos(bank)], axis=1)
    return force, np.stack([roll_rate, around * np.sin(bank), around * np.cos(bank)], axis=1)


def vibration(pulsation: float, axis: FloatArray = SKEW) -> Motion:
    """Angular vibration about `axis`, started at zero rate."""

    def motion(time: FloatArray) -> tuple[FloatArray, FloatArray]:
        rate = VIBRATION_RAD * pulsation * np.sin(pulsation * np.maximum(time, 0.0))
        return np.tile([0.0, 0.0, -GRAVITY], (len(time), 1)), rate[:, None] * axis

    return motion


def _simpson(values: FloatArray, step: float) -> FloatArray:
    total: FloatArray = step / 6.0 * (values[:-2:2] + 4.0 * values[1::2] + values[2::2])
    return total


def errors(
    block: Block, motion: Motion, fast_hz: int, *, dynamics: bool, rest: float = REST_S
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Errors of a block on a motion, raw and compensated on the fast step.

    Parameters
    ----------
    block : sequence of Pendulum
        Three.
    motion : Motion
        What it goes through.
    fast_hz : int
        Rate of the compensation; divides `DYNAMIC_HZ`.
    dynamics : bool
        The pendulums move; otherwise they are in equilibrium.
    rest : float
        Rest before the motion, s; without it the first sample of the compensation moves.

    Returns
    -------
    time : (n,) float
        s.
    raw, compensated : (n, 3) float
        Position errors of the channels, m.
    """
    h, every = 1.0 / DYNAMIC_HZ, DYNAMIC_HZ // fast_hz
    start, count = round(rest * fast_hz) * every, round(DURATION_S * fast_hz) * every
    nodes: FloatArray = np.asarray((np.arange(2 * (start + count) + 1) - 2 * start) * 0.5 * h, np.float64)
    force, rate = motion(nodes)
    true = _simpson(force @ np.array([p.axes[0] for p in block]).T, h)
    if dynamics:
        sensors = PendulumBlock(block, h)
        _settle(sensors, force[0], rate[0])
        measured = sensors.sense(force, rate)
    else:
        changes = np.diff(rate[::2], axis=0)
        terms = _simpson(size_terms(rate, np.zeros_like(rate)), h)
        terms[:, 6:] = changes
        measured = true + terms @ size_coefficients(block).T
    dtheta, dvel, reference = (part.reshape(-1, every, 3).sum(axis=1) for part in (_simpson(rate, h), measured, true))
    step = np.full(len(dvel), every * h)
    clean = np.empty_like(dvel)
    compensate(np.zeros(MEMORY), size_coefficients(block), step, dtheta, dvel, clean)
    time: FloatArray = np.asarray((np.arange(len(step)) + 1) * every * h - start * h, np.float64)
    return time, _position(step, dvel - reference), _position(step, clean - reference)


def _settle(sensors: PendulumBlock, force: FloatArray, rate: FloatArray) -> None:
    """Half a second of the first inputs, so that the switching-on of gravity is no part of the error."""
    nodes = np.ones((DYNAMIC_HZ + 1, 1))
    sensors.sense(nodes * force, nodes * rate)


def _position(step: FloatArray, dvel: FloatArray) -> FloatArray:
    velocity, position = np.empty_like(dvel), np.empty_like(dvel)
    integrate_twice(np.zeros(10), step, dvel, velocity, position)
    return position


def lever_block() -> Block:
    """Three times the first channel of the published figures: the best place, but 0.15 m out along xi."""
    p = Pendulum()
    return (replace(p, hinge=(LEVER_M, 0.0, p.percussion_radius)),) * 3


def scattered_block() -> Block:
    """Hinges anywhere within 0.15 m of O, so that all terms of every channel count."""
    places = ((0.15, 0.06, -0.08), (-0.09, 0.12, 0.05), (0.1, -0.07, 0.13))
    return tuple(replace(p, hinge=place) for p, place in zip(ideal_layout(Pendulum()), places, strict=True))


def _published() -> tuple[list[Row], list[Plot]]:
    rows, lines = [], []
    level = np.array([0.0, 1.0, 0.0])
    for key, name, motion, published, mean_square in (
        ("turn", "coordinated turn, 0.1 rad/s", turn, 7.5, TURN_RATE**2),
        *(
            (
                key,
                f"vibration 0.4 mrad, {rate}",
                vibration(pulsation, level),
                published,
                0.5 * (VIBRATION_RAD * pulsation) ** 2,
            )
            for key, rate, pulsation, published in (
                ("vibration-300", "300 rad/s", PUBLISHED_PULSATION, 5.4),
                ("vibration-50hz", "exactly 50 Hz", PULSATION, 5.9),
            )
        ),
    ):
        closed = 100.0 * LEVER_M * mean_square * DURATION_S**2 / 2.0
        time, raw, clean = errors(lever_block(), motion, 2000, dynamics=False)
        lines.append(Line(name, time[::20], 100.0 * np.abs(raw[::20, 0])))
        what = f"{name}, lever 0.15 m, 10 s"
        ours = 100.0 * abs(raw[-1, 0])
        text = f"{what}: raw (reference: closed form)"
        rows.append(near(f"{key}-raw", text, ours, "cm", 0.01 * published, published=published, reference=closed))
        rows.append(near(f"{key}-closed", f"{text}, within 1 %", ours, "cm", 0.01 * closed, reference=closed))
        left = 1e3 * np.abs(clean[:, 0]).max()
        rows.append(at_most(f"{key}-compensated", f"{what}: compensated at 2 kHz", left, "mm", GOAL_MM))
    return rows, [Plot("raw", "Position error of the lever 0.15 m without compensation", "s", "cm", lines)]


def vibropendulous(block: Block, pulsation: float, axis: FloatArray) -> FloatArray:
    """Position error after `DURATION_S` of angular vibration that the deflections make, in closed form.

    The angular acceleration drives each pendulum and, through the hinge's place, pulls along its zeta; the mean of
    -phi f_zeta is no part of the equilibrium form, and compensation cannot see it.

    Returns
    -------
    (p,) float
        m.
    """
    s = 1j * pulsation
    found = []
    for p in block:
        xi0, eta0, zeta0 = np.array(p.axes) @ p.hinge
        e_xi, e_eta, e_zeta = VIBRATION_RAD * pulsation**2 * np.array(p.axes) @ axis
        w0 = 2.0 * math.pi * p.frequency_hz
        loop = np.polyval([1.0, 2.0 * p.damping * w0, w0**2, p.integral * w0**2], s)
        drive = (zeta0 - p.percussion_radius) * e_eta - eta0 * e_zeta
        phi = drive / p.percussion_radius * s / loop
        found.append(-0.25 * phi.real * (e_xi * eta0 - e_eta * xi0) * DURATION_S**2)
    return np.array(found)


def _compensated() -> tuple[list[Row], list[Plot]]:
    """All terms, with and without the pendulums' own motion."""
    rows, lines = [], []
    block, shaking = scattered_block(), vibration(PULSATION)
    rectified = 1e3 * float(np.linalg.norm(vibropendulous(block, PULSATION, SKEW)))
    for key, what, motion in (
        ("turn", "turn of 45 deg, rolled into in 2 s", rolling_turn),
        ("vibration", "vibration 0.4 mrad, 50 Hz, skew axis", shaking),
    ):
        for fast in FAST_HZ:
            for dynamics in (False, True):
                time, raw, clean = errors(block, motion, fast, dynamics=dynamics)
                left = 1e3 * np.linalg.norm(clean, axis=1)
                text = f"{what}, all terms, {fast // 1000} kHz, {'full dynamics' if dynamics else 'equilibrium'}"
                name = f"all-{key}-{fast // 1000}khz-{'full' if dynamics else 'equilibrium'}"
                if fast == FAST_HZ[0]:
                    rows.append(shown(f"{name}-raw", f"{text}: raw", 1e3 * float(np.linalg.norm(raw[-1])), "mm"))
                text += ": compensated"
                if dynamics and motion is shaking:
                    text += " (reference: the deflections rectify, closed form)"
                    rows.append(near(name, text, left[-1], "mm", 0.1 * rectified, reference=rectified))
                else:
                    rows.append(at_most(name, text, left.max(), "mm", GOAL_MM))
                if dynamics:
                    lines.append(Line(f"{key}, {fast // 1000} kHz", time[:: fast // 100], left[:: fast // 100]))
    _, _, clean = errors(block, shaking, 1000, dynamics=False, rest=0.0)
    what = "vibration at 1 kHz whose first sample already moves: the angular acceleration over it is unknown"
    rows.append(shown("all-vibration-no-rest", what, 1e3 * float(np.linalg.norm(clean[-1])), "mm"))
    frequencies = np.geomspace(5.0, 200.0, 12)
    pulsations = 2.0 * math.pi * frequencies
    sweep = [
        Line(f"{fast // 1000} kHz", frequencies, np.array([_left(w, fast) for w in pulsations]), ".-")
        for fast in FAST_HZ
    ]
    sweep.append(
        Line(
            "deflections alone, closed form",
            frequencies,
            np.array([1e3 * np.linalg.norm(vibropendulous(block, w, SKEW)) for w in pulsations]),
            "--",
        )
    )
    title = "Left after 10 s of vibration of 0.4 mrad, all terms, full dynamics"
    return rows, [
        Plot("left", "Position error after compensation, all terms, full dynamics", "s", "mm", lines),
        Plot("frequency", title, "Hz", "mm", sweep, log=True),
    ]


def _left(pulsation: float, fast_hz: int) -> float:
    clean = errors(scattered_block(), vibration(pulsation), fast_hz, dynamics=True)[2]
    return 1e3 * float(np.linalg.norm(clean[-1]))


def _layouts() -> tuple[list[Row], list[Plot]]:
    p = Pendulum()
    gram = _vibration_gram()
    common = common_layout(p, LEVER_M, math.radians(30.0))
    centre = best_centre(common, gram)
    blocks: dict[str, tuple[str, Block]] = {
        "ideal": ("ideal", ideal_layout(p)),
        "honeywell": ("Honeywell-like", honeywell_layout(p)),
        "common": ("common, the source's centre", common),
        "common-best": ("common, centre best for vibration", moved(common, centre)),
        "common-position": (
            "common, centre best for the turn's position",
            moved(common, best_centre(common, _turn_gram())),
        ),
    }
    rows = []
    for key, (what, block) in blocks.items():
        rows.append(
            shown(f"layout-{key}", f"{what}: rms error in 50 Hz vibration", 1e3 * size_error(block, gram), "mm/s^2")
        )
        for name, motion in (("turn", rolling_turn), ("vibration", vibration(PULSATION))):
            _, raw, clean = errors(block, motion, 2000, dynamics=True)
            text = f"{what}, {name}, full dynamics, 10 s"
            rows.append(shown(f"layout-{key}-{name}-raw", f"{text}: raw", 1e3 * float(np.linalg.norm(raw[-1])), "mm"))
            left = 1e3 * np.linalg.norm(clean, axis=1).max()
            seen = 1e3 * float(np.linalg.norm(vibropendulous(block, PULSATION, SKEW))) if name == "vibration" else 0.0
            text = f"{text}: compensated at 2 kHz (reference: the deflections alone)"
            rows.append(at_most(f"layout-{key}-{name}", text, left, "mm", GOAL_MM + seen, reference=seen))
    for i, name in enumerate("xyz"):
        what = f"common: centre best for vibration, from the source's, {name}"
        rows.append(shown(f"centre-common-{name}", what, 1e3 * centre[i], "mm"))
    hidden = np.array([0.07, -0.04, 0.11])
    found = best_centre(moved(ideal_layout(p), hidden), gram)
    what = "ideal layout seen from a wrong O: distance of the centre found"
    rows.append(at_most("centre-ideal", what, 1e3 * float(np.linalg.norm(found + hidden)), "mm", 1e-6))
    gain = size_error(moved(common, centre), gram) / size_error(common, gram)
    rows.append(at_most("centre-gain", "common: error at the best centre over that at the source's", gain, "1", 1.0))
    aside = np.linspace(-0.2, 0.2, 81)
    lines = [
        Line(
            f"along {name}",
            1e3 * aside,
            np.array([1e3 * size_error(moved(common, centre + d * axis), gram) for d in aside]),
        )
        for name, axis in zip("xyz", np.eye(3), strict=True)
    ]
    return rows, [Plot("centre", "Common layout: rms error by the place of O", "mm from the best", "mm/s^2", lines)]


def _turn_gram() -> FloatArray:
    """Of position errors over the rolling turn."""
    step = 1e-3
    time: FloatArray = np.asarray(np.arange(DURATION_S / step) * step, np.float64)
    rate = rolling_turn(time)[1]
    terms = size_terms(rate, np.gradient(rate, step, axis=0))
    return motion_gram(step**2 * np.cumsum(np.cumsum(terms, axis=0), axis=0))


def _vibration_gram() -> FloatArray:
    """Vibration of 0.4 mrad at 50 Hz, as much about every axis."""
    variance = 0.5 * (VIBRATION_RAD * PULSATION) ** 2
    return spectrum_gram(variance * np.eye(3), variance * PULSATION**2 * np.eye(3))


def run() -> Study:
    """All of it."""
    rows: list[Row] = []
    plots: list[Plot] = []
    for part in (_published, _compensated, _layouts):
        more_rows, more_plots = part()
        rows += more_rows
        plots += more_plots
    about = (
        "Pendulum accelerometers away from the navigated point: the raw error of position and what compensation leaves of it. "
        "Gyro increments are exact. Full dynamics: every pendulum moves in its rebalance loop at 8 kHz; equilibrium: eq. 1.7. "
        "Errors are double integrals along the channels, without rotation."
    )
    return Study("pendulum", "Pendulum accelerometers: the size effect", about, rows, plots)
