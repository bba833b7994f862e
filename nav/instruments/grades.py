"""Sensor grades: one table for simulation, tests and documents; 1 sigma, turn-on values drawn for each run."""

import math
from dataclasses import dataclass

import numpy as np

from nav.earth import STANDARD_GRAVITY as _G
from nav.instruments.accelerometer_errors import AccelerometerErrors
from nav.instruments.channels import TRIAD, Triple
from nav.instruments.gyro_errors import DTG_HEAD, GyroErrors
from nav.instruments.noise import NoiseModel

_DEG = math.pi / 180.0
_DEG_H = _DEG / 3600.0
_DEG_SQRT_H = _DEG / 60.0
_ARCSEC = _DEG / 3600.0
_PPM = 1e-6


@dataclass(frozen=True, slots=True)
class Grade:
    """What instruments of one kind are worth.

    Attributes
    ----------
    name : str
        In words.
    gyro_bias, gyro_bias_removed : float
        At turn-on, and what is left of it once it has been removed at rest, rad/s.
    gyro_flicker : float
        B, rad/s.
    gyro_white : float
        Angle random walk, rad/sqrt(s).
    gyro_scale, gyro_misalignment : float
        1 and rad.
    gyro_g : float
        Drift by force, rad/s / (m/s^2); along the input and the other input axis.
    accelerometer_bias, accelerometer_flicker : float
        m/s^2.
    accelerometer_white : float
        Velocity random walk, m/s^2/sqrt(Hz).
    accelerometer_scale : float
        1.
    gyro_channels : tuple of (3,) int
        Axes of the gyros' channels.
    """

    name: str
    gyro_bias: float
    gyro_bias_removed: float
    gyro_flicker: float
    gyro_white: float
    gyro_scale: float
    gyro_misalignment: float
    gyro_g: float
    accelerometer_bias: float
    accelerometer_flicker: float
    accelerometer_white: float
    accelerometer_scale: float
    gyro_channels: tuple[Triple, ...] = TRIAD

    def draw(self, rng: np.random.Generator, *, bias_removed: bool = False) -> tuple[GyroErrors, AccelerometerErrors]:
        """Turn-on values of one run.

        Parameters
        ----------
        rng : numpy Generator
            Of the run.
        bias_removed : bool
            The gyros' turn-on bias has been removed at rest.
        """

        def normal(sigma: float, count: int) -> tuple[float, ...]:
            return tuple(map(float, sigma * rng.standard_normal(count)))

        n = len(self.gyro_channels)
        gyros = GyroErrors(
            bias=normal(self.gyro_bias_removed if bias_removed else self.gyro_bias, n),
            scale=normal(self.gyro_scale, n),
            misalignment_other=normal(self.gyro_misalignment, n),
            misalignment_spin=normal(self.gyro_misalignment, n),
            unbalance=normal(self.gyro_g, n),
            quadrature=normal(self.gyro_g, n),
            noise=NoiseModel(white=self.gyro_white, flicker=self.gyro_flicker),
            channels=self.gyro_channels,
        )
        accelerometers = AccelerometerErrors(
            bias=normal(self.accelerometer_bias, 3),
            scale=normal(self.accelerometer_scale, 3),
            noise=NoiseModel(white=self.accelerometer_white, flicker=self.accelerometer_flicker),
        )
        return gyros, accelerometers


GRADES = {
    "dtg": Grade(
        "DTG head",
        gyro_bias=0.01 * _DEG_H,
        gyro_bias_removed=0.01 * _DEG_H,
        gyro_flicker=0.003 * _DEG_H,
        gyro_white=0.002 * _DEG_SQRT_H,
        gyro_scale=50.0 * _PPM,
        gyro_misalignment=5.0 * _ARCSEC,
        gyro_g=0.05 * _DEG_H / _G,
        accelerometer_bias=10e-6 * _G,
        accelerometer_flicker=3e-6 * _G,
        accelerometer_white=5e-6 * _G,
        accelerometer_scale=50.0 * _PPM,
        gyro_channels=DTG_HEAD,
    ),
    "tactical": Grade(
        "tactical",
        gyro_bias=1.0 * _DEG_H,
        gyro_bias_removed=1.0 * _DEG_H,
        gyro_flicker=0.3 * _DEG_H,
        gyro_white=0.05 * _DEG_SQRT_H,
        gyro_scale=300.0 * _PPM,
        gyro_misalignment=100.0 * _ARCSEC,
        gyro_g=1.0 * _DEG_H / _G,
        accelerometer_bias=1e-3 * _G,
        accelerometer_flicker=0.1e-3 * _G,
        accelerometer_white=50e-6 * _G,
        accelerometer_scale=300.0 * _PPM,
    ),
    "mems": Grade(
        "MEMS",
        gyro_bias=0.2 * _DEG,
        gyro_bias_removed=10.0 * _DEG_H,
        gyro_flicker=10.0 * _DEG_H,
        gyro_white=0.3 * _DEG_SQRT_H,
        gyro_scale=5000.0 * _PPM,
        gyro_misalignment=0.2 * _DEG,
        gyro_g=0.01 * _DEG / _G,
        accelerometer_bias=5e-3 * _G,
        accelerometer_flicker=0.05e-3 * _G,
        accelerometer_white=120e-6 * _G,
        accelerometer_scale=3000.0 * _PPM,
    ),
}
"""By the names that a scenario uses."""
