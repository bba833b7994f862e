"""The whole chain against emulated boards: increments as the board rounds them, frames, driver, alignment, navigation."""

import math
from itertools import pairwise

import numpy as np
import pytest

from drivers import make_emulator
from drivers.can.unix_bus import UnixPort
from hil.bridge import EVENTS, Loop, LoopOrder, Outlets
from hil.monitor import Monitor
from hil.monitor_view import headline
from hil.scenario import Scenario
from hil.world.head import SimulatedHead
from nav.errors import HilError
from nav.increments import ImuIncrements
from nav.rotation import euler_from_quaternion
from nav.state import NAV_STATE, Mode

ALIGN_S, REST_S, END_S = 5.0, 8.0, 28.0
BOARDS = {  # sample rate, one step of the rates and of the specific force
    "sbg": (200.0, 1e-3, 1e-2),
    "xsens-can": (400.0, 2.0**-9, 2.0**-17 * 400.0),
    "j1939-imu": (100.0, math.radians(1.0 / 128.0), 1e-2),
}
boards = pytest.mark.parametrize("driver", BOARDS)


def scenario(driver, **head):
    return Scenario.model_validate(
        {
            "bus": "unix:none",
            "driver": driver,
            "duration_s": END_S,
            "head": {"rate_hz": BOARDS[driver][0], **head},
            "motion": {
                "rest_s": REST_S,
                "ramp_s": 4.0,
                "heading": {"offset": 40.0, "rate": 3.0},
                "roll": {"sines": [{"amplitude": 10.0, "period_s": 7.0}]},
                "north": {"rate": 10.0},
            },
            "navigation": {"alignment": "level", "align_s": ALIGN_S, "start": {"heading_deg": 40.0}},
        }
    )


def frames_of(chosen):
    samples = round(chosen.duration_s * chosen.head.rate_hz)
    return np.concatenate([part for _, *parts in SimulatedHead(chosen).chunks(samples) for part in parts])


def test_a_message_that_is_switched_off_is_told():
    """By the run, to ground stations too, and once; and by the monitor, which looks for a board."""
    chosen = scenario("sbg")
    batch = frames_of(chosen)
    batch = batch[batch["can_id"] != 0x122]
    outlets = Outlets.make(recording=False, readers=1)
    loop, monitor = Loop(LoopOrder(chosen, paced=False), outlets), Monitor(None)
    for part in np.array_split(batch, 50):
        loop.take(part)
        monitor.take(part)
    events = np.zeros(256, EVENTS)
    told, _ = outlets.events.pull(events, 0)
    said = [(row["severity"], row["text"], row["station"]) for row in events[:told]]
    assert said == [
        (b"warning", b"IMU_GYRO does not come: switch it on", True),
        (b"warning", b"short: frames have a wrong length, lack a value or make no sample", False),
    ]
    report = monitor.report(0)
    assert report["lacking"] == {"sbg": "IMU_GYRO does not come: switch it on"}
    assert "IMU_GYRO does not come" in headline(report)


def run(chosen, batch, cuts=()):
    order = LoopOrder(chosen, paced=False, own_world=True)
    loop = Loop(order, Outlets.make(recording=False, readers=1))
    for start, stop in pairwise([0, *cuts, len(batch)]):
        loop.take(batch[start:stop])
    return loop.result()


@boards
def test_an_emulated_board_aligns_and_navigates(driver):
    """Attitude errs by no more than half a step of every axis all the way, and the tilt of the start."""
    chosen = scenario(driver)
    batch = frames_of(chosen)
    result = run(chosen, batch)
    assert result["mode"] == "navigate"
    _, rate_step, force_step = BOARDS[driver]
    moving = END_S - ALIGN_S
    bound = math.sqrt(3.0) * 0.5 * rate_step * moving + math.sqrt(2.0) * 0.5 * force_step / 9.81
    assert math.radians(result["error"]["attitude_deg"]["max"]) < bound
    # ... and velocity by gravity on such a tilt, and half a step of the force
    assert result["error"]["velocity_ms"]["max"] < 9.81 * bound * moving + force_step * moving
    again = run(chosen, batch, cuts=sorted(np.random.default_rng(4).integers(0, len(batch), 40).tolist()))
    assert again["navigation_digest"] == result["navigation_digest"]


def test_a_board_that_stands_turned_in_the_vehicle():
    """`head.mounting_deg` turns a board's axes into those of the body, as it does the head's."""
    straight, turned = (scenario("xsens-can", mounting_deg=angles) for angles in ((0, 0, 0), (90, 0, 180)))
    expected, found = run(straight, frames_of(straight)), run(turned, frames_of(turned))
    assert found["mode"] == "navigate"
    for name in ("attitude_deg", "velocity_ms"):
        assert found["error"][name]["max"] == pytest.approx(expected["error"][name]["max"], abs=0.2)


def test_the_gyro_bias_of_a_board_at_rest_is_captured_at_the_start():
    """What it turns by at rest, but for the Earth's rate, is bias (whole steps of the wire here), taken off from then on."""
    chosen, bias_deg_s = scenario("j1939-imu").with_changes(duration_s=20.0), np.array([0.5, -1.25, 2.0])
    imu = ImuIncrements.empty(2000)
    imu.step[:], imu.time[:], imu.sequence[:] = 0.01, 0.01 * np.arange(1, 2001), np.arange(2000)
    imu.dtheta[:], imu.dvel[:, 2] = 0.01 * np.radians(bias_deg_s), -0.0981
    emulator = make_emulator("j1939-imu", 10_000)
    outlets = Outlets.make(recording=False, readers=1)
    loop = Loop(LoopOrder(chosen, paced=False), outlets)
    loop.take(np.concatenate([emulator.slow(), emulator.samples(imu)]))
    north, heading = (
        15.041067 * math.cos(math.radians(50.0)),
        math.radians(40.0),
    )  # deg/h, of a level board at 50 deg north
    earth = [north * math.cos(heading), -north * math.sin(heading), -15.041067 * math.sin(math.radians(50.0))]
    np.testing.assert_allclose(loop.result()["gyro_bias_deg_h"], 3600.0 * bias_deg_s - earth, atol=1e-3)
    rows = np.zeros(1, NAV_STATE)
    assert outlets.states.latest(rows)
    assert rows["mode"][0] == Mode.NAVIGATE
    turned_deg = np.degrees(np.abs(euler_from_quaternion(rows["q_nb"][0]) - np.radians([40.0, 0.0, 0.0])))
    assert turned_deg.max() < 0.1, "15 s at 2 deg/s would be 30 deg"


def test_instruments_of_the_dtg_head_are_not_those_of_a_board():
    with pytest.raises(HilError, match="an emulated sbg has ideal instruments"):
        SimulatedHead(scenario("sbg", instruments="dtg"))


def test_a_lossless_sender_keeps_simulated_time():
    chosen = scenario("j1939-imu")
    (_, _, batch), *_ = SimulatedHead(chosen).chunks(10)
    listener, sender = UnixPort("board-time"), UnixPort("board-time", listen=False, lossless=True)
    try:
        got = np.zeros(1024, batch.dtype)
        sender.send(batch)
        n = listener.receive(got, 2.0)
        np.testing.assert_array_equal(got["time_ns"][:n], batch["time_ns"])
        assert n == 20
    finally:
        sender.close()
        listener.close()
