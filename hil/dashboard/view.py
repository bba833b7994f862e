"""What the window shows: the rings and counters of a run, as small records of plain numbers. It reads and never waits.

`fast` is one moment, 50 times a second; `slow` is what a person reads, five times a second; `events` are messages as they
come. Angles are in degrees here.
"""

import math
import secrets
import time
from collections import deque
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hil.bridge import EVENTS, LoopOrder, Outlets
from hil.control import Injected
from hil.dashboard.bus_load import bus_load
from hil.dashboard.comparison import Comparison, angles_deg
from hil.health import HEALTH
from hil.link_stats import LinkStats
from hil.stats import Phase, Times
from nav.instruments.redundancy import AXES, Fault
from nav.state import NAV_STATE, Health, Mode

FAST_S, SLOW_S = 0.02, 0.2
EDGES_US = (1, 2, 5, 10, 20, 50, 100, 200, 500, 1000, 2000, 5000, 10000, 20000, 50000)
"""Upper edges of the bins of the histograms; one more bin holds what is longer."""
HISTOGRAM_S = 10
"""Seconds that a histogram looks back."""
FRESH_S = 2.0
"""A loss is news for so long."""
TRACK = 1200
"""Most points of the track; then every second one goes."""
LOSSES = (
    *("lost", "duplicated", "late", "crc_errors", "foreign", "short", "version_errors"),
    *("restarts", "frozen", "clock_steps", "interpolated", "silences", "recorder_lost"),
)
BAD_HEALTH = Health.SILENT | Health.SENSOR | Health.UNITS
"""Reasons that are told in red; those besides them in amber."""
FAULTS = {
    Injected.SILENCE: "silence for 1 s",
    Injected.LOSS: "10 % loss for 1 s",
    Injected.STUCK: "axis g2y stuck for 1 s",
    Injected.BUILT_IN: "gyro 1 fails its own test for 1 s",
}


@dataclass(frozen=True, slots=True)
class Sources:
    """What a run shares with those who show it; picklable to a spawned process.

    Attributes
    ----------
    order : LoopOrder
        What is run.
    outlets : Outlets
        Its rings, counters and orders.
    links : LinkStats
        Its MAVLink links.
    simulated : bool
        The head is simulated by this run and can be told to have faults.
    recorded : bool
        A recording was asked for at the start and goes on to the end.
    """

    order: LoopOrder
    outlets: Outlets
    links: LinkStats
    simulated: bool = False
    recorded: bool = False


def recording_name(since: int) -> str:
    """File name of a recording that was asked for at the UTC second `since`."""
    return time.strftime("hil-%Y%m%d-%H%M%S.dhil", time.gmtime(since))


def _plain(values: ArrayLike) -> list[float | None]:
    """Seven digits of each, None for what is not finite."""
    return [float(f"{x:.7g}") if math.isfinite(x) else None for x in np.asarray(values, float).tolist()]


class Histogram:
    """Counts of times (us) over the last `HISTOGRAM_S`."""

    def __init__(self) -> None:
        self._slots: deque[NDArray[np.int64]] = deque([np.zeros(len(EDGES_US) + 1, np.int64)], HISTOGRAM_S)
        self._second = 0

    def add(self, times_us: NDArray[Any], now_s: float) -> None:
        """Count (n,) times, us."""
        places = np.searchsorted(EDGES_US, times_us, "right")
        self.add_counts(np.bincount(places, minlength=len(EDGES_US) + 1), now_s)

    def add_counts(self, counts: NDArray[np.int64], now_s: float) -> None:
        """Add to each bin."""
        if int(now_s) != self._second:
            self._second = int(now_s)
            self._slots.append(np.zeros(len(EDGES_US) + 1, np.int64))
        self._slots[-1] += counts

    def counts(self) -> list[int]:
        """Of each bin."""
        total: list[int] = np.sum(self._slots, axis=0).tolist()
        return total


class View:
    """Follows a run; `look` first, then read."""

    def __init__(self, sources: Sources) -> None:
        self._sources, self._scenario = sources, sources.order.scenario
        self._outlets = sources.outlets
        self._run = secrets.token_hex(4)
        """Tells the page one run from the next."""
        self._rows = np.zeros(1024, NAV_STATE)
        self._last = np.zeros(1, NAV_STATE)
        self._number = 0
        self._health = np.zeros(1, HEALTH)
        self._has_health = False
        self._notes, self._note_number = np.zeros(64, EVENTS), 0
        self._comparison: Comparison | None = None
        self._histograms = {"age": Histogram(), "jitter": Histogram()}
        self._aged = np.zeros(len(EDGES_US) + 1, np.int64)
        self._before: tuple[float, dict[str, int]] = (time.monotonic(), {})
        self._rates: dict[str, float] = {}
        self._losses = dict.fromkeys(LOSSES, 0)
        self._news = dict.fromkeys(LOSSES, -math.inf)
        self._arrived_s = time.monotonic()
        self._track: list[list[float | None]] = []
        self._spacing_s, self._tracked_s = 1.0, -math.inf
        self.events: deque[dict[str, Any]] = deque(maxlen=200)
        """Messages so far, the newest last, each with its number ``n``."""
        self.told = 0
        """How many there were."""

    def warm(self) -> None:
        """Load the kernels that a look needs; takes about a second, and may be done in a thread."""
        self._outlets.states.latest(np.zeros(1, NAV_STATE))
        self._comparison = Comparison(self._sources.order)

    @property
    def ended(self) -> bool:
        """The run is over."""
        return self._outlets.stats["phase"] in (Phase.DONE, Phase.FAILED) or self._outlets.control.stop

    def hello(self) -> dict[str, Any]:
        """What does not change, and what came before."""
        sources = self._sources
        return {
            "k": "hello",
            "run": self._run,
            "scenario": self._scenario.name,
            "bus": self._scenario.bus or str(sources.order.file),
            "faults": {fault.name.lower(): text for fault, text in FAULTS.items()} if sources.simulated else {},
            "can_record": not sources.recorded,
            "edges_us": EDGES_US,
            "track": self._track,
            "events": list(self.events),
        }

    def look(self) -> bool:
        """Take what is new; whether there is a new solution."""
        self._has_health = self._outlets.health.latest(self._health) or self._has_health
        copied, first = self._outlets.events.pull(self._notes, self._note_number)
        self._note_number = first + copied
        for note in self._notes[:copied]:
            self.tell(float(note["time"]), note["severity"].decode(), note["text"].decode(errors="replace"))
        states = self._outlets.states
        copied, first = states.pull(self._rows, max(self._number, states.count - len(self._rows)))
        self._number = first + copied
        if not copied:
            return False
        self._arrived_s = time.monotonic()
        rows = self._rows[:copied]
        self._measure(np.concatenate([self._last, rows]))
        self._last[:] = rows[-1:]
        self._mean = rows["w_ib_b"].mean(axis=0), rows["f_b"].mean(axis=0)
        self._add_to_track()
        return True

    def tell(self, device_s: float, severity: str, text: str) -> None:
        """Add a message."""
        self.told += 1
        self.events.append({"n": self.told, "t": device_s, "severity": severity, "text": text})

    def fast(self) -> dict[str, Any]:
        """The newest moment."""
        row, health = self._last[0], self._health[0]
        if self._comparison is None:
            self._comparison = Comparison(self._sources.order)
        own_world = self._has_health and bool(health["own_truth"])
        reference, errors = self._comparison.of(self._last, own_world=own_world)
        return {
            "k": "fast",
            "t": float(row["time"]),
            "mode": int(row["mode"]),
            "att": _plain(angles_deg(row["q_nb"])) if row["q_nb"].any() else None,
            "w": _plain(np.degrees(self._mean[0])),
            "f": _plain(self._mean[1]),
            "place": [math.degrees(row["lat"]), math.degrees(row["lon"]), float(row["height"])],
            "vel": _plain(row["vel_n"]),
            "ref": None if reference is None else _plain(reference),
            "err": None if errors is None else _plain(errors),
            "sig3": _plain(3.0 * row["sigma"].astype(float) * _SCALE),
            "parity": _plain(np.degrees([health["parity_mean"], health["parity_peak"]]) * 3600.0),
        }

    def slow(self) -> dict[str, Any]:
        """What a person reads."""
        stats, row = self._outlets.stats, self._last[0]
        if stats["phase"] == Phase.STARTING:
            return {"k": "slow", "state": "starting"}
        now_s = time.monotonic()
        self._differentiate(now_s)
        self._add_ages(now_s)
        silent = now_s - self._arrived_s > 1.0
        health = Health(int(row["health"])) | (Health.SILENT if silent and self._number else Health.GOOD)
        mode = Mode(int(row["mode"]))
        since = self._outlets.control.record_since
        return {
            "k": "slow",
            "state": "ended" if self.ended else "running" if self._number else "waiting",
            "mode": mode.name,
            "progress": _plain([row["progress"]])[0],
            "health": [{"name": one.name, "bad": bool(one & BAD_HEALTH)} for one in Health if one & health],
            "device_s": float(row["time"]),
            "rate_hz": self._rates.get("samples", 0.0),
            "age_us": stats["age_us"],
            "losses": {name: [self._losses[name], now_s - self._news[name] < FRESH_S] for name in LOSSES},
            "bus": self._bus(),
            "sensor": self._sensor(),
            "hist": {name: one.counts() for name, one in self._histograms.items()},
            "links": [
                one | {"sent_hz": self._rates.get(f"link{k}", 0.0)} for k, one in enumerate(self._sources.links.links())
            ],
            "sent_hz": {n: self._rates.get(n, 0.0) for n, total in self._sources.links.sent().items() if total},
            "recording": recording_name(since) if since else "",
        }

    def order(self, what: str, fault: str = "") -> str:
        """Pass an order on; why not, or an empty text."""
        control, sources = self._outlets.control, self._sources
        if self.ended:
            return "the run is over"
        if what == "align":
            control.request_align()
        elif what == "mark":
            control.request_mark()
        elif what == "record" and not sources.recorded:
            control.record_since = 0 if control.record_since else int(time.time())
        elif what == "inject" and sources.simulated and fault.upper() in Injected.__members__:
            control.inject(Injected[fault.upper()])
            self.tell(float(self._last["time"][0]), "warning", f"fault injected: {FAULTS[Injected[fault.upper()]]}")
        else:
            return f"this run does not take the order {what[:20]} {fault[:20]}".rstrip()
        return ""

    def _measure(self, rows: NDArray[Any]) -> None:
        """Jitter of rows, the first of them seen before."""
        good = (rows["health"] & Health.SILENT.value) == 0
        now_s = time.monotonic()
        came, sent = np.diff(rows["arrival_ns"]) / 1e3, np.diff(rows["time"]) * 1e6
        seen = (rows["arrival_ns"][:-1] > 0) & good[:-1]  # the first row of all has none before it
        steady = seen & good[1:] & (np.diff(rows["sequence"]) == 1) & (came > 0.0)
        self._histograms["jitter"].add(np.abs(came - sent)[steady], now_s)

    def _add_ages(self, now_s: float) -> None:
        """What the loop has counted since the last look."""
        aged = np.array(self._outlets.stats.histogram(Times.AGE, (0, *EDGES_US)))
        self._histograms["age"].add_counts(aged - self._aged, now_s)
        self._aged = aged

    def _add_to_track(self) -> None:
        row = self._last[0]
        if row["mode"] < Mode.NAVIGATE or 0.0 <= row["time"] - self._tracked_s < self._spacing_s:
            return
        self._tracked_s = float(row["time"])
        self._track.append([math.degrees(row["lat"]), math.degrees(row["lon"])])
        if len(self._track) > TRACK:
            self._track, self._spacing_s = self._track[::2], 2.0 * self._spacing_s

    def _differentiate(self, now_s: float) -> None:
        """Rates of all counters since about a second ago; losses that are new."""
        stats = self._outlets.stats
        for name in LOSSES:
            if stats[name] > self._losses[name]:
                self._news[name] = now_s
            self._losses[name] = stats[name]
        then, before = self._before
        if now_s - then < 1.0 and before:
            return
        totals = {"samples": stats["samples"], "frames": stats["frames"]}
        totals |= self._sources.links.sent()
        totals |= {f"link{k}": int(one["sent"]) for k, one in enumerate(self._sources.links.links())}
        self._rates = {name: (totals[name] - before.get(name, totals[name])) / (now_s - then) for name in totals}
        self._before = now_s, totals

    def _bus(self) -> dict[str, float]:
        frames_s, health = self._rates.get("frames", 0.0), self._health[0]
        bytes_s = frames_s * health["bytes"] / max(1, health["frames"])
        return {"frames_s": frames_s, "bytes_s": bytes_s, "load": bus_load(self._scenario.bus, frames_s, bytes_s)}

    def _sensor(self) -> dict[str, Any]:
        health = self._health[0]
        faults = zip(AXES, health["faults"].tolist(), strict=True)
        head = self._has_health and self._scenario.driver.partition("@")[0] == "dtg-head"
        return {
            "axes": {name: _words(fault) for name, fault in faults} if head else {},
            "temperature": _plain(health["temperature"]) if head else [],
            "spin": _plain(health["spin"]) if head else [],
        }


_SCALE = np.repeat([1.0, 1.0, 180.0 / math.pi], 3)


def _words(fault: int) -> str:
    return str(Fault(fault).name).lower().replace("_", "-").replace("|", ", ") if fault else ""
