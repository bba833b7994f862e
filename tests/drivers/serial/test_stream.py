"""Bytes to packets: nothing depends on how they were cut, every byte is accounted for, rubbish costs bounded time and memory."""

import re

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pty_board import BOARDS, cut, moving

from drivers.can.frames import frames
from drivers.serial.chunks import CHUNK, chunk_bytes, is_chunk, to_chunks
from drivers.serial.mip import Mip
from drivers.serial.stream import ByteStream, Framing
from drivers.serial.vectornav import VectorNav, line_of
from drivers.serial.xbus import LONGEST, Xbus, message

FRAMINGS: dict[str, type[Framing]] = {"xsens-xbus": Xbus, "vectornav": VectorNav, "microstrain-mip": Mip}


class Counting:
    """A framing that counts the bytes whose check it computes."""

    def __init__(self, inner: Framing) -> None:
        self.inner, self.sync, self.looked, self.asked = inner, inner.sync, 0, 0

    def size(self, data: bytes, at: int) -> int:
        self.asked += 1
        return self.inner.size(data, at)

    def good(self, packet: bytes) -> bool:
        self.looked += len(packet)
        return self.inner.good(packet)


def found(name: str, batch: np.ndarray, every: int) -> tuple[list[tuple[bytes, int]], ByteStream]:
    stream = ByteStream(FRAMINGS[name]())
    out = [pair for start in range(0, len(batch), every) for pair in stream.take(batch[start : start + every])]
    return out, stream


@given(st.data())
@pytest.mark.parametrize("name", FRAMINGS)
def test_cuts_and_batches_change_nothing(name: str, data: st.DataObject) -> None:
    good = BOARDS[name][1]().packets(moving(4))
    noise = st.binary(max_size=40) | st.sampled_from(
        [b"\xfa\xff\x36\xf0", b"\x75\x65\x80\xff", b"\xfa\x05", b"$VNYPR,"]
    )
    pieces = data.draw(st.lists(st.one_of(noise, st.sampled_from(good)), max_size=12))
    whole = b"".join(pieces)
    one, stream = found(name, to_chunks(whole), 1 << 20)
    sizes = data.draw(st.lists(st.integers(1, 90), max_size=60))
    many, other = found(name, cut(whole, sizes), data.draw(st.integers(1, 5)))
    assert [packet for packet, _ in one] == [packet for packet, _ in many]
    assert (stream.skipped, stream.bad_checks, stream.packets) == (other.skipped, other.bad_checks, other.packets)
    assert stream.skipped + sum(len(packet) for packet, _ in one) + stream.waiting == len(whole)


def test_the_arrival_is_that_of_the_last_byte_even_behind_a_false_start() -> None:
    good = message(0x36, b"\x10\x20\x02\x00\x01")
    false = b"\xfa\xff\x36\xf0"  # says 240 bytes: all that follows waits
    data = false + good + good + bytes(300)
    sizes = [len(false), 5, len(good) - 5, len(good)]
    (packets, _), (alone, _) = found("xsens-xbus", cut(data, sizes), 100), found("xsens-xbus", cut(data, sizes), 1)
    assert packets == alone == [(good, 2000), (good, 3000)]


@pytest.mark.parametrize(
    ("name", "rubbish"),
    [
        ("xsens-xbus", b"\xfa\xff\x36\xfe"),
        ("xsens-xbus", b"\xfa\xff\x36\xff\x07\xff"),
        ("vectornav", b"\xfa\x7f" + b"\xff\x03" * 3),
        ("vectornav", b"\xfa\x01\xff\x7f"),
        ("vectornav", b"$VN"),
        ("microstrain-mip", b"\x75\x65\x80\xff"),
    ],
)
def test_rubbish_full_of_false_starts_costs_in_proportion_to_its_length(name: str, rubbish: bytes) -> None:
    looked = []
    for n in (1 << 14, 1 << 16):
        framing = Counting(FRAMINGS[name]())
        stream, batch = ByteStream(framing), to_chunks(rubbish * (n // len(rubbish)))
        for k in range(len(batch)):
            for _ in stream.take(batch[k : k + 1]):
                pass
            assert stream.waiting <= LONGEST + 7
        looked.append(framing.looked + framing.asked)
    assert looked[1] < 4.5 * looked[0]  # what waits at the end is never looked at


def test_frames_of_a_bus_among_the_chunks_are_passed_over() -> None:
    batch = np.concatenate([frames(2), to_chunks(message(0x31)), frames(1)])
    assert is_chunk(batch).tolist() == [False, False, True, False]
    assert [packet for packet, _ in ByteStream(Xbus()).take(batch)] == [message(0x31)]


@given(st.binary(max_size=300))
def test_chunks_hold_their_bytes(data: bytes) -> None:
    batch = to_chunks(data, 7)
    assert chunk_bytes(batch) == data
    assert (batch["can_id"] == CHUNK).all()
    assert not batch["reserved"].any()


def test_vectornav_lines_of_both_checks() -> None:
    """Lines as the maker's documents and the boards print them."""
    printed = b"$VNRRG,82,0,0,0,0,0*65\r\n$VNWRG,6,0,1*B1B4\r\n$VNRRG,75,3,400,01,0321*3B31\r\n$VNRRG,8*4B\r\n"
    stream = ByteStream(VectorNav())
    lines = [packet for packet, _ in stream.take(to_chunks(b"noise$V" + printed + b"$VNRRG,8*4C\r\n" + line_of("VNX")))]
    assert b"".join(lines[:4]) == printed
    assert lines[4:] == [line_of("VNX")]
    assert stream.bad_checks == 1


def test_packets_of_the_makers_documents() -> None:
    vn = bytes.fromhex("FA01080093502E42833EF13F48B504BB9288")
    mip = bytes.fromhex("7565800E0E043E7A63A0BB8E3B297FE5BF7F84EE")
    for framing, packet in ((VectorNav(), vn), (Mip(), mip)):
        stream = ByteStream(framing)
        assert [found for found, _ in stream.take(to_chunks(b"\x00" + packet + b"\x01"))] == [packet]
        assert re.match(framing.sync, packet)
