"""Flights in closed form, and cores flown on their exact increments."""

from collections.abc import Iterator, Mapping
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hil.geometry import position_error
from hil.scenario import Channel, MotionConfig, Sine, load
from hil.world.motion import Motion
from nav.increments import FloatArray
from nav.strapdown import Strapdown

DURATION_S = 2050.0
LOOK_S = 0.5
"""Time between comparisons."""
CHUNK = 24_000
"""Steps a call: a multiple of every window, so that the blocks are those of the whole record."""


class Flight(Protocol):
    """What is true, and what an ideal inertial unit measures."""

    def truth(self, times: ArrayLike) -> NDArray[np.void]:
        """See `hil.world.motion.Motion.truth`."""
        ...

    def increments(self, first: int, count: int, step: float, dtheta: FloatArray, dvel: FloatArray) -> None:
        """See `hil.world.motion.Motion.increments`."""
        ...


def flight(name: str) -> Motion:
    """The motion of `configuration`."""
    return Motion(configuration(name))


def configuration(name: str) -> MotionConfig:
    """`smooth`: the built-in flight without its rest; `agile`: a jet that never stops banking and shaking."""
    if name == "smooth":
        return load("flight").motion.model_copy(update={"rest_s": 0.0, "ramp_s": 0.0})
    return MotionConfig(
        attitude="coordinated",
        north=Channel(rate=230.0),
        east=Channel(sines=(Sine(amplitude=176.0, period_s=35.0),)),  # bank of 30 degrees
        up=Channel(offset=3000.0, sines=(Sine(amplitude=300.0, period_s=240.0),)),
        heading=Channel(sines=(Sine(amplitude=1.0, period_s=2.0),)),
        pitch=Channel(sines=(Sine(amplitude=1.5, period_s=1.3, phase_deg=50.0),)),
        roll=Channel(sines=(Sine(amplitude=2.0, period_s=1.0, phase_deg=100.0),)),
    )


def fly(
    motion: Flight, step: float, cores: Mapping[str, Strapdown], duration: float = DURATION_S
) -> tuple[FloatArray, dict[str, FloatArray]]:
    """Fly all `cores` on the same exact increments.

    Returns
    -------
    time : (m,) float
        s.
    errors : dict of (m,) float
        Position error, m, by the names of `cores`.
    """
    truth = motion.truth([0.0])[0]
    for core in cores.values():
        core.start(truth["lat"], truth["lon"], truth["height"], truth["vel_n"], truth["q_nb"])
    stride = round(LOOK_S / step)
    out = np.empty((CHUNK, 3)), np.empty((CHUNK, 3)), np.empty((CHUNK, 4))
    times: list[FloatArray] = []
    found: dict[str, list[FloatArray]] = {name: [] for name in cores}
    for first, dtheta, dvel in _increments(motion, step, round(duration / step)):
        n = len(dtheta)
        rows = np.arange(stride - 1, n, stride)
        times.append(np.asarray((first + rows + 1) * step, np.float64))
        truths = motion.truth(times[-1])
        for name, core in cores.items():
            core.advance(np.full(n, step), dtheta, dvel, np.zeros(3), out[0][:n], out[1][:n], out[2][:n])
            lat, lon, height = np.ascontiguousarray(out[0][rows].T)
            found[name].append(np.linalg.norm(position_error(lat, lon, height, truths), axis=1))
    return np.concatenate(times), {name: np.concatenate(parts) for name, parts in found.items()}


def _increments(motion: Flight, step: float, count: int) -> Iterator[tuple[int, FloatArray, FloatArray]]:
    dtheta, dvel = np.empty((CHUNK, 3)), np.empty((CHUNK, 3))
    for first in range(0, count, CHUNK):
        n = min(CHUNK, count - first)
        motion.increments(first, n, step, dtheta[:n], dvel[:n])
        yield first, dtheta[:n], dvel[:n]
