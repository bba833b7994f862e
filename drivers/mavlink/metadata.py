"""What ground stations fetch to show parameters and events in words: component-information files, as JSON.

The files are those of the MAVLink component metadata protocol, read over MAVLink FTP (:mod:`drivers.mavlink.files`).
"""

import json
import math
import zlib
from collections.abc import Mapping
from typing import Any

from pymavlink.dialects.v20 import ardupilotmega as mav

from drivers.mavlink.events import EVENTS
from drivers.mavlink.parameters import Parameters

GENERAL, PARAMETERS, EVENT_FILE = "general.json", "parameters.json", "events.json"
_TYPE_PARAMETER, _TYPE_EVENTS = 1, 4
_LEVELS = {
    mav.MAV_SEVERITY_ERROR: "Error",
    mav.MAV_SEVERITY_WARNING: "Warning",
    mav.MAV_SEVERITY_NOTICE: "Notice",
    mav.MAV_SEVERITY_INFO: "Info",
}


def files(parameters: Parameters, version: str) -> dict[str, bytes]:
    """Name to content of every file."""
    found = {PARAMETERS: _text(_parameters(parameters)), EVENT_FILE: _text(_events())}
    kinds = ((_TYPE_PARAMETER, PARAMETERS), (_TYPE_EVENTS, EVENT_FILE))
    listed = [{"type": kind, "uri": uri(name), "fileCrc": checksum(found[name])} for kind, name in kinds]
    general = {
        "version": 1,
        "vendorName": "dtg-hil",
        "modelName": "inertial navigation bridge",
        "firmwareVersion": version,
        "hardwareVersion": "",
        "metadataTypes": listed,
    }
    return {GENERAL: _text(general), **found}


def uri(name: str) -> str:
    """Where a client finds a file."""
    return f"mftp:///{name}"


def checksum(data: bytes) -> int:
    """CRC-32 as MAVLink FTP has it: begun with zero, not inverted."""
    return zlib.crc32(data, 0xFFFFFFFF) ^ 0xFFFFFFFF


def _text(table: Mapping[str, Any]) -> bytes:
    return json.dumps(table).encode()


def _parameters(parameters: Parameters) -> dict[str, Any]:
    rows = []
    for parameter in parameters.table:
        row: dict[str, Any] = {
            "name": parameter.name,
            "type": "Float",
            "group": "Rates" if parameter.change else "Identity",
            "category": "Standard" if parameter.change else "System",
            "shortDesc": parameter.text,
            "default": parameters.defaults[parameter.name],
            "decimalPlaces": 0 if parameter.whole else 3,
        }
        bounds = {"min": parameter.lowest, "max": parameter.highest}
        row |= {key: value for key, value in bounds.items() if math.isfinite(value)}
        if parameter.unit:
            row["units"] = parameter.unit
        if parameter.change is None:
            row["readOnly"] = True
        rows.append(row)
    return {"version": 1, "parameters": rows}


def _events() -> dict[str, Any]:
    events = {
        str(kind.number & 0xFFFFFF): {"name": kind.name, "message": kind.text, "description": _LEVELS[kind.severity]}
        for kind in EVENTS
    }
    component = {"namespace": "dtg_hil", "event_groups": {"default": {"events": events}}}
    return {"version": 1, "components": {"1": component}}
