"""The feed to PX4, with PX4's simulator interface as the other end (pymavlink over TCP)."""

import math
import socket
import struct
import time
from collections.abc import Iterator

import numpy as np
import pytest
from autopilots import Px4
from feeding import RunningFeed, running_feed, until
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from pymavlink.dialects.v20 import common as mav

from hil.geoid import undulation
from hil.magnetic import magnetic_field
from nav.rotation import conjugate, rotated

PX4 = {"kind": "px4", "address": "127.0.0.1:0", "rate_hz": 250}


@pytest.fixture
def lockstep() -> Iterator[RunningFeed]:
    with running_feed(**PX4, paced=False) as feed:
        yield feed


@pytest.fixture(scope="module")
def shared() -> Iterator[RunningFeed]:
    with running_feed(**PX4, paced=False, patience_s=1000.0) as feed:
        yield feed


def fly(px4: Px4, frames: int) -> list:
    """`frames` steps of the lockstep; their HIL_SENSOR."""
    found = []
    while len(found) < frames:
        found += px4.sensors()
        px4.actuators()
    return found


def started(px4: Px4) -> None:
    """PX4 is fed by the clock until its first actuators; what is on its way then is answered too."""
    fly(px4, 5)


def test_every_sensor_waits_for_the_actuators_of_the_last(lockstep: RunningFeed) -> None:
    rows, px4 = lockstep.push(1200), Px4(lockstep.port)
    started(px4)
    held = 0
    for _ in range(20):  # the sensor is there, the actuators are not: nothing more may come
        px4.sensors()
        held += not px4.sensors(0.05)
        px4.actuators()
    assert held >= 15, "but for a machine that is slower than the patience of the feed"
    found = fly(px4, 200)
    times = [message.time_usec for message in found]
    assert set(np.diff(times)) == {4000}, "no solution is left out, none is used twice"
    for message in found:
        last = round(message.time_usec / 1000)
        mean = rows[last - 4 : last]
        assert (message.xgyro, message.ygyro, message.zgyro) == pytest.approx(mean["w_ib_b"].mean(axis=0), rel=1e-6)
        assert (message.xacc, message.yacc, message.zacc) == pytest.approx(mean["f_b"].mean(axis=0), rel=1e-6)
        assert message.fields_updated & 0x3F == 0x3F
        assert not message.fields_updated & ~0x1BFF, "no airspeed, no reserved bits"
    commanded = lockstep.commanded()
    assert commanded["armed"]
    assert commanded["values"][:16].tolist() == [0.5] * 16
    counters = lockstep.end()
    assert counters["received"]["HIL_ACTUATOR_CONTROLS"] >= 200
    assert counters["dropped"] == counters["bad_data"] == counters["lost_solutions"] == 0


def test_units_are_those_of_the_messages(lockstep: RunningFeed) -> None:
    rows, px4 = lockstep.push(1200), Px4(lockstep.port)
    started(px4)
    fly(px4, 60)
    row = {round(r["time"] * 1e6): r for r in rows}
    slow = [m for m in px4.of("HIL_SENSOR") if m.fields_updated & 0x1A00 == 0x1A00]
    assert len(px4.of("HIL_SENSOR")) / len(slow) == pytest.approx(5.0, rel=0.2), "50 of 250 a second"
    for message in slow:
        state = row[message.time_usec]
        altitude = state["height"] - undulation(state["lat"], state["lon"])
        assert message.fields_updated & 0x1C0 == 0x1C0
        assert message.pressure_alt == pytest.approx(altitude, abs=1e-3)
        assert message.abs_pressure == pytest.approx(1013.25 * (1.0 - 2.25577e-5 * altitude) ** 5.25588, rel=1e-4)
        assert message.temperature == pytest.approx(15.0 - 6.5e-3 * altitude, abs=0.01)
        field_n = magnetic_field("dipole", state["lat"], state["lon"], state["height"], 2026.0)
        gauss = rotated(conjugate(state["q_nb"]), field_n) * 1e4
        assert (message.xmag, message.ymag, message.zmag) == pytest.approx(gauss, abs=1e-5)
    for message in px4.of("HIL_GPS"):
        state = row[message.time_usec]
        assert (message.lat, message.lon) == pytest.approx(np.degrees([state["lat"], state["lon"]]) * 1e7, abs=1)
        assert message.alt == pytest.approx(1e3 * (state["height"] - undulation(state["lat"], state["lon"])), abs=1)
        assert (message.vn, message.ve, message.vd) == pytest.approx(state["vel_n"] * 100.0, abs=1)
        assert message.vel == pytest.approx(math.hypot(*state["vel_n"][:2]) * 100.0, abs=1)
        course = math.degrees(math.atan2(state["vel_n"][1], state["vel_n"][0])) % 360.0
        assert message.cog == pytest.approx(course * 100.0, abs=1)
        assert (message.fix_type, message.eph, message.epv) == (3, 100, 100)
    for message in px4.of("HIL_STATE_QUATERNION"):
        state = row[message.time_usec]
        assert message.attitude_quaternion == pytest.approx(state["q_nb"], abs=1e-6)
        assert (message.vx, message.vy, message.vz) == pytest.approx(state["vel_n"] * 100.0, abs=1)
        gravity_b = rotated(conjugate(state["q_nb"]), [0.0, 0.0, 9.8106])
        acceleration_mg = (state["f_b"] + gravity_b) / 9.80665e-3
        assert (message.xacc, message.yacc, message.zacc) == pytest.approx(acceleration_mg, abs=2)
    span_s = (px4.clock_us - px4.of("HIL_SENSOR")[0].time_usec) * 1e-6
    assert len(px4.of("HIL_GPS")) == pytest.approx(10.0 * span_s, abs=2)
    assert len(px4.of("HIL_STATE_QUATERNION")) == pytest.approx(len(px4.of("HIL_SENSOR")) * 0.8, rel=0.3), "5 ms asked"
    assert px4.of("COMMAND_ACK")[0].command == mav.MAV_CMD_SET_MESSAGE_INTERVAL
    assert px4.of("HEARTBEAT")
    assert px4.of("SYSTEM_TIME")


def test_known_sigmas_are_stated() -> None:
    with running_feed(**PX4) as feed:
        px4 = Px4(feed.port)
        until(lambda: feed.push(4) is not None and px4.sensors(0.01))
        row = feed.push(1)
        row["time"] += 0.5
        row["sigma"] = (3.0, 4.0, 2.0, 0.1, 0.1, 0.1, 1e-3, 1e-3, 1e-2)
        feed.ring.push(row)
        until(lambda: px4.sensors(0.05) is not None and px4.of("HIL_GPS")[-1].eph == 500)
        assert px4.of("HIL_GPS")[-1].epv == 200


def test_an_autopilot_that_does_not_answer_is_not_waited_for(lockstep: RunningFeed) -> None:
    lockstep.push(200)
    px4 = Px4(lockstep.port)
    started(px4)
    px4.sensors()
    before = px4.clock_us
    began = time.monotonic()
    assert px4.sensors()[0].time_usec == before + 4000
    assert time.monotonic() - began > 0.1
    assert lockstep.end()["timeouts"] >= 1


def test_without_lockstep_it_runs_by_the_clock() -> None:
    with running_feed(**PX4) as feed:
        px4 = Px4(feed.port, lockstep=False)
        until(lambda: feed.push(4) is not None and px4.sensors(0.01))
        px4.actuators()
        heard = len(px4.of("HIL_SENSOR"))
        for _ in range(50):
            feed.push(4)
            px4.sensors(0.05)
        assert len(px4.of("HIL_SENSOR")) > heard + 10, "though no more actuators come"
        assert feed.end()["timeouts"] == 0


def test_inertial_sensors_alone() -> None:
    with running_feed(**PX4, paced=False, derived=False) as feed:
        feed.push(200)
        px4 = Px4(feed.port)
        started(px4)
        assert {message.fields_updated for message in fly(px4, 20)} == {0x3F}
        assert not px4.of("HIL_GPS")


def test_an_autopilot_goes_and_comes_back_and_a_second_is_refused(lockstep: RunningFeed) -> None:
    lockstep.push(1000)
    px4 = Px4(lockstep.port)
    started(px4)
    last = fly(px4, 5)[-1].time_usec
    second = socket.create_connection(("127.0.0.1", lockstep.port), timeout=5.0)
    px4.sensors()
    px4.actuators()
    assert second.recv(100) == b"", "turned away"
    px4.close()
    again = Px4(lockstep.port)
    assert again.sensors()[0].time_usec > last, "time has not gone back"
    again.actuators()
    fly(again, 5)
    counters = lockstep.end()
    assert (counters["connections"], counters["refused"]) == (2, 1)


def controls(values: list[float]) -> bytes:
    packer = mav.MAVLink(None, 1, 1)
    return bytes(mav.MAVLink_hil_actuator_controls_message(0, values, 129, 1).pack(packer))


@settings(max_examples=25, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.lists(st.binary(max_size=300) | st.integers(1, 60), max_size=6))
def test_whatever_comes_px4_is_fed(shared: RunningFeed, pieces: list[bytes | int]) -> None:
    """Random bytes and messages that are cut short; a new connection begins afresh."""
    shared.push(40)
    rude = socket.create_connection(("127.0.0.1", shared.port), timeout=5.0)
    for piece in pieces:
        rude.sendall(controls([0.1] * 16)[:piece] if isinstance(piece, int) else piece)
    rude.close()
    px4 = _connected(shared.port)
    assert px4.sensors()
    px4.close()
    time.sleep(0.01)


def _connected(port: int) -> Px4:
    """A client that comes while the one before is not yet gone is turned away: once more."""
    deadline = time.monotonic() + 10.0
    while time.monotonic() < deadline:
        px4 = None
        try:
            px4 = Px4(port)
            if px4.sensors(1.0):
                return px4
        except (AssertionError, OSError):
            time.sleep(0.02)
        finally:
            if px4 is not None and not px4.heard:
                px4.close()
    raise AssertionError("never let in")


def test_actuators_that_are_no_numbers_are_refused(lockstep: RunningFeed) -> None:
    lockstep.push(400)
    px4 = Px4(lockstep.port)
    started(px4)
    px4.sensors()
    px4.socket.sendall(struct.pack("<B", 0x55) * 40)
    px4.actuators((math.nan,) * 16)
    px4.actuators()
    fly(px4, 3)
    assert lockstep.commanded()["values"][:16].tolist() == [0.5] * 16
    assert lockstep.end()["bad_data"] >= 2


def test_an_address_in_use_is_told() -> None:
    with (
        socket.create_server(("127.0.0.1", 0)) as taken,
        running_feed(kind="px4", address=f"127.0.0.1:{taken.getsockname()[1]}") as feed,
    ):
        assert "cannot open it: Address already in use" in feed.said["failed"]
