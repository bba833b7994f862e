"""RawIMU over DroneCAN: our transfers by the dronecan library and the library's by us, loss and damage to the transfer."""

import contextlib
import math
import time
from itertools import pairwise

import dronecan
import numpy as np
import pytest
from dronecan.transport import Transfer
from hypothesis import given, settings
from hypothesis import strategies as st

from drivers.can.bus import open_port
from drivers.can.dronecan_imu import BASE_CRC, DronecanImu
from drivers.can.dronecan_imu_emulator import DronecanEmulator
from drivers.can.frames import BRS, EFF, FDF, frames
from drivers.can.samples import LEARN, LEARN_LONG
from nav.errors import HilError
from nav.increments import ImuIncrements

PERIOD_S, SET_CLOCK, FRAMES = 0.005, LEARN + 1, 7
RawImu = dronecan.uavcan.equipment.ahrs.RawIMU


def smooth(n, first=0):
    """Exact increments of a shaken vehicle."""
    edges = PERIOD_S * np.arange(first, first + n + 1)
    w, size = 2.0 * np.pi * np.array([0.5, 0.4, 0.3, 0.5, 0.4, 0.3]), np.array([0.3, 0.2, 0.4, 2.0, 1.0, 1.5])
    mean = np.array([0.02, -0.03, 0.05, 0.3, -0.2, -9.81])
    change = np.diff(edges[:, None] * mean - size / w * np.cos(edges[:, None] * w), axis=0)
    ones = np.full(n, PERIOD_S)
    return ImuIncrements(
        edges[1:], ones, change[:, :3], change[:, 3:], np.zeros(n, np.int64), np.arange(first, first + n)
    )


def sent(n, **options):
    return DronecanEmulator(round(1e6 * PERIOD_S), **options).samples(smooth(n))


def fed(driver, batch, cuts=()):
    """All samples, as increments side by side (n, 6), their times and arrivals."""
    edges, parts = [0, *sorted(min(cut, len(batch)) for cut in cuts), len(batch)], []
    for start, stop in pairwise(edges):
        imu = driver.decode(batch[start:stop])
        parts.append((np.hstack([imu.dtheta, imu.dvel]).copy(), imu.time.copy(), driver.arrivals().copy()[: len(imu)]))
    return tuple(np.concatenate(part) for part in zip(*parts, strict=True))


def faults(driver):
    said = driver.counters.as_dict()
    return {name: said[name] for name in said if said[name] and name not in {"frames", "samples"}}


def test_the_signature_and_every_field_are_those_of_the_library():
    assert dronecan.transport.get_dronecan_data_type(RawImu()).base_crc == BASE_CRC
    truth, batch = smooth(40), sent(40)
    for k, rows in enumerate(batch.reshape(40, FRAMES)):
        transfer = Transfer()
        transfer.from_frames(
            [dronecan.transport.Frame(int(row["can_id"]) & ~EFF, bytes(row["data"][:8])) for row in rows]
        )
        said = transfer.payload
        assert (transfer.source_node_id, transfer.transfer_id) == (42, k % 32)
        assert said.timestamp.usec == 5000 * (k + 1)
        assert said.integration_interval == pytest.approx(PERIOD_S, rel=1e-7)
        np.testing.assert_allclose(list(said.rate_gyro_integral), truth.dtheta[k], rtol=1e-7, atol=1e-12)
        np.testing.assert_allclose(list(said.accelerometer_integral), truth.dvel[k], rtol=1e-7, atol=1e-12)
        np.testing.assert_allclose(list(said.accelerometer_latest), truth.dvel[k] / PERIOD_S, atol=0.1)


@pytest.mark.parametrize("canfd", [False, True])
@pytest.mark.parametrize("covariance", [0, 6, 36])
def test_transfers_of_the_library_are_read(canfd, covariance):
    """Covariances of any length behind the values, in classic frames and in those of CAN FD."""
    truth, rows = smooth(30), []
    for k in range(30):
        said = RawImu(integration_interval=PERIOD_S, covariance=[0.5] * covariance)
        said.timestamp.usec = 5000 * (k + 1)
        said.rate_gyro_integral, said.accelerometer_integral = truth.dtheta[k].tolist(), truth.dvel[k].tolist()
        transfer = Transfer(payload=said, source_node_id=7, transfer_id=k % 32, transfer_priority=8, canfd=canfd)
        for part in transfer.to_frames():
            row = frames(1)
            row["can_id"], row["length"], row["flags"] = part.message_id | EFF, len(part.bytes), (FDF | BRS) * canfd
            row["data"][0, : len(part.bytes)] = part.bytes
            rows.append(row)
    driver = DronecanImu("7")
    out, times, _ = fed(driver, np.concatenate(rows))
    assert faults(driver) == {}
    np.testing.assert_allclose(times, truth.time[SET_CLOCK:], atol=1e-9)
    np.testing.assert_allclose(out, np.hstack([truth.dtheta, truth.dvel])[SET_CLOCK:], rtol=1e-6, atol=1e-9)


def test_integrals_lose_nothing_and_latest_values_have_eleven_bits():
    """Single precision: the Earth's rate is far above its rounding. Half precision: half a step of 2^-11 of the value."""
    truth = smooth(200)
    exact = np.hstack([truth.dtheta, truth.dvel])[SET_CLOCK:]
    whole, _, _ = fed(DronecanImu(), sent(200))
    coarse, _, _ = fed(DronecanImu(), sent(200, integrals=False))
    assert np.abs(whole - exact).max() < 2.0**-24 * np.abs(exact).max() * 1.01
    assert 1e-5 < np.abs(coarse - exact)[:, 5].max() <= 2.0**-11 * 16.0 * PERIOD_S
    earth = math.radians(15.0 / 3600.0)
    assert np.abs(whole - exact)[:, :3].max() / PERIOD_S < 0.01 * earth


def test_without_stamps_time_goes_by_the_arrival():
    batch = sent(100, stamped=False)
    batch["time_ns"] += np.random.default_rng(1).integers(0, 400_000, len(batch))
    driver = DronecanImu()
    out, times, arrivals = fed(driver, batch)
    assert driver.period_s == pytest.approx(PERIOD_S)
    np.testing.assert_allclose(np.diff(times), PERIOD_S, atol=1e-9)
    np.testing.assert_array_equal(arrivals, batch["time_ns"][FRAMES - 1 :: FRAMES][SET_CLOCK:])
    assert len(out) == 100 - SET_CLOCK
    assert driver.identity() == {"node": 42, "time_stamps": False}


@pytest.mark.parametrize("rate_hz", [300.0, 400.0, 600.0])
@pytest.mark.parametrize("integrals", [False, True])
def test_without_stamps_any_rate_is_found(rate_hz, integrals):
    """An interval that the node sends is the period at once; else it is what the arrivals say, whole milliseconds or not."""
    n = 400
    imu = smooth(n)
    imu.step[:] = 1.0 / rate_hz
    batch = DronecanEmulator(5000, stamped=False, integrals=integrals).samples(imu).reshape(n, FRAMES)
    batch["time_ns"] = np.rint(1e9 / rate_hz * np.arange(n))[:, None] + 1000 * np.arange(FRAMES)
    driver = DronecanImu()
    out, times, _ = fed(driver, batch.reshape(-1), range(0, FRAMES * n, FRAMES))
    assert faults(driver) == {}
    assert len(out) == (n - SET_CLOCK if integrals else n - LEARN_LONG - 1)
    np.testing.assert_allclose(np.diff(times), 1.0 / rate_hz, rtol=1e-3)
    if integrals:
        np.testing.assert_allclose(out[:, :3], imu.dtheta[SET_CLOCK:], rtol=1e-6, atol=1e-9)


@given(st.integers(SET_CLOCK, 78), st.integers(0, FRAMES - 1), st.lists(st.integers(0, 560), max_size=8))
@settings(max_examples=40, deadline=None)
def test_a_lost_frame_costs_its_sample_and_cuts_do_not_matter(sample, part, cuts):
    batch = np.delete(sent(80), FRAMES * sample + part)
    driver = DronecanImu()
    out, times, _ = fed(driver, batch, cuts)
    kept = [k for k in range(SET_CLOCK, 80) if k != sample]
    assert np.rint(times / PERIOD_S).astype(int).tolist() == [k + 1 for k in kept]
    assert driver.counters.lost == 1
    assert driver.counters.short >= 1
    np.testing.assert_allclose(out, np.hstack([smooth(80).dtheta, smooth(80).dvel])[kept], rtol=1e-6, atol=1e-9)


@given(st.integers(SET_CLOCK, 78), st.integers(0, FRAMES - 1), st.integers(0, 6), st.integers(0, 7))
@settings(max_examples=60, deadline=None)
def test_a_wrong_bit_is_seen_by_the_check(sample, part, byte, bit):
    batch = sent(80)
    batch["data"][FRAMES * sample + part, byte] ^= 1 << bit
    driver = DronecanImu()
    _, times, _ = fed(driver, batch)
    assert driver.counters.crc_errors == 1
    assert driver.counters.lost == 1
    assert sample + 1 not in np.rint(times / PERIOD_S).astype(int)


@given(st.lists(st.binary(max_size=8), max_size=60))
@settings(max_examples=100, deadline=None)
def test_any_frames_are_survived(payloads):
    batch = frames(len(payloads))
    batch["can_id"] = sent(1)["can_id"][0]
    for row, data in zip(batch, payloads, strict=True):
        row["length"] = len(data)
        row["data"][: len(data)] = np.frombuffer(data, np.uint8)
    driver = DronecanImu()
    driver.decode(batch)
    out, _, _ = fed(driver, sent(40))
    assert np.isfinite(out).all()
    assert len(out) >= 40 - SET_CLOCK - 1


def test_other_nodes_and_messages_are_foreign():
    ours, others = sent(40), sent(40, node=43)
    mixed = np.stack([ours, others], axis=1).reshape(-1)
    driver = DronecanImu("42")
    out, _, _ = fed(driver, mixed)
    assert (len(out), driver.counters.foreign) == (40 - SET_CLOCK, len(others))
    for option in ("0", "128", "x", "-1"):
        with pytest.raises(HilError, match="node id from 1 to 127"):
            DronecanImu(option)


def test_over_a_unix_bus():
    batch, driver = sent(60), DronecanImu("42")
    with (
        contextlib.closing(open_port("unix:dronecan-test")) as listener,
        contextlib.closing(open_port("unix:dronecan-test", listen=False)) as sender,
    ):
        room, parts, deadline = frames(1024), [], time.monotonic() + 10.0
        sender.send(batch)
        while sum(map(len, parts)) < len(batch) and time.monotonic() < deadline:
            parts.append(room[: listener.receive(room, 0.1)].copy())
    out, _, _ = fed(driver, np.concatenate(parts))
    assert len(out) == 60 - SET_CLOCK
    assert faults(driver) == {}
