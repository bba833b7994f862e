"""Aiding on CAN: rows come back to the resolution of the wire, its faults are counted, the head's driver is not disturbed."""

import math

import cantools
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.can.aiding import AidingDecoder, AidingEncoder, aiding_database_text, has_aiding, is_aiding, merge
from drivers.can.codec import load_database
from drivers.can.dtg_head import DtgHead
from drivers.can.dtg_head_emulator import HeadEncoder
from drivers.can.frames import EFF, ERR, FDF, RTR, frames
from drivers.can.integrity import protection
from nav.aiding import AIDING, Kind, aiding, aiding_rows
from nav.errors import HilError

# Largest value and resolution of each kind's values, as docs/can.md states them
WIRE = {
    Kind.GNSS: [(4.0, 2.0**-45)] * 2 + [(2.0**17, 2.0**-14)] + [(2.0**11, 2.0**-20)] * 3,
    Kind.BARO: [(2.0**17, 2.0**-14)],
    Kind.MAGNETIC: [(2.0**-9, 2.0**-40)] * 3,
    Kind.HEADING: [(8.0, 2.0**-28)],
    Kind.ATTITUDE: [(2.0, 2.0**-30)] * 4,
    Kind.BODY_VELOCITY: [(2.0**11, 2.0**-20)] * 3,
}
SIGMAS = {kind: 3 if kind == Kind.ATTITUDE else len(values) for kind, values in WIRE.items()}


@st.composite
def measurements(draw):
    kind = draw(st.sampled_from(list(WIRE)))
    values = [draw(st.floats(-0.999 * limit, 0.999 * limit)) for limit, _ in WIRE[kind]]
    sigma = st.one_of(st.just(math.inf), st.floats(1e-12, 1e6))
    sigmas = [draw(sigma) for _ in range(SIGMAS[kind])]
    return aiding(draw(st.floats(0.0, 4294.0)), kind, values, sigmas, draw(st.integers(0, 255)))


def rows_of(n=6, kinds=tuple(WIRE), start=10.0):
    """Rows that the wire carries exactly."""
    rows = np.zeros(n, AIDING)
    for k in range(n):
        kind = kinds[k % len(kinds)]
        values = [resolution * (1000 + 37 * k + i) for i, (_, resolution) in enumerate(WIRE[kind])]
        rows[k] = aiding(start + k * 0.125, kind, values, [0.5 + i for i in range(SIGMAS[kind])], k % 3)
    return rows


def protected(data, name, counter=0):
    """Payloads as a sender that knows the check writes them."""
    protection(load_database(aiding_database_text())[name]).protect(data, np.array([counter]))


@given(st.lists(measurements(), max_size=20))
def test_round_trip(listed):
    rows = np.array(listed, AIDING)
    batch = AidingEncoder().frames(rows)
    got, places = AidingDecoder().decode(batch, None)
    assert places.tolist() == list(range(len(rows)))
    np.testing.assert_array_equal(got["kind"], rows["kind"])
    np.testing.assert_array_equal(got["source"], rows["source"])
    np.testing.assert_allclose(got["time"], rows["time"], rtol=0, atol=0.501e-6)
    np.testing.assert_allclose(got["sigma"], rows["sigma"], rtol=2.0**-24)
    for before, after in zip(rows, got, strict=True):
        half = [0.5 * resolution for _, resolution in WIRE[Kind(before["kind"])]]
        assert (np.abs(after["value"] - before["value"])[: len(half)] <= half).all()


def test_a_fix_is_kept_to_a_fifth_of_a_micrometre():
    assert 6.4e6 * WIRE[Kind.GNSS][0][1] < 0.2e-6


def test_what_the_wire_carries_comes_back_exactly_and_counted():
    rows, decoder = rows_of(60), AidingDecoder()
    got, _ = decoder.decode(AidingEncoder().frames(rows), None)
    np.testing.assert_array_equal(got, rows)
    assert decoder.heard == dict.fromkeys(WIRE, 10)
    assert decoder.counters.as_dict() == {**dict.fromkeys(decoder.counters.as_dict(), 0), "frames": 60, "samples": 60}


def test_cantools_reads_the_same():
    peer = cantools.database.load_string(aiding_database_text(), "dbc")
    for row, frame in zip(rows_of(), AidingEncoder().frames(rows_of()), strict=True):
        said = peer.decode_message(int(frame["can_id"]), bytes(frame["data"][: frame["length"]]))
        values = [v for k, v in said.items() if k not in {"crc16", "e2e_counter", "protocol", "source", "device_time"}]
        assert values == [*row["value"][: len(WIRE[row["kind"]])], *row["sigma"][: SIGMAS[row["kind"]]]]
        assert (said["source"], said["device_time"]) == (row["source"], round(row["time"] * 1e6))


@pytest.mark.parametrize("now", [5000.0, 4294.967295, 4294.967297, 123456.789])
@pytest.mark.parametrize("age", [-3.0, 0.0, 0.25, 1000.0])
def test_time_is_the_one_nearest_to_the_newest_sample(now, age):
    batch = AidingEncoder().frames(aiding_rows([now - age], Kind.BARO, [1.0], [1.0]))
    got, _ = AidingDecoder().decode(batch, now)
    assert got["time"][0] == pytest.approx(now - age, abs=0.6e-6)


def test_every_fault_is_counted_and_nothing_wrong_comes_out():
    rows = rows_of(40, (Kind.GNSS, Kind.MAGNETIC))
    batch = AidingEncoder().frames(rows)
    batch["data"][4, 30] ^= 1  # a wrong bit: also missing by number
    batch["length"][7] = 32
    batch["flags"][9] = 0
    good = np.setdiff1d(np.arange(40), [4, 7, 9, 12, 14])
    foreign = frames(3)
    foreign["can_id"], foreign["length"] = [0x150, 0x15F, 0x157], 8
    sent = np.concatenate([batch[:12], batch[11:12], batch[13:14], batch[15:], foreign])
    decoder = AidingDecoder()
    got, places = decoder.decode(sent, None)
    np.testing.assert_array_equal(got, rows[good])
    assert (np.diff(places) > 0).all()
    counters = decoder.counters
    assert (counters.crc_errors, counters.short, counters.duplicated, counters.foreign) == (1, 2, 1, 3)
    assert counters.lost == 5
    decoder.decode(AidingEncoder().frames(rows[:2]), None)  # a sender that starts anew
    assert counters.restarts == 2
    assert counters.lost == 5


def test_another_version_is_refused():
    batch = AidingEncoder().frames(rows_of(1))
    batch["data"][0, 3] = 2
    decoder = AidingDecoder()
    protected(batch["data"], "AID_GNSS")
    assert len(decoder.decode(batch, None)[0]) == 0
    assert decoder.counters.version_errors == 1


@given(st.integers(0, 63), st.integers(0, 7))
def test_no_flipped_bit_passes(byte, bit):
    batch = AidingEncoder().frames(rows_of(1))
    batch["data"][0, byte] ^= 1 << bit
    decoder = AidingDecoder()
    assert len(decoder.decode(batch, None)[0]) == 0
    assert decoder.counters.crc_errors == 1


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"kind": 9}, "kind 9 has no message"),
        ({"source": 256}, "AID_GNSS.source: 256"),
        ({"value": math.nan}, "AID_GNSS.lat: nan"),
        ({"value": 5.0}, "AID_GNSS.lat: 5.0"),
        ({"sigma": 0.0}, "not positive"),
        ({"sigma": math.nan}, "not positive"),
    ],
)
def test_what_the_wire_cannot_carry_is_refused(change, says):
    row = aiding_rows([1.0], Kind.GNSS, np.zeros(6), np.ones(6))
    for name, value in change.items():
        row[name] = value
    with pytest.raises(HilError, match=says):
        AidingEncoder().frames(row)


def test_a_wrong_deviation_of_a_sender_is_a_missing_value():
    decoder = AidingDecoder()
    batch = AidingEncoder().frames(aiding_rows([1.0], Kind.BARO, [1.0], [1.0]))
    for wrong in (math.nan, -1.0, 0.0, math.inf):
        batch["data"][0, 16:20] = np.frombuffer(np.float32(wrong).tobytes(), np.uint8)
        protected(batch["data"], "AID_BARO", decoder.counters.samples)
        assert decoder.decode(batch, None)[0]["sigma"][0, 0] == math.inf


@pytest.mark.parametrize("layout", ["fd", "classic"])
def test_the_heads_driver_passes_over_them(layout):
    """Samples and counters with measurements between the samples' frames are those without."""
    encoder, plain, mixed = HeadEncoder(layout, 1000), DtgHead(), DtgHead()
    slow = encoder.slow()
    samples = encoder.samples(np.arange(20), 1000 * np.arange(1, 21), np.full((20, 4), 1e-4), np.full((20, 3), 1e-2))
    between = merge(samples, AidingEncoder().frames(rows_of(12)), np.arange(-1, 23, 2), 1 if layout == "fd" else 6)
    assert len(between) == len(samples) + 10, "those of samples -1 and 21 are not placed"
    alone = plain.decode(np.concatenate([slow, samples]))
    together = mixed.decode(np.concatenate([slow, between]))
    np.testing.assert_array_equal(together.dtheta, alone.dtheta)
    assert mixed.counters.as_dict() == {**plain.counters.as_dict(), "frames": plain.counters.frames + 10}
    assert mixed.counters.samples == 20


@pytest.mark.parametrize("flag", [EFF, RTR, ERR])
def test_reserved_ids_are_plain_ones(flag):
    assert is_aiding(np.arange(0x150, 0x160, dtype=np.uint32)).all()
    assert not is_aiding(np.array([0x14F, 0x160, 0x155 | flag], np.uint32)).any()


@given(st.lists(st.sampled_from([0x14F, 0x150, 0x15F, 0x160, 0x155 | EFF]), max_size=4))
def test_one_reserved_id_among_others_is_seen(ids):
    batch = frames(len(ids))
    batch["can_id"] = ids
    assert has_aiding(batch["can_id"]) == is_aiding(batch["can_id"]).any()


def test_length_on_the_wire_is_one_that_can_fd_has():
    batch = AidingEncoder().frames(rows_of())
    assert set(batch["length"].tolist()) <= {8, 12, 16, 20, 24, 32, 48, 64}
    assert ((batch["flags"] & FDF) != 0).all()
