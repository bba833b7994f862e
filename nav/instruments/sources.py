"""Error sources of the sensor grades for the linear covariance: the table of :mod:`nav.instruments.grades` in body axes."""

import numpy as np

from nav.covariance import Source
from nav.increments import FloatArray, IntArray
from nav.instruments.channels import Triple
from nav.instruments.grades import Grade
from nav.instruments.noise import flicker_processes


def combination(channels: tuple[Triple, ...]) -> FloatArray:
    """(3, c): increments in b from those of channels along body axes; channels of one axis are averaged.

    Parameters
    ----------
    channels : tuple of (3,) int
        The first of each is its axis.
    """
    return np.asarray(np.linalg.pinv(np.eye(3)[[triple[0] for triple in channels]]), np.float64)


def grade_sources(grade: Grade, step: float, *, bias_removed: bool = False) -> tuple[Source, ...]:
    """Sources of instruments of a grade, one sigma: what :meth:`Grade.draw` draws and its noises.

    Parameters
    ----------
    grade : Grade
        Row of the table.
    step : float
        Of the sensors, s: the shortest correlation time of their flicker.
    bias_removed : bool
        As in `Grade.draw`.
    """
    i, o, s = np.array(grade.gyro_channels).T
    gyro, force = np.zeros((len(i), 6)), np.zeros((3, 6))
    gyro[:, :3], force[:, 3:] = combination(grade.gyro_channels).T, np.eye(3)
    one, rate, pull = 0, 1, 4  # where r holds 1, w_ib_b, f_b
    x = np.arange(3)

    def constant(name: str, sigma: float, directions: FloatArray, *places: IntArray) -> Source:
        patterns = np.zeros((len(places), len(directions), 6, 7))
        for pattern, place in zip(patterns, places, strict=True):
            pattern[np.arange(len(directions)), :, place] = sigma * directions
        return Source(name, constant=patterns.reshape(-1, 6, 7))

    def flicker(name: str, value: float, directions: FloatArray) -> Source:
        times, sigma = flicker_processes(value, step)
        return Source(name, drift=sigma * directions, times=times)

    bias = grade.gyro_bias_removed if bias_removed else grade.gyro_bias
    return (
        constant("gyro bias", bias, gyro, one + 0 * i),
        constant("gyro scale factor", grade.gyro_scale, gyro, rate + i),
        constant("gyro misalignment", grade.gyro_misalignment, gyro, rate + o, rate + s),
        constant("g-sensitive drift", grade.gyro_g, gyro, pull + i, pull + o),
        Source("angle random walk", white=grade.gyro_white * gyro),
        flicker("gyro bias instability", grade.gyro_flicker, gyro),
        constant("accelerometer bias", grade.accelerometer_bias, force, one + 0 * x),
        constant("accelerometer scale factor", grade.accelerometer_scale, force, pull + x),
        Source("velocity random walk", white=grade.accelerometer_white * force),
        flicker("accelerometer bias instability", grade.accelerometer_flicker, force),
    )
