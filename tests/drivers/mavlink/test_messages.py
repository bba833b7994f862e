"""Solutions to messages: every one encodes, decodes back to the physics, and refuses what is no number."""

import math
from typing import Any

import numpy as np
import pymap3d
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pymavlink.dialects.v20 import ardupilotmega as mav
from scipy.spatial.transform import Rotation

from drivers.mavlink.messages import KINDS, ClockReading, Situation
from drivers.mavlink.solution import Home, Solution
from nav.rotation import quaternion_from_euler
from nav.state import NAV_STATE, Health, Mode

EARTH_RATE = 7.292115e-5
GEOID_M = 25.0
SIGMA = (0.3, 0.4, 0.7, 0.03, 0.02, 0.05, 1e-3, 2e-3, 3e-3)
COVARIANCES = {"pose_covariance", "velocity_covariance"}
NAMES = {"name"}
"""Fields in which NaN says "unknown"."""
DIAGONAL = [k for k, (i, j) in enumerate(zip(*np.triu_indices(6), strict=True)) if i == j]


def row(**changes: Any) -> np.ndarray:
    made = np.zeros(1, NAV_STATE)
    values = {
        "time": 12.345,
        "arrival_ns": 1_700_000_000_123_456_789,
        "mode": Mode.NAVIGATE,
        "lat": math.radians(50.0),
        "lon": math.radians(36.25),
        "height": 175.0,
        "vel_n": (3.0, -4.0, 0.5),
        "q_nb": quaternion_from_euler(math.radians(300.0), math.radians(5.0), math.radians(-10.0)),
        "f_b": (0.1, 0.2, -9.8),
        "sigma": SIGMA,
        "test_ratio": (0.5, 0.25, 0.75, 0.125, 0.0),
    }
    with np.errstate(over="ignore"):  # single precision has room for the sigmas of nonsense as infinities
        for key, value in (values | changes).items():
            made[key] = value
    return made


def solution(**changes: Any) -> Solution:
    return Solution.of(row(**changes)[0], lambda lat, lon: GEOID_M)


HOME = Home(math.radians(50.0), math.radians(36.25), 150.0)
SITUATION = Situation(home=HOME, lost=1, samples=999, clock=ClockReading(10**18, -12.5, 3.0, 2))


def over_the_wire(message: Any) -> Any:
    """The message as a client decodes it."""
    sender, client = mav.MAVLink(None, 1, 1), mav.MAVLink(None)
    (received,) = client.parse_buffer(message.pack(sender))
    assert received.get_type() == message.get_type()
    return received


def decoded(name: str, situation: Situation = SITUATION, **changes: Any) -> Any:
    message = KINDS[name].build(solution(**changes), situation)
    assert message is not None
    return over_the_wire(message)


@pytest.mark.parametrize("name", KINDS)
def test_every_message_survives_the_wire(name: str) -> None:
    message = decoded(name)
    for field in message.get_fieldnames():
        value = getattr(message, field)
        values = value if isinstance(value, list) else [value]
        assert field in COVARIANCES | NAMES or all(math.isfinite(v) for v in values), field


@pytest.mark.parametrize(
    ("mode", "status"),
    [
        (Mode.INIT, mav.MAV_STATE_BOOT),
        (Mode.ALIGN, mav.MAV_STATE_CALIBRATING),
        (Mode.NAVIGATE, mav.MAV_STATE_ACTIVE),
        (Mode.DEGRADED, mav.MAV_STATE_CRITICAL),
    ],
)
def test_heartbeat_tells_the_mode(mode: Mode, status: int) -> None:
    message = decoded("HEARTBEAT", mode=mode)
    assert message.system_status == status
    assert message.autopilot == mav.MAV_AUTOPILOT_GENERIC
    assert message.type == mav.MAV_TYPE_FIXED_WING
    assert not message.base_mode & mav.MAV_MODE_FLAG_SAFETY_ARMED


@pytest.mark.parametrize("mode", [Mode.INIT, Mode.ALIGN, Mode.NAVIGATE])
def test_no_fault_is_shown_when_there_is_none(mode: Mode) -> None:
    message = decoded("SYS_STATUS", mode=mode)
    assert message.onboard_control_sensors_enabled & ~message.onboard_control_sensors_health == 0
    assert message.onboard_control_sensors_health & mav.MAV_SYS_STATUS_GEOFENCE
    assert not message.onboard_control_sensors_present & mav.MAV_SYS_STATUS_GEOFENCE
    assert message.drop_rate_comm == 10  # 0.1 %, in hundredths of a percent


@pytest.mark.parametrize(
    ("health", "bit"),
    [
        (Health.SILENT, mav.MAV_SYS_STATUS_SENSOR_3D_GYRO),
        (Health.SENSOR, mav.MAV_SYS_STATUS_SENSOR_3D_ACCEL),
        (Health.UNITS, mav.MAV_SYS_STATUS_SENSOR_3D_ACCEL),
        (Health.BRIDGED, mav.MAV_SYS_STATUS_AHRS),
    ],
)
def test_a_fault_shows_as_enabled_and_not_healthy(health: Health, bit: int) -> None:
    message = decoded("SYS_STATUS", mode=Mode.DEGRADED, health=health)
    assert message.onboard_control_sensors_enabled & ~message.onboard_control_sensors_health & bit


def test_attitude_is_that_of_the_solution() -> None:
    message = decoded("ATTITUDE")
    assert math.degrees(message.yaw) == pytest.approx(-60.0, abs=1e-4)
    assert math.degrees(message.pitch) == pytest.approx(5.0, abs=1e-4)
    assert math.degrees(message.roll) == pytest.approx(-10.0, abs=1e-4)
    assert message.time_boot_ms == 12345
    quaternion = decoded("ATTITUDE_QUATERNION")
    expected = solution().q_nb
    assert [quaternion.q1, quaternion.q2, quaternion.q3, quaternion.q4] == pytest.approx(expected, abs=1e-7)
    assert quaternion.repr_offset_q == [1.0, 0.0, 0.0, 0.0]


def test_rates_of_a_vehicle_at_rest_are_zero() -> None:
    lat = math.radians(50.0)
    q_nb = quaternion_from_euler(1.0, 0.2, -0.3)
    c, s = math.cos(lat), math.sin(lat)
    w_ie_n = np.array([EARTH_RATE * c, 0.0, -EARTH_RATE * s])
    half = np.array([q_nb[0], -q_nb[1], -q_nb[2], -q_nb[3]])
    w_ie_b = w_ie_n + 2.0 * np.cross(half[1:], np.cross(half[1:], w_ie_n) + half[0] * w_ie_n)
    still = solution(q_nb=q_nb, w_ib_b=w_ie_b, vel_n=(0.0, 0.0, 0.0))
    assert np.abs(still.w_nb_b).max() < 1e-12


def test_rates_of_level_flight_over_the_turning_earth_are_zero() -> None:
    """Flying east along a parallel the gyros feel (Earth rate + longitude rate) about the Earth's axis."""
    lat, height, east = math.radians(60.0), 1000.0, 250.0
    radius = math.hypot(*pymap3d.geodetic2ecef(60.0, 0.0, height)[:2])
    total = EARTH_RATE + east / radius
    level = solution(
        lat=lat,
        height=height,
        vel_n=(0.0, east, 0.0),
        q_nb=(1.0, 0.0, 0.0, 0.0),
        w_ib_b=(total * math.cos(lat), 0.0, -total * math.sin(lat)),
    )
    assert np.abs(level.w_nb_b).max() < 1e-12


def test_position_is_above_mean_sea_level_and_relative_to_home() -> None:
    message = decoded("GLOBAL_POSITION_INT")
    assert (message.lat, message.lon) == (500000000, 362500000)
    assert message.alt == 150_000
    assert message.relative_alt == 25_000
    assert (message.vx, message.vy, message.vz) == (300, -400, 50)
    assert message.hdg == 30000


def test_odometry_is_the_solution_in_body_axes() -> None:
    message, local = decoded("ODOMETRY"), decoded("LOCAL_POSITION_NED")
    assert (message.frame_id, message.child_frame_id) == (mav.MAV_FRAME_LOCAL_NED, mav.MAV_FRAME_BODY_FRD)
    assert (message.x, message.y, message.z) == (local.x, local.y, local.z)
    to_n = Rotation.from_quat(message.q, scalar_first=True)
    assert to_n.apply([message.vx, message.vy, message.vz]) == pytest.approx([3.0, -4.0, 0.5], abs=1e-6)


def test_covariances_of_the_odometry_are_the_sigmas() -> None:
    message = decoded("ODOMETRY")
    pose = np.array(message.pose_covariance)
    assert pose[DIAGONAL] == pytest.approx(np.square(SIGMA[:3] + SIGMA[6:]))
    assert np.isnan(np.delete(pose, DIAGONAL)).all()
    c = Rotation.from_quat(message.q, scalar_first=True).as_matrix()
    expected = np.diag(c.T @ np.diag(np.square(SIGMA[3:6])) @ c)
    assert np.array(message.velocity_covariance)[DIAGONAL[:3]] == pytest.approx(expected)


def test_an_unaided_navigator_claims_nothing_of_its_accuracy() -> None:
    unknown = solution(sigma=np.full(9, np.inf))
    assert KINDS["ESTIMATOR_STATUS"].build(unknown, SITUATION) is None
    assert KINDS["EKF_STATUS_REPORT"].build(unknown, SITUATION) is None
    message = decoded("ODOMETRY", sigma=np.full(9, np.inf))
    assert np.isnan(message.pose_covariance).all()
    assert np.isnan(message.velocity_covariance).all()


def test_a_good_estimate_is_called_good() -> None:
    """831 is what clients of ArduPilot take for healthy."""
    status, report = decoded("ESTIMATOR_STATUS"), decoded("EKF_STATUS_REPORT")
    assert status.flags == report.flags == 831
    assert (status.vel_ratio, status.pos_horiz_ratio, status.pos_vert_ratio, status.mag_ratio) == (
        0.5,
        0.25,
        0.75,
        0.125,
    )
    assert (report.velocity_variance, report.pos_horiz_variance, report.compass_variance) == (0.5, 0.25, 0.125)
    assert status.pos_horiz_accuracy == pytest.approx(0.5)
    assert status.pos_vert_accuracy == pytest.approx(0.7)


@pytest.mark.parametrize(
    ("place", "sigma", "lost"),
    [
        (0, 100.0, mav.EKF_POS_HORIZ_ABS | mav.EKF_POS_HORIZ_REL | mav.EKF_PRED_POS_HORIZ_ABS | mav.EKF_PRED_POS_HORIZ_REL),
        (2, 100.0, mav.EKF_POS_VERT_ABS),
        (4, 10.0, mav.EKF_VELOCITY_HORIZ),
        (5, 10.0, mav.EKF_VELOCITY_VERT),
        (8, 1.0, mav.EKF_ATTITUDE),
    ],
)  # fmt: skip
def test_what_is_not_good_is_not_called_so(place: int, sigma: float, lost: int) -> None:
    changed = [sigma if k == place else one for k, one in enumerate(SIGMA)]
    assert decoded("ESTIMATOR_STATUS", sigma=changed).flags == 831 & ~lost
    assert decoded("EKF_STATUS_REPORT", sigma=changed).flags == 831 & ~lost


def test_a_rejected_fix_is_a_glitch() -> None:
    ratio = (0.5, 2.0, 0.0, 0.0, 0.0)
    assert decoded("ESTIMATOR_STATUS", test_ratio=ratio).flags & mav.ESTIMATOR_GPS_GLITCH
    assert decoded("EKF_STATUS_REPORT", test_ratio=ratio).flags & mav.EKF_GPS_GLITCHING


@given(st.floats(0.0, 2.0 * math.pi))
def test_heading_stays_in_range(heading: float) -> None:
    q_nb = quaternion_from_euler(heading, 0.0, 0.0)
    assert 0 <= decoded("GLOBAL_POSITION_INT", q_nb=q_nb).hdg <= 35999
    assert 0 <= decoded("VFR_HUD", q_nb=q_nb).heading <= 359
    assert -math.pi - 1e-6 <= decoded("ATTITUDE", q_nb=q_nb).yaw <= math.pi + 1e-6


def test_local_position_agrees_with_a_peer() -> None:
    here = {"lat": math.radians(50.3), "lon": math.radians(36.0), "height": 2000.0}
    message = decoded("LOCAL_POSITION_NED", **here)
    expected = pymap3d.geodetic2ned(50.3, 36.0, 2000.0, 50.0, 36.25, 150.0)
    assert [message.x, message.y, message.z] == pytest.approx(list(expected), abs=2e-3)


def test_altitudes_agree_with_each_other() -> None:
    altitude, hud, home = decoded("ALTITUDE"), decoded("VFR_HUD"), decoded("HOME_POSITION")
    assert altitude.altitude_amsl == hud.alt == 150.0
    assert altitude.altitude_relative == 25.0
    assert home.altitude == 125_000
    assert hud.groundspeed == 5.0
    assert hud.climb == -0.5


def test_time_is_device_time_and_wraps() -> None:
    assert decoded("ATTITUDE", time=2.0**32 / 1e3 + 1.5).time_boot_ms == 1500
    message = decoded("SYSTEM_TIME", Situation())
    assert (message.time_unix_usec, message.time_boot_ms) == (1_700_000_000_123_456, 12345)
    assert decoded("HIGHRES_IMU").time_usec == 12_345_000


def test_compared_clocks_give_the_time_of_the_host() -> None:
    """Not the arrival of one sample, which may have waited."""
    message = decoded("SYSTEM_TIME", time=12.345)
    assert (message.time_unix_usec, message.time_boot_ms) == (1_000_000_012_345_000, 12345)
    message = decoded("DEBUG_VECT", time=12.345)
    assert (message.name, message.time_usec) == ("CLOCK", 12_345_000)
    assert (message.x, message.y, message.z) == (-12.5, 3.0, 2.0)


def test_no_satellite_receiver_is_pretended() -> None:
    message = decoded("GPS_RAW_INT")
    assert message.fix_type == mav.GPS_FIX_TYPE_NO_GPS
    assert message.satellites_visible == 255


def test_before_the_alignment_there_is_no_attitude_and_no_position() -> None:
    blind = solution(mode=Mode.ALIGN, q_nb=(0.0, 0.0, 0.0, 0.0))
    said = {name for name, kind in KINDS.items() if kind.build(blind, Situation()) is not None}
    assert said == {"HEARTBEAT", "SYS_STATUS", "SYSTEM_TIME", "HIGHRES_IMU", "GPS_RAW_INT"}


numbers = st.one_of(
    st.floats(allow_nan=True, allow_infinity=True),
    st.floats(-1e4, 1e4),
    st.sampled_from([math.nan, math.inf, -math.inf, 1e39, -1e30, 0.0]),
)
vectors = st.tuples(numbers, numbers, numbers)


@given(
    time=numbers, lat=numbers, lon=numbers, height=numbers, vel_n=vectors, w_ib_b=vectors, f_b=vectors,
    sigma=st.lists(numbers, min_size=9, max_size=9), test_ratio=st.lists(numbers, min_size=5, max_size=5),
    q_nb=st.one_of(st.tuples(numbers, numbers, numbers, numbers), st.just((0.6, 0.0, 0.8, 0.0))),
)  # fmt: skip
def test_nonsense_is_left_out_and_never_sent(**fields: Any) -> None:
    situation = Situation(home=HOME, lost=2**40, samples=-1, clock=ClockReading(2**62, -1e9, 1e9, 2**40))
    for kind in KINDS.values():
        message = kind.build(solution(**fields), situation)
        if message is None:
            continue
        message = over_the_wire(message)
        for field in message.get_fieldnames():
            value = getattr(message, field)
            values = value if isinstance(value, list) else [value]
            assert field in COVARIANCES | NAMES or all(math.isfinite(v) for v in values), field
            assert field in NAMES or not any(math.isinf(v) for v in values), field
