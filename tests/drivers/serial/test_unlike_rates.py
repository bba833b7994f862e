"""Boards that send angle increments, velocity increments, rates and forces at unlike rates: no turn is lost unsaid."""

import math
import struct

import pytest
from pty_board import decoded

from drivers.serial import mip, xbus
from drivers.serial.chunks import to_chunks
from drivers.serial.driver import SerialDriver
from drivers.serial.mip import microstrain_mip
from drivers.serial.xbus import xsens_xbus
from drivers.serial.xbus_emulator import field
from nav.earth import STANDARD_GRAVITY

STEP_S, YAW_RATE = 0.0025, math.radians(10.0)
boards = pytest.mark.parametrize("driver", [xsens_xbus(), microstrain_mip()], ids=["xsens-xbus", "microstrain-mip"])


def packet(driver: SerialDriver, k: int, has: str) -> bytes:
    """Sample `k` of a level board that turns: `has` names angle increment (q), velocity increment (v), rate (r), force (a)."""
    angle, push = YAW_RATE * STEP_S, STANDARD_GRAVITY * STEP_S
    if isinstance(driver.board, mip.Mip):
        values = {
            "q": (mip.DELTA_THETA, (0.0, 0.0, angle)),
            "v": (mip.DELTA_VELOCITY, (0.0, 0.0, -STEP_S)),
            "r": (mip.RATE, (0.0, 0.0, YAW_RATE)),
            "a": (mip.ACCELERATION, (0.0, 0.0, -1.0)),
        }
        parts = [(values[name][0], struct.pack(">3f", *values[name][1])) for name in has if name in values]
        time = struct.pack(">Q", round(1e9 * k * STEP_S))
        return mip.packet_of(mip.SENSOR, [(mip.REFERENCE_TIME, time), *parts])
    flu = {
        "q": (xbus.DELTA_Q, struct.pack(">4f", math.cos(angle / 2), 0.0, 0.0, -math.sin(angle / 2))),
        "v": (xbus.DELTA_V, struct.pack(">3f", 0.0, 0.0, push)),
        "r": (xbus.RATE, struct.pack(">3f", 0.0, 0.0, -YAW_RATE)),
        "a": (xbus.ACCELERATION, struct.pack(">3f", 0.0, 0.0, STANDARD_GRAVITY)),
    }
    data = field(xbus.COUNTER, struct.pack(">H", k)) + field(xbus.TIME_FINE, struct.pack(">I", 25 * k))
    return xbus.message(xbus.MTDATA2, data + b"".join(field(*flu[name]) for name in has if name in flu))


def sent(make: SerialDriver, cycle: list[str], n: int = 400) -> tuple[SerialDriver, float, int]:
    """A fresh driver of that make, the yaw (rad) of what it makes of `cycle`, and how many samples that is."""
    driver = SerialDriver(type(make.board)())
    got = decoded(driver, to_chunks(b"".join(packet(driver, k, cycle[k % len(cycle)]) for k in range(n))))
    return driver, float(got.dtheta[:, 2].sum()), len(got)


@boards
@pytest.mark.parametrize("lone", ["q", "v", "r", "a", "qa", "vr"])
def test_a_packet_with_half_of_a_pair_is_short(driver: SerialDriver, lone: str) -> None:
    assert driver.board.read(packet(driver, 1, lone)) == "short"


@boards
def test_slow_outputs_are_foreign(driver: SerialDriver) -> None:
    assert driver.board.read(packet(driver, 1, "")) == "foreign"


@boards
@pytest.mark.parametrize("cycle", [["qv", "q"], ["qv", "v", "v", "v"], ["qv", "q", ""]])
def test_increments_over_unlike_times_make_no_sample(driver: SerialDriver, cycle: list[str]) -> None:
    """What of two increments comes seldom covers a longer time than the other: together they are no step."""
    made, _, n = sent(driver, cycle)
    slow = sum(not has for has in cycle) * 400 // len(cycle)
    assert n == 0
    assert made.counters.foreign <= slow + 1
    assert made.counters.short >= 399 - slow - 1


@boards
@pytest.mark.parametrize("cycle", [["qvra", "qra"], ["qvra", "ra", "vra", "ra"]])
def test_rates_beside_increments_at_unlike_rates_are_taken(driver: SerialDriver, cycle: list[str]) -> None:
    made, yaw, n = sent(driver, cycle)
    assert n == 399
    assert yaw == pytest.approx(399 * YAW_RATE * STEP_S, rel=1e-5)
    assert made.counters.short == made.counters.foreign == 0


@boards
def test_increments_that_come_together_again_are_taken(driver: SerialDriver) -> None:
    made, yaw, n = sent(driver, ["qv"] * 100 + ["q"] + ["qv"] * 299)
    assert n == 397  # the first sets the clock; the lone one and the next are no steps
    assert yaw == pytest.approx(397 * YAW_RATE * STEP_S, rel=1e-5)
    assert (made.counters.short, made.counters.lost) == (2, 2)
