"""The pendulum against Newton-Euler dynamics, closed forms of its loop, and the published equations."""

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

from nav.errors import HilError
from nav.instruments.pendulum import Pendulum, PendulumBlock, apparent_force, best_hinge

AXES = tuple(map(tuple, Rotation.from_euler("zyx", [0.4, -1.1, 2.3]).as_matrix()))
PLACED = replace(Pendulum(), hinge=(0.05, -0.02, 0.03), axes=AXES)
STEP = 1.0 / 8000.0

vectors = st.tuples(*[st.floats(-3, 3)] * 3).map(np.array)
angles = st.floats(-0.005, 0.005)


def skew(v):
    return np.array([[0, -v[2], v[1]], [v[2], 0, -v[0]], [-v[1], v[0], 0]])


def hinge_torque(p, force, rate, acceleration, motion):
    """Torque about the hinge that the motion (phi, phi', phi'') needs, by momentum alone.

    Places and the angular momentum are followed in inertial axes over two small times and differenced.
    """
    axes, d = np.array(p.axes), 1e-3

    def turn(t):  # block to inertial; exact to second order in t, which is all that enters
        return np.eye(3) + t * skew(rate) + 0.5 * t * t * (skew(acceleration) + skew(rate) @ skew(rate))

    def pendulum(t):  # pendulum axes to block
        return axes.T @ Rotation.from_rotvec([0, motion[0] + motion[1] * t + 0.5 * motion[2] * t * t, 0]).as_matrix()

    def centre(t):  # of mass, from O at rest at t = 0 and falling freely but for its specific force
        return 0.5 * force * t * t + turn(t) @ (np.array(p.hinge) - p.arm * pendulum(t)[:, 2])

    def momentum(t):  # about the centre of mass, from the rotation's own rate
        whole = turn(t) @ pendulum(t)
        spin = (turn(t + d) @ pendulum(t + d) - turn(t - d) @ pendulum(t - d)) / (2 * d) @ np.linalg.inv(whole)
        vee = 0.5 * np.array([spin[2, 1] - spin[1, 2], spin[0, 2] - spin[2, 0], spin[1, 0] - spin[0, 1]])
        return whole @ (np.array(p.inertia) * (np.linalg.inv(whole) @ vee))

    reaction = p.mass * (centre(d) - 2 * centre(0) + centre(-d)) / d**2
    change = (momentum(d) - momentum(-d)) / (2 * d)
    lever = p.arm * pendulum(0)[:, 2]  # from the centre of mass to the hinge
    return (change - np.cross(lever, reaction)) @ axes[1]


@given(vectors, vectors, vectors, angles, st.floats(-2, 2), st.floats(-20, 20))
def test_equation_of_motion_is_that_of_newton_and_euler(force, rate, acceleration, phi, speed, phi2):
    torque = hinge_torque(PLACED, force, rate, acceleration, (phi, speed, phi2))
    drive = apparent_force(PLACED, force, rate, acceleration, phi)[0]
    moment = PLACED.mass * PLACED.arm
    # Eq. 1.5: (J / ml) phi'' = F - u / ml, the torque on the pendulum being -u
    expected = PLACED.percussion_radius * phi2 - drive
    assert torque / moment == pytest.approx(expected, abs=2e-4 * (1.0 + np.abs([*force, *rate, *acceleration]).max()))


@given(vectors, vectors, vectors, angles)
def test_equation_of_motion_as_printed(force, rate, acceleration, phi):
    """Eq. 1.5 term by term."""
    xi0, eta0, zeta0 = np.array(AXES) @ PLACED.hinge
    (fx, _, fz), (wx, wy, wz), (ex, ey, ez) = (np.array(AXES) @ v for v in (force, rate, acceleration))
    a, b, c = PLACED.inertia
    moment = PLACED.mass * PLACED.arm
    mixed = PLACED.arm + (a - c) / moment
    s, k = math.sin(phi), math.cos(phi)
    printed = (
        fx * k
        - fz * s
        - mixed * (wx**2 - wz**2) * s * k
        - mixed * wx * wz * math.cos(2 * phi)
        + xi0 * ((ey - wx * wz) * s - (wy**2 + wz**2) * k)
        - eta0 * ((ex + wy * wz) * s + (ez - wx * wy) * k)
        + zeta0 * ((wy**2 + wx**2) * s + (ey + wx * wz) * k)
        - (b + PLACED.mass * PLACED.arm**2) / moment * ey
    )
    assert apparent_force(PLACED, force, rate, acceleration, phi)[0] == pytest.approx(printed, abs=1e-12)


@given(vectors, vectors, vectors)
def test_equilibrium_form(force, rate, acceleration):
    m, n, l, eta0 = PLACED.coefficients  # noqa: E741
    (fx, _, _), (wx, wy, wz), (_, ey, ez) = (np.array(AXES) @ v for v in (force, rate, acceleration))
    expected = fx + m * wx * wz + n * (wy**2 + wz**2) + l * ey + eta0 * (wx * wy - ez)
    assert apparent_force(PLACED, force, rate, acceleration)[0] == pytest.approx(expected, abs=1e-12)


@given(vectors, vectors)
def test_in_the_best_place_only_anisoinertia_is_left(rate, acceleration):
    best = replace(PLACED, hinge=best_hinge(PLACED))
    np.testing.assert_allclose(best.centre_of_percussion, 0.0, atol=1e-17)
    wx, _, wz = np.array(AXES) @ rate
    output = apparent_force(best, np.zeros(3), rate, acceleration)[0]
    assert output == pytest.approx(best.anisoinertia * wx * wz, abs=1e-13)


def test_a_plate_has_no_anisoinertia_and_a_blow_at_the_centre_of_percussion_does_not_load_the_hinge():
    _, b, c = Pendulum().inertia
    assert replace(Pendulum(), inertia=(b + c, b, c)).anisoinertia == pytest.approx(0.0, abs=1e-17)
    # A blow P at r from the hinge: m v = P + R at the centre of mass, J phi' = P r about the hinge
    p = Pendulum()
    turned = p.percussion_radius / (b + p.mass * p.arm**2)
    assert p.mass * p.arm * turned == pytest.approx(1.0)


def steady(n, force, rate=(0.0, 0.0, 0.0)):
    return np.tile(np.array(force, float), (2 * n + 1, 1)), np.tile(np.array(rate, float), (2 * n + 1, 1))


def test_at_rest_the_output_is_gravity_and_the_integral_leaves_no_deflection():
    block = PendulumBlock([Pendulum()], STEP)
    dvel = block.sense(*steady(8000, (-3.0, 1.0, -9.8)))
    assert dvel[-1, 0] / STEP == pytest.approx(-3.0, rel=1e-12)
    assert abs(block.deflection[0]) < 1e-15
    held = PendulumBlock([replace(Pendulum(), integral=0.0)], STEP)
    held.sense(*steady(8000, (-3.0, 0.0, 0.0)))
    spring = Pendulum().percussion_radius * (2 * math.pi * 800.0) ** 2
    assert held.deflection[0] == pytest.approx(-3.0 / spring, rel=1e-9)


@pytest.mark.parametrize("frequency", [20.0, 300.0, 800.0, 1500.0])
def test_frequency_response_of_the_loop(frequency):
    p = Pendulum()
    n, pulsation = 16000, 2 * math.pi * frequency
    step = 1.0 / 32000.0
    time = np.arange(2 * n + 1) * 0.5 * step
    force, rate = steady(n, (0, 0, 0))
    force[:, 0] = np.sin(pulsation * time)
    dvel = PendulumBlock([p], step).sense(force, rate)[n // 2 :, 0]  # settled; whole periods
    middle = (time[1::2])[n // 2 :]
    found = 2.0 * np.mean(dvel / step * np.exp(-1j * pulsation * middle)) * 1j
    s, w0 = 1j * pulsation, 2 * math.pi * p.frequency_hz
    torque = np.polyval([2 * p.damping * w0, w0**2, p.integral * w0**2], s)
    expected = torque / (s**3 + torque) * np.sinc(frequency * step)
    assert abs(found - expected) < 1e-3 * (frequency / 1500.0) ** 3


def test_vibration_along_both_axes_rectifies():
    """Vibropendulous error: mean of -phi f_zeta, phi being force over stiffness at low frequency."""
    p = replace(Pendulum(), integral=0.0)
    n, amplitude, pulsation = 16000, 50.0, 2 * math.pi * 40.0
    time = np.arange(2 * n + 1) * 0.5 * STEP
    force, rate = steady(n, (0, 0, 0))
    force[:, 0] = force[:, 2] = amplitude * np.sin(pulsation * time)
    mean = PendulumBlock([p], STEP).sense(force, rate)[n // 2 :, 0].mean() / STEP
    stiffness = (2 * math.pi * p.frequency_hz) ** 2 * p.percussion_radius
    s = 1j * pulsation / (2 * math.pi * p.frequency_hz)
    phi = amplitude / stiffness / (1 + 2 * p.damping * s + s * s)
    assert mean == pytest.approx(-0.5 * amplitude * phi.real, rel=1e-4)


def shaking(n, step):
    """A wild motion: forces and rates, and the angular acceleration, at the times of `sense`."""
    time = np.arange(2 * n + 1)[:, None] * 0.5 * step
    pulsation, phase = np.array([400.0, 530.0, 310.0]), np.array([0.1, 1.0, 2.0])
    force = np.array([40.0, -25.0, 30.0]) * np.sin(pulsation * time + phase)
    rate = np.array([2.0, 1.5, -3.0]) * np.sin(0.7 * pulsation * time + 2 * phase)
    acceleration = np.array([2.0, 1.5, -3.0]) * 0.7 * pulsation * np.cos(0.7 * pulsation * time + 2 * phase)
    return force, rate, acceleration


def test_full_dynamics_beside_an_integrator_of_high_order():
    duration, p = 0.02, PLACED
    w0, radius = 2 * math.pi * p.frequency_hz, p.percussion_radius

    def rhs(t, y):  # int phi, phi, phi', int u / ml
        inputs = [v[1] for v in shaking(1, 2 * t)] if t > 0 else [v[0] for v in shaking(1, 1.0)]
        torque = radius * (w0**2 * (p.integral * y[0] + y[1]) + 2 * p.damping * w0 * y[2])
        return [y[1], y[2], (apparent_force(p, *inputs, y[1])[0] - torque) / radius, torque]

    exact = solve_ivp(rhs, (0, duration), np.zeros(4), method="DOP853", rtol=1e-11, atol=1e-16).y[:, -1]
    errors = []
    for n in (160, 320, 640):
        block = PendulumBlock([p], duration / n)
        force, rate, _ = shaking(n, duration / n)
        errors.append(abs(block.sense(force, rate)[:, 0].sum() - exact[3]))
        assert block.deflection[0] == pytest.approx(exact[1], rel=2e-3)
    assert errors[0] < 2e-6  # of 0.1 m/s that came and went
    assert errors[-1] < 0.15 * errors[-2] < 0.03 * errors[-3]


def test_chunks_do_not_matter():
    force, rate, _ = shaking(500, STEP)
    whole = PendulumBlock([PLACED, Pendulum()], STEP).sense(force, rate)
    block, parts, at = PendulumBlock([PLACED, Pendulum()], STEP), [], 0
    for n in (1, 7, 0, 200, 292):
        parts.append(block.sense(force[2 * at : 2 * (at + n) + 1], rate[2 * at : 2 * (at + n) + 1]))
        at += n
    np.testing.assert_array_equal(np.concatenate(parts), whole)


def test_saturation_stops_and_recovery():
    p = Pendulum()
    block = PendulumBlock([p], STEP)
    dvel = block.sense(*steady(800, (2.0 * p.limit, 0, 0)))
    assert dvel.max() <= p.limit * STEP * (1 + 1e-12)
    assert dvel[-1, 0] == pytest.approx(p.limit * STEP)
    assert block.deflection[0] == pytest.approx(p.stop)
    assert block.saturated[0] > 700
    after = block.sense(*steady(1600, (5.0, 0, 0)))
    assert after[-1, 0] / STEP == pytest.approx(5.0, rel=1e-9)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"mass": 0.0}, "mass"),
        ({"arm": -1.0}, "arm"),
        ({"inertia": (1e-7, 3e-7, 1e-7)}, "no body has"),
        ({"integral": 1e5}, "unstable"),
        ({"stop": 0.5}, "stop"),
        ({"damping": math.nan}, "damping"),
        ({"hinge": (0.0, math.nan, 0.0)}, "hinge"),
        ({"axes": ((1, 0, 0), (0, 0, 1), (0, 1, 0))}, "axes"),
    ],
)
def test_what_cannot_be_built_is_refused(change, message):
    with pytest.raises(HilError, match=message):
        replace(Pendulum(), **change)


def test_wrong_input_is_refused():
    with pytest.raises(HilError, match="too long"):
        PendulumBlock([Pendulum()], 1e-3)
    block = PendulumBlock([Pendulum()], STEP)
    with pytest.raises(HilError, match="2 n"):
        block.sense(np.zeros((4, 3)), np.zeros((4, 3)))
    with pytest.raises(HilError, match="finite"):
        block.sense(np.full((3, 3), np.nan), np.zeros((3, 3)))
