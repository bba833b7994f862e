"""Measurements from the network in a live session: the navigator follows them, and a recording replays to the same bits."""

import math
import time
from pathlib import Path

import pytest
from pymavlink import mavutil
from pymavlink.dialects.v20 import ardupilotmega as mav

from drivers.can.aiding import AidingDecoder, AidingEncoder
from drivers.can.frames import FrameArray
from hil.bridge import LoopOrder
from hil.geoid import undulation
from hil.pytest_plugin import StartBridge
from hil.scenario import Scenario
from hil.session import Session
from nav.aiding import RELAYED, Kind, aiding_rows
from nav.earth import curvature_radii
from nav.errors import HilError
from nav.rotation import euler_from_quaternion
from nav.state import Mode

LAT_DEG, LON_DEG, HEIGHT_M = 50.0, 36.25, 150.0
NORTH_M = 8.0
"""How far to the north of the truth the network says we are: within the doubt of the start."""
SCENARIO = Scenario.model_validate(
    {
        "motion": {"latitude_deg": LAT_DEG, "longitude_deg": LON_DEG, "height_m": HEIGHT_M},
        "head": {"rate_hz": 200, "instruments": "dtg", "grade": "tactical"},
        "navigation": {"alignment": "truth", "aided": True},
        "mavlink": {"aiding": True, "aiding_delay_s": 0.05},
    }
)


def fix() -> mav.MAVLink_gps_input_message:
    meridian, _ = curvature_radii(math.sin(math.radians(LAT_DEG)))
    lat_deg = LAT_DEG + math.degrees(NORTH_M / (meridian + HEIGHT_M))
    no_height = mav.GPS_INPUT_IGNORE_FLAG_ALT
    no_velocity = mav.GPS_INPUT_IGNORE_FLAG_VEL_HORIZ | mav.GPS_INPUT_IGNORE_FLAG_VEL_VERT
    return mav.MAVLink_gps_input_message(
        0, 0, no_height | no_velocity, 0, 0, 3, round(1e7 * lat_deg), round(1e7 * LON_DEG), 0.0,
        1.0, 1.0, 0.0, 0.0, 0.0, 0.0, 0.5, 0.0, 12,
    )  # fmt: skip


def north_m(lat: float) -> float:
    meridian, _ = curvature_radii(math.sin(math.radians(LAT_DEG)))
    return (lat - math.radians(LAT_DEG)) * (meridian + HEIGHT_M)


def test_the_position_follows_and_the_recording_replays(hil_bridge: StartBridge, tmp_path: Path) -> None:
    file = tmp_path / "network.dhil"
    bridge = hil_bridge(SCENARIO, record=file)
    client = mavutil.mavlink_connection(
        f"udpin:127.0.0.1:{bridge.mavlink_port}", source_system=255, dialect="ardupilotmega"
    )
    assert client.recv_match(type="ATTITUDE", blocking=True, timeout=30.0) is not None
    deadline, told, estimate = time.monotonic() + 60.0, 0, None
    while abs(north_m(float(bridge.state()["lat"])) - NORTH_M) > 1.0 or told < 20 or estimate is None:
        assert time.monotonic() < deadline
        client.mav.send(fix())
        told += 1
        time.sleep(0.2)
        while (heard := client.recv_msg()) is not None:
            estimate = heard if heard.get_type() == "ESTIMATOR_STATUS" and told > 10 else estimate
    stranger = mav.MAVLink(client, 7, 1)
    client.write(fix().pack(stranger))
    time.sleep(0.3)
    client.close()
    summary = bridge.stop()

    assert estimate.pos_horiz_accuracy < 2.0
    assert estimate.flags & mav.ESTIMATOR_POS_HORIZ_ABS
    network = summary["publisher"]["aiding"]
    assert network["refused"] == {"sender": 1}
    assert 20 <= network["taken"]["GPS_INPUT"] <= told
    assert summary["aiding"]["GNSS"] == network["taken"]["GPS_INPUT"]
    assert not any(summary["aiding_faults"].values())
    with Session(LoopOrder(SCENARIO, file=file, paced=False), publish=False) as session:
        session.wait_ready()
        while session.running:
            time.sleep(0.05)
    again = session.summary()
    assert again["navigation_digest"] == summary["navigation_digest"]
    assert again["aiding"] == summary["aiding"]
    assert again["samples"] == summary["samples"]


def test_the_alignment_is_transferred_from_another_inertial_system(hil_bridge: StartBridge, tmp_path: Path) -> None:
    """ATTITUDE_QUATERNION and GLOBAL_POSITION_INT of system 2 begin the navigation, live and in the replay."""
    file, heading = tmp_path / "transfer.dhil", math.radians(30.0)
    scenario = SCENARIO.with_changes(
        motion={"heading": {"offset": 30.0}},
        navigation={"alignment": "transfer", "start": {"latitude_deg": 0.0, "longitude_deg": 0.0, "height_m": 0.0}},
        mavlink={"master": (2, 1)},
    )
    bridge = hil_bridge(scenario, record=file)
    client = mavutil.mavlink_connection(
        f"udpin:127.0.0.1:{bridge.mavlink_port}", source_system=2, source_component=1, dialect="ardupilotmega"
    )
    assert client.recv_match(type="HEARTBEAT", blocking=True, timeout=30.0) is not None
    sea_m = HEIGHT_M - undulation(math.radians(LAT_DEG), math.radians(LON_DEG))
    place = round(1e7 * LAT_DEG), round(1e7 * LON_DEG), round(1e3 * sea_m)
    deadline = time.monotonic() + 60.0
    while (state := bridge.state()) is None or state["mode"] != Mode.NAVIGATE:
        assert time.monotonic() < deadline
        client.mav.attitude_quaternion_send(0, math.cos(heading / 2), 0.0, 0.0, math.sin(heading / 2), 0.0, 0.0, 0.0)
        client.mav.global_position_int_send(0, *place, 0, 0, 0, 0, 3000)
        time.sleep(0.2)
    client.close()
    summary = bridge.stop()
    assert north_m(float(state["lat"])) == pytest.approx(0.0, abs=1.0)
    assert state["height"] == pytest.approx(HEIGHT_M, abs=1.0)
    assert euler_from_quaternion(state["q_nb"]) == pytest.approx([heading, 0.0, 0.0], abs=1e-3)
    assert summary["aiding"].keys() == {"GNSS", "ATTITUDE"}
    with Session(LoopOrder(scenario, file=file, paced=False), publish=False) as session:
        session.wait_ready()
        while session.running:
            time.sleep(0.05)
    assert session.summary()["navigation_digest"] == summary["navigation_digest"]


def test_nobody_steers_the_navigator_unasked(hil_bridge: StartBridge) -> None:
    bridge = hil_bridge(SCENARIO.with_changes(mavlink={"aiding": False}))
    client = mavutil.mavlink_connection(
        f"udpin:127.0.0.1:{bridge.mavlink_port}", source_system=255, dialect="ardupilotmega"
    )
    assert client.recv_match(type="ATTITUDE", blocking=True, timeout=30.0) is not None
    for _ in range(5):
        client.mav.send(fix())
    client.mav.command_long_send(1, 1, mav.MAV_CMD_FIXED_MAG_CAL_YAW, 0, 10, 0, 0, 0, 0, 0, 0)
    ack = client.recv_match(type="COMMAND_ACK", blocking=True, timeout=30.0)
    client.close()
    summary = bridge.stop()
    assert ack.result == mav.MAV_RESULT_UNSUPPORTED
    assert summary["publisher"]["received"]["GPS_INPUT"] >= 1
    assert summary["aiding"] == {}
    assert "aiding" not in summary["publisher"]


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"navigation": {"aided": False}}, "navigation.aided = true"),
        ({"mavlink": {"aiding": False, "master": (2, 1)}}, "mavlink.aiding = true"),
    ],
)
def test_contradictions_are_refused(changes: dict[str, object], says: str) -> None:
    with pytest.raises(HilError, match=says):
        SCENARIO.with_changes(**changes)


def test_a_relay_counts_for_itself() -> None:
    """Frames of the bus and of the network with the same counters are both taken; repeated ones of each are not."""

    def sent(source: int) -> FrameArray:
        rows = aiding_rows([1.0, 2.0, 3.0], Kind.HEADING, [[0.1], [0.2], [0.3]], [0.01], source)
        return AidingEncoder().frames(rows)

    bus, network, decoder = sent(0), sent(RELAYED), AidingDecoder()
    for k in range(3):
        for frame in (bus[k : k + 1], network[k : k + 1], bus[k : k + 1]):
            decoder.decode(frame, 1.0)
    assert decoder.heard[Kind.HEADING] == 6
    assert decoder.counters.duplicated == 3
    assert decoder.counters.lost == 0
