"""Messages of MAVLink's common set that pymavlink's dialects lack: component metadata and events.

They are in the dialect's table from the import of this module on, so that its parser knows them too.
"""

import struct
from typing import Any

from pymavlink.dialects.v20 import ardupilotmega as mav


class _Extra(mav.MAVLink_message):  # type: ignore[misc]
    """A message made of its fields in the order of the definition."""

    def __init__(self, *values: Any) -> None:
        super().__init__(self.id, self.msgname)
        self._fieldnames = self.fieldnames
        for name, value in zip(self.fieldnames, values, strict=True):
            setattr(self, name, value)

    def pack(self, packer: mav.MAVLink, force_mavlink1: bool = False) -> bytes:
        """The frame."""
        values = []
        for name in self.ordered_fieldnames:
            value = getattr(self, name)
            values += value if isinstance(value, list) else [value]
        return bytes(self._pack(packer, self.crc_extra, self.unpacker.pack(*values), force_mavlink1=force_mavlink1))


def _message(number: int, name: str, crc_extra: int, fields: dict[str, str], order: tuple[str, ...]) -> type[_Extra]:
    """A class of the definition's `fields` (name to type), which lie on the wire in `order`."""
    codes = {"uint8_t": "B", "uint16_t": "H", "uint32_t": "I"}
    layout, arrays = "<", []
    for field in order:
        kind, _, length = fields[field].rstrip("]").partition("[")
        layout += f"{length}s" if kind == "char" else f"{length}{codes[kind]}"
        arrays.append(int(length or 0))
    made = type(
        name.title().replace("_", ""),
        (_Extra,),
        {
            "id": number,
            "msgname": name,
            "crc_extra": crc_extra,
            "fieldnames": list(fields),
            "ordered_fieldnames": list(order),
            "fieldtypes": [kind.partition("[")[0] for kind in fields.values()],
            "orders": [order.index(field) for field in fields],
            "lengths": [
                1 if fields[field].startswith("char") else max(size, 1)
                for field, size in zip(order, arrays, strict=True)
            ],
            "array_lengths": arrays,
            "unpacker": struct.Struct(layout),
            "native_format": bytearray(b"<" + b"".join(_code(fields[field]) for field in order)),
        },
    )
    mav.mavlink_map[number] = made
    return made


def _code(kind: str) -> bytes:
    return {"char": b"c", "uint8_t": b"B", "uint16_t": b"H", "uint32_t": b"I"}[kind.partition("[")[0]]


ComponentMetadata = _message(
    397,
    "COMPONENT_METADATA",
    182,
    {"time_boot_ms": "uint32_t", "file_crc": "uint32_t", "uri": "char[100]"},
    ("time_boot_ms", "file_crc", "uri"),
)
Event = _message(
    410,
    "EVENT",
    160,
    {
        "destination_component": "uint8_t",
        "destination_system": "uint8_t",
        "id": "uint32_t",
        "event_time_boot_ms": "uint32_t",
        "sequence": "uint16_t",
        "log_levels": "uint8_t",
        "arguments": "uint8_t[40]",
    },
    ("id", "event_time_boot_ms", "sequence", "destination_component", "destination_system", "log_levels", "arguments"),
)
CurrentEventSequence = _message(
    411, "CURRENT_EVENT_SEQUENCE", 106, {"sequence": "uint16_t", "flags": "uint8_t"}, ("sequence", "flags")
)
RequestEvent = _message(
    412,
    "REQUEST_EVENT",
    33,
    {
        "target_system": "uint8_t",
        "target_component": "uint8_t",
        "first_sequence": "uint16_t",
        "last_sequence": "uint16_t",
    },
    ("first_sequence", "last_sequence", "target_system", "target_component"),
)
ResponseEventError = _message(
    413,
    "RESPONSE_EVENT_ERROR",
    77,
    {
        "target_system": "uint8_t",
        "target_component": "uint8_t",
        "sequence": "uint16_t",
        "sequence_oldest_available": "uint16_t",
        "reason": "uint8_t",
    },
    ("sequence", "sequence_oldest_available", "target_system", "target_component", "reason"),
)
