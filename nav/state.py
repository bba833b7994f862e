"""What the navigator says at every sample: one row of `NAV_STATE`, also the layout of the shared-memory ring."""

from enum import IntEnum, IntFlag

import numpy as np


class Mode(IntEnum):
    """Mode of the navigator."""

    INIT = 0
    """No sample seen yet."""
    ALIGN = 1
    """Standing still, finding the vertical and the north."""
    NAVIGATE = 2
    """Attitude, velocity and position are integrated from good samples."""
    DEGRADED = 3
    """Integrated, but something is wrong: see `Health`."""


class Health(IntFlag):
    """Reasons to distrust the solution; 0 is a healthy one."""

    GOOD = 0
    SILENT = 1
    """No sample arrives."""
    BRIDGED = 2
    """A gap longer than the policy interpolates was bridged since the last alignment."""
    SENSOR = 4
    """An instrument that the solution needs has failed or is saturated."""
    MOVING = 8
    """Alignment waits: the vehicle moves."""
    UNITS = 16
    """Specific force at rest is not 1 g: units, signs or axes are wrong."""
    RATE_TOO_SMALL = 32
    """The Earth rate is below the sensor's noise or there is no horizontal part: heading must be given."""
    UNAIDED = 64
    """Position and velocity of this grade of sensor cannot be trusted without aiding."""
    SPARE = 128
    """A redundant instrument has failed: the solution is good, but there is none to spare."""


class Ratio(IntEnum):
    """Places of what `test_ratio` holds."""

    VELOCITY = 0
    POSITION = 1
    HEIGHT = 2
    """Of a barometer."""
    DIRECTION = 3
    """Heading, attitude, magnetic field."""
    REST = 4
    """Of a vehicle that is known to stand."""


NAV_STATE = np.dtype(
    [
        ("arrival_ns", "<i8"),  # host clock (UTC, ns) when the sample's last frame was sent or received
        ("solution_ns", "<i8"),  # host clock (UTC, ns) when the solution was put into the ring
        ("time", "<f8"),  # device time, s
        ("sequence", "<i8"),  # sample counter of the device, unwrapped
        ("mode", "<i4"),
        ("health", "<i4"),
        ("lat", "<f8"),  # geodetic, rad
        ("lon", "<f8"),  # rad
        ("height", "<f8"),  # above the ellipsoid, m
        ("vel_n", "<f8", 3),  # north, east, down, m/s
        ("q_nb", "<f8", 4),  # body to n, scalar first
        ("w_ib_b", "<f8", 3),  # mean over the sample's step, bias removed, rad/s
        ("f_b", "<f8", 3),  # mean over the sample's step, m/s^2
        ("gyro_bias", "<f8", 3),  # rad/s
        ("progress", "<f8"),  # of the alignment, 0..1
        (
            "sigma",
            "<f4",
            9,
        ),  # one sigma of position, velocity, attitude, each north, east, down: m, m/s, rad; inf: unknown
        (
            "test_ratio",
            "<f4",
            len(Ratio),
        ),  # innovation over its gate, by `Ratio`; 1 and more: rejected, 0: no measurement
    ]
)
"""One solution. Until the mode is NAVIGATE or DEGRADED, position is the configured start and velocity is zero.

Only an aided navigator knows its sigmas: they are infinite, and the ratios zero, in all others and until the mode is NAVIGATE.
"""

HOST_FIELDS = 16
"""Bytes at the start of a row that belong to the host's clock; all that follows is the same in every replay."""
