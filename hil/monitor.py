"""What is on a bus or a port, or in a recording, as signals: value, mean, noise, rate, range, age; frames by id; losses by kind.

Nothing is sent. Signals come from the driver of the board, and from every message of the DBC files that are named; where no board
is named, all drivers listen until one of them understands.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from drivers import FrameDriver, Selective, driver_names, make_driver
from drivers.can.codec import Database, MessageCodec
from drivers.can.frames import EFF, ERR, FrameArray
from drivers.can.wire import bits
from drivers.serial.chunks import CHUNK
from hil.runs import Run, Scatter
from nav.earth import STANDARD_GRAVITY
from nav.increments import FloatArray, HeadIncrements, ImuIncrements, IntArray
from nav.instruments.redundancy import GYRO_AXES

ENOUGH = 3
"""Samples that settle which board it is."""
WINDOW_S = 5.0
"""What a person sees is of the last one to two of these, s."""
DEG = math.degrees(1.0)
_RATE, _FORCE = ("deg/s", "deg/s/sqrt(Hz)", 1.0), ("m/s^2", "ug/sqrt(Hz)", 1e6 / STANDARD_GRAVITY)
_NOT_LOSSES = ("frames", "samples")


@dataclass(slots=True)
class Signal:
    """One signal: `density` is its unit per root of Hz and the factor to it, of an axis of an inertial sensor."""

    name: str
    unit: str
    density: tuple[str, float] | None = None
    last: float = 0.0
    run: Run = field(default_factory=Run)

    def row(self, now_ns: int, *, recent: bool) -> dict[str, Any]:
        """As ``--json`` prints it."""
        part, rate = self.run.shown(recent=recent), self.run.shown(recent=recent).rate_hz
        known = self.density is not None and rate > 0.0
        return {
            "name": self.name,
            "unit": self.unit,
            "last": self.last,
            "mean": part.mean,
            "std": part.sigma,
            "density": self.density[1] * part.sigma / math.sqrt(rate) if known and self.density else None,
            "density_unit": self.density[0] if self.density else None,
            "rate_hz": rate,
            "min": part.low,
            "max": part.high,
            "age_s": max(0.0, 1e-9 * (now_ns - part.last_ns)),
            "count": part.count,
        }


@dataclass(slots=True)
class Identifier:
    """Frames of one identifier, or serial bytes."""

    name: str
    run: Run = field(default_factory=Run)
    length: int = 0
    data: bytes = b""


class Monitor:
    """Takes frames, and says what is in them.

    Parameters
    ----------
    driver : str, optional
        Of the board; left out: that of the installed ones which understands.
    databases : sequence of Database
        Messages whose signals are shown.
    bitrates : (float, float)
        Of the bus and of the data of CAN FD, or of the port, bits a second; 0: not known.
    """

    def __init__(
        self, driver: str | None, databases: Sequence[Database] = (), bitrates: tuple[float, float] = (0.0, 0.0)
    ) -> None:
        self._drivers = {name: make_driver(name) for name in ([driver] if driver else driver_names())}
        self._codecs = {can_id: codec for one in databases for can_id, codec in one.by_id.items()}
        self._bitrates = bitrates[0], bitrates[1] or bitrates[0]
        self._signals: dict[str, Signal] = {}
        self._ids: dict[int, Identifier] = {}
        self._busy = Run()
        """Seconds that the bus is taken by each batch, least; `_most` the most."""
        self._most = Run()
        self._frames = Run()
        self._losses = {"error_frames": 0} | ({"unknown": 0, "dbc_short": 0} if self._codecs else {})
        self._turned_ns = 0

    @property
    def driver(self) -> str | None:
        """Whose samples these are, once it is known."""
        return next(iter(self._drivers)) if len(self._drivers) == 1 else None

    @property
    def last_ns(self) -> int:
        """When the newest frame or sample came, ns since 1970."""
        newest = [one.run.whole.last_ns for one in self._signals.values()]
        return max([self._frames.whole.last_ns, *newest])

    def take(self, batch: FrameArray) -> None:
        """Take the next frames."""
        if len(batch) == 0:
            return
        times = batch["time_ns"].astype(np.int64)
        if times[-1] - self._turned_ns > WINDOW_S * 1e9:
            self._turned_ns = int(times[-1])
            for run in (self._frames, self._busy, self._most, *(one.run for one in self._rows())):
                run.turn()
        self._frames.take(batch["length"].astype(float), times)
        if self._bitrates[0]:
            for run, seconds in zip((self._busy, self._most), bits(batch).seconds(*self._bitrates), strict=True):
                run.take(np.full(1, seconds), times[-1:])
        ids, order = np.unique(batch["can_id"], return_inverse=True)
        for k, can_id in enumerate(ids.tolist()):
            self._identifier(can_id, batch[order == k])
        for name, driver in list(self._drivers.items()):
            samples = driver.decode(batch)
            if len(self._drivers) > 1 and driver.counters.samples >= ENOUGH:
                self._drivers = {name: driver}
            if len(self._drivers) == 1:
                self.add(samples, driver.arrivals())
                break

    def add(self, samples: HeadIncrements | ImuIncrements, arrivals_ns: IntArray) -> None:
        """Take samples of the board that came at these times."""
        good = samples.step > 0.0
        if not good.any():
            return
        times, step = arrivals_ns[good], samples.step[good, None]
        head = isinstance(samples, HeadIncrements)
        self._axes("rate", GYRO_AXES if head else ("x", "y", "z"), DEG * samples.dtheta[good] / step, _RATE, times)
        self._axes("force", ("x", "y", "z"), samples.dvel[good] / step, _FORCE, times)
        if isinstance(samples, HeadIncrements):
            self._axes("rotor", GYRO_AXES, 1e3 * samples.rotor[good], ("mrad",), times)
            self._axes("spin", ("g1", "g2"), samples.spin[good], ("Hz",), times)
            self._axes("temperature", ("g1", "g2", "a"), samples.temperature[good], ("degC",), times)

    def report(self, now_ns: int, *, recent: bool = False, port: object = None) -> dict[str, Any]:
        """What ``--json`` prints; ages are up to `now_ns`. `recent`: of the newest part; `port`: count its losses too."""
        frames = self._frames.shown(recent=recent)
        driver = self._drivers[self.driver] if self.driver else None
        return {
            "driver": self.driver,
            "identity": _plain(driver),
            "seconds": 1e-9 * (self._frames.whole.last_ns - self._frames.whole.first_ns),
            "frames": frames.count,
            "frames_hz": frames.rate_hz,
            "load": self._load(frames, recent=recent),
            "signals": [one.row(now_ns, recent=recent) for one in self._signals.values()],
            "lacking": {name: text for name, one in self._drivers.items() if (text := _lacking(one))},
            "ids": [self._id_row(key, now_ns, recent=recent) for key in sorted(self._ids)],
            "losses": self._losses | _lost(driver) | _port_losses(port),
        }

    def _rows(self) -> list[Signal | Identifier]:
        return [*self._signals.values(), *self._ids.values()]

    def _identifier(self, can_id: int, rows: FrameArray) -> None:
        if can_id != CHUNK and can_id & ERR:
            self._losses["error_frames"] += len(rows)
            return
        codec = self._codecs.get(can_id)
        one = self._ids.get(can_id)
        if one is None:
            one = self._ids[can_id] = Identifier("serial bytes" if can_id == CHUNK else codec.name if codec else "")
        one.run.take(rows["length"].astype(float), rows["time_ns"])
        one.length = int(rows["length"][-1])
        one.data = rows["data"][-1, : one.length].tobytes()
        if codec is not None:
            self._decode(codec, rows)
        elif self._codecs:
            self._losses["unknown"] += len(rows)

    def _decode(self, codec: MessageCodec, rows: FrameArray) -> None:
        good = rows[rows["length"] >= codec.length]
        self._losses["dbc_short"] += len(rows) - len(good)
        if len(good) == 0 or not codec.signals:
            return
        values = codec.decode(np.ascontiguousarray(good["data"]), np.empty((len(good), len(codec.signals))))
        for signal, column in zip(codec.signals, values.T, strict=True):
            self._values(f"{codec.name}.{signal.name}", (signal.unit,), column, good["time_ns"])

    def _axes(
        self, kind: str, names: Sequence[str], values: FloatArray, unit: tuple[Any, ...], times: IntArray
    ) -> None:
        for name, column in zip(names, values.T, strict=True):
            self._values(f"{kind}_{name}", unit, column, times)

    def _values(self, name: str, unit: tuple[Any, ...], values: FloatArray, times: NDArray[Any]) -> None:
        there = np.isfinite(values)
        if not there.any():
            return
        signal = self._signals.get(name)
        if signal is None:
            density = (unit[1], unit[2]) if len(unit) == 3 else None
            signal = self._signals[name] = Signal(name, unit[0], density)
        signal.run.take(values[there], times[there])
        signal.last = float(values[there][-1])

    def _id_row(self, can_id: int, now_ns: int, *, recent: bool) -> dict[str, Any]:
        one = self._ids[can_id]
        part = one.run.shown(recent=recent)
        text = "" if can_id == CHUNK else f"{can_id & ~EFF:08X}" if can_id & EFF else f"{can_id:03X}"
        return {
            "id": text,
            "name": one.name,
            "count": part.count,
            "rate_hz": part.rate_hz,
            "length": one.length,
            "data": one.data.hex(" "),
            "age_s": max(0.0, 1e-9 * (now_ns - part.last_ns)),
        }

    def _load(self, frames: Scatter, *, recent: bool) -> dict[str, float] | None:
        """Share of the time in which the bus is taken; None where its bit rate or the time is not known."""
        span = 1e-9 * (frames.last_ns - frames.first_ns)
        if not self._bitrates[0] or span <= 0.0:
            return None
        least, most = (run.shown(recent=recent) for run in (self._busy, self._most))
        return {"least": least.mean * least.count / span, "most": most.mean * most.count / span}


def _lacking(driver: FrameDriver) -> str:
    return driver.lacking() if isinstance(driver, Selective) else ""


def _lost(driver: FrameDriver | None) -> dict[str, int]:
    if driver is None:
        return {}
    return {name: count for name, count in driver.counters.as_dict().items() if name not in _NOT_LOSSES}


def _port_losses(port: object) -> dict[str, int]:
    """What the port says that it dropped."""
    return {f"port_{name}": getattr(port, name) for name in ("overflowed", "failures") if hasattr(port, name)}


def _plain(driver: FrameDriver | None) -> dict[str, Any]:
    """What the board says of itself, as JSON can hold it."""
    said = {} if driver is None else driver.identity()
    return {
        name: None if isinstance(value, float) and not math.isfinite(value) else value for name, value in said.items()
    }
