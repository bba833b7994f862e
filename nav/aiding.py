"""What helps the navigator besides the inertial sensors: one row for each measurement, of any kind, at its own time.

A row holds up to six values and their standard deviations. A value that is not there, or is not to be used, has an infinite
standard deviation. Times are device times of the inertial sensor, s, at which the measurement was true, not when it came.
"""

from enum import IntEnum

import numpy as np
from numpy.typing import ArrayLike, NDArray

RELAYED = 128
"""Sources from here on are those of another network, for which a relay sends."""
AT_PORTS = 192
"""Sources from here on to 255 are receivers at ports of their own, each of which sends for itself."""
"""Sources from here on to 255 are those of another network, for which a relay sends."""
RECEIVERS = 16
"""Relayed sources up to here are receivers, as all that are not relayed."""
OPERATOR = RELAYED + 18
"""The source of what a person says: a navigator without a filter takes it as it is."""


class Kind(IntEnum):
    """What a row measures: its values, and the axes and units of their standard deviations."""

    GNSS = 1
    """lat, lon (rad), height above the ellipsoid (m), vel_n (3, m/s) of the antenna; sigmas north, east, down: 3 x m, 3 x m/s."""
    BARO = 2
    """Pressure height (m), with an offset of its own; sigma m."""
    MAGNETIC = 3
    """Magnetic flux in body axes (3, T); sigmas T."""
    HEADING = 4
    """True heading (rad), from an operator or a two-antenna receiver; sigma rad."""
    ATTITUDE = 5
    """Attitude q_nb (4, scalar first), from four antennas or another navigator; three sigmas about north, east, down, rad."""
    BODY_VELOCITY = 6
    """Velocity over the ground in body axes (3, m/s); infinite sigma where only some axes are known (a wheel, a keel)."""
    ZERO_RATE = 7
    """The body turns with the Earth alone (no values); sigmas about its axes, rad/s."""
    GRAVITY = 8
    """The specific force is that against gravity: the vertical (no values); sigmas north, east, m/s^2."""


AIDING = np.dtype(
    [
        ("time", "<f8"),  # device time at which it was true, s
        ("kind", "<i4"),
        ("source", "<i4"),  # number of the receiver or sensor among those of its kind
        ("value", "<f8", 6),
        ("sigma", "<f8", 6),
    ]
)
"""A measurement."""


def aiding(time: float, kind: Kind, value: tuple[float, ...], sigma: tuple[float, ...], source: int = 0) -> np.void:
    """One row of `AIDING`; what is left out of `value` and `sigma` is zero and infinite."""
    row = np.zeros(1, AIDING)
    row["time"], row["kind"], row["source"], row["sigma"] = time, kind, source, np.inf
    row["value"][0, : len(value)], row["sigma"][0, : len(sigma)] = value, sigma
    result: np.void = row[0]
    return result


def aiding_rows(
    times: ArrayLike, kind: Kind, values: ArrayLike, sigmas: ArrayLike, source: int = 0
) -> NDArray[np.void]:
    """Rows of `AIDING`.

    Parameters
    ----------
    times : (n,) array_like
        Device times, s.
    kind : Kind
        What all of them measure.
    values, sigmas : (n, m) or (m,) array_like
        As in `Kind`; what is left out of them is zero and infinite.
    source : int
        Number of the receiver or sensor.
    """
    values, sigmas = np.atleast_2d(np.asarray(values, float)), np.atleast_2d(np.asarray(sigmas, float))
    rows = np.zeros(np.size(times), AIDING)
    rows["time"], rows["kind"], rows["source"], rows["sigma"] = times, kind, source, np.inf
    rows["value"][:, : values.shape[1]], rows["sigma"][:, : sigmas.shape[1]] = values, sigmas
    return rows


def of_receivers(rows: NDArray[np.void]) -> NDArray[np.bool_]:
    """Which of `rows` (n,) are fixes of satellite receivers."""
    found: NDArray[np.bool_] = (rows["kind"] == Kind.GNSS) & (rows["source"] < RELAYED + RECEIVERS)
    return found
