"""Feeds in a whole run: simulated time waits for the autopilot, real time does not, and the user is told what is rounded away."""

import ipaddress
import os
import signal
import time
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from autopilots import ArduPilotAhrs, Px4, Sitl, on_terminal
from commands import called
from hypothesis import example, given
from hypothesis import strategies as st

from hil.feed.common import ACTUATORS
from hil.feed.config import FeedConfig
from hil.feed.quantisation import warnings
from hil.feed.tap import Tap, mean_row
from hil.pytest_plugin import StartBridge
from hil.ring import Ring
from hil.scenario import load
from nav.errors import HilError
from nav.instruments.grades import GRADES
from nav.state import NAV_STATE, Mode

TRUTH = {"alignment": "truth"}
MOVING = {"rest_s": 0, "ramp_s": 0}
JSON = {"kind": "ardupilot-json", "address": "127.0.0.1:0"}


def port(place: str) -> int:
    return int(place.rpartition(":")[2])


def test_simulated_time_waits_for_the_autopilot(hil_bridge: StartBridge) -> None:
    """Every solution goes to it once, though the ring holds fewer; the navigation is the same as without it."""
    run: dict[str, Any] = {"navigation": TRUTH, "motion": MOVING, "duration_s": 10, "mavlink": {"links": ()}}
    alone = hil_bridge(paced=False, **run).wait_end(120)
    bridge = hil_bridge(paced=False, **run, feed=[JSON])
    sitl, times, slowest = Sitl(port(bridge.session.feed_places()[0])), [], 0
    sitl.socket.settimeout(30.0)
    while len(times) < 10000:
        sitl.send()
        times.append(float(sitl.socket.recv(4096).split(b":")[1].split(b",")[0]))
        sitl.count += 1
        slowest = max(slowest, bridge.session.outlets.states.count - len(times))
    np.testing.assert_allclose(times, np.arange(1, 10001) * 1e-3, atol=1e-9)
    assert slowest < bridge.session.outlets.states.capacity, "the loop waited"
    sitl.send()  # one more: there is nothing left
    summary = bridge.wait_end(60)
    assert summary["navigation_digest"] == alone["navigation_digest"]
    (feed,) = summary["feeds"]
    assert (feed["frames"], feed["lost_solutions"], feed["kind"]) == (10000, 0, "ardupilot-json")
    row = np.zeros(1, ACTUATORS)
    assert bridge.session.feeds.actuators[0].latest(row)
    assert row["values"][0, :3].tolist() == [1000.0, 1001.0, 1002.0]
    assert "problems" not in summary


def test_all_kinds_at_once_in_real_time(hil_bridge: StartBridge) -> None:
    feeds = [JSON, {"kind": "px4", "address": "127.0.0.1:0"}, {"kind": "vectornav"}]
    bridge = hil_bridge(navigation=TRUTH, motion=MOVING, head={"rate_hz": 500}, feed=feeds)
    bridge.wait_mode("navigate")
    json, px4_place, terminal = bridge.session.feed_places()
    sitl, px4 = Sitl(port(json)), Px4(port(px4_place))
    read, write, close = on_terminal(terminal.removeprefix("pty "))
    ahrs = ArduPilotAhrs(read, write, old=False)
    ahrs.initialize()
    sensed = sitl.frame()
    deadline = time.monotonic() + 20.0
    while len(ahrs.packets) < 20 and time.monotonic() < deadline:
        sensed = sitl.frame()
        if px4.sensors(0.5):
            px4.actuators()
        ahrs.listen(0.01)
    state = bridge.state()
    assert 0.0 < sensed.timestamp <= state["time"]
    assert 0 < px4.clock_us <= state["time"] * 1e6 + 1.0
    texts = [text for _, _, text in bridge.events()]
    assert sum("feed px4: the autopilot rounds" in text for text in texts) == 2
    close()
    summary = bridge.stop()
    assert summary["lost"] == 0
    assert [feed["kind"] for feed in summary["feeds"]] == ["ardupilot-json", "px4", "vectornav"]
    assert all(feed["frames"] > 3 for feed in summary["feeds"])
    assert "problems" not in summary


def lockstep(hil_bridge: StartBridge) -> tuple[Any, Sitl, int]:
    """A run in simulated time, the autopilot of its feed behind the first frame, and the process of the feed."""
    bridge: Any = hil_bridge(
        navigation=TRUTH, motion=MOVING, duration_s=12, paced=False, mavlink={"links": ()}, feed=[JSON]
    )
    sitl = Sitl(port(bridge.session.feed_places()[0]))
    sitl.socket.settimeout(30.0)
    sitl.frame()
    pid = bridge.session._parts["feed 0"].process.pid
    assert pid
    return bridge, sitl, pid


def test_the_death_of_a_feed_is_said_and_the_run_goes_on(hil_bridge: StartBridge) -> None:
    bridge, _sitl, feed = lockstep(hil_bridge)
    os.kill(feed, signal.SIGKILL)
    summary = bridge.wait_end(60)
    assert summary["problems"] == ["the feed 0 process died (exit code -9)"]
    assert summary["samples"] == 12000


def test_a_stopped_feed_holds_simulated_time_and_it_is_said(hil_bridge: StartBridge) -> None:
    """A feed that is stopped cannot give its autopilot up: the user has to know what the run waits for."""
    bridge, sitl, feed = lockstep(hil_bridge)
    os.kill(feed, signal.SIGSTOP)
    deadline = time.monotonic() + 30.0
    while not bridge.session.problems and time.monotonic() < deadline:
        assert bridge.session.running
        time.sleep(0.05)
    (said,) = bridge.session.problems
    assert said == "the feed 0 process does not answer: it is stopped or starved, and simulated time waits for it"
    waiting = bridge.session.outlets.stats["samples"]
    os.kill(feed, signal.SIGCONT)
    sitl.frame()
    os.kill(feed, signal.SIGKILL)  # nobody is waited for any more
    summary = bridge.wait_end(60)
    assert waiting < summary["samples"] == 12000


def scaled(grade: str, rate_hz: float, rng: np.random.Generator) -> tuple[float, float]:
    """Deviation of mean rate (deg/s) and force (mg) over a period, of white noise that is drawn."""
    fine_s, count = 1e-4, round(1e4 / rate_hz)
    white = rng.standard_normal((400, count)) / np.sqrt(fine_s)
    mean = float(white.mean(axis=1).std())
    return np.degrees(GRADES[grade].gyro_white) * mean, GRADES[grade].accelerometer_white * mean / 9.80665e-3


@pytest.mark.parametrize("grade", ["dtg", "tactical", "mems"])
def test_the_warning_comes_where_rounding_is_coarser_than_noise(grade: str) -> None:
    """PX4 keeps 2000 deg/s and 16 g in 16 bits."""
    rate, force = scaled(grade, 250.0, np.random.default_rng(1))
    found = warnings(FeedConfig(kind="px4", rate_hz=250), load(None).with_changes(head={"grade": grade}))
    assert any("rates to 0.061 deg/s" in text for text in found) == (rate < 2000.0 / 32768.0)
    assert any("forces to 0.488 mg" in text for text in found) == (force < 1000.0 / 2048.0)
    for kind in ("ardupilot-json", "vectornav"):
        assert not warnings(FeedConfig(kind=kind), load(None).with_changes(head={"grade": grade}))


def test_what_the_filter_is_told_of_the_sensor_counts() -> None:
    noisy = load(None).with_changes(navigation={"filter": {"grade": "dtg", "gyro_deg_sqrt_h": 1.0}})
    found = warnings(FeedConfig(kind="px4"), noisy)
    assert [text.split()[5] for text in found] == ["forces"]
    assert warnings(FeedConfig(kind="px4"), load(None).with_changes(driver="vectornav")) == [], "not known"
    assert len(warnings(FeedConfig(kind="px4"), load(None))) == 2, "an ideal head"


@given(
    st.lists(st.integers(1, 40), min_size=1, max_size=20),
    st.sampled_from([0.0, 0.004, 0.02]),
    st.booleans(),
)
@example([1, 1, 1, 2], 0.004, True)
def test_a_tap_gives_every_solution_once(batches: list[int], span_s: float, restart: bool) -> None:
    """However they come, and where the sensor's clock begins anew: all of them, in times that rise, spans as long as asked."""
    ring, number = Ring(NAV_STATE, 1024, 0), 0
    tap = Tap(ring)
    spans, taken = [], 0
    for part, count in enumerate(batches):
        rows = np.zeros(count, NAV_STATE)
        if restart and part == len(batches) // 2:
            number = 0
        rows["time"] = 1e-3 * np.arange(number + 1, number + count + 1)
        rows["mode"], rows["w_ib_b"][:, 0] = Mode.NAVIGATE, 1.0
        number += count
        ring.push(rows)
        ring.push(rows[-1:])  # a silent sensor's solution is told twice
        while (found := tap.take(span_s)) is not None:
            spans.append((float(found["time"][0]), float(found["time"][-1])))
            taken += len(found)
            assert mean_row(found, "navigated")["w_ib_b"][0] == 1.0
    ends = [end for _, end in spans]
    assert all(b > a for a, b in pairwise(ends))
    assert tap.lost == 0
    left = sum(batches) - taken
    same = int(restart)  # one that begins anew at the very same time is not told apart
    assert 0 <= left < max(1, round(span_s * 1000)) + same
    if not restart:
        assert all(b - a >= span_s - 1e-5 for a, b in pairwise(ends))


def test_a_slow_tap_says_what_it_lost() -> None:
    ring = Ring(NAV_STATE, 16, 0)
    tap, rows = Tap(ring), np.zeros(40, NAV_STATE)
    rows["time"], rows["mode"] = 1e-3 * np.arange(1, 41), Mode.NAVIGATE
    ring.push(rows)
    found = tap.take(0.0)
    assert found is not None
    assert len(found) == 16
    assert tap.lost == 24


@pytest.mark.parametrize(
    ("feed", "told"),
    [
        ({"kind": "px5"}, "feed.0.kind = 'px5'"),
        ({"kind": "px4", "address": "127.0.0.1"}, "expected HOST:PORT"),
        ({"kind": "ardupilot-json", "address": ":9002"}, "expected HOST:PORT"),
        ({"kind": "px4", "address": "127.0.0.1:70000"}, "expected HOST:PORT"),
        ({"kind": "vectornav", "address": "/dev/ttyS0"}, "expected pty, pty:PATH, tcp:HOST:PORT or serial:"),
        ({"kind": "px4", "rate_hz": 10}, "greater than or equal to 50"),
    ],
)
def test_a_wrong_feed_is_refused_with_what_was_expected(feed: dict[str, Any], told: str) -> None:
    with pytest.raises(HilError, match=r"feed\.0") as refused:
        load(None).with_changes(feed=[feed])
    assert told in str(refused.value)


@pytest.mark.parametrize(
    ("host", "beyond"),
    [("0.0.0.0", ["ardupilot-json on udpin", "px4 on tcpin", "vectornav on tcpin"]), ("127.0.0.2", [])],
)
def test_feeds_that_other_machines_can_reach_are_said(host: str, beyond: list[str]) -> None:
    """As of MAVLink links: before the run, and in the same words."""
    feeds = (f"ardupilot-json:{host}:0", f"px4:{host}:0", f"vectornav:tcp:{host}:0", "vectornav:pty")
    options = [part for feed in feeds for part in ("--feed", feed)]
    code, _, err = called("run", "rest", "--duration", 0.1, "--mavlink", "none", "--no-dashboard", *options)
    assert code == 0, err
    told = [line for line in err.splitlines() if "other machines" in line]
    assert told == [f"feed {one}:{host}:0 can be reached from other machines; nothing is signed" for one in beyond]


@pytest.mark.parametrize("kind", ["ardupilot-json", "px4", "vectornav"])
def test_a_feed_listens_to_this_machine_alone_unless_told_otherwise(kind: Any) -> None:
    listens = FeedConfig(kind=kind).listens
    assert not listens or ipaddress.ip_address(listens.split(":")[1]).is_loopback


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        (("--feed", "nosuch:1"), "unknown kind 'nosuch'; expected ardupilot-json:HOST:PORT, px4:HOST:PORT"),
        (("--feed", "vectornav", "--speed", "max"), "a vectornav feed needs real time"),
        (("--feed", "ardupilot-json:nohost.invalid:9002"), "cannot listen there"),
    ],
)
def test_wrong_requests_end_before_the_run(arguments: tuple[str, ...], told: str) -> None:
    code, _, err = called("run", "rest", "--duration", 1, "--mavlink", "none", *arguments)
    assert code == 2
    assert told in err
