"""Between python-can messages and our bulk frames."""

from typing import Any

import can

from drivers.can.frames import BRS, EFF, ERR, ESI, FDF, RTR


def from_message(message: can.Message, row: Any) -> None:
    """Write a python-can message into one `FRAME` record."""
    data = message.data or b""
    row["time_ns"] = round(message.timestamp * 1e9)
    row["can_id"] = (
        message.arbitration_id
        | (EFF if message.is_extended_id else 0)
        | (RTR if message.is_remote_frame else 0)
        | (ERR if message.is_error_frame else 0)
    )
    row["length"] = min(message.dlc, 8) if message.is_remote_frame else len(data)
    row["flags"] = (
        (FDF if message.is_fd else 0)
        | (BRS if message.bitrate_switch else 0)
        | (ESI if message.error_state_indicator else 0)
    )
    row["reserved"] = 0
    payload = row["data"]
    payload[: len(data)] = bytearray(data)
    payload[len(data) :] = 0


def to_message(row: Any, channel: str | None = None) -> can.Message:
    """The python-can message of one `FRAME` record."""
    can_id, flags = int(row["can_id"]), int(row["flags"])
    extended, remote, length = bool(can_id & EFF), bool(can_id & RTR), int(row["length"])
    return can.Message(
        timestamp=int(row["time_ns"]) * 1e-9,
        arbitration_id=can_id & (0x1FFFFFFF if extended else 0x7FF),
        is_extended_id=extended,
        is_remote_frame=remote,
        is_error_frame=bool(can_id & ERR),
        is_fd=bool(flags & FDF),
        bitrate_switch=bool(flags & BRS),
        error_state_indicator=bool(flags & ESI),
        dlc=length,
        data=None if remote else bytes(row["data"][:length]),
        channel=channel,
    )
