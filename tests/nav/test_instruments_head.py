"""From a head's raw increments to those of one IMU: mounting, lag, combination, size effect, and what is said of failures."""

import math
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from nav.increments import HeadIncrements, Validity
from nav.instruments.dtg import HEAD, respond
from nav.instruments.head import HeadCombiner, HeadModel
from nav.instruments.layout import common_layout
from nav.instruments.pendulum import Pendulum
from nav.instruments.redundancy import Fault, Limits, layout

STEP = 1e-3
SKEW = math.radians(45.0)
LIMITS = Limits(6e-7, 5e-5, 5e-5, 2.5e-5, 3.0, 300.0)


def head(dtheta, dvel, rotor=None):
    n = len(dtheta)
    batch = HeadIncrements.empty(n)
    batch.dtheta[:], batch.dvel[:] = dtheta, dvel
    batch.rotor[:] = np.nan if rotor is None else rotor
    batch.time[:], batch.step[:] = STEP * np.arange(1, n + 1), STEP
    batch.sequence[:] = 7 + np.arange(n)
    return batch


def plain(c_bh, **choice):
    return HeadCombiner(HeadModel(np.asarray(c_bh), **choice))


def noisy(n, skew=0.0, seed=4):
    rng = np.random.default_rng(seed)
    gyro = 6e-7 * math.sqrt(STEP) * rng.standard_normal((n, 4)) + STEP * layout(skew) @ [0.01, -0.02, 0.03]
    return head(gyro, 5e-5 * math.sqrt(STEP) * rng.standard_normal((n, 3)) + STEP * np.array([0.1, 0.2, -9.8]))


def test_axes_of_the_two_gyros():
    imu = plain(np.eye(3)).combine(head([[1.0, 2.0, 4.0, 8.0]], [[0.1, 0.2, 0.3]]))
    np.testing.assert_allclose(imu.dtheta[0], [1.0, 3.0, 8.0], rtol=1e-15)
    assert imu.dvel[0].tolist() == [0.1, 0.2, 0.3]
    assert imu.sequence[0] == 7


@given(st.tuples(*[st.floats(-180, 180)] * 3), st.floats(-3, 3), st.integers(0, 600), st.integers(0, 2**32))
def test_mounting_and_skew_turn_head_axes_into_body_axes(angles, skew, n, seed):
    turn = Rotation.from_euler("ZYX", angles, degrees=True)
    random = np.random.default_rng(seed)
    rate, dvel = random.normal(size=(2, n, 3))
    imu = plain(turn.as_matrix(), skew=skew).combine(head(rate @ layout(skew).T, dvel))
    assert len(imu) == n
    if n:
        np.testing.assert_allclose(imu.dtheta, turn.apply(rate), atol=1e-13)
        np.testing.assert_allclose(imu.dvel, turn.apply(dvel), atol=1e-13)


def test_the_lag_of_both_gyros_is_taken_off():
    """What two rotors make of a fast motion about all axes comes back as the rate."""
    time = STEP / 8.0 * np.arange(8 * 4000 + 1)
    rate = np.stack([0.5 * np.sin(8.0 * time), 0.3 * np.sin(5.0 * time + 1.0), 0.2 * np.cos(11.0 * time) - 0.2], axis=1)
    columns, angles = [], []
    for axes in ((0, 1), (1, 2)):
        angle, swept = respond(HEAD, rate[:, axes], STEP / 8.0, state=HEAD.settled(tuple(rate[0, axes])))
        columns.append(-swept.reshape(-1, 8, 2).sum(axis=1) / HEAD.lag)
        angles.append(angle[7::8])
    raw = head(np.hstack(columns), np.zeros((4000, 3)), np.hstack(angles))
    imu = plain(np.eye(3), rotors=(HEAD, HEAD)).combine(raw)
    true = STEP / 8.0 * 0.5 * (rate[1:] + rate[:-1]).reshape(-1, 8, 3).sum(axis=1)
    settled = slice(2000, None)
    left = np.cumsum(imu.dtheta - true, axis=0)[settled]
    lagged = np.cumsum(raw.dtheta[:, [0, 1, 3]] - true, axis=0)[settled]
    assert np.ptp(left, axis=0).max() < 2e-5 * np.ptp(np.cumsum(true, axis=0), axis=0).max()
    assert np.ptp(lagged, axis=0).max() > 0.05


def test_the_size_effect_is_taken_off():
    """A steady turn about z: each pendulum feels the centripetal force at its own place."""
    block, rate = common_layout(Pendulum(), 0.05), 2.0
    gyro = np.tile(STEP * layout(0.0) @ [0.0, 0.0, rate], (100, 1))
    force = np.array([-block[0].hinge[0] * rate**2, 0.0, 0.0])
    imu = plain(np.eye(3), pendulums=block).combine(head(gyro, np.tile(STEP * force, (100, 1))))
    with_size = plain(np.eye(3)).combine(head(gyro, np.tile(STEP * force, (100, 1)))).dvel
    assert abs(with_size[50, 0]) == pytest.approx(STEP * 0.05 * 4.0)
    assert abs(imu.dvel[50, 0]) < 1e-6 * STEP


@settings(max_examples=20)
@given(st.lists(st.integers(1, 900), max_size=6))
def test_every_batch_size_gives_the_same_rows(cuts):
    data = noisy(2000)
    data.rotor[:] = -HEAD.lag * data.dtheta / STEP
    data.dtheta[800:, 1] = data.dtheta[800, 1]
    data.status[1200:1500] = 2
    model = HeadModel(np.eye(3), rotors=(HEAD, HEAD), pendulums=common_layout(Pendulum(), 0.03), limits=LIMITS)
    one, other = HeadCombiner(model), HeadCombiner(model)
    whole = one.combine(data)
    edges = [0, *np.cumsum(cuts).clip(max=2000).tolist(), 2000]
    for start, stop in pairwise(edges):
        part = other.combine(data.rows(start, stop))
        for name in ("dtheta", "dvel", "validity"):
            np.testing.assert_array_equal(getattr(part, name), getattr(whole, name)[start:stop])
    assert one.notes() == other.notes()


def test_a_lost_y_costs_nothing():
    data = noisy(2000)
    data.dtheta[1000:, 2] = data.dtheta[1000, 2]
    combiner = plain(np.eye(3), limits=LIMITS)
    imu = combiner.combine(data)
    (note,) = combiner.notes()
    assert note.text == "axis g2y: stuck; the others carry on, none is left to spare"
    assert 1.0 < note.time <= 1.11
    found = round(note.time / STEP)
    np.testing.assert_array_equal(imu.dtheta[found:, 1], data.dtheta[found:, 1])
    assert set(imu.validity[:found]) == {0}
    assert set(imu.validity[found:]) == {Validity.SPARE}


@pytest.mark.parametrize("kind", [Fault.NOISE, Fault.STUCK])
def test_a_lost_x_is_said_and_the_rest_goes_on(kind):
    """A noisy axis that nobody can replace is better than none; a dead one is none."""
    data = noisy(2000)
    if kind == Fault.NOISE:
        data.dtheta[1000:, 0] += 1e-4 * np.random.default_rng(8).standard_normal(1000)
    else:
        data.dtheta[1000:, 0] = data.dtheta[1000, 0]
    combiner = plain(np.eye(3), limits=LIMITS)
    imu = combiner.combine(data)
    (note,) = combiner.notes()
    what = str(kind.name).lower()
    assert note.text == f"axis g1x: {what}; no other axis measures its rate: attitude is not to be trusted"
    found = round(note.time / STEP)
    assert set(imu.validity[found:]) == {Validity.SENSOR}
    expected = data.dtheta[found:, 0] if kind == Fault.NOISE else 0.0 * data.dtheta[found:, 0]
    np.testing.assert_allclose(imu.dtheta[found:, 0], expected, rtol=1e-12, atol=1e-20)
    np.testing.assert_allclose(imu.dtheta[found:, 1], data.dtheta[found:, 1:3].mean(axis=1), rtol=1e-12)
    np.testing.assert_allclose(imu.dtheta[found:, 2], data.dtheta[found:, 3], rtol=1e-12)
    combiner.renew()
    assert not combiner.faults.any()


@pytest.mark.parametrize("axis", range(4))
def test_skewed_any_axis_may_be_lost(axis):
    data = noisy(2000, SKEW)
    true = STEP * np.array([0.01, -0.02, 0.03])
    data.dtheta[1000:, axis] = data.dtheta[1000, axis]
    imu = plain(np.eye(3), skew=SKEW, limits=LIMITS).combine(data)
    assert set(imu.validity[1200:]) == {Validity.SPARE}
    assert np.abs(imu.dtheta[1200:].mean(axis=0) - true).max() < 1e-8


def test_a_jump_that_nobody_can_place_is_said():
    data = noisy(2000, SKEW)
    data.dtheta[1000:, 3] += 3e-4 * STEP
    combiner = plain(np.eye(3), skew=SKEW, limits=LIMITS)
    imu = combiner.combine(data)
    (note,) = combiner.notes()
    assert note.text.startswith("g1x and g1y and g2y and g2z disagree, and nothing tells which is wrong")
    assert set(imu.validity[1100:]) == {Validity.SENSOR}


def test_what_the_head_says_of_itself_is_believed_while_it_says_so():
    data = noisy(900)
    data.status[300:600] = 1 << 1
    combiner = plain(np.eye(3), limits=LIMITS)
    imu = combiner.combine(data)
    assert [note.text for note in combiner.notes()] == [
        "axis g2y: built-in; no other axis measures its rate: attitude is not to be trusted",
        "axis g2z: built-in; no other axis measures its rate: attitude is not to be trusted",
        "axis g2y is good again",
        "axis g2z is good again",
    ]
    assert [set(imu.validity[part]) for part in (slice(300), slice(300, 600), slice(600, None))] == [{0}, {4}, {0}]


def test_a_rotor_off_its_speed_is_a_failed_gyro():
    data = noisy(900)
    data.rotor[:] = 0.0
    data.spin[:] = HEAD.spin / (2.0 * math.pi)
    data.spin[500:, 0] *= 1.02
    combiner = plain(np.eye(3), rotors=(HEAD, HEAD))
    combiner.combine(data)
    assert combiner.faults.tolist() == [Fault.BUILT_IN, Fault.BUILT_IN, 0, 0, 0, 0, 0]
    assert {round(note.time, 6) for note in combiner.notes()} == {0.501}
