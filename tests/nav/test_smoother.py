"""The smoother against the least-squares solution of the whole, on simulated flights, and across restarts."""

import math
from dataclasses import replace
from functools import cache
from itertools import pairwise

import numpy as np
import pytest

from hil.geometry import position_error
from hil.study.aiding import GNSS_SIGMA, TILT, _own, begin, gnss_rows, record, turns
from nav.errors import HilError
from nav.filter.aided import AidedNavigator, Settings
from nav.filter.error_state import ErrorState
from nav.filter.record import Recorder
from nav.filter.smoother import smooth
from nav.filter.states import STATES, Block, tuning
from nav.instruments.grades import GRADES
from nav.rotation import attitude_error, quaternion_from_rotation_vector
from nav.strapdown import Strapdown

DURATION, OUTAGE = 150.0, (60.0, 120.0)


def linear_case(epochs, blocks):
    """A filter that runs beside random intervals and takes random measurements; its record, and the same as one problem.

    The problem: mean and covariance of the errors of all epochs before any measurement, stacked; rows, residuals and
    variances of the measurements; what was taken off the errors at each epoch.
    """
    rng = np.random.default_rng(1)
    state, recorder = ErrorState(tuning(GRADES["mems"], blocks)), Recorder()
    sigma = np.array([5.0, 5.0, 5.0, 0.3, 0.3, 0.3, 1e-3, 1e-3, 1e-2])
    solution = np.array([0.9, 0.3, 500.0, 60.0, -40.0, 2.0, *quaternion_from_rotation_vector([0.1, -0.2, 0.7])])
    state.start(sigma)
    recorder.start(0.0, state, solution)
    used, estimates = state.used, np.zeros(STATES)
    n = len(used)
    mean, joint = np.zeros((epochs, n)), np.zeros((epochs, n, epochs, n))
    joint[0, :, 0], taken = state.covariance, np.zeros((epochs, n))
    measured = []
    recorder.end(solution, estimates)
    for k in range(1, epochs):
        sums = 0.5 * np.array([1.0, *rng.normal(0.0, 0.3, 3), *rng.normal(0.0, 10.0, 3)])
        after = solution + 1e-9 * rng.standard_normal(10)
        before, p = solution, state.covariance
        state.predict(before, after, sums)
        recorder.predict(0.5 * k, after, sums)
        phi = np.vstack([state.transition, np.eye(n)[9:]])
        noise = state.covariance - phi @ p @ phi.T
        mean[k] = phi @ (mean[k - 1] - taken[k - 1])
        joint[k, :, :k] = np.einsum("ij,jkl->ikl", phi, joint[k - 1, :, :k])
        joint[:k, :, k] = joint[k, :, :k].transpose(1, 2, 0)
        joint[k, :, k] = phi @ joint[k - 1, :, k - 1] @ phi.T + noise
        for m in [(), (3,), (1, 2)][k % 3]:
            h = np.zeros((3, STATES))
            h[:, used] = rng.normal(size=(3, n)) / np.sqrt(np.diag(state.covariance))
            residual, variance = rng.normal(size=3), rng.uniform(0.2, 2.0, 3)
            recorder.absorb(h, residual, variance, m)
            for i in range(m):
                row = np.zeros((epochs, n))
                row[k] = h[i, used]
                measured.append((row.ravel(), residual[i] + row[k] @ taken[k], variance[i]))
            x = state.absorb(h, residual, variance, m)
            taken[k] += x[used]
            estimates[9:] += x[9:]
        solution = after
        recorder.end(solution, estimates)
    rows, residuals, variances = (np.array(part) for part in zip(*measured, strict=True))
    return recorder, mean.ravel(), joint.reshape(epochs * n, -1), rows, residuals, variances, taken


@pytest.mark.parametrize("blocks", [(), (Block.GYRO_BIAS, Block.ACCELEROMETER_SCALE, Block.BAROMETER_BIAS)])
def test_it_is_the_least_squares_solution_of_the_whole(blocks):
    """All errors of all epochs at once, from all measurements: mean and covariance of the Gauss-Markov theorem."""
    epochs = 12
    recorder, mean, joint, rows, residuals, variances, taken = linear_case(epochs, blocks)
    gain = joint @ rows.T @ np.linalg.inv(rows @ joint @ rows.T + np.diag(variances))
    x = (mean + gain @ (residuals - rows @ mean)).reshape(epochs, -1) - taken
    p = (joint - gain @ rows @ joint).reshape(epochs, len(x[0]), epochs, -1)
    found, after = smooth(recorder), recorder.epochs["after"]
    used = recorder.filter.used
    scale = np.sqrt(np.einsum("kiki->ki", joint.reshape(epochs, len(used), epochs, -1)))
    ours = np.hstack(
        [
            -position_error(*found.position.T, np.rec.fromarrays(after[:, :3].T, names="lat,lon,height")),
            after[:, 3:6] - found.velocity,
            attitude_error(after[:, 6:10], found.attitude),
            (found.estimates - recorder.epochs["estimates"])[:, used[9:]],
        ]
    )
    np.testing.assert_allclose(ours / scale, x / scale, atol=1e-6)
    assert np.abs(x / scale).max() > 0.5
    np.testing.assert_allclose(
        found.sigma[:, used] / scale, np.sqrt(np.einsum("kiki->ki", p)) / scale, rtol=1e-6, atol=1e-12
    )
    nine = scale[:, :9, None] * scale[:, None, :9]
    np.testing.assert_allclose(found.covariance / nine, np.einsum("kikj->kij", p)[:, :9, :9] / nine, atol=1e-9)


def navigator(grade="tactical", recorder=None, **settings):
    return AidedNavigator(Strapdown(), believed(grade), Settings(**settings), recorder)


def believed(grade):
    return replace(tuning(GRADES[grade], bias_removed=True), by_rate=np.zeros((3, 3)))


MOTION = turns()


@cache
def exact():
    return record(MOTION, DURATION)


@cache
def flown(seed, grade="tactical"):
    """GNSS is silent for a minute: navigator, smoothed; errors of the filter at samples, of the smoother there and at epochs."""
    rng, noise = np.random.default_rng(seed).spawn(2)
    dtheta, dvel = _own(believed(grade), exact().dtheta, exact().dvel, noise)
    imu, times = replace(exact(), dtheta=dtheta, dvel=dvel), 0.2 * np.arange(1, 5 * DURATION + 1)
    recorder = Recorder()
    found = navigator(grade, recorder)
    begin(found, MOTION.truth([0.0])[0], TILT[grade], rng)
    found.aid(gnss_rows(MOTION.truth(times[(times < OUTAGE[0]) | (times > OUTAGE[1])]), rng))
    answers = found.process(imu)
    smoothed = smooth(recorder)
    return (
        found,
        smoothed,
        wrong(imu.time, *answers),
        wrong(imu.time, *smoothed.correct(imu.time, *answers)),
        wrong(smoothed.time, smoothed.position, smoothed.velocity, smoothed.attitude),
    )


def wrong(time, position, velocity, attitude):
    truth = MOTION.truth(time)
    return np.hstack(
        [
            position_error(*position.T, truth),
            velocity - truth["vel_n"],
            attitude_error(attitude, truth["q_nb"]),
        ]
    )


def rms(errors):
    return np.sqrt((errors**2).sum(axis=1).mean())


@pytest.mark.parametrize("grade", ["tactical", "mems"])
def test_it_is_better_than_the_filter_and_much_better_in_an_outage(grade):
    _, _, filtered, smoothed, _ = flown(1, grade)
    for part in (slice(0, 3), slice(3, 6), slice(6, 9)):
        assert rms(smoothed[:, part]) < 0.7 * rms(filtered[:, part])
    out = slice(round(OUTAGE[0] * 100), round(OUTAGE[1] * 100))
    assert rms(smoothed[out, :3]) < 0.25 * rms(filtered[out, :3])


def test_the_last_epoch_is_the_filters():
    found, smoothed, *_ = flown(1)
    last = np.concatenate([smoothed.position[-1], smoothed.velocity[-1], smoothed.attitude[-1]])
    assert (last[:6] == found.solution[:6]).all()
    np.testing.assert_allclose(last, found.solution, rtol=1e-15)
    assert (smoothed.estimates[-1] == found.estimates).all()
    np.testing.assert_allclose(smoothed.sigma[-1], found.sigma, rtol=1e-12)


def test_it_knows_how_good_it_is():
    """NEES of position, velocity and attitude over ten runs, outage and all, by the chi-square of three states."""
    runs, nees = 10, []
    for seed in range(runs):
        _, smoothed, _, _, errors = flown(seed)
        parts = [slice(3 * k, 3 * k + 3) for k in range(3)]
        whitened = [np.linalg.solve(smoothed.covariance[:, p, p], errors[:, p, None])[..., 0] for p in parts]
        nees.append([(errors[:, p] * w).sum(axis=1).mean() for p, w in zip(parts, whitened, strict=True)])
    assert (np.abs(np.mean(nees, axis=0) - 3.0) < 4.0 * math.sqrt(6.0 / runs)).all()
    assert (np.abs(np.mean(nees, axis=0) - 3.0) < 1.0).all()


def test_no_measurement_makes_it_less_sure():
    """Later measurements: of every state no more doubt than the filter's, and late in an outage much less."""
    recorder = Recorder()
    found, sure = navigator(recorder=recorder), []
    begin(found, MOTION.truth([0.0])[0], TILT["tactical"], np.random.default_rng(3))
    times = 0.2 * np.arange(1, 150)
    found.aid(gnss_rows(MOTION.truth(times[(times < 8.0) | (times > 22.0)]), np.random.default_rng(4)))
    for k in range(30):
        found.process(exact().rows(100 * k, 100 * k + 100))
        sure.append(found.sigma)
    smoothed = smooth(recorder)
    ours = smoothed.sigma[np.searchsorted(smoothed.time, np.arange(1.0, 31.0) - 1e-6)]
    assert (ours <= np.array(sure) * (1.0 + 1e-9)).all()
    assert (ours[20, :3] < 0.5 * np.array(sure)[20, :3]).all()


def test_between_epochs_it_is_as_smooth_as_the_motion():
    """No step of the error from sample to sample, where the filter's are steps of metres; at the epochs it is theirs."""
    _, smoothed, filtered, errors, at_epochs = flown(1, "mems")
    assert np.abs(np.diff(filtered[100:, :3], axis=0)).max() > 0.5
    assert np.abs(np.diff(errors[100:, :3], axis=0)).max() < 2e-3
    rows = np.rint(smoothed.time[1:] * 100).astype(int) - 1
    np.testing.assert_allclose(errors[rows, :6], at_epochs[1:, :6], atol=1e-6)


def short(recorder, order, cuts=(), late=(), **settings):
    """Twelve seconds with GNSS in any order, some of it late."""
    found, imu = navigator(recorder=recorder, **settings), exact().rows(0, 1200)
    begin(found, MOTION.truth([0.0])[0], TILT["tactical"], np.random.default_rng(3))
    rows = gnss_rows(MOTION.truth(0.2 * np.arange(1, 60) - 0.003), np.random.default_rng(4))
    found.aid(rows[[k for k in order if k not in late]])
    for start, stop in pairwise([0, *cuts, len(imu)]):
        found.process(imu.rows(start, stop))
        due = [k for k in late if stop >= 20 * k + 30]
        if due:
            found.aid(rows[due])
            late = [k for k in late if k not in due]
    return found


def test_late_measurements_and_batches_change_no_bit():
    one, other = Recorder(), Recorder()
    short(one, range(59))
    short(other, reversed(range(59)), (333, 471, 480, 700, 1010), late=[14, 15, 21, 40])
    for name in ("time", "position", "velocity", "attitude", "estimates", "sigma", "covariance"):
        np.testing.assert_array_equal(getattr(smooth(one), name), getattr(smooth(other), name))


def test_being_recorded_changes_no_bit():
    with_it, without = short(Recorder(), range(59)), short(None, range(59))
    assert (with_it.solution == without.solution).all()
    assert (with_it.covariance == without.covariance).all()


def test_a_restart_parts_what_was_before_from_what_comes():
    """GNSS jumps by a kilometre and stays there: until the restart the smoothed flight is where it was."""
    imu, times = exact().rows(0, 6000), 0.2 * np.arange(1, 300)
    rows = gnss_rows(MOTION.truth(times), np.random.default_rng(4))
    rows["value"][times > 20.0, 0] += 1000.0 / 6.37e6
    recorder = Recorder()
    found = navigator(recorder=recorder, restart_s=10.0)
    begin(found, MOTION.truth([0.0])[0], TILT["tactical"], np.random.default_rng(3))
    found.aid(rows)
    answers = found.process(imu)
    (restart,) = found.restarts()
    smoothed = smooth(recorder)
    (twice,) = np.flatnonzero(np.diff(smoothed.time) == 0.0)
    assert smoothed.time[twice] == restart.time
    epochs = wrong(smoothed.time, smoothed.position, smoothed.velocity, smoothed.attitude)
    assert np.abs(epochs[: twice + 1, 0]).max() < 10.0
    assert np.abs(epochs[twice + 1 :, 0] - 1000.0).max() < 10.0
    assert (smoothed.position[twice] == recorder.epochs["before"][twice, :3]).all()
    samples = wrong(imu.time, *smoothed.correct(imu.time, *answers))
    before = imu.time < restart.time - 1e-9
    assert np.abs(samples[before, 0]).max() < 10.0
    assert np.abs(samples[~before, 0] - 1000.0).max() < 10.0


def test_a_second_start_is_a_run_of_its_own():
    one, both = Recorder(), Recorder()
    short(one, range(59))
    found = short(both, range(59))
    begin(found, MOTION.truth([0.0])[0], TILT["tactical"], np.random.default_rng(9))
    found.process(exact().rows(0, 300))
    smoothed = smooth(both)
    assert smoothed.runs == (0, len(one.epochs))
    np.testing.assert_array_equal(smoothed.position[: smoothed.runs[1]], smooth(one).position)
    with pytest.raises(HilError, match="started 2 times"):
        smoothed.correct(np.zeros(1), np.zeros((1, 3)), np.zeros((1, 3)), np.zeros((1, 4)))
    with pytest.raises(HilError, match="nothing was recorded"):
        smooth(Recorder())


def test_a_start_that_knows_nothing_is_found_from_behind():
    """Doubts of 100 km and 1 km/s leave no rounding: the smoothed start is as sure as from doubts that are small beside them."""
    sure = []
    for doubt in (1e3, 1e5):
        recorder = Recorder()
        found, row = navigator(recorder=recorder), MOTION.truth([0.0])[0]
        place = row["lat"] + 2e3 / 6.37e6 * (doubt > 1e3), row["lon"], row["height"]
        sigma = np.array([doubt] * 3 + [1e-2 * doubt] * 3 + [0.01, 0.01, 0.1])
        found.start(0.0, *place, row["vel_n"], row["q_nb"], sigma)
        found.aid(gnss_rows(MOTION.truth(0.2 * np.arange(1, 150)), np.random.default_rng(4)))
        found.process(exact().rows(0, 3000))
        smoothed = smooth(recorder)
        assert np.abs(wrong(smoothed.time, smoothed.position, smoothed.velocity, smoothed.attitude)[:, :3]).max() < 2.0
        assert np.linalg.eigvalsh(smoothed.covariance).min() > 0.0
        sure.append(smoothed.sigma[0, :6])
    np.testing.assert_allclose(sure[1], sure[0], rtol=0.01)


def test_an_hour_of_all_states_fits():
    """35 states, 50 intervals a second, GNSS, magnetometer and barometer: the record and the result of an hour, below 0.6 GB."""
    recorder = Recorder()
    everything = tuning(GRADES["mems"], tuple(Block))
    found = AidedNavigator(Strapdown(), everything, Settings(), recorder)
    begin(found, MOTION.truth([0.0])[0], TILT["mems"], np.random.default_rng(3))
    found.aid(gnss_rows(MOTION.truth(0.07 * np.arange(1, 570)), np.random.default_rng(4), GNSS_SIGMA))
    found.process(exact().rows(0, 4000))
    smoothed = smooth(recorder)
    held = [recorder.epochs, recorder.rows, *(part for mark in recorder.marks for part in mark[2:])]
    held += [getattr(smoothed, name) for name in smoothed.__slots__ if name != "runs"]
    assert len(recorder.rows) > 80 * 40
    assert len(recorder.epochs) > 50 * 40
    assert sum(array.nbytes for array in held) * 3600 / 40 < 0.6e9
