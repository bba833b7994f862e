"""The codec against cantools, bit for bit, and against the layout of the head's messages as their users know it."""

import math
import struct
from functools import cache
from pathlib import Path

import cantools
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from drivers.can.codec import MessageCodec, load_database
from drivers.can.frames import EFF, frames
from nav.errors import HilError

HEAD_DBC = Path(__file__).parents[3] / "fixtures" / "can" / "dtg_head.dbc"

SCALES = st.sampled_from([1, 2, -3, 0.01, 0.1, 2.0**-32, 1e-7, -0.25, 3.3, 1e6])
OFFSETS = st.sampled_from([0, 0, 5, -40, 0.5, -273.15, 1e9])


def used_bits(start, length, big_endian):
    """Wire bits, numbered 8 * byte + bit, of a DBC signal; None when they leave 64 bytes."""
    if not big_endian:
        bits = list(range(start, start + length))
    else:
        bits, bit = [], start
        for _ in range(length):
            bits.append(bit)
            bit = bit - 1 if bit % 8 else bit + 15
    return bits if max(bits) < 512 else None


@st.composite
def message_text(draw, longest=64, floats=True):
    """A DBC with one 64-byte message of up to eight signals that do not overlap, and the signals' wire bits."""
    taken, lines, kinds = set(), [], []
    for k in range(draw(st.integers(1, 8))):
        kind = draw(st.sampled_from(["+", "-", "f", "d"] if floats else ["+", "-"]))
        length = {"f": 32, "d": 64}.get(kind) or draw(st.integers(1, longest))
        start, big_endian = draw(st.integers(0, 511)), draw(st.booleans())
        bits = used_bits(start, length, big_endian)
        if bits is None or taken & set(bits):
            continue
        taken |= set(bits)
        sign = kind if kind in "+-" else "-"
        scale, offset = draw(SCALES), draw(OFFSETS)
        lines.append(f' SG_ S{k} : {start}|{length}@{0 if big_endian else 1}{sign} ({scale!r},{offset!r}) [0|0] "" R')
        if kind in "fd":
            kinds.append(f"SIG_VALTYPE_ 5 S{k} : {'fd'.index(kind) + 1};")
    if not lines:
        lines, taken = [' SG_ S0 : 0|8@1+ (1,0) [0|0] "" R'], set(range(8))
    return "\n".join(["BU_: R", "BO_ 5 M: 64 R", *lines, "", *kinds, ""]), taken


def expected(signal, raw):
    """`raw * scale + offset` in doubles, which is what cantools computes but for integers beyond 2^53."""
    if not signal.is_float and max(abs(raw), abs(raw * signal.scale)) >= 2**53:
        return float(raw) * float(signal.scale) + float(signal.offset)
    return float(signal.conversion.raw_to_scaled(raw, decode_choices=False))


def same(a, b):
    return struct.pack("<d", a) == struct.pack("<d", b) or (math.isnan(a) and math.isnan(b))


def assert_decodes_as_cantools(message, codec: MessageCodec, data):
    rows = np.array(data, np.uint8).reshape(1, -1)
    out = codec.decode(rows, np.empty((1, len(codec.signals))))[0]
    raw = codec.decode_raw(rows, np.empty((1, len(codec.signals)), np.int64))[0]
    reference = message.decode(bytes(data)[: message.length], scaling=False, decode_choices=False)
    for signal in message.signals:
        column = codec.columns[signal.name]
        if signal.name not in reference:
            assert math.isnan(out[column])
            continue
        assert same(out[column], expected(signal, reference[signal.name])), signal
        if not signal.is_float:
            assert (int(raw[column]) - reference[signal.name]) % 2**64 == 0


@settings(max_examples=150)
@given(message_text(), st.lists(st.binary(min_size=64, max_size=64), min_size=1, max_size=4))
def test_decode_is_cantools_bit_for_bit(drawn, payloads):
    text, _ = drawn
    message = cantools.database.load_string(text, "dbc").messages[0]
    codec = load_database(text)["M"]
    for payload in payloads:
        assert_decodes_as_cantools(message, codec, list(payload))


@settings(max_examples=100)
@given(message_text(), st.binary(min_size=64, max_size=64))
def test_raw_values_make_a_round_trip_through_their_own_bits_only(drawn, payload):
    text, taken = drawn
    codec = load_database(text)["M"]
    data = np.frombuffer(payload, np.uint8)[None, :]
    raw = codec.decode_raw(data, np.empty((1, len(codec.signals)), np.int64))
    back = codec.encode_raw(raw, np.full((1, 64), 0xFF, np.uint8))
    mask = np.packbits([bit in taken for bit in range(512)], bitorder="little")
    assert (back[0] == data[0] & mask).all()


@settings(max_examples=100)
@given(message_text(longest=50), st.data())
def test_encode_is_cantools_bit_for_bit(drawn, data):
    text, _ = drawn
    message = cantools.database.load_string(text, "dbc").messages[0]
    codec = load_database(text)["M"]
    values = {}
    for signal in message.signals:
        if signal.is_float:
            values[signal.name] = data.draw(st.floats(-1e27, 1e27))
            continue
        low = -(2 ** (signal.length - 1)) if signal.is_signed else 0
        raw = data.draw(st.integers(low, low + 2**signal.length - 1))
        inside = low < raw < low + 2**signal.length - 1
        part = data.draw(st.sampled_from([0.0, 0.25, -0.375, 0.5])) if inside else 0.0
        values[signal.name] = float((raw + part) * signal.scale + signal.offset)
        ratio = (values[signal.name] - signal.offset) / signal.scale
        if not low <= round(ratio) < low + 2**signal.length:  # a large offset moved the edge
            values[signal.name] = float(signal.offset)
    row = np.array([[values[s.name] for s in codec.signals]])
    out = codec.encode(row, np.full((1, 64), 0xFF, np.uint8))
    assert out.tobytes() == message.encode(values, strict=False)


def one_signal(declaration, *rest):
    return load_database("\n".join(["BU_: R", "BO_ 5 M: 8 R", f' SG_ S : {declaration} [0|0] "rad" R', "", *rest, ""]))[
        "M"
    ]


@pytest.mark.parametrize("big_endian", [False, True])
@pytest.mark.parametrize("signed", [False, True])
@pytest.mark.parametrize("length", [1, 7, 8, 13, 32, 52])
def test_a_value_is_refused_exactly_beyond_the_bits(length, signed, big_endian):
    codec = one_signal(f"{7 if big_endian else 3}|{length}@{0 if big_endian else 1}{'-' if signed else '+'} (0.5,0)")
    low = -(2.0 ** (length - 1)) if signed else 0.0
    high = low + 2.0**length - 1.0
    out = np.zeros((1, 8), np.uint8)
    for edge in (low, high):
        codec.encode(np.array([[edge * 0.5]]), out)
        assert codec.decode(out, np.empty((1, 1)))[0, 0] == edge * 0.5
    for beyond in (low - 1, high + 1):
        with pytest.raises(HilError, match=r"M\.S"):
            codec.encode(np.array([[beyond * 0.5]]), out)
        with pytest.raises(HilError, match=r"M\.S"):
            codec.encode_raw(np.array([[int(beyond)]]), out)


@pytest.mark.parametrize("length", [16, 64])
@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf, 1e300])
def test_what_is_no_number_of_the_signal_is_refused_by_name(length, value):
    codec = one_signal(f"0|{length}@1- (1,0)")
    with pytest.raises(HilError, match=r"M\.S.*row 1"):
        codec.encode(np.array([[0.0], [value]]), np.zeros((2, 8), np.uint8))


@pytest.mark.parametrize(
    ("kind", "length", "value"), [(1, 32, math.nan), (1, 32, 1e39), (2, 64, math.inf), (2, 64, math.nan)]
)
def test_a_float_that_is_not_finite_is_refused(kind, length, value):
    codec = one_signal(f"0|{length}@1- (1,0)", f"SIG_VALTYPE_ 5 S : {kind};")
    with pytest.raises(HilError, match=r"M\.S"):
        codec.encode(np.array([[value]]), np.zeros((1, 8), np.uint8))


def test_a_negative_zero_stays_negative():
    codec = one_signal("0|64@1- (1,0)", "SIG_VALTYPE_ 5 S : 2;")
    assert math.copysign(1.0, codec.unpack(struct.pack("<d", -0.0))["S"]) == -1.0


def test_unsigned_64_bits_are_not_taken_for_negative():
    codec = one_signal("0|64@1+ (1,0)")
    assert codec.unpack(b"\xff" * 8) == {"S": 2**64 - 1}
    assert codec.decode(np.full((1, 8), 0xFF, np.uint8), np.empty((1, 1)))[0, 0] == 2.0**64


MULTIPLEXED = """BU_: R
BO_ 5 M: 8 R
 SG_ Selector M : 4|4@1+ (1,0) [0|0] "" R
 SG_ A m0 : 8|16@1- (0.5,1) [0|0] "" R
 SG_ B m3 : 15|24@0+ (2,0) [0|0] "" R
 SG_ Always : 40|8@1+ (1,0) [0|0] "" R
"""


@given(st.binary(min_size=8, max_size=8), st.sampled_from([0, 3]))
def test_multiplexed_signals_come_only_when_selected(payload, selected):
    message = cantools.database.load_string(MULTIPLEXED, "dbc").messages[0]
    codec = load_database(MULTIPLEXED)["M"]
    data = bytes([selected << 4 | payload[0] & 15]) + payload[1:]
    assert_decodes_as_cantools(message, codec, list(data))
    values = codec.unpack(data)
    assert set(values) == {"Selector", "Always", "A" if selected == 0 else "B"}
    row = np.array([[values.get(s.name, math.nan) for s in codec.signals]])
    packed = codec.encode(row, np.zeros((1, 8), np.uint8)).tobytes()
    assert packed == message.encode(values, strict=False)


def test_an_unselected_multiplexed_signal_is_nan_and_raw_zero():
    codec = load_database(MULTIPLEXED)["M"]
    data = np.full((1, 8), 0xFF, np.uint8)
    for name in "AB":
        assert math.isnan(codec.decode(data, np.empty((1, 4)))[0, codec.columns[name]])
        assert codec.decode_raw(data, np.empty((1, 4), np.int64))[0, codec.columns[name]] == 0


def test_what_is_not_covered_is_refused_by_name_and_the_rest_works():
    nested = (
        "BU_: R\nBO_ 5 Nested: 8 R\n"
        ' SG_ S0 M : 0|4@1+ (1,0) [0|0] "" R\n'
        ' SG_ S1 m0M : 4|4@1+ (1,0) [0|0] "" R\n'
        ' SG_ S2 m1 : 8|8@1+ (1,0) [0|0] "" R\n'
        'BO_ 2147483654 Good: 8 R\n SG_ S : 0|8@1+ (1,0) [0|0] "" R\n\n'
        "SG_MUL_VAL_ 5 S1 S0 0-0;\nSG_MUL_VAL_ 5 S2 S1 1-1;\n"
    )
    database = load_database(nested)
    assert database.by_id[6 | EFF] is database["Good"]
    with pytest.raises(HilError, match=r"Nested.*multiplexed"):
        database["Nested"]
    with pytest.raises(HilError, match="no message Other"):
        database["Other"]


@pytest.mark.parametrize(
    "source",
    [
        Path("no/such/file.dbc"),
        "no/such/file.dbc",
        "this is\nnot a DBC",
        'BU_: R\nBO_ 5 M: 1 R\n SG_ S : 0|9@1+ (1,0) [0|0] "" R\n',
        'BU_: R\nBO_ 5 M: 2 R\n SG_ A : 0|9@1+ (1,0) [0|0] "" R\n SG_ B : 8|4@1+ (1,0) [0|0] "" R\n',
    ],
)
def test_a_bad_file_is_one_kind_of_error(source):
    with pytest.raises(HilError, match="cannot be read as a DBC"):
        load_database(source)


def test_arrays_of_the_wrong_shape_are_refused():
    codec = one_signal("0|16@1- (1,0)")
    with pytest.raises(HilError, match="do not fit"):
        codec.decode(np.zeros((2, 7), np.uint8), np.zeros((2, 1)))
    with pytest.raises(HilError, match="do not fit"):
        codec.decode_raw(np.zeros((2, 8), np.uint8), np.zeros((3, 1), np.int64))
    with pytest.raises(HilError, match="do not fit"):
        codec.encode(np.zeros((2, 2)), np.zeros((2, 8), np.uint8))
    with pytest.raises(HilError, match="8 are expected"):
        codec.unpack(b"1234567")
    with pytest.raises(HilError, match="has no signal T"):
        codec.pack({"T": 1.0})


def test_payloads_are_read_where_they_lie_in_frame_records():
    codec = one_signal("0|16@1- (1,0)")
    batch = frames(5)
    batch["data"][:, :2] = np.arange(-2, 3).astype("<i2").view(np.uint8).reshape(5, 2)
    assert codec.decode(batch["data"], np.empty((5, 1)))[:, 0].tolist() == [-2, -1, 0, 1, 2]


def test_the_sbg_messages_decode_as_cantools(hil_data):
    path = hil_data / "sbgCan.dbc"
    reference, database = cantools.database.load_file(path), load_database(path)
    assert not database.refused
    rng = np.random.default_rng(7)
    for message in reference.messages:
        for _ in range(50):
            assert_decodes_as_cantools(message, database[message.name], rng.integers(0, 256, 64).tolist())


@pytest.mark.parametrize("path", sorted(HEAD_DBC.parent.glob("*.dbc")), ids=lambda path: path.stem)
def test_every_message_that_is_shipped_decodes_as_cantools(path):
    reference, database = cantools.database.load_file(path), load_database(path)
    assert not database.refused
    rng = np.random.default_rng(8)
    for message in reference.messages:
        for _ in range(20):
            assert_decodes_as_cantools(message, database[message.name], rng.integers(0, 256, 64).tolist())


# The head's own message set, as a head's maker would write it down.


@cache
def load_head():
    return load_database(HEAD_DBC)


INT32 = st.integers(-(2**31), 2**31 - 1)
U32 = st.integers(0, 2**32 - 1)


@given(st.tuples(*[U32, U32, st.integers(0, 65535), *[INT32] * 11]))
def test_head_sample_has_its_layout_and_exact_scales(fields):
    counter, time, status, *increments = fields
    data = struct.pack("<HBBIIHH11i4x", 0xBEEF, counter & 0xFF, 1, counter, time, status, 0, *increments)
    values = load_head()["HEAD_SAMPLE"].unpack(data)
    assert values["crc16"] == 0xBEEF
    assert values["e2e_counter"] == counter & 0xFF
    assert (values["protocol"], values["sample_counter"], values["device_time"], values["status"]) == (
        1,
        counter,
        time,
        status,
    )
    axes = ("g1x", "g1y", "g2y", "g2z")
    names = [*(f"dtheta_{a}" for a in axes), *(f"dvel_{a}" for a in "xyz"), *(f"rotor_{a}" for a in axes)]
    for name, raw in zip(names, increments, strict=True):
        assert values[name] == math.ldexp(raw, -26 if "dvel" in name else -32)


@given(st.tuples(*[st.integers(-(2**23), 2**23 - 1)] * 3), st.tuples(*[INT32] * 4), U32, U32)
def test_the_classic_set_has_its_layout_and_its_split_velocity(dvel, dtheta, counter, time):
    low, high = [v & 0xFFFF for v in dvel], [v >> 16 for v in dvel]
    head = bytes([0xA5, counter & 15])
    bodies = [
        struct.pack("<IH", counter, 0x8001),
        struct.pack("<IbB", time, high[2], 1),
        *(struct.pack("<iH", dtheta[k], low[k]) for k in range(3)),
        struct.pack("<ibb", dtheta[3], high[0], high[1]),
    ]
    values = {}
    for k, body in enumerate(bodies):
        codec = load_head()[f"HEAD_C{k}"]
        assert (codec.can_id, codec.length, codec.is_fd) == (0x130 + k, 8, False)
        values |= codec.unpack(head + body)
    assert (values["crc8"], values["e2e_counter"], values["status"], values["protocol"]) == (
        0xA5,
        counter & 15,
        0x8001,
        1,
    )
    assert (values["sample_counter"], values["device_time"]) == (counter, time)
    for axis, raw in zip("xyz", dvel, strict=True):
        assert values[f"dvel_{axis}_lo"] + values[f"dvel_{axis}_hi"] == math.ldexp(raw, -22)
    for axis, raw in zip(("g1x", "g1y", "g2y", "g2z"), dtheta, strict=True):
        assert values[f"dtheta_{axis}"] == math.ldexp(raw, -32)


def test_the_slow_messages_have_their_layout():
    database = load_head()
    cases = {
        "HEAD_IDENTITY": (struct.pack("<IBB", 123456789, 1, 2), {"serial": 123456789, "protocol": 1, "hardware": 2}),
        "HEAD_CONFIG": (struct.pack("<IH", 0xCAFEF00D, 1000), {"world_id": 0xCAFEF00D, "sample_period": 1000}),
        "HEAD_TEMPERATURE": (
            struct.pack("<3h", 2512, -4000, 7),
            {"temperature_g1": 25.12, "temperature_g2": -40.0, "temperature_acc": 0.07},
        ),
        "HEAD_ROTOR": (
            struct.pack("<3H", 22800, 22801, 27000),
            {"rotor_speed_g1": 228.0, "rotor_speed_g2": 228.01, "supply": 27.0},
        ),
        "HEAD_BIT": (
            bytes(range(6)),
            {f"bit_{part}": k for k, part in enumerate(("g1", "g2", "ax", "ay", "az", "cpu"))},
        ),
    }
    for name, (body, values) in cases.items():
        assert database[name].unpack(b"\x00\x05" + body) == pytest.approx({"crc8": 0, "e2e_counter": 5, **values})
        assert database[name].pack(values)[2:] == body
    hardware = database["HEAD_IDENTITY"].signals[database["HEAD_IDENTITY"].columns["hardware"]]
    assert hardware.choices == {0: "real", 1: "simulated", 2: "replay"}


def test_only_the_sample_is_fd_and_every_message_is_documented_and_timed():
    for codec in load_head().messages.values():
        assert codec.is_fd == (codec.name == "HEAD_SAMPLE")
        assert codec.attributes["VFrameFormat"] == ("StandardCAN_FD" if codec.is_fd else "StandardCAN")
        assert codec.attributes["GenMsgCycleTime"] >= 1
        assert codec.comment
        assert all(signal.comment for signal in codec.signals)
