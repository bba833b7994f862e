"""What the user is told of a bad wire: each kind of fault when it begins, and how much there was when it is over.

So a bad wire fills no screen; the counters of the summary have the rest. Nothing is formatted while the counters stand still.
"""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass

from drivers import Counters, Selective
from drivers.can.bus_errors import BusErrors, is_error
from drivers.can.frames import FrameArray

QUIET_S = 1.0
"""A fault that has not shown for so long is over."""
FRAMES = {
    "lost": "samples are missing",
    "duplicated": "frames come twice",
    "late": "samples come behind later ones",
    "crc_errors": "frames fail their check",
    "foreign": "frames of another sender",
    "short": "frames have a wrong length, lack a value or make no sample",
    "version_errors": "frames are of another protocol version",
    "frozen": "the counter of the samples stands still while their time goes on",
    "clock_steps": "the sensor's clock jumped and its samples went on: time goes on with them",
}
BUS = {
    "bus_off": (
        "the CAN controller is off the bus: see wiring, termination, bit rate. Back: sudo ip link set {0} type can restart. "
        "By itself: sudo sh -c 'ip link set {0} down; ip link set {0} up type can restart-ms 100'"
    ),
    "restarted": "the CAN controller is back on the bus",
    "error_passive": "the CAN controller is error-passive, next is bus-off: see wiring, termination, bit rate",
    "error_warning": "the CAN controller has seen 96 errors: see wiring, termination, bit rate",
    "overflow": "the CAN controller's buffer overflows: frames are lost before they reach this machine",
    "no_ack": "nobody on the CAN bus acknowledges",
    "protocol": "frames on the CAN bus violate the protocol: see wiring, termination, bit rate",
    "lost_arbitration": "the CAN controller loses arbitration",
    "tx_timeout": "the CAN controller cannot send",
    "transceiver": "the CAN transceiver reports a fault of the wires",
}
_FIRST = 2
"""The counters before this one are those of good frames and samples."""
_SEVERE = {"bus_off": "error", "restarted": "notice"}


@dataclass(slots=True)
class Said:
    """Something to tell; ground stations too where `station`."""

    severity: str
    text: str
    station: bool = False


@dataclass(slots=True)
class _Fault:
    began_s: float
    shown_s: float
    before: int


class WireWatch:
    """Looks at the counters of a driver after each batch; `bus` is the URL, for the commands that mend.

    A `selective` driver is asked for what is lacking too.
    """

    def __init__(self, counters: Counters, bus: str, selective: Selective | None = None) -> None:
        self._counters, self._names = counters, list(counters.as_dict())[_FIRST:]
        self._selective, self._lacking = selective, ""
        self._before, self._faults = counters.as_list()[_FIRST:], dict[str, _Fault]()
        kind, _, place = bus.partition("?")[0].partition(":")
        self._interface = place if kind == "socketcan" else "can0"
        self.errors = BusErrors()
        """What the error frames have said."""

    def look(self, batch: FrameArray, counts: list[int], now_s: float) -> Iterable[Said]:
        """What is new with the counters `counts` after `batch`, at the device time `now_s`."""
        if not self._faults and counts[_FIRST:] == self._before and not self._lacking:
            return ()
        return self._news(batch, counts, now_s)

    def _news(self, batch: FrameArray, counts: list[int], now_s: float) -> Iterator[Said]:
        lacking = "" if self._selective is None else self._selective.lacking()
        if lacking != self._lacking:
            self._lacking = lacking
            if lacking:
                yield Said("warning", lacking, station=True)
        if counts[_FIRST:] != self._before:
            before, self._before = dict(zip(self._names, self._before, strict=True)), counts[_FIRST:]
            for name, count in zip(self._names, self._before, strict=True):
                errors = int(is_error(batch).sum()) if name == "foreign" else 0
                if name in FRAMES and count > before[name] + errors:
                    yield from self._shown(name, before[name], now_s, Said("warning", f"{name}: {FRAMES[name]}"))
            if self._counters.foreign > before["foreign"]:
                yield from self._bus(batch, now_s)
        for name, fault in list(self._faults.items()):
            if not 0.0 <= now_s - fault.shown_s <= QUIET_S:
                del self._faults[name]
                count = getattr(self._counters if name in FRAMES else self.errors, name) - fault.before
                yield Said("notice", f"{name}: {count} in {max(fault.shown_s - fault.began_s, 0.0):.3f} s, no more")

    def _bus(self, batch: FrameArray, now_s: float) -> Iterator[Said]:
        before = self.errors.as_dict()
        self.errors.add(batch)
        for name, count in self.errors.as_dict().items():
            if count > before.get(name, 0):
                text = BUS[name].format(self._interface)
                said = Said(_SEVERE.get(name, "warning"), text, station=name in _SEVERE)
                yield from self._shown(name, before.get(name, 0), now_s, said)

    def _shown(self, name: str, before: int, now_s: float, said: Said) -> Iterator[Said]:
        fault = self._faults.get(name)
        if fault is not None:
            fault.shown_s = now_s
            return
        self._faults[name] = _Fault(now_s, now_s, before)
        yield said
