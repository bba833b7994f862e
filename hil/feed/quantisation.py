"""Where an autopilot rounds what a feed gives it more coarsely than the sensor is noisy."""

import math
from dataclasses import dataclass

from drivers.can.dtg_head_emulator import ANGLE_LSB, VELOCITY_LSB
from hil.feed.config import FeedConfig
from hil.scenario import Scenario
from nav.earth import STANDARD_GRAVITY
from nav.instruments.grades import GRADES

_SINGLE = 2.0**-23
"""Step of single precision from 1 to 2."""


@dataclass(frozen=True, slots=True)
class Resolution:
    """Steps or noise of rate and specific force: rad/s, m/s^2."""

    rate: float
    force: float


STEPS = {
    "px4": Resolution(math.radians(2000.0 / 32768.0), STANDARD_GRAVITY / 2048.0),
    "ardupilot-json": Resolution(_SINGLE, 8.0 * _SINGLE),
    "vectornav": Resolution(_SINGLE, 8.0 * _SINGLE),
}
"""PX4 takes id 0 for a sensor of 16 bits, 2000 deg/s and 16 g; the others keep single precision (to 2 rad/s and 16 m/s^2)."""
_IMU_HZ = {"vectornav": 50.0}
"""How many a second the autopilot asks for."""


def noise_of(scenario: Scenario, rate_hz: float) -> Resolution | None:
    """Noise of means over ``1 / rate_hz`` by the grade of the scenario; None for a board of no known grade.

    A head without errors is as noisy as its wire rounds.
    """
    head, chosen = scenario.head, scenario.navigation.filter
    name = chosen.grade or head.grade
    if name == "none" and scenario.driver != "dtg-head":
        return None
    samples = max(head.rate_hz / rate_hz, 1.0)
    rate = ANGLE_LSB * head.rate_hz / samples
    force = VELOCITY_LSB[head.layout] * head.rate_hz / samples
    if name != "none":
        grade = GRADES[name]
        given, forced = chosen.gyro_deg_sqrt_h, chosen.accelerometer_ms_sqrt_h
        rate_white = grade.gyro_white if given is None else math.radians(given) / 60.0
        force_white = grade.accelerometer_white if forced is None else forced / 60.0
        rate = math.hypot(rate, rate_white * math.sqrt(rate_hz))
        force = math.hypot(force, force_white * math.sqrt(rate_hz))
    return Resolution(rate, force)


def delivered_hz(feed: FeedConfig, scenario: Scenario) -> float:
    """Samples a second that the autopilot gets."""
    wanted = feed.rate_hz if feed.kind == "px4" else _IMU_HZ.get(feed.kind, scenario.head.rate_hz)
    return min(wanted, scenario.head.rate_hz)


def warnings(feed: FeedConfig, scenario: Scenario) -> list[str]:
    """A line for each quantity that the autopilot rounds more coarsely than the sensor is noisy."""
    noise = noise_of(scenario, delivered_hz(feed, scenario))
    if noise is None:
        return []
    step = STEPS[feed.kind]
    found = []
    for what, coarse, fine, unit, scale in (
        ("rates", step.rate, noise.rate, "deg/s", math.degrees(1.0)),
        ("forces", step.force, noise.force, "mg", 1e3 / STANDARD_GRAVITY),
    ):
        if coarse > fine:
            found.append(
                f"feed {feed.kind}: the autopilot rounds {what} to {coarse * scale:.3g} {unit}, "
                f"{coarse / fine:.3g} times the noise of the sensor ({fine * scale:.2g} {unit})"
            )
    return found
