"""An operator's position and heading in a navigator that nothing aids."""

import math
from typing import Any

import numpy as np
import pytest

from nav.aiding import OPERATOR, Kind, aiding
from nav.earth import RATE
from nav.errors import HilError
from nav.increments import ImuIncrements
from nav.navigator import Navigator, Settings
from nav.rotation import euler_from_quaternion, quaternion_from_euler
from nav.state import Mode

LAT, LON, HEIGHT = 0.87, 0.63, 150.0


def navigator(mechanization: str) -> Navigator:
    made = Navigator(Settings(lat=LAT, lon=LON, height=HEIGHT, mechanization=mechanization))
    made.begin(LAT, LON, HEIGHT, np.array([30.0, 5.0, 0.0]), quaternion_from_euler(0.4, 0.02, -0.03), 0.0)
    return made


def rows(*given: object) -> np.ndarray:
    return np.array(given)


def place(lat: float, lon: float, source: int = OPERATOR) -> object:
    return aiding(1.0, Kind.GNSS, (lat, lon), (100.0, 100.0), source)


def heading(angle: float, source: int = OPERATOR) -> object:
    return aiding(1.0, Kind.HEADING, (angle,), (0.03,), source)


def step(made: Navigator, number: int = 1) -> Any:
    """The solution after a hundredth of a second of level flight, the `number`-th."""
    imu = ImuIncrements.empty(1)
    imu.time[0], imu.step[0], imu.sequence[0], imu.validity[0] = 0.01 * number, 0.01, number, 0
    imu.dtheta[0], imu.dvel[0] = 0.01 * RATE * np.array([0.5, 0.0, -0.7]), (0.0, 0.0, -0.098)
    return made.process(imu)[-1].copy()


@pytest.mark.parametrize("mechanization", ["geographic", "wander", "earth", "inertial"])
@pytest.mark.parametrize(("north_m", "east_m"), [(50.0, -70.0), (4e5, 3e5), (-2e6, 0.0)])
def test_the_position_is_moved_there_and_nothing_else(mechanization: str, north_m: float, east_m: float) -> None:
    made = navigator(mechanization)
    before = step(made)
    lat, lon = before["lat"] + north_m / 6.37e6, before["lon"] + east_m / 6.37e6 / math.cos(LAT)
    made.aid(rows(place(lat, lon)))
    after = step(made, 2)
    metres = 6.37e6 * np.array([after["lat"] - lat, (after["lon"] - lon) * math.cos(LAT)])
    assert np.abs(metres - 0.01 * before["vel_n"][:2]).max() < 0.05
    assert after["height"] == pytest.approx(before["height"], abs=0.01)
    assert after["vel_n"] == pytest.approx(before["vel_n"], abs=0.01)
    assert abs(after["q_nb"] @ before["q_nb"]) == pytest.approx(1.0, abs=1e-9)
    assert any("position" in event.text and event.station for event in made.events())


@pytest.mark.parametrize("mechanization", ["geographic", "wander"])
@pytest.mark.parametrize("angle", [0.4, 2.0, -2.9, 3.5])
def test_the_heading_is_turned_there_and_the_level_stays(mechanization: str, angle: float) -> None:
    made = navigator(mechanization)
    before = step(made)
    made.aid(rows(heading(angle)))
    after = step(made, 2)
    found, pitch, roll = euler_from_quaternion(after["q_nb"])
    assert abs(math.remainder(found - angle, 2.0 * math.pi)) < 1e-4
    assert (pitch, roll) == pytest.approx(tuple(euler_from_quaternion(before["q_nb"])[1:]), abs=1e-5)
    assert (after["lat"], after["lon"]) == pytest.approx((before["lat"], before["lon"]), abs=1e-6)


def test_nothing_but_an_operator_moves_an_unaided_navigator() -> None:
    made = navigator("geographic")
    step(made)
    made.aid(rows(place(0.5, 0.5, source=0), heading(2.0, source=145)))
    assert step(made, 2)["lat"] == pytest.approx(LAT, abs=1e-6)
    with pytest.raises(HilError, match="no number"):
        made.aid(rows(place(math.nan, 0.5)))
    waiting = Navigator(Settings())
    waiting.aid(rows(place(0.5, 0.5)))
    assert waiting.mode == Mode.INIT
