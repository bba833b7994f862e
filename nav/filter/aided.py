"""An aided navigator: a strapdown core and an error-state filter, fed with increments and with measurements of any age.

The core takes every sample; the filter follows in intervals of `Settings.predict_s`. A measurement belongs to the first
sample that ends at its time or later: there the interval ends early, and the model takes the solution back by what is
missing of a sample. What it says of the errors is taken off the core and added to the parameters at once.

At the end of each interval everything is remembered, for `Settings.buffer_s`, with the samples since. A measurement that
comes late makes the navigator go back to the last memory before its time and take samples and measurements again, in the
order of their times. So the state never depends on when a measurement came, nor on how samples were batched: to the last
bit. (What was answered before it came stays answered.) A measurement older than the buffer is refused; one that is early
waits.
"""

import math
from bisect import bisect_right, insort
from collections import deque
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from nav.aiding import Kind
from nav.errors import HilError
from nav.filter import health as gates
from nav.filter import measurements as models
from nav.filter.error_state import MEASURED, ErrorState
from nav.filter.health import Channel, ChannelHealth, Trust
from nav.filter.states import BAROMETER_BIAS, GNSS_DELAY, LEVER_ARM, STATES, Tuning, correct_one
from nav.increments import FloatArray, ImuIncrements
from nav.kernel import inline_kernel, kernel
from nav.step import POLE
from nav.strapdown import Strapdown

_VALUES = {
    Kind.GNSS: 6,
    Kind.BARO: 1,
    Kind.MAGNETIC: 3,
    Kind.HEADING: 1,
    Kind.ATTITUDE: 4,
    Kind.BODY_VELOCITY: 3,
    Kind.ZERO_RATE: 0,
    Kind.GRAVITY: 0,
}
_GNSS = (
    (Channel.GNSS_POSITION, models.gnss_position, slice(0, 3)),
    (Channel.GNSS_VELOCITY, models.gnss_velocity, slice(3, 6)),
)
_NOTHING = np.zeros(3)
_ROOM = 4096
"""Samples that there is room for at the start."""


@dataclass(frozen=True, slots=True)
class Settings:
    """How the filter is run.

    Attributes
    ----------
    predict_s : float
        Length of an interval, s.
    buffer_s : float
        How late a measurement may come, s.
    gate : float
        Probability that a right measurement is accepted.
    restart_s : float
        A position source that is rejected for so long, s, is right and the filter has diverged: it restarts there. `inf`: never.
    lever_arm : (3,) float
        From the navigated point (the sensor, if it is not moved) to the GNSS antenna, b, m, as first known.
    delay : float
        How much older GNSS is than it says, s, as far as known: it is taken at that time. The estimated delay is what is left.
    field_n : (3,) float, optional
        Magnetic flux in n, T; without it no magnetic row is taken.
    magnetic_heading : bool
        Take of a magnetic row nothing but where its level part points: on a scale of its own, or where the field is disturbed.
    """

    predict_s: float = 0.02
    buffer_s: float = 2.0
    gate: float = 0.999
    restart_s: float = 30.0
    lever_arm: tuple[float, float, float] = (0.0, 0.0, 0.0)
    delay: float = 0.0
    field_n: tuple[float, float, float] | None = None
    magnetic_heading: bool = False

    def __post_init__(self) -> None:
        """Refuse what cannot be."""
        if not (0.0 < self.predict_s <= 1.0 and self.predict_s <= self.buffer_s < math.inf):
            raise HilError("filter: predict_s must be in (0, 1] and buffer_s finite and not shorter")
        if not (0.5 <= self.gate < 1.0 and self.restart_s > 0.0):
            raise HilError("filter: gate must be in [0.5, 1) and restart_s positive")


class Judged(NamedTuple):
    """One judged measurement."""

    time: float
    channel: Channel
    source: int
    freedom: int
    nis: float
    accepted: bool


class Restart(NamedTuple):
    """The filter had diverged and was started again, at `time`, s."""

    time: float
    source: int


class Answers(NamedTuple):
    """The solution at the end of each sample: lat, lon (rad), height (m); vel_n, m/s; q_nb."""

    position: FloatArray
    velocity: FloatArray
    attitude: FloatArray


class _Row(NamedTuple):
    key: tuple[float, ...]
    kind: Kind
    source: int
    value: FloatArray
    sigma: FloatArray


class _Memory(NamedTuple):
    number: int
    time: float
    core: tuple[Any, ...]
    own: tuple[FloatArray, ...]
    table: dict[tuple[Channel, int], FloatArray]


class AidedNavigator:
    """See the module.

    Parameters
    ----------
    core : Strapdown
        Its mechanization; it belongs to this object from now on.
    tuning : Tuning
        What the sensors are worth and what is estimated (:func:`nav.filter.states.tuning`).
    settings : Settings

    Attributes
    ----------
    estimates : (STATES,) float
        The parameters as estimated (biases, scale factors...); the first nine are 0.
    time : float
        End of the newest sample, s.
    too_late : int
        Measurements refused because they were older than the buffer.
    """

    def __init__(self, core: Strapdown, tuning: Tuning, settings: Settings | None = None) -> None:
        self.settings = settings or Settings()
        self._core, self._filter = core, ErrorState(tuning)
        self._gate = [gates.quantile(self.settings.gate, m + 1) for m in range(MEASURED)]
        self._field = np.zeros(3) if self.settings.field_n is None else np.array(self.settings.field_n, float)
        self._declination = math.atan2(self._field[1], self._field[0])
        self.estimates = np.zeros(STATES)
        self._sums, self._before, self._instant = np.zeros(7), np.zeros(10), np.zeros(models.INSTANT)
        self._last, self._one = np.zeros(6), np.zeros(6)
        self._h, self._residual = np.zeros((MEASURED, STATES)), np.zeros(MEASURED)
        self._variance, self._believed = np.zeros(MEASURED), np.zeros(MEASURED)
        self._samples, self._sigma = ImuIncrements.empty(_ROOM), np.zeros(9)
        self._table: dict[tuple[Channel, int], FloatArray] = {}
        self._rows: list[_Row] = []
        self._memories: deque[_Memory] = deque()
        self._judged: list[Judged] = []
        self._restarts: list[Restart] = []
        self._room(256)
        self.time, self.too_late = -math.inf, 0

    def start(
        self,
        time: float,
        lat: float,
        lon: float,
        height: float,
        vel_n: FloatArray,
        q_nb: FloatArray,
        sigma: FloatArray,
    ) -> None:
        """Begin at `time`, s, from a solution (rad, m, m/s) with independent errors, `sigma` (9,): m, m/s, rad.

        The parameters begin at what the settings say. What came before is forgotten.

        Raises
        ------
        HilError
            `sigma` is not finite or negative.
        """
        given = np.asarray(sigma, float)
        if given.shape != (9,) or not (np.isfinite(given) & (given >= 0.0)).all():
            raise HilError("filter: sigma of the start must be nine numbers, finite and not negative")
        self._sigma[:] = given
        self._core.start(lat, lon, height, vel_n, q_nb)
        self._filter.start(given)
        self._begin_parameters()
        self._sums[:], self._instant[:] = 0.0, 0.0
        self._before[:] = self._instant[:10] = self._core.solution
        self.time, self._number, self._count, self._first, self._next = time, 0, 0, 0, 0
        for held in (self._table, self._rows, self._memories, self._judged, self._restarts):
            held.clear()
        self._remember()

    def process(self, imu: ImuIncrements) -> Answers:
        """Take samples; the solution at each, valid until the next call.

        Raises
        ------
        HilError
            Not started, an increment is not finite, or time goes back.
        """
        n, bad = len(imu), imu.first_bad()
        if bad >= 0:
            raise HilError(f"increment {int(imu.sequence[bad])} is not a number: mend the driver or the file")
        self._check_started()
        if n and (imu.time[0] < self.time or (np.diff(imu.time) < 0.0).any()):
            raise HilError(f"filter: time goes back, after {self.time:g} s: start anew")
        self._append(imu)
        out = self._answers(n)
        self._run(out)
        return out

    def push(
        self, time: float, step: float, x: float, y: float, z: float, vx: float, vy: float, vz: float
    ) -> FloatArray:
        """Take one sample, to the same bits as `process` and many times faster.

        Parameters
        ----------
        time, step : float
            End and length of the step, s.
        x, y, z, vx, vy, vz : float
            Increments as measured, rad, m/s, b.

        Returns
        -------
        (10,) float
            lat, lon, height, vel_n, q_nb: the core's own array, to be read only.

        Raises
        ------
        HilError
            As `process`.
        """
        if not math.isfinite(time + step + x + y + z + vx + vy + vz):
            raise HilError(f"increment at {time:g} s is not a number: mend the driver or the file")
        if not time >= self.time or not self._memories:
            self._check_started()
            raise HilError(f"filter: time goes back, after {self.time:g} s: start anew")
        row = self._count - self._first
        if row == len(self._samples):
            row = self._make_way(1)
        s = self._samples
        kept = s.time, s.step, s.dtheta, s.dvel
        how = self.settings.predict_s, self._until(), self.estimates, self._sums, self._last, self._one
        ended, *corrected = _add_one(kept, row, time, step, x, y, z, vx, vy, vz, *how)
        if self._core.push(step, *corrected) == POLE:
            self._core.hand_over("wander")
            self._core.push(step, *corrected)
        self._count += 1
        self._number += 1
        self.time = time
        if ended:
            self._end()
        return self._core.solution

    def aid(self, rows: NDArray[Any]) -> None:
        """Take measurements, `nav.aiding.AIDING`, in any order.

        Raises
        ------
        HilError
            A value or a sigma that is used is no number, the kind is unknown, or there is no magnetic field to compare with.
        """
        self._check_started()
        late = math.inf
        for row in [_row(entry, self.settings) for entry in np.atleast_1d(rows)]:
            time = row.key[0]
            if time <= self._memories[0].time:
                self.too_late += 1
                continue
            insort(self._rows, row, key=_key)
            late = min(late, time)
        if late <= self.time:
            self._recall(late)
            self._run(self._answers(self._count - self._number))

    @property
    def solution(self) -> FloatArray:
        """(10,): lat, lon, height, vel_n (3), q_nb (4) at `time`."""
        return self._core.solution.copy()

    @property
    def covariance(self) -> FloatArray:
        """P of the states in `used`, as of the last end of an interval: `predict_s` ago at most."""
        return self._filter.covariance

    @property
    def sigma(self) -> FloatArray:
        """(STATES,): one sigma of each state (:mod:`nav.filter.states`); 0 of one that is not used."""
        return self._filter.sigma

    @property
    def used(self) -> NDArray[np.int64]:
        """Places of the states that are used, the rows of `covariance`."""
        return self._filter.used

    @property
    def health(self) -> list[ChannelHealth]:
        """Of every source heard so far."""
        return [
            ChannelHealth(
                *key,
                accepted=int(row[gates.ACCEPTED]),
                rejected=int(row[gates.REJECTED]),
                nis=float(row[gates.NIS]),
                nis_mean=float(row[gates.NIS_MEAN]),
                inflation=gates.inflation(row),
                trust=Trust(int(row[gates.TRUST])),
            )
            for key, row in sorted(self._table.items())
        ]

    def judged(self) -> list[Judged]:
        """Measurements judged since the last call; those that are taken again by a late one come again."""
        judged, self._judged = self._judged, []
        return judged

    def restarts(self) -> list[Restart]:
        """Restarts since the last call."""
        restarts, self._restarts = self._restarts, []
        return restarts

    def _check_started(self) -> None:
        if not self._memories:
            raise HilError("filter: no start yet: call start")

    def _append(self, imu: ImuIncrements) -> None:
        row, n = self._count - self._first, len(imu)
        if row + n > len(self._samples):
            row = self._make_way(n)
        _copy(imu, self._samples.rows(row, row + n))
        self._count += n

    def _make_way(self, n: int) -> int:
        """Room for `n` more samples by forgetting those before the oldest memory; the row of the first."""
        oldest, old = self._memories[0].number - self._first, self._samples
        kept = self._count - self._memories[0].number
        if 2 * (kept + n) > len(old):
            self._samples = ImuIncrements.empty(2 * (kept + n))
        _copy(old.rows(oldest, oldest + kept), self._samples.rows(0, kept))
        self._first += oldest
        return kept

    def _until(self) -> float:
        """Time of the next measurement that waits."""
        return self._rows[self._next].key[0] if self._next < len(self._rows) else math.inf

    def _run(self, out: Answers) -> None:
        """Take all samples that are not taken yet; `out` begins at the first of them."""
        base = self._number
        while self._number < self._count:
            first, stop = self._number - self._first, self._count - self._first
            data = self._samples.time, self._samples.step, self._samples.dtheta, self._samples.dvel
            room = self._sums, self._last, self._turned, self._pushed
            n, ended = _gather(*data, first, stop, self.settings.predict_s, self._until(), self.estimates, *room)
            here, begin = slice(first, first + n), self._number - base
            there = tuple(array[begin : begin + n] for array in out)
            self._core.advance(self._samples.step[here], self._turned[:n], self._pushed[:n], _NOTHING, *there)
            self._number += n
            self.time = float(self._samples.time[first + n - 1])
            if ended:
                self._end()
                solution = self._core.solution
                there[0][-1], there[1][-1], there[2][-1] = solution[0:3], solution[3:6], solution[6:10]

    def _end(self) -> None:
        """End an interval: predict, take what is due, remember."""
        self._filter.predict(self._before, self._core.solution, self._sums)
        self._instant[:10], self._instant[models.LAST_PART] = self._core.solution, self._last
        if self._sums[0] > 0.0:
            self._instant[models.MEAN_PART] = self._sums[1:] / self._sums[0]
        while self._next < len(self._rows) and self._rows[self._next].key[0] <= self.time:
            self._take(self._rows[self._next])
            self._next += 1
        self._before[:] = self._core.solution
        self._sums[:] = 0.0
        self._remember()

    def _take(self, row: _Row) -> None:
        at, age, to = self._instant, self.time - row.key[0], (self._h, self._residual, self._variance)
        value, sigma = row.value, row.sigma
        if row.kind == Kind.GNSS:
            self._take_gnss(row)
        elif row.kind == Kind.BARO:
            offset = float(self.estimates[BAROMETER_BIAS][0])
            self._judge(Channel.BARO, row.source, models.barometer(at, offset, value, sigma, age, *to))
        elif row.kind == Kind.MAGNETIC:
            if self.settings.magnetic_heading:
                m = models.magnetic_heading(at, self._declination, value, sigma, age, *to)
            else:
                m = models.magnetic(at, self._field, value, sigma, age, *to)
            self._judge(Channel.MAGNETIC, row.source, m)
        elif row.kind == Kind.HEADING:
            self._judge(Channel.HEADING, row.source, models.heading(at, value, sigma, age, *to))
        elif row.kind == Kind.ATTITUDE:
            self._judge(Channel.ATTITUDE, row.source, models.attitude(at, value, sigma, age, *to))
        elif row.kind == Kind.BODY_VELOCITY:
            self._judge(Channel.BODY_VELOCITY, row.source, models.body_velocity(at, value, sigma, age, *to))
        elif row.kind == Kind.ZERO_RATE:
            self._judge(Channel.ZERO_RATE, row.source, models.earth_rate(at, sigma, *to))
        else:
            self._judge(Channel.GRAVITY, row.source, models.gravity(at, sigma, *to))

    def _take_gnss(self, row: _Row) -> None:
        """Position and velocity, each by its own gate; and the restart."""
        for channel, model, part in _GNSS:
            m = self._gnss(model, row, part)
            rejected_since = self._judge(channel, row.source, m)
            if channel == Channel.GNSS_POSITION and m == 3 and self.time - rejected_since >= self.settings.restart_s:
                self._restart(row)
                return

    def _gnss(self, model: Any, row: _Row, part: slice) -> int:
        arm, delay = self.estimates[LEVER_ARM], float(self.estimates[GNSS_DELAY][0])
        at, age, to = self._instant, self.time - row.key[0], (self._h, self._residual, self._variance)
        return int(model(at, arm, delay, row.value[part], row.sigma[part], age, *to))

    def _judge(self, channel: Channel, source: int, m: int) -> float:
        """Take or reject a measurement of `m` rows; since when its source has been rejected, s, NaN if it is not."""
        if m == 0:
            return math.nan
        row = self._table.get((channel, source))
        if row is None:
            row = self._table[channel, source] = np.zeros(gates.TABLE)
            gates.clear(row)
        self._believed[:] = gates.inflation(row) * self._variance
        nis, spread = self._filter.examine(self._h, self._residual, self._believed, m)
        gate = self._gate[m - 1]
        accepted = gates.judge(row, m, self._residual, self._variance, spread, nis, gate, self.time)
        self._judged.append(Judged(self.time, channel, source, m, nis, accepted))
        if accepted:
            x = self._filter.absorb(self._h, self._residual, self._believed, m)
            self._core.correct(x[0:3], x[3:6], x[6:9])
            self.estimates[9:] += x[9:]
            self._instant[:10] = self._core.solution
        return float(row[gates.SINCE])

    def _restart(self, row: _Row) -> None:
        """Begin again where GNSS says, with the attitude as it is, three times less sure of it than before."""
        zero = np.zeros(3)
        self._sigma[6:9] = np.minimum(3.0 * self._sigma[6:9], 1.0)
        for _, model, part in _GNSS:
            if self._gnss(model, row, part) == 3:
                errors = [zero, zero, zero]
                errors[part.start // 3] = self._residual
                self._core.correct(*errors)
                self._instant[:10] = self._core.solution
                self._sigma[part] = np.sqrt(self._variance)
        self._filter.start(self._sigma)
        self._begin_parameters()
        self._table.clear()
        self._restarts.append(Restart(self.time, row.source))

    def _begin_parameters(self) -> None:
        self.estimates[:] = 0.0
        self.estimates[LEVER_ARM] = self.settings.lever_arm

    def _own(self) -> tuple[FloatArray, ...]:
        f = self._filter
        return f.u, f.d, f.turn, self.estimates, self._before, self._instant, self._last, self._sigma

    def _remember(self) -> None:
        table = {key: row.copy() for key, row in self._table.items()}
        own = tuple(array.copy() for array in self._own())
        self._memories.append(_Memory(self._number, self.time, self._core.memory(), own, table))
        old = len(self._memories)
        while len(self._memories) > 1 and self._memories[1].time <= self.time - self.settings.buffer_s:
            self._memories.popleft()
        if len(self._memories) < old:
            done = bisect_right(self._rows, self._memories[0].time, key=_time)
            del self._rows[:done]
            self._next -= done

    def _recall(self, time: float) -> None:
        """Go back to the last memory before `time`."""
        while self._memories[-1].time >= time:
            self._memories.pop()
        memory = self._memories[-1]
        self._number, self.time = memory.number, memory.time
        self._core.recall(memory.core)
        for array, then in zip(self._own(), memory.own, strict=True):
            array[:] = then
        self._table = {key: row.copy() for key, row in memory.table.items()}
        self._sums[:] = 0.0
        self._next = bisect_right(self._rows, self.time, key=_time)
        self._judged = [one for one in self._judged if one.time <= self.time]
        self._restarts = [one for one in self._restarts if one.time <= self.time]

    def _room(self, n: int) -> None:
        self._out = Answers(np.empty((n, 3)), np.empty((n, 3)), np.empty((n, 4)))
        self._turned, self._pushed = np.empty((n, 3)), np.empty((n, 3))

    def _answers(self, n: int) -> Answers:
        if n > len(self._turned):
            self._room(2 * n)
        return Answers(*(array[:n] for array in self._out))


def _key(row: _Row) -> tuple[float, ...]:
    return row.key


def _time(row: _Row) -> float:
    return row.key[0]


def _row(row: Any, settings: Settings) -> _Row:
    """A checked row, and its place in the order: by time, and the same for rows of one time, however they came."""
    time, number, source = float(row["time"]), int(row["kind"]), int(row["source"])
    if number not in _VALUES:
        raise HilError(f"aiding row at {time:g} s: unknown kind {number}; there is: {', '.join(k.name for k in Kind)}")
    kind = Kind(number)
    if kind == Kind.MAGNETIC and settings.field_n is None:
        raise HilError("aiding row MAGNETIC: no magnetic field to compare with: give Settings.field_n")
    value, sigma = np.array(row["value"], float), np.array(row["sigma"], float)
    used = value[: _VALUES[kind]]
    if not (math.isfinite(time) and np.isfinite(used).all() and (sigma > 0.0).all()):
        raise HilError(f"aiding row {kind.name} at {time:g} s: a value is no number, or a sigma is not positive")
    if kind == Kind.GNSS:
        time -= settings.delay
    return _Row((time, number, source, *map(float, value), *map(float, sigma)), kind, source, value, sigma)


def _copy(source: ImuIncrements, target: ImuIncrements) -> None:
    target.time[:], target.step[:] = source.time, source.step
    target.dtheta[:], target.dvel[:] = source.dtheta, source.dvel


@kernel
def _gather(
    time: FloatArray,
    step: FloatArray,
    dtheta: FloatArray,
    dvel: FloatArray,
    first: int,
    stop: int,
    period: float,
    until: float,
    estimates: FloatArray,
    sums: FloatArray,
    last: FloatArray,
    turned: FloatArray,
    pushed: FloatArray,
) -> tuple[int, bool]:
    """Correct samples from `first` up to the end of the interval; how many, and whether it has ended.

    `sums` (7,) goes on: length, increments. `last` (6,) out: rate and force of the last sample.
    """
    n, ended = 0, False
    while first + n < stop and not ended:
        k = first + n
        ended = _add(estimates, time[k], step[k], dtheta[k], dvel[k], period, until, sums, last, turned[n], pushed[n])
        n += 1
    return n, ended


@inline_kernel
def _add(
    estimates: FloatArray,
    time: float,
    step: float,
    dtheta: FloatArray,
    dvel: FloatArray,
    period: float,
    until: float,
    sums: FloatArray,
    last: FloatArray,
    turned: FloatArray,
    pushed: FloatArray,
) -> bool:
    """Correct a sample and add it to the interval; whether that ends with it."""
    correct_one(estimates, step, dtheta, dvel, turned, pushed)
    sums[0] += step
    for i in range(3):
        sums[1 + i] += turned[i]
        sums[4 + i] += pushed[i]
        if step > 0.0:
            last[i], last[3 + i] = turned[i] / step, pushed[i] / step
    return sums[0] + 0.5 * step >= period or time >= until


@kernel
def _add_one(
    samples: tuple[FloatArray, FloatArray, FloatArray, FloatArray],
    row: int,
    time: float,
    step: float,
    x: float,
    y: float,
    z: float,
    vx: float,
    vy: float,
    vz: float,
    period: float,
    until: float,
    estimates: FloatArray,
    sums: FloatArray,
    last: FloatArray,
    one: FloatArray,
) -> tuple[bool, float, float, float, float, float, float]:
    """Keep a sample in `row` and add it; `one` (6,) is room to work in. Whether the interval ends; corrected increments."""
    samples[0][row], samples[1][row] = time, step
    dtheta, dvel = samples[2][row], samples[3][row]
    dtheta[0], dtheta[1], dtheta[2] = x, y, z
    dvel[0], dvel[1], dvel[2] = vx, vy, vz
    ended = _add(estimates, time, step, dtheta, dvel, period, until, sums, last, one[:3], one[3:])
    return ended, one[0], one[1], one[2], one[3], one[4], one[5]
