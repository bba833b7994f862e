"""The head's driver against its emulator: exact round trips, and every fault of a wire counted to the sample."""

import math
from copy import deepcopy
from functools import cache
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from drivers import driver_names, make_driver
from drivers.can.dtg_head import DtgHead, _fill, _track
from drivers.can.dtg_head_emulator import HeadEncoder
from drivers.can.frames import EFF, ERR, FDF, RTR, frames
from nav.errors import HilError
from nav.increments import HeadIncrements, Validity

PERIOD = 1000
layouts = pytest.mark.parametrize("layout", ["fd", "classic"])
PARTS = {"fd": 1, "classic": 6}


def motion(n, seed=0):
    random = np.random.default_rng(seed)
    return random.uniform(-1e-3, 1e-3, (n, 4)), random.uniform(-0.05, 0.05, (n, 3))


_new_head, _new_encoder = cache(DtgHead), cache(lambda layout: HeadEncoder(layout, PERIOD, world_id=7))
"""Reading the message set takes longer than a test: fresh ones are copies of these."""


def sent(layout, counters, times=None, seed=0, **kwargs):
    counters = np.asarray(counters, np.int64)
    times = (counters + 1) * PERIOD if times is None else np.asarray(times, np.int64)
    return deepcopy(_new_encoder(layout)).samples(counters, times, *motion(len(counters), seed), **kwargs)


def told(layout):
    """A driver that has heard the head's slow frames."""
    driver = deepcopy(_new_head())
    driver.decode(deepcopy(_new_encoder(layout)).slow())
    return driver


def copied(result):
    return HeadIncrements(*(getattr(result, name).copy() for name in HeadIncrements.__dataclass_fields__))


def fed(driver, batch, cuts=()):
    """All samples out of `batch`, handed over in pieces, as columns; arrivals among them."""
    edges = [0, *sorted(min(cut, len(batch)) for cut in cuts), len(batch)]
    columns = {name: [] for name in (*HeadIncrements.__dataclass_fields__, "arrival")}
    for start, stop in pairwise(edges):
        result = driver.decode(batch[start:stop])
        for name in HeadIncrements.__dataclass_fields__:
            columns[name].append(getattr(result, name).copy())
        columns["arrival"].append(driver.arrivals().copy())
    return {name: np.concatenate(values) for name, values in columns.items()}


@layouts
def test_round_trip(layout):
    n = 500
    dtheta, dvel = motion(n)
    encoder = HeadEncoder(layout, PERIOD, serial=77, world_id=0xDEADBEEF)
    batch = encoder.samples(np.arange(n), (np.arange(n) + 1) * PERIOD, dtheta, dvel)
    assert len(batch) == n * PARTS[layout]
    batch["time_ns"] = np.arange(len(batch))
    driver = make_driver("dtg-head")
    driver.decode(encoder.slow())
    out = fed(driver, batch)
    np.testing.assert_array_equal(out["sequence"], np.arange(n))
    np.testing.assert_allclose(out["time"], (np.arange(n) + 1) * 1e-3, rtol=1e-15)
    np.testing.assert_allclose(out["step"], 1e-3, rtol=1e-15)
    # Rounded to the wire's least step, the rest carried over: no error exceeds one step, and none remains in the sum
    velocity_step = 2.0 ** (-26 if layout == "fd" else -22)
    assert np.abs(out["dtheta"] - dtheta).max() <= 2.0**-32
    assert np.abs(out["dvel"] - dvel).max() <= velocity_step
    assert np.abs((out["dtheta"] - dtheta).sum(0)).max() <= 0.5001 * 2.0**-32
    assert np.abs((out["dvel"] - dvel).sum(0)).max() <= 0.5001 * velocity_step
    assert np.isnan(out["rotor"]).all()  # this emulator has no rotor angles and says so
    assert (out["arrival"] == np.arange(n) * PARTS[layout] + PARTS[layout] - 1).all()
    assert driver.world_id == 0xDEADBEEF
    assert driver.period_s == pytest.approx(1e-3)
    assert driver.identity()["serial"] == 77
    assert driver.counters.as_dict() | {"frames": 0, "samples": 0} == dict.fromkeys(driver.counters.as_dict(), 0)
    assert (driver.counters.frames, driver.counters.samples) == (len(batch) + 5, n)


@layouts
@given(st.floats(-1e-11, 1e-11), st.floats(-1e-9, 1e-9))
@settings(max_examples=20)
def test_quantisation_adds_no_bias(layout, angle, velocity):
    """Increments far below the wire's step arrive in the mean."""
    n = 3000
    encoder = deepcopy(_new_encoder(layout))
    batch = [
        encoder.samples(
            np.arange(k, k + 500), np.arange(k, k + 500), np.full((500, 4), angle), np.full((500, 3), velocity)
        )
        for k in range(0, n, 500)
    ]
    out = fed(told(layout), np.concatenate(batch))
    assert np.abs(out["dtheta"].sum(0) - n * angle).max() <= 0.51 * 2.0**-32
    assert np.abs(out["dvel"].sum(0) - n * velocity).max() <= 0.51 * 2.0 ** (-26 if layout == "fd" else -22)


@layouts
@pytest.mark.parametrize("column", ["angle", "velocity"])
@pytest.mark.parametrize("value", [1e3, -1e3, math.nan, math.inf])
def test_what_does_not_fit_the_wire_is_refused_by_its_number(layout, column, value):
    dtheta, dvel = motion(10)
    (dtheta if column == "angle" else dvel)[6, 1] = value
    with pytest.raises(HilError, match="sample 6: "):
        HeadEncoder(layout, PERIOD).samples(np.arange(10), np.arange(10), dtheta, dvel)


@layouts
def test_full_scale_arrives_unwrapped(layout):
    top = 0.5 - 2.0**-32
    fast = 32.0 - 2.0**-26 if layout == "fd" else 2.0 - 2.0**-22
    dtheta, dvel = np.array([[top, -0.5, top, -0.5]]), np.array([[fast, -fast, fast]])
    out = fed(told(layout), HeadEncoder(layout, PERIOD).samples(np.array([3]), np.array([4000]), dtheta, dvel))
    np.testing.assert_array_equal(out["dtheta"], dtheta)
    np.testing.assert_array_equal(out["dvel"], dvel)


@layouts
def test_counter_and_clock_wrap(layout):
    counters = np.arange(2**32 - 50, 2**32 + 50)
    times = 2**32 - 25 * PERIOD + (np.arange(100) + 1) * PERIOD - 3
    driver = told(layout)
    out = fed(driver, sent(layout, counters, times))
    assert len(out["sequence"]) == 100
    np.testing.assert_array_equal(np.diff(out["sequence"]), 1)
    np.testing.assert_allclose(np.diff(out["time"]), 1e-3, rtol=1e-6)
    np.testing.assert_allclose(out["step"], 1e-3, rtol=1e-12)
    assert driver.counters.lost == driver.counters.restarts == 0


@layouts
def test_a_restart_is_seen_and_its_time_does_not_go_on(layout):
    driver = told(layout)
    out = fed(driver, np.concatenate([sent(layout, range(5000, 5100)), sent(layout, range(100))]))
    assert driver.counters.restarts == 1
    assert driver.counters.lost == 0
    assert len(out["sequence"]) == 200
    assert out["sequence"][100] - out["sequence"][99] != 1
    assert out["time"][100] < out["time"][99]
    np.testing.assert_array_equal(np.diff(out["sequence"][100:]), 1)


@layouts
def test_a_gap_has_its_exact_size_and_its_sample_one_period(layout):
    driver = told(layout)
    out = fed(driver, np.concatenate([sent(layout, range(100)), sent(layout, range(350, 400))]))
    assert driver.counters.lost == 250
    assert out["sequence"][100] == 350
    assert out["time"][100] == pytest.approx(0.351)
    np.testing.assert_allclose(out["step"], 1e-3, rtol=1e-9)


@layouts
def test_other_protocol_version_and_flags(layout):
    driver = told(layout)
    out = fed(driver, sent(layout, range(20), status=0x0001))
    assert (out["validity"] == Validity.SENSOR).all()
    assert not fed(driver, sent(layout, range(20, 30), status=0x0400))["validity"].any()
    encoder = HeadEncoder(layout, PERIOD)
    protections = {codec.name: encoder._protection[codec.name] for codec in encoder._codecs}
    batch = encoder.samples(np.arange(30, 40), np.arange(31, 41) * PERIOD, *motion(10))
    for k, codec in enumerate(encoder._codecs):  # a head of version 2, with right checks
        if "protocol" in codec.columns:
            column = 3 if layout == "fd" else 7
            data = batch[k :: PARTS[layout]]["data"][:, : codec.length].copy()
            data[:, column] = 2
            protections[codec.name].protect(data, np.arange(30, 40))
            batch["data"][k :: PARTS[layout], : codec.length] = data
    assert len(fed(driver, batch)["time"]) == 0
    assert driver.counters.version_errors == 10


def test_unknown_driver_is_named():
    assert "dtg-head" in driver_names()
    with pytest.raises(HilError, match=r"'gyrotron'.*dtg-head"):
        make_driver("gyrotron")


def test_frames_that_are_not_ours():
    good = sent("fd", range(8))
    foreign, short = good.copy(), good.copy()
    foreign["can_id"][:] = [0x7FF, 0x121, 0x120 | EFF, 0x120 | RTR, 0x120 | ERR, 0x120 | EFF, 1, 0]
    short["length"][:] = [0, 1, 8, 12, 48, 63, 64, 64]
    short["flags"][6:] &= ~np.uint8(FDF)
    driver = told("fd")
    out = fed(driver, np.concatenate([foreign, short, good, frames(0)]))
    assert len(out["time"]) == 8
    assert driver.counters.foreign == 8
    assert driver.counters.short == 8
    assert driver.counters.crc_errors == driver.counters.lost == 0


@pytest.mark.parametrize("layout", ["fd", "classic"])
def test_late_and_duplicate_samples(layout):
    batches = [sent(layout, [k]) for k in range(100, 200)]
    order = [*range(10, 20), 21, 20, 21, 22, 5, 23, 22, *range(24, 100)]
    driver = told(layout)
    out = fed(driver, np.concatenate([batches[k] for k in order]))
    expected = [*range(110, 120), *range(121, 200)]
    assert out["sequence"].tolist() == expected
    count = driver.counters
    assert (count.samples, count.lost, count.late, count.restarts) == (89, 0, 1, 0)
    assert count.duplicated == 3  # 21 and 22 again, and 5 from before the first, which was never counted as lost
    assert count.samples + count.lost + count.late == 200 - 110


def test_classic_frames_of_two_samples_are_never_mixed():
    """The four-bit number comes again after 15 samples: what stayed incomplete must not be completed by another sample."""
    whole = sent("classic", range(40))
    cut = np.concatenate([whole[: 10 * 6 + 4], whole[25 * 6 :]])  # torn inside sample 10, on again with 25
    driver = told("classic")
    out = fed(driver, cut)
    assert out["sequence"].tolist() == [*range(10), *range(25, 40)]
    clean = fed(told("classic"), whole)
    np.testing.assert_array_equal(out["dtheta"], clean["dtheta"][out["sequence"]])
    np.testing.assert_array_equal(out["dvel"], clean["dvel"][out["sequence"]])
    assert driver.counters.lost == 15
    assert driver.counters.duplicated == 0


@st.composite
def faults(draw):
    """What a bad wire does to a stream: (order of frames, corrupted frames, strangers)."""
    places = st.integers(0, 119)
    lost = draw(st.sets(places, max_size=40))
    order = [k for k in range(120) if k not in lost]
    for at, hop in draw(st.lists(st.tuples(places, st.integers(1, 8)), max_size=6)):
        if at + hop < len(order):
            order.insert(at + hop, order.pop(at))
    for at, hop in draw(st.lists(st.tuples(places, st.integers(0, 8)), max_size=6)):
        if at < len(order):
            order.insert(min(at + hop, len(order)), order[at])
    corrupt = draw(st.dictionaries(places, st.tuples(st.integers(0, 63), st.integers(1, 255)), max_size=6))
    strangers = draw(st.lists(st.tuples(places, st.sampled_from([0x7FF, 0x100, 0x18FF0000 | EFF])), max_size=6))
    return order, corrupt, strangers


def spoiled(batch, fault):
    order, corrupt, strangers = fault
    bad = batch[order].copy()
    hit = 0
    for at, (byte, mask) in corrupt.items():
        if at < len(bad):
            bad["data"][at, byte % bad["length"][at]] ^= mask  # one burst of at most 8 bits: both CRCs see all of these
            hit += 1
    for at, can_id in strangers:
        row = frames(1)
        row["can_id"], row["length"] = can_id, 8
        bad = np.concatenate([bad[:at], row, bad[at:]])
    bad["time_ns"] = np.arange(len(bad))
    return bad, hit


@settings(max_examples=150)
@given(faults(), st.lists(st.integers(0, 140), max_size=6), st.booleans())
def test_fd_faults_are_accounted_exactly(fault, cuts, with_period):
    whole = sent("fd", range(1000, 1120))
    bad, hit = spoiled(whole, fault)
    slow = deepcopy(_new_encoder("fd")).slow()
    if not with_period:  # the head says its period in the middle of the stream
        bad = np.concatenate([bad[:7], slow, bad[7:]])
    driver, other = (told("fd"), told("fd")) if with_period else (deepcopy(_new_head()), deepcopy(_new_head()))
    out, again = fed(driver, bad), fed(other, bad, cuts)
    for name, values in out.items():
        np.testing.assert_array_equal(values, again[name])
    assert driver.counters == other.counters
    count = driver.counters
    assert count.crc_errors == hit
    assert count.foreign == len(fault[2])
    assert count.short == count.version_errors == count.restarts == 0
    sequence = out["sequence"]
    assert (np.diff(sequence) > 0).all()
    assert count.samples == len(sequence)
    if with_period and len(sequence):
        assert count.samples + count.lost + count.late == sequence[-1] - sequence[0] + 1
    frames_in = len(bad) - len(fault[2]) - (0 if with_period else len(slow))
    unread = 0 if with_period or frames_in == hit else frames_in - hit - count.samples - count.duplicated - count.late
    assert unread in (0, 1)  # without a period the first sample only sets the clock
    assert count.samples + count.duplicated + count.late + unread == frames_in - hit
    clean = fed(told("fd"), whole)
    np.testing.assert_array_equal(out["dtheta"], clean["dtheta"][sequence - 1000])
    np.testing.assert_array_equal(out["dvel"], clean["dvel"][sequence - 1000])
    np.testing.assert_allclose(out["time"], (sequence + 1) * 1e-3, rtol=1e-12)


@settings(max_examples=100)
@given(faults(), st.lists(st.integers(0, 140), max_size=6))
def test_classic_faults_never_make_a_wrong_sample(fault, cuts):
    whole = sent("classic", range(1000, 1020))
    bad, hit = spoiled(whole, fault)
    driver, other = told("classic"), told("classic")
    out, again = fed(driver, bad), fed(other, bad, cuts)
    for name, values in out.items():
        np.testing.assert_array_equal(values, again[name])
    assert driver.counters == other.counters
    count, sequence = driver.counters, out["sequence"]
    assert count.crc_errors == hit
    assert (np.diff(sequence) > 0).all()
    if len(sequence):
        assert count.samples + count.lost + count.late == sequence[-1] - sequence[0] + 1
    clean = fed(told("classic"), whole)
    np.testing.assert_array_equal(out["dtheta"], clean["dtheta"][sequence - 1000])
    np.testing.assert_array_equal(out["dvel"], clean["dvel"][sequence - 1000])


@settings(max_examples=50)
@given(
    st.binary(max_size=2000),
    st.lists(st.sampled_from([0x120, 0x130, 0x135, 0x140, 0x141, 0x144]), min_size=1, max_size=30),
)
def test_garbage_is_counted_and_never_raises(noise, ids):
    batch = frames(len(ids))
    batch["can_id"] = ids
    data = batch["data"].reshape(-1)
    data[: len(noise)] = np.frombuffer(noise, np.uint8)[: len(data)]
    is_sample = batch["can_id"] == 0x120
    batch["length"], batch["flags"] = np.where(is_sample, 64, 8), np.where(is_sample, FDF, 0)
    driver = told("fd")
    driver.decode(batch)
    assert driver.counters.frames == len(ids) + 5
    assert driver.counters.short == driver.counters.foreign == 0


@layouts
def test_temperatures_hold_for_the_samples_that_follow_them(layout):
    first, slow, rest = sent(layout, range(3)), deepcopy(_new_encoder(layout)).slow(), sent(layout, range(3, 6))
    driver = deepcopy(_new_head())
    driver.decode(deepcopy(_new_encoder(layout)).slow()[1:2])  # the period, and nothing else
    rows = copied(driver.decode(np.concatenate([first, slow, rest])))
    assert np.isnan(rows.temperature[:3]).all()
    assert rows.temperature[3:].tolist() == [[40.0, 40.0, 35.0]] * 3
    assert driver.identity()["temperature_acc"] == 35.0


@layouts
def test_samples_beside_slow_frames_take_the_kernels_of_those_alone(layout):
    """A first one in the middle of a run would hold the loop up while it is compiled."""
    driver, slow = told(layout), deepcopy(_new_encoder(layout)).slow()
    driver.decode(sent(layout, range(3)))
    ways = {kernel: len(kernel.signatures) for kernel in (_track, _fill)}
    assert len(driver.decode(np.concatenate([slow, sent(layout, range(3, 6))]))) == 3
    assert {kernel: len(kernel.signatures) for kernel in ways} == ways
