"""Distances and angles between a solution and a reference, in the units that a user reads."""

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from nav.earth import curvature_radii
from nav.increments import FloatArray
from nav.rotation import attitude_error, euler_from_quaternion


def position_error(
    lat: FloatArray, lon: FloatArray, height: FloatArray, reference: Mapping[str, FloatArray] | NDArray[np.void]
) -> FloatArray:
    """(n, 3) north, east, down offset from `reference` (fields lat, lon, height), m."""
    error = np.empty((len(lat), 3))
    for k in range(len(lat)):
        true_lat, true_height = float(reference["lat"][k]), float(reference["height"][k])
        meridian, prime = curvature_radii(math.sin(true_lat))
        east = math.remainder(lon[k] - float(reference["lon"][k]), 2.0 * math.pi)
        error[k, 0] = (lat[k] - true_lat) * (meridian + true_height)
        error[k, 1] = east * (prime + true_height) * math.cos(true_lat)
        error[k, 2] = true_height - height[k]
    return error


def attitude_difference(q: FloatArray, q_reference: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """(total, tilt, heading) difference of attitudes (n, 4), rad; heading signed, in (-pi, pi]."""
    total = np.linalg.norm(attitude_error(q, q_reference), axis=-1)
    tilt = np.arccos(np.clip(np.sum(_down(q) * _down(q_reference), axis=-1), -1.0, 1.0))
    turn = euler_from_quaternion(q)[:, 0] - euler_from_quaternion(q_reference)[:, 0]
    heading: FloatArray = np.remainder(turn + np.pi, 2 * np.pi) - np.pi
    return total, tilt, heading


def _down(q: FloatArray) -> FloatArray:
    """The vertical (down) in body axes: the third row of C_nb."""
    w, x, y, z = q.T
    return np.stack([2 * (x * z - w * y), 2 * (y * z + w * x), w * w - x * x - y * y + z * z], axis=-1)


@dataclass(slots=True)
class Spread:
    """Running rms, largest and final value of an error."""

    count: int = 0
    squares: float = 0.0
    largest: float = 0.0
    final: float = 0.0

    def add(self, values: FloatArray) -> None:
        """Take values (n,), signed or not."""
        if len(values):
            self.count += len(values)
            self.squares += float(np.dot(values, values))
            self.largest = max(self.largest, float(np.abs(values).max()))
            self.final = float(values[-1])

    def as_dict(self, scale: float = 1.0) -> dict[str, float]:
        """rms, max, final, each times `scale`."""
        rms = math.sqrt(self.squares / self.count) if self.count else 0.0
        return {"rms": rms * scale, "max": self.largest * scale, "final": abs(self.final) * scale}
