"""What all links of a MAVLink component share: identity, the newest solution, home, parameters, notes.

Nothing here has a thread or a clock: the caller says what time it is.
"""

from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from pymavlink.dialects.v20 import ardupilotmega as mav

from drivers.mavlink.events import EventLog
from drivers.mavlink.intake import Intake
from drivers.mavlink.messages import (
    KINDS,
    SHORTEST_INTERVAL_S,
    VEHICLES,
    ClockReading,
    Fix,
    Situation,
    check_rates,
    slowest_hz,
)
from drivers.mavlink.metadata import files
from drivers.mavlink.parameters import Parameter, Parameters
from drivers.mavlink.solution import Home, Solution, Undulation
from drivers.mavlink.store import Store
from drivers.mavlink.version import software_version
from nav.errors import HilError
from nav.state import NAV_STATE, Health, Mode

_NOTES = 16
"""Most notes that wait to be told."""
SEVERITIES = {
    "info": int(mav.MAV_SEVERITY_INFO),
    "notice": int(mav.MAV_SEVERITY_NOTICE),
    "warning": int(mav.MAV_SEVERITY_WARNING),
    "error": int(mav.MAV_SEVERITY_ERROR),
}


@dataclass(frozen=True)
class Identity:
    """Who we are on the network."""

    system_id: int = 1
    component_id: int = 1
    vehicle: str = "fixed-wing"


class Station:
    """What all links share.

    Parameters
    ----------
    identity : Identity
        System, component, vehicle type (a key of `messages.VEHICLES`).
    rates_hz : mapping
        Message name to rate, over the built-in ones; 0 switches a message off.
    geoid : callable
        (lat, lon), rad, to the height of the geoid above the ellipsoid, m.
    on_command : callable
        Called with the name of what a ground station wants done: ``"align"``.
    intake : Intake, optional
        Takes what aids the navigator; without it nothing does.
    store : Store, optional
        Keeps parameters that are set.

    Raises
    ------
    HilError
        An unknown message name or vehicle, or a rate out of range.
    """

    def __init__(
        self,
        identity: Identity,
        rates_hz: Mapping[str, float],
        geoid: Undulation,
        on_command: Callable[[str], None],
        intake: Intake | None = None,
        store: Store | None = None,
    ) -> None:
        if identity.vehicle not in VEHICLES:
            raise HilError(f"mavlink.vehicle = {identity.vehicle!r}: unknown; expected one of {', '.join(VEHICLES)}")
        check_rates(rates_hz, "mavlink.rates_hz")
        self.identity = identity
        self.geoid = geoid
        self.on_command = on_command
        self.intake = intake
        self.on_home: list[Callable[[], None]] = []
        self.on_rate: list[Callable[[str], None]] = []
        self.on_attitude: Callable[[], None] = lambda: None
        """Called when ATTITUDE is out on a link."""
        self._rates_hz = {name: kind.rate_hz for name, kind in KINDS.items()} | dict(rates_hz)
        self.parameters = Parameters(self._table(), store)
        self.files = files(self.parameters, software_version())
        self.events = EventLog()
        self.situation = Situation(
            VEHICLES[identity.vehicle], beside=identity.component_id != mav.MAV_COMP_ID_AUTOPILOT1
        )
        self.solution = Solution.of(np.zeros(1, NAV_STATE)[0], geoid)
        self.number = 0
        """Counts solutions; 0 before the first one."""
        self.notes: deque[tuple[int, str]] = deque(maxlen=_NOTES)
        """The newest notes: severity and text."""
        self.noted = 0
        """Counts notes."""
        self.now_s = 0.0
        self._updated_s = 0.0
        for name, value in self.parameters.kept.items():
            self.tell("info", f"{name} is {value:g}, kept from an earlier run")

    def update(self, row: Any, now_s: float) -> None:
        """Take a new solution, one record of `NAV_STATE`; the first one that navigates sets home."""
        self.solution = Solution.of(row, self.geoid)
        self.number += 1
        self.now_s = self._updated_s = now_s
        if self.situation.home is None and self.solution.mode == Mode.NAVIGATE and self.solution.has_position:
            home = Home(self.solution.lat, self.solution.lon, self.solution.height)
            self.situation = replace(self.situation, home=home)
        self._follow()

    def set_home(self, home: Home) -> None:
        """Have relative positions refer to another place; it is told on every link."""
        self.situation = replace(self.situation, home=home)
        for told in self.on_home:
            told()

    def set_fix(self, row: Any) -> None:
        """Take the newest fix of a receiver, a row of `AIDING`."""
        lat, lon, height, *velocity = row["value"].tolist()
        sigma = tuple(row["sigma"].tolist())
        fix = Fix(float(row["time"]), Home(lat, lon, height), (velocity[0], velocity[1], velocity[2]), sigma)
        self.situation = replace(self.situation, fix=fix)

    def silence(self) -> None:
        """No solution has come for too long: say so in status and text until the next one."""
        mode = Mode.DEGRADED if self.solution.mode == Mode.NAVIGATE else self.solution.mode
        self.solution = replace(self.solution, mode=mode, health=self.solution.health | Health.SILENT)
        self._follow()

    def _follow(self) -> None:
        solution = self.solution
        self.events.follow(solution.mode, solution.health, self.device_ns() // 1_000_000, self.now_s)

    def tell(self, severity: str, text: str) -> None:
        """Have something said on every link: ``"info"``, ``"notice"``, ``"warning"`` or ``"error"``."""
        self.notes.append((SEVERITIES[severity], text))
        self.noted += 1

    def set_loss(self, lost: int, samples: int) -> None:
        """Sensor samples lost and received since the start."""
        if (lost, samples) != (self.situation.lost, self.situation.samples):
            self.situation = replace(self.situation, lost=lost, samples=samples)

    def set_clock(self, clock: ClockReading | None) -> None:
        """What is known of the device's clock against the host's."""
        if clock != self.situation.clock:
            self.situation = replace(self.situation, clock=clock)

    def device_ns(self) -> int:
        """Device time now, ns; the caller's clock before the first solution."""
        start_s = self.solution.time if self.number and self.solution.has_imu else 0.0
        return int(1e9 * (start_s + self.now_s - self._updated_s))

    def interval_s(self, name: str) -> float:
        """Interval that message `name` has on a new link, s; 0 when it is off."""
        rate_hz = self._rates_hz[name]
        return 1.0 / rate_hz if rate_hz > 0.0 else 0.0

    def _table(self) -> list[Parameter]:
        identity = self.identity
        table = [
            Parameter("SYSID_THISMAV", lambda: float(identity.system_id), text="MAVLink system id", whole=True),
            Parameter("HIL_COMPID", lambda: float(identity.component_id), text="MAVLink component id", whole=True),
            Parameter("HIL_VEHICLE", lambda: float(VEHICLES[identity.vehicle]), text="Vehicle type", whole=True),
        ]
        for name, kind in KINDS.items():
            lowest = slowest_hz(name)
            highest, text = 1.0 / SHORTEST_INTERVAL_S, f"Rate of {name} on every link; 0: off"
            table.append(Parameter(kind.parameter, self._get(name), self._set(name), lowest, highest, "Hz", text))
        return table

    def _get(self, name: str) -> Callable[[], float]:
        return lambda: self._rates_hz[name]

    def _set(self, name: str) -> Callable[[float], None]:
        def change(rate_hz: float) -> None:
            self._rates_hz[name] = rate_hz
            for told in self.on_rate:
                told(name)

        return change
