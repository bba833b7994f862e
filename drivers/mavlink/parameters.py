"""The MAVLink parameter table: identity, which can be read, and message rates, which can be set and outlive the run.

All values are REAL32 on the wire, the one type that every client encodes alike; `Parameter.whole` says which of them count.
Indices are dense and never change.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from pymavlink.dialects.v20 import ardupilotmega as mav

from drivers.mavlink.store import Store
from nav.errors import HilError


@dataclass(frozen=True)
class Parameter:
    """One parameter; read-only without `change`."""

    name: str
    """At most 16 characters."""
    value: Callable[[], float]
    change: Callable[[float], None] | None = None
    lowest: float = -math.inf
    highest: float = math.inf
    unit: str = ""
    text: str = ""
    """What it is, in a few words."""
    whole: bool = False
    """A whole number; a fraction is refused."""

    def takes(self, value: float) -> bool:
        """Whether it can be set to `value`."""
        fits = self.lowest <= value <= self.highest and not (self.whole and value % 1.0)  # False for NaN
        return self.change is not None and fits


class Parameters:
    """The table and its protocol.

    Parameters
    ----------
    table : sequence of Parameter
        Their values now are the defaults.
    store : Store, optional
        Keeps what is set. A value is kept together with the default that it replaced: where the scenario gives another default
        later, that counts.

    Raises
    ------
    HilError
        What is kept cannot be read.
    """

    def __init__(self, table: Sequence[Parameter], store: Store | None = None) -> None:
        self.table = tuple(table)
        self.defaults = {parameter.name: parameter.value() for parameter in self.table}
        self.kept: dict[str, float] = {}
        """Values of an earlier run that hold."""
        self.problem = ""
        """Why a value could not be kept; empty while all is well."""
        self._index = {parameter.name: index for index, parameter in enumerate(self.table)}
        self._store = store
        for name, entry in (store.read() if store is not None else {}).items():
            value, over = (entry.get("value"), entry.get("over")) if isinstance(entry, dict) else (None, None)
            found = self._index.get(name)
            if found is None or not isinstance(value, int | float) or over != self.defaults[name]:
                continue
            parameter = self.table[found]
            if parameter.change is not None and parameter.takes(value):
                parameter.change(float(value))
                self.kept[name] = float(value)

    def all(self) -> list[mav.MAVLink_message]:
        """PARAM_VALUE of every parameter: the answer to PARAM_REQUEST_LIST."""
        return [self._told(index) for index in range(len(self.table))]

    def read(self, name: str, index: int) -> mav.MAVLink_message | None:
        """The answer to PARAM_REQUEST_READ: by name when `index` is -1; None when there is no such parameter."""
        found = self._index.get(name) if index == -1 else index
        return self._told(found) if found is not None and 0 <= found < len(self.table) else None

    def write(self, name: str, value: float, kind: int) -> mav.MAVLink_message | None:
        """The answer to PARAM_SET: what holds afterwards, changed or not; None when there is no such parameter."""
        found = self._index.get(name)
        if found is None:
            return None
        parameter = self.table[found]
        if parameter.change is not None and parameter.takes(value) and kind == mav.MAV_PARAM_TYPE_REAL32:
            parameter.change(value)
            self._keep(name, value)
        return self._told(found)

    def reset(self) -> None:
        """Let the defaults hold again, in later runs too."""
        for parameter in self.table:
            if parameter.change is not None:
                parameter.change(self.defaults[parameter.name])
        self._update(lambda _: {})

    def _keep(self, name: str, value: float) -> None:
        over = self.defaults[name]
        self._update(lambda kept: {**kept, name: {"value": value, "over": over}})

    def _update(self, change: Callable[[dict[str, object]], dict[str, object]]) -> None:
        if self._store is None:
            return
        try:
            self._store.update(change)
        except HilError as error:  # it holds for this run
            self.problem = str(error)

    def _told(self, index: int) -> mav.MAVLink_message:
        parameter = self.table[index]
        return mav.MAVLink_param_value_message(
            parameter.name.encode("ascii"), parameter.value(), mav.MAV_PARAM_TYPE_REAL32, len(self.table), index
        )
