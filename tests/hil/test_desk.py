"""The built-in scenario `desk`: a MEMS head at rest, gravity and detected rest alone, through frames, driver and loop."""

import math

import pytest

from hil.assertions import parse
from hil.bridge import Loop, LoopOrder, Outlets, settings_of
from hil.scenario import Scenario, load
from hil.scenario import parse as parse_scenario
from hil.world.head import SimulatedHead
from nav.errors import HilError
from nav.instruments.grades import GRADES

THREE_SIGMA_DEG = 3.0 * math.degrees(GRADES["mems"].accelerometer_bias / 9.80665)


def run(scenario: Scenario, seconds: float) -> dict[str, object]:
    loop = Loop(LoopOrder(scenario, paced=False), Outlets.make(recording=False, readers=1))
    for _, *parts in SimulatedHead(scenario).chunks(round(seconds * scenario.head.rate_hz)):
        for part in parts:
            loop.take(part)
    return loop.result()


def check(summary: dict[str, object], heading_deg: float) -> None:
    for text in (
        "mode == navigate",
        f"error.tilt_deg.max < {THREE_SIGMA_DEG}",
        f"error.heading_deg.max < {heading_deg}",
        "error.position_m.max < 0.5",
        "error.velocity_ms.max < 0.2",
        "estimate.sigma.position_m < 20",
        "estimate.sigma.velocity_ms < 0.05",
        f"estimate.sigma.tilt_deg < {THREE_SIGMA_DEG}",
        f"estimate.sigma.heading_deg < {heading_deg}",
    ):
        assert parse(text).failure(summary) is None, text


def test_half_a_minute_on_the_desk() -> None:
    check(run(load("desk").with_changes(bus="unix:none", seed=2), 30.0), 1.0)


@pytest.mark.study
def test_an_hour_on_the_desk() -> None:
    summary = run(load("desk").with_changes(bus="unix:none"), 3600.0)
    check(summary, 3.5)
    assert isinstance(sigma := summary["estimate"]["sigma"], dict)
    assert isinstance(error := summary["error"], dict)
    assert error["heading_deg"]["final"] < 3.0 * sigma["heading_deg"]


def test_without_the_filter_nothing_is_assumed() -> None:
    with pytest.raises(HilError, match=r"navigation.*aided = true"):
        parse_scenario('[navigation.assume]\nrest = "detected"', "mine.toml")
    with pytest.raises(HilError, match=r"bounds.place_m.*required"):
        parse_scenario("[navigation]\naided = true\nassume.bounds = {acceleration_ms2 = 1, speed_ms = 1}", "mine.toml")
    assert settings_of(load("aided")).aiding.assumptions is None  # type: ignore[union-attr]
