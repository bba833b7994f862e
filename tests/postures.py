"""A body that is held in postures and turned between them, for tests: what ideal sensors in it measure."""

import numpy as np
from scipy.spatial.transform import Rotation

from nav.increments import ImuIncrements

G = 9.81
RATE_HZ = 100
SEQUENCE = [(0, 0, 0), (0, 90, 0), (0, 0, 0), (0, 0, 90), (0, 0, 0), (90, 0, 0)]
"""Heading, pitch, roll (deg): flat, nose up, flat, right side down, flat, turned to the right."""


def increments(attitudes: Rotation) -> ImuIncrements:
    """Of a body that takes these attitudes (body to north-east-down) one after the other, in its place."""
    imu = ImuIncrements.empty(len(attitudes) - 1)
    imu.step[:] = 1.0 / RATE_HZ
    imu.time[:] = np.arange(1, len(attitudes)) / RATE_HZ
    imu.sequence[:] = np.arange(len(imu))
    turns = (attitudes[:-1].inv() * attitudes[1:]).as_rotvec()
    middle = attitudes[:-1] * Rotation.from_rotvec(0.5 * turns)
    imu.dtheta[:], imu.dvel[:] = turns, middle.inv().apply([0.0, 0.0, -G]) / RATE_HZ
    return imu


def through(ends: list[tuple[float, float, float]], rest_s: float = 2.0, turn_s: float = 1.5) -> ImuIncrements:
    """Rests at attitudes (heading, pitch, roll, deg) and smooth turns between them."""
    poses, part = Rotation.from_euler("ZYX", ends, degrees=True), np.linspace(0.0, 1.0, int(turn_s * RATE_HZ))[:, None]
    parts = [Rotation.concatenate([poses[0]] * int(rest_s * RATE_HZ))]
    for k in range(1, len(ends)):
        turn = (poses[k - 1].inv() * poses[k]).as_rotvec()
        parts.append(poses[k - 1] * Rotation.from_rotvec(part * part * (3.0 - 2.0 * part) * turn))
        parts.append(Rotation.concatenate([poses[k]] * int(rest_s * RATE_HZ)))
    return increments(Rotation.concatenate(parts))
