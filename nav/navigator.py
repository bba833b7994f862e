"""The navigator: gap policy, alignment and mechanization joined by a mode machine.

It takes batches of `ImuIncrements` and answers one `NAV_STATE` row for each sample, received or filled. Everything it
decides depends on the samples and on the explicit calls (`begin`, `realign`, `silent`) alone, in their order, never on
how samples were batched and never on a clock: a recording replays bit for bit.
"""

import math
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from nav.aiding import OPERATOR, Kind
from nav.alignment import rest
from nav.alignment.chain import aligner, check_grade
from nav.alignment.plan import GIVEN_UP, Plan, Start, Way, Word
from nav.alignment.rest import UNSTATED, Sensors
from nav.earth import curvature_radii
from nav.errors import HilError
from nav.filter.aided import AidedNavigator
from nav.filter.aided import Settings as FilterSettings
from nav.filter.assumptions import Assumed, Assumptions
from nav.filter.record import Recorder
from nav.filter.states import GYRO_BIAS, Tuning
from nav.filter.watch import Watch
from nav.frames import earth_rate_in_body
from nav.gaps import Gap, GapFiller, GapPolicy
from nav.increments import FloatArray, ImuIncrements, IntArray, Validity
from nav.kernel import kernel
from nav.lever_arm import shift
from nav.ordinary import Parts, take_one
from nav.rotation import euler_from_quaternion
from nav.solutions import Solutions, StateArray
from nav.state import Health, Mode, Ratio
from nav.strapdown import Answers, Strapdown

Severity = Literal["info", "notice", "warning", "error"]

DISTRUST = Health.SILENT | Health.BRIDGED | Health.SENSOR
"""Health that makes the mode DEGRADED."""
_SILENT = int(Health.SILENT)
_FLAGS = int(Validity.SENSOR | Validity.SPARE)
_LAT, _LON, _HEIGHT, _VEL, _Q = slice(0, 1), slice(1, 2), slice(2, 3), slice(3, 6), slice(6, 10)
REST_WINDOW_S = 2.0
"""Length of the windows in which the bias is tracked at rest, s."""
REST_GAIN = 0.2
"""Weight of one window in the tracked bias (time constant about 10 s)."""
REST_BIAS_STEP = 0.003
"""A window that would change the bias by more than this is a slow turn, not rest, rad/s."""


@dataclass(frozen=True, slots=True)
class Aiding:
    """How measurements besides the inertial ones are used.

    Attributes
    ----------
    tuning : Tuning
        What the sensors are worth and what is estimated of them.
    filter : nav.filter.aided.Settings
        How the filter is run.
    sigma : (9,) float
        Of the start, at least: position and velocity north, east, down (m, m/s), attitude about them (rad).
    assumptions : Assumptions, optional
        What is known without another sensor.
    """

    tuning: Tuning
    filter: FilterSettings
    sigma: FloatArray
    assumptions: Assumptions | None = None


@dataclass(frozen=True, slots=True)
class Settings:
    """What the navigator has to know.

    Attributes
    ----------
    lat, lon, height : float
        Position where alignment takes place, rad and m above the ellipsoid.
    alignment : Way
        See :mod:`nav.alignment.chain`; ``level`` needs `heading`, or a heading source among the measurements.
    align_s : float
        How long it takes, s.
    heading : float, optional
        Given heading, rad.
    sensors : Sensors
        What is known of the sensors in a level vehicle.
    sway : float
        How far a swaying base moves about its mean place, one sigma an axis, m.
    track_bias_at_rest : bool
        Keep averaging the gyro bias at rest.
    position_trusted : bool
        False marks the solution `Health.UNAIDED`, but where a receiver's fixes hold it.
    lever_arm : tuple of float
        From the navigated point to the sensor, body axes, m. What goes in and out is the navigated point.
    antenna : tuple of float
        From the sensor to the GNSS antenna, body axes, m; for the alignment in motion.
    """

    lat: float = 0.0
    lon: float = 0.0
    height: float = 0.0
    alignment: Way = "gyrocompass"
    align_s: float = 30.0
    heading: float | None = None
    sensors: Sensors = UNSTATED
    sway: float = 0.3
    track_bias_at_rest: bool = False
    position_trusted: bool = True
    attitude: str = "two-sample"
    mechanization: str = "geographic"
    gravity: str = "normal"
    lever_arm: tuple[float, float, float] = (0.0, 0.0, 0.0)
    antenna: tuple[float, float, float] = (0.0, 0.0, 0.0)
    gaps: GapPolicy = field(default_factory=GapPolicy)
    aiding: Aiding | None = None
    """None: measurements besides the inertial ones are not used."""


@dataclass(frozen=True, slots=True)
class Event:
    """Something that the user is told: a change of mode, a gap, a refusal."""

    time: float
    severity: Severity
    text: str
    station: bool = False
    """Ground stations are told too: they cannot see it from mode and health."""


class Navigator:
    """See the module; what the filter does is noted in a `recorder`, if there is one.

    Raises
    ------
    HilError
        Unknown method or mechanization; ``level`` without a heading; sensors that cannot find north where they should.
    """

    def __init__(self, settings: Settings, recorder: Recorder | None = None) -> None:
        self._core = Strapdown(settings.attitude, settings.mechanization, settings.gravity)
        aiding = settings.aiding
        self._aided = None if aiding is None else AidedNavigator(self._core, aiding.tuning, aiding.filter, recorder)
        self._watch = None if self._aided is None else Watch(self._aided)
        self._assumed = None if aiding is None or aiding.assumptions is None else Assumed(aiding.assumptions)
        if settings.alignment == "level" and settings.heading is None and aiding is None:
            raise HilError(
                'alignment "level" needs a heading: give navigation.start.heading_deg, or a heading sensor and navigation.aided'
            )
        self._plan = _plan(settings)
        check_grade(self._plan)
        self.settings = settings
        self.mode = Mode.INIT
        self.health = Health.GOOD if settings.position_trusted else Health.UNAIDED
        self.gyro_bias = np.zeros(3)
        self._flagged = 0
        self._filler = GapFiller(settings.gaps)
        self._sums = np.zeros(rest.SUMS)
        self._state = _solution(settings.lat, settings.lon, settings.height, np.zeros(3), np.zeros(4))
        self._arm = np.asarray(settings.lever_arm, float)
        self._has_arm = bool(self._arm.any())
        self._plain = aiding is None and not settings.track_bias_at_rest and not self._has_arm
        """Nothing but the core looks at a sample."""
        self._aligner = aligner(self._plan, self._state[:3])
        self._progress = 0.0
        self._events: list[Event] = []
        self._solutions = Solutions()
        self._worthless = np.full(9, np.inf, np.float32), np.zeros(len(Ratio), np.float32)
        self._parts: Parts | None = None

    def events(self) -> list[Event]:
        """What happened since the last call."""
        events, self._events = self._events, []
        return events

    def begin(
        self,
        lat: float,
        lon: float,
        height: float,
        vel_n: FloatArray,
        q_nb: FloatArray,
        time: float,
        w_ib_b: FloatArray | None = None,
    ) -> None:
        """Navigate from a known state of the navigated point instead of aligning.

        Position in rad and m, velocity in m/s; the body rate (rad/s) matters with a lever arm only.
        """
        self._state = _solution(lat, lon, height, vel_n, q_nb)
        self._move(1.0, w_ib_b)
        self._start_core(time, np.zeros(9))
        self._sums[:] = 0.0
        self._progress = 1.0
        self.tell(time, "info", "navigating from a given start")
        self.mode = Mode.NAVIGATE

    def realign(self, time: float, reason: str) -> None:
        """Give the attitude up and align again at the present position."""
        self.mode = Mode.ALIGN
        self.health &= ~(Health.BRIDGED | GIVEN_UP)
        self._sums[:] = 0.0
        self._progress = 0.0
        if self._state[6:10].any():
            self._move(-1.0)
        lat, lon, height = self._state[:3]
        self._state = _solution(lat, lon, height, np.zeros(3), np.zeros(4))
        self._aligner = aligner(self._plan, self._state[:3])
        self.tell(time, "notice", f"aligning: {reason}")

    def aid(self, rows: NDArray[Any]) -> None:
        """Take measurements (:data:`nav.aiding.AIDING`): for the alignment, then for the filter, if there is one.

        Without a filter an operator's position and heading are taken as they are, and nothing else is.

        Raises
        ------
        HilError
            A value or a standard deviation that is used is no number.
        """
        if self.mode == Mode.ALIGN:
            _check(rows)
            self._aligner.aid(rows)
        elif self.mode not in (Mode.NAVIGATE, Mode.DEGRADED):
            return
        elif self._aided is None:
            words = rows[rows["source"] == OPERATOR]
            _check(words)
            for word in words:
                self._set(word)
        else:
            self._aided.aid(rows)
            for restart in self._aided.restarts():
                text = "the filter had diverged: it starts again where GNSS says"
                self.tell(restart.time, "warning", text, station=True)

    def _set(self, word: Any) -> None:
        """Move or turn the solution to what an operator says."""
        core, given = self._core, word["value"]
        if word["kind"] == Kind.GNSS:
            lat, lon, height = core.solution[:3]
            meridian, prime = curvature_radii(math.sin(lat))
            north = (lat - given[0]) * (meridian + height)
            east = math.remainder(lon - given[1], 2.0 * math.pi) * (prime + height) * math.cos(lat)
            core.correct(np.array([north, east, 0.0]), np.zeros(3), np.zeros(3))
            what = "position"
        elif word["kind"] == Kind.HEADING:
            turn = math.remainder(euler_from_quaternion(core.solution[6:10])[0] - given[0], 2.0 * math.pi)
            core.correct(np.zeros(3), np.zeros(3), np.array([0.0, 0.0, turn]))
            what = "heading"
        else:
            return
        self._state[:] = core.solution
        self.tell(float(word["time"]), "notice", f"the {what} is the operator's", station=True)

    def silent(self) -> StateArray:
        """The sensor has fallen silent: one row that repeats the last state and says so."""
        self.health |= Health.SILENT
        if self.mode == Mode.NAVIGATE:
            self.mode = Mode.DEGRADED
        row = self._solutions.last
        row["mode"], row["health"] = self.mode, self.health
        self.tell(float(row["time"][0]), "error", "no samples: the sensor is silent")
        return row

    def process(self, imu: ImuIncrements) -> StateArray:
        """One row of `NAV_STATE` for each sample and each filled step; valid until the next call.

        Raises
        ------
        HilError
            An increment is not finite.
        """
        if len(imu) == 1 and self._take_one(imu):
            return self._solutions.room(1)
        bad = imu.first_bad()
        if bad >= 0:
            raise HilError(f"increment {int(imu.sequence[bad])} is not a number: mend the driver or the file")
        imu, gaps = self._filler.fill(imu)
        n = len(imu)
        rows = self._solutions.room(n)
        if n == 0:
            return rows
        if self.mode == Mode.INIT:
            self.realign(float(imu.time[0]), self._plan.order)
        if self.health & Health.SILENT:
            self.health &= ~Health.SILENT
            self.tell(float(imu.time[0]), "notice", "samples arrive again")
            if not (gaps and gaps[0].realign):
                self._trust(float(imu.time[0]))
        start = 0
        for gap in gaps:
            self._run(imu, start, gap.row)
            self._meet(gap)
            start = gap.row
        self._run(imu, start, n)
        self._solutions.add_samples(imu)
        if self._has_arm:
            there = np.ascontiguousarray(rows[rows["mode"] >= Mode.NAVIGATE])
            point = there["lat"], there["lon"], there["height"], there["vel_n"]
            shift(*point, there["q_nb"], there["w_ib_b"], -self._arm)
            rows[rows["mode"] >= Mode.NAVIGATE] = there
        self._solutions.keep_last(n)  # what `silent` repeats
        return rows

    def _take_one(self, imu: ImuIncrements) -> bool:
        """Take an ordinary sample (:mod:`nav.ordinary`); False, and nothing has changed, when it is not one."""
        ready = self.ordinary()
        sample = imu.time, imu.step, imu.dtheta, imu.dvel, imu.validity, imu.sequence
        if ready is None or not take_one(*ready, self.parts, sample):
            return False
        self.passed(float(imu.time[0]))
        return True

    def ordinary(self) -> tuple[int, tuple[int, int, int], tuple[int, int, float]] | None:
        """What :func:`nav.ordinary.take_one` needs to know besides `parts`; None when the next sample is not ordinary."""
        health = int(self.health)
        if not self._plain or not self._core.address or self.mode < Mode.NAVIGATE or health & _SILENT:
            return None
        return self._core.address, (self._filler.expected, self._flagged, _FLAGS), (int(self.mode), health, 1.0)

    @property
    def parts(self) -> Parts:
        """For :func:`nav.ordinary.take_one`; another tuple whenever something in it is."""
        parts = self._parts
        if parts is None or parts[0] is not self.gyro_bias or parts[3] is not self._solutions.buffer:
            filler = self._filler
            parts = self.gyro_bias, *self._worthless, self._solutions.buffer, filler.rate, filler.force
            self._parts = parts
        return parts

    def passed(self, time: float) -> StateArray:
        """Take over the sample that ended at `time`, s, and that `take_one` has taken; its row, valid until the next sample."""
        self._filler.passed(self._filler.expected, time)
        self._state[:] = self._core.solution
        return self._solutions.room(1)

    def _move(self, sign: float, w_ib_b: FloatArray | None = None) -> None:
        """Move the state from the navigated point to the sensor (`sign` 1) or back (-1)."""
        if not self._has_arm:
            return
        lat, lon, height, vel_n, q_nb = (self._state[part] for part in (_LAT, _LON, _HEIGHT, _VEL, _Q))
        rate = np.zeros((1, 3)) if w_ib_b is None else np.asarray(w_ib_b, float).reshape(1, 3)
        shift(lat, lon, height, vel_n.reshape(1, 3), q_nb.reshape(1, 4), rate, sign * self._arm)

    def _start_core(self, time: float, sigma: FloatArray) -> None:
        lat, lon, height = self._state[:3]
        if self._aided is None or self.settings.aiding is None:
            self._core.start(lat, lon, height, self._state[3:6], self._state[6:10])
            return
        sigma = np.maximum(self.settings.aiding.sigma, sigma)
        self._aided.start(time, lat, lon, height, self._state[3:6], self._state[6:10], sigma, self.gyro_bias)
        if self._watch is not None:
            self._watch.start()
        if self._assumed is not None:
            self._assumed.start(lat, lon, height)

    def _run(self, imu: ImuIncrements, start: int, stop: int) -> None:
        while start < stop:
            end = stop if stop - start == 1 else _same_flags(imu.validity, start, stop)
            flagged = int(imu.validity[start]) & _FLAGS
            if flagged != self._flagged:
                self._flag(float(imu.time[start]), flagged)
            start += (self._align if self.mode == Mode.ALIGN else self._navigate)(imu, start, end)

    def _align(self, imu: ImuIncrements, start: int, stop: int) -> int:
        used, word = self._aligner.take(imu, start, stop)
        last = start + used - 1
        self._fill_constant(start, last)  # what a sample brings shows from it on
        if word is not None:
            self._hear(float(imu.time[last]), word)
        self._progress = self._aligner.progress if self.mode == Mode.ALIGN else 1.0
        self._fill_constant(last, last + 1)
        return used

    def _hear(self, time: float, word: Word) -> None:
        for health, text in word.complaints:
            self._complain(time, health, text)
        self.health &= ~word.cleared
        if word.notice:
            self.tell(time, "notice", word.notice)
        if word.start is not None:
            self._begin_at(time, word.start)

    def _begin_at(self, time: float, start: Start) -> None:
        """Navigate from the end of the alignment, which may lie some samples back."""
        self.gyro_bias = start.gyro_bias
        self._sums[:] = 0.0
        self._state = np.concatenate([start.place, start.vel_n, start.q_nb])
        self._start_core(start.time, start.sigma)
        self.mode = Mode.NAVIGATE
        if len(start.since):
            self._advance(start.since)
        heading, pitch, roll = (math.degrees(angle) for angle in euler_from_quaternion(self._state[6:10]))
        self.tell(
            time,
            "info",
            f"aligned in {start.took_s:.1f} s: heading {heading:.3f} pitch {pitch:.3f} roll {roll:.3f} deg, {start.remark}",
        )
        self._trust(time)

    def _navigate(self, imu: ImuIncrements, start: int, stop: int) -> int:
        event = 0
        if self._watch is not None:
            stop = start + self._watch.part(imu.time[start:stop])
            if not self.settings.position_trusted:
                self.health = self.health & ~Health.UNAIDED | (Health.GOOD if self._watch.fixed else Health.UNAIDED)
            for note in self._watch.notes():
                self.tell(note.time, "warning" if note.bad else "notice", note.text, station=True)
        if self._assumed is not None:
            stop = start + self._assumed.detector.take(imu.rows(start, stop))
        elif self.settings.track_bias_at_rest:
            used, event = rest.accumulate(
                self._sums, imu.step[start:stop], imu.dtheta[start:stop], imu.dvel[start:stop], REST_WINDOW_S
            )
            stop = start + used
        answers = self._advance(imu if stop - start == len(imu) else imu.rows(start, stop))
        self._fill(start, stop, 1.0, answers)
        if event == 2:
            self._track_bias()
        if self._assumed is not None and self._aided is not None and self._assumed.detector.decided:
            self.aid(self._assumed.rows(self._aided))
        return stop - start

    def _advance(self, imu: ImuIncrements) -> Answers:
        """Carry the solution over samples: place, velocity, attitude at each, valid until the next call."""
        n, before = len(imu), self._core.mechanization
        if self._aided is None:
            out = self._solutions.answers(n)
            done = self._core.carry(imu.step, imu.dtheta, imu.dvel, self.gyro_bias, out)
        else:
            out = self._aided.process(imu)
            self.gyro_bias = self._aided.estimates[GYRO_BIAS].copy()
            done = n if self._core.mechanization == before else 0
        self._state[:] = self._core.solution
        if done < n:
            text = f"the {before} mechanization is singular at the pole: {self._core.mechanization} goes on"
            self.tell(float(imu.time[done]), "notice", text)
        return out

    def _flag(self, time: float, flagged: int) -> None:
        if flagged & ~self._flagged & Validity.SENSOR:
            self.tell(time, "error", "the sensor flags its own samples: see its built-in test")
        self._flagged = flagged
        self.health &= ~(Health.SENSOR | Health.SPARE)
        self.health |= Health.SENSOR if flagged & Validity.SENSOR else Health.GOOD
        self.health |= Health.SPARE if flagged & Validity.SPARE else Health.GOOD
        self._trust(time)

    def _track_bias(self) -> None:
        mean = rest.means(self._sums)
        self._sums[:] = 0.0
        change = mean.w - earth_rate_in_body(self._state[6:10], float(self._state[0])) - self.gyro_bias
        if float(np.abs(change).max()) < REST_BIAS_STEP:
            self.gyro_bias = self.gyro_bias + REST_GAIN * change

    def _meet(self, gap: Gap) -> None:
        if self.mode == Mode.INIT or (self.mode == Mode.ALIGN and not (gap.realign and self._plan.in_motion)):
            return
        what = f"gap of {gap.length_s:.3f} s, {gap.missing} samples"
        if gap.length_s < 0.0:
            what = "the sensor started anew"
        if gap.realign:
            self.realign(gap.time, what)
        elif gap.length_s > self.settings.gaps.interpolate_s:
            self.health |= Health.BRIDGED
            self.tell(gap.time, "warning", f"{what}: bridged, attitude and velocity are no longer exact")
            self._trust(gap.time)

    def _trust(self, time: float) -> None:
        if self.mode in (Mode.NAVIGATE, Mode.DEGRADED):
            mode = Mode.DEGRADED if self.health & DISTRUST else Mode.NAVIGATE
            if mode != self.mode:
                self.mode = mode
                self.tell(time, "warning" if mode == Mode.DEGRADED else "info", f"mode {mode.name.lower()}")

    def _complain(self, time: float, health: Health, text: str) -> None:
        if not self.health & health:
            self.health |= health
            self.tell(time, "warning", text)

    def tell(self, time: float, severity: Severity, text: str, *, station: bool = False) -> None:
        self._events.append(Event(time, severity, text, station))

    def _fill_constant(self, start: int, stop: int) -> None:
        state = self._state
        self._fill(start, stop, self._progress, Answers(state[None, :3], state[None, 3:6], state[None, 6:10]))

    def _fill(self, start: int, stop: int, progress: float, answers: Answers) -> None:
        known = self._watch is not None and self.mode >= Mode.NAVIGATE
        worth = (self._watch.sigma, self._watch.ratio) if known and self._watch else self._worthless
        self._solutions.fill(start, stop, (int(self.mode), int(self.health), progress), answers, self.gyro_bias, worth)


@kernel
def _same_flags(validity: IntArray, start: int, stop: int) -> int:
    """The end of the samples from `start` on that the sensor flags alike."""
    for k in range(start + 1, stop):
        if (validity[k] ^ validity[start]) & _FLAGS:
            return k
    return stop


def _check(rows: NDArray[Any]) -> None:
    if not (np.isfinite(rows["time"]).all() and np.isfinite(rows["value"]).all() and (rows["sigma"] > 0.0).all()):
        raise HilError("aiding row: a value is no number, or a sigma is not positive: mend what sends it")


def _plan(settings: Settings) -> Plan:
    return Plan(
        settings.alignment,
        settings.lat,
        settings.lon,
        settings.height,
        settings.align_s,
        settings.heading,
        settings.sensors,
        settings.sway,
        settings.lever_arm,
        settings.antenna,
    )


def _solution(lat: float, lon: float, height: float, vel_n: FloatArray, q_nb: FloatArray) -> FloatArray:
    """lat, lon, height, vel_n (3), q_nb (4) in one array, as `Strapdown.solution`."""
    return np.array([lat, lon, height, *vel_n, *q_nb], float)
