"""The time of a fix: from UTC of the receiver and its arrival to device time, whatever came late, and whoever set a clock."""

import math

import numpy as np
import pytest

from drivers.can.aiding import AidingDecoder
from drivers.can.frames import FRAME, frames
from drivers.serial.chunks import to_chunks
from drivers.serial.fixes import Fix
from drivers.serial.nmea_emulator import NmeaEmulator
from drivers.serial.ubx_emulator import GPS_EPOCH, UbxEmulator
from hil.receiver import SETTLE_NS, FixClock, Relay, device_s
from hil.ring import Ring
from hil.scenario import ReceiverConfig
from hil.stats import NO_BOUND, Stats
from nav.aiding import AIDING, AT_PORTS, Kind, aiding_rows

S = 1_000_000_000
EPOCH_NS = 1_800_000_000 * S
"""Host clock when the device's clock is zero."""


def fix(utc_s: float | None, arrival_ns: int) -> Fix:
    return Fix(arrival_ns, utc_s, np.zeros(0, AIDING))


def loop_clock(bound_ns: int = 1000) -> Stats:
    """What the loop says of a device whose clock was zero at `EPOCH_NS`."""
    stats = Stats()
    stats["clock_offset_ns"], stats["clock_bound_ns"] = EPOCH_NS, bound_ns
    return stats


def test_lateness_beyond_the_fastest_is_taken_off() -> None:
    """Fixes that come 50 ms after they were true, and up to 300 ms late: the host clock is 7 s ahead of UTC."""
    clock, late = FixClock(), np.random.default_rng(3).uniform(0.0, 0.3, 100)
    late[5] = 0.0
    arrivals = []
    for k in range(100):
        utc_s = 1.8e9 + 0.2 * k
        arrival_ns = round((utc_s + 7.05 + late[k]) * S)
        arrivals.append(1e-9 * clock.arrival_ns(fix(utc_s, arrival_ns)) - utc_s)
    # What is left is the drift that so few fixes leave open
    assert np.abs(np.array(arrivals[5:]) - 7.05).max() < 0.05
    assert clock.offset_s == pytest.approx(7.05, abs=1e-5)
    assert clock.late_s == pytest.approx(late[6:].max(), abs=0.01)
    assert clock.steps == 0


def test_a_clock_that_is_set_settles_anew() -> None:
    clock = FixClock()
    first, second = fix(1.8e9, EPOCH_NS), fix(1.8e9 + 3.0, EPOCH_NS + 3 * S)
    assert (clock.arrival_ns(first), clock.settled(first)) == (EPOCH_NS, False)
    assert (clock.arrival_ns(second), clock.settled(second)) == (EPOCH_NS + 3 * S, True)
    jumped = fix(1.8e9 + 4.0 - 18.0, EPOCH_NS + 4 * S)  # leap seconds are known now
    assert (clock.arrival_ns(jumped), clock.settled(jumped)) == (EPOCH_NS + 4 * S, False)
    assert clock.steps == 1
    assert clock.offset_s == pytest.approx(18.0, abs=1e-5)
    assert clock.settled(fix(None, EPOCH_NS))  # a receiver without date has no clock


def test_device_time_is_that_of_the_loops_fit() -> None:
    stats = loop_clock()
    assert device_s(stats, EPOCH_NS + 5 * S) == pytest.approx(5.0, abs=1e-6)
    stats["clock_offset_ns"] = EPOCH_NS + 8 * S  # started anew
    assert device_s(stats, EPOCH_NS + 9 * S) == pytest.approx(1.0, abs=1e-6)
    assert math.isnan(device_s(loop_clock(NO_BOUND), EPOCH_NS))
    assert math.isnan(device_s(Stats(), EPOCH_NS))


def taken(ring: Ring) -> np.ndarray:
    batch = frames(64)
    copied, _ = ring.pull(batch, 0)
    rows, _ = AidingDecoder().decode(batch[:copied], 10.0)
    return rows


@pytest.mark.parametrize("speaks", ["ubx", "nmea"])
def test_a_fix_reaches_the_loop_with_the_time_at_which_it_was_true(speaks: str) -> None:
    """Fixes of 0.2 s k come 80 ms after; the delay of the scenario takes that off."""
    utc = GPS_EPOCH.fromtimestamp(1e-9 * EPOCH_NS, GPS_EPOCH.tzinfo)
    emulator = UbxEmulator(utc) if speaks == "ubx" else NmeaEmulator(utc, lambda _lat, _lon: 20.0)
    ring = Ring(FRAME, 256, 0)
    relay = Relay(ReceiverConfig(port="serial:/dev/ttyACM0:9600", delay_s=0.08), 2, loop_clock(), ring)
    for k in range(1, 31):
        rows = aiding_rows([0.2 * k], Kind.GNSS, [0.8, 0.6, 100.0 + k, 1.0, 2.0, 0.0], [1.0] * 6)
        arrival_ns = EPOCH_NS + round((0.2 * k + 0.08) * S)
        relay.take(to_chunks(emulator.packets(rows)[0], arrival_ns))
    rows = taken(ring)
    assert relay.receiver.fixes == 30
    settling = relay.receiver.refused["clock settles"]
    assert settling == pytest.approx(SETTLE_NS / (0.2 * S), abs=1)
    assert relay.sent == len(rows) == 30 - settling
    assert set(rows["source"].tolist()) == {AT_PORTS + 2}
    np.testing.assert_allclose(rows["time"], 0.2 * np.round(rows["value"][:, 2] - 100.0), atol=2e-3)


def test_receivers_count_for_themselves() -> None:
    """Two receivers with the same counters, on one ring of frames: nothing is lost and nothing comes twice."""
    decoder, batches = AidingDecoder(), []
    for number in range(2):
        ring = Ring(FRAME, 256, 0)
        relay = Relay(ReceiverConfig(port="serial:/dev/x:9600"), number, loop_clock(), ring)
        relay._send(aiding_rows([1.0, 2.0, 3.0], Kind.HEADING, [[0.1]] * 3, [0.01], AT_PORTS + number))
        batch = frames(3)
        ring.pull(batch, 0)
        batches.append(batch)
    for k in range(3):
        for batch in batches:
            decoder.decode(batch[k : k + 1], 1.0)
    assert decoder.heard[Kind.HEADING] == 6
    assert (decoder.counters.lost, decoder.counters.duplicated) == (0, 0)


def test_what_does_not_fit_the_wire_is_counted() -> None:
    ring = Ring(FRAME, 256, 0)
    relay = Relay(ReceiverConfig(port="serial:/dev/x:9600"), 0, loop_clock(), ring)
    relay._send(aiding_rows([1.0], Kind.GNSS, [0.1, 0.1, 1e7, 0.0, 0.0, 0.0], [1.0] * 6))
    assert (relay.sent, ring.count) == (0, 0)
    assert dict(relay.receiver.refused) == {"out of range": 1}
