"""Lag compensation: closed forms over frequency against simulation, and what a stream may bring."""

import math
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from nav.errors import HilError
from nav.increments import HeadIncrements
from nav.instruments.dtg import HEAD, move, step_map
from nav.instruments.dtg_compensation import LagCompensator, end_weights
from nav.instruments.dtg_response import (
    compensated_response,
    noise_gain,
    noise_spectrum,
    raw_response,
    taps,
)

STEP, INSIDE = 1e-3, 8
LAG_ERROR = replace(HEAD, cross_stiffness=HEAD.cross_stiffness / 1.02)
FORMS = pytest.mark.parametrize("with_angles", [True, False])


def harmonic(pulsation, n, axis=0, rotor=HEAD, lengths=None):
    """A head whose gyro axes x and y of both gyros turn as sin(w t) / w about one of them, in the steady state.

    Returns the head and the true angles at the ends of its samples; `lengths`: inner steps in each sample.
    """
    lengths = np.full(n, INSIDE) if lengths is None else lengths
    edges = np.arange(lengths.sum() + 1) * (STEP / INSIDE)
    unit = np.eye(2)[axis]
    angle = np.outer(np.sin(pulsation * edges) / pulsation, unit)
    rate = np.outer(np.cos(pulsation * edges), unit)
    waves = np.array([1j * pulsation, -1j * pulsation])
    tilts = 0.5 * complex(*unit) * rotor.angle_per_rate(waves)
    state = np.array([tilts.sum(), complex(*unit) + tilts @ waves])
    z, swept = np.empty((len(edges) - 1, 2)), np.empty((len(edges) - 1, 2))
    mean, change = np.diff(angle, axis=0) * (INSIDE / STEP), np.diff(rate, axis=0)
    move(step_map(rotor, STEP / INSIDE), state, mean, change, z, swept)
    ends = np.cumsum(lengths)
    head = HeadIncrements.empty(n)
    head.step[:], head.sequence[:] = lengths * (STEP / INSIDE), 5 + np.arange(n)
    current = -np.add.reduceat(swept, ends - lengths) / rotor.lag
    head.dtheta[:], head.rotor[:] = np.tile(current, 2), np.tile(z[ends - 1], 2)
    return head, np.vstack([angle[0], angle[ends]])


def compensate(head, with_angles=True, taken_for=HEAD):
    out = np.empty_like(head.dtheta)
    rotor = head.rotor if with_angles else np.full_like(head.rotor, np.nan)
    LagCompensator(taken_for, taken_for).compensate(replace(head, rotor=rotor), out)
    return out


def predicted(response, pulsation, n, axis):
    """Increments of both axes from the answer to a rate cos(w t) about `axis`."""
    middle = (np.arange(n) + 0.5) * STEP
    swing = math.sin(0.5 * pulsation * STEP) / (0.5 * pulsation) * np.exp(1j * pulsation * middle)
    same, cross = (response.same * swing).real, (response.cross * swing).real
    return np.column_stack([same, cross] if axis == 0 else [-cross, same])


@FORMS
@pytest.mark.parametrize("axis", [0, 1])
@pytest.mark.parametrize("pulsation", [0.1, 8.0, 50.0, 600.0])
@pytest.mark.parametrize("taken_for", [HEAD, LAG_ERROR, replace(HEAD, damping=12.0, stiffness=30.0)])
def test_closed_form_is_what_the_stream_does(pulsation, axis, with_angles, taken_for):
    n = 400
    head, _ = harmonic(pulsation, n, axis)
    response = compensated_response(HEAD, pulsation, STEP, with_angles=with_angles, taken_for=taken_for)
    expected = predicted(response, pulsation, n, axis)[5:]
    tolerance = 1e-11 if pulsation <= 50.0 else 1e-6  # what is left: the curvature of the rate in an inner step
    np.testing.assert_allclose(
        compensate(head, with_angles, taken_for)[5:], np.tile(expected, 2), rtol=0, atol=tolerance * STEP
    )
    np.testing.assert_allclose(
        head.dtheta[:, :2], predicted(raw_response(HEAD, pulsation), pulsation, n, axis), rtol=0, atol=tolerance * STEP
    )


@FORMS
def test_goals(with_angles):
    w = np.linspace(0.0, 50.0, 501)
    response = compensated_response(HEAD, w, STEP, with_angles=with_angles)
    assert np.abs(response.amplitude_error).max() < 1e-4
    assert np.degrees(np.abs(response.phase)).max() < 0.02
    assert response.leak.max() < 1e-5
    raw = raw_response(HEAD, 8.0)
    assert abs(raw.same) == pytest.approx(1.0 / math.hypot(1.0, 8.0 * HEAD.lag), rel=1e-3)
    assert math.tan(raw.phase) == pytest.approx(-8.0 * HEAD.lag, rel=1e-2)


def test_without_the_slow_part_of_the_rotors_own_rate_the_other_axis_gets_its_share():
    """The page's term A D / H^2: taking A as 0 leaves it out."""
    bare = replace(HEAD, equatorial_inertia=1e-9)
    leak = compensated_response(HEAD, [8.0, 50.0], STEP, with_angles=True, taken_for=bare).leak
    expected = np.abs(8.0j * np.array([1.0, 50.0 / 8.0]) * raw_response(HEAD, [8.0, 50.0]).same) * HEAD.lag
    share = HEAD.equatorial_inertia * HEAD.cross_stiffness / HEAD.angular_momentum**2
    np.testing.assert_allclose(leak, share * expected, rtol=0.01)
    assert leak.max() > 3e-3


def test_a_wrong_lag_costs_its_share_of_the_fast_part():
    """A constant rate is right, a fast one is wrong by the error of the lag; z on the wire needs no lag."""
    w = np.array([1e-3, 8.0, 1e2])
    error = compensated_response(HEAD, w, STEP, with_angles=False, taken_for=LAG_ERROR).amplitude_error
    turn = w * HEAD.lag
    np.testing.assert_allclose(error[:2], np.hypot(1.0, 1.02 * turn[:2]) / np.hypot(1.0, turn[:2]) - 1.0, atol=1e-5)
    assert error[1] < 0.015
    scale = compensated_response(HEAD, w, STEP, with_angles=True, angle_scale=1.02).amplitude_error
    np.testing.assert_allclose(scale[:2], error[:2], atol=1e-5)
    wire = compensated_response(HEAD, w, STEP, with_angles=True, taken_for=LAG_ERROR).amplitude_error
    assert np.abs(wire).max() < 1e-4


@given(st.lists(st.floats(0.2, 3.0), min_size=4, max_size=4), st.integers(0, 2**32 - 1))
def test_weights_are_exact_for_a_cubic(steps, seed):
    coefficients = np.random.default_rng(seed).normal(size=4)
    rate, angle = np.poly1d(coefficients), np.poly1d(coefficients).integ()
    edges = -np.concatenate([[0.0], np.cumsum(steps)])  # the newest first
    increments = angle(edges[:-1]) - angle(edges[1:])
    assert np.dot(end_weights(*steps), increments) == pytest.approx(rate(0.0), rel=1e-6, abs=1e-6)


@FORMS
@pytest.mark.parametrize("seed", range(3))
def test_unequal_steps(with_angles, seed):
    lengths = np.random.default_rng(seed).integers(4, 13, 600)
    head, angles = harmonic(8.0, 600, lengths=lengths)
    error = np.cumsum(compensate(head, with_angles)[:, 0] - np.diff(angles[:, 0]))[4:]
    equal = compensated_response(HEAD, 8.0, STEP, with_angles=with_angles)
    assert np.ptp(error) < 1.01 * abs(equal.same - 1.0) * np.ptp(angles[:, 0])


def events(seed):
    """A record with lost rotor angles and lost samples."""
    random = np.random.default_rng(seed)
    head, _ = harmonic(8.0, 60)
    head.rotor[random.random(60) < 0.5, :2] = np.nan
    head.rotor[random.random(60) < 0.2, 2:] = np.nan
    head.sequence[:] += np.cumsum(random.random(60) < 0.1)
    head.step[:] *= random.uniform(0.5, 1.5, 60)
    return head


@settings(max_examples=50, deadline=None)
@given(st.integers(0, 2**32 - 1), st.lists(st.integers(0, 60), max_size=8))
def test_splitting_the_stream_changes_no_bit(seed, cuts):
    head = events(seed)
    out, compensator, edges = np.empty((60, 4)), LagCompensator(), [0, *sorted(cuts), 60]
    for start, stop in pairwise(edges):
        compensator.compensate(head.rows(start, stop), out[start:stop])
    np.testing.assert_array_equal(out, compensate(head))
    assert np.isfinite(out).all()
    in_place = replace(head, dtheta=head.dtheta.copy())
    LagCompensator().compensate(in_place, in_place.dtheta)
    np.testing.assert_array_equal(in_place.dtheta, out)


def test_a_sample_without_rotor_angles_takes_the_cubic():
    head, _ = harmonic(50.0, 100)
    whole = compensate(head)
    head.rotor[50, :2] = np.nan
    head.rotor[60:63, 2] = np.nan
    out = compensate(head)
    np.testing.assert_array_equal(out[:50], whole[:50])
    np.testing.assert_array_equal(out[52:60], whole[52:60])
    assert np.abs(out[50:52] - whole[50:52])[:, :2].max() > 0.0
    of_cubic = (50.0 * STEP) ** 4 / 5.0 * abs(HEAD.angle_per_rate(50.0j))  # fourth derivative of z, T^4 / 5
    assert np.abs(out - whole).max() < 1.01 * of_cubic
    np.testing.assert_allclose(out.sum(axis=0), whole.sum(axis=0), rtol=0, atol=1e-15)


@pytest.mark.parametrize("missing", [0, 1, 2])
def test_after_a_gap_z_counts_as_linear_until_it_is_known(missing):
    """`missing`: samples after the gap that lack z although the wire has it from then on."""
    head, _ = harmonic(8.0, 200)
    whole = compensate(head)
    head.sequence[100:] += 3
    head.rotor[100 : 100 + missing] = np.nan
    out = compensate(head)
    np.testing.assert_array_equal(out[100:], compensate(head.rows(100, 200)))
    np.testing.assert_array_equal(out[101 + missing :], whole[101 + missing :])
    bound = ((missing + 1) * STEP * 8.0) ** 2 / 6.0 * abs(HEAD.angle_per_rate(8.0j))  # z'' t^2 / 6
    assert 0.0 < np.abs((out - whole).sum(axis=0)[0]) < 1.01 * bound


def test_after_a_gap_without_z_the_fourth_sample_makes_up_for_the_first_three():
    head, _ = harmonic(8.0, 200)
    whole = compensate(head, with_angles=False)
    head.sequence[100:] += 3
    out = compensate(head, with_angles=False)
    np.testing.assert_array_equal(out[100:103], head.dtheta[100:103])
    np.testing.assert_array_equal(out[104:], whole[104:])
    np.testing.assert_allclose(out.sum(axis=0), whole.sum(axis=0), rtol=0, atol=1e-10)


@pytest.mark.parametrize(
    ("field", "value", "message"),
    [
        ("step", 0.0, "sample 12 has a step of 0.0 s"),
        ("step", math.nan, "sample 12 has a step of nan s"),
        ("dtheta", math.inf, "sample 12 .* finite numbers"),
    ],
)
def test_samples_that_cannot_be(field, value, message):
    head, _ = harmonic(8.0, 20)
    getattr(head, field)[7] = value
    with pytest.raises(HilError, match=message):
        compensate(head)
    with pytest.raises(HilError, match="with_loop_gain"):
        LagCompensator(replace(HEAD, damping=0.0).with_loop_gain(0.0))


@FORMS
def test_noise_gains_of_the_stream(with_angles):
    n = 100_000
    random = np.random.default_rng(3)
    head = HeadIncrements.empty(n)
    head.step[:], head.sequence[:] = STEP, np.arange(n)
    head.dtheta[:] = random.normal(size=(n, 4))
    of_increments, of_angles = noise_gain(HEAD, STEP, with_angles=with_angles)
    out = compensate(head, with_angles)[10:]
    assert out.std() == pytest.approx(of_increments.increment, rel=0.02)
    surplus = (out - head.dtheta[10:]).cumsum(axis=0)
    assert (surplus - surplus.mean(axis=0)).std() == pytest.approx(of_increments.angle, rel=0.02)
    if with_angles:
        head.dtheta[:], head.rotor[:] = 0.0, random.normal(size=(n, 4))
        out = compensate(head)[10:]
        assert out.std() == pytest.approx(of_angles.increment, rel=0.02)
        total = out.cumsum(axis=0)
        assert (total - total.mean(axis=0)).std() == pytest.approx(of_angles.angle, rel=0.02)


@FORMS
def test_noise_spectrum_holds_the_power_of_the_gain(with_angles):
    """Parseval: the mean of the squared spectrum over all frequencies is the squared gain."""
    w = (np.arange(1000) + 0.5) / 1000.0 * math.pi / STEP
    for spectrum, gain in zip(
        noise_spectrum(HEAD, w, STEP, with_angles=with_angles),
        noise_gain(HEAD, STEP, with_angles=with_angles),
        strict=True,
    ):
        assert math.sqrt(np.mean(spectrum**2)) == pytest.approx(gain.increment, rel=1e-9)


@FORMS
def test_the_filter_passes_a_constant_rate(with_angles):
    filters = taps(replace(HEAD, stiffness=0.0), STEP, with_angles=with_angles)
    assert filters.increment.sum() == pytest.approx(1.0)
    assert filters.angle.sum() == pytest.approx(0.0)
