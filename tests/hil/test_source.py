"""Frames from a file or a bus behind one `receive`."""

import re
import time
from contextlib import closing

import can
import numpy as np
import pytest

from drivers.can.convert import from_message, to_message
from drivers.can.frames import BRS, EFF, FDF, frames
from drivers.can.unix_bus import PACKET, UnixPort
from drivers.logs.recording import RecordingWriter
from hil.player import timed
from hil.source import BusSource, FileSource, is_own
from nav.errors import HilError

START_NS = 1_700_000_000_000_000_000


def numbered(n, period_ns=1_000_000):
    batch = frames(n)
    batch["time_ns"] = START_NS + np.arange(n) * period_ns
    batch["can_id"], batch["length"], batch["flags"] = 0x120, 64, FDF | BRS
    batch["can_id"][::5], batch["length"][::5], batch["flags"][::5] = 0x18FF0001 | EFF, 8, 0
    batch["data"][:, :8] = np.arange(n, dtype=np.int64)[:, None].view(np.uint8)
    return batch


def drained(source, room=100):
    parts, batch = [frames(0)], frames(room)
    while not source.exhausted:
        parts.append(batch[: source.receive(batch, 0.1)].copy())
    return np.concatenate(parts)


def recorded(path, batch):
    if path.suffix == ".hil":
        with RecordingWriter(path, {}) as writer:
            writer.write(batch)
    else:
        with can.Logger(path) as logger:
            for row in batch:
                logger.on_message_received(to_message(row, "can0"))
    return path


@pytest.mark.parametrize("suffix", [".hil", ".log", ".blf", ".asc"])
def test_every_format_gives_the_same_frames(tmp_path, suffix):
    batch = numbered(700)
    path = recorded(tmp_path / f"a{suffix}", batch)
    assert is_own(path) == (suffix == ".hil")
    with closing(FileSource(path, paced=False)) as source:
        got = drained(source)
        assert source.problem() == ""
        assert not source.live
    for name in ("can_id", "length", "flags", "data"):
        np.testing.assert_array_equal(got[name], batch[name])
    since = got["time_ns"] - got["time_ns"][0]
    np.testing.assert_allclose(since, batch["time_ns"] - START_NS, atol=1e4 if suffix != ".asc" else 1.1e6)


def test_paced_keeps_the_recorded_times(tmp_path):
    path = recorded(tmp_path / "a.hil", numbered(300))
    source, batch, ages, got = FileSource(path, paced=True), frames(100), [], 0
    start = time.monotonic_ns()
    while not source.exhausted:
        n = source.receive(batch, 0.05)
        now = time.monotonic_ns() - start
        ages += (now - (batch["time_ns"][:n] - START_NS)).tolist()
        got += n
    assert got == 300
    assert min(ages) >= -1e6
    assert np.median(ages) < 20e6
    assert 0.299 <= (time.monotonic_ns() - start) * 1e-9 < 1.0


@pytest.mark.parametrize("step_s", [3600.0, -3600.0])
def test_a_host_clock_that_was_set_holds_nothing_up(tmp_path, step_s):
    batch = numbered(200)
    batch["time_ns"][100:] += round(1e9 * step_s)
    path = recorded(tmp_path / "a.hil", batch)
    source, began = FileSource(path, paced=True), time.monotonic()
    assert len(drained(source, 10)) == 200
    assert 0.15 < time.monotonic() - began < 5.0
    due = [due_s for due_s, _ in timed(path, one_by_one=True)]
    assert due[-1] == pytest.approx(0.198)


def test_damage_is_told_and_what_came_before_is_used(tmp_path):
    path = recorded(tmp_path / "a.hil", numbered(100))
    path.write_bytes(path.read_bytes()[:-1])
    recorded(tmp_path / "b.log", numbered(100))
    (tmp_path / "b.log").write_text((tmp_path / "b.log").read_text() + "(17000 can0 12#zz\n")
    for name, n in (("a.hil", 0), ("b.log", 100)):
        source = FileSource(tmp_path / name, paced=False)
        assert len(drained(source)) == n
        assert name in source.problem()


@pytest.mark.parametrize(
    ("name", "content"), [("x.log", b"what is this\n"), ("x.blf", b"LOG?" * 50), ("x.xyz", b"1"), ("x", b"")]
)
def test_what_is_no_recording_is_refused(tmp_path, name, content):
    (tmp_path / name).write_bytes(content)
    with pytest.raises(HilError, match=name):
        drained(FileSource(tmp_path / name, paced=False))


def test_missing_files(tmp_path):
    with pytest.raises(HilError, match="No such file"):
        FileSource(tmp_path / "none.hil", paced=False)
    with pytest.raises(HilError, match="Is a directory"):
        FileSource(tmp_path, paced=False)


@pytest.mark.parametrize("paced", [True, False])
def test_a_bus_is_a_source(tmp_path_factory, monkeypatch, paced):
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path_factory.mktemp("s")))
    with closing(BusSource("unix:source", paced=paced)) as source, closing(UnixPort("source")) as sender:
        assert source.live == paced
        sender.send(numbered(10))
        batch = frames(128)
        assert source.receive(batch, 1.0) == 10
        assert source.receive(batch, 0.0) == 0
        assert not source.exhausted
        assert source.problem() == ""
    with pytest.raises(HilError):
        BusSource("nowhere", paced=paced)


def test_a_bus_tells_no_event(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    with closing(BusSource("unix:x", paced=True)) as source, closing(UnixPort("x", listen=False)) as port:
        odd = numbered(3)
        odd["reserved"] = 1
        batch = frames(PACKET)
        while not port.listeners:
            pass
        port.send(odd)
        assert source.receive(batch, 1.0) == 3
        assert not batch["reserved"][:3].any()


@pytest.mark.parametrize("size", [0, 16, 31])
def test_an_object_without_length_does_not_hold_a_blf_file_up(tmp_path, size):
    """python-can's reader alone goes round for ever at it."""
    path = tmp_path / "a.blf"
    with can.BLFWriter(path, compression_level=0) as logger:
        for row in numbered(10):
            logger.on_message_received(to_message(row, "can0"))
    data = bytearray(path.read_bytes())
    at = [found.start() for found in re.finditer(b"LOBJ", data)][6]  # the container, and five frames
    data[at + 8 : at + 12] = size.to_bytes(4, "little")
    path.write_bytes(data)
    with closing(FileSource(path, paced=False)) as source:
        assert len(drained(source)) == 5
        assert f"an object of {size} bytes" in source.problem()


def test_a_remote_frame_asks_for_no_more_than_a_frame_holds():
    message = can.Message(arbitration_id=1, is_remote_frame=True, dlc=8)
    message.dlc = 200
    row = frames(1)[0]
    from_message(message, row)
    assert row["length"] == 8
