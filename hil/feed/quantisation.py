"""Where an autopilot rounds what a feed gives it more coarsely than the sensor is noisy."""

import math
from dataclasses import dataclass

from hil.feed.config import FeedConfig
from hil.scenario import Scenario
from nav.earth import STANDARD_GRAVITY
from nav.instruments.grades import GRADES


@dataclass(frozen=True, slots=True)
class Resolution:
    """Steps or noise of rate and specific force: rad/s, m/s^2."""

    rate: float
    force: float


_SINGLE = Resolution(2.0**-23, 2.0**-20)
"""Single precision, to 2 rad/s and 16 m/s^2."""
STEPS = {
    "px4": Resolution(math.radians(2000.0 / 32768.0), STANDARD_GRAVITY / 2048.0),
    "ardupilot-json": _SINGLE,
    "vectornav": _SINGLE,
}
"""PX4 takes id 0 for a sensor of 16 bits, 2000 deg/s and 16 g."""
_IMU_HZ = {"vectornav": 50.0}
"""How many a second the autopilot asks for."""


def noise_of(scenario: Scenario, rate_hz: float) -> Resolution | None:
    """Noise of means over ``1 / rate_hz`` by the grade of the scenario; None for a board of no known grade.

    A head without errors has none.
    """
    name = scenario.navigation.filter.grade or scenario.head.grade
    if name == "none":
        return Resolution(0.0, 0.0) if scenario.driver == "dtg-head" else None
    grade, chosen = GRADES[name], scenario.navigation.filter
    given, forced = chosen.gyro_deg_sqrt_h, chosen.accelerometer_ms_sqrt_h
    rate = grade.gyro_white if given is None else math.radians(given) / 60.0
    force = grade.accelerometer_white if forced is None else forced / 60.0
    return Resolution(rate * math.sqrt(rate_hz), force * math.sqrt(rate_hz))


def delivered_hz(feed: FeedConfig, scenario: Scenario) -> float:
    """Samples a second that the autopilot gets."""
    wanted = feed.rate_hz if feed.kind == "px4" else _IMU_HZ.get(feed.kind, scenario.head.rate_hz)
    return min(wanted, scenario.head.rate_hz)


def warnings(feed: FeedConfig, scenario: Scenario) -> list[str]:
    """A line for each quantity that the autopilot rounds more coarsely than the sensor is noisy."""
    noise = noise_of(scenario, delivered_hz(feed, scenario))
    if noise is None:
        return []
    step, found = STEPS[feed.kind], []
    if noise.rate == 0.0 and step is _SINGLE:  # its steps shrink with the value: nothing to warn of
        return []
    for what, coarse, fine, unit, scale in (
        ("rates", step.rate, noise.rate, "deg/s", math.degrees(1.0)),
        ("forces", step.force, noise.force, "mg", 1e3 / STANDARD_GRAVITY),
    ):
        if coarse > fine:
            found.append(
                f"feed {feed.kind}: the autopilot rounds {what} to {coarse * scale:.3g} {unit}, "
                f"more coarsely than the noise of the sensor ({fine * scale:.2g} {unit})"
            )
    return found
