"""Our recording: whatever happens to the file or to its writer, what is read is a true beginning of what was written."""

import struct
import tracemalloc
import zlib

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from drivers.can.frames import FRAME, frames
from drivers.logs.recording import BLOCK, EVENT, MAGIC, SILENCE, RecordingReader, RecordingWriter, event_record
from nav.errors import HilError

HEADER = {"scenario": {"name": "ü"}, "origin": "test"}


def numbered(n):
    batch = frames(n)
    batch["time_ns"] = np.arange(n) * 1000
    batch["data"][:, :8] = np.arange(n, dtype=np.int64)[:, None].view(np.uint8)
    batch["length"] = 8
    return batch


def read(path):
    """All frames and the reader's complaint."""
    reader, parts = RecordingReader.open(path), [frames(0)]
    while len(chunk := reader.read()):
        parts.append(chunk)
    reader.close()
    return np.concatenate(parts), reader.problem


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    """A file of five blocks of 7 frames, an event between them; (bytes, frames)."""
    path = tmp_path_factory.mktemp("log") / "a.hil"
    batch = numbered(35)
    with RecordingWriter(path, HEADER) as writer:
        for start in range(0, 35, 7):
            writer.write(batch[start : start + 7])
            writer.flush()
    return path.read_bytes(), batch


@pytest.mark.parametrize("sizes", [[], [1], [BLOCK], [BLOCK + 1], [3 * BLOCK + 5, 2, 0, 1]])
def test_round_trip(tmp_path, sizes):
    batch, path = numbered(sum(sizes)), tmp_path / "a.hil"
    with RecordingWriter(path, HEADER) as writer:
        for k, size in enumerate(sizes):
            writer.write(batch[sum(sizes[:k]) :][:size])
    got, problem = read(path)
    np.testing.assert_array_equal(got, batch)
    assert problem == ""
    assert writer.written == len(batch)
    assert RecordingReader.open(path).header == HEADER


def test_events_keep_their_place(tmp_path):
    batch = numbered(4)
    with RecordingWriter(tmp_path / "a.hil", {}) as writer:
        writer.write(batch[:2])
        writer.write(event_record(SILENCE, 1500))
        writer.write(batch[2:])
    got, _ = read(tmp_path / "a.hil")
    assert got["reserved"][:, 0].tolist() == [0, 0, EVENT, 0, 0]
    assert (got["data"][2, 0], got["time_ns"][2]) == (SILENCE, 1500)


def test_truncated_anywhere(recorded, tmp_path):
    """Every region: magic, header, block heads, inside frames; each offset of the first two blocks, then every seventh."""
    whole, batch = recorded
    header = whole.index(b"BLK1")
    path, block = tmp_path / "cut.hil", 12 + 7 * FRAME.itemsize
    for size in [*range(header + 2 * block + 20), *range(header + 2 * block, len(whole), 7)]:
        path.write_bytes(whole[:size])
        if size < header:
            with pytest.raises(HilError, match=r"not a recording of ours at offset 0|damaged header at offset"):
                RecordingReader.open(path)
            continue
        got, problem = read(path)
        blocks, rest = divmod(size - header, block)
        np.testing.assert_array_equal(got, batch[: 7 * blocks])
        assert (f"offset {header + blocks * block}" in problem) == (rest > 0)


@settings(max_examples=200)
@given(st.data())
def test_bit_flips_never_give_a_wrong_frame(recorded, tmp_path_factory, data):
    whole, batch = recorded
    bad = bytearray(whole)
    at = data.draw(st.integers(0, len(bad) - 1))
    bad[at] ^= 1 << data.draw(st.integers(0, 7))
    path = tmp_path_factory.getbasetemp() / "flip.hil"
    path.write_bytes(bad)
    header = whole.index(b"BLK1")
    if at < header:
        with pytest.raises(HilError, match="offset"):
            RecordingReader.open(path)
        return
    got, problem = read(path)
    good = (at - header) // (12 + 7 * FRAME.itemsize)
    np.testing.assert_array_equal(got, batch[: 7 * good])
    assert "damaged" in problem


@pytest.mark.parametrize(
    "content", [b"", b"\0" * 100, b"(1700000000.0) can0 123#00\n", b"DTGHIL recording 2\n" + b"x" * 50]
)
def test_foreign_files_are_refused(tmp_path, content):
    (tmp_path / "foreign").write_bytes(content)
    with pytest.raises(HilError, match="not a recording of ours at offset 0"):
        RecordingReader.open(tmp_path / "foreign")


@pytest.mark.parametrize("text", [b"[1]", b"{", b"\xff", b"[" * 100_000])
def test_a_header_that_its_check_belies(tmp_path, text):
    """Its check is right, and it says nothing."""
    (tmp_path / "odd").write_bytes(MAGIC + struct.pack("<II", len(text), zlib.crc32(text)) + text)
    with pytest.raises(HilError, match="damaged header"):
        RecordingReader.open(tmp_path / "odd")


def test_a_header_that_says_it_is_huge_takes_no_room(tmp_path):
    (tmp_path / "huge").write_bytes(MAGIC + struct.pack("<II", 0xFFFFFFFF, 0))
    tracemalloc.start()
    with pytest.raises(HilError, match="damaged header"):
        RecordingReader.open(tmp_path / "huge")
    most = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert most < 1 << 26


def test_paths_that_cannot_be(tmp_path):
    with pytest.raises(HilError, match="No such file"):
        RecordingReader.open(tmp_path / "none")
    with pytest.raises(HilError, match="Is a directory"):
        RecordingReader.open(tmp_path)
    with pytest.raises(HilError, match="No such file"):
        RecordingWriter(tmp_path / "no" / "a.hil", {})
