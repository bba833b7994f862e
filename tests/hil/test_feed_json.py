"""The feed to ArduPilot SITL, with SITL's side of the wire written from its description."""

import socket
import time
from collections.abc import Iterator

import numpy as np
import pymap3d
import pytest
from autopilots import Sitl
from feeding import START, RunningFeed, running_feed, until
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

JSON = {"kind": "ardupilot-json", "address": "127.0.0.1:0"}
with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as _probe:
    _probe.bind(("127.0.0.1", 0))
    OWN_PORT: int = _probe.getsockname()[1]


@pytest.fixture
def lockstep() -> Iterator[RunningFeed]:
    with running_feed(**JSON, paced=False) as feed:
        yield feed


@pytest.fixture(scope="module")
def shared() -> Iterator[RunningFeed]:
    with running_feed(**JSON, paced=False, patience_s=1000.0) as feed:
        yield feed


@pytest.mark.parametrize("channels", [16, 32])
def test_every_frame_is_answered_with_the_next_solution(lockstep: RunningFeed, channels: int) -> None:
    rows, sitl = lockstep.push(300), Sitl(lockstep.port, channels)
    for row in rows:
        sensed = sitl.frame()
        assert sensed.timestamp == row["time"]
        assert sensed.gyro == row["w_ib_b"].tolist()
        assert sensed.accel_body == row["f_b"].tolist()
        assert sensed.velocity == row["vel_n"].tolist()
        assert sensed.quaternion == row["q_nb"].tolist()
        north, east, down = pymap3d.geodetic2ned(
            row["lat"], row["lon"], row["height"], START[0], START[1], START[2], deg=False
        )
        np.testing.assert_allclose(sensed.position, [north, east, down], atol=1e-6)
    assert lockstep.commanded()["values"][:channels].tolist() == [1000.0 + n for n in range(channels)]
    counters = lockstep.end()
    assert counters["frames"] == 300
    assert counters["actuators"]["values"] == [1000.0 + n for n in range(channels)]
    for name in ("resent", "restarts", "lost_frames", "bad_data", "refused", "dropped", "lost_solutions"):
        assert counters[name] == 0, name


def test_steps_are_as_long_as_sitl_wants(lockstep: RunningFeed) -> None:
    rows, sitl = lockstep.push(100), Sitl(lockstep.port, rate_hz=250)
    for k in range(4, 100, 4):
        sensed = sitl.frame()
        assert sensed.timestamp == rows["time"][k - 1]
        np.testing.assert_allclose(sensed.gyro, rows["w_ib_b"][k - 4 : k].mean(axis=0), rtol=1e-12)
        np.testing.assert_allclose(sensed.accel_body, rows["f_b"][k - 4 : k].mean(axis=0), rtol=1e-12)


def test_a_frame_that_comes_again_gets_the_same_answer(lockstep: RunningFeed) -> None:
    rows, sitl = lockstep.push(10), Sitl(lockstep.port)
    first = sitl.frame()
    for _ in range(3):
        sitl.count -= 1
        assert sitl.frame() == first
    assert sitl.frame().timestamp == rows["time"][1]
    counters = lockstep.end()
    assert (counters["frames"], counters["resent"]) == (2, 3)


def test_a_restart_and_lost_frames_are_counted(lockstep: RunningFeed) -> None:
    rows, sitl = lockstep.push(10), Sitl(lockstep.port)
    for _ in range(3):
        sitl.frame()
    sitl.count += 4  # four packets that never came
    sitl.frame()
    sitl.count = 0
    assert sitl.frame().timestamp == rows["time"][4], "the world goes on"
    counters = lockstep.end()
    assert (counters["restarts"], counters["lost_frames"]) == (1, 4)


def test_an_answer_waits_for_its_solution() -> None:
    with running_feed(**JSON) as feed:
        feed.push(5)
        sitl = Sitl(feed.port)
        assert sitl.frame().timestamp == 0.005, "real time: the newest"
        sitl.send()
        time.sleep(0.2)
        sitl.socket.setblocking(False)
        with pytest.raises(BlockingIOError):
            sitl.socket.recv(1000)
        sitl.socket.settimeout(5.0)
        row = feed.push(1)[0]
        assert sitl.receive().timestamp == row["time"]
        rows = feed.push(7)
        sensed = sitl.frame()
        assert sensed.timestamp == rows["time"][-1]
        np.testing.assert_allclose(sensed.gyro, rows["w_ib_b"].mean(axis=0), rtol=1e-12)
        assert feed.end()["lost_solutions"] == 0


def test_rates_with_the_bias_where_they_are_wanted() -> None:
    with running_feed(**JSON, rates="compensated") as feed:
        row = feed.push(1)[0]
        assert Sitl(feed.port).frame().gyro == pytest.approx(row["w_ib_b"] + row["gyro_bias"], rel=1e-12)


def test_nothing_is_said_before_there_is_an_attitude() -> None:
    with running_feed(**JSON) as feed:
        sitl = Sitl(feed.port)
        row = np.zeros(1, feed.ring.dtype)
        row["mode"], row["q_nb"] = 1, (1.0, 0.0, 0.0, 0.0)
        feed.ring.push(row)
        sitl.send()
        sitl.socket.settimeout(0.3)
        with pytest.raises(TimeoutError):
            sitl.receive()
        sitl.socket.settimeout(5.0)
        feed.push(1)
        assert sitl.receive().timestamp == 0.001


def test_time_goes_on_where_the_sensor_begins_anew() -> None:
    with running_feed(**JSON) as feed:
        sitl = Sitl(feed.port)
        feed.push(20)
        before = sitl.frame().timestamp
        feed.pushed = 0
        times = []
        for _ in range(3):
            feed.push(1)
            times.append(sitl.frame().timestamp)
        assert times[0] > before
        np.testing.assert_allclose(np.diff(times), 1e-3, atol=1e-9)


def test_a_second_autopilot_is_refused_until_the_first_is_silent(lockstep: RunningFeed) -> None:
    lockstep.push(50)
    first, second = Sitl(lockstep.port), Sitl(lockstep.port)
    first.frame()
    second.socket.settimeout(0.2)
    with pytest.raises(TimeoutError):
        second.frame()
    first.frame()
    time.sleep(1.1)
    second.socket.settimeout(5.0)
    assert second.frame().timestamp == 0.003
    counters = lockstep.end()
    assert (counters["refused"], counters["connections"]) == (1, 2)


@settings(max_examples=30, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.lists(st.binary(max_size=90) | st.integers(0, 39), max_size=8))
def test_whatever_comes_the_lockstep_goes_on(shared: RunningFeed, pieces: list[bytes | int]) -> None:
    """Random bytes, and servo packets that are cut short, from the autopilot's own address."""
    row = shared.push(1)[0]
    sitl = Sitl(shared.port, own_port=OWN_PORT)
    sitl.count = shared.pushed
    for piece in pieces:
        sitl.socket.send(sitl.servos(7)[:piece] if isinstance(piece, int) else piece)
    assert sitl.frame().timestamp == row["time"]
    sitl.close()  # the next one has its address: no other autopilot


def test_bad_datagrams_are_counted(lockstep: RunningFeed) -> None:
    lockstep.push(5)
    sitl = Sitl(lockstep.port)
    whole = sitl.servos(0)
    bad = [whole[:-1], whole + b"\0", whole[:7], b"\0" * 40, b"x"]
    for datagram in bad:
        sitl.socket.send(datagram)
    sitl.frame()
    assert lockstep.end()["bad_data"] == len(bad)


def test_simulated_time_does_not_wait_for_ever() -> None:
    with running_feed(**JSON, paced=False, patience_s=0.3) as feed:
        feed.push(10)
        assert "no autopilot on udp 127.0.0.1" in feed.hear()["failed"]
        assert feed.gate is not None
        feed.gate.wait(feed.ring, 0, lambda: False)  # open: the loop goes on


def test_an_address_in_use_is_told() -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as taken:
        taken.bind(("127.0.0.1", 0))
        with running_feed(kind="ardupilot-json", address=f"127.0.0.1:{taken.getsockname()[1]}") as feed:
            assert "cannot listen there" in feed.said["failed"]


def test_a_feed_sleeps_while_nobody_asks() -> None:
    with running_feed(**JSON) as feed:
        before = _cpu_s(feed.process.pid)
        until(lambda: feed.push(2) is not None and feed.pushed >= 1000)
        assert _cpu_s(feed.process.pid) - before < 0.05


def _cpu_s(pid: int | None) -> float:
    with open(f"/proc/{pid}/stat") as file:
        fields = file.read().rsplit(")", 1)[1].split()
    return (int(fields[11]) + int(fields[12])) / 100.0
