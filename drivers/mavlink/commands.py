"""What a ground station may ask of this component, and the answers.

Every command is acknowledged, with UNSUPPORTED where it means nothing here. Messages for other systems or components
are none of our business.
"""

import math
from collections.abc import Callable
from importlib.metadata import PackageNotFoundError, version
from typing import TYPE_CHECKING, Any

from pymavlink.dialects.v20 import ardupilotmega as mav

from drivers.mavlink.messages import KINDS, LONGEST_HEARTBEAT_S, SHORTEST_INTERVAL_S

if TYPE_CHECKING:
    from drivers.mavlink.endpoint import Endpoint

MESSAGE_NAMES = {int(getattr(mav, f"MAVLINK_MSG_ID_{name}")): name for name in KINDS}
"""Messages that have a rate, by number."""

_STREAMS = {
    mav.MAV_DATA_STREAM_RAW_SENSORS: ("HIGHRES_IMU",),
    mav.MAV_DATA_STREAM_EXTENDED_STATUS: ("SYS_STATUS", "GPS_RAW_INT", "ESTIMATOR_STATUS"),
    mav.MAV_DATA_STREAM_POSITION: ("GLOBAL_POSITION_INT", "LOCAL_POSITION_NED"),
    mav.MAV_DATA_STREAM_EXTRA1: ("ATTITUDE", "ATTITUDE_QUATERNION"),
    mav.MAV_DATA_STREAM_EXTRA2: ("VFR_HUD",),
    mav.MAV_DATA_STREAM_EXTRA3: ("ALTITUDE", "SYSTEM_TIME", "ODOMETRY", "EKF_STATUS_REPORT"),
}
_STREAMS[mav.MAV_DATA_STREAM_ALL] = tuple(name for names in _STREAMS.values() for name in names)

_FTP_NAK = 129
_FTP_FILE_NOT_FOUND = 10


def answer(message: Any, endpoint: "Endpoint") -> None:
    """Answer a message that arrived on `endpoint`, if it asks for something and means us."""
    handler = _HANDLERS.get(message.get_type())
    if handler is not None and _means_us(message, endpoint):
        handler(message, endpoint)


def software_version() -> int:
    """Version of this software as AUTOPILOT_VERSION encodes it: major, minor, patch, type (0: development)."""
    try:
        text = version("dtg-hil")
    except PackageNotFoundError:
        return 0
    parts = [int(part) if part.isdigit() else 0 for part in text.split(".")[:3]]
    major, minor, patch = (*parts, 0, 0, 0)[:3]
    return (major & 255) << 24 | (minor & 255) << 16 | (patch & 255) << 8


def autopilot_version() -> mav.MAVLink_message:
    """AUTOPILOT_VERSION: what this component can do; no mission, fence or rally points."""
    capabilities = (
        mav.MAV_PROTOCOL_CAPABILITY_MAVLINK2
        | mav.MAV_PROTOCOL_CAPABILITY_COMMAND_INT
        | mav.MAV_PROTOCOL_CAPABILITY_PARAM_ENCODE_C_CAST
    )
    none = [0] * 8
    return mav.MAVLink_autopilot_version_message(capabilities, software_version(), 0, 0, 0, none, none, none, 0, 0, 0)


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
        interval_us = round(1e6 * endpoint.interval_s(name)) or -1
    endpoint.send(mav.MAVLink_message_interval_message(int(params[0]), interval_us))
    return int(mav.MAV_RESULT_ACCEPTED)


def _request_message(params: list[float], endpoint: "Endpoint") -> int:
    if params[0] == mav.MAVLINK_MSG_ID_AUTOPILOT_VERSION:
        return _request_version(params, endpoint)
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
    """Gyro or accelerometer calibration is an alignment here; there is nothing else to calibrate."""
    gyro, others, accel = params[0], params[1:4] + params[5:6], params[4]
    if any(others) and not gyro and not accel:
        return int(mav.MAV_RESULT_UNSUPPORTED)
    endpoint.station.on_command("align")
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
    """There are no files: say so, or a client asks again and again."""
    request = bytes(message.payload)
    number = (int.from_bytes(request[:2], "little") + 1) % 65536
    reply = bytearray(251)
    reply[0:2] = number.to_bytes(2, "little")
    reply[2] = request[2]
    reply[3], reply[4], reply[5] = _FTP_NAK, 1, request[3]
    reply[12] = _FTP_FILE_NOT_FOUND
    sender = message.get_srcSystem(), message.get_srcComponent()
    endpoint.send(mav.MAVLink_file_transfer_protocol_message(0, *sender, reply))


_COMMANDS: dict[int, Callable[[list[float], "Endpoint"], int]] = {
    mav.MAV_CMD_SET_MESSAGE_INTERVAL: _set_message_interval,
    mav.MAV_CMD_GET_MESSAGE_INTERVAL: _get_message_interval,
    mav.MAV_CMD_REQUEST_MESSAGE: _request_message,
    mav.MAV_CMD_REQUEST_AUTOPILOT_CAPABILITIES: _request_version,
    mav.MAV_CMD_GET_HOME_POSITION: _request_home,
    mav.MAV_CMD_PREFLIGHT_CALIBRATION: _calibrate,
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
    "TIMESYNC": _timesync,
    "PING": _ping,
    "SETUP_SIGNING": _setup_signing,
    "FILE_TRANSFER_PROTOCOL": _ftp,
}
