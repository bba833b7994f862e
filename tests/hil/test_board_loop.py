"""The whole chain against emulated boards: increments as the board rounds them, frames, driver, alignment, navigation."""

import math
from itertools import pairwise

import numpy as np
import pytest

from drivers.can.unix_bus import UnixPort
from hil.bridge import Loop, LoopOrder, Outlets
from hil.scenario import Scenario
from hil.world.head import SimulatedHead
from nav.errors import HilError

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
