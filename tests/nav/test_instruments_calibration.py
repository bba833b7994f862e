"""Calibration of a head: it undoes the error models, changes nothing when it is zero, and its fit finds them again."""

import math
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from nav import earth
from nav.errors import HilError
from nav.increments import HeadIncrements
from nav.instruments.accelerometer_errors import AccelerometerErrors, Accelerometers
from nav.instruments.calibration import ACCELEROMETER_TERMS, CASES, GYRO_TERMS, Calibration, Calibrator, cases
from nav.instruments.calibration_fit import fit
from nav.instruments.calibration_stretch import Stretch, steady_part, stretch, without_lag
from nav.instruments.calibration_terms import REQUIRED
from nav.instruments.dtg import HEAD
from nav.instruments.gyro_errors import GyroErrors, Gyros
from nav.instruments.head import HeadCombiner, HeadModel
from nav.instruments.redundancy import layout
from nav.rotation import dcm_from_euler, dcm_from_rotation_vector

STEP, SKEW = 1e-3, math.radians(30.0)
DEG_H, G = math.radians(1.0) / 3600.0, 9.80665
LAT, HEIGHT = math.radians(50.0), 150.0
GYRO_SIZES = {
    "bias": 0.1 * DEG_H,
    "scale": 5e-4,
    "misalignment_other": 2.5e-4,
    "misalignment_spin": 2.5e-4,
    "unbalance": 0.5 * DEG_H / G,
    "quadrature": 0.5 * DEG_H / G,
    "axial": 0.1 * DEG_H / G,
    "asymmetry": 1e-5,
    "anisoelasticity": 0.1 * DEG_H / G**2,
    "anisoelasticity_quadrature": 0.1 * DEG_H / G**2,
}
FORCE_SIZES = {
    "bias": 1e-3,
    "scale": 5e-4,
    "misalignment_output": 2.5e-4,
    "misalignment_pendulous": 2.5e-4,
    "quadratic": 2e-5 / G,
    "cubic": 1e-5 / G**2,
    "cross_io": 1e-5 / G,
    "cross_ip": 1e-5 / G,
    "cross_po": 1e-5 / G,
    "asymmetry": 1e-5,
    "odd_quadratic": 1e-5 / G,
    "output_square": 1e-5 / G,
    "pendulous_square": 1e-5 / G,
}
WHITE = np.repeat([0.002 * math.radians(1.0) / 60.0, 5e-6 * G], [4, 3])


def drawn(rng, *, fitted=False):
    """Errors of every term that a calibration takes off, or of those that a fit finds at one temperature."""
    chosen = [
        REQUIRED[kind] if fitted else sizes for kind, sizes in (("gyro", GYRO_SIZES), ("accelerometer", FORCE_SIZES))
    ]
    gyros = {name: tuple(GYRO_SIZES[name] * rng.standard_normal(4)) for name in GYRO_SIZES if name in chosen[0]}
    forces = {name: tuple(FORCE_SIZES[name] * rng.standard_normal(3)) for name in FORCE_SIZES if name in chosen[1]}
    return GyroErrors(**gyros, channels=CASES), AccelerometerErrors(**forces)


def sensed(gyros, forces, rate, force, skew=0.0, step=STEP, temperature=0.0):
    """Outputs (n, 7) of the error models for rates and forces (n, 3) in head axes."""
    rng, axes = np.random.default_rng(0), cases(skew)
    force = np.ascontiguousarray(np.broadcast_to(force, rate.shape))
    columns = []
    for j in range(4):  # one channel at a time: each sees the motion in the axes of its own case
        one = {name: value[j] for name in GYRO_TERMS if isinstance(value := getattr(gyros, name), tuple)}
        for name in ("bias_temperature", "scale_temperature"):
            one[name] = tuple(power[j] for power in getattr(gyros, name))
        channel = Gyros(GyroErrors(**one, channels=((0, 1, 2),)), step, rng)
        columns.append(channel.sense(step * rate @ axes[j].T, step * force @ axes[j].T, temperature))
    columns.append(Accelerometers(forces, step, rng).sense(step * force, temperature))
    return np.hstack(columns) / step


def record(outputs, temperature=20.0):
    head = HeadIncrements.empty(len(outputs))
    head.time[:], head.step[:] = STEP * np.arange(1, len(outputs) + 1), STEP
    head.sequence[:] = np.arange(len(outputs))
    head.dtheta[:], head.dvel[:] = STEP * outputs[:, :4], STEP * outputs[:, 4:]
    head.temperature[:] = temperature
    return head


@pytest.mark.parametrize("skew", [0.0, SKEW])
def test_it_undoes_the_error_models(skew):
    """What is left is of the second order in the errors."""
    rng = np.random.default_rng(3)
    rate, force = rng.normal(0.0, 0.5, (400, 3)), rng.normal(0.0, 10.0, (400, 3))
    left = []
    for size in (1.0, 0.1):
        gyros, forces = (
            replace(e, **{n: tuple(size * np.asarray(getattr(e, n))) for n in names})
            for e, names in zip(drawn(np.random.default_rng(4)), (GYRO_TERMS, ACCELEROMETER_TERMS), strict=True)
        )
        raw = sensed(gyros, forces, rate, force, skew)
        model = HeadModel(np.eye(3), skew, calibration=Calibration(gyros, forces))
        imu = HeadCombiner(model).combine(record(raw))
        left.append([np.abs(imu.dtheta / STEP - rate).max(), np.abs(imu.dvel / STEP - force).max()])
        plain = HeadCombiner(replace(model, calibration=None)).combine(record(raw))
        assert np.abs(plain.dtheta / STEP - rate).max() > 500.0 * left[-1][0]
        assert np.abs(plain.dvel / STEP - force).max() > 500.0 * left[-1][1]
    ratio = np.array(left[0]) / left[1]
    assert (ratio > 50.0).all(), left


def test_temperature_is_taken_off_and_held_at_the_edge():
    rng = np.random.default_rng(5)
    per = [tuple(1e-6 * rng.standard_normal(4)) for _ in range(3)]
    gyros = GyroErrors(bias_temperature=(per[0], per[1]), scale_temperature=(per[2],), channels=CASES)
    forces = AccelerometerErrors(bias_temperature=((1e-5, 2e-5, 3e-5),), scale_temperature=((1e-6, 2e-6, 3e-6),))
    calibration = Calibration(gyros, forces, None, (20.0,) * 3, (0.0,) * 3, (50.0,) * 3)
    rate, force = np.tile([0.1, 0.2, 0.3], (50, 1)), np.array([1.0, 2.0, -9.0])
    combiner = HeadCombiner(HeadModel(np.eye(3), calibration=calibration))
    for t in (-5.0, 0.0, 20.0, 45.0, 50.0, 60.0):
        imu = combiner.combine(record(sensed(gyros, forces, rate, force, temperature=np.clip(t, 0.0, 50.0) - 20.0), t))
        np.testing.assert_allclose(imu.dtheta / STEP, rate, rtol=1e-12)
        np.testing.assert_allclose(imu.dvel / STEP, np.tile(force, (50, 1)), rtol=1e-12)
    (note,) = combiner.notes()  # said once, though it was outside twice
    assert "gyro 1 -5.0, calibrated 0.0 to 50.0" in note.text
    nothing_said = record(sensed(gyros, forces, rate, force), np.nan)
    combiner = HeadCombiner(HeadModel(np.eye(3), calibration=calibration))
    np.testing.assert_allclose(combiner.combine(nothing_said).dtheta / STEP, rate, rtol=1e-12)


@pytest.mark.parametrize("skew", [0.0, SKEW])
def test_a_calibration_of_nothing_changes_nothing(skew):
    rng = np.random.default_rng(6)
    data = record(rng.normal(0.0, 1.0, (500, 7)))
    data.rotor[:] = -HEAD.lag * data.dtheta / STEP
    model = HeadModel(np.eye(3), skew, rotors=(HEAD, HEAD))
    one, other = (HeadCombiner(m).combine(data) for m in (model, replace(model, calibration=Calibration())))
    np.testing.assert_array_equal(one.dtheta, other.dtheta)
    np.testing.assert_array_equal(one.dvel, other.dvel)


@settings(max_examples=20)
@given(st.lists(st.integers(1, 400), max_size=5))
def test_every_batch_size_gives_the_same_rows(cuts):
    rng = np.random.default_rng(7)
    gyros, forces = drawn(rng)
    gyros = replace(gyros, bias_temperature=((1e-6,) * 4,), scale_temperature=((1e-6,) * 4,))
    data = record(rng.normal(0.0, 1.0, (1000, 7)))
    data.temperature[:] = np.repeat([np.nan, 20.0, 20.1, 31.0, 25.0], 200)[:, None]
    calibration = Calibration(gyros, forces, None, (20.0,) * 3, (0.0,) * 3, (30.0,) * 3)
    one, other = (HeadCombiner(HeadModel(np.eye(3), calibration=calibration)) for _ in range(2))
    whole = one.combine(data)
    for start, stop in pairwise([0, *np.cumsum(cuts).clip(max=1000).tolist(), 1000]):
        part = other.combine(data.rows(start, stop))
        np.testing.assert_array_equal(part.dtheta, whole.dtheta[start:stop])
        np.testing.assert_array_equal(part.dvel, whole.dvel[start:stop])
    assert one.notes() == other.notes()


def test_parity_follows_the_calibrated_axes():
    """Misaligned axes disagree under rotation; by their calibrated matrix they do not."""
    gyros = GyroErrors(misalignment_spin=(0.0, 1e-3, -1e-3, 0.0), channels=CASES)
    calibration = Calibration(gyros)
    rate = np.tile([1.0, 0.0, 1.0], (10, 1))
    raw = sensed(gyros, AccelerometerErrors(), rate, np.zeros(3))
    imu = HeadCombiner(HeadModel(np.eye(3), calibration=calibration)).combine(record(raw))
    np.testing.assert_allclose(imu.dtheta / STEP, rate, atol=1e-12)
    np.testing.assert_allclose(raw[:, :4], rate @ calibration.gyro_matrix(0.0).T, atol=1e-12)


def test_measured_rotors_take_the_place_of_the_nominal_ones():
    data = record(np.full((100, 7), 0.1))
    data.rotor[:] = 1e-4 * np.arange(100)[:, None] ** 2
    slow = replace(HEAD, damping=20.0)
    by_model = HeadCombiner(HeadModel(np.eye(3), rotors=(slow, slow))).combine(data)
    by_file = HeadCombiner(HeadModel(np.eye(3), rotors=(HEAD, HEAD), calibration=Calibration(rotors=(slow, slow))))
    np.testing.assert_array_equal(by_file.combine(data).dtheta, by_model.dtheta)


@pytest.mark.parametrize(
    ("make", "say"),
    [
        (lambda: Calibration(GyroErrors()), "channels"),
        (lambda: Calibration(GyroErrors(bias_temperature=((1e-6,) * 4,) * 4, channels=CASES)), "power 3"),
        (lambda: Calibration(reference=(70.0,) * 3, warmest=(50.0,) * 3), "outside"),
        (lambda: Calibration(GyroErrors(scale=0.2, channels=CASES)).gyro_matrix(0.0), "g1x lies 0.2"),
        (lambda: Calibrator(Calibration(accelerometers=AccelerometerErrors(scale=(-1.0, 0.0, 0.0))), 0.0), "small"),
    ],
)
def test_what_cannot_be_taken_off_is_refused(make, say):
    with pytest.raises(HilError, match=say):
        make()


FACES = [(h, p, r) for p, r in ((0, 0), (0, 180), (0, 90), (0, -90), (90, 0), (-90, 0)) for h in (0, 180)]
EDGES = [(90 * k, p, r) for k, (p, r) in enumerate([(0, s * 45 + q) for s in (1, -1) for q in (0, 180)])]
EDGES += [(45 + 90 * k, p, r) for k, (p, r) in enumerate((p, r) for p in (45, -45) for r in (0, 90, 180, 270))]
TURNS = [(p, r, rate) for p, r in ((0, 0), (0, 90), (90, 0)) for rate in (-60.0, -30.0, 30.0, 60.0)]


def sequence(errors, rng, *, skew=0.0, off=0.0, noise=1.0, temperature=lambda _: 20.0, turns=TURNS, duration=60.0):
    """Stretches of a tumble and a turntable, simulated: exact outputs of the error models, plus the noise of a mean."""
    gravity = earth.normal_gravity(math.sin(LAT), HEIGHT)
    w_n, f_n = earth.RATE * np.array([math.cos(LAT), 0.0, -math.sin(LAT)]), np.array([0.0, 0.0, -gravity])
    made = []
    for k, (heading, pitch, roll, speed) in enumerate(
        [(*one, 0.0) for one in (*FACES, *EDGES)] + [(0.0, p, r, rate) for p, r, rate in turns]
    ):
        nominal = dcm_from_euler(*np.radians([heading, pitch, roll]))
        true = nominal @ dcm_from_rotation_vector(off * rng.standard_normal(3))
        turn = np.array([0.0, 0.0, math.radians(speed)])
        angles = np.outer(np.linspace(0.0, 2.0 * math.pi, 40, endpoint=False) * (speed != 0.0), [0.0, 0.0, 1.0])
        c_nh = dcm_from_rotation_vector(angles) @ true
        t = temperature(k)
        out = sensed(*errors, (w_n + turn) @ c_nh, f_n @ c_nh, skew, temperature=t - 20.0).mean(axis=0)
        out += noise * WHITE / math.sqrt(duration) * rng.standard_normal(7)
        made.append(Stretch(f"s{k}", nominal, turn, out[:4], out[4:], duration, WHITE, np.full(3, t)))
    return made


def difference(found, true, rng_names):
    """Fitted less drawn over sigma, of every determined coefficient."""
    sigma = {0: found.gyro_sigma, 1: found.accelerometer_sigma}
    z = []
    for group, (got, want) in enumerate(
        ((found.calibration.gyros, true[0]), (found.calibration.accelerometers, true[1]))
    ):
        for name in rng_names[group]:
            one = sigma[group][name]
            error = np.broadcast_to(getattr(got, name), one.shape) - np.broadcast_to(getattr(want, name), one.shape)
            z += (error / one)[np.isfinite(one)].tolist()
    return z


NAMES = [[name for name in REQUIRED[kind] if not name.endswith("]")] for kind in ("gyro", "accelerometer")]


@pytest.mark.parametrize(("skew", "off"), [(0.0, 0.0), (SKEW, 0.0), (0.0, 1e-5)])
def test_the_fit_finds_the_errors_and_its_sigmas_are_right(skew, off):
    """Over seeds the squares of fitted less drawn over sigma have the mean 1 (chi-square)."""
    squares = []
    for seed in range(6):
        rng = np.random.default_rng(seed)
        errors = drawn(rng, fitted=True)
        found = fit(sequence(errors, rng, skew=skew, off=off), LAT, HEIGHT, skew=skew, attitude_sigma=off)
        z = np.array(difference(found, errors, NAMES))
        assert np.abs(z).max() < 5.0
        squares.append(np.mean(z**2))
    assert len(z) == 4 * 10 + 3 * 9
    assert 0.85 < np.mean(squares) < 1.2, squares
    assert {name.split()[1].split("[")[0] for name in found.undetermined} == {"bias_temperature", "scale_temperature"}


def test_noise_from_stretch_to_stretch_is_in_the_sigmas():
    """Outputs repeat five times worse than their white noise says: the residuals tell."""
    squares, factors = [], []
    for seed in range(8):
        rng = np.random.default_rng(seed)
        errors = drawn(rng, fitted=True)
        found = fit(sequence(errors, rng, noise=5.0), LAT, HEIGHT)
        squares.append(np.mean(np.square(difference(found, errors, NAMES))))
        factors.append(found.factor)
    assert 0.8 < np.mean(squares) < 1.25
    np.testing.assert_allclose(np.mean(factors, axis=0), 5.0, rtol=0.1)


def test_an_attitude_table_of_a_degree_leaves_what_does_not_need_it():
    """With attitudes off by 0.5 degree, |f| = g still gives biases and scale factors of the accelerometers."""
    rng = np.random.default_rng(2)
    gyros, forces = drawn(rng, fitted=True)
    errors = gyros, AccelerometerErrors(bias=forces.bias, scale=forces.scale)
    found = fit(sequence(errors, rng, off=math.radians(0.5)), LAT, HEIGHT, attitude_sigma=math.radians(0.5))
    assert (found.accelerometer_sigma["bias"] < 2e-4).all()
    assert (found.accelerometer_sigma["scale"] < 2e-5).all()
    assert np.abs(difference(found, errors, ([], ["bias", "scale"]))).max() < 4.5


def test_temperature_coefficients_need_temperatures():
    rng = np.random.default_rng(1)
    gyros, forces = drawn(rng, fitted=True)
    per_k = tuple(0.02 * DEG_H * rng.standard_normal(4))
    errors = replace(gyros, bias_temperature=(per_k,)), replace(forces, scale_temperature=((1e-5, -1e-5, 2e-5),))
    found = fit(sequence(errors, rng, temperature=lambda k: 10.0 + (7 * k) % 30), LAT, HEIGHT)
    assert not found.undetermined
    e = found.calibration.gyros
    # About the mean temperature the bias is another; its slope is the same.
    slope = np.array(e.bias_temperature[0]) - per_k
    assert np.abs(slope / found.gyro_sigma["bias_temperature[0]"]).max() < 4.5
    gain = np.array(found.calibration.accelerometers.scale_temperature[0]) - [1e-5, -1e-5, 2e-5]
    assert np.abs(gain / found.accelerometer_sigma["scale_temperature[0]"]).max() < 4.5
    assert found.calibration.coldest[0] == pytest.approx(5.0, abs=1.0)


def test_what_a_sequence_cannot_determine_is_said():
    rng = np.random.default_rng(1)
    errors = drawn(rng, fitted=True)
    no_turns = fit(sequence(errors, rng, turns=[]), LAT, HEIGHT)
    assert {f"{axis} scale" for axis in ("g1x", "g1y", "g2y", "g2z")} <= set(no_turns.undetermined)
    assert "ax scale" not in no_turns.undetermined
    assert not any(no_turns.calibration.gyros.scale)
    faces = fit([s for k, s in enumerate(sequence(errors, rng)) if k < 12 or k >= 24], LAT, HEIGHT)
    assert {"ax cubic", "ay cross_io", "g1x anisoelasticity"} <= set(faces.undetermined)
    assert "ax quadratic" not in faces.undetermined


def test_a_wrong_sequence_is_refused():
    rng = np.random.default_rng(1)
    good = sequence(drawn(rng, fitted=True), rng)
    with pytest.raises(HilError, match="5 positions at rest; it takes 6"):
        fit([*good[:5], *good[24:]], LAT, HEIGHT)
    with pytest.raises(HilError, match=r"s0: .* should read .*does not show what the sequence says"):
        fit([replace(good[0], c_nh=good[2].c_nh), *good[1:]], LAT, HEIGHT)
    with pytest.raises(HilError, match="s24: g2z reads -60"):
        fit([*good[:24], replace(good[24], turn=-good[24].turn)], LAT, HEIGHT)
    with pytest.raises(HilError, match="ax, ay, az show no noise"):
        fit([replace(s, white=np.repeat([1e-7, 0.0], [4, 3])) for s in good], LAT, HEIGHT)


def noisy(n, rate=(0.0, 0.0, 0.0), seed=0):
    rng = np.random.default_rng(seed)
    mean = np.concatenate([layout(0.0) @ rate, [0.0, 0.0, -G]])
    return mean + WHITE / math.sqrt(STEP) * rng.standard_normal((n, 7))


def test_a_stretch_is_the_mean_and_knows_its_noise():
    data = record(noisy(60_000))
    one = stretch("a", data, without_lag(data, None), slice(0, 60_000), np.eye(3), np.zeros(3))
    np.testing.assert_allclose(one.gyro, data.dtheta.mean(axis=0) / STEP, rtol=1e-9)
    np.testing.assert_allclose(one.force, data.dvel.mean(axis=0) / STEP, rtol=1e-9)
    assert one.duration == pytest.approx(60.0)
    np.testing.assert_allclose(one.white, WHITE, rtol=0.35)
    assert one.temperature.tolist() == [20.0] * 3


def test_whole_turns_are_taken_of_a_turn():
    data = record(noisy(50_000, (0.0, 0.0, 1.0)))
    one = stretch("t", data, without_lag(data, None), slice(0, 50_000), np.eye(3), np.array([0.0, 0.0, 1.0]))
    assert one.duration == pytest.approx(7 * 2.0 * math.pi, abs=1.1 * STEP)
    with pytest.raises(HilError, match="less than one whole turn"):
        stretch("t", data, without_lag(data, None), slice(0, 6000), np.eye(3), np.array([0.0, 0.0, 1.0]))


def test_the_steady_part_is_found():
    """Rest, a turn about z to another attitude, rest."""
    outputs = noisy(40_000)
    outputs[12_000:15_000, 3] += 0.5
    data = record(outputs)
    part = steady_part(data, without_lag(data, None), stands=True)
    assert 15_000 <= part.start <= 15_500
    assert part.stop == 40_000
    stretch("found", data, without_lag(data, None), part, np.eye(3), np.zeros(3))


def test_motion_saturation_and_faults_are_refused():
    outputs = noisy(20_000)
    outputs[7000:7600, 1] += math.radians(0.2)
    data = record(outputs)
    whole = slice(0, 20_000)
    with pytest.raises(HilError, match=r"p: the head moved 7\.0 s after the start \(g1y\)"):
        stretch("p", data, without_lag(data, None), whole, np.eye(3), np.zeros(3))
    still = record(noisy(20_000))
    still.status[300] = 1 << 6
    with pytest.raises(HilError, match=r"saturated; turn slower \(1 samples, the first 0\.300 s"):
        stretch("p", still, without_lag(still, None), whole, np.eye(3), np.zeros(3))
    still.status[300] = 1
    with pytest.raises(HilError, match="an instrument failed"):
        stretch("p", still, without_lag(still, None), whole, np.eye(3), np.zeros(3))
    with pytest.raises(HilError, match="too short"):
        stretch("p", still, without_lag(still, None), slice(1000, 4000), np.eye(3), np.zeros(3))
