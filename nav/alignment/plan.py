"""What every way to align has in common: what it is told, what it says, and where the navigation begins."""

from dataclasses import dataclass, field
from typing import Literal, Protocol

import numpy as np
from numpy.typing import NDArray

from nav.alignment.rest import UNSTATED, Sensors
from nav.increments import FloatArray, ImuIncrements
from nav.lever_arm import shift
from nav.state import Health

Way = Literal["gyrocompass", "level", "swaying", "moving", "transfer"]
Vector = tuple[float, float, float]
GIVEN_UP = Health.MOVING | Health.UNITS | Health.RATE_TOO_SMALL
"""Health that an alignment sets and its end clears."""


@dataclass(frozen=True, slots=True)
class Plan:
    """How to align.

    Attributes
    ----------
    way : Way
        ``gyrocompass``, ``level``: at rest (:mod:`nav.alignment.standing`); ``swaying``, ``moving``: by optimisation, at a
        mooring or with GNSS; ``transfer``: from another navigator (:mod:`nav.alignment.moving`).
    lat, lon, height : float
        Where the navigated point stands or sways, rad and m above the ellipsoid.
    align_s : float
        How long, s.
    heading : float, optional
        Given heading for ``level``, rad; None: that of the heading source.
    sensors : Sensors
        What is known of them, in a level vehicle.
    sway : float
        How far the head moves about its mean place, one sigma an axis, m.
    lever_arm, antenna : tuple of float
        From the navigated point to the sensor and from the sensor to the GNSS antenna, b, m.
    """

    way: Way = "gyrocompass"
    lat: float = 0.0
    lon: float = 0.0
    height: float = 0.0
    align_s: float = 30.0
    heading: float | None = None
    sensors: Sensors = UNSTATED
    sway: float = 0.3
    lever_arm: Vector = (0.0, 0.0, 0.0)
    antenna: Vector = (0.0, 0.0, 0.0)

    @property
    def in_motion(self) -> bool:
        """The attitude is carried meanwhile: no sample may be missing."""
        return self.way in ("swaying", "moving", "transfer")

    @property
    def order(self) -> str:
        """What the vehicle shall do."""
        return {
            "swaying": f"stay at the mooring for {self.align_s:g} s",
            "moving": f"move with GNSS for {self.align_s:g} s; turns show the heading",
            "transfer": "another navigator has to send attitude, position and velocity",
        }.get(self.way, f"stand still for {self.align_s:g} s")


@dataclass(frozen=True, slots=True)
class Start:
    """Where the navigation begins.

    Attributes
    ----------
    time : float
        s.
    place : (3,) float
        Of the sensor: lat, lon (rad), height (m).
    vel_n, q_nb, gyro_bias : (3,), (4,), (3,) float
        m/s, attitude, rad/s.
    sigma : (9,) float
        One sigma: position and velocity north, east, down (m, m/s), attitude about them (rad).
    took_s : float
        How long it took, s.
    remark : str
        What else there is to say.
    since : ImuIncrements
        Samples after `time` that have come already; valid until the next call.
    """

    time: float
    place: FloatArray
    vel_n: FloatArray
    q_nb: FloatArray
    gyro_bias: FloatArray
    sigma: FloatArray
    took_s: float
    remark: str
    since: ImuIncrements = field(default_factory=lambda: ImuIncrements.empty(0))


@dataclass(frozen=True, slots=True)
class Word:
    """What an alignment says at a sample.

    Attributes
    ----------
    complaints : tuple of (Health, str)
        What is wrong.
    cleared : Health
        What is no longer wrong.
    notice : str
        What else has happened; empty for nothing.
    start : Start, optional
        It is done.
    """

    complaints: tuple[tuple[Health, str], ...] = ()
    cleared: Health = Health.GOOD
    notice: str = ""
    start: Start | None = None


class Aligner(Protocol):
    """One way to align, at work. What it says depends on samples and measurements in their order, not on batches."""

    @property
    def progress(self) -> float:
        """How much is done, 0..1; changes with a `Word` or at whole seconds that end `take`, and at no other time."""

    def take(self, imu: ImuIncrements, start: int, stop: int) -> tuple[int, Word | None]:
        """Take samples from `start` until there is something to say, before `stop`: how many, and what."""

    def aid(self, rows: NDArray[np.void]) -> None:
        """Take measurements, `nav.aiding.AIDING`; those that do not serve are passed over."""


def place_of_sensor(place: FloatArray, q_nb: FloatArray, lever_arm: Vector) -> FloatArray:
    """Place (3,) of the sensor of a vehicle that does not move, from that of the navigated point."""
    lat, lon, height = (np.array([value]) for value in place)
    shift(lat, lon, height, np.zeros((1, 3)), q_nb.reshape(1, 4), np.zeros((1, 3)), np.asarray(lever_arm, float))
    return np.concatenate([lat, lon, height])
