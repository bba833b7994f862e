"""Drift that fast motion makes of the gyros' lag: on the source's roll, and under vibration with and without a rubber mount.

A rate that comes out too small, late, or on the wrong axis makes the attitude cone: the drift is the rectified product of
two axes. The mount is a damped spring, the same about all axes; it turns the angles of the base into those of the head.
"""

import math
from collections.abc import Mapping

import numpy as np
from numpy.typing import ArrayLike

from hil.study.dtg_world import FORMS, Rocking, drift_deg_h, outputs, rectified_deg_h, response
from hil.study.report import Line, Plot, Row, at_most, near, shown
from nav.attitude.signals import Coning, Signal
from nav.exponential import ComplexArray
from nav.increments import FloatArray
from nav.instruments.dtg import HEAD, Rotor

TURN = 2.0 * math.pi
MOUNT_HZ, MOUNT_DAMPING = 25.0, 0.15
"""Natural frequency of the mount and its damping over the critical one: rubber."""
VIBRATION_DEG = 0.1
ROLL_DEG, ROLL = 10.0, 8.0
"""The source's fastest roll, deg and rad/s."""
RECORD_S = 10.0
WORDS = {
    "raw": "raw",
    "angles": "compensated, z on the wire",
    "increments": "compensated, increments alone",
}
SIMULATED = (("rocking", 50.0), ("coning", 20.0), ("coning", 50.0), ("coning", 100.0))


def transmissibility(pulsation: ArrayLike) -> FloatArray:
    """Angle of the head over that of the base, |1 + 2 j d r| / |1 - r^2 + 2 j d r| with r = W / (2 pi f)."""
    r = np.asarray(pulsation, np.float64) / (TURN * MOUNT_HZ)
    spring = 1.0 + 2j * MOUNT_DAMPING * r
    return np.asarray(np.abs(spring / (spring - r * r)))


def motion(kind: str, hz: float, amplitude: float) -> Signal:
    """`rocking` about x or `coning` about x, of an amplitude in rad."""
    return Rocking(amplitude, TURN * hz) if kind == "rocking" else Coning(amplitude, hz)


def rates(kind: str, pulsation: FloatArray, amplitude: ArrayLike) -> ComplexArray:
    """The same as phasors (n, 3) of the rate, to the first order of the angle."""
    axes = np.array([1.0, 0.0, 0.0] if kind == "rocking" else [0.0, 1j, 1.0], np.complex128)
    out: ComplexArray = (np.asarray(amplitude) * pulsation)[:, None] * axes
    return out


def roll_rows(wrong: Mapping[str, tuple[str, Rotor]]) -> list[Row]:
    """Drift on the source's roll: raw, compensated, and by compensations that take the gyros for something else."""
    amplitude, pulsation = math.radians(ROLL_DEG), np.array([ROLL])
    signal, rows = Rocking(amplitude, ROLL), []
    for key, (words, rotor) in {"": ("", HEAD), **wrong}.items():
        edges, found = outputs(HEAD, signal, 60.0, rotor)
        for form in FORMS[1:] if key else FORMS:
            ours = drift_deg_h(signal, ROLL, edges, found[form])
            answer = response(HEAD, pulsation, form, rotor)
            reference = float(rectified_deg_h(answer, rates("rocking", pulsation, amplitude), pulsation)[0])
            what = ", ".join(filter(None, ("roll of 10 deg at 8 rad/s", WORDS[form], words)))
            what, name = f"{what}: drift (reference: closed form)", "-".join(filter(None, ("roll-drift", form, key)))
            if form == "raw" or key:
                rows.append(near(name, what, ours, "deg/h", 5e-3 * reference, reference=reference))
            else:
                rows.append(at_most(name, what, ours, "deg/h", 0.01, reference=reference))
    what = "roll at 8 rad/s: what the mount makes of it; it does not help against the lag"
    rows.append(shown("mount-roll", what, float(transmissibility(ROLL)), "1"))
    return rows


def vibration() -> tuple[list[Row], list[Plot]]:
    """Drift under vibration of 0.1 deg of the base: simulated rows, plots over frequency."""
    rows = []
    for kind, hz in SIMULATED:
        pulsation = np.array([TURN * hz])
        for mount, factor in (("hard", 1.0), ("mounted", float(transmissibility(TURN * hz)))):
            amplitude = factor * math.radians(VIBRATION_DEG)
            signal = motion(kind, hz, amplitude)
            edges, found = outputs(HEAD, signal, RECORD_S)
            for form, axes in found.items():
                ours = drift_deg_h(signal, TURN * hz, edges, axes)
                answer = response(HEAD, pulsation, form)
                reference = float(rectified_deg_h(answer, rates(kind, pulsation, amplitude), pulsation)[0])
                what = f"{kind} of the base, 0.1 deg, {hz:g} Hz, {mount}: {WORDS[form]}, drift (reference: closed form)"
                name = f"{kind}-{hz:g}hz-{mount}-{form}"
                rows.append(near(name, what, ours, "deg/h", 1e-3 * reference, reference=reference))
    hz_grid = np.geomspace(1.0, 150.0, 300)
    pulsation = TURN * hz_grid
    plots = []
    for kind in ("rocking", "coning"):
        lines = []
        for form in FORMS:
            answer = response(HEAD, pulsation, form)
            for mount, factors in (("hard", np.ones(300)), ("mounted", transmissibility(pulsation))):
                swings = factors * math.radians(VIBRATION_DEG)
                drift = rectified_deg_h(answer, rates(kind, pulsation, swings), pulsation)
                lines.append(Line(f"{form}, {mount}", hz_grid, drift, "-" if mount == "hard" else "--"))
        title = f"Drift under {kind} of the base of 0.1 deg, mount of {MOUNT_HZ:g} Hz"
        plots.append(Plot(f"vibration-{kind}", title, "Hz", "deg/h", lines, log=True))
    return rows, plots
