"""Opening a bus by URL: what goes wrong says what to do, and every back end carries frames."""

import time
from contextlib import closing

import can
import numpy as np
import pytest

from drivers.can.bus import open_port
from drivers.can.frames import BRS, EFF, FDF, frames
from nav.errors import HilError


def mixed():
    batch = frames(4)
    batch["can_id"] = [0x100, 0x18FF1234 | EFF, 0x200, 0x7FF]
    batch["length"], batch["flags"] = [8, 3, 64, 0], [0, 0, FDF | BRS, 0]
    for row in batch:
        row["data"][: row["length"]] = np.arange(row["length"])
    return batch


def exchanged(url):
    """What of `mixed` arrives at a second participant."""
    with closing(open_port(url)) as a, closing(open_port(url)) as b:
        a.send(mixed())
        got, batch, deadline = frames(0), frames(64), time.monotonic() + 5.0
        while len(got) < 4 and time.monotonic() < deadline:
            n = b.receive(batch, 0.2)
            got = np.concatenate([got, batch[:n]])
        assert a.dropped == b.dropped == 0
    return got


def same(got):
    for name in ("can_id", "length", "flags", "data"):
        np.testing.assert_array_equal(got[name], mixed()[name])
    assert (np.abs(got["time_ns"] - time.time_ns()) < 10 * 10**9).all()


@pytest.mark.parametrize("url", ["unix:test-bus", "virtual:test-bus"])
def test_round_trip(url, tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    same(exchanged(url))


def test_udp_multicast_round_trip():
    try:
        got = exchanged("udp_multicast:239.74.163.2?port=43117")
    except HilError as error:
        pytest.skip(f"udp_multicast is not to be had here: {error}")
    if len(got) == 0:
        pytest.skip("no multicast route on this machine: nothing came back")
    same(got)


@pytest.mark.socketcan
def test_socketcan_round_trip():
    same(exchanged("socketcan:vcan0"))


def test_missing_socketcan_says_how_to_make_it():
    with pytest.raises(HilError) as refusal:
        open_port("socketcan:vcan77")
    text = str(refusal.value)
    assert "socketcan:vcan77" in text
    assert "ip link add vcan77 type vcan" in text or "this kernel has no SocketCAN" in text
    assert "hil doctor" in text


def test_missing_real_interface_says_its_bit_rates():
    with pytest.raises(HilError, match=r"type can bitrate|no SocketCAN"):
        open_port("socketcan:can77")


@pytest.mark.parametrize(
    ("url", "say"),
    [
        ("", "expected INTERFACE:CHANNEL"),
        ("unix", "expected INTERFACE:CHANNEL"),
        ("unix:", "expected INTERFACE:CHANNEL"),
        ("socketcan:?fd=true", "expected INTERFACE:CHANNEL"),
        ("unix:x?fd=true", "takes no options"),
        ("unix:../x", "40 letters"),
        ("telepathy:x", "nobody knows an interface 'telepathy'"),
    ],
)
def test_bad_urls(url, say):
    with pytest.raises(HilError) as refusal:
        open_port(url)
    assert say in str(refusal.value)


def test_options_reach_python_can(monkeypatch):
    seen = {}

    def bus(**arguments):
        seen.update(arguments)
        raise can.CanInitializationError("no hardware here")

    monkeypatch.setattr(can, "Bus", bus)
    with pytest.raises(HilError, match=r"slcan:/dev/ttyACM0.*no hardware here"):
        open_port("slcan:/dev/ttyACM0?bitrate=500000&fd=true&timeout=0.5&name=x")
    assert seen == {
        "interface": "slcan",
        "channel": "/dev/ttyACM0",
        "bitrate": 500000,
        "fd": True,
        "timeout": 0.5,
        "name": "x",
    }


def test_a_bus_that_fails_is_reopened(monkeypatch):
    monkeypatch.setattr("drivers.can.bus.REOPEN_S", 0.05)
    with closing(open_port("virtual:flaky")) as port, closing(open_port("virtual:flaky")) as other:
        port._bus.shutdown()
        batch = frames(64)
        assert port.receive(batch, 0.1) == 0
        assert port.failures == 1
        time.sleep(0.1)
        port.receive(batch, 0.0)  # opens it again
        other.send(mixed())
        assert port.receive(batch, 1.0) == 4
