"""What the simulated world measures besides the head: satellite fixes, pressure heights, magnetic fields, headings.

Each sensor measures the truth at its own times, k / rate, with errors from a stream of its own; the measurement arrives after
the sensor's delay. What a sensor sends depends on the scenario alone, not on how the run is cut or what other sensors there are.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from drivers.can.aiding import AidingArray
from hil.magnetic import magnetic_field
from hil.scenario import (
    AidConfig,
    AidingConfig,
    BaroConfig,
    GnssConfig,
    HeadingConfig,
    Jump,
    MagnetometerConfig,
    Scenario,
    VectorJump,
)
from hil.world.motion import Motion
from nav.aiding import AIDING, Kind, aiding_rows
from nav.earth import A, curvature_radii
from nav.increments import FloatArray, IntArray
from nav.lever_arm import shift
from nav.rotation import conjugate, euler_from_quaternion, rotated

FIELD_CELL_M = 1000.0
"""The magnetic field is computed anew after so much way: it changes by a few nT over it."""
_STREAM = 2
"""What sets the random streams of aiding apart from others of the scenario's seed."""

Truth = NDArray[np.void]
Measure = Callable[[Truth, FloatArray], FloatArray]
"""Values of measurements (n, m) from the truth and standard normal numbers (n, draws)."""


@dataclass(slots=True)
class _Sensor:
    """One sensor at work."""

    config: AidConfig
    kind: Kind
    source: int
    sigma: FloatArray
    draws: int
    measure: Measure
    motion: Motion
    rng: np.random.Generator
    measured: int = 0

    def arrived(self, until_us: int) -> tuple[AidingArray, IntArray]:
        """Measurements that have arrived by `until_us` and were not handed out before, and their arrivals, us."""
        rate, delay_us = self.config.rate_hz, round(self.config.delay_s * 1e6)
        first = self.measured + 1
        last = math.floor((until_us - delay_us + 0.5) * rate * 1e-6)
        if last < first:
            return np.zeros(0, AIDING), np.zeros(0, np.int64)
        self.measured = last
        time_us = np.rint(np.arange(first, last + 1) * (1e6 / rate)).astype(np.int64)
        times = time_us * 1e-6
        values = self.measure(self.motion.truth(times), self.rng.standard_normal((len(times), self.draws)))
        rows = aiding_rows(times, self.kind, values, self.sigma * self.config.claim, self.source)
        there = np.ones(len(times), np.bool_)
        for outage in self.config.outages:
            there &= (times < outage.start_s) | (times >= outage.end_s)
        return rows[there], time_us[there] + delay_us


class SimulatedAiding:
    """All sensors of a scenario that aid the navigator."""

    def __init__(self, scenario: Scenario) -> None:
        motion, aiding = Motion(scenario.motion), scenario.aiding
        makers: tuple[tuple[Kind, Sequence[AidConfig], Callable[..., tuple[FloatArray, int, Measure]]], ...] = (
            (Kind.GNSS, aiding.gnss, _gnss),
            (Kind.BARO, aiding.baro, _baro),
            (Kind.MAGNETIC, aiding.magnetometer, lambda config: _magnetometer(config, aiding)),
            (Kind.HEADING, aiding.heading, _heading),
        )
        self._sensors = [
            _Sensor(
                config, kind, k, *make(config), motion, np.random.default_rng([scenario.seed, _STREAM, int(kind), k])
            )
            for kind, configs, make in makers
            for k, config in enumerate(configs)
        ]

    def arrived(self, until_us: int) -> tuple[AidingArray, IntArray]:
        """Rows of `AIDING` in the order in which they have arrived by `until_us` since the last call, and when, us."""
        parts = [sensor.arrived(until_us) for sensor in self._sensors]
        rows = np.concatenate([np.zeros(0, AIDING), *(rows for rows, _ in parts)])
        arrivals = np.concatenate([np.zeros(0, np.int64), *(arrivals for _, arrivals in parts)])
        order = np.argsort(arrivals, kind="stable")
        return rows[order], arrivals[order]


class _Drift:
    """A first-order Gauss-Markov error of unit draws: stationary from the start."""

    def __init__(self, config: GnssConfig | BaroConfig) -> None:
        self._sigma, self._decay = config.bias_sigma_m, math.exp(-1.0 / (config.rate_hz * config.bias_time_s))
        self._state: FloatArray | None = None

    def follow(self, draws: FloatArray) -> FloatArray:
        """The error at each of the draws (n, axes)."""
        out = np.empty_like(draws)
        for k, draw in enumerate(draws):
            if self._state is None:
                self._state = self._sigma * draw
            else:
                self._state = self._decay * self._state + self._sigma * math.sqrt(1.0 - self._decay**2) * draw
            out[k] = self._state
        return out


def _stepped(times: FloatArray, jumps: Sequence[Jump] | Sequence[VectorJump], axes: int) -> FloatArray:
    """Sum of the steps of the error (n, axes)."""
    total = np.zeros((len(times), axes))
    for jump in jumps:
        total[times >= jump.at_s] += np.asarray(jump.size)
    return total


def _gnss(config: GnssConfig) -> tuple[FloatArray, int, Measure]:
    sigma = np.array([*config.position_sigma_m, *config.velocity_sigma_ms])
    drift, arm = _Drift(config), np.array(config.lever_arm_m)

    def measure(truth: Truth, draws: FloatArray) -> FloatArray:
        times = truth["time"]
        lat, lon, height, vel = (np.ascontiguousarray(truth[name]) for name in ("lat", "lon", "height", "vel_n"))
        shift(lat, lon, height, vel, np.ascontiguousarray(truth["q_nb"]), np.ascontiguousarray(truth["w_ib_b"]), arm)
        error = drift.follow(draws[:, 6:]) + sigma[:3] * draws[:, :3] + _stepped(times, config.jumps, 3)
        for jump in config.jumps:
            since = np.maximum(times - jump.at_s, 0.0)[:, None]
            error += since * np.asarray(jump.drift_ms)
            vel += (since > 0.0) * np.asarray(jump.drift_ms)
        for k in range(len(times)):
            meridian, prime = curvature_radii(math.sin(lat[k]))
            lat[k] += error[k, 0] / (meridian + height[k])
            lon[k] += error[k, 1] / ((prime + height[k]) * math.cos(lat[k]))
        return np.column_stack([lat, lon, height - error[:, 2], vel + sigma[3:] * draws[:, 3:6]])

    return sigma, 9, measure


def _baro(config: BaroConfig) -> tuple[FloatArray, int, Measure]:
    drift = _Drift(config)

    def measure(truth: Truth, draws: FloatArray) -> FloatArray:
        error = config.offset_m + drift.follow(draws[:, 1:]) + _stepped(truth["time"], config.jumps, 1)
        return truth["height"][:, None] + error + config.sigma_m * draws[:, :1]

    return np.array([config.sigma_m]), 2, measure


def _magnetometer(config: MagnetometerConfig, aiding: AidingConfig) -> tuple[FloatArray, int, Measure]:
    place, field = np.full(3, np.inf), np.zeros(3)  # where the field was last computed

    def field_at(row: Any) -> FloatArray:
        there = np.array([row["lat"] * A, row["lon"] * A, row["height"]])
        if not np.linalg.norm(there - place) < FIELD_CELL_M:
            place[:] = there
            field[:] = magnetic_field(aiding.field, row["lat"], row["lon"], row["height"], aiding.year)
        return field.copy()

    def measure(truth: Truth, draws: FloatArray) -> FloatArray:
        flux = rotated(conjugate(truth["q_nb"]), np.stack([field_at(row) for row in truth]))
        error = np.asarray(config.hard_iron_ut) + _stepped(truth["time"], config.jumps, 3) + config.sigma_ut * draws
        result: FloatArray = flux + 1e-6 * error
        return result

    return np.full(3, config.sigma_ut * 1e-6), 3, measure


def _heading(config: HeadingConfig) -> tuple[FloatArray, int, Measure]:
    def measure(truth: Truth, draws: FloatArray) -> FloatArray:
        error = config.offset_deg + _stepped(truth["time"], config.jumps, 1) + config.sigma_deg * draws
        heading = euler_from_quaternion(truth["q_nb"])[:, :1] + np.radians(error)
        result: FloatArray = np.remainder(heading, 2.0 * math.pi)
        return result

    return np.radians([config.sigma_deg]), 1, measure
