"""Error models of gyros and accelerometers: tumble tests, rectification, conditions, converter, streams; the grades."""

import math

import allantools
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from nav.errors import HilError
from nav.instruments.accelerometer_errors import AccelerometerErrors, Accelerometers
from nav.instruments.grades import GRADES
from nav.instruments.gyro_errors import DTG_HEAD, GyroErrors, Gyros
from nav.instruments.noise import NoiseModel

STEP, G = 1e-3, 9.8
RNG = np.random.default_rng(2)


def rng():
    return np.random.default_rng(4)


def static_force(errors, force):
    """Output of the first channel under a steady force, m/s^2, the vibration's variance settled."""
    dvel = np.tile(np.array(force, float) * STEP, (3000, 1))
    return Accelerometers(errors, STEP, rng()).sense(dvel)[-1, 0] / STEP


def static_rate(errors, rate, force=(0, 0, 0), **conditions):
    return (
        Gyros(errors, STEP, rng()).sense(np.array([rate], float) * STEP, np.array([force], float) * STEP, **conditions)[
            0
        ]
        / STEP
    )


@pytest.mark.parametrize("errors", [AccelerometerErrors(), GyroErrors(), GyroErrors(channels=DTG_HEAD)])
def test_without_errors_the_instrument_is_ideal(errors):
    a, b = RNG.normal(0, 1, (2, 50, 3))
    if isinstance(errors, AccelerometerErrors):
        out = Accelerometers(errors, STEP, rng()).sense(a)
    else:
        out = Gyros(errors, STEP, rng()).sense(a, b)
    np.testing.assert_allclose(out, a[:, [triple[0] for triple in errors.channels]], rtol=1e-15)


def test_a_tumble_in_the_vertical_plane_shows_the_coefficients():
    """IEEE 1293: the Fourier coefficients of the output over the angle of a dividing head, in closed form."""
    k0, k1, k2, k3, kip, kpp, mp = 3e-3, 2e-4, 5e-5, 4e-6, 7e-5, 2e-5, 1e-3
    errors = AccelerometerErrors(
        bias=k0, scale=k1, quadratic=k2, cubic=k3, cross_ip=kip, pendulous_square=kpp, misalignment_pendulous=mp
    )
    angles = np.arange(12) * math.pi / 6
    found = [static_force(errors, (G * math.sin(t), 0.0, G * math.cos(t))) for t in angles]
    design = [np.ones(12)]
    for n in (1, 2, 3):
        design += [np.sin(n * angles), np.cos(n * angles)]
    c0, s1, c1, s2, c2, s3, _ = np.linalg.lstsq(np.array(design).T, found, rcond=None)[0]
    assert c0 == pytest.approx(k0 + (k2 + kpp) * G**2 / 2, rel=1e-6)
    assert s1 == pytest.approx(G * (1 + k1) + 0.75 * k3 * G**3, rel=1e-9)
    assert c1 == pytest.approx(mp * G, rel=1e-6)
    assert s2 == pytest.approx(kip * G**2 / 2, rel=1e-6)
    assert c2 == pytest.approx((kpp - k2) * G**2 / 2, rel=1e-6)
    assert s3 == pytest.approx(-0.25 * k3 * G**3, rel=1e-6)


@given(*[st.floats(-0.9, 0.9)] * 3)
def test_odd_and_cross_terms(a, b, c):
    force = np.array([a, b, c])
    errors = AccelerometerErrors(
        asymmetry=2e-3, odd_quadratic=1e-3, misalignment_output=3e-3, cross_io=4e-3, cross_po=5e-3, output_square=6e-3
    )
    expected = a + 1e-3 * abs(a) + 1e-3 * a * abs(a) + 3e-3 * b + 4e-3 * a * b + 5e-3 * b * c + 6e-3 * b * b
    assert static_force(errors, force) == pytest.approx(expected, abs=1e-12)


def test_vibration_rectifies():
    time = np.arange(20_000) * STEP
    vibration = 30.0 * np.sin(2 * math.pi * 70.0 * time)
    dvel = np.outer(vibration * STEP, [1.0, 0.0, 0.0])
    whole = slice(10_000, None)  # whole periods, the variance settled
    by_k2 = Accelerometers(AccelerometerErrors(quadratic=1e-5), STEP, rng()).sense(dvel)[whole, 0].mean() / STEP
    assert by_k2 == pytest.approx(1e-5 * 450.0, rel=1e-3)
    errors = AccelerometerErrors(rectification=1e-5)
    dvel[:, 0] += G * STEP
    by_kv = Accelerometers(errors, STEP, rng()).sense(dvel)[whole, 0].mean() / STEP - G
    assert by_kv == pytest.approx(1e-5 * 450.0, rel=0.03)
    assert static_force(errors, (G, 0, 0)) == pytest.approx(G, abs=1e-12)  # not of a steady force


def test_gyro_drifts_with_force_as_a_tumble_shows():
    errors = GyroErrors(
        bias=1e-6, unbalance=2e-7, quadrature=3e-7, axial=4e-7, anisoelasticity=5e-8, anisoelasticity_quadrature=6e-8
    )
    for turn in Rotation.random(10, random_state=1).as_matrix():
        f = G * turn[0]
        drift = static_rate(errors, (0, 0, 0), f)
        for i, o, s in errors.channels:
            expected = 1e-6 + 2e-7 * f[i] + 3e-7 * f[o] + 4e-7 * f[s] + 5e-8 * f[i] * f[s] + 6e-8 * f[o] * f[s]
            assert drift[i] == pytest.approx(expected, abs=1e-16)


def test_gyro_scale_misalignment_and_the_axes_of_the_head():
    errors = GyroErrors(
        scale=(1e-3, 2e-3, 3e-3, 4e-3),
        asymmetry=1e-2,
        misalignment_other=5e-3,
        misalignment_spin=7e-3,
        channels=DTG_HEAD,
    )
    x, y, z = w = np.array([0.3, -0.5, 0.8])
    expected = [
        x * 1.001 + 5e-3 * abs(x) + 5e-3 * y + 7e-3 * z,
        y * 1.002 + 5e-3 * abs(y) + 5e-3 * x + 7e-3 * z,
        y * 1.003 + 5e-3 * abs(y) + 5e-3 * z + 7e-3 * x,
        z * 1.004 + 5e-3 * abs(z) + 5e-3 * y + 7e-3 * x,
    ]
    np.testing.assert_allclose(static_rate(errors, w), expected, rtol=1e-12)


def test_temperature_and_rotor_speed():
    gyro = GyroErrors(bias_temperature=(1e-6, 2e-8), scale_temperature=(1e-5,), bias_speed=1e-4, scale_speed=-1.0)
    found = static_rate(gyro, (1.0, 0, 0), temperature=10.0, speed=1e-3)[0]
    assert found == pytest.approx(1.0 + 1e-4 - 1e-3 + 1e-5 + 2e-6 + 1e-7, rel=1e-12)
    force = AccelerometerErrors(bias_temperature=(0.0, (1e-4, 0.0, -1e-4)), scale_temperature=(1e-6,))
    dvel = np.full((3, 3), G * STEP)
    out = Accelerometers(force, STEP, rng()).sense(dvel, [0.0, 1.0, 2.0]) / STEP - G
    np.testing.assert_allclose(out[:, 0], [0.0, 1e-4 + 1e-6 * G, 4e-4 + 2e-6 * G], atol=1e-13)
    np.testing.assert_allclose(out[:, 2], [0.0, -1e-4 + 1e-6 * G, -4e-4 + 2e-6 * G], atol=1e-13)


def test_pulses_are_whole_and_nothing_is_lost():
    pulse = 1e-5
    dtheta = np.cumsum(RNG.normal(0, 1e-5, (5000, 3)), axis=0) * 0.1
    out = Gyros(GyroErrors(pulse=pulse), STEP, rng()).sense(dtheta, np.zeros_like(dtheta))
    np.testing.assert_allclose(out / pulse, np.round(out / pulse), atol=1e-6)
    assert np.abs(np.cumsum(out, axis=0) - np.cumsum(dtheta, axis=0)).max() <= 0.5 * pulse * (1 + 1e-6)


def test_the_limit_holds_and_is_counted():
    dvel = np.outer([0.5, 2.0, -3.0, 0.9], [1.0, 0.0, -1.0]) * STEP
    sensors = Accelerometers(AccelerometerErrors(limit=1.0), STEP, rng())
    np.testing.assert_allclose(sensors.sense(dvel)[:, 0] / STEP, [0.5, 1.0, -1.0, 0.9])
    np.testing.assert_array_equal(sensors.saturated, [2, 0, 2])


FULL = {"bias": 1e-3, "scale": 1e-3, "limit": 1e3, "pulse": 1e-6, "noise": NoiseModel(1e-4, 1e-4, 1e-4, 1e-6)}


@settings(max_examples=20, deadline=None)
@given(st.lists(st.integers(0, 40), max_size=4).map(sorted))
def test_chunks_do_not_matter(splits):
    a, b = np.random.default_rng(6).normal(0, 1e-2, (2, 40, 3))
    heat = np.linspace(0.0, 5.0, 40)

    def stream(cuts):
        gyros = Gyros(GyroErrors(bias_temperature=(1e-4,), channels=DTG_HEAD, **FULL), STEP, rng())
        forces = Accelerometers(AccelerometerErrors(rectification=1e-2, **FULL), STEP, rng())
        parts = [
            np.hstack([gyros.sense(a[i:j], b[i:j], heat[i:j]), forces.sense(b[i:j], heat[i:j])])
            for i, j in zip([0, *cuts], [*cuts, 40], strict=True)
        ]
        return np.concatenate(parts)

    np.testing.assert_array_equal(stream(splits), stream([]))


@pytest.mark.parametrize(
    ("kind", "change", "message"),
    [
        (GyroErrors, {"bias": (1.0, 2.0)}, "bias must be a number or 3"),
        (GyroErrors, {"scale": math.nan}, "scale"),
        (GyroErrors, {"channels": ((0, 0, 1),)}, "axes"),
        (AccelerometerErrors, {"limit": 0.0}, "limit"),
        (AccelerometerErrors, {"pulse": -1.0}, "pulse"),
        (AccelerometerErrors, {"bias_temperature": (1.0, (1.0, 2.0))}, r"bias_temperature\[1\]"),
    ],
)
def test_impossible_errors_are_refused(kind, change, message):
    with pytest.raises(HilError, match=message):
        kind(**change)


def test_wrong_increments_are_refused():
    with pytest.raises(HilError, match="finite"):
        Accelerometers(AccelerometerErrors(), STEP, rng()).sense(np.full((1, 3), np.nan))
    with pytest.raises(HilError, match="shape"):
        Gyros(GyroErrors(), STEP, rng()).sense(np.zeros((2, 3)), np.zeros((3, 3)))


DEG_H = math.radians(1.0) / 3600.0
TABLE = {  # deg/h, deg/sqrt(h), ppm, arcsec, deg/h/g; ug, ug/sqrt(Hz), ppm
    "dtg": (0.01, 0.002, 50, 5, 0.05, 10, 5, 50),
    "tactical": (1.0, 0.05, 300, 100, 1.0, 1000, 50, 300),
    "mems": (720.0, 0.3, 5000, 720, 36.0, 5000, 120, 3000),
}


@pytest.mark.parametrize("name", GRADES)
def test_draws_have_the_spread_of_the_table(name):
    source = np.random.default_rng(11)
    draws = [GRADES[name].draw(source) for _ in range(1500)]
    spread = [
        np.std([np.array(getattr(draw[which], field)) for draw in draws]) / unit
        for which, field, unit in (
            (0, "bias", DEG_H),
            (0, "scale", 1e-6),
            (0, "misalignment_other", math.radians(1.0 / 3600.0)),
            (0, "unbalance", DEG_H / 9.80665),
            (1, "bias", 9.80665e-6),
            (1, "scale", 1e-6),
        )
    ]
    expected = [TABLE[name][i] for i in (0, 2, 3, 4, 5, 7)]
    np.testing.assert_allclose(spread, expected, rtol=0.05)


@pytest.mark.parametrize("name", GRADES)
def test_random_walks_are_those_of_the_table(name):
    gyro_errors, force_errors = GRADES[name].draw(np.random.default_rng(1), bias_removed=True)
    step, zero = 0.01, np.zeros((100_000, 3))
    turned = Gyros(gyro_errors, step, rng()).sense(zero, zero)
    pushed = Accelerometers(force_errors, step, rng()).sense(zero)
    for out, expected in ((turned, math.radians(TABLE[name][1]) / 60.0), (pushed, TABLE[name][6] * 9.80665e-6)):
        found = [
            allantools.oadev(column / step, rate=1 / step, data_type="freq", taus=[0.01])[1][0] for column in out.T
        ]
        # White noise rules at the shortest time; flicker adds its share
        assert np.mean(found) / math.sqrt(1 / 0.01) == pytest.approx(expected, rel=0.05)


def test_bias_removed_at_rest():
    spread = np.std([GRADES["mems"].draw(RNG, bias_removed=True)[0].bias for _ in range(1000)])
    assert spread == pytest.approx(10.0 * DEG_H, rel=0.05)
