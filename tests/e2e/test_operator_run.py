"""An operator at a ground station's map, in a live run: pymavlink over UDP, the acknowledgement, and what is reported after."""

import math
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
from pymavlink import mavutil
from pymavlink.dialects.v20 import ardupilotmega as mav

from hil.bridge import LoopOrder
from hil.pytest_plugin import Bridge, StartBridge
from hil.session import Session

LAT, LON = 500_000_000, 362_500_000
"""Where the vehicle stands, 1e-7 deg."""
THERE = LAT + 200_000, LON - 300_000
"""Where the operator points: some two kilometres away."""
RUN: dict[str, Any] = {
    "motion": {"latitude_deg": 1e-7 * LAT, "longitude_deg": 1e-7 * LON, "height_m": 150.0},
    "head": {"rate_hz": 100},
    "navigation": {"alignment": "truth"},
}
ACCEPTED, DENIED, UNSUPPORTED = mav.MAV_RESULT_ACCEPTED, mav.MAV_RESULT_DENIED, mav.MAV_RESULT_UNSUPPORTED
NORTH_M, EAST_M = 111_229.0, 71_700.0
"""A degree at 50 deg north."""
METRE = 90
"""1e-7 deg of latitude, and more of longitude."""


class Desk:
    """A ground station."""

    def __init__(self, bridge: Bridge, system: int = 255) -> None:
        assert bridge.mavlink_port is not None
        self.link = mavutil.mavlink_connection(
            f"udpin:127.0.0.1:{bridge.mavlink_port}", source_system=system, dialect="ardupilotmega"
        )
        self.next("GLOBAL_POSITION_INT")

    def next(self, kind: str, fits: Callable[[Any], bool] = lambda _: True) -> Any:
        """The next message of a kind that fits."""
        deadline = time.monotonic() + 30.0
        while time.monotonic() < deadline:
            message = self.link.recv_match(type=kind, blocking=True, timeout=1.0)
            if message is not None and fits(message):
                return message
        raise AssertionError(f"no such {kind} in 30 s")

    def command(self, number: int, *params: float, at: tuple[int, int] = (0, 0), altitude_m: float = math.nan) -> int:
        """COMMAND_INT, as ground stations send places; the result that is acknowledged."""
        four = [*params, *[0.0] * (4 - len(params))]
        self.link.mav.command_int_send(1, 1, mav.MAV_FRAME_GLOBAL, number, 0, 0, *four, *at, altitude_m)
        return int(self.next("COMMAND_ACK", lambda ack: ack.command == number).result)


@contextmanager
def desk_of(bridge: Bridge) -> Iterator[Desk]:
    desk = Desk(bridge)
    try:
        yield desk
    finally:
        desk.link.close()


def is_at(place: tuple[int, int]) -> Callable[[Any], bool]:
    return lambda told: abs(told.lat - place[0]) < METRE and abs(told.lon - place[1]) < METRE


def test_home_is_moved_on_the_map(hil_bridge: StartBridge) -> None:
    """HOME_POSITION, and what is told relative to it, change; the position does not."""
    bridge = hil_bridge(**RUN)
    with desk_of(bridge) as desk:
        assert desk.command(mav.MAV_CMD_GET_HOME_POSITION) == ACCEPTED
        home = desk.next("HOME_POSITION")
        assert is_at((home.latitude, home.longitude))(desk.next("GLOBAL_POSITION_INT"))
        sea_m = 1e-3 * home.altitude
        assert desk.command(mav.MAV_CMD_DO_SET_HOME, at=THERE, altitude_m=sea_m - 20.0) == ACCEPTED
        moved = desk.next("HOME_POSITION")
        assert (moved.latitude, moved.longitude) == THERE
        assert moved.altitude == pytest.approx(home.altitude - 20_000, abs=20)
        local = desk.next("LOCAL_POSITION_NED", lambda told: abs(told.x) > 1.0)
        assert (-local.x, local.y) == pytest.approx((0.02 * NORTH_M, 0.03 * EAST_M), rel=2e-3)
        assert desk.next("GLOBAL_POSITION_INT", lambda told: told.relative_alt > 1000).relative_alt == pytest.approx(
            20_000, abs=50
        )
        desk.link.mav.set_gps_global_origin_send(1, LAT, LON, home.altitude)
        back = desk.next("HOME_POSITION", lambda told: told.latitude != THERE[0])
        assert (back.latitude, back.longitude) == (LAT, LON)
        assert desk.command(mav.MAV_CMD_DO_SET_HOME, at=(910_000_000, 0), altitude_m=0.0) == DENIED
        assert is_at((LAT, LON))(desk.next("GLOBAL_POSITION_INT"))
    assert bridge.stop()["lost"] == 0


def test_position_and_heading_are_given_on_the_map(hil_bridge: StartBridge, tmp_path: Path) -> None:
    """An unaided navigator is where the operator points, at its own height and level, and a recording goes there again."""
    file = tmp_path / "operator.dhil"
    bridge = hil_bridge(**RUN, mavlink={"operator": True}, record=file)
    with desk_of(bridge) as desk:
        before = desk.next("GLOBAL_POSITION_INT", is_at((LAT, LON)))
        assert desk.command(mav.MAV_CMD_EXTERNAL_POSITION_ESTIMATE, 0.0, 0.0, 30.0, at=THERE) == ACCEPTED
        after = desk.next("GLOBAL_POSITION_INT", is_at(THERE))
        assert after.alt == pytest.approx(before.alt, abs=500)
        assert desk.command(mav.MAV_CMD_FIXED_MAG_CAL_YAW, 90.0) == ACCEPTED
        level = desk.next("ATTITUDE", lambda told: abs(math.degrees(told.yaw) - 90.0) < 0.1)
        assert (level.roll, level.pitch) == pytest.approx((0.0, 0.0), abs=1e-3)
        for wrong in ((910_000_000, 0), (0, -2_000_000_000)):
            assert desk.command(mav.MAV_CMD_EXTERNAL_POSITION_ESTIMATE, 0.0, 0.0, 30.0, at=wrong) == DENIED
        stranger = mav.MAVLink(desk.link, 7, 190)
        stranger.command_int_send(
            1, 1, 0, mav.MAV_CMD_EXTERNAL_POSITION_ESTIMATE, 0, 0, 0, 0, 30, 0, LAT, LON, math.nan
        )
        assert desk.next("COMMAND_ACK").result == DENIED
        for _ in range(5):
            assert is_at(THERE)(desk.next("GLOBAL_POSITION_INT")), "nobody else moves it"
    summary = bridge.stop()
    assert summary["publisher"]["aiding"]["taken"] == {"EXTERNAL_POSITION_ESTIMATE": 1, "FIXED_MAG_CAL_YAW": 1}
    assert summary["publisher"]["aiding"]["refused"]["sender"] == 1
    with Session(LoopOrder(bridge.scenario, file=file, paced=False), publish=False) as session:
        session.wait_ready()
        while session.running:
            time.sleep(0.05)
    assert session.summary()["navigation_digest"] == summary["navigation_digest"]


def test_nobody_gives_a_position_unasked(hil_bridge: StartBridge) -> None:
    bridge = hil_bridge(**RUN)
    with desk_of(bridge) as desk:
        assert desk.command(mav.MAV_CMD_EXTERNAL_POSITION_ESTIMATE, 0.0, 0.0, 30.0, at=THERE) == UNSUPPORTED
        for _ in range(5):
            assert is_at((LAT, LON))(desk.next("GLOBAL_POSITION_INT"))
    bridge.stop()
