"""The head by its physics: what it sends, that the core gets the motion back, and how its failures reach the user."""

import math

import numpy as np
import pytest

from drivers.can.dtg_head import DtgHead
from hil.bridge import EVENTS, Loop, LoopOrder, Outlets
from hil.scenario import Scenario
from hil.world.head import SimulatedHead
from hil.world.instruments import head_model, instruments
from hil.world.motion import Motion
from nav.increments import HeadIncrements
from nav.instruments.head import HeadCombiner
from nav.navigator import Navigator, Settings
from nav.rotation import attitude_error, euler_from_quaternion
from nav.state import NAV_STATE, Health

STEP = 1e-3
WILD = {
    "heading": {"rate": 5.0, "sines": [{"amplitude": 4.0, "period_s": 1.7}]},
    "pitch": {"sines": [{"amplitude": 3.0, "period_s": 1.1}]},
    "roll": {"sines": [{"amplitude": 8.0, "period_s": 0.9, "phase_deg": 90}]},
    "north": {"sines": [{"amplitude": 5.0, "period_s": 4.0}]},
}


def scenario(motion=None, **head):
    motion = {"rest_s": 0.5, "ramp_s": 1.0, **(WILD if motion is None else motion)}
    return Scenario.model_validate({"seed": 3, "motion": motion, "head": {"instruments": "dtg", **head}})


def sensed(choice, samples, step=STEP):
    """A run of the head as it reaches the core."""
    source = instruments(choice, step)
    batch = HeadIncrements.empty(samples)
    got = source.sense(0, samples)
    batch.sequence[:] = np.arange(samples)
    batch.time[:], batch.step[:] = step * np.arange(1, samples + 1), step
    batch.dtheta[:], batch.dvel[:], batch.status[:] = got.dtheta, got.dvel, got.status
    batch.rotor[:] = np.nan if got.rotor is None else got.rotor
    return batch


@pytest.mark.parametrize("kind", ["ideal", "dtg"])
def test_how_a_run_is_cut_does_not_matter(kind):
    faults = [{"axis": "g1x", "kind": "noise", "at_s": 0.4}, {"axis": "ay", "kind": "stuck", "at_s": 0.5}]
    choice = scenario(grade="dtg", instruments=kind, faults=faults)
    whole, cut, first = instruments(choice, STEP).sense(0, 1000), instruments(choice, STEP), 0
    for count in (1, 99, 400, 500):
        part = cut.sense(first, count)
        np.testing.assert_array_equal(part.dtheta, whole.dtheta[first : first + count])
        np.testing.assert_array_equal(part.dvel, whole.dvel[first : first + count])
        if whole.rotor is not None:
            np.testing.assert_array_equal(part.rotor, whole.rotor[first : first + count])
        first += count


@pytest.mark.parametrize("skew", [0.0, 45.0])
@pytest.mark.parametrize(
    "place", [{}, {"lever_arm_m": [1.0, -0.4, 0.3]}, {"mounting_deg": [30, 10, -20], "lever_arm_m": [0.5, 0.2, -0.1]}]
)
def test_the_core_gets_the_motion_back(skew, place):
    """Without errors: lag and size effect come off; the integrals of what is left are those of the ideal head."""
    choice = scenario(skew_deg=skew, **place)
    got = HeadCombiner(head_model(choice.head)).combine(sensed(choice, 6000))
    ideal = scenario(skew_deg=skew, **place, instruments="ideal")
    true = HeadCombiner(head_model(ideal.head)).combine(sensed(ideal, 6000))
    angle = np.cumsum(got.dtheta - true.dtheta, axis=0)
    assert np.abs(angle).max() < 5e-7
    velocity = np.cumsum(got.dvel - true.dvel, axis=0)
    # The pendulums answer within half a millisecond of what they feel; their loops lose no velocity.
    assert np.abs(velocity - velocity[400]).max() < 1e-2
    assert np.abs(velocity[-1000:].mean(axis=0) - velocity[400:500].mean(axis=0)).max() < 5e-4


def test_what_is_drawn_depends_on_the_seed():
    one, same = (instruments(scenario(grade="mems"), STEP).sense(0, 50) for _ in range(2))
    np.testing.assert_array_equal(one.dtheta, same.dtheta)
    other = instruments(scenario(grade="mems").model_copy(update={"seed": 4}), STEP).sense(0, 50)
    assert (one.dtheta != other.dtheta).all()
    assert (one.dvel != other.dvel).all()


def test_the_noise_of_the_grade_comes_through_the_chain():
    """At rest the compensated increments scatter by the grade's random walk, however much the rotor smooths: x and z by one
    axis, y by two whose shares go as 1 : (bias^2 + flicker^2) / (bias^2 + flicker^2 + drift by gravity^2).
    """
    choice = scenario(motion={}, grade="tactical")
    imu = HeadCombiner(head_model(choice.head)).combine(sensed(choice, 20_000))
    arw = math.radians(0.05) / 60.0 * math.sqrt(STEP)
    scatter = np.diff(imu.dtheta[1000:], axis=0).std(axis=0) / math.sqrt(2.0)
    other = (1.0 + 0.3**2) / (1.0 + 0.3**2 + 1.0)
    y = math.hypot(1.0, other) / (1.0 + other)
    np.testing.assert_allclose(scatter, arw * np.array([1.0, y, 1.0]), rtol=0.02)


@pytest.mark.parametrize("layout", ["fd", "classic"])
def test_a_fast_roll_through_the_whole_chain(layout):
    """10 degrees at 8 rad/s through head, frames, driver and core; raw, a third of it is lost (source 001, Table 1)."""
    motion = {"rest_s": 0.0, "ramp_s": 0.0, "roll": {"sines": [{"amplitude": 10, "period_s": 2.0 * math.pi / 8.0}]}}
    choice = scenario(motion=motion, layout=layout)
    row = Motion(choice.motion).truth([0.0])[0]
    half = {}
    for name in ("compensated", "raw"):
        driver, combiner = DtgHead(), HeadCombiner(head_model(choice.head))
        if name == "raw":
            combiner = HeadCombiner(head_model(choice.head.model_copy(update={"instruments": "ideal"})))
        navigator = Navigator(Settings(attitude="high-order:4"))
        navigator.begin(row["lat"], row["lon"], row["height"], row["vel_n"], row["q_nb"], 0.0)
        attitudes = []
        for _, slow, batch in SimulatedHead(choice).chunks(8000):
            if len(slow):
                driver.decode(slow)
            attitudes.append(navigator.process(combiner.combine(driver.decode(batch)))["q_nb"].copy())
        roll = np.degrees(euler_from_quaternion(np.concatenate(attitudes))[5000:, 2])
        half[name] = 0.5 * np.ptp(roll)
    assert half["compensated"] == pytest.approx(10.0, abs=0.02)
    assert half["raw"] == pytest.approx(6.8, abs=0.1)


def test_a_failed_axis_reaches_the_summary_the_events_and_the_health():
    faults = [{"axis": "g2y", "kind": "stuck", "at_s": 1.0}, {"axis": "g2z", "kind": "built-in", "at_s": 2.0}]
    choice = scenario(grade="dtg", faults=faults).with_changes(
        bus="unix:none", duration_s=3.0, navigation={"alignment": "truth"}
    )
    outlets = Outlets.make(recording=False, readers=1)
    loop = Loop(LoopOrder(choice, paced=False), outlets)
    for _, slow, batch in SimulatedHead(choice).chunks(3000):
        loop.take(slow)
        loop.take(batch)
    result = loop.result()
    # The head says "fault of G2", which is both of its axes.
    assert result["failed_axes"]["g2y"].startswith("stuck and built-in")
    assert result["failed_axes"] == {"g2y": result["failed_axes"]["g2y"], "g2z": "built-in"}
    assert result["mode"] == "degraded"
    rows = np.zeros(64, EVENTS)
    copied, _ = outlets.events.pull(rows, 0)
    texts = [row["text"].decode() for row in rows[:copied]]
    assert "axis g2y: stuck; the others carry on, none is left to spare" in texts
    assert "axis g2z: built-in; no other axis measures its rate: attitude is not to be trusted" in texts
    state = np.zeros(1, NAV_STATE)
    outlets.states.latest(state)
    assert Health(int(state["health"][0])) == Health.SENSOR


def test_a_lost_spare_costs_no_accuracy():
    """g2y dies in a manoeuvre: before it is found the mean of the pair errs, afterwards g1y carries y alone."""
    choice = scenario(faults=[{"axis": "g2y", "kind": "stuck", "at_s": 2.0}], grade="dtg")
    healthy = scenario(grade="dtg")
    ends = []
    row = Motion(choice.motion).truth([0.0])[0]
    for each in (choice, healthy):
        navigator = Navigator(Settings(attitude="high-order:4"))
        navigator.begin(row["lat"], row["lon"], row["height"], row["vel_n"], row["q_nb"], 0.0)
        imu = HeadCombiner(head_model(each.head)).combine(sensed(each, 5000))
        ends.append(navigator.process(imu)["q_nb"].copy())
    late = attitude_error(ends[0], ends[1])
    assert np.degrees(np.abs(late[2200:] - late[2200]).max()) < 2e-3


def test_runge_kutta_moves_the_rotor_too():
    exact = instruments(scenario(), STEP).sense(0, 500)
    source = instruments(scenario(rotor={"method": "rk4"}), STEP).sense(0, 500)
    assert 0.0 < np.abs(exact.rotor - source.rotor).max() < 1e-4 * np.abs(exact.rotor).max()
