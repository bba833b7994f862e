"""The `unix:` bus on real sockets and real processes."""

import asyncio
import signal
import subprocess
import sys
import threading
import time
from contextlib import closing

import can
import numpy as np
import pytest

from drivers.can.frames import BRS, EFF, FDF, frames
from drivers.can.unix_bus import PACKET, UnixPort
from nav.errors import HilError


@pytest.fixture(autouse=True)
def own_folder(tmp_path_factory, monkeypatch):
    """A short folder of our own: a socket's path has 107 bytes."""
    folder = tmp_path_factory.mktemp("b")
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(folder))
    return folder


def numbered(n, first=0):
    batch = frames(n)
    batch["can_id"], batch["length"] = 0x123, 8
    batch["data"][:, :8] = np.arange(first, first + n, dtype=np.int64)[:, None].view(np.uint8)
    return batch


def numbers(batch):
    return np.ascontiguousarray(batch["data"][:, :8]).view(np.int64)[:, 0]


def drain(port, n, timeout=5.0, room=256):
    """`n` frames, or what came before `timeout` s without any."""
    parts, got = [], 0
    while got < n:
        batch = frames(room)
        count = port.receive(batch, timeout)
        if not count:
            break
        parts.append(batch[:count])
        got += count
    return np.concatenate(parts) if parts else frames(0)


def child(code, *arguments):
    """Another process with the same bus folder."""
    setup = (
        "import sys, time\nimport numpy as np\nfrom drivers.can.frames import frames\n"
        "from drivers.can.unix_bus import UnixPort\n"
    )
    return subprocess.Popen(
        [sys.executable, "-c", setup + code, *map(str, arguments)],
        stdout=subprocess.PIPE,
        stdin=subprocess.PIPE,
        text=True,
    )


SENDER = """
port = UnixPort(sys.argv[1], listen=False, lossless=True)
while port.listeners < 1: time.sleep(0.005)
n = int(sys.argv[2])
for k in range(0, n, 500):
    batch = frames(500)
    batch["data"][:, :8] = np.arange(k, k + 500, dtype=np.int64)[:, None].view(np.uint8)
    port.send(batch)
print(port.dropped, flush=True)
port.close()
"""
LISTENER = """
port, batch = UnixPort(sys.argv[1]), frames(256)
print("ready", flush=True)
got = []
while len(got) < int(sys.argv[2]):
    n = port.receive(batch, 5.0)
    if not n: break
    got += np.ascontiguousarray(batch["data"][:n, :8]).view(np.int64)[:, 0].tolist()
print(got == list(range(int(sys.argv[2]))), len(got), flush=True)
port.close()
"""


@pytest.mark.parametrize("listener_first", [True, False])
def test_two_processes_in_any_order(listener_first):
    n = 5000
    order = [LISTENER, SENDER] if listener_first else [SENDER, LISTENER]
    first = child(order[0], "pair", n)
    if listener_first:
        assert first.stdout.readline() == "ready\n"
    second = child(order[1], "pair", n)
    out, _ = first.communicate(timeout=30)
    rest, _ = second.communicate(timeout=30)
    heard, said = (out, rest) if listener_first else (rest, out)
    assert heard.split()[-2:] == ["True", str(n)]
    assert said.strip() == "0"


def test_every_listener_hears_everything_and_nobody_itself():
    with closing(UnixPort("mesh")) as a, closing(UnixPort("mesh")) as b, closing(UnixPort("mesh")) as c:
        before = time.time_ns()
        for k, port in enumerate((a, b, c)):
            port.send(numbered(3, 10 * k))
        assert sorted(numbers(drain(a, 6))) == [10, 11, 12, 20, 21, 22]
        assert sorted(numbers(drain(b, 6))) == [0, 1, 2, 20, 21, 22]
        got = drain(c, 6)
        assert sorted(numbers(got)) == [0, 1, 2, 10, 11, 12]
        assert (np.abs(got["time_ns"] - before) < 10**9).all()
        assert all(port.receive(frames(PACKET), 0.0) == 0 for port in (a, b, c))


def test_buses_are_apart():
    with closing(UnixPort("one")) as a, closing(UnixPort("two")) as b:
        a.send(numbered(1))
        assert a.listeners == b.listeners == 0
        assert b.receive(frames(PACKET), 0.05) == 0


def test_lossless_waits_for_a_slow_listener():
    n, done = 150_000, []
    with closing(UnixPort("slow", lossless=True)) as sender, closing(UnixPort("slow")) as listener:

        def send():
            sender.send(numbered(n))
            done.append(time.monotonic())

        thread = threading.Thread(target=send)
        thread.start()
        time.sleep(0.3)
        assert not done  # 12 MB do not fit into the queue
        np.testing.assert_array_equal(numbers(drain(listener, n, room=4096)), np.arange(n))
        thread.join(5.0)
        assert done
        assert sender.dropped == 0


def test_without_it_what_does_not_fit_is_dropped_and_counted_to_the_frame():
    n = 150_000
    with closing(UnixPort("fast")) as sender, closing(UnixPort("fast")) as listener:
        sender.send(numbered(n))
        got = numbers(drain(listener, n, timeout=0.1, room=4096))
        assert 0 < sender.dropped < n
        assert len(got) == n - sender.dropped
        assert (np.diff(got) > 0).all()
        sender.send(numbered(1, n))  # and the bus goes on
        assert numbers(drain(listener, 1)).tolist() == [n]


def test_a_lossless_sender_survives_the_death_of_a_full_listener():
    with closing(UnixPort("dying", lossless=True, listen=False)) as sender:
        listener = child("port = UnixPort('dying')\nprint('ready', flush=True)\ntime.sleep(60)\n")
        assert listener.stdout.readline() == "ready\n"
        threading.Timer(0.3, listener.kill).start()
        sender.send(numbered(150_000))  # blocks on the full queue until its reader dies
        listener.wait(5)
        with closing(UnixPort("dying")) as other:
            sender.send(numbered(2))
            assert len(drain(other, 2)) == 2
            assert sender.listeners == 1


@pytest.mark.parametrize("how", [signal.SIGKILL, signal.SIGTERM])
def test_the_killed_leave_nothing_that_disturbs(how, own_folder):
    with closing(UnixPort("dead")) as port:
        other = child("port = UnixPort('dead')\nprint('ready', flush=True)\ntime.sleep(60)\n")
        assert other.stdout.readline() == "ready\n"
        port.send(numbered(1))
        assert port.listeners == 1
        other.send_signal(how)
        other.wait(5)
        port.send(numbered(1))
        assert port.receive(frames(PACKET), 0.0) == 0
        assert port.listeners == 0
        with closing(UnixPort("dead")) as late:  # finds the dead one's socket, and sweeps it away
            port.send(numbered(2))
            assert len(drain(late, 2)) == 2
    assert [entry.name for entry in own_folder.rglob("*.sock")] == []


def test_a_pure_sender_is_not_sent_to():
    with closing(UnixPort("mute", listen=False)) as mute, closing(UnixPort("mute", lossless=True)) as port:
        port.send(numbered(200_000))  # would block for ever on a queue that nobody reads
        assert port.listeners == 0
        mute.send(numbered(1))
        assert len(drain(port, 1)) == 1


def test_many_come_and_go_while_one_does_not_look():
    """A participant that is busy elsewhere stays on the bus, however many joined and left meanwhile."""
    with closing(UnixPort("busy")) as busy:
        for _ in range(150):
            UnixPort("busy", listen=False).close()
        with closing(UnixPort("busy")) as late:
            late.send(numbered(1))
            assert len(drain(busy, 1)) == 1


@pytest.mark.parametrize("name", ["", ".", "..", ".hidden", "a/b", "a b", "ü", "x" * 41, "a\n", "a\0"])
def test_bad_names_are_refused(name):
    with pytest.raises(HilError, match="40 letters"):
        UnixPort(name)


def test_a_folder_that_cannot_hold_a_socket_is_named(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path / ("x" * 120)))
    with pytest.raises(HilError, match="XDG_RUNTIME_DIR"):
        UnixPort("long")
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path / "file"))
    with pytest.raises(HilError, match="XDG_RUNTIME_DIR"):
        UnixPort("file")


MESSAGES = [
    can.Message(arbitration_id=0x123, data=b"\1\2\3", is_extended_id=False),
    can.Message(arbitration_id=0x18FF1234, data=b"", is_extended_id=True),
    can.Message(arbitration_id=0x7, data=bytes(64), is_fd=True, bitrate_switch=True, is_extended_id=False),
    can.Message(arbitration_id=0x8, is_fd=True, error_state_indicator=True, data=bytes(12), is_extended_id=False),
    can.Message(arbitration_id=0x321, is_remote_frame=True, dlc=8, is_extended_id=False),
    can.Message(arbitration_id=0x20, is_error_frame=True, data=bytes(8), is_extended_id=False),
]


@pytest.mark.parametrize("message", MESSAGES, ids=str)
def test_python_can_messages_arrive_as_they_were(message):
    with can.Bus(interface="unix", channel="pc") as a, can.Bus(interface="unix", channel="pc") as b:
        a.send(message)
        got = b.recv(2.0)
        assert got is not None
        assert got.equals(message, timestamp_delta=None, check_channel=False, check_direction=False)
        assert abs(got.timestamp - time.time()) < 2.0
        assert a.recv(0) is None


def test_python_can_filters_and_our_own_frames():
    batch = frames(3)
    batch["can_id"] = [0x100, 0x18FF1234 | EFF, 0x200]
    batch["length"], batch["flags"] = [1, 8, 64], [0, 0, FDF | BRS]
    filters = [{"can_id": 0x200, "can_mask": 0x7FF, "extended": False}]
    with (
        closing(UnixPort("mix")) as port,
        can.Bus(interface="unix", channel="mix") as bus,
        can.Bus(interface="unix", channel="mix", can_filters=filters) as picky,
    ):
        port.send(batch)
        assert [bus.recv(1.0).arbitration_id for _ in range(3)] == [0x100, 0x18FF1234, 0x200]
        only = picky.recv(1.0)
        assert (only.arbitration_id, only.dlc, only.is_fd) == (0x200, 64, True)
        assert picky.recv(0.05) is None


@pytest.mark.parametrize("loop", [True, False])
def test_notifier_gets_every_message_of_a_packet(loop):
    """With asyncio python-can reads one message each time the file descriptor is readable."""

    async def listen():
        got = []
        with can.Bus(interface="unix", channel="note") as bus, closing(UnixPort("note")) as port:
            notifier = can.Notifier(bus, [got.append], loop=asyncio.get_running_loop() if loop else None)
            port.send(numbered(100))
            deadline = time.monotonic() + 3.0
            while len(got) < 100 and time.monotonic() < deadline:
                await asyncio.sleep(0.01)
            notifier.stop()
        return got

    assert len(asyncio.run(listen())) == 100


def test_threads_of_one_process_may_join_at_once():
    ports, failures = [], []

    def join():
        try:
            ports.append(UnixPort("crowd"))
        except Exception as error:
            failures.append(error)

    threads = [threading.Thread(target=join) for _ in range(12)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert failures == []
    assert [port.listeners for port in ports] == [11] * 12
    ports[0].send(numbered(5))
    assert all(len(drain(port, 5)) == 5 for port in ports[1:])
    for port in ports:
        port.close()


def test_a_packet_that_is_no_whole_frames_disturbs_no_other():
    with closing(UnixPort("rubbish")) as port, closing(UnixPort("rubbish", listen=False)) as other:
        assert other.listeners == 1
        (wire,) = other._peers.values()
        for junk in (b"abc", bytes(200), bytes(79)):
            wire.send(junk)
            other.send(numbered(3, 10))
            other.send(numbered(2, 20))
        got = numbers(drain(port, 17, 0.2)).tolist()
        good = [10, 11, 12, 20, 21]
        assert got == [*good, 0, 0, *good, *good]  # 200 bytes are two frames and a half
        wire.send(b"abc")
        before = time.monotonic()
        assert port.receive(frames(PACKET), 0.2) == 0
        assert 0.15 < time.monotonic() - before < 1.0


def test_frames_that_lie_apart_or_may_not_be_stamped_are_sent_as_they_are():
    with closing(UnixPort("apart")) as port, closing(UnixPort("apart", listen=False)) as other:
        other.send(numbered(8)[::2])
        assert numbers(drain(port, 4)).tolist() == [0, 2, 4, 6]
        fixed = numbered(3)
        fixed.flags.writeable = False
        other.send(fixed)
        assert numbers(drain(port, 3)).tolist() == [0, 1, 2]
        assert not fixed["time_ns"].any()
