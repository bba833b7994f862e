"""The rotor of a dynamically tuned gyro: its motion against closed forms and peers, and where it is stable."""

import math
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from scipy.linalg import expm

from nav.errors import HilError
from nav.instruments.dtg import HEAD, SOURCE, Rotor, generator, move, respond, step_map
from nav.instruments.dtg_stability import growth, stability

TURN = 2.0 * math.pi
rotors = st.builds(
    Rotor.from_ratios,
    spin=st.floats(1.0, 3000.0),
    polar=st.floats(0.5, 2.0),
    cross=st.floats(0.0, 5e4),
    damping=st.floats(0.0, 3000.0),
    stiffness=st.floats(-1e5, 1e5),
)
steps = st.floats(1e-6, 5e-3)


def from_generator(rotor, step, whole):
    """Map of (z, y, mean, change) from that of (Int z, z, y, rate at the start, change)."""
    start = np.zeros((5, 4))
    start[1, 0] = start[2, 1] = start[3, 2] = start[4, 3] = 1.0
    start[3, 3] = -0.5
    return (whole @ start)[[1, 2, 0]]


@given(rotors, steps)
def test_exact_map_is_the_matrix_exponential(rotor, step):
    whole = expm(step * generator(rotor, step))
    expected = from_generator(rotor, step, whole)
    np.testing.assert_allclose(step_map(rotor, step), expected, rtol=0, atol=1e-12 * max(1.0, np.abs(whole).max()))


@pytest.mark.parametrize("step", [1e-4, 1e-2, 0.3])
@pytest.mark.parametrize("apart", [0.0, 1e-14, 1e-9, 1e-4])
def test_exact_map_with_equal_eigenvalues(step, apart):
    """(k - jD)/A = (f - jH)^2 / (4 A^2): stiffness (f^2 - H^2)/4A and cross-stiffness f H/2A."""
    rotor = Rotor(1.0, 1.0, 3.0, -22.75 * (1.0 + apart), 15.0, 10.0)
    first, second = rotor.modes()
    assert abs(first - second) < 20.0 * math.sqrt(apart) + 1e-6
    expected = from_generator(rotor, step, expm(step * generator(rotor, step)))
    np.testing.assert_allclose(step_map(rotor, step), expected, rtol=0, atol=1e-13 * np.abs(expected).max())


def by_runge_kutta(rotor, rate, step):
    """The textbook method on alpha, beta and their derivatives less the input's, the rate linear in the step."""
    a, f, k = rotor.equatorial_inertia, rotor.damping, rotor.stiffness
    h, d = rotor.angular_momentum, rotor.cross_stiffness

    def slope(x, w):
        alpha, beta, y1, y2 = x[:4]
        v1, v2 = y1 - w[0], y2 - w[1]  # alpha', beta'
        a1 = (-f * v1 - k * alpha - h * v2 - d * beta - h * w[1]) / a  # alpha'' + w_x'
        a2 = (-f * v2 - k * beta + h * v1 + d * alpha + h * w[0]) / a
        return np.array([v1, v2, a1, a2, alpha, beta])

    x, out = np.zeros(6), []
    for w0, w1 in pairwise(rate):
        x[4:] = 0.0
        mid = 0.5 * (w0 + w1)
        k1 = slope(x, w0)
        k2 = slope(x + 0.5 * step * k1, mid)
        k3 = slope(x + 0.5 * step * k2, mid)
        k4 = slope(x + step * k3, w1)
        x = x + step / 6.0 * (k1 + 2.0 * k2 + 2.0 * k3 + k4)
        out.append(x.copy())
    return np.array(out)


def test_rk4_map_is_the_textbook_method():
    rate = np.random.default_rng(5).normal(size=(200, 2))
    rotor = replace(HEAD, stiffness=300.0)
    expected = by_runge_kutta(rotor, rate, 5e-4)
    angle, swept = respond(rotor, rate, 5e-4, "rk4")
    np.testing.assert_allclose(angle, expected[:, :2], rtol=0, atol=1e-13)
    np.testing.assert_allclose(swept, expected[:, 4:], rtol=0, atol=1e-16)


def test_rk4_goes_to_the_exact_map_with_the_fourth_order():
    def error(n):
        whole = np.linspace([0.0, 0.3], [1.0, -0.5], n + 1)
        ends = [respond(HEAD, whole, 0.02 / n, method)[0][-1] for method in ("rk4", "exact")]
        return np.linalg.norm(ends[0] - ends[1])

    assert math.log2(error(80) / error(160)) == pytest.approx(4.0, abs=0.1)


@given(rotors, st.integers(0, 2**32 - 1))
def test_two_steps_are_one_of_twice_the_length(rotor, seed):
    w0, w1 = np.random.default_rng(seed).normal(size=(2, 2))
    assume(max(mode.real for mode in rotor.modes()) < 1e3)
    one = respond(rotor, [w0, w1], 1e-3)
    two = respond(rotor, [w0, 0.5 * (w0 + w1), w1], 5e-4)
    np.testing.assert_allclose(two[0][-1], one[0][-1], rtol=0, atol=1e-12)
    np.testing.assert_allclose(two[1].sum(axis=0), one[1][-1], rtol=0, atol=1e-14)


def test_a_free_rotor_stays_still_among_the_stars():
    """Without damping, stiffness and loop the tilt is minus the angle of the case."""
    free = replace(HEAD, damping=0.0).with_loop_gain(0.0)
    edges = np.linspace(0.0, 2.0, 2001)
    turned = np.column_stack([np.sin(3.0 * edges), edges**2])
    mean, change = np.diff(turned, axis=0) / 1e-3, np.zeros((2000, 2))
    angle, swept = np.empty((2000, 2)), np.empty((2000, 2))
    move(step_map(free, 1e-3), free.settled(), mean, change, angle, swept)
    np.testing.assert_allclose(angle, turned[0] - turned[1:], atol=1e-12)
    assert math.isinf(free.lag)
    with pytest.raises(HilError, match="no bound"):
        free.settled((1e-3, 0.0))


def test_the_rebalance_loop_reads_a_constant_rate():
    rate = (0.02, -0.05)
    angle, swept = respond(HEAD, np.tile(rate, (500, 1)), 1e-3, state=HEAD.settled(rate))
    np.testing.assert_allclose(-angle / HEAD.lag, np.tile(rate, (499, 1)), rtol=1e-12)
    np.testing.assert_allclose(-swept / HEAD.lag, np.tile(np.multiply(rate, 1e-3), (499, 1)), rtol=1e-12)


def test_an_open_loop_leaks_by_the_damping_alone():
    """K = 0: D = f Omega, and after a turn of the case the tilt dies with H / (f Omega) = J / f."""
    rotor = HEAD.with_loop_gain(0.0)
    assert rotor.loop_gain == 0.0
    assert rotor.lag == pytest.approx(rotor.polar_inertia / rotor.damping)
    _, slow = rotor.modes()
    assert slow.real == pytest.approx(-1.0 / rotor.lag, rel=0.01)
    angle, _ = respond(rotor, np.zeros((1001, 2)), 1e-3, state=np.array([1e-3, 1e-3 * slow]))
    assert np.hypot(*angle[-1]) == pytest.approx(1e-3 * math.exp(-1.0 / rotor.lag), rel=0.01)
    assert HEAD.loop_gain > 0.0
    assert replace(HEAD, damping=9.96).loop_gain < 0.0 < replace(HEAD, damping=9.95).loop_gain


@given(rotors)
def test_modes_solve_the_characteristic_equation(rotor):
    fast, slow = rotor.modes()
    a = rotor.equatorial_inertia
    p, q = complex(rotor.damping, -rotor.angular_momentum) / a, complex(rotor.stiffness, -rotor.cross_stiffness) / a
    assert abs(fast) >= (1.0 - 1e-12) * abs(slow)
    assert fast + slow == pytest.approx(-p, rel=1e-12)
    assert fast * slow == pytest.approx(q, rel=1e-12)


@pytest.mark.parametrize("pulsation", [-2000.0, -8.0, 8.0, 50.0, 500.0])
def test_harmonic_answer(pulsation):
    """A circular rate exp(j w t) turns z with it, by what angle_per_rate says."""
    rotor = replace(HEAD, stiffness=500.0)
    step = 1e-5
    wave = np.exp(1j * pulsation * step * np.arange(2001))
    answer = complex(rotor.angle_per_rate(1j * pulsation))
    state = np.array([answer, 1.0 + 1j * pulsation * answer])
    angle, swept = respond(rotor, np.column_stack([wave.real, wave.imag]), step, state=state)
    size = abs(answer)
    np.testing.assert_allclose(angle @ [1, 1j], answer * wave[1:], rtol=0, atol=1e-4 * size)
    turned = np.diff(wave) / (1j * pulsation)
    np.testing.assert_allclose(swept @ [1, 1j], answer * turned, rtol=0, atol=1e-4 * size * step)


def test_splitting_the_record_changes_no_bit():
    mean, change = np.random.default_rng(2).normal(size=(2, 1000, 2))
    table = step_map(HEAD, 1.25e-4)
    whole, parts = np.empty((2, 1000, 2)), np.empty((2, 1000, 2))
    move(table, HEAD.settled(), mean, change, *whole)
    state = HEAD.settled()
    for rows in (slice(0, 1), slice(1, 1), slice(1, 700), slice(700, 1000)):
        move(table, state, mean[rows], change[rows], parts[0][rows], parts[1][rows])
    np.testing.assert_array_equal(parts, whole)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"equatorial_inertia": 0.0}, "equatorial_inertia is 0; expected more than 0"),
        ({"polar_inertia": -1.0}, "polar_inertia"),
        ({"spin": 0.0}, "spin"),
        ({"damping": -1e-9}, "damping is -1e-09; expected 0 or more"),
        ({"cross_stiffness": -1.0}, "cross_stiffness"),
        ({"stiffness": math.nan}, "stiffness is nan; expected a finite number"),
    ],
)
def test_what_cannot_be_a_rotor(change, message):
    with pytest.raises(HilError, match=message):
        replace(HEAD, **change)


def test_requests_that_cannot_be_met():
    with pytest.raises(HilError, match="a step of 0"):
        step_map(HEAD, 0.0)
    with pytest.raises(HilError, match="there is: exact, rk4"):
        step_map(HEAD, 1e-3, "euler")
    with pytest.raises(HilError, match=r"expected \(n \+ 1, 2\)"):
        respond(HEAD, np.zeros((5, 3)), 1e-3)
    with pytest.raises(HilError, match="not finite"):
        respond(HEAD, np.full((5, 2), np.nan), 1e-3)
    with pytest.raises(HilError, match="there is: continuous"):
        stability(HEAD, "rk5")
    with pytest.raises(HilError, match="a step of -1"):
        stability(HEAD, "exact", -1.0)


def test_published_limits_are_those_of_rk4():
    ((low, high),) = stability(SOURCE, "rk4", 1e-3).intervals
    assert low / TURN == pytest.approx(130.0, abs=1.0)
    assert high / TURN == pytest.approx(337.0, abs=1.0)
    assert high * SOURCE.polar_inertia * 1e-3 == pytest.approx(math.sqrt(8.0), rel=0.005)  # on the imaginary axis
    ((other, _),) = stability(SOURCE, "rk4", 5e-4).intervals  # half the step: the limits of the same gyro move
    assert other / TURN > 180.0


@pytest.mark.parametrize("rotor", [SOURCE, HEAD])
def test_the_rotor_and_its_exact_map_are_stable_from_one_speed_on(rotor):
    for kind in ("continuous", "exact"):
        result = stability(rotor, kind, 1e-3)
        ((low, high),) = result.intervals
        assert low == pytest.approx(rotor.cross_stiffness / rotor.polar_inertia / rotor.damping, rel=1e-4)
        assert high / TURN == pytest.approx(2000.0)
        assert result.growth == pytest.approx(1.0 / rotor.lag - rotor.damping, abs=1e-3)
        assert result.stable == (rotor is HEAD)


@pytest.mark.parametrize(("spin_hz", "grows"), [(128.0, True), (132.0, False), (336.0, False), (339.0, True)])
def test_what_the_chart_says_of_rk4_happens(spin_hz, grows):
    rotor = replace(SOURCE, spin=TURN * spin_hz)
    rate = np.zeros((12_001, 2))
    rate[0] = 1e-3
    angle, _ = respond(rotor, rate, 1e-3, "rk4")
    size = np.hypot(*angle.T)
    assert (size[-1000:].max() > size[4000:5000].max()) == grows


@pytest.mark.parametrize("method", ["exact", "rk4"])
def test_growth_is_that_of_the_simulation(method):
    rotor, step = replace(SOURCE, spin=TURN * 110.0), 1e-3
    rate = np.zeros((3001, 2))
    rate[0] = 1e-3
    angle, _ = respond(rotor, rate, step, method)
    size = np.hypot(*angle.T)
    assert np.log(size[-1] / size[-1001]) == pytest.approx(growth(rotor, method, step), rel=1e-3)
