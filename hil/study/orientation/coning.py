"""Coning: every method on six cones, and the goals."""

import math
from importlib import import_module
from typing import Any

import numpy as np

from hil.study.orientation.measure import METHODS, errors, uniform
from hil.study.report import Line, Plot, Row, at_most, shown
from nav.attitude import method
from nav.attitude.signals import Coning, Signal
from nav.increments import FloatArray
from nav.rotation import attitude_error

CONES_DEG, FREQUENCIES_HZ = (1.0, 10.0), (1.0, 10.0, 74.0)
CONING_SAMPLE_HZ, CONING_S = 1000.0, 10.0


def cones() -> tuple[list[Row], list[Plot]]:
    ten = math.radians(10.0)
    rows = []
    for key, name, frequency, rate, duration, limit in (
        ("10hz-4", "high-order:4", 10.0, 1000.0, 10.0, 2e-8),
        ("10hz-6", "high-order:6", 10.0, 1000.0, 10.0, 1e-10),
        ("10hz-8", "high-order:8", 10.0, 1000.0, 10.0, 1e-10),
        ("2hz-100hz-4", "high-order:4", 2.0, 400.0, 6.0, 1e-9),
        ("15hz-100hz-8", "high-order:8", 15.0, 800.0, 6.0, 1e-9),
    ):
        _, error = errors(name, Coning(ten, frequency), uniform(duration, rate))
        what = f"coning 10 deg, {frequency:g} Hz, {rate:g} Hz samples, {duration:g} s: {name}"
        rows.append(at_most(f"coning-goal-{key}", what, error.max(), "rad", limit))
    edges = uniform(CONING_S, CONING_SAMPLE_HZ)
    for cone in CONES_DEG:
        for frequency in FREQUENCIES_HZ:
            signal = Coning(math.radians(cone), frequency)
            for name in METHODS:
                ours = errors(name, signal, edges)[1].max()
                peer = _pyins_error(signal, edges) if name == "coning-stream:2" else None
                of_peer = "" if peer is None else " (reference: pyins)"
                what = f"coning {cone:g} deg, {frequency:g} Hz, 1 kHz samples, 10 s: {name}{of_peer}"
                rows.append(shown(f"coning-{cone:g}deg-{frequency:g}hz-{name}", what, ours, "rad", reference=peer))
    frequencies = np.geomspace(1.0, 100.0, 21)
    edges = uniform(1.0, CONING_SAMPLE_HZ)
    lines = [
        Line(name, frequencies, np.array([errors(name, Coning(ten, f), edges)[1].max() for f in frequencies]))
        for name in (
            "poisson-rk4",
            "picard3",
            "four-sample",
            "coning:3",
            "coning-stream:4",
            "high-order:4",
            "high-order:8",
        )
    ]
    return rows, [
        Plot("coning", "Coning of 10 deg, 1 kHz samples, 1 s", "cone frequency, Hz", "error, rad", lines, log=True)
    ]


def _pyins_error(signal: Signal, edges: FloatArray) -> float | None:
    """Largest error of the peer's attitude increments, composed exactly; None where it is not installed."""
    try:
        pandas: Any = import_module("pandas")
        strapdown: Any = import_module("pyins.strapdown")
        util: Any = import_module("pyins.util")
    except ImportError:
        return None
    dtheta = signal.increments(np.concatenate([[2.0 * edges[0] - edges[1]], edges]))
    columns = [*util.GYRO_COLS, *util.ACCEL_COLS]
    imu = pandas.DataFrame(np.hstack([dtheta, np.zeros_like(dtheta)]), index=pandas.Index(edges), columns=columns)
    increments = strapdown.compute_increments_from_imu(imu, "increment")
    turns = increments[["theta_x", "theta_y", "theta_z"]].to_numpy()
    q = method("coning:1").integrate(signal.attitude(edges[:1])[0], np.diff(edges), turns)
    return float(np.linalg.norm(attitude_error(q, signal.attitude(edges[1:])), axis=1).max())
