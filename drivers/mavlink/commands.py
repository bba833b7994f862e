"""What a ground station may ask of this component, and the answers.

Every command is acknowledged, with UNSUPPORTED where it means nothing here. Messages for other systems or components
are none of our business.
"""

import math
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from pymavlink.dialects.v20 import ardupilotmega as mav

from drivers.mavlink.events import KEPT
from drivers.mavlink.extra import ComponentMetadata, ResponseEventError
from drivers.mavlink.messages import KINDS, LONGEST_HEARTBEAT_S, SHORTEST_INTERVAL_S
from drivers.mavlink.metadata import GENERAL, checksum, uri
from drivers.mavlink.solution import Home
from drivers.mavlink.version import version_number
from nav.state import Health, Mode

if TYPE_CHECKING:
    from drivers.mavlink.endpoint import Endpoint

MESSAGE_NAMES = {int(getattr(mav, f"MAVLINK_MSG_ID_{name}")): name for name in KINDS}
"""Messages that have a rate, by number."""

FARTHEST_M = 1e5
"""Altitudes beyond this are damage."""
_STREAMS = {
    mav.MAV_DATA_STREAM_RAW_SENSORS: ("HIGHRES_IMU",),
    mav.MAV_DATA_STREAM_EXTENDED_STATUS: ("SYS_STATUS", "GPS_RAW_INT", "ESTIMATOR_STATUS"),
    mav.MAV_DATA_STREAM_POSITION: ("GLOBAL_POSITION_INT", "LOCAL_POSITION_NED"),
    mav.MAV_DATA_STREAM_EXTRA1: ("ATTITUDE", "ATTITUDE_QUATERNION"),
    mav.MAV_DATA_STREAM_EXTRA2: ("VFR_HUD",),
    mav.MAV_DATA_STREAM_EXTRA3: ("ALTITUDE", "SYSTEM_TIME", "DEBUG_VECT", "ODOMETRY", "EKF_STATUS_REPORT"),
}
_STREAMS[mav.MAV_DATA_STREAM_ALL] = tuple(name for names in _STREAMS.values() for name in names)

_LONGEST_US = 2**31 - 1
"""What MESSAGE_INTERVAL can say."""


def answer(message: Any, endpoint: "Endpoint") -> None:
    """Answer a message that arrived on `endpoint`, if it asks for something and means us."""
    handler = _HANDLERS.get(message.get_type())
    if handler is not None and _means_us(message, endpoint):
        handler(message, endpoint)


def autopilot_version() -> mav.MAVLink_message:
    """AUTOPILOT_VERSION: what this component can do; no mission, fence or rally points."""
    capabilities = (
        mav.MAV_PROTOCOL_CAPABILITY_MAVLINK2
        | mav.MAV_PROTOCOL_CAPABILITY_COMMAND_INT
        | mav.MAV_PROTOCOL_CAPABILITY_PARAM_ENCODE_C_CAST
        | mav.MAV_PROTOCOL_CAPABILITY_FTP
    )
    none = [0] * 8
    return mav.MAVLink_autopilot_version_message(capabilities, version_number(), 0, 0, 0, none, none, none, 0, 0, 0)


def _means_us(message: Any, endpoint: "Endpoint") -> bool:
    identity = endpoint.station.identity
    return getattr(message, "target_system", 0) in (0, identity.system_id) and getattr(
        message, "target_component", 0
    ) in (0, identity.component_id)


def _command_long(message: Any, endpoint: "Endpoint") -> None:
    p = [message.param1, message.param2, message.param3, message.param4, message.param5, message.param6, message.param7]
    _command(message, p, endpoint)


def _command_int(message: Any, endpoint: "Endpoint") -> None:
    p = [message.param1, message.param2, message.param3, message.param4, message.x, message.y, message.z]
    _command(message, p, endpoint)


def _command(message: Any, params: list[float], endpoint: "Endpoint") -> None:
    handler, intake = _COMMANDS.get(message.command), endpoint.station.intake
    result = mav.MAV_RESULT_UNSUPPORTED
    if handler is not None:
        result = handler(params, endpoint)
    elif message.command == mav.MAV_CMD_DO_SET_HOME:
        result = _set_home(message, params, endpoint)
    elif intake is not None:
        result = intake.command(message, params, endpoint.station)
    endpoint.send(
        mav.MAVLink_command_ack_message(
            message.command, result, 0, 0, message.get_srcSystem(), message.get_srcComponent()
        )
    )


def _name_of(value: float) -> str | None:
    """Name of the message whose number came as a parameter; None when it has no rate or is no number."""
    return MESSAGE_NAMES.get(int(value)) if math.isfinite(value) else None


def _set_message_interval(params: list[float], endpoint: "Endpoint") -> int:
    name, interval_s = _name_of(params[0]), params[1] * 1e-6
    if name is None:
        return int(mav.MAV_RESULT_UNSUPPORTED)
    if not endpoint.allows(name):
        return int(mav.MAV_RESULT_DENIED)
    if params[1] == 0.0:
        endpoint.set_interval(name, endpoint.default_s(name))
    elif params[1] == -1.0 and name != "HEARTBEAT":
        endpoint.set_interval(name, 0.0)
    elif interval_s >= SHORTEST_INTERVAL_S and interval_s <= (LONGEST_HEARTBEAT_S if name == "HEARTBEAT" else 1e6):
        endpoint.set_interval(name, interval_s)
    else:
        return int(mav.MAV_RESULT_DENIED)
    return int(mav.MAV_RESULT_ACCEPTED)


def _get_message_interval(params: list[float], endpoint: "Endpoint") -> int:
    name = _name_of(params[0])
    if not 0 <= params[0] <= 65535:
        return int(mav.MAV_RESULT_DENIED)
    interval_us = 0  # not available
    if name is not None:
        interval_us = round(min(1e6 * endpoint.interval_s(name), _LONGEST_US)) or -1
    endpoint.send(mav.MAVLink_message_interval_message(int(params[0]), interval_us))
    return int(mav.MAV_RESULT_ACCEPTED)


def _request_message(params: list[float], endpoint: "Endpoint") -> int:
    if params[0] == mav.MAVLINK_MSG_ID_AUTOPILOT_VERSION:
        return _request_version(params, endpoint)
    if params[0] == ComponentMetadata.id:
        general = endpoint.station.files[GENERAL]
        endpoint.wants_events = True  # whose words are in those files
        boot_ms = endpoint.station.device_ns() // 1_000_000 % 2**32
        endpoint.send(ComponentMetadata(boot_ms, checksum(general), uri(GENERAL).encode()))
        return int(mav.MAV_RESULT_ACCEPTED)
    name = _name_of(params[0])
    if name is None or not endpoint.allows(name):
        return int(mav.MAV_RESULT_UNSUPPORTED)
    return int(mav.MAV_RESULT_ACCEPTED if endpoint.send_now(name) else mav.MAV_RESULT_TEMPORARILY_REJECTED)


def _request_home(_: list[float], endpoint: "Endpoint") -> int:
    sent = endpoint.send_now("HOME_POSITION")
    return int(mav.MAV_RESULT_ACCEPTED if sent else mav.MAV_RESULT_TEMPORARILY_REJECTED)


def _request_version(_: list[float], endpoint: "Endpoint") -> int:
    endpoint.send(autopilot_version())
    return int(mav.MAV_RESULT_ACCEPTED)


def _calibrate(params: list[float], endpoint: "Endpoint") -> int:
    """A calibration of the gyros is an alignment, which finds their bias; nothing else is calibrated while it navigates."""
    gyro, *others = params
    station = endpoint.station
    if gyro != 1.0 or any(others):
        station.tell("notice", "hil calibrate does that, not the ground station")
        return int(mav.MAV_RESULT_UNSUPPORTED)
    if station.solution.mode == Mode.INIT or station.solution.health & Health.SILENT:
        return int(mav.MAV_RESULT_TEMPORARILY_REJECTED)
    station.on_command("align")
    return int(mav.MAV_RESULT_ACCEPTED)


def _set_home(message: Any, params: list[float], endpoint: "Endpoint") -> int:
    """DO_SET_HOME: where we are, or a place; altitudes are above the sea or above the old home."""
    station = endpoint.station
    solution, old = station.solution, station.situation.home
    if params[0] == 1.0:
        if not solution.has_position:
            return int(mav.MAV_RESULT_TEMPORARILY_REJECTED)
        return _home_at(Home(solution.lat, solution.lon, solution.height), message, endpoint)
    scale = 1e-7 if message.get_type() == "COMMAND_INT" else 1.0
    frame = getattr(message, "frame", mav.MAV_FRAME_GLOBAL)
    return _home_of(scale * params[4], scale * params[5], params[6], frame, old, message, endpoint)


def _home_of(
    lat_deg: float, lon_deg: float, altitude_m: float, frame: int, old: Home | None, message: Any, endpoint: "Endpoint"
) -> int:
    inside = abs(lat_deg) <= 90.0 and abs(lon_deg) <= 180.0 and abs(altitude_m) <= FARTHEST_M  # False for NaN
    if not inside or lat_deg == lon_deg == 0.0:
        return int(mav.MAV_RESULT_DENIED)
    lat, lon = math.radians(lat_deg), math.radians(lon_deg)
    if frame in (mav.MAV_FRAME_GLOBAL, mav.MAV_FRAME_GLOBAL_INT):
        height = altitude_m + endpoint.station.geoid(lat, lon)
    elif frame in (mav.MAV_FRAME_GLOBAL_RELATIVE_ALT, mav.MAV_FRAME_GLOBAL_RELATIVE_ALT_INT) and old is not None:
        height = altitude_m + old.height
    else:
        return int(mav.MAV_RESULT_DENIED)
    return _home_at(Home(lat, lon, height), message, endpoint)


def _home_at(home: Home, message: Any, endpoint: "Endpoint") -> int:
    """Those who may aid may move what their measurements refer to."""
    intake = endpoint.station.intake
    if intake is not None and not intake.allows(message.get_srcSystem()):
        return int(mav.MAV_RESULT_DENIED)
    endpoint.station.set_home(home)
    return int(mav.MAV_RESULT_ACCEPTED)


def _set_home_position(message: Any, endpoint: "Endpoint") -> None:
    """SET_HOME_POSITION and SET_GPS_GLOBAL_ORIGIN: what local positions refer to is home."""
    place = 1e-7 * message.latitude, 1e-7 * message.longitude, 1e-3 * message.altitude
    _home_of(*place, mav.MAV_FRAME_GLOBAL, None, message, endpoint)


def _storage(params: list[float], endpoint: "Endpoint") -> int:
    """Parameters are kept when they are set: there is nothing to load or store, but they can be forgotten."""
    if params[0] not in (0.0, 1.0, 2.0):
        return int(mav.MAV_RESULT_UNSUPPORTED)
    if params[0] == 2.0:
        endpoint.station.parameters.reset()
    return int(mav.MAV_RESULT_ACCEPTED)


def _request_data_stream(message: Any, endpoint: "Endpoint") -> None:
    rate_hz = float(message.req_message_rate) if message.start_stop else 0.0
    interval_s = max(1.0 / rate_hz, SHORTEST_INTERVAL_S) if rate_hz > 0.0 else 0.0
    for name in filter(endpoint.allows, _STREAMS.get(message.req_stream_id, ())):
        endpoint.set_interval(name, interval_s)


def _param_request_list(_: Any, endpoint: "Endpoint") -> None:
    for value in endpoint.station.parameters.all():
        endpoint.send(value)


def _param_request_read(message: Any, endpoint: "Endpoint") -> None:
    value = endpoint.station.parameters.read(message.param_id, message.param_index)
    if value is not None:
        endpoint.send(value)


def _param_set(message: Any, endpoint: "Endpoint") -> None:
    value = endpoint.station.parameters.write(message.param_id, message.param_value, message.param_type)
    if value is not None:
        endpoint.send(value)
    if problem := endpoint.station.parameters.problem:
        endpoint.station.tell("warning", problem)
        endpoint.station.parameters.problem = ""


def _mission_request_list(message: Any, endpoint: "Endpoint") -> None:
    sender = message.get_srcSystem(), message.get_srcComponent()
    endpoint.send(mav.MAVLink_mission_count_message(*sender, 0, message.mission_type))


def _mission_ack(result: int) -> Callable[[Any, "Endpoint"], None]:
    def acknowledge(message: Any, endpoint: "Endpoint") -> None:
        sender = message.get_srcSystem(), message.get_srcComponent()
        endpoint.send(mav.MAVLink_mission_ack_message(*sender, result, message.mission_type))

    return acknowledge


def _timesync(message: Any, endpoint: "Endpoint") -> None:
    if message.tc1 == 0:
        endpoint.send(mav.MAVLink_timesync_message(endpoint.station.device_ns(), message.ts1))


def _ping(message: Any, endpoint: "Endpoint") -> None:
    if message.target_system == 0 and message.target_component == 0:
        sender = message.get_srcSystem(), message.get_srcComponent()
        endpoint.send(mav.MAVLink_ping_message(message.time_usec, message.seq, *sender))


def _setup_signing(_: Any, endpoint: "Endpoint") -> None:
    endpoint.station.tell("warning", "A signing key is taken from a file, not from the network")


def _ftp(message: Any, endpoint: "Endpoint") -> None:
    sender = message.get_srcSystem(), message.get_srcComponent()
    for payload in endpoint.files.answers(bytes(message.payload), sender):
        endpoint.send(mav.MAVLink_file_transfer_protocol_message(0, *sender, payload))


def _request_event(message: Any, endpoint: "Endpoint") -> None:
    """Events that a client has missed; the first that is there no longer is told with the oldest that is."""
    endpoint.wants_events = True
    events = endpoint.station.events
    wanted = (message.last_sequence - message.first_sequence) % 65536 + 1
    for sequence in ((message.first_sequence + i) % 65536 for i in range(min(wanted, KEPT))):
        happened = events.find(sequence)
        if happened is None:
            sender = message.get_srcSystem(), message.get_srcComponent()
            endpoint.send(ResponseEventError(*sender, sequence, events.oldest, 0))
            return
        endpoint.send_event(happened)


_COMMANDS: dict[int, Callable[[list[float], "Endpoint"], int]] = {
    mav.MAV_CMD_SET_MESSAGE_INTERVAL: _set_message_interval,
    mav.MAV_CMD_GET_MESSAGE_INTERVAL: _get_message_interval,
    mav.MAV_CMD_REQUEST_MESSAGE: _request_message,
    mav.MAV_CMD_REQUEST_AUTOPILOT_CAPABILITIES: _request_version,
    mav.MAV_CMD_GET_HOME_POSITION: _request_home,
    mav.MAV_CMD_PREFLIGHT_CALIBRATION: _calibrate,
    mav.MAV_CMD_PREFLIGHT_STORAGE: _storage,
}

_HANDLERS: dict[str, Callable[[Any, "Endpoint"], None]] = {
    "COMMAND_LONG": _command_long,
    "COMMAND_INT": _command_int,
    "REQUEST_DATA_STREAM": _request_data_stream,
    "PARAM_REQUEST_LIST": _param_request_list,
    "PARAM_REQUEST_READ": _param_request_read,
    "PARAM_SET": _param_set,
    "MISSION_REQUEST_LIST": _mission_request_list,
    "MISSION_REQUEST": _mission_ack(mav.MAV_MISSION_INVALID_SEQUENCE),
    "MISSION_REQUEST_INT": _mission_ack(mav.MAV_MISSION_INVALID_SEQUENCE),
    "MISSION_COUNT": _mission_ack(mav.MAV_MISSION_UNSUPPORTED),
    "MISSION_CLEAR_ALL": _mission_ack(mav.MAV_MISSION_ACCEPTED),
    "SET_HOME_POSITION": _set_home_position,
    "SET_GPS_GLOBAL_ORIGIN": _set_home_position,
    "TIMESYNC": _timesync,
    "PING": _ping,
    "REQUEST_EVENT": _request_event,
    "SETUP_SIGNING": _setup_signing,
    "FILE_TRANSFER_PROTOCOL": _ftp,
}
