"""The factored filter against dense matrices, over hours, and its reset."""

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from nav.chi_square import quantile
from nav.earth import RATE, normal_gravity
from nav.error_dynamics import fill_dynamics, fill_input, fill_transition
from nav.errors import HilError
from nav.filter.error_state import ErrorState
from nav.filter.states import STATES, TURN_S, Block, Tuning, correct_increments, places, tuning
from nav.instruments.channels import TRIAD
from nav.instruments.grades import GRADES
from nav.instruments.gyro_errors import Gyros
from nav.instruments.noise import flicker_processes
from nav.instruments.sources import combination

SIGMA = np.array([5.0, 5.0, 5.0, 0.3, 0.3, 0.3, 1e-3, 1e-3, 1e-2])
Q_NB = Rotation.from_euler("ZYX", [40.0, 5.0, -10.0], degrees=True).as_quat(scalar_first=True)
LAT = 0.9


def interval(step=0.5, lat=LAT, w=(0.02, -0.05, 0.2), f=(1.0, -2.0, -11.0)):
    """A solution that moves over a step, and its increments."""
    before = np.array([lat, 0.3, 500.0, 60.0, -40.0, 2.0, *Q_NB])
    turned = Rotation.from_quat(Q_NB, scalar_first=True) * Rotation.from_rotvec(step * np.array(w))
    after = before.copy()
    after[0] += step * 60.0 / 6.37e6
    after[2] -= step * 2.0
    after[3:6] += step * np.array([1.0, 2.0, -0.5])
    after[6:10] = turned.as_quat(scalar_first=True)
    return before, after, step * np.array([1.0, *w, *f])


def dense(tuning, before, after, sums, turn):
    """Transition and noise of all used states, by whole matrices."""
    step, used = sums[0], places(tuning.blocks)
    w, f = sums[1:4] / step, sums[4:7] / step
    middle = Rotation.from_quat(after[6:10], scalar_first=True) * Rotation.from_rotvec(-0.5 * sums[1:4])
    c = np.ascontiguousarray(middle.as_matrix())
    dynamics, transition, gain = np.empty((9, 9)), np.empty((9, 9)), np.empty((9, 6))
    fill_dynamics(*(0.5 * (before + after))[[0, 2]], 0.5 * (before + after)[3:6], c, f, dynamics)
    fill_transition(dynamics, step, transition)
    fill_input(dynamics, c, step, gain)
    phi = np.eye(STATES)
    e = Rotation.from_rotvec(turn).as_matrix()
    reset = np.eye(9)
    reset[6:, 6:] -= (
        0.5 * (e - e.T) / 2.0 * (np.linalg.norm(turn) / math.sin(np.linalg.norm(turn)) if turn.any() else 1)
    )
    phi[:9, :9] = transition @ reset
    phi[:9, 9:15] = step * gain
    phi[:9, 15:18], phi[:9, 18:21] = gain[:, :3] * sums[1:4], gain[:, 3:] * sums[4:7]
    phi[:9, 21:24] = gain[:, :3] * sums[4:7]
    for place, (gyro, about) in enumerate([(0, 1), (0, 2), (1, 2), (1, 0), (2, 0), (2, 1)]):
        phi[:9, 29 + place] = gain[:, gyro] * sums[1 + about]
    noise = np.diag(tuning.walk**2 * step)
    noise[:9, :9] = 0.0
    density = tuning.white**2
    density[:3] += tuning.by_rate @ w**2 + tuning.by_force @ np.square(f + np.array([0.0, 0.0, 9.80665]))
    noise[:9, :9] += step * (gain * density) @ gain.T
    return phi[np.ix_(used, used)], noise[np.ix_(used, used)]


@pytest.mark.parametrize("blocks", [tuple(Block), (), (Block.GYRO_BIAS, Block.BAROMETER_BIAS, Block.GYRO_G)])
def test_it_is_the_filter_of_whole_matrices(blocks):
    believed = tuning(GRADES["mems"], blocks)
    state = ErrorState(believed)
    state.start(SIGMA)
    used = state.used
    p = state.covariance
    np.testing.assert_allclose(np.diag(p), np.concatenate([SIGMA, believed.sigma[used[9:]]]) ** 2)
    rng = np.random.default_rng(1)
    turn = np.zeros(3)
    for _ in range(20):
        data = interval(w=rng.normal(0.0, 0.3, 3), f=rng.normal(0.0, 10.0, 3))
        state.predict(*data)
        phi, noise = dense(believed, *data, turn)
        p = phi @ p @ phi.T + noise
        h = rng.normal(size=(3, STATES))
        residual, variance = rng.normal(size=3), rng.uniform(0.5, 2.0, 3)
        rows = h[:, used]
        s = rows @ p @ rows.T
        nis, spread = state.examine(h, residual, variance)
        np.testing.assert_allclose(spread, s, rtol=1e-9)
        whole = np.linalg.inv(s + np.diag(variance))
        assert nis == pytest.approx(residual @ whole @ residual, rel=1e-8)
        gain = p @ rows.T @ whole
        x = state.absorb(h, residual, variance)
        scale = np.sqrt(np.diag(p))
        np.testing.assert_allclose(x[used] / scale, gain @ residual / scale, atol=1e-8)
        turn = x[6:9].copy()
        keep = np.eye(len(used)) - gain @ rows
        p = keep @ p @ keep.T + gain @ np.diag(variance) @ gain.T
        np.testing.assert_allclose(state.covariance / np.outer(scale, scale), p / np.outer(scale, scale), atol=1e-8)
        np.testing.assert_allclose(state.sigma[used], np.sqrt(np.diag(p)), rtol=1e-6)


def test_the_full_set_has_more_than_21_states_and_each_block_can_be_left_out():
    assert len(places(Block)) == STATES >= 21
    for block in Block:
        left = places(set(Block) - {block})
        assert set(range(STATES)) - set(left) == set(range(block.value.start, block.value.stop))


def test_it_stays_positive_for_hours_where_the_textbook_form_does_not():
    """Position to a micrometre beside a metre of doubt of the lever arm, and a bias known to 1e-12: 17 decades and more."""
    believed = tuning(GRADES["dtg"], tuple(Block), lever_arm=100.0, barometer=1e5)
    state = ErrorState(believed)
    state.start(np.array([1e5, 1e5, 1e5, 1e2, 1e2, 1e2, 0.5, 0.5, 3.0]))
    used, p = state.used, state.covariance
    data = interval(step=1.0, w=(0.0, 0.0, 0.0), f=(0.0, 0.0, -9.8))
    h = np.zeros((3, STATES))
    h[:, 0:3], h[:, 24:27] = np.eye(3), -Rotation.from_quat(Q_NB, scalar_first=True).as_matrix()
    down = np.zeros((1, STATES))
    down[0, [2, 28]] = -1.0
    spoiled = False
    for k in range(3 * 3600):
        state.predict(*data)
        state.absorb(h, np.zeros(3), np.full(3, 1e-12))
        state.absorb(down, np.zeros(1), np.full(1, 1e-12))
        assert (state.d >= 0.0).all()
        if not spoiled:
            phi, noise = dense(believed, *data, np.zeros(3))
            p = phi @ p @ phi.T + noise
            for row in np.vstack([h, down])[:, used]:
                p = p - np.outer(p @ row, row @ p) / (row @ p @ row + 1e-12)
            spoiled = bool((np.diag(p) < 0.0).any() or np.linalg.eigvalsh(p / np.abs(p).max()).min() < -1e-12)
        if k % 600 == 0:
            scale = np.sqrt(np.maximum(np.diag(state.covariance), 1e-300))
            whole = state.covariance / np.outer(scale, scale)
            np.testing.assert_allclose(whole, whole.T, atol=1e-12)
            assert np.linalg.eigvalsh(whole).min() > -1e-9
    assert spoiled
    assert np.isfinite(state.covariance).all()


@given(st.lists(st.floats(-0.5, 0.5), min_size=3, max_size=3), st.lists(st.floats(-1.0, 1.0), min_size=3, max_size=3))
def test_what_the_reset_does_to_the_rest_of_the_error(e, d):
    """exp(-e) exp(e + d): of the first order in d, and good to the second in e."""
    e, d = np.array(e), 1e-4 * np.array(d)
    left = (Rotation.from_rotvec(-e) * Rotation.from_rotvec(e + d)).as_rotvec()
    assert np.linalg.norm(left - (d - 0.5 * np.cross(e, d))) <= np.linalg.norm(d) * (0.2 * e @ e + 1e-3) + 1e-14


def test_the_reset_reaches_the_covariance():
    state = ErrorState(tuning(GRADES["mems"], ()))
    state.start(SIGMA)
    state.turn[:] = 0.1, -0.2, 0.3
    before, after, sums = interval(step=1e-9)
    state.predict(before, after, sums)
    x, y, z = 0.1, -0.2, 0.3
    reset = np.eye(3) - 0.5 * np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    np.testing.assert_allclose(state.covariance[6:, 6:], reset @ np.diag(SIGMA[6:] ** 2) @ reset.T, rtol=1e-6)
    assert not state.turn.any()


def test_an_interval_of_no_length_changes_nothing():
    state = ErrorState(tuning(GRADES["mems"]))
    state.start(SIGMA)
    before, after, _ = interval()
    p = state.covariance
    state.predict(before, after, np.zeros(7))
    assert (state.covariance == p).all()


@pytest.mark.parametrize("name", GRADES)
def test_the_noise_covers_the_spectrum_of_flicker(name):
    """Of the simulated flicker, its ripple aside, at every frequency; and no more than it where they touch."""
    grade = replace(GRADES[name], gyro_white=0.0, accelerometer_white=0.0, gyro_channels=TRIAD)
    believed, w = tuning(grade), np.geomspace(1e-4, 100.0, 300)
    for place, flicker in (0, grade.gyro_flicker), (3, grade.accelerometer_flicker):
        times, part = flicker_processes(flicker, 0.001)
        simulated = (2.0 * part**2 * times / (1.0 + np.outer(w, times) ** 2)).sum(axis=1)
        said = believed.white[place] ** 2 + (believed.walk[9 + place] / w) ** 2
        assert (said > 0.95 * simulated).all()
        assert (said / simulated).min() < 1.05


@pytest.mark.parametrize("name", GRADES)
def test_drift_by_force_is_expected_as_the_gyros_have_it(name):
    """In a pull-up of `TURN_S`: how far it turns the attitude beyond what it does in level flight."""
    grade, level, pulled = GRADES[name], np.array([0.0, 0.0, -9.80665]), np.array([3.0, -2.0, -14.0])
    rng = np.random.default_rng(1)

    def drift(errors):
        angles = [
            Gyros(errors, TURN_S, np.random.default_rng(0)).sense(np.zeros((1, 3)), TURN_S * force[None])[0]
            for force in (pulled, level)
        ]
        return combination(grade.gyro_channels) @ (angles[0] - angles[1])

    def variance(force):
        state, solution = ErrorState(tuning(grade)), np.array([LAT, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0])
        state.start(np.zeros(9))
        state.predict(solution, solution, TURN_S * np.array([1.0, 0.0, 0.0, 0.0, *force]))
        return np.diag(state.covariance)[6:9]

    drawn = np.array([drift(grade.draw(rng)[0]) for _ in range(1000)])
    np.testing.assert_allclose(np.sqrt(variance(pulled) - variance(level)), drawn.std(axis=0), rtol=0.1)


@given(st.integers(0, 100))
@settings(max_examples=20)
def test_increments_are_corrected_by_the_model(seed):
    """What the model adds to true increments is taken off; of misalignment times scale factor and the like the first order."""
    rng = np.random.default_rng(seed)
    parameters = np.zeros(STATES)
    parameters[9:24] = 0.01 * rng.standard_normal(15)
    step, dtheta, dvel = rng.uniform(0.001, 0.1, 5), rng.standard_normal((5, 3)), rng.standard_normal((5, 3))
    bias, force_bias, scale, force_scale, by_force = parameters[9:24].reshape(5, 3)
    turned = (1.0 + scale) * dtheta + bias * step[:, None] + by_force * dvel
    parameters[29:] = 1e-6 * rng.standard_normal(6)
    for place, (gyro, about) in enumerate([(0, 1), (0, 2), (1, 2), (1, 0), (2, 0), (2, 1)]):
        turned[:, gyro] += parameters[29 + place] * dtheta[:, about]
    pushed = (1.0 + force_scale) * dvel + force_bias * step[:, None]
    found, force = np.empty((5, 3)), np.empty((5, 3))
    correct_increments(parameters, step, turned, pushed, found, force)
    np.testing.assert_allclose(found, dtheta, atol=1e-6)
    np.testing.assert_allclose(force, dvel, atol=1e-14)


@pytest.mark.parametrize("freedom", [1, 2, 3])
@pytest.mark.parametrize("probability", [0.9, 0.99, 0.999, 0.9999])
def test_quantiles(freedom, probability):
    assert quantile(probability, freedom) == pytest.approx(chi2.ppf(probability, freedom), rel=1e-6)


def test_a_gyrocompass_finds_the_heading_of_its_bias():
    """At rest with zero velocity: heading to the east gyro's bias / (U cos B), tilt to the force's bias / g."""
    blocks = Block.GYRO_BIAS, Block.ACCELEROMETER_BIAS
    still = Tuning(blocks, np.repeat([0.0, 1e-7, 1e-3, 0.0], [9, 3, 3, STATES - 15]), np.full(6, 1e-7))
    state = ErrorState(still)
    state.start(np.array([1e-3, 1e-3, 1e-3, 1e-3, 1e-3, 1e-3, 0.1, 0.1, 0.5]))
    g = normal_gravity(math.sin(LAT), 0.0)
    solution = np.array([LAT, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0])
    sums = np.array([1.0, RATE * math.cos(LAT), 0.0, -RATE * math.sin(LAT), 0.0, 0.0, -g])
    h = np.zeros((3, STATES))
    h[:, 3:6] = np.eye(3)
    for _ in range(1800):
        state.predict(solution, solution, sums)
        state.absorb(h, np.zeros(3), np.full(3, 1e-6))
    assert state.sigma[8] == pytest.approx(1e-7 / (RATE * math.cos(LAT)), rel=0.03)
    assert state.sigma[6:8] == pytest.approx(1e-3 / g, rel=0.03)


def test_what_is_no_sigma_is_refused():
    with pytest.raises(HilError, match="white must be"):
        Tuning((), np.zeros(STATES), np.full(6, -1.0))
