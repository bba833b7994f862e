"""The head's combination: mounting and the two y axes."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from nav.increments import HeadIncrements
from nav.instruments.head import HeadCombiner


def head(dtheta, dvel):
    batch = HeadIncrements.empty(len(dtheta))
    batch.dtheta[:], batch.dvel[:] = dtheta, dvel
    batch.time[:] = np.arange(len(dtheta))
    batch.sequence[:] = 7 + np.arange(len(dtheta))
    return batch


def test_axes_of_the_two_gyros():
    imu = HeadCombiner(np.eye(3)).combine(head([[1.0, 2.0, 4.0, 8.0]], [[0.1, 0.2, 0.3]]))
    assert imu.dtheta[0].tolist() == [1.0, 3.0, 8.0]
    assert imu.dvel[0].tolist() == [0.1, 0.2, 0.3]
    assert imu.sequence[0] == 7


@given(st.tuples(*[st.floats(-180, 180)] * 3), st.integers(0, 600), st.integers(0, 2**32))
def test_mounting_turns_head_axes_into_body_axes(angles, n, seed):
    mounting = Rotation.from_euler("ZYX", angles, degrees=True)
    random = np.random.default_rng(seed)
    x, y, z = random.normal(size=(3, n))
    dvel = random.normal(size=(n, 3))
    imu = HeadCombiner(mounting.as_matrix()).combine(head(np.stack([x, y, y, z], axis=1), dvel))
    assert len(imu) == n
    if n:
        np.testing.assert_allclose(imu.dtheta, mounting.apply(np.stack([x, y, z], axis=1)), atol=1e-14)
        np.testing.assert_allclose(imu.dvel, mounting.apply(dvel), atol=1e-14)


@pytest.mark.parametrize("sizes", [(10, 300, 5), (1, 1, 2000)])
def test_every_batch_size_gives_the_same_rows(sizes):
    data = np.random.default_rng(1).normal(size=(sum(sizes), 7))
    mounting = Rotation.from_euler("ZYX", [30, 20, 10], degrees=True).as_matrix()
    whole = HeadCombiner(mounting).combine(head(data[:, :4], data[:, 4:]))
    combiner, start = HeadCombiner(mounting), 0
    for size in sizes:
        part = combiner.combine(head(data[start : start + size, :4], data[start : start + size, 4:]))
        np.testing.assert_array_equal(part.dtheta, whole.dtheta[start : start + size])
        np.testing.assert_array_equal(part.dvel, whole.dvel[start : start + size])
        start += size
