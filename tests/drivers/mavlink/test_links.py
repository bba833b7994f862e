"""Several links at once on real sockets: rates, filters, sequences, counters and logs of each; what one does to the others."""

import itertools
import re
import select
import socket
import struct
import subprocess
import sys
import time
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pymavlink import mavutil
from pymavlink.dialects.v20 import ardupilotmega as mav

from drivers.logs.tlog import TlogWriter
from drivers.mavlink.hub import Hub
from drivers.mavlink.link import CLIENTS, Listener, listens_beyond, open_link
from drivers.mavlink.messages import KINDS
from drivers.mavlink.options import LinkOptions, parse_options
from drivers.mavlink.sole import SoleClient
from drivers.mavlink.station import Identity, Station
from nav.errors import HilError
from nav.state import NAV_STATE, Mode


class Net:
    """A hub that is told the time, and its peers."""

    def __init__(self, *links: LinkOptions) -> None:
        self.station = Station(Identity(), {}, lambda lat, lon: 20.0, print)
        self.hub = Hub(self.station, links)
        self.row = np.zeros(1, NAV_STATE)
        self.row["mode"], self.row["q_nb"], self.row["f_b"] = Mode.NAVIGATE, (1.0, 0.0, 0.0, 0.0), (0.0, 0.0, -9.8)
        self.now_s = 1000.0

    def run(self, duration_s: float, each: Any = lambda: None, rate_hz: float = 100.0) -> None:
        for _ in range(round(duration_s * rate_hz)):
            self.now_s += 1.0 / rate_hz
            self.row["time"] += 1.0 / rate_hz
            self.station.update(self.row[0], self.now_s)
            self.hub.poll(self.now_s)
            each()


class Peer:
    """A client's end of a link."""

    def __init__(self, sock: socket.socket, system: int = 255) -> None:
        sock.setblocking(False)
        self.sock, self.heard = sock, list[Any]()
        self.mav = mav.MAVLink(None, system, 190)
        self.mav.robust_parsing = True

    def read(self) -> None:
        while True:
            try:
                data = self.sock.recv(65535)
            except BlockingIOError:
                return
            if not data:
                return
            self.heard += self.mav.parse_buffer(data) or []

    def tell(self, message: Any) -> None:
        self.sock.send(bytes(message.pack(self.mav)))
        self.mav.seq = (self.mav.seq + 1) % 256

    def counts(self) -> Counter[str]:
        return Counter(message.get_type() for message in self.heard)

    def gaps(self) -> int:
        assert "BAD_DATA" not in self.counts()
        numbers = [message.get_seq() for message in self.heard]
        return sum((b - a) % 256 != 1 for a, b in itertools.pairwise(numbers))


def beat() -> Any:
    return mav.MAVLink_heartbeat_message(mav.MAV_TYPE_GCS, mav.MAV_AUTOPILOT_INVALID, 0, 0, 0, 3)


def udp_pair() -> tuple[Peer, str]:
    sock = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    sock.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1 << 20)
    sock.bind(("127.0.0.1", 0))
    return Peer(sock), f"udpout:127.0.0.1:{sock.getsockname()[1]}"


def dial(net: Net, number: int = 0) -> Peer:
    peer = Peer(socket.create_connection(("127.0.0.1", net.hub.listeners[number][0].port)))
    time.sleep(0.01)
    net.hub.poll(net.now_s)
    return peer


def test_each_link_has_its_own_rates_filter_and_sequence() -> None:
    (first, a), (second, b), (third, c) = udp_pair(), udp_pair(), udp_pair()
    net = Net(
        LinkOptions(a), LinkOptions(b, rates_hz={"ATTITUDE": 10.0, "VFR_HUD": 0.0}), LinkOptions(c, only=("ATTITUDE",))
    )

    def read() -> None:
        for peer in (first, second, third):
            peer.read()

    net.run(10.0, read)
    for peer, rates in ((first, {}), (second, {"ATTITUDE": 10.0, "VFR_HUD": 0.0})):
        for name in ("ATTITUDE", "VFR_HUD", "GLOBAL_POSITION_INT"):
            expected = rates.get(name, KINDS[name].rate_hz)
            assert peer.counts()[name] == pytest.approx(10.0 * expected, abs=1.01), name
    assert set(third.counts()) == {"ATTITUDE", "HEARTBEAT", "STATUSTEXT"}
    assert (first.gaps(), second.gaps(), third.gaps()) == (0, 0, 0)
    net.station.parameters.write("SR_ATT_HZ", 20.0, mav.MAV_PARAM_TYPE_REAL32)
    before = [peer.counts()["ATTITUDE"] for peer in (first, second, third)]
    net.run(10.0, read)
    after = [peer.counts()["ATTITUDE"] for peer in (first, second, third)]
    assert [y - x for x, y in zip(before, after, strict=True)] == pytest.approx([200, 100, 200], abs=2)
    net.hub.close()


def test_a_filtered_message_cannot_be_asked_for() -> None:
    peer, url = udp_pair()
    net = Net(LinkOptions(url, only=("ATTITUDE",)))
    net.run(0.1, peer.read)
    peer.sock.connect(("127.0.0.1", net.hub.endpoints[0].link._socket.getsockname()[1]))  # type: ignore[attr-defined]
    for command, number, result in (
        (mav.MAV_CMD_SET_MESSAGE_INTERVAL, mav.MAVLINK_MSG_ID_VFR_HUD, mav.MAV_RESULT_DENIED),
        (mav.MAV_CMD_SET_MESSAGE_INTERVAL, mav.MAVLINK_MSG_ID_ATTITUDE, mav.MAV_RESULT_ACCEPTED),
        (mav.MAV_CMD_REQUEST_MESSAGE, mav.MAVLINK_MSG_ID_VFR_HUD, mav.MAV_RESULT_UNSUPPORTED),
    ):
        peer.heard.clear()
        peer.tell(mav.MAVLink_command_long_message(1, 1, command, 0, number, 1e5, 0, 0, 0, 0, 0))
        net.run(0.1, peer.read)
        (ack,) = [message for message in peer.heard if message.get_type() == "COMMAND_ACK"]
        assert ack.result == result
    peer.tell(mav.MAVLink_request_data_stream_message(1, 1, mav.MAV_DATA_STREAM_ALL, 20, 1))
    net.run(1.0, peer.read)
    assert "VFR_HUD" not in peer.counts()
    net.hub.close()


def test_a_link_that_is_not_heard_is_neither_answered_nor_obeyed() -> None:
    net = Net(LinkOptions("tcpin:127.0.0.1:0", hear=False))
    peer = dial(net)
    peer.tell(mav.MAVLink_param_set_message(1, 1, b"SR_ATT_HZ", 5.0, mav.MAV_PARAM_TYPE_REAL32))
    peer.tell(mav.MAVLink_command_long_message(1, 1, 31999, 0, 0, 0, 0, 0, 0, 0, 0))
    net.run(1.0, peer.read)
    assert net.station.interval_s("ATTITUDE") == 1.0 / 50.0
    assert peer.counts()["ATTITUDE"] > 40
    assert "COMMAND_ACK" not in peer.counts()
    assert net.hub.tallies()["tcpin:127.0.0.1:0"]["received"] == {"PARAM_SET": 1, "COMMAND_LONG": 1}
    net.hub.close()


def test_slow_and_dead_links_disturb_no_other() -> None:
    """A TCP client that never reads, a server that is not there, a UDP peer that refuses, and one good client of each kind."""
    good, url = udp_pair()
    dead, refused = udp_pair()
    dead.sock.close()
    with socket.create_server(("127.0.0.1", 0)) as nobody:
        port = nobody.getsockname()[1]
    net = Net(*(LinkOptions(one) for one in (refused, f"tcp:127.0.0.1:{port}", "tcpin:127.0.0.1:0", url)))
    stuck, fine = dial(net), dial(net)
    for peer in (stuck, fine):
        peer.tell(mav.MAVLink_request_data_stream_message(1, 1, mav.MAV_DATA_STREAM_ALL, 1000, 1))
    fine.sock.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1 << 22)

    def read() -> None:
        good.read()
        fine.read()

    longest = 0.0
    for _ in range(200):
        start = time.perf_counter()
        net.run(0.5, read, rate_hz=1000.0)
        longest = max(longest, time.perf_counter() - start)
        if sum(endpoint.dropped for endpoint in net.hub.endpoints) > 2000:
            break
    by_link = [endpoint.dropped for endpoint in net.hub.endpoints if endpoint.options.url.startswith("tcpin")]
    assert by_link[0] > 1000  # the stuck one
    assert (by_link[1], fine.gaps(), good.gaps()) == (0, 0, 0)
    assert good.counts()["ATTITUDE"] == pytest.approx(50.0 * (net.now_s - 1000.0), rel=0.01)
    stuck.read()
    assert stuck.gaps() <= 1  # whole frames or none
    net.hub.close()


def test_clients_of_a_server_come_and_go_by_themselves() -> None:
    net = Net(LinkOptions("tcpin:127.0.0.1:0"))
    assert net.hub.poll(net.now_s) <= net.now_s + 1.0
    one, other = dial(net), dial(net)
    one.tell(mav.MAVLink_request_data_stream_message(1, 1, mav.MAV_DATA_STREAM_EXTRA1, 10, 1))
    net.run(2.0, lambda: (one.read(), other.read()))
    assert one.counts()["ATTITUDE"] == pytest.approx(20, abs=3)
    assert other.counts()["ATTITUDE"] == pytest.approx(100, abs=3)
    one.sock.close()
    net.run(0.1, other.read)
    assert len(net.hub.endpoints) == len(net.station.on_rate) == 1
    tally = net.hub.tallies()["tcpin:127.0.0.1:0"]
    assert tally["received"] == {"REQUEST_DATA_STREAM": 1}  # of the one that has left
    assert tally["sent"]["ATTITUDE"] >= one.counts()["ATTITUDE"] + other.counts()["ATTITUDE"]
    crowd = [dial(net) for _ in range(CLIENTS)]
    net.run(0.1)
    assert len(net.hub.endpoints) == CLIENTS
    assert net.hub.tallies()["tcpin:127.0.0.1:0"]["turned_away"] == 1
    assert crowd[-1].sock.recv(10) == b""
    net.hub.close()


@pytest.mark.parametrize("served_s", [0.0, 0.5])
def test_the_last_words_of_a_client_that_has_closed_are_heard(served_s: float) -> None:
    net = Net(LinkOptions("tcpin:127.0.0.1:0"))
    for count in range(1, 11):
        client = Peer(socket.create_connection(("127.0.0.1", net.hub.listeners[0][0].port)))
        if served_s:
            time.sleep(0.01)
            net.run(served_s)
        client.tell(mav.MAVLink_request_data_stream_message(1, 1, mav.MAV_DATA_STREAM_EXTRA1, 10, 1))
        client.sock.close()
        time.sleep(0.01)
        net.run(0.1)
        assert net.hub.tallies()["tcpin:127.0.0.1:0"]["received"] == {"REQUEST_DATA_STREAM": count}
    assert not net.hub.endpoints
    net.hub.close()


def test_messages_lost_on_the_way_to_us_are_counted() -> None:
    net = Net(LinkOptions("tcpin:127.0.0.1:0"))
    peer = dial(net)
    for number in (250, 251, 254, 255, 0, 3):
        peer.mav.seq = number
        peer.tell(beat())
    net.run(0.1)
    assert net.hub.tallies()["tcpin:127.0.0.1:0"]["lost"] == 4
    peer.mav.seq = 3  # it began anew, or the frame came twice
    peer.tell(beat())
    net.run(0.1)
    assert net.hub.tallies()["tcpin:127.0.0.1:0"]["lost"] == 4
    net.hub.close()


def test_bytes_that_are_no_message_make_nobody_a_peer() -> None:
    net = Net(LinkOptions("udpin:127.0.0.1:0"))
    port = net.hub.endpoints[0].link.port  # type: ignore[attr-defined]
    peers = []
    for data in (b"GET / HTTP/1.0\r\n\r\n", bytes(beat().pack(mav.MAVLink(None, 255, 190)))):
        peers.append(Peer(socket.socket(socket.AF_INET, socket.SOCK_DGRAM)))
        peers[-1].sock.connect(("127.0.0.1", port))
        peers[-1].sock.send(data)
        net.run(0.5, peers[-1].read)
    assert peers[0].heard == []
    assert peers[1].counts()["ATTITUDE"] > 10
    net.hub.close()


def tool(name: str, *arguments: str) -> str:
    program = Path(sys.executable).parent / name
    done = subprocess.run(
        [sys.executable, str(program), *arguments], capture_output=True, text=True, timeout=60, check=True
    )
    return done.stdout + done.stderr


def test_a_log_holds_what_was_sent_and_received_and_others_read_it(tmp_path: Path) -> None:
    path = tmp_path / "flight.tlog"
    net = Net(LinkOptions("tcpin:127.0.0.1:0", tlog=str(path)))
    peer = dial(net)
    for _ in range(5):
        peer.tell(beat())
    peer.tell(mav.MAVLink_setup_signing_message(1, 1, bytes(range(32)), 0))
    net.run(5.0, peer.read)
    second = dial(net)
    net.run(1.0, second.read)
    tally = net.hub.tallies()["tcpin:127.0.0.1:0"]
    net.hub.close()

    counts: Counter[tuple[int, str]] = Counter()
    log = mavutil.mavlink_connection(str(path), dialect="ardupilotmega")
    stamps = []
    while (message := log.recv_match()) is not None:
        counts[message.get_srcSystem(), message.get_type()] += 1
        stamps.append(message._timestamp)
    assert counts[1, "ATTITUDE"] >= 245
    assert counts[255, "HEARTBEAT"] == 5
    assert counts[255, "SETUP_SIGNING"] == 0  # a key does not go into logs
    assert bytes(range(32)) not in path.read_bytes()
    assert stamps == sorted(stamps)
    assert abs(stamps[-1] - time.time()) < 60.0
    second_log = tmp_path / "flight-2.tlog"
    logged = sum(counts.values()) + len(frames(second_log))
    assert logged == sum(tally["sent"].values()) + sum(tally["received"].values()) - 1

    printed = tool("mavlogdump.py", "--types", "ATTITUDE", str(path))
    assert printed.count("ATTITUDE {") == counts[1, "ATTITUDE"]
    assert re.search(r"\b0\.0+%", tool("mavloss.py", str(path)))


def frames(path: Path) -> list[bytes]:
    """The frames of a log, split by hand: time, then a MAVLink 2 frame."""
    data, at, found = path.read_bytes(), 0, []
    while at + 8 + 12 <= len(data):
        assert data[at + 8] == 0xFD
        (time_us,) = struct.unpack_from(">Q", data, at)
        assert 1.6e15 < time_us < 4e15
        size = 12 + data[at + 9] + (13 if data[at + 10] & 1 else 0)
        found.append(data[at + 8 : at + 8 + size])
        at += 8 + size
    return found


def test_a_torn_log_loses_its_last_frame_alone(tmp_path: Path) -> None:
    peer, url = udp_pair()
    path = tmp_path / "torn.tlog"
    net = Net(LinkOptions(url, tlog=str(path)))
    net.run(2.0, peer.read)
    net.hub.close()
    whole = frames(path)
    path.write_bytes(path.read_bytes()[:-5])
    log = mavutil.mavlink_connection(str(path), dialect="ardupilotmega")
    read = 0
    while (message := log.recv_match()) is not None:
        read += message.get_type() != "BAD_DATA"
    assert read == len(whole) - 1


def test_a_log_is_on_the_disk_soon_and_a_full_disk_ends_the_log_alone(tmp_path: Path) -> None:
    peer, url = udp_pair()
    path = tmp_path / "a.tlog"
    net = Net(LinkOptions(url, tlog=str(path)))
    net.run(0.05)
    time.sleep(0.6)
    net.hub.poll(net.now_s)
    assert len(frames(path)) > 0
    net.hub.close()
    if Path("/dev/full").exists():
        net = Net(LinkOptions(url, tlog="/dev/full"))
        net.run(0.05)
        time.sleep(0.6)
        net.hub.poll(net.now_s)
        assert any("No space left" in text for _, text in net.station.notes)
        peer.heard.clear()
        net.run(1.0, peer.read)
        assert peer.counts()["ATTITUDE"] > 40
        net.hub.close()
    with pytest.raises(HilError, match="no/such"):
        TlogWriter(tmp_path / "no" / "such.tlog")


def test_options_of_a_url() -> None:
    found = parse_options(
        "udpout:10.0.0.2:14550?rates_hz=ATTITUDE:100,VFR_HUD:0&only=ATTITUDE,VFR_HUD&hear=false&tlog=a.tlog"
    )
    assert found == LinkOptions(
        "udpout:10.0.0.2:14550", {"ATTITUDE": 100.0, "VFR_HUD": 0.0}, ("ATTITUDE", "VFR_HUD"), False, True, "a.tlog"
    )
    assert parse_options("tcp:h:1") == LinkOptions("tcp:h:1")
    for text, says in (
        ("tcp:h:1?rate=3", "unknown option 'rate'"),
        ("tcp:h:1?hear=maybe", "expected true or false"),
        ("tcp:h:1?rates_hz=ATTITUDE", "expected MESSAGE:HZ"),
        ("tcp:h:1?rates_hz=ATTITUD:3", "unknown message"),
        ("tcp:h:1?rates_hz=ATTITUDE:2000", "expected 0 to 1000"),
        ("tcp:h:1?rates_hz=ATTITUDE:nan", "expected 0 to 1000"),
        ("tcp:h:1?only=ATT", "unknown message 'ATT'"),
    ):
        with pytest.raises(HilError, match=re.escape(says)) as caught:
            parse_options(text)
        assert "tcp:h:1" in str(caught.value)


@pytest.mark.parametrize(
    ("url", "beyond"),
    [
        ("udpin:127.0.0.1:14550", False),
        ("tcpin:localhost:5760", False),
        ("tcpin:[::1]:5760", False),
        ("udpin:0.0.0.0:14550", True),
        ("tcpin:[::]:5760", True),
        ("udpin:192.168.1.2:14550", True),
        ("udpout:192.168.1.2:14550", False),
        ("tcp:192.168.1.2:5760", False),
    ],
)
def test_what_listens_beyond_this_machine(url: str, beyond: bool) -> None:
    assert listens_beyond(url) == beyond


def test_a_listener_listens_where_it_is_told_and_nowhere_else() -> None:
    link = open_link("tcpin:127.0.0.1:0")
    assert isinstance(link, Listener)
    with pytest.raises(ConnectionRefusedError):
        socket.create_connection(("127.0.0.2", link.port), timeout=1.0)
    link.close()


def test_a_server_of_one_client_lets_the_next_in_when_the_first_has_left() -> None:
    """Also where bytes of the first are not read yet; one that comes before is turned away."""
    listener = open_link("tcpin:127.0.0.1:0")
    assert isinstance(listener, Listener)
    link = SoleClient(listener)

    def connected() -> socket.socket:
        return socket.create_connection(("127.0.0.1", link.port), timeout=5.0)

    def heard(wanted: bytes) -> None:
        data, deadline = b"", time.monotonic() + 5.0
        while wanted not in data and time.monotonic() < deadline:
            select.select([link], [], [], 0.1)
            data += link.receive()
        assert data == wanted

    assert not link.ready()
    first = connected()
    first.sendall(b"first")
    heard(b"first")
    with connected() as second:
        select.select([link], [], [], 5.0)
        assert link.receive() == second.recv(10) == b"", "turned away"
    assert link.send(b"to the first")
    assert first.recv(100) == b"to the first"
    first.sendall(b"never read")
    first.close()
    with connected() as third:
        third.sendall(b"third")
        heard(b"third")
        assert (link.connections, link.refused) == (2, 1)
    select.select([link], [], [], 5.0)
    assert link.receive() == b""
    assert not link.ready()
    assert not link.send(b"to nobody")
    link.close()
