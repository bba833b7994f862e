"""Messages of other systems as measurements that aid the navigator: pure functions, rows of `nav.aiding.AIDING`.

Every field is checked: what is no number, out of range or says itself that it is not there is refused or left out. A row has the
time that the caller gives it. Positions are taken to be those of the antenna that the filter knows.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pymavlink.dialects.v20 import ardupilotmega as mav

from drivers.mavlink.messages import DIAGONAL
from drivers.mavlink.solution import Home, Undulation, geodetic
from nav.aiding import OPERATOR, RECEIVERS, RELAYED, Kind, aiding
from nav.errors import HilError
from nav.rotation import quaternion_from_euler

GNSS_M, GNSS_VERTICAL_M, GNSS_MS, GNSS_YAW = 5.0, 10.0, 0.5, math.radians(1.0)
"""Sigmas of a receiver that does not state its accuracy, and of its yaw."""
MASTER_M, MASTER_MS, MASTER_TILT, MASTER_HEADING = 10.0, 0.2, math.radians(0.2), math.radians(0.5)
"""Sigmas of another inertial system: its messages state none."""
OPERATOR_M, OPERATOR_HEADING = 100.0, math.radians(2.0)
"""Sigmas of an operator's position without an accuracy, and of a heading."""
SMALLEST_M, SMALLEST_MS, SMALLEST_RAD = 0.01, 0.01, 1e-4
"""No message is believed to be better than this."""
FARTHEST_M, FASTEST_MS, LONGEST_S = 1e5, 2000.0, 1.0

VISION, MASTER = RELAYED + RECEIVERS, RELAYED + RECEIVERS + 1
"""Sources of rows: a receiver is `RELAYED` + its number, below `RECEIVERS`."""

_FIXES = (
    mav.GPS_FIX_TYPE_2D_FIX,
    mav.GPS_FIX_TYPE_3D_FIX,
    mav.GPS_FIX_TYPE_DGPS,
    mav.GPS_FIX_TYPE_RTK_FLOAT,
    mav.GPS_FIX_TYPE_RTK_FIXED,
    mav.GPS_FIX_TYPE_PPP,
)


class Refused(HilError):
    """A message that is not used; the text is the reason in a word or two."""


@dataclass(frozen=True)
class Place:
    """What the messages refer to: home for local positions, None before there is one, and the geoid for altitudes."""

    home: Home | None
    geoid: Undulation


Rows = list[Any]
"""Rows of `AIDING`."""


def gps_input(message: Any, time: float, place: Place) -> Rows:
    """GPS_INPUT: a fix, and a heading where the receiver has one."""
    if message.fix_type not in _FIXES:
        raise Refused("no fix")
    if not 0 <= message.gps_id < RECEIVERS:
        raise Refused("out of range")
    ignored = message.ignore_flags

    def sigma(flag: int, value: float, missing: float, smallest: float) -> float:
        stated = 0.0 if ignored & flag else _number(value, 0.0, math.inf)
        return max(stated, smallest) if stated > 0.0 else missing

    lat, lon = _degrees_e7(message.lat, message.lon)
    level = sigma(mav.GPS_INPUT_IGNORE_FLAG_HORIZONTAL_ACCURACY, message.horiz_accuracy, GNSS_M, SMALLEST_M)
    speed = sigma(mav.GPS_INPUT_IGNORE_FLAG_SPEED_ACCURACY, message.speed_accuracy, GNSS_MS, SMALLEST_MS)
    height, north, east, down = 0.0, 0.0, 0.0, 0.0
    sigmas = [level, level, math.inf, math.inf, math.inf, math.inf]
    if message.fix_type != mav.GPS_FIX_TYPE_2D_FIX and not ignored & mav.GPS_INPUT_IGNORE_FLAG_ALT:
        height = _number(message.alt, -FARTHEST_M, FARTHEST_M) + place.geoid(lat, lon)
        sigmas[2] = sigma(
            mav.GPS_INPUT_IGNORE_FLAG_VERTICAL_ACCURACY, message.vert_accuracy, GNSS_VERTICAL_M, SMALLEST_M
        )
    if not ignored & mav.GPS_INPUT_IGNORE_FLAG_VEL_HORIZ:
        north, east = _vector((message.vn, message.ve), FASTEST_MS)
        sigmas[3] = sigmas[4] = speed
    if not ignored & mav.GPS_INPUT_IGNORE_FLAG_VEL_VERT:
        down = _number(message.vd, -FASTEST_MS, FASTEST_MS)
        sigmas[5] = speed
    source = RELAYED + message.gps_id
    rows = [aiding(time, Kind.GNSS, (lat, lon, height, north, east, down), tuple(sigmas), source)]
    if 0 < message.yaw <= 36000:
        rows.append(aiding(time, Kind.HEADING, (_turn(math.radians(0.01 * message.yaw)),), (GNSS_YAW,), source))
    return rows


def vision_position_estimate(message: Any, time: float, place: Place) -> Rows:
    """VISION_POSITION_ESTIMATE: position and attitude in north, east and down of home, each where its covariance is given."""
    pose = _sigmas(message.covariance, SMALLEST_M, SMALLEST_RAD)
    rows = _local(time, place, (message.x, message.y, message.z), pose[:3], (0.0,) * 3, (math.inf,) * 3)
    if _given(about := _about_level(pose[3:])):
        roll, pitch, yaw = _vector((message.roll, message.pitch, message.yaw), 10.0)
        rows.append(_attitude(time, quaternion_from_euler(yaw, pitch, roll), about, VISION))
    return _some(rows)


def odometry(message: Any, time: float, place: Place) -> Rows:
    """ODOMETRY in north, east and down of home: position, attitude, velocity, each where its covariance is given."""
    if message.frame_id != mav.MAV_FRAME_LOCAL_NED:
        raise Refused("frame")
    pose = _sigmas(message.pose_covariance, SMALLEST_M, SMALLEST_RAD)
    swift = _sigmas(message.velocity_covariance, SMALLEST_MS, SMALLEST_RAD)[:3]
    velocity: tuple[float, ...] = (0.0,) * 3
    rows: Rows = []
    if _given(swift):
        velocity = _vector((message.vx, message.vy, message.vz), FASTEST_MS)
    if message.child_frame_id in (mav.MAV_FRAME_BODY_FRD, mav.MAV_FRAME_BODY_NED):
        if _given(swift):
            rows.append(aiding(time, Kind.BODY_VELOCITY, velocity, swift, VISION))
        velocity, swift = (0.0,) * 3, (math.inf,) * 3
    elif message.child_frame_id != mav.MAV_FRAME_LOCAL_NED:
        raise Refused("frame")
    rows += _local(time, place, (message.x, message.y, message.z), pose[:3], velocity, swift)
    if _given(about := _about_level(pose[3:])):
        rows.append(_attitude(time, message.q, about, VISION))
    return _some(rows)


def global_position_int(message: Any, time: float, place: Place) -> Rows:
    """GLOBAL_POSITION_INT of another inertial system."""
    lat, lon = _degrees_e7(message.lat, message.lon)
    height = _number(1e-3 * message.alt, -FARTHEST_M, FARTHEST_M) + place.geoid(lat, lon)
    velocity = (0.01 * message.vx, 0.01 * message.vy, 0.01 * message.vz)
    return [aiding(time, Kind.GNSS, (lat, lon, height, *velocity), (MASTER_M,) * 3 + (MASTER_MS,) * 3, MASTER)]


def attitude_quaternion(message: Any, time: float, _: Place) -> Rows:
    """ATTITUDE_QUATERNION of another inertial system."""
    q = message.q1, message.q2, message.q3, message.q4
    return [_attitude(time, q, (MASTER_TILT, MASTER_TILT, MASTER_HEADING), MASTER)]


def operator_position(lat_deg: float, lon_deg: float, accuracy: float, age_s: float, time: float) -> Rows:
    """MAV_CMD_EXTERNAL_POSITION_ESTIMATE: horizontal; `age_s` is what the sender has spent on it, NaN accuracy is unknown."""
    lat, lon = math.radians(_number(lat_deg, -90.0, 90.0)), math.radians(_number(lon_deg, -180.0, 180.0))
    sigma = OPERATOR_M if math.isnan(accuracy) else max(_number(accuracy, 0.0, math.inf), 1.0)
    when = time - _number(age_s, 0.0, LONGEST_S)
    return [aiding(when, Kind.GNSS, (lat, lon), (sigma, sigma), OPERATOR)]


def operator_heading(heading_deg: float, time: float) -> Rows:
    """MAV_CMD_FIXED_MAG_CAL_YAW: the true heading of the vehicle, of which nothing but that is used."""
    heading = _turn(math.radians(_number(heading_deg, -360.0, 360.0)))
    return [aiding(time, Kind.HEADING, (heading,), (OPERATOR_HEADING,), OPERATOR)]


Decoder = Callable[[Any, float, Place], Rows]
FROM_ANYONE: dict[str, Decoder] = {
    "GPS_INPUT": gps_input,
    "VISION_POSITION_ESTIMATE": vision_position_estimate,
    "ODOMETRY": odometry,
}
"""Messages that are meant to aid."""
FROM_MASTER: dict[str, Decoder] = {
    "GLOBAL_POSITION_INT": global_position_int,
    "ATTITUDE_QUATERNION": attitude_quaternion,
}
"""Messages of the one other inertial system that is followed."""


def _number(value: float, lowest: float, highest: float) -> float:
    if not (lowest <= value <= highest and math.isfinite(value)):
        raise Refused("out of range" if math.isfinite(value) else "no number")
    return float(value)


def _vector(values: Sequence[float], largest: float) -> tuple[float, ...]:
    return tuple(_number(value, -largest, largest) for value in values)


def _turn(angle: float) -> float:
    return math.remainder(angle, 2.0 * math.pi)


def _degrees_e7(lat: int, lon: int) -> tuple[float, float]:
    if lat == lon == 0:
        raise Refused("no position")
    return math.radians(_number(1e-7 * lat, -90.0, 90.0)), math.radians(_number(1e-7 * lon, -180.0, 180.0))


def _sigmas(covariance: Sequence[float], smallest_m: float, smallest_rad: float) -> tuple[float, ...]:
    """One sigma of each of six; infinite where a variance is not there: NaN, zero, or a NaN in the first place."""
    variances = [covariance[place] if not math.isnan(covariance[0]) else math.nan for place in DIAGONAL]
    smallest = (smallest_m,) * 3 + (smallest_rad,) * 3
    return tuple(
        max(math.sqrt(v), least) if v > 0.0 else math.inf for v, least in zip(variances, smallest, strict=True)
    )


def _given(sigmas: Sequence[float]) -> bool:
    return min(sigmas) < math.inf


def _local(
    time: float,
    place: Place,
    ned: Sequence[float],
    sigmas: Sequence[float],
    vel_n: Sequence[float],
    vel_sigmas: Sequence[float],
) -> Rows:
    """A position relative to home, and a velocity; none where neither has a sigma."""
    if not (_given(sigmas) or _given(vel_sigmas)):
        return []
    if place.home is None:
        raise Refused("no home")
    offset = _vector(ned, FARTHEST_M) if _given(sigmas) else (0.0,) * 3
    position = geodetic(place.home, (offset[0], offset[1], offset[2]))
    return [aiding(time, Kind.GNSS, (*position, *vel_n), (*sigmas, *vel_sigmas), VISION)]


def _about_level(sigmas: Sequence[float]) -> tuple[float, float, float]:
    """Sigmas about north, east and down of those of roll, pitch and yaw: the larger of the tilts holds for both axes."""
    tilt = max(sigmas[0], sigmas[1])
    return tilt, tilt, sigmas[2]


def _attitude(time: float, q: Sequence[float] | NDArray[np.float64], sigmas: tuple[float, ...], source: int) -> Any:
    values = _vector(tuple(map(float, q)), 2.0)
    length = math.hypot(*values)
    if abs(length - 1.0) > 0.01:
        raise Refused("no attitude")
    return aiding(time, Kind.ATTITUDE, tuple(x / length for x in values), sigmas, source)


def _some(rows: Rows) -> Rows:
    if not rows:
        raise Refused("no covariance")
    return rows
