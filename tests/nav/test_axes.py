"""Which way a board's axes point: all 48 ways are told apart, by postures and by motion, whatever the noise of a hand."""

import itertools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from postures import RATE_HZ, SEQUENCE, increments, through
from scipy.spatial.transform import Rotation

from nav.alignment.axes import ROTATIONS, SIGNED, gyro_fit, matrix, named, rotation, turned
from nav.alignment.postures import FORCES, ORDERS, Postures, judged
from nav.errors import HilError
from nav.increments import ImuIncrements

signed = st.integers(0, 47).map(lambda k: SIGNED[k])


def sensed(imu: ImuIncrements, gyro, accelerometer, rng=None) -> ImuIncrements:
    """The same by a board whose axes are those of the body turned back by these, with the errors of a MEMS board."""
    found = ImuIncrements.empty(len(imu))
    found.fill(imu)
    found.dtheta[:], found.dvel[:] = imu.dtheta @ gyro, imu.dvel @ accelerometer  # C' v, row by row
    if rng is not None:
        step = imu.step[:, None]
        found.dtheta[:] += step * (np.radians([1.0, -1.5, 2.0]) + np.radians(0.3) * rng.standard_normal((len(imu), 3)))
        found.dvel[:] += step * (0.2 + 0.05 * rng.standard_normal((len(imu), 3)))
    return found


WHOLE = through(SEQUENCE)


def test_there_are_48_and_half_of_them_are_rotations():
    assert len({one.tobytes() for one in SIGNED}) == 48
    np.testing.assert_allclose(SIGNED @ np.swapaxes(SIGNED, 1, 2), np.broadcast_to(np.eye(3), (48, 3, 3)))
    np.testing.assert_allclose(np.linalg.det(SIGNED), np.repeat([1.0, -1.0], ROTATIONS))


@given(signed)
def test_names_and_matrices_are_one(c):
    if np.linalg.det(c) > 0.0:
        np.testing.assert_array_equal(matrix(named(c)), c)
    else:
        with pytest.raises(HilError, match="left-handed"):
            matrix(named(c))


def test_names_say_which_axis_points_where():
    np.testing.assert_array_equal(matrix(("y", "x", "-z")) @ [1.0, 2.0, 3.0], [2.0, 1.0, -3.0])
    for wrong in (("x", "x", "z"), ("x", "-x", "z")):
        with pytest.raises(HilError, match="once"):
            matrix(wrong)


def test_a_matrix_of_few_digits_is_taken_as_the_rotation_that_is_meant():
    exact = Rotation.from_euler("ZYX", [30, 10, -20], degrees=True).as_matrix()
    found = rotation(np.round(exact, 4))
    np.testing.assert_allclose(found @ found.T, np.eye(3), atol=1e-14)
    np.testing.assert_allclose(found, exact, atol=1e-4)
    for wrong, said in ((np.round(exact, 2), "at right angles"), (-exact, "left-handed"), (2 * exact, "length 1")):
        with pytest.raises(HilError, match=said):
            rotation(wrong)


@given(st.integers(0, 40), st.integers(0, 2**32))
def test_turns_one_after_the_other(n, seed):
    turns = np.random.default_rng(seed).normal(size=(n, 3))
    expected = Rotation.identity()
    for turn in turns:
        expected = expected * Rotation.from_rotvec(turn)
    w, *xyz = turned(turns)
    np.testing.assert_allclose(Rotation.from_quat([*xyz, w]).as_matrix(), expected.as_matrix(), atol=1e-12)


@pytest.mark.parametrize("k", range(48))
def test_the_sequence_shows_gyros_and_accelerometers_each_for_themselves(k):
    """Every way the gyros may lie, beside another one of the accelerometers."""
    gyro, accelerometer = SIGNED[k], SIGNED[(7 * k + 5) % 48]
    postures = Postures()
    postures.take(sensed(WHOLE, gyro, accelerometer, np.random.default_rng(k)))
    by_force, by_turn = judged(postures.found)
    np.testing.assert_array_equal(by_force.c, accelerometer)
    np.testing.assert_array_equal(by_turn.c, gyro)
    assert by_force.certain
    assert by_turn.certain
    assert np.degrees([by_force.off, by_turn.off]).max() < 10.0
    assert by_turn.left_handed == (k >= ROTATIONS)


@settings(max_examples=20)
@given(st.lists(st.integers(1, 400), max_size=8), st.integers(0, 47))
def test_how_the_stream_is_split_changes_nothing(cuts, k):
    imu = sensed(WHOLE, SIGNED[k], SIGNED[0])
    whole, split = Postures(), Postures()
    whole.take(imu)
    edges = [0, *sorted(sum(cuts[: i + 1]) for i in range(len(cuts))), len(imu)]
    for start, stop in itertools.pairwise(edges):
        split.take(imu.rows(min(start, len(imu)), min(stop, len(imu))))
    assert [one.time for one in whole.found] == [one.time for one in split.found]
    assert len(whole.found) == len(ORDERS) == len(FORCES)


def test_a_board_that_is_held_askew_by_a_hand():
    """Postures to 15 deg, the last turn by 60 or 130 deg, are enough."""
    rng = np.random.default_rng(3)
    for last in (60, 130):
        ends = np.array([*SEQUENCE[:-1], (last, 0, 0)], float)
        ends[[1, 3]] += rng.uniform(-15, 15, (2, 3)) * [0, 1, 1]
        postures = Postures()
        postures.take(sensed(through([tuple(one) for one in ends]), SIGNED[9], SIGNED[9], rng))
        for found in judged(postures.found):
            np.testing.assert_array_equal(found.c, SIGNED[9])


@pytest.mark.parametrize(("ends", "count"), [(SEQUENCE[:4], 4), ([*SEQUENCE[:2], (0, 45, 0), *SEQUENCE[2:]], 7)])
def test_another_sequence_is_refused(ends, count):
    postures = Postures()
    postures.take(through(ends))
    with pytest.raises(HilError, match=f"{count} rests were found where the sequence has 6"):
        judged(postures.found)


def test_dead_instruments_are_named():
    deaf, whole = np.diag([0.0, 1.0, 1.0]), np.eye(3)
    for gyro, accelerometer, said in ((deaf, whole, "gyros do not feel"), (whole, 0 * whole, "specific force is zero")):
        postures = Postures()
        postures.take(sensed(WHOLE, gyro, accelerometer))
        with pytest.raises(HilError, match=said):
            judged(postures.found)


def waved(seed: int, still: tuple[int, ...] = ()) -> ImuIncrements:
    """A board that a hand turns about for 20 s; about the axes `still` not at all."""
    rng, t = np.random.default_rng(seed), np.arange(20 * RATE_HZ + 1) / RATE_HZ
    amplitude = rng.uniform(0.5, 1.2, 3)
    amplitude[list(still)] = 0.0
    angles = amplitude * np.sin(2.0 * np.pi * t[:, None] / rng.uniform(2.0, 5.0, 3) + rng.uniform(0.0, 6.0, 3))
    return increments(Rotation.from_euler("ZYX", angles))


@pytest.mark.parametrize("k", range(0, 48, 5))
def test_motion_alone_shows_how_gyros_and_accelerometers_lie_to_each_other(k):
    """Gravity turns against the gyros. Seen from left-handed accelerometers it turns the other way round."""
    rng = np.random.default_rng(k)
    accelerometer = SIGNED[(11 * k + 3) % 48]
    found = gyro_fit(sensed(waved(k), SIGNED[k], accelerometer, rng))
    assert found is not None
    handed = np.round(np.linalg.det(accelerometer))
    np.testing.assert_array_equal(found.c, handed * accelerometer.T @ SIGNED[k])
    assert found.certain
    assert np.degrees(found.off) < 5.0


def test_too_little_motion_is_said_and_not_guessed():
    about_one = gyro_fit(waved(1, still=(0, 2)))
    assert about_one is not None
    assert not about_one.certain
    assert about_one.allows(np.eye(3))
    assert gyro_fit(waved(1, still=(1, 2))) is None, "about the vertical gravity does not turn"
    assert gyro_fit(ImuIncrements.empty(0)) is None
