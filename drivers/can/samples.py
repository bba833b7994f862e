"""Samples of a board that counts nothing, or little: which are missing, late or twice, and the increments that they make.

A board's driver puts what it has read into rows of `RAW` columns; `Samples` judges them and turns rates into increments, once and
here. The first `LEARN` + 1 samples of a life only set the clock: the median of their distances is the sample period. Of a board
without a clock it is their mean, on a grid; where that is off the grid, `LEARN_LONG` + 1 samples set the clock and the period is
the mean itself. It is measured again every `MEASURE` samples. From then on a sample is placed by the board's counter where it
sends one, else by its time in whole periods:

- the next one or a later one is taken, what is missing between counts as lost;
- one of the last 63 that was not seen yet comes late, one that was seen is a duplicate; both are dropped;
- by a counter, one that stands still while time goes on is dropped; where it goes on by one and time jumps, the clock was set,
  and time goes on by a period;
- anything else is a board that started anew, and the period is learnt again; so is one of which `SLOWER` distances in a row are
  alike and longer than a period, if its counter does not say that samples are missing.

A rate is that at the sample's time: the increment is the mean of both ends times the step; after a gap, the rate times one
period.
"""

import numpy as np

from drivers import Counters
from nav.increments import FloatArray, ImuIncrements, IntArray, Validity
from nav.kernel import inline_kernel, kernel

LEARN = 9
"""Distances between samples from which the period is learnt."""
LEARN_LONG = 99
"""The same where it is on no grid."""
ON_GRID = 0.02
"""A mean that is a multiple of the grid but for this part is that multiple."""
MEASURE, WRONG = 256, 0.005
"""Samples over which the period of a board without a clock is measured, and the part by which it is wrong then."""
WINDOW = 64
"""How far back a sample counts as late or duplicate rather than as a restart."""
SLOWER = 16
"""Distances in a row that tell another rate from lost samples."""
LONGEST_S = 60.0
"""After a longer gap the board counts as started anew."""
FOLLOW = 8
"""The grid of a board without a clock moves by one part in so many of what each arrival is off it."""
FLIP = np.array([1.0, -1.0, -1.0])
"""Forward, left, up to forward, right, down, and back."""

# Columns of a raw sample: ticks of the clock, counter (-1: none), whether the board flags it, rate or increment of the turn and
# of the velocity, and which of these it is.
TICKS, NUMBER, BAD, TURN, PUSH, TURN_IS, PUSH_IS, RAW = 0, 1, 2, 3, 6, 9, 10, 11
RATE, MEAN_RATE, INCREMENT = 0, 1, 2

_LEARNT, _LAST_TICKS, _LAST_NUMBER, _TIME, _SEQUENCE, _SEEN, _PERIOD, _UNIT, _TURN_HELD, _PUSH_HELD = range(10)
_FROM_TICKS, _FROM, _LATEST, _ALIKE, _STATE = range(10, 15)
_SAMPLES, _LOST, _DUPLICATED, _LATE, _RESTARTS, _FROZEN, _CLOCK_STEPS, _OUTCOMES = range(8)


@inline_kernel
def signed(value: int, bits: int) -> int:
    """The residue of `value` modulo 2^bits next to zero."""
    half = 1 << (bits - 1)
    return (value + half) % (2 * half) - half


@inline_kernel
def _integral(value: float, before: float, kind: int, held: bool, step: float) -> float:
    if kind == INCREMENT:
        return value
    if kind == RATE and held:
        return 0.5 * step * (before + value)
    return step * value


@inline_kernel
def _hold(row: FloatArray, before: FloatArray, state: IntArray) -> None:
    """Keep the rates of a sample for the step that begins at it."""
    for i in range(3):
        before[i], before[3 + i] = row[TURN + i], row[PUSH + i]
    state[_TURN_HELD], state[_PUSH_HELD] = row[TURN_IS] == RATE, row[PUSH_IS] == RATE


@inline_kernel
def _mean_without_gaps(distances: IntArray) -> float:
    """Mean of the distances that are not nearly two, so that a lost sample does not lengthen it."""
    longest = 1.75 * distances.mean()
    total = n = 0
    for distance in distances:
        if distance <= longest:
            total, n = total + distance, n + 1
    return total / n


@inline_kernel
def _learn(ticks: int, number: int, elapsed: int, grid: int, usual: int, learnt: IntArray, state: IntArray) -> None:
    """Take one sample of those that only set the clock."""
    at = state[_LEARNT]
    if at < 0 or elapsed < 0:
        state[_LEARNT], state[_TIME] = 0, ticks
    else:
        learnt[0, at] = elapsed
        learnt[1, at] = signed(number - state[_LAST_NUMBER], 16) if number >= 0 and state[_LAST_NUMBER] >= 0 else 0
        state[_LEARNT] += 1
        state[_TIME] += elapsed
    state[_LAST_TICKS], state[_LAST_NUMBER] = ticks, number
    n = state[_LEARNT]
    if n not in (LEARN, LEARN_LONG):
        return
    period = np.sort(learnt[0, :n])[n // 2]
    if grid > 0:
        mean = _mean_without_gaps(learnt[0, :n])
        period = int(np.rint(mean / grid)) * grid
        if mean == 0.0:
            period = usual
        elif abs(mean - period) > ON_GRID * period:
            if n == LEARN:
                return
            period = int(np.rint(mean))
        state[_TIME] = (n + 1) * period
        state[_FROM_TICKS], state[_FROM] = ticks, state[_SEQUENCE]
    state[_PERIOD] = period
    state[_UNIT] = np.sort(learnt[1, :n])[n // 2] if learnt[1, :n].min() > 0 else 0
    state[_SEEN] = -1  # one from before was never counted as lost
    state[_LEARNT] = LEARN_LONG


@inline_kernel
def _measure(state: IntArray) -> None:
    """Correct the period by the distance that the grid has moved while it followed the arrivals."""
    n = state[_SEQUENCE] - state[_FROM]
    if n < MEASURE:
        return
    mean = signed(state[_LAST_TICKS] - state[_FROM_TICKS], 32) / n
    if abs(mean - state[_PERIOD]) > WRONG * state[_PERIOD]:
        state[_PERIOD] = int(np.rint(mean))
    state[_FROM_TICKS], state[_FROM] = state[_LAST_TICKS], state[_SEQUENCE]


@inline_kernel
def _is_slower(elapsed: int, expected: int, period: int, state: IntArray) -> bool:
    """Whether the board sends at a lower rate than it did."""
    is_long = 4 * (elapsed - expected) > period
    is_alike = is_long and 8 * abs(elapsed - state[_LATEST]) <= period
    state[_LATEST] = elapsed
    state[_ALIKE] = state[_ALIKE] + 1 if is_alike else int(is_long)
    return bool(state[_ALIKE] == SLOWER)


@kernel
def _take(
    raw: FloatArray,
    tick_s: float,
    grid: int,
    usual: int,
    learnt: IntArray,
    before: FloatArray,
    state: IntArray,
    outcome: IntArray,
    time: FloatArray,
    step: FloatArray,
    dtheta: FloatArray,
    dvel: FloatArray,
    validity: IntArray,
    sequence: IntArray,
    rows: IntArray,
) -> int:
    """Judge raw samples; the increments of the accepted ones go to the front of the outputs."""
    n = 0
    for k in range(raw.shape[0]):
        ticks, number = int(raw[k, TICKS]), int(raw[k, NUMBER])
        elapsed = signed(ticks - state[_LAST_TICKS], 32)
        if state[_LEARNT] < LEARN_LONG:
            if state[_LEARNT] >= 0 and elapsed == 0 and grid == 0:
                outcome[_DUPLICATED] += 1
            else:
                outcome[_RESTARTS] += state[_LEARNT] >= 0 and elapsed < 0
                _learn(ticks, number, elapsed, grid, usual, learnt, state)
                _hold(raw[k], before, state)
            continue
        period, delta, fits, off = state[_PERIOD], 0, True, 0
        if state[_UNIT] > 0 and number >= 0:
            delta = int(np.rint(signed(number - state[_LAST_NUMBER], 16) / state[_UNIT]))
            fits = abs(elapsed - delta * period) <= 0.5 * period * max(abs(delta), 1)
            slower = _is_slower(elapsed, max(delta, 1) * period, period, state)
            if delta == 0 and not fits and abs(elapsed) * tick_s <= LONGEST_S:
                outcome[_FROZEN] += 1
                continue
            if delta == 1 and not (fits or slower):
                outcome[_CLOCK_STEPS] += 1
                elapsed, fits = period, True
        else:
            if grid > 0 and elapsed < -period:  # no arrival is that early: the host's clock was set back
                state[_FROM_TICKS] += elapsed - period
                elapsed = period
            delta = int(np.rint(elapsed / period))
            slower = _is_slower(elapsed, period, period, state)
        fits = fits and not slower and elapsed * tick_s <= LONGEST_S
        if grid > 0 and fits:
            if delta < 1:  # too early: after a gap, what was counted as lost had only been held up
                delta = -1
                while delta > -WINDOW and (state[_SEEN] >> -delta) & 1:
                    delta -= 1
                delta = 1 if delta == -WINDOW else delta
            off = elapsed - delta * period
            elapsed = delta * period
        if delta > 0 and fits:
            outcome[_LOST] += delta - 1
            state[_SEQUENCE] += delta
            state[_TIME] += elapsed
            state[_SEEN] = (state[_SEEN] << delta) | 1 if delta < WINDOW else 1
            state[_LAST_NUMBER] = number if number >= 0 else (state[_LAST_NUMBER] + delta * state[_UNIT]) % 65536
        elif -WINDOW < delta <= 0 and elapsed <= 0 and fits:
            if (state[_SEEN] >> -delta) & 1:
                outcome[_DUPLICATED] += 1
            else:
                state[_SEEN] |= 1 << -delta
                outcome[_LATE] += 1
                outcome[_LOST] -= 1
            continue
        else:
            outcome[_RESTARTS] += 1
            state[_SEQUENCE] += 2  # any jump: the navigator sees that time does not go on
            state[_LEARNT] = -1
            _learn(ticks, number, elapsed, grid, usual, learnt, state)
            _hold(raw[k], before, state)
            continue
        state[_LAST_TICKS] = ticks - off + off // FOLLOW
        if grid > 0:
            _measure(state)
        seconds = tick_s * (elapsed if delta == 1 else period)
        both = delta == 1  # ends of the step are there
        turn_is, push_is = int(raw[k, TURN_IS]), int(raw[k, PUSH_IS])
        for i in range(3):
            dtheta[n, i] = _integral(raw[k, TURN + i], before[i], turn_is, both and state[_TURN_HELD] == 1, seconds)
            dvel[n, i] = _integral(raw[k, PUSH + i], before[3 + i], push_is, both and state[_PUSH_HELD] == 1, seconds)
        _hold(raw[k], before, state)
        time[n], step[n], sequence[n] = tick_s * state[_TIME], seconds, state[_SEQUENCE]
        validity[n] = Validity.SENSOR.value if raw[k, BAD] != 0.0 else 0
        rows[n] = k
        n += 1
    outcome[_SAMPLES] += n
    return n


class Samples:
    """See the module.

    Parameters
    ----------
    counters : Counters
        Where to count.
    tick_s : float
        One tick of the clock, s; the clock has 32 bits.
    grid_s : float
        Of a board without a clock, whose ticks are those of the arrival: its period is a whole multiple of this where arrivals
        agree. Time then goes in whole periods. 0: the board has a clock.
    usual_s : float
        The period of a board without a clock whose arrivals tell none.
    """

    def __init__(self, counters: Counters, tick_s: float, grid_s: float = 0.0, usual_s: float = 0.0) -> None:
        self._counters, self._tick_s = counters, tick_s
        self._grid, self._usual = round(grid_s / tick_s), round(usual_s / tick_s)
        self._learnt, self._before = np.zeros((2, LEARN_LONG), np.int64), np.zeros(6)
        self._state, self._outcome = np.zeros(_STATE, np.int64), np.zeros(_OUTCOMES, np.int64)
        self._state[_LEARNT] = -1
        self._room(256)

    def _room(self, n: int) -> None:
        self._batch, self._rows = ImuIncrements.empty(n), np.zeros(n, np.int64)

    @property
    def period_s(self) -> float | None:
        """Sample period, s, once learnt."""
        period = int(self._state[_PERIOD])
        return period * self._tick_s if period else None

    def take(self, raw: FloatArray) -> tuple[ImuIncrements, IntArray]:
        """Increments of the accepted ones of the raw samples (n, `RAW`), and which these are; views until the next call."""
        if len(raw) > len(self._rows):
            self._room(2 * len(raw))
        batch, counters, outcome = self._batch, self._counters, self._outcome
        n = _take(
            raw,
            self._tick_s,
            self._grid,
            self._usual,
            self._learnt,
            self._before,
            self._state,
            outcome,
            batch.time,
            batch.step,
            batch.dtheta,
            batch.dvel,
            batch.validity,
            batch.sequence,
            self._rows,
        )
        counters.samples, counters.lost, counters.late = (int(outcome[i]) for i in (_SAMPLES, _LOST, _LATE))
        counters.restarts, counters.frozen = int(outcome[_RESTARTS]), int(outcome[_FROZEN])
        counters.clock_steps = int(outcome[_CLOCK_STEPS])
        counters.duplicated += int(outcome[_DUPLICATED])
        outcome[_DUPLICATED] = 0
        return batch.rows(0, n), self._rows[:n]
