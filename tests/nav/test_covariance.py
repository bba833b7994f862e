"""Covariance along a path: an augmented system by matrix exponentials, closed forms, and Monte-Carlo."""

import dataclasses
import math

import numpy as np
import pytest
from scipy.linalg import expm, solve_continuous_lyapunov
from scipy.spatial.transform import Rotation

from nav.covariance import Path, Source, budget, covariance, response
from nav.earth import RATE, curvature_radii, normal_gravity
from nav.error_dynamics import fill_dynamics
from nav.errors import HilError
from nav.increments import HeadIncrements
from nav.instruments.accelerometer_errors import Accelerometers
from nav.instruments.channels import TRIAD
from nav.instruments.grades import GRADES
from nav.instruments.gyro_errors import DTG_HEAD, Gyros
from nav.instruments.head import HeadCombiner, HeadModel
from nav.instruments.noise import Noise, NoiseModel, flicker_processes
from nav.instruments.sources import combination, grade_sources
from nav.strapdown import Strapdown

LAT = math.radians(50.0)
GRAVITY = normal_gravity(math.sin(LAT), 0.0)
ATTITUDE = Rotation.from_euler("ZYX", [40, 10, -20], degrees=True)
RATE_B = ATTITUDE.inv().apply([RATE * math.cos(LAT), 0.0, -RATE * math.sin(LAT)])
FORCE_B = ATTITUDE.inv().apply([0.0, 0.0, -GRAVITY])


def rest(step, n, attitude=ATTITUDE):
    ones = np.ones((n, 1))
    rate, force = (ones * attitude.inv().apply(ATTITUDE.apply(v)) for v in (RATE_B, FORCE_B))
    q_nb = ones * attitude.as_quat(scalar_first=True)
    return Path(step, LAT * ones[:, 0], 0.0 * ones[:, 0], np.zeros((n, 3)), q_nb, rate, force)


def augmented(source, step, n):
    """P (9, 9) after n steps: errors and every Gauss-Markov process in one system, discretised after Van Loan."""
    f = np.empty((9, 9))
    c_nb = ATTITUDE.as_matrix()
    fill_dynamics(LAT, 0.0, np.zeros(3), c_nb, FORCE_B, f)
    entry = np.zeros((9, 6))
    entry[6:, :3] = entry[3:6, 3:] = c_nb
    times = np.tile(source.times, len(source.drift))
    a = np.zeros((9 + len(times),) * 2)
    a[:9, :9] = f
    a[:9, 9:] = entry @ source.drift.repeat(len(source.times), axis=0).T
    a[9:, 9:] = -np.diag(1.0 / times)
    q = np.zeros_like(a)
    q[9:, 9:] = np.diag(2.0 / times)
    q[:9, :9] = entry @ source.white.T @ source.white @ entry.T
    p = np.zeros_like(a)
    if len(times):
        p[9:, 9:] = solve_continuous_lyapunov(a[9:, 9:], -q[9:, 9:])
    m = len(a)
    both = expm(np.block([[-a, q], [np.zeros_like(a), a.T]]) * step)
    phi = both[m:, m:].T
    noise = phi @ both[:m, m:]
    for _ in range(n):
        p = phi @ p @ phi.T + noise
    return p[:9, :9]


@pytest.mark.parametrize(
    "source",
    [
        Source("white", white=np.diag([1e-6, 2e-6, 3e-6, 1e-4, 2e-4, 3e-4])),
        Source("drift", drift=np.diag([1e-8, 2e-8, 3e-8, 1e-5, 2e-5, 3e-5]), times=np.array([0.3, 4.0, 60.0, 1e5])),
        Source("skewed", drift=np.array([[1e-8, 2e-8, 0, 0, 1e-5, 0.0]]), times=np.array([20.0])),
    ],
    ids=lambda source: source.name,
)
def test_noises_are_those_of_the_augmented_system(source):
    found = covariance(rest(1.0, 1200), source, every=600)
    for k, n in enumerate((600, 1200)):
        expected = augmented(source, 1.0, n)
        scale = np.sqrt(np.diag(expected))
        np.testing.assert_allclose(found[k] / np.outer(scale, scale), expected / np.outer(scale, scale), atol=1e-4)


def test_constants_at_rest_are_the_closed_forms():
    """Height held: b / w^2 (1 - cos w t), and R e (t - sin(w t) / w), the Earth's turn aside."""
    bias, drift, time = 1e-4, 5e-8, 1500.0
    constant = np.zeros((2, 6, 7))
    constant[0, 3, 0], constant[1, 1, 0] = bias, drift
    level = rest(1.0, round(time), Rotation.identity())
    found = covariance(level, Source("both", constant=constant), every=round(time), height_held=True)[-1]
    radius = curvature_radii(math.sin(LAT))[0]
    schuler = math.sqrt(GRAVITY / radius)
    by_bias = bias / schuler**2 * (1.0 - math.cos(schuler * time))
    by_drift = radius * drift * (time - math.sin(schuler * time) / schuler)
    assert math.sqrt(found[0, 0]) == pytest.approx(math.hypot(by_bias, by_drift), rel=0.01)
    assert (found[[2, 5]] == 0.0).all()


def test_scale_factors_and_cross_terms_act_through_rate_and_force():
    """A constant that is seen through r is a bias of that size where rate and force are steady."""
    path = rest(1.0, 100)
    r = np.concatenate([[1.0], RATE_B, FORCE_B])
    for j in range(7):
        seen, plain = np.zeros((1, 6, 7)), np.zeros((1, 6, 7))
        seen[0, :, j] = 1e-3
        plain[0, :, 0] = 1e-3 * r[j]
        one, other = (response(path, np.zeros((1, 9)), c)[-1, 0] for c in (seen, plain))
        np.testing.assert_allclose(one, other, rtol=1e-12)


def test_the_middle_of_the_step_makes_it_second_order():
    """Turning at 10 deg/s: halving the step divides what is wrong by four."""
    ends = []
    for step in (0.05, 0.1, 0.2):
        n = round(60.0 / step)
        turn = Rotation.from_rotvec(np.outer((np.arange(n) + 0.5) * step, [0.0, 0.0, math.radians(10.0)]))
        force = turn.inv().apply([1.0, 0.5, -9.8])
        q_nb, zeros, w = turn.as_quat(scalar_first=True), np.zeros((n, 3)), np.tile([0, 0, math.radians(10.0)], (n, 1))
        path = Path(step, np.full(n, LAT), zeros[:, 0], zeros, q_nb, w, force)
        ends.append(covariance(path, grade_sources(GRADES["dtg"], 0.01)[0], every=n)[-1])
    coarse, fine = (np.abs(ends[k + 1] - ends[k])[6:, 6:].max() for k in (1, 0))
    assert coarse / fine == pytest.approx(4.0, rel=0.1)


def test_monte_carlo_of_the_simulated_noise():
    """The navigator at rest on white noise and flicker of `Noise`: spread after five minutes, 150 runs."""
    step, n, runs = 0.1, 3000, 150
    gyro, force = NoiseModel(white=2e-6, flicker=4e-7), NoiseModel(white=1e-4, flicker=4e-5)
    ends = []
    for seed in range(runs):
        one, other = np.random.default_rng(seed).spawn(2)
        core = Strapdown()
        core.start(LAT, 0.0, 0.0, np.zeros(3), ATTITUDE.as_quat(scalar_first=True))
        turned = step * RATE_B + Noise(gyro, step, 3, one).increments(n)
        pushed = step * FORCE_B + Noise(force, step, 3, other).increments(n)
        core.advance(np.full(n, step), turned, pushed, np.zeros(3), *(np.empty((n, k)) for k in (3, 3, 4)))
        ends.append(core.solution[3:6].copy())
    eye = np.eye(6)
    sources = [Source("white", white=np.vstack([gyro.white * eye[:3], force.white * eye[3:]]))]
    for name, rows, model in (("gyro", eye[:3], gyro), ("force", eye[3:], force)):
        times, sigma = flicker_processes(model.flicker, step)
        sources.append(Source(name, drift=sigma * rows, times=times))
    expected = sum(budget(rest(step, n), sources, every=n).values())[-1]
    ends = np.array(ends)
    ratio = ends.var(axis=0) / np.diag(expected)[3:6]
    np.testing.assert_allclose(ratio, 1.0, atol=4.0 * math.sqrt(2.0 / runs))
    normalised = np.einsum("si,si->", ends, np.linalg.solve(expected[3:6, 3:6], ends.T).T) / ends.size
    assert normalised == pytest.approx(1.0, abs=4.0 * math.sqrt(2.0 / ends.size))


@pytest.mark.parametrize("removed", [False, True])
@pytest.mark.parametrize("name", GRADES)
def test_sources_are_what_the_grade_draws(name, removed):
    """Errors of the increments of 1000 drawn instruments, noise aside, beside the sum of the constants' one sigma."""
    grade, rng, count = GRADES[name], np.random.default_rng(5), 1000
    dtheta, dvel = np.array([[0.3, -0.2, 0.5]]) * 0.01, np.array([[3.0, -7.0, 9.0]]) * 0.01
    to_body, wrong = combination(grade.gyro_channels), []
    for _ in range(count):
        drawn = [dataclasses.replace(e, noise=NoiseModel()) for e in grade.draw(rng, bias_removed=removed)]
        gyros, forces = Gyros(drawn[0], 0.01, rng), Accelerometers(drawn[1], 0.01, rng)
        wrong.append(
            np.concatenate([to_body @ gyros.sense(dtheta, dvel)[0] - dtheta[0], forces.sense(dvel)[0] - dvel[0]])
        )
    found = np.array(wrong).std(axis=0) / 0.01
    r = np.concatenate([[1.0], dtheta[0] / 0.01, dvel[0] / 0.01])
    sources = grade_sources(grade, 0.01, bias_removed=removed)
    expected = np.sqrt(sum(((source.constant @ r) ** 2).sum(axis=0) for source in sources))
    np.testing.assert_allclose(found, expected, rtol=4.0 / math.sqrt(2.0 * count))


def test_channels_are_combined_as_the_head_does():
    rng = np.random.default_rng(3)
    dtheta, head = 1e-9 * rng.standard_normal((5, 4)), HeadIncrements.empty(5)
    head.step[:], head.dtheta[:] = 0.01, dtheta
    np.testing.assert_allclose(
        dtheta @ combination(DTG_HEAD).T, HeadCombiner(HeadModel(np.eye(3))).combine(head).dtheta, atol=1e-20
    )
    np.testing.assert_allclose(combination(TRIAD), np.eye(3), atol=1e-15)


@pytest.mark.parametrize(
    ("change", "say"),
    [
        ({"step": 0.0}, "it must be positive"),
        ({"lat": np.array([0.1, 0.5 * math.pi])}, "meets a pole"),
        ({"f_b": np.array([[0, 0, -9.8], [0, np.nan, 0]])}, "f_b is not finite at step 1"),
        ({"height": np.zeros(1)}, "path: height: shape"),
        ({"vel_n": np.zeros((2, 2))}, "path: vel_n: shape"),
        ({"q_nb": np.zeros((2, 4))}, "no rotation"),
    ],
)
def test_impossible_paths_are_refused(change, say):
    with pytest.raises(HilError, match=say):
        dataclasses.replace(rest(1.0, 2), **change)


@pytest.mark.parametrize(
    ("source", "say"),
    [
        ({"white": np.ones((1, 3))}, "white: shape"),
        ({"white": np.full((1, 6), np.nan)}, "white is not finite"),
        ({"constant": np.ones((1, 6, 6))}, "constant: shape"),
        ({"drift": np.ones((1, 6))}, "needs correlation times"),
        ({"drift": np.ones((1, 6)), "times": np.zeros(1)}, "positive ones"),
    ],
)
def test_impossible_sources_are_refused(source, say):
    with pytest.raises(HilError, match=say):
        Source("wrong", **source)


def test_an_attitude_of_any_norm_is_the_same_rotation():
    path, source = rest(1.0, 20), Source("white", white=np.ones((1, 6)))
    longer = dataclasses.replace(path, q_nb=2.0 * path.q_nb)
    np.testing.assert_allclose(covariance(longer, source), covariance(path, source), rtol=1e-14)
    with pytest.raises(HilError, match="every 0 steps"):
        covariance(path, source, every=0)
    with pytest.raises(HilError, match="sources of one name"):
        budget(path, [source, source])
