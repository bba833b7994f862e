"""Weights of a head's axes: what they leave of the drift, and that no others leave less."""

import math
from dataclasses import replace

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from nav.increments import HeadIncrements
from nav.instruments.axis_drift import axis_variances, body_drift
from nav.instruments.grades import GRADES
from nav.instruments.gyro_errors import DTG_HEAD, Gyros
from nav.instruments.head import HeadCombiner, HeadModel
from nav.instruments.redundancy import Limits, combination, layout

DEG_H = math.radians(1.0) / 3600.0
G = 9.80665
UPRIGHT, UPSIDE = np.eye(3), Rotation.from_euler("Y", 90, degrees=True).as_matrix()


def test_gravity_spares_the_gyro_that_spins_along_it():
    """DTG: 0.01 deg/h of bias, 0.003 of flicker, 0.05 deg/h/g across the spin axis."""
    calm, driven = 0.01**2 + 0.003**2, 0.01**2 + 0.003**2 + 0.05**2
    np.testing.assert_allclose(axis_variances(GRADES["dtg"], UPRIGHT) / DEG_H**2, [calm, calm, driven, driven])
    np.testing.assert_allclose(
        axis_variances(GRADES["dtg"], UPSIDE) / DEG_H**2, [driven, driven, calm, calm], rtol=1e-9
    )


def test_drawn_heads_scatter_as_the_weights_say():
    """A thousand heads of the grade at rest, through the product's own combination; no flicker, no noise."""
    grade, n = replace(GRADES["tactical"], gyro_channels=DTG_HEAD, gyro_flicker=0.0, gyro_white=0.0), 1000
    variances = axis_variances(grade, UPRIGHT)
    rng, turned, pushed = np.random.default_rng(2), np.zeros((1, 3)), np.array([[0.0, 0.0, -G]])
    batch = HeadIncrements.empty(n)
    batch.step[:], batch.time[:] = 1.0, np.arange(1, n + 1)
    for k in range(n):
        batch.dtheta[k] = Gyros(grade.draw(rng)[0], 1.0, rng).sense(turned, pushed)[0]
    scatter = HeadCombiner(HeadModel(UPRIGHT, variances=variances)).combine(batch).dtheta.std(axis=0)
    np.testing.assert_allclose(scatter, body_drift(variances, UPRIGHT, 0.0), rtol=4.0 / math.sqrt(2.0 * n))


@given(
    weights=st.lists(st.floats(0.05, 20.0), min_size=4, max_size=4),
    skew=st.floats(0.0, 0.8),
    mounting=st.tuples(*[st.floats(-180, 180)] * 3),
)
def test_no_other_weights_leave_less(weights, skew, mounting):
    c_bh = Rotation.from_euler("ZYX", mounting, degrees=True).as_matrix()
    variances = axis_variances(GRADES["dtg"], c_bh)
    other = c_bh @ combination(layout(skew), np.array(weights))
    left = np.sqrt(np.einsum("ij,j,ij->i", other, variances, other))
    assert (body_drift(variances, c_bh, skew) <= left * (1.0 + 1e-9)).all()


def test_a_lost_axis_leaves_the_pair_to_the_other_one():
    """The weight is no obstacle: where the good axis of the pair dies, the other one carries y alone."""
    limits = Limits(gyro_noise=1e-6)
    combiner = HeadCombiner(HeadModel(UPRIGHT, limits=limits, variances=axis_variances(GRADES["dtg"], UPRIGHT)))
    batch = HeadIncrements.empty(400)
    batch.step[:], batch.time[:] = 1e-3, 1e-3 * np.arange(1, 401)
    batch.dtheta[:] = 1e-6 * math.sqrt(1e-3) * np.random.default_rng(1).standard_normal((400, 4))
    batch.dtheta[:, 1] = 0.0
    imu = combiner.combine(batch)
    assert list(combiner.failed()) == ["g1y"]
    np.testing.assert_allclose(imu.dtheta[200:, 1], batch.dtheta[200:, 2], rtol=1e-12)
