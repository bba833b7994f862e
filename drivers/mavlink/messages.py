"""Navigation solutions to MAVLink messages: pure functions, and the table of what is sent how often.

Each function takes a `Solution` and the `Situation` around it and returns the message, or None when the solution does
not hold what the message needs (no attitude yet, a number that is not one). Units are those of the message definition;
altitudes are above mean sea level, times are device time.
"""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

from pymavlink.dialects.v20 import ardupilotmega as mav

from drivers.mavlink.solution import Home, Solution, Vector
from nav.errors import HilError
from nav.state import Health, Mode, Ratio

Message = Any
"""A message of pymavlink, which has no type information."""

VEHICLES = {
    "fixed-wing": mav.MAV_TYPE_FIXED_WING,
    "quadrotor": mav.MAV_TYPE_QUADROTOR,
    "helicopter": mav.MAV_TYPE_HELICOPTER,
    "ground-rover": mav.MAV_TYPE_GROUND_ROVER,
    "surface-boat": mav.MAV_TYPE_SURFACE_BOAT,
    "generic": mav.MAV_TYPE_GENERIC,
}
"""Names of the vehicle types that a user may choose."""

_SYSTEM_STATUS = {
    Mode.INIT: mav.MAV_STATE_BOOT,
    Mode.ALIGN: mav.MAV_STATE_CALIBRATING,
    Mode.NAVIGATE: mav.MAV_STATE_ACTIVE,
    Mode.DEGRADED: mav.MAV_STATE_CRITICAL,
}
_GYRO = mav.MAV_SYS_STATUS_SENSOR_3D_GYRO
_ACCEL = mav.MAV_SYS_STATUS_SENSOR_3D_ACCEL
_AHRS = mav.MAV_SYS_STATUS_AHRS
_ACCEL_AND_GYRO_UPDATED = 0b111111

DIAGONAL = (0, 6, 11, 15, 18, 20)
"""Places of the diagonal in the upper triangle of a 6 x 6 matrix, row by row."""
GOOD_POSITION_M, GOOD_VELOCITY_MS, GOOD_ATTITUDE = 10.0, 1.0, math.radians(5.0)
"""An estimate is called good up to this sigma (horizontal: of north and east together)."""


FIX_S = 2.0
"""A fix that is older than this is over."""


@dataclass(frozen=True)
class Fix:
    """What a satellite receiver has measured, not what became of it in a filter."""

    time: float
    """Device time, s."""
    place: Home
    vel_n: Vector
    sigma: tuple[float, ...]
    """North, east, down of position and velocity, m and m/s; infinite where there is no value."""


@dataclass(frozen=True)
class ClockReading:
    """The device's clock against the host's."""

    offset_ns: int
    """Host (UTC) less device."""
    drift_ppm: float
    """Positive: the device's clock is fast."""
    bound_us: float
    """Of the offset, beside the smallest delay of the transport, which is in it."""
    steps: int
    """Of either clock."""


@dataclass(frozen=True)
class Situation:
    """What a message says beside the solution."""

    vehicle_type: int = mav.MAV_TYPE_FIXED_WING
    beside: bool = False
    """We are a component beside an autopilot."""
    fix: Fix | None = None
    """The newest of a receiver."""
    home: Home | None = None
    lost: int = 0
    """Sensor samples lost since the start."""
    samples: int = 0
    """Sensor samples received since the start."""
    clock: ClockReading | None = None


def heartbeat(solution: Solution, situation: Situation) -> Message:
    """HEARTBEAT of a navigation unit that is no autopilot, never armed: a generic one where no autopilot is beside it."""
    status = _SYSTEM_STATUS[solution.mode]
    kind, autopilot = situation.vehicle_type, mav.MAV_AUTOPILOT_GENERIC
    if situation.beside:
        kind, autopilot = mav.MAV_TYPE_ONBOARD_CONTROLLER, mav.MAV_AUTOPILOT_INVALID
    return mav.MAVLink_heartbeat_message(kind, autopilot, 0, 0, status, 3)


def sys_status(solution: Solution, situation: Situation) -> Message:
    """SYS_STATUS: a sensor is enabled once it should work, so that a client sees a fault only where there is one.

    The geofence bit is healthy and not present: some clients announce a breach without it.
    """
    enabled = 0 if solution.mode == Mode.INIT else _GYRO | _ACCEL
    if solution.mode in (Mode.NAVIGATE, Mode.DEGRADED):
        enabled |= _AHRS
    healthy = mav.MAV_SYS_STATUS_GEOFENCE
    if not solution.health & (Health.SILENT | Health.SENSOR):
        healthy |= _GYRO if solution.health & Health.UNITS else _GYRO | _ACCEL
    if solution.mode == Mode.NAVIGATE:
        healthy |= _AHRS
    total = situation.lost + situation.samples
    return mav.MAVLink_sys_status_message(
        onboard_control_sensors_present=_GYRO | _ACCEL | _AHRS,
        onboard_control_sensors_enabled=enabled,
        onboard_control_sensors_health=healthy,
        load=0,
        voltage_battery=65535,
        current_battery=-1,
        battery_remaining=-1,
        drop_rate_comm=_integer(10000.0 * situation.lost / total, 0, 10000) if total > 0 else 0,
        errors_comm=min(max(situation.lost, 0), 65535),
        errors_count1=0,
        errors_count2=0,
        errors_count3=0,
        errors_count4=0,
    )


def system_time(solution: Solution, situation: Situation) -> Message | None:
    """SYSTEM_TIME: host time (UTC) of this device time; the arrival of the sample while the clocks are not compared."""
    if not solution.has_imu:
        return None
    clock = situation.clock
    host_ns = solution.arrival_ns if clock is None else round(solution.time * 1e9) + clock.offset_ns
    return mav.MAVLink_system_time_message(max(host_ns, 0) // 1000, _boot_ms(solution))


def debug_vect(solution: Solution, situation: Situation) -> Message | None:
    """DEBUG_VECT named CLOCK: drift of the device's clock (ppm), bound of its offset (us), steps."""
    clock = situation.clock
    if clock is None or not solution.has_imu:
        return None
    return mav.MAVLink_debug_vect_message(b"CLOCK", _boot_us(solution), clock.drift_ppm, clock.bound_us, clock.steps)


def attitude(solution: Solution, _: Situation) -> Message | None:
    """ATTITUDE: Euler angles, and the body's rates relative to the local level."""
    if not solution.has_position:  # the rates of the local level need it
        return None
    heading, pitch, roll = solution.euler
    yaw = heading - 2.0 * math.pi if heading > math.pi else heading
    return mav.MAVLink_attitude_message(_boot_ms(solution), roll, pitch, yaw, *solution.w_nb_b)


def attitude_quaternion(solution: Solution, _: Situation) -> Message | None:
    """ATTITUDE_QUATERNION: q_nb, no offset for display."""
    if not solution.has_position:
        return None
    return mav.MAVLink_attitude_quaternion_message(
        _boot_ms(solution), *solution.q_nb, *solution.w_nb_b, repr_offset_q=[1.0, 0.0, 0.0, 0.0]
    )


def global_position_int(solution: Solution, situation: Situation) -> Message | None:
    """GLOBAL_POSITION_INT: altitude above mean sea level and above home."""
    if not solution.has_position:
        return None
    lat, lon = _degrees_e7(solution.lat, solution.lon)
    north, east, down = (_integer(100.0 * v, -32767, 32767) for v in solution.vel_n)
    hdg = _integer(math.degrees(solution.euler[0]) * 100.0, 0, 36000) % 36000
    above_home = solution.height - situation.home.height if situation.home else 0.0
    return mav.MAVLink_global_position_int_message(
        _boot_ms(solution), lat, lon, _millimetres(solution.altitude), _millimetres(above_home), north, east, down, hdg
    )


def local_position_ned(solution: Solution, situation: Situation) -> Message | None:
    """LOCAL_POSITION_NED: relative to home."""
    if not solution.has_position or situation.home is None:
        return None
    return mav.MAVLink_local_position_ned_message(
        _boot_ms(solution), *solution.relative_to(situation.home), *solution.vel_n
    )


def vfr_hud(solution: Solution, _: Situation) -> Message | None:
    """VFR_HUD: no airspeed (there are no air data), no throttle."""
    if not solution.has_position:
        return None
    north, east, down = solution.vel_n
    heading_deg = _integer(math.degrees(solution.euler[0]), 0, 360) % 360
    return mav.MAVLink_vfr_hud_message(0.0, math.hypot(north, east), heading_deg, 0, solution.altitude, -down)


def highres_imu(solution: Solution, _: Situation) -> Message | None:
    """HIGHRES_IMU: specific force and rate of the body, inertial."""
    if not solution.has_imu:
        return None
    return mav.MAVLink_highres_imu_message(
        _boot_us(solution), *solution.f_b, *solution.w_ib_b, *([0.0] * 7), fields_updated=_ACCEL_AND_GYRO_UPDATED
    )


def altitude(solution: Solution, situation: Situation) -> Message | None:
    """ALTITUDE: terrain unknown."""
    if not solution.has_position:
        return None
    above_home = local = 0.0
    if situation.home is not None:
        above_home = solution.height - situation.home.height
        local = -solution.relative_to(situation.home)[2]
    return mav.MAVLink_altitude_message(
        _boot_us(solution), solution.height, solution.altitude, local, above_home, -1001.0, -1.0
    )


def home_position(solution: Solution, situation: Situation) -> Message | None:
    """HOME_POSITION: where navigation began."""
    home = situation.home
    if home is None:
        return None
    altitude_m = home.height - solution.geoid(home.lat, home.lon)
    return mav.MAVLink_home_position_message(
        *_degrees_e7(home.lat, home.lon), _millimetres(altitude_m), 0.0, 0.0, 0.0, [1.0, 0.0, 0.0, 0.0], 0.0, 0.0, 0.0
    )


def gps_raw_int(solution: Solution, situation: Situation) -> Message | None:
    """GPS_RAW_INT: what a receiver has measured, and no fix where there is none; never our own solution."""
    if not solution.has_imu:
        return None
    fix, unknown = situation.fix, 65535
    if fix is None or not 0.0 <= solution.time - fix.time < FIX_S:
        kind = mav.GPS_FIX_TYPE_NO_GPS if fix is None else mav.GPS_FIX_TYPE_NO_FIX
        return mav.MAVLink_gps_raw_int_message(_boot_us(solution), kind, 0, 0, 0, *[unknown] * 4, 255)
    high, moving = math.isfinite(fix.sigma[2]), max(fix.sigma[3:5]) < math.inf
    north, east, _ = fix.vel_n
    course = _integer(100.0 * math.degrees(math.atan2(east, north) % (2.0 * math.pi)), 0, 35999) if moving else unknown
    place = fix.place
    altitude_m = place.height - solution.geoid(place.lat, place.lon) if high else 0.0
    return mav.MAVLink_gps_raw_int_message(
        round(fix.time * 1e6),
        mav.GPS_FIX_TYPE_3D_FIX if high else mav.GPS_FIX_TYPE_2D_FIX,
        *_degrees_e7(place.lat, place.lon),
        _millimetres(altitude_m),
        unknown,
        unknown,
        _integer(100.0 * math.hypot(north, east), 0, unknown - 1) if moving else unknown,
        course,
        255,
        alt_ellipsoid=_millimetres(place.height) if high else 0,
        h_acc=_accuracy(math.hypot(*fix.sigma[:2])),
        v_acc=_accuracy(fix.sigma[2]),
        vel_acc=_accuracy(math.hypot(*fix.sigma[3:5])),
    )


def odometry(solution: Solution, situation: Situation) -> Message | None:
    """ODOMETRY: position relative to home, velocity in body axes.

    Covariances are diagonal: elements that are not known are NaN, all of them when nothing is. Errors of the attitude are about
    north, east and down.
    """
    if not solution.has_position or situation.home is None:
        return None
    pose, velocity = [math.nan] * 21, [math.nan] * 21
    if solution.has_sigma:
        for place, variance in zip(DIAGONAL, (s * s for s in solution.sigma[:3] + solution.sigma[6:]), strict=True):
            pose[place] = variance
        for place, variance in zip(DIAGONAL[:3], solution.vel_b_variance, strict=True):
            velocity[place] = variance
    return mav.MAVLink_odometry_message(
        _boot_us(solution), mav.MAV_FRAME_LOCAL_NED, mav.MAV_FRAME_BODY_FRD, *solution.relative_to(situation.home),
        solution.q_nb, *solution.vel_b, *solution.w_nb_b, pose, velocity, 0, mav.MAV_ESTIMATOR_TYPE_GPS_INS,
    )  # fmt: skip


def estimator_status(solution: Solution, _: Situation) -> Message | None:
    """ESTIMATOR_STATUS: innovations over their gates, one sigma of the position, what is good.

    Where nothing aids a solution whose position cannot be trusted, its attitude alone is good.
    """
    if not solution.has_sigma:
        if not _untrusted(solution):
            return None
        nothing = [0.0] * 6 + [math.nan] * 2
        return mav.MAVLink_estimator_status_message(_boot_us(solution), mav.ESTIMATOR_ATTITUDE, *nothing)
    ratio = solution.test_ratio
    flags = _estimate_flags(solution)
    if ratio[Ratio.POSITION] >= 1.0:
        flags |= mav.ESTIMATOR_GPS_GLITCH
    north, east, down = solution.sigma[:3]
    return mav.MAVLink_estimator_status_message(
        _boot_us(solution), flags, *_ratios(solution), 0.0, 0.0, math.hypot(north, east), down
    )


def ekf_status_report(solution: Solution, _: Situation) -> Message | None:
    """EKF_STATUS_REPORT: the same for clients of ArduPilot; its variances are innovations over their gates."""
    if not solution.has_sigma:
        return mav.MAVLink_ekf_status_report_message(mav.EKF_ATTITUDE, *[0.0] * 6) if _untrusted(solution) else None
    flags = _estimate_flags(solution)
    if solution.test_ratio[Ratio.POSITION] >= 1.0:
        flags |= mav.EKF_GPS_GLITCHING
    return mav.MAVLink_ekf_status_report_message(flags, *_ratios(solution), 0.0, 0.0)


@dataclass(frozen=True)
class Kind:
    """One message of the table."""

    build: Callable[[Solution, Situation], Message | None]
    rate_hz: float
    parameter: str
    """Name of the parameter that holds the rate."""
    from_solution: bool = True
    """Sent only with a new solution; otherwise by time alone."""


KINDS = {
    "ATTITUDE": Kind(attitude, 50.0, "SR_ATT_HZ"),
    "ATTITUDE_QUATERNION": Kind(attitude_quaternion, 25.0, "SR_QUAT_HZ"),
    "HIGHRES_IMU": Kind(highres_imu, 25.0, "SR_IMU_HZ"),
    "GLOBAL_POSITION_INT": Kind(global_position_int, 10.0, "SR_GPOS_HZ"),
    "LOCAL_POSITION_NED": Kind(local_position_ned, 10.0, "SR_LPOS_HZ"),
    "VFR_HUD": Kind(vfr_hud, 5.0, "SR_HUD_HZ"),
    "ODOMETRY": Kind(odometry, 5.0, "SR_ODOM_HZ"),
    "ALTITUDE": Kind(altitude, 5.0, "SR_ALT_HZ"),
    "ESTIMATOR_STATUS": Kind(estimator_status, 2.0, "SR_EST_HZ"),
    "EKF_STATUS_REPORT": Kind(ekf_status_report, 2.0, "SR_EKF_HZ"),
    "SYSTEM_TIME": Kind(system_time, 1.0, "SR_TIME_HZ"),
    "DEBUG_VECT": Kind(debug_vect, 1.0, "SR_CLOCK_HZ"),
    "GPS_RAW_INT": Kind(gps_raw_int, 1.0, "SR_GPS_HZ"),
    "SYS_STATUS": Kind(sys_status, 2.0, "SR_SYS_HZ", from_solution=False),
    "HOME_POSITION": Kind(home_position, 0.2, "SR_HOME_HZ", from_solution=False),
    "HEARTBEAT": Kind(heartbeat, 1.0, "SR_BEAT_HZ", from_solution=False),
}
"""Every message that is sent at a rate, most urgent first."""


SHORTEST_INTERVAL_S = 0.001
LONGEST_HEARTBEAT_S = 2.0
"""Ground stations declare the link lost after 3.5 s."""


def slowest_hz(name: str) -> float:
    """Lowest rate of a message of the table."""
    return 1.0 / LONGEST_HEARTBEAT_S if name == "HEARTBEAT" else 0.0


def check_rates(rates_hz: Mapping[str, float], where: str) -> None:
    """Refuse rates of unknown messages and those out of range; `where` names them.

    Raises
    ------
    HilError
        There is one.
    """
    for name, rate_hz in rates_hz.items():
        if name not in KINDS:
            raise HilError(f"{where}.{name}: unknown message; expected one of {', '.join(KINDS)}")
        lowest = slowest_hz(name)
        if not lowest <= rate_hz <= 1.0 / SHORTEST_INTERVAL_S:
            raise HilError(f"{where}.{name} = {rate_hz}: expected {lowest:g} to 1000 Hz")


def _untrusted(solution: Solution) -> bool:
    return solution.has_position and solution.mode == Mode.NAVIGATE and bool(solution.health & Health.UNAIDED)


def _estimate_flags(solution: Solution) -> int:
    """What is good; the bits are the same in ESTIMATOR_STATUS and EKF_STATUS_REPORT, 831 when all is."""
    north, east, down, v_north, v_east, v_down, *attitude_sigma = solution.sigma
    flags = int(mav.EKF_ATTITUDE if max(attitude_sigma) <= GOOD_ATTITUDE else 0)
    if math.hypot(v_north, v_east) <= GOOD_VELOCITY_MS:
        flags |= mav.EKF_VELOCITY_HORIZ
    if v_down <= GOOD_VELOCITY_MS:
        flags |= mav.EKF_VELOCITY_VERT
    if math.hypot(north, east) <= GOOD_POSITION_M:
        flags |= mav.EKF_POS_HORIZ_REL | mav.EKF_POS_HORIZ_ABS | mav.EKF_PRED_POS_HORIZ_REL | mav.EKF_PRED_POS_HORIZ_ABS
    if down <= GOOD_POSITION_M:
        flags |= mav.EKF_POS_VERT_ABS
    return flags


def _ratios(solution: Solution) -> tuple[float, float, float, float]:
    """Of velocity, horizontal and vertical position (a fix is judged as a whole) and compass."""
    ratio = solution.test_ratio
    vertical = max(ratio[Ratio.POSITION], ratio[Ratio.HEIGHT])
    return ratio[Ratio.VELOCITY], ratio[Ratio.POSITION], vertical, ratio[Ratio.DIRECTION]


def _boot_ms(solution: Solution) -> int:
    return round(solution.time * 1e3) % 2**32


def _boot_us(solution: Solution) -> int:
    return round(solution.time * 1e6) % 2**64


def _integer(value: float, lowest: int, highest: int) -> int:
    return min(max(round(value), lowest), highest)


def _accuracy(metres: float) -> int:
    """In millimetres; 0 where it is not known."""
    return _integer(1000.0 * metres, 1, 2**32 - 1) if math.isfinite(metres) else 0


def _millimetres(metres: float) -> int:
    return _integer(1000.0 * metres, -(2**31), 2**31 - 1)


def _degrees_e7(lat: float, lon: float) -> tuple[int, int]:
    lon_deg = math.degrees(math.remainder(lon, 2.0 * math.pi))
    return _integer(math.degrees(lat) * 1e7, -900_000_000, 900_000_000), round(lon_deg * 1e7)
