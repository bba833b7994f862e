"""PX4's simulator interface: what a simulator sends to PX4 over MAVLink, and the actuators that come back.

HIL_SENSOR with id 0 drives PX4's clock. PX4 looks at whole groups of `fields_updated`: accelerometer, gyro, magnetometer,
barometer (pressure, pressure altitude, temperature). Of HIL_GPS it takes `time_usec` for UTC, altitudes are above the sea.
Source: the message definitions, and PX4, src/modules/simulation/simulator_mavlink/SimulatorMavlink.cpp.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from pymavlink.dialects.v20 import ardupilotmega as mav

from drivers.mavlink.solution import Solution
from drivers.mavlink.surroundings import Surroundings
from nav.earth import STANDARD_GRAVITY, normal_gravity
from nav.state import Mode

Message = Any
"""A message of pymavlink, which has no type information."""

ACCELEROMETER, GYRO, MAGNETOMETER, BAROMETER = 0x7, 0x38, 0x1C0, 0x1A00
"""Groups of `fields_updated`."""
LOCKSTEP = 1
"""Of `flags` in HIL_ACTUATOR_CONTROLS: PX4 waits for the next HIL_SENSOR."""
SATELLITES = 12
"""A number that PX4 wants and no solution has."""


@dataclass(frozen=True, slots=True)
class Claim:
    """One sigma that is stated where the navigator does not know its own: m, m/s."""

    position: float
    velocity: float

    def of(self, solution: Solution) -> tuple[float, float, float]:
        """Horizontal and vertical position, m, and velocity, m/s."""
        if not solution.has_sigma:
            return self.position, self.position, self.velocity
        sigma = solution.sigma
        return math.hypot(sigma[0], sigma[1]), sigma[2], math.hypot(*sigma[3:6])


def hil_sensor(solution: Solution, around: Surroundings | None, fields: int) -> Message:
    """HIL_SENSOR of id 0: rates and forces, and what `fields` names of the `around`."""
    flux_gauss = [1e4 * b for b in around.flux_b] if around and fields & MAGNETOMETER else [0.0, 0.0, 0.0]
    pressure_hpa = altitude = celsius = 0.0
    if around and fields & BAROMETER:
        pressure_hpa, altitude, celsius = 0.01 * around.pressure, solution.altitude, around.temperature - 273.15
    return mav.MAVLink_hil_sensor_message(
        _us(solution), *solution.f_b, *solution.w_ib_b, *flux_gauss, pressure_hpa, 0.0, altitude, celsius, fields, 0
    )  # fmt: skip


def hil_gps(solution: Solution, claim: Claim) -> Message:
    """HIL_GPS: the solution in the dress of a receiver."""
    north, east, down = solution.vel_n
    speed = math.hypot(north, east)
    horizontal, vertical, _ = claim.of(solution)
    return mav.MAVLink_hil_gps_message(
        time_usec=_us(solution),
        fix_type=3 if solution.mode == Mode.NAVIGATE else 2,
        lat=_integer(math.degrees(solution.lat) * 1e7, 32),
        lon=_integer(math.degrees(solution.lon) * 1e7, 32),
        alt=_integer(solution.altitude * 1e3, 32),
        eph=_unsigned(horizontal * 100.0),
        epv=_unsigned(vertical * 100.0),
        vel=_unsigned(speed * 100.0),
        vn=_integer(north * 100.0, 16),
        ve=_integer(east * 100.0, 16),
        vd=_integer(down * 100.0, 16),
        cog=round(math.degrees(math.atan2(east, north)) * 100.0) % 36000 if speed > 0.1 else 65535,
        satellites_visible=SATELLITES,
    )


def hil_state_quaternion(solution: Solution) -> Message:
    """HIL_STATE_QUATERNION: attitude, rates over the ground, position, velocity, acceleration over the ground in the body."""
    gravity_b = solution.in_body((0.0, 0.0, normal_gravity(math.sin(solution.lat), solution.height)))
    airspeed = _unsigned(math.hypot(*solution.vel_n) * 100.0)  # of still air
    return mav.MAVLink_hil_state_quaternion_message(
        _us(solution),
        list(solution.q_nb),
        *solution.w_nb_b,
        _integer(math.degrees(solution.lat) * 1e7, 32),
        _integer(math.degrees(solution.lon) * 1e7, 32),
        _integer(solution.altitude * 1e3, 32),
        *(_integer(v * 100.0, 16) for v in solution.vel_n),
        airspeed,
        airspeed,
        *(_integer((f + g) / STANDARD_GRAVITY * 1e3, 16) for f, g in zip(solution.f_b, gravity_b, strict=True)),
    )


def system_time(solution: Solution) -> Message:
    """SYSTEM_TIME: host time (UTC) at which the sample arrived, device time."""
    return mav.MAVLink_system_time_message(max(solution.arrival_ns, 0) // 1000, _us(solution) // 1000 % 2**32)


def heartbeat() -> Message:
    """HEARTBEAT of a simulator, which is no autopilot."""
    return mav.MAVLink_heartbeat_message(mav.MAV_TYPE_GENERIC, mav.MAV_AUTOPILOT_INVALID, 0, 0, mav.MAV_STATE_ACTIVE, 3)


@dataclass(frozen=True, slots=True)
class Controls:
    """One HIL_ACTUATOR_CONTROLS."""

    values: tuple[float, ...]
    """-1 to 1, or 0 to 1 for motors, as PX4's outputs are assigned; 0 while disarmed."""
    armed: bool
    lockstep: bool


def controls_of(message: Message) -> Controls | None:
    """The controls in a message; None when there are others than numbers in it."""
    values: Sequence[float] = message.controls
    if not all(math.isfinite(value) for value in values):
        return None
    armed = bool(message.mode & mav.MAV_MODE_FLAG_SAFETY_ARMED)
    return Controls(tuple(map(float, values)), armed, bool(message.flags & LOCKSTEP))


def _us(solution: Solution) -> int:
    return max(round(solution.time * 1e6), 0)


def _integer(value: float, bits: int) -> int:
    limit = (1 << (bits - 1)) - 1
    return round(min(max(value, -limit), limit))


def _unsigned(value: float) -> int:
    return round(min(max(value, 0.0), 65534.0))
