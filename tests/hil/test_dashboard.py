"""The window's server on real sockets, over real runs: who may look, what comes, what an order does, who waits for whom."""

import asyncio
import contextlib
import itertools
import json
import math
import os
import socket
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest
from websockets.asyncio.client import ClientConnection, connect
from websockets.exceptions import ConnectionClosed, InvalidStatus

from drivers.can.frames import frames
from drivers.logs.recording import EVENT, MARK, RecordingReader
from hil.bridge import LoopOrder
from hil.control import Control, Injected
from hil.dashboard import Window, open_window, recording_name
from hil.dashboard.address import TOKEN_VARIABLE
from hil.dashboard.bus_load import bus_load
from hil.scenario import Scenario, load
from hil.session import STOPPED_S, Session, simulated_head
from hil.world.head import SimulatedHead
from hil.world.injection import Injection
from nav.errors import HilError
from nav.state import Mode

numbers = itertools.count()
CLIENT: dict[str, Any] = {"proxy": None}


def scenario(**changes: Any) -> Scenario:
    quick: dict[str, Any] = {
        "bus": f"unix:window-{os.getpid()}-{next(numbers)}",
        "motion": {"rest_s": 0.5, "ramp_s": 2.0, "attitude": "coordinated", "north": {"rate": 30.0}},
        "head": {"rate_hz": 200.0, "instruments": "ideal"},
        "navigation": {"alignment": "truth"},
        "mavlink": {"links": ()},
    }
    return load(None).with_changes(**(quick | changes))


Running = tuple[Session, str]
Start = Callable[..., Running]


@pytest.fixture
def start() -> Iterator[Start]:
    """Starts a run with a window; the run and the window's address as HOST:PORT."""
    with starter() as begin:
        yield begin


@pytest.fixture(scope="module")
def running() -> Iterator[Running]:
    """A run that goes on, for tests that only look."""
    with starter() as begin:
        yield begin(mavlink={"links": ("udpout:127.0.0.1:9",)})


@contextlib.contextmanager
def starter() -> Iterator[Start]:
    with ExitStack() as stack:

        def begin(*, address: str = "127.0.0.1:0", record: Path | None = None, **changes: Any) -> tuple[Session, str]:
            window = open_window(address, lambda _: None)
            assert window is not None
            place = f"127.0.0.1:{window.port}"
            order = LoopOrder(scenario(**changes))
            session = Session(order, feeder=simulated_head(order), record=record, window=window)
            stack.enter_context(session)
            session.wait_ready()
            session.wait_mode(Mode.NAVIGATE)
            return session, place

        yield begin


async def records(socket: ClientConnection, until: Callable[[dict[str, Any]], bool], timeout_s: float = 60.0) -> Any:
    """All records up to the first that `until` accepts."""
    found: list[dict[str, Any]] = []
    async with asyncio.timeout(timeout_s):
        while True:
            for record in json.loads(await socket.recv()):
                found.append(record)
                if until(record):
                    return found


def kind(name: str) -> Callable[[dict[str, Any]], bool]:
    return lambda record: record["k"] == name


def follow(session: Session, seconds: float) -> None:
    """What `hil run` does while the run goes on."""
    end = time.monotonic() + seconds
    while time.monotonic() < end and session.running:
        time.sleep(0.02)


def test_moments_states_and_truth_come(running: Running) -> None:
    session, place = running

    def flying(one: dict[str, Any]) -> bool:
        """The ramp is over, and the links are at work."""
        return one["k"] == "slow" and one.get("device_s", 0.0) > 3.0 and one["links"][0]["sent_hz"] > 0

    async def look() -> list[dict[str, Any]]:
        async with connect(f"ws://{place}/live", **CLIENT) as socket:
            return list(await records(socket, flying))

    seen = asyncio.run(look())
    assert seen[0]["k"] == "hello"
    moments = [one for one in seen if one["k"] == "fast"]
    times = [one["t"] for one in moments]
    assert all(later > earlier for earlier, later in itertools.pairwise(times))
    last, state = moments[-1], [one for one in seen if one["k"] == "slow"][-1]
    assert last["att"] == pytest.approx(last["ref"], abs=1e-4), "the truth stands beside ours"
    assert max(map(abs, last["err"][:3])) < 1e-3
    assert last["sig3"] == [None] * 9, "a navigator that is not aided knows no sigma"
    assert np.linalg.norm(last["f"]) == pytest.approx(9.81, rel=0.5)
    assert state["losses"]["lost"] == [0, False]
    assert state["sensor"]["temperature"] == [40.0, 40.0, 35.0], "what the simulated head says"
    assert sum(state["hist"]["age"]) > 0
    assert state["sent_hz"]["ATTITUDE"] > 0
    assert session.outlets.stats["lost"] == 0


def test_page_is_confined_and_needs_nothing_from_elsewhere(running: Running) -> None:
    _, place = running
    with httpx.Client(base_url=f"http://{place}", trust_env=False) as client:
        page = client.get("/")
        assert page.status_code == 200
        policy = page.headers["content-security-policy"]
        assert "default-src 'none'" in policy
        assert "unsafe" not in policy
        assert "http" not in policy
        for name in ("app.js", "style.css", "draw.js", "icon.svg"):
            assert client.get(f"/{name}").status_code == 200
        assert client.get("/../server.py").status_code == 404
        assert client.get("/%2e%2e/server.py").status_code == 404


def test_no_file_of_the_page_names_another_host() -> None:
    folder = Path(__file__).resolve().parents[2] / "hil" / "dashboard" / "static"
    for path in folder.iterdir():
        text = path.read_text().replace("http://www.w3.org/2000/svg", "")
        assert "http:" not in text.replace('"https:"', "")
        assert "//cdn" not in text
    html = (folder / "index.html").read_text()
    assert html.count("<script") == html.count('<script type="module" src=')
    assert "style=" not in html


@pytest.mark.parametrize(
    "headers",
    [
        {"Origin": "http://evil.example"},
        {"Host": "evil.example"},
        {"Host": "evil.example", "Origin": "http://evil.example"},
    ],
    ids=["origin", "host", "rebound name"],
)
def test_foreign_pages_are_refused(running: Running, headers: dict[str, str]) -> None:
    session, place = running

    async def attempt() -> None:
        host, port = place.split(":")
        extra = {key: value for key, value in headers.items() if key == "Origin"}
        name = headers.get("Host", host)
        async with connect(
            f"ws://{name}:{port}/live", host=host, port=int(port), additional_headers=extra, **CLIENT
        ) as socket:
            await socket.send(json.dumps({"do": "align"}))
            await socket.recv()

    with pytest.raises(InvalidStatus) as refusal:
        asyncio.run(attempt())
    assert refusal.value.response.status_code == 403
    assert session.outlets.control.align_requests == 0
    if "Host" in headers:
        assert httpx.get(f"http://{place}/", headers={"Host": headers["Host"]}, trust_env=False).status_code == 403


def test_own_page_and_scripts_are_let_in(running: Running) -> None:
    _, place = running

    async def attempt(host: str, **headers: str) -> str:
        port = place.split(":")[1]
        async with connect(f"ws://{host}:{port}/live", additional_headers=headers, **CLIENT) as socket:
            return str(json.loads(await socket.recv())[0]["k"])

    assert asyncio.run(attempt("127.0.0.1")) == "hello"
    assert asyncio.run(attempt("localhost", Origin=f"http://localhost:{place.split(':')[1]}")) == "hello"


def test_beyond_this_machine_a_token_is_wanted(start: Start, monkeypatch: pytest.MonkeyPatch) -> None:
    secret = "correct horse battery staple"
    monkeypatch.setenv(TOKEN_VARIABLE, secret)
    session, place = start(address="0.0.0.0:0")

    async def attempt(first: str | None) -> str:
        async with connect(f"ws://{place}/live", **CLIENT) as socket:
            if first is not None:
                await socket.send(first)
            return str(json.loads(await asyncio.wait_for(socket.recv(), 20))[0]["k"])

    assert asyncio.run(attempt(json.dumps({"token": secret}))) == "hello"
    for wrong in (json.dumps({"token": secret[:-1]}), json.dumps({"do": "align"}), "[]", "{", "[" * 3000, None):
        with pytest.raises(ConnectionClosed) as refusal:
            asyncio.run(attempt(wrong))
        assert refusal.value.rcvd is not None
        assert refusal.value.rcvd.code == 1008
    assert session.outlets.control.align_requests == 0


def test_the_token_is_made_told_once_and_kept_out_of_addresses(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv(TOKEN_VARIABLE, raising=False)
    said: list[str] = []
    windows = [open_window("0.0.0.0:0", said.append) for _ in range(2)]
    tokens = [window.token for window in windows if window is not None]
    assert len(set(tokens)) == 2
    for line, token in zip(said, tokens, strict=True):
        assert len(token) >= 32
        assert f"/#token={token}" in line, "behind the #, which no browser sends"
    local = open_window("127.0.0.1:0", said.append)
    assert local is not None
    assert local.token == ""
    for window in (*windows, local):
        assert window is not None
        window.socket.close()
    monkeypatch.setenv(TOKEN_VARIABLE, "short")
    with pytest.raises(HilError, match=TOKEN_VARIABLE):
        open_window("127.0.0.1:0", said.append)


def test_a_port_in_use_is_told_with_the_mend() -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        with pytest.raises(HilError, match=f"{port} is in use.*--dashboard.*--no-dashboard"):
            open_window(f"127.0.0.1:{port}", lambda _: None)


def test_the_default_port_gives_way_to_another_run() -> None:
    said: list[str] = []
    first, second = (open_window(None, said.append) for _ in range(2))
    assert isinstance(first, Window)
    assert isinstance(second, Window)
    assert first.port != second.port
    assert "is in use" in said[1]
    first.socket.close()
    second.socket.close()


@pytest.mark.parametrize(
    "address", ["8765", "127.0.0.1", "127.0.0.1:port", "127.0.0.1:70000", ":8765", "no.such.host.invalid:1"]
)
def test_malformed_addresses_are_refused(address: str) -> None:
    with pytest.raises(HilError, match="--dashboard"):
        open_window(address, lambda _: None)


def test_a_slow_browser_loses_its_own_updates(running: Running) -> None:
    """One that reads nothing for a while neither holds up another nor the loop, and is shown the present afterwards."""
    session, place = running
    lost = session.outlets.stats["lost"]

    async def both() -> tuple[list[float], list[float]]:
        narrow = socket.socket()
        narrow.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        host, port = place.split(":")
        narrow.connect((host, int(port)))
        async with (
            connect(f"ws://{place}/live", sock=narrow, max_queue=1) as slow,
            connect(f"ws://{place}/live", **CLIENT) as other,
        ):
            seen = await records(other, kind("fast"))
            end = seen[-1]["t"] + 8.0
            seen += await records(other, lambda record: record["k"] == "fast" and record["t"] > end)
            late = await records(slow, lambda record: record["k"] == "fast" and record["t"] > end)
        return tuple([one["t"] for one in part if one["k"] == "fast"] for part in (seen, late))  # type: ignore[return-value]

    quick, slow = asyncio.run(both())
    assert len(slow) < 0.8 * len(quick), "it has lost updates"
    assert slow == sorted(slow), "and is shown none twice or out of order"
    assert np.median(np.diff(quick)) < 0.1, "the other one went on at its rate"
    assert session.outlets.stats["lost"] == lost


def test_an_address_can_be_left_and_come_back_to(running: Running) -> None:
    _, place = running

    async def come() -> tuple[str, float]:
        async with connect(f"ws://{place}/live", **CLIENT) as socket:
            seen = await records(socket, kind("fast"))
            return str(seen[0]["run"]), float(seen[-1]["t"])

    first, second = (asyncio.run(come()) for _ in range(2))
    assert first[0] == second[0], "the page knows that it is the same run"
    assert second[1] >= first[1]


def test_orders_mark_and_align(start: Start, tmp_path: Path) -> None:
    session, place = start(record=tmp_path / "run.dhil")

    async def order() -> list[dict[str, Any]]:
        async with connect(f"ws://{place}/live", **CLIENT) as socket:
            await records(socket, kind("fast"))
            await socket.send(json.dumps({"do": "mark"}))
            seen = await records(socket, lambda record: record["k"] == "event" and record["text"] == "mark 1")
            for wrong in ({"do": "dance"}, {"do": "record"}, {"do": "inject", "fault": "meteor"}):
                await socket.send(json.dumps(wrong))
                await records(socket, kind("refused"))
            for noise in ("null", "17", "{", '{"do": {"a": 1}}'):
                await socket.send(noise)
            await socket.send(json.dumps({"do": "align"}))
            return seen + list(await records(socket, lambda one: one["k"] == "slow" and one["mode"] == "ALIGN"))

    asyncio.run(order())
    session.__exit__(None, None, None)
    reader = RecordingReader.open(tmp_path / "run.dhil")
    kinds = []
    while len(batch := reader.read()):
        kinds += [int(row["data"][0]) for row in batch if row["reserved"][0] == EVENT]
    reader.close()
    assert kinds.count(MARK) == 1, "the mark stands in the recording"


def test_a_recording_begins_and_ends_while_running(
    start: Start, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    session, place = start()

    async def order() -> str:
        async with connect(f"ws://{place}/live", **CLIENT) as socket:
            await socket.send(json.dumps({"do": "record"}))
            seen = await records(socket, lambda one: one["k"] == "slow" and bool(one.get("recording")))
            return str(seen[-1]["recording"])

    name = asyncio.run(order())
    assert name == recording_name(session.outlets.control.record_since)
    deadline = time.monotonic() + 60.0
    while session.outlets.control.recorded < 450:
        follow(session, 0.1)
        assert time.monotonic() < deadline
    session.outlets.control.record_since = 0
    while not session.recordings:
        follow(session, 0.1)
        assert time.monotonic() < deadline
    answer = session.recordings[0]
    reader = RecordingReader.open(tmp_path / name)
    count = 0
    while len(batch := reader.read()):
        count += len(batch)
    assert not reader.problem
    reader.close()
    assert answer["frames"] == count > 450
    assert answer["lost"] == 0
    assert session.summary()["recordings"] == session.recordings


def test_a_recording_after_a_pause_has_a_recorder_that_answers(
    start: Start, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    session, _ = start()
    control, deadline = session.outlets.control, time.monotonic() + 60.0
    for count in (1, 2):
        control.record_since = int(time.time())
        follow(session, 0.5)
        control.record_since = 0
        while len(session.recordings) < count:
            follow(session, 0.1)
            assert time.monotonic() < deadline
        follow(session, STOPPED_S + 0.2)
    assert len({one["file"] for one in session.recordings}) == 2
    assert session.problems == []


def test_faults_are_injected_beside_those_of_the_wire(start: Start) -> None:
    session, _ = start(wire=[{"kind": "duplicate", "at_s": 0.0}], duration_s=8.0)
    step, injected = 1.0 / session.order.scenario.head.rate_hz, False
    while session.running:
        if not injected and session.outlets.stats["samples"] * step > 1.0:
            session.outlets.control.inject(Injected.SILENCE)
            injected = True
        time.sleep(0.01)
    assert injected
    stats = session.outlets.stats
    assert stats["lost"] * step == pytest.approx(1.0, abs=0.1), "of the injected silence"
    assert stats["duplicated"] == pytest.approx(stats["samples"], rel=0.05), "of the wire"


def test_an_injected_silence_is_red_and_passes(running: Running) -> None:
    session, place = running
    red = {"name": "SILENT", "bad": True}

    async def inject() -> dict[str, Any]:
        async with connect(f"ws://{place}/live", **CLIENT) as socket:
            hello = (await records(socket, kind("fast")))[0]
            assert "silence" in hello["faults"]
            await socket.send(json.dumps({"do": "inject", "fault": "silence"}))
            bad = await records(socket, lambda one: one["k"] == "slow" and red in one.get("health", []))
            await records(
                socket, lambda one: one["k"] == "slow" and one["losses"]["lost"][0] and red not in one["health"]
            )
            return dict(bad[-1])

    assert asyncio.run(inject())["mode"] == "DEGRADED"
    step = 1.0 / session.order.scenario.head.rate_hz
    assert session.outlets.stats["lost"] * step == pytest.approx(1.0, abs=0.1), "a second of samples is missing"


def test_injected_faults_last_a_second_of_the_head() -> None:
    control = Control()
    head = SimulatedHead(scenario())
    head.injection = Injection(control, head.step)
    rate = round(1.0 / head.step)
    batch = frames(1)

    def sent(first: int, count: int) -> int:
        assert head.injection is not None
        return sum(len(head.injection.sent(first + k, batch)) for k in range(count))

    assert sent(0, rate) == rate
    control.inject(Injected.SILENCE)
    assert sent(rate, 2 * rate) == rate
    control.inject(Injected.LOSS)
    assert sent(3 * rate, 2 * rate) == pytest.approx(2 * rate - rate / 10, abs=1)


@pytest.mark.parametrize(("fault", "said"), [(Injected.STUCK, "g2y: stuck"), (Injected.BUILT_IN, "g1x: built-in")])
def test_injected_instrument_faults_are_found(fault: Injected, said: str) -> None:
    """By the very loop that flies: a stuck axis is named by the head's own tests, a built-in test by its status bit."""
    from hil.bridge import Loop, Outlets

    chosen = load("failing_head").with_changes(
        head={"faults": ()}, navigation={"alignment": "truth"}, motion={"rest_s": 0.1, "ramp_s": 0.5}
    )
    outlets = Outlets.make(recording=False, readers=0)
    loop = Loop(LoopOrder(chosen, paced=False, own_world=True), outlets)
    head = SimulatedHead(chosen)
    head.injection = Injection(outlets.control, head.step)
    rate = round(1.0 / head.step)
    for first, slow, batch in head.chunks(4 * rate):
        if first == 2 * rate:
            outlets.control.inject(fault)
        loop.take(slow)
        loop.take(batch)
    rows = np.zeros(64, outlets.events.dtype)
    copied, _ = outlets.events.pull(rows, 0)
    when, _ = next((row["time"], row) for row in rows[:copied] if said in row["text"].decode())
    assert 2.0 < when < 2.5


def test_health_of_the_sensor_is_a_few_records_a_second() -> None:
    from hil.bridge import Loop, Outlets
    from hil.health import HEALTH

    chosen = scenario(head={"rate_hz": 1000.0, "instruments": "dtg", "grade": "dtg"})
    outlets = Outlets.make(recording=False, readers=0)
    loop = Loop(LoopOrder(chosen, paced=False, own_world=True), outlets)
    sent = 0
    for _, slow, batch in SimulatedHead(chosen).chunks(2000):
        for part in (slow, batch):
            sent += int(part["length"].sum())
            loop.take(part)
    assert 15 <= outlets.health.count <= 25, "two seconds"
    rows = np.zeros(outlets.health.capacity, HEALTH)
    copied, _ = outlets.health.pull(rows, 0)
    assert rows["own_truth"][:copied].all()
    assert rows["bytes"][copied - 1] == pytest.approx(sent, rel=0.1)
    assert (np.abs(rows["parity_mean"][:copied]) <= rows["parity_peak"][:copied]).all()
    assert (rows["parity_peak"][:copied] > 0.0).all(), "a head with noise"


def test_bus_load_of_full_buses() -> None:
    """A standard frame of eight bytes is 111 bits long, space included: 500 kbit/s carry 4504.5 of them a second."""
    assert bus_load("socketcan:can0", 500e3 / 111, 8 * 500e3 / 111) == pytest.approx(1.0)
    assert bus_load("socketcan:can0?bitrate=1000000", 500e3 / 111, 8 * 500e3 / 111) == pytest.approx(0.5)
    assert bus_load("serial:/dev/ttyUSB0:115200", 100.0, 11520.0) == pytest.approx(1.0)
    assert bus_load("serial:socket://host:4001", 100.0, 11520.0) == 0.0
    fast = bus_load("socketcan:can0?bitrate=500000&data_bitrate=8000000", 1000.0, 64e3)
    assert 0.0 < fast < bus_load("socketcan:can0", 1000.0, 64e3) < 1.0
    assert math.isfinite(bus_load("socketcan:can0?bitrate=fast", 1.0, 1.0))
