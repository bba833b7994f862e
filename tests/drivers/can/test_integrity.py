"""Protection of payloads against the published check values, the package autosar-e2e, and damage."""

from pathlib import Path

import numpy as np
import pytest
from e2e import p05, p11
from hypothesis import given
from hypothesis import strategies as st

from drivers.can.codec import load_database
from drivers.can.integrity import Protection, p05_crc, p11_crc, protection
from nav.errors import HilError

HEAD_DBC = Path(__file__).parents[3] / "fixtures" / "can" / "dtg_head.dbc"
ORACLE = {"P05": (p05.e2e_p05_protect, p05.e2e_p05_check), "P11": (p11.e2e_p11_protect, p11.e2e_p11_check)}

PROFILES = st.sampled_from(["P05", "P11"])
IDS = st.integers(0, 65535)
PAYLOADS = st.lists(st.binary(min_size=64, max_size=64), min_size=1, max_size=5)


def rows(payloads):
    return np.frombuffer(b"".join(payloads), np.uint8).reshape(len(payloads), -1).copy()


def test_the_published_check_values():
    """CRC-16/IBM-3740 of "123456789" is 0x29B1, CRC-8/GSM-A 0x37: the data id takes part of the text."""
    out16, out8 = np.zeros(1, np.uint16), np.zeros(1, np.uint8)
    p05_crc(rows([b"--1234567"]), 9, int.from_bytes(b"89", "little"), out16)
    p11_crc(rows([b"-3456789"]), 8, int.from_bytes(b"12", "little"), out8)
    assert (out16[0], out8[0]) == (0x29B1, 0x37)


@given(PROFILES, PAYLOADS, IDS, st.integers(3, 64), st.integers(0, 2**32 - 1))
def test_protected_rows_are_those_of_autosar_e2e(profile, payloads, data_id, length, first):
    modulus = 256 if profile == "P05" else 15
    counters = first + np.arange(len(payloads))
    data = rows(payloads)
    Protection(profile, data_id, length, modulus).protect(data, counters)
    for row, payload, counter in zip(data, payloads, counters, strict=True):
        reference = bytearray(payload)
        if profile == "P05":
            reference[2] = counter % modulus
        else:
            reference[1] = reference[1] & 0xF0 | counter % modulus
        ORACLE[profile][0](reference, data_id, length=length, increment_counter=False)
        assert row.tobytes() == bytes(reference)


@given(
    PROFILES,
    st.lists(st.binary(min_size=12, max_size=12), min_size=1, max_size=5),
    IDS,
    st.integers(3, 12),
    st.booleans(),
)
def test_a_row_is_good_when_autosar_e2e_says_so(profile, payloads, data_id, length, repair):
    data = rows(payloads)
    modulus = 256 if profile == "P05" else 15
    if repair:  # random payloads alone are hardly ever good
        crc = np.zeros(len(data), np.uint16 if profile == "P05" else np.uint8)
        (p05_crc if profile == "P05" else p11_crc)(data, length, data_id, crc)
        data[:, : crc.itemsize] = crc[:, None].view(np.uint8)
    good = Protection(profile, data_id, length, modulus).check(data, np.zeros(len(data), bool))
    assert good.tolist() == [ORACLE[profile][1](bytearray(row), data_id, length=length) for row in data]


@given(PROFILES, st.binary(min_size=64, max_size=64), IDS, st.integers(4, 64), st.data())
def test_a_burst_shorter_than_the_crc_is_always_seen(profile, payload, data_id, length, drawn):
    guard = Protection(profile, data_id, length, 256 if profile == "P05" else 16)
    data = rows([payload])
    guard.protect(data, np.array([7]))
    width = drawn.draw(st.integers(1, 16 if profile == "P05" else 8))
    start = drawn.draw(st.integers(8 * (2 if profile == "P05" else 1), 8 * length - width))
    for bit in {start, start + width - 1} | set(drawn.draw(st.lists(st.integers(start, start + width - 1)))):
        data[0, bit // 8] ^= 0x80 >> bit % 8
    assert not guard.check(data, np.ones(1, bool))[0]


def test_no_message_of_the_head_passes_for_another():
    guards = [protection(message) for message in load_database(HEAD_DBC).messages.values() if message.length == 8]
    assert all(guards)
    data = np.zeros((1, 8), np.uint8)
    for sender in guards:
        sender.protect(data, np.array([3]))
        assert [g for g in guards if g.check(data, np.zeros(1, bool))[0]] == [sender]


def test_the_head_declares_profile_and_counter_beside_the_layout():
    database = load_database(HEAD_DBC)
    for message in database.messages.values():
        guard = protection(message)
        assert guard.length == message.length
        assert guard.profile == ("P05" if message.is_fd else "P11")
        crc, counter = message.signals[0], message.signals[message.columns["e2e_counter"]]
        assert (crc.start, crc.length) == (0, 16 if message.is_fd else 8)
        assert (counter.start, 2**counter.length) == ((16, 256) if message.is_fd else (8, 16))
        assert guard.counter_modulus == (256 if message.is_fd else 15)  # Profile 11 leaves out 15


def test_a_message_without_a_declaration_has_no_protection_and_a_wrong_one_is_named():
    plain = 'BU_: R\nBO_ 5 M: 8 R\n SG_ S : 0|8@1+ (1,0) [0|0] "" R\n\n'
    assert protection(load_database(plain)["M"]) is None
    for attributes in ('BA_DEF_ BO_ "E2EProfile" STRING;\nBA_ "E2EProfile" BO_ 5 "P99";\n',
                       'BA_DEF_ BO_ "E2EProfile" STRING;\nBA_ "E2EProfile" BO_ 5 "P11";\n'):  # fmt: skip
        with pytest.raises(HilError, match="message M"):
            protection(load_database(plain + attributes)["M"])


def test_arrays_that_do_not_fit_are_refused():
    guard = Protection("P11", 1, 8, 16)
    with pytest.raises(HilError, match="do not fit"):
        guard.check(np.zeros((2, 7), np.uint8), np.zeros(2, bool))
    with pytest.raises(HilError, match="do not fit"):
        guard.protect(np.zeros((2, 8), np.uint8), np.zeros(3, np.int64))
    with pytest.raises(HilError, match="cannot carry"):
        Protection("P05", 1, 2, 256)
