"""The MAVLink parameter table: identity, which can be read, and message rates, which can be set.

All values are REAL32, the one type that every client encodes alike. Indices are dense and never change.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from pymavlink.dialects.v20 import ardupilotmega as mav


@dataclass(frozen=True)
class Parameter:
    """One parameter; read-only without `change`."""

    name: str
    """At most 16 characters."""
    value: Callable[[], float]
    change: Callable[[float], None] | None = None
    lowest: float = -math.inf
    highest: float = math.inf


class Parameters:
    """The table and its protocol."""

    def __init__(self, table: Sequence[Parameter]) -> None:
        self._table = tuple(table)
        self._index = {parameter.name: index for index, parameter in enumerate(self._table)}

    def all(self) -> list[mav.MAVLink_message]:
        """PARAM_VALUE of every parameter: the answer to PARAM_REQUEST_LIST."""
        return [self._told(index) for index in range(len(self._table))]

    def read(self, name: str, index: int) -> mav.MAVLink_message | None:
        """The answer to PARAM_REQUEST_READ: by name when `index` is -1; None when there is no such parameter."""
        found = self._index.get(name) if index == -1 else index
        return self._told(found) if found is not None and 0 <= found < len(self._table) else None

    def write(self, name: str, value: float, kind: int) -> mav.MAVLink_message | None:
        """The answer to PARAM_SET: what holds afterwards, changed or not; None when there is no such parameter."""
        found = self._index.get(name)
        if found is None:
            return None
        parameter = self._table[found]
        allowed = parameter.lowest <= value <= parameter.highest  # False for NaN
        if parameter.change is not None and allowed and kind == mav.MAV_PARAM_TYPE_REAL32:
            parameter.change(value)
        return self._told(found)

    def _told(self, index: int) -> mav.MAVLink_message:
        parameter = self._table[index]
        return mav.MAVLink_param_value_message(
            parameter.name.encode("ascii"), parameter.value(), mav.MAV_PARAM_TYPE_REAL32, len(self._table), index
        )
