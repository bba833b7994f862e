"""What is taken from the network to aid the navigator: from whom, how often, and at what time it was true."""

from collections import Counter
from collections.abc import Callable, Collection
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from pymavlink.dialects.v20 import ardupilotmega as mav

from drivers.mavlink.aiding import (
    FROM_ANYONE,
    FROM_MASTER,
    Place,
    Refused,
    Rows,
    operator_heading,
    operator_position,
)
from nav.errors import HilError
from nav.state import Health, Mode

if TYPE_CHECKING:
    from drivers.mavlink.station import Station

SHORTEST_S = 0.01
"""Between two messages of one kind of one sender: a flood may not hold the navigator up."""
_COMMANDS = {
    mav.MAV_CMD_EXTERNAL_POSITION_ESTIMATE: "EXTERNAL_POSITION_ESTIMATE",
    mav.MAV_CMD_FIXED_MAG_CAL_YAW: "FIXED_MAG_CAL_YAW",
}


class Intake:
    """See the module. A measurement is `delay_s` older than its arrival in device time.

    Parameters
    ----------
    senders : collection of int
        Systems whose measurements and commands are accepted.
    master : (int, int), optional
        System and component of another inertial system to follow.
    delay_s : float
        Age of a measurement when it comes, s.
    take : callable
        Takes the rows of `AIDING` on; a HilError of it refuses them.
    early : bool
        The alignment uses measurements: take them while it goes on. Else they are refused until the navigation has begun.
    measurements : bool
        False: commands of an operator alone are taken.
    """

    def __init__(
        self,
        senders: Collection[int],
        master: tuple[int, int] | None,
        delay_s: float,
        take: Callable[[NDArray[Any]], None],
        *,
        early: bool = False,
        measurements: bool = True,
    ) -> None:
        self._measurements = measurements
        self._first = Mode.ALIGN if early else Mode.NAVIGATE
        self._senders, self._master, self._delay_s, self._take = frozenset(senders), master, delay_s, take
        self._last_s: dict[tuple[str, int, int], float] = {}
        self.taken: Counter[str] = Counter()
        """By message or command."""
        self.refused: Counter[str] = Counter()
        """By reason."""

    def message(self, message: Any, station: "Station") -> None:
        """Take a message if it aids."""
        if not self._measurements:
            return
        name, sender = message.get_type(), (message.get_srcSystem(), message.get_srcComponent())
        decoder = FROM_MASTER.get(name) if sender == self._master else None
        accepted = decoder is not None or sender[0] in self._senders
        decoder = decoder or FROM_ANYONE.get(name)
        if decoder is not None:
            place = Place(station.situation.home, station.geoid)
            self._attempt(name, sender, accepted, station, lambda time: decoder(message, time, place))

    def allows(self, system: int) -> bool:
        """Whether a system may change what measurements refer to."""
        return system in self._senders

    def command(self, message: Any, params: list[float], station: "Station") -> int:
        """Take a command; the MAV_RESULT to acknowledge it with."""
        name = _COMMANDS.get(message.command)
        if name is None:
            return int(mav.MAV_RESULT_UNSUPPORTED)
        degrees = 1e-7 if message.get_type() == "COMMAND_INT" else 1.0

        def decode(time: float) -> Rows:
            if message.command == mav.MAV_CMD_FIXED_MAG_CAL_YAW:
                return operator_heading(params[0], time)
            return operator_position(degrees * params[4], degrees * params[5], params[2], params[1], time)

        sender = message.get_srcSystem(), message.get_srcComponent()
        return self._attempt(name, sender, sender[0] in self._senders, station, decode)

    def _attempt(
        self,
        name: str,
        sender: tuple[int, int],
        accepted: bool,
        station: "Station",
        decode: Callable[[float], Rows],
    ) -> int:
        key = (name, *sender)
        try:
            if not accepted:
                raise Refused("sender")
            if station.now_s - self._last_s.get(key, -SHORTEST_S) < SHORTEST_S:
                raise Refused("too often")
            self._last_s[key] = station.now_s
            if station.solution.mode < self._first or station.solution.health & Health.SILENT:
                raise Refused("not navigating")
            self._take(np.array(decode(1e-9 * station.device_ns() - self._delay_s)))
        except Refused as refusal:
            self.refused[str(refusal)] += 1
        except HilError:  # it does not fit the wire to the loop
            self.refused["out of range"] += 1
        else:
            self.taken[name] += 1
            return int(mav.MAV_RESULT_ACCEPTED)
        return int(mav.MAV_RESULT_DENIED)
