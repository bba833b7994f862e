"""Deadlines: what is granted, what is counted of them, and that nobody who stops or dies holds the loop up."""

import json
import os
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pymavlink.dialects.v20 import ardupilotmega as mav

from hil.bridge import LoopOrder
from hil.publisher import LOOP_DIED
from hil.pytest_plugin import StartBridge
from hil.realtime import LEAD_S, PRIORITY, REST, doze, refused, rest
from hil.ring import Shared, Wake
from hil.scenario import Scenario
from hil.session import STOPPED_S, Session, simulated_head
from hil.stats import BINS, Stats, Times
from nav.errors import HilError
from nav.state import Mode

TRUTH = {"alignment": "truth"}
NOTICED_S = 0.9
"""Sooner than anything else that would notice: the publisher calls a loop silent after a second."""


def pid_of(session: Any, part: str) -> int:
    pid = session._parts[part].process.pid
    assert pid
    return int(pid)


def listener() -> tuple[socket.socket, str]:
    client = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    client.bind(("127.0.0.1", 0))
    client.settimeout(20.0)
    return client, f"udpout:127.0.0.1:{client.getsockname()[1]}"


def until_said(client: socket.socket, text: str) -> float:
    """When a STATUSTEXT with the start of `text` came, s."""
    parser = mav.MAVLink(None)
    while True:
        for message in parser.parse_buffer(client.recv(65536)) or []:
            if message.get_type() == "STATUSTEXT" and text.startswith(message.text):
                return time.monotonic()


def test_the_loops_death_is_noticed_and_said_at_once() -> None:
    client, url = listener()
    scenario = Scenario.model_validate(
        {"bus": f"unix:death-{os.getpid()}", "head": {"rate_hz": 100}, "navigation": TRUTH, "mavlink": {"links": [url]}}
    )
    order = LoopOrder(scenario, own_world=True)
    with Session(order, feeder=simulated_head(order)) as session:
        session.wait_mode(Mode.NAVIGATE)
        client.recv(65536)  # the publisher is at work
        os.kill(pid_of(session, "loop"), signal.SIGKILL)
        killed = time.monotonic()
        said = until_said(client, LOOP_DIED)
        with pytest.raises(HilError, match="loop process died"):
            session.wait_mode(Mode.ALIGN, timeout_s=5.0)
        assert time.monotonic() - max(said, killed) < NOTICED_S
        assert said - killed < NOTICED_S


def test_a_normal_end_is_no_death(hil_bridge: StartBridge) -> None:
    client, url = listener()
    bridge = hil_bridge(navigation=TRUTH, head={"rate_hz": 100}, duration_s=1, mavlink={"links": [url]})
    summary = bridge.wait_end(30)
    assert not any("died" in problem for problem in summary.get("problems", ()))
    client.setblocking(False)
    heard = b""
    while True:
        try:
            heard += client.recv(65536)
        except BlockingIOError:
            break
    assert LOOP_DIED[:40].encode() not in heard


@pytest.mark.parametrize("reader", ["publisher", "recorder", "feed 0"])
def test_a_reader_that_stops_is_noticed_and_not_waited_for(
    reader: str, hil_bridge: StartBridge, tmp_path: Path
) -> None:
    _, url = listener()
    feed = {"kind": "ardupilot-json", "address": "127.0.0.1:0"}
    chosen: dict[str, Any] = {"head": {"rate_hz": 200}, "mavlink": {"links": [url]}, "feed": [feed]}
    bridge = hil_bridge(navigation=TRUTH, record=tmp_path / "run.dhil", **chosen)
    bridge.wait_mode("navigate")
    session: Any = bridge.session
    until = time.monotonic() + 30.0
    while session.outlets.control.beat_age_s(reader) == 0.0 and time.monotonic() < until:
        time.sleep(0.05)
    os.kill(pid_of(session, reader), signal.SIGSTOP)
    texts: list[str] = []

    def said(what: str) -> bool:
        deadline = time.monotonic() + 10 * STOPPED_S
        while not any(what in text for text in texts) and time.monotonic() < deadline:
            assert session.running
            texts.extend(text for _, _, text in bridge.events())
            time.sleep(0.05)
        return any(what in text for text in texts)

    try:
        assert said(f"the {reader} process does not answer")
        stopped_at = session.outlets.stats["samples"]
        time.sleep(0.5)
        assert session.outlets.stats["samples"] - stopped_at > 50, "the loop goes on"
    finally:
        os.kill(pid_of(session, reader), signal.SIGCONT)
    assert said(f"the {reader} process answers again")
    bridge.stop()
    summary = bridge.wait_end(30)
    assert summary["lost"] == 0
    assert summary["recorder"]["lost"] == 0
    assert any(reader in problem for problem in summary["problems"])


def test_what_is_granted_is_what_the_kernel_says() -> None:
    asks = (
        "import json, os; from hil.realtime import claim, step_aside\n"
        "before = sorted(os.sched_getaffinity(0)); step_aside(); aside = sorted(os.sched_getaffinity(0))\n"
        "os.sched_setaffinity(0, before); granted = claim().as_dict()\n"
        "status = dict(line.split(':', 1) for line in open('/proc/self/status'))\n"
        "print(json.dumps([before, aside, granted, os.sched_getscheduler(0), sorted(os.sched_getaffinity(0)),"
        " status['VmLck'].strip()]))"
    )
    out = subprocess.run([sys.executable, "-c", asks], capture_output=True, text=True, check=True, timeout=60).stdout
    before, aside, granted, policy, processors, locked = json.loads(out)
    assert (policy == os.SCHED_FIFO) == (granted["priority"] == PRIORITY)
    assert (locked != "0 kB") == granted["locked"]
    if len(before) > 1:
        assert processors == [granted["processor"]] == before[-1:]
        assert aside == before[:-1], "the others leave that processor alone"
    assert len(granted["lacking"]) == (not granted["priority"]) + (not granted["locked"]) + (len(before) == 1)
    assert refused() == granted["lacking"]
    assert os.sched_getscheduler(0) == os.SCHED_OTHER, "found out in another process"


def test_what_is_refused_says_how_to_get_it() -> None:
    asks = (
        "import os, resource\n"
        "for limit in (resource.RLIMIT_RTPRIO, resource.RLIMIT_MEMLOCK): resource.setrlimit(limit, (0, 0))\n"
        "os.setuid(65534)\n"
        "from hil.realtime import claim\n"
        "print('\\n'.join(claim().lacking))"
    )
    if os.geteuid() != 0:
        pytest.skip("only root can give up its rights here")
    environment = {**os.environ, "PYTHONDONTWRITEBYTECODE": "1"}
    command = [sys.executable, "-c", asks]
    run = subprocess.run(command, check=False, capture_output=True, text=True, timeout=60, env=environment)
    if "Permission denied" in run.stderr or "ModuleNotFoundError" in run.stderr:
        pytest.skip("the sources cannot be read by another user here")
    assert "no real-time priority" in run.stdout
    assert "memory is not locked" in run.stdout
    assert "limits.d" in run.stdout


def test_a_run_in_real_time_says_what_it_got(hil_bridge: StartBridge) -> None:
    summary = hil_bridge(navigation=TRUTH, head={"rate_hz": 200}, duration_s=1, realtime=True).wait_end(60)
    assert summary["realtime"]["lacking"] == refused()
    assert summary["samples"] == 200
    times = summary["times_us"]
    assert set(times) == {what.name.lower() for what in Times}
    for what in ("latency", "wake", "round"):
        assert 0.0 < times[what]["p50"] <= times[what]["p99"] <= times[what]["max"]
    assert times["wake"]["p50"] < times["latency"]["p50"]
    assert summary["overruns"] >= 0


def processor_time_s(pid: int) -> float:
    words = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(words[11]) + int(words[12])) / os.sysconf("SC_CLK_TCK")


@pytest.mark.skipif(len(os.sched_getaffinity(0)) == 1, reason="one processor: the loop has none for itself")
@pytest.mark.parametrize("realtime", [True, False])
def test_a_loop_that_looks_for_samples_rests_when_none_come(hil_bridge: StartBridge, *, realtime: bool) -> None:
    bridge = hil_bridge(navigation=TRUTH, head={"rate_hz": 1000}, realtime=realtime)
    bridge.wait_mode("navigate")
    loop = pid_of(bridge.session, "loop")

    def share(over_s: float) -> float:
        before = processor_time_s(loop)
        time.sleep(over_s)
        return (processor_time_s(loop) - before) / over_s

    assert share(1.0) < 0.95, "the kernel stops who takes more"
    head = pid_of(bridge.session, "feeder")
    os.kill(head, signal.SIGSTOP)
    try:
        time.sleep(0.3)
        assert share(1.0) < 0.3
    finally:
        os.kill(head, signal.SIGCONT)
    bridge.stop()
    bridge.wait_end(30)


@pytest.mark.parametrize("layout", ["fd", "classic"])
def test_what_takes_a_sample_alone_is_ready_before_the_first(layout: str) -> None:
    asks = (
        "from hil.scenario import load; from hil.warmup import warm_loop; from nav.ordinary import take_one\n"
        f"warm_loop(load(None).with_changes(head={{'layout': {layout!r}}}), lambda done: None)\n"
        "assert take_one.signatures"
    )
    subprocess.run([sys.executable, "-c", asks], check=True, timeout=300)


@pytest.mark.parametrize("period_s", [None, 1e-4, 4.9e-4])
def test_looking_does_not_pay_before_the_period_is_known_or_where_there_is_no_rest(period_s: float | None) -> None:
    assert rest(period_s) == 0
    wake = Wake()
    assert doze([wake.fileno()], time.monotonic_ns(), period_s) == 0
    assert doze([], time.monotonic_ns(), 0.02) == 0, "nothing to look at"


def test_a_rest_is_a_part_of_the_period() -> None:
    before = time.monotonic_ns()
    until = rest(0.02)
    assert time.monotonic_ns() - before >= REST * 0.02e9
    assert 0.04e9 <= until - before < 0.05e9


def test_a_doze_ends_before_the_next_sample_or_with_it() -> None:
    wake, heard = Wake(), time.monotonic_ns()
    until = doze([wake.fileno()], heard, 0.02)
    assert time.monotonic_ns() - heard >= 0.02e9 - LEAD_S * 1e9
    assert until == heard + round(0.02e9) + round(LEAD_S * 1e9)
    wake.call()
    heard = time.monotonic_ns()
    assert doze([wake.fileno()], heard, 5.0) == 0
    assert time.monotonic_ns() - heard < 2.5e9


def test_a_processor_that_the_busy_want_is_not_looked_on() -> None:
    """Two processes that never rest on one processor; then one alone."""
    asks = (
        "import os, subprocess, sys, time; from hil.realtime import SharedProcessor\n"
        "os.sched_setaffinity(0, [min(os.sched_getaffinity(0))])\n"
        "other = subprocess.Popen([sys.executable, '-c', 'while True: pass'])\n"
        "processor, until = SharedProcessor(), time.monotonic() + 60.0\n"
        "while processor.is_free and time.monotonic() < until:\n"
        "    processor.give_way()\n"
        "assert not processor.is_free\n"
        "other.kill(); other.wait()\n"
        "while not processor.is_free and time.monotonic() < until:\n"
        "    time.sleep(0.01)\n"
        "assert processor.is_free"
    )
    subprocess.run([sys.executable, "-c", asks], check=True, timeout=120)


def test_an_overrun_is_a_round_longer_than_its_samples(hil_bridge: StartBridge) -> None:
    bridge = hil_bridge(navigation=TRUTH, head={"rate_hz": 2000})
    bridge.wait_mode("navigate")
    session: Any = bridge.session
    before = session.outlets.stats["overruns"]
    pid = pid_of(session, "loop")
    for k in range(60):  # at work for a good part of its time, so that most of these fall into a round
        os.kill(pid, signal.SIGSTOP)
        time.sleep(0.02)
        os.kill(pid, signal.SIGCONT)
        time.sleep(0.011 + 0.0003 * (k % 7))
    bridge.stop()
    summary = bridge.wait_end(30)
    assert summary["lost"] == 0
    assert summary["overruns"] > before
    assert summary["latency_us"]["max"] > 5000.0, "frames waited for the loop"


def test_quantiles_and_histogram_are_those_of_the_durations() -> None:
    stats = Stats()
    values = np.random.default_rng(1).exponential(300e3, 20_000).astype(np.int64)
    now = int(values.max()) + 5
    stats.count_since(Times.LATENCY, now, now - values[:10_000])
    for value in values[10_000:]:
        stats.count(Times.LATENCY, int(value))
    found, microseconds = stats.quantiles_us(Times.LATENCY), np.sort(values // 1000)
    for name, part in (("p50", 0.5), ("p99", 0.99), ("p999", 0.999)):
        assert found[name] == microseconds[int(np.ceil(part * len(values))) - 1]
    assert found["max"] == microseconds[-1]
    edges = [0, 100, 200, 500, 1000]
    expected = np.histogram(microseconds, [*edges, 1 << 40])[0]
    assert stats.histogram(Times.LATENCY, edges) == expected.tolist()
    assert stats.quantiles_us(Times.AGE)["max"] == 0.0, "each has its own"
    stats.count(Times.AGE, 10**12)
    assert stats.quantiles_us(Times.AGE) == dict.fromkeys(("p50", "p99", "p999", "max"), 1e9)
    assert stats.histogram(Times.AGE, [0, BINS]) == [1, 0], "the last bin holds everything longer"
    stats.count(Times.WAKE, -5)
    assert stats.quantiles_us(Times.WAKE)["max"] == 0.0, "clocks that disagree by a little"


def test_counters_are_shared() -> None:
    stats = Stats()
    other = Stats(Shared(stats._shared.size, os.dup(stats._shared.fd)))
    stats["overruns"] = 7
    stats.count(Times.ROUND, 5_000)
    assert other["overruns"] == 7
    assert other.quantiles_us(Times.ROUND)["max"] == 5.0
