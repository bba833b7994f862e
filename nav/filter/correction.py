"""Measurements into the filter, and what they say off the core and into the parameters at once.

Each is judged by the gate of its source (:mod:`nav.filter.health`). A position that is rejected for long enough is right:
the filter has diverged and begins again there.
"""

import math
from typing import Any, NamedTuple

import numpy as np

from nav.aiding import Kind
from nav.chi_square import quantile
from nav.filter import health as gates
from nav.filter import measurements as models
from nav.filter.error_state import MEASURED, ErrorState
from nav.filter.health import Channel, ChannelHealth, Trust
from nav.filter.record import Recorder
from nav.filter.rows import Row
from nav.filter.settings import Settings
from nav.filter.states import BAROMETER_BIAS, GNSS_DELAY, GYRO_BIAS, LEVER_ARM, STATES, Tuning
from nav.increments import FloatArray
from nav.strapdown import Strapdown

Table = dict[tuple[Channel, int], FloatArray]
"""What is known of each source, `nav.filter.health.TABLE`."""

_GNSS = (
    (Channel.GNSS_POSITION, models.gnss_position, slice(0, 3)),
    (Channel.GNSS_VELOCITY, models.gnss_velocity, slice(3, 6)),
)


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


class Correction:
    """See the module.

    Parameters
    ----------
    core : Strapdown
        What is corrected.
    tuning : Tuning
        Of the filter.
    settings : Settings
        How it is run.
    recorder : Recorder, optional
        Notes what a smoother needs.

    Attributes
    ----------
    filter : ErrorState
    estimates : (STATES,) float
        The parameters as estimated; the first nine are 0.
    time : float
        End of the last interval, s.
    table : Table
        The sources heard so far.
    judged, restarts : list of Judged, list of Restart
        What happened since somebody emptied them.
    """

    def __init__(self, core: Strapdown, tuning: Tuning, settings: Settings, recorder: Recorder | None) -> None:
        self.settings, self.filter, self.time = settings, ErrorState(tuning), -math.inf
        self._core, self._recorder = core, recorder
        self._gate = [quantile(settings.gate, m + 1) for m in range(MEASURED)]
        self._field = np.zeros(3) if settings.field_n is None else np.array(settings.field_n, float)
        self._apart = {source: np.subtract(arm, settings.lever_arm) for source, arm in settings.antennas}
        self._declination = math.atan2(self._field[1], self._field[0])
        self.estimates, self._known, self._sigma = np.zeros(STATES), np.zeros(STATES), np.zeros(9)
        self._instant = np.zeros(models.INSTANT)
        self._h, self._residual = np.zeros((MEASURED, STATES)), np.zeros(MEASURED)
        self._variance, self._believed = np.zeros(MEASURED), np.zeros(MEASURED)
        self.table: Table = {}
        self.judged: list[Judged] = []
        self.restarts: list[Restart] = []

    def start(self, time: float, sigma: FloatArray, gyro_bias: FloatArray) -> None:
        """Begin with the core as it is, `sigma` (9,) of its errors, and a gyro bias (3,), rad/s."""
        self.time, self._sigma[:], self._instant[:] = time, sigma, 0.0
        self._instant[:10] = self._core.solution
        self._known[LEVER_ARM], self._known[GYRO_BIAS] = self.settings.lever_arm, gyro_bias
        self.filter.start(sigma)
        self.estimates[:] = self._known
        for held in (self.table, self.judged, self.restarts):
            held.clear()
        if self._recorder is not None:
            self._recorder.start(time, self.filter, self._core.solution)
            self._recorder.end(self._core.solution, self.estimates)

    def predict(self, time: float, before: FloatArray, sums: FloatArray, last: FloatArray) -> None:
        """Carry the filter to the end of an interval, `time`; arguments as of `ErrorState.predict` and `interval.gather`."""
        self.time, solution = time, self._core.solution
        self.filter.predict(before, solution, sums)
        self._instant[:10], self._instant[models.LAST_PART] = solution, last
        if sums[0] > 0.0:
            self._instant[models.MEAN_PART] = sums[1:] / sums[0]
        if self._recorder is not None:
            self._recorder.predict(time, solution, sums)

    def end(self) -> None:
        """All measurements of the interval's end have been taken."""
        if self._recorder is not None:
            self._recorder.end(self._core.solution, self.estimates)

    def take(self, row: Row) -> None:
        """Take or reject a measurement."""
        at, age, to = self._instant, self.time - row.time, (self._h, self._residual, self._variance)
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

    def _take_gnss(self, row: Row) -> None:
        """Position and velocity, each by its own gate; and the restart."""
        for channel, model, part in _GNSS:
            m = self._gnss(model, row, part)
            rejected_since = self._judge(channel, row.source, m)
            if channel == Channel.GNSS_POSITION and m == 3 and self.time - rejected_since >= self.settings.restart_s:
                self._restart(row)
                return

    def _gnss(self, model: Any, row: Row, part: slice) -> int:
        arm, delay = self.estimates[LEVER_ARM], float(self.estimates[GNSS_DELAY][0])
        if row.source in self._apart:
            arm = arm + self._apart[row.source]
        at, age, to = self._instant, self.time - row.time, (self._h, self._residual, self._variance)
        return int(model(at, arm, delay, row.value[part], row.sigma[part], age, *to))

    def _judge(self, channel: Channel, source: int, m: int) -> float:
        """Take or reject a measurement of `m` rows; since when its source has been rejected, s, NaN if it is not."""
        if m == 0:
            return math.nan
        row = self.table.get((channel, source))
        if row is None:
            row = self.table[channel, source] = np.zeros(gates.TABLE)
            gates.clear(row)
        self._believed[:] = gates.inflation(row) * self._variance
        nis, spread = self.filter.examine(self._h, self._residual, self._believed, m)
        gate = self._gate[m - 1]
        accepted = gates.judge(row, m, self._residual, self._variance, spread, nis, gate, self.time)
        self.judged.append(Judged(self.time, channel, source, m, nis, accepted))
        if accepted:
            if self._recorder is not None:
                self._recorder.absorb(self._h, self._residual, self._believed, m)
            x = self.filter.absorb(self._h, self._residual, self._believed, m)
            self._core.correct(x[0:3], x[3:6], x[6:9])
            self.estimates[9:] += x[9:]
            self._instant[:10] = self._core.solution
        return float(row[gates.SINCE])

    def _restart(self, row: Row) -> None:
        """Begin again where GNSS says, with the attitude as it is, three times less sure of it than before."""
        if self._recorder is not None:
            self._recorder.end(self._core.solution, self.estimates)
        zero = np.zeros(3)
        self._sigma[6:9] = np.minimum(3.0 * self._sigma[6:9], 1.0)
        for _, model, part in _GNSS:
            if self._gnss(model, row, part) == 3:
                errors = [zero, zero, zero]
                errors[part.start // 3] = self._residual
                self._core.correct(*errors)
                self._instant[:10] = self._core.solution
                self._sigma[part] = np.sqrt(self._variance)
        self.filter.start(self._sigma)
        self.estimates[:] = self._known
        if self._recorder is not None:
            self._recorder.restart(self._core.solution)
        self.table.clear()
        self.restarts.append(Restart(self.time, row.source))

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
            for key, row in sorted(self.table.items())
        ]

    def own(self) -> tuple[FloatArray, ...]:
        """All that the next answer depends on, besides the core and `table`; their own arrays."""
        f = self.filter
        return f.u, f.d, f.turn, self.estimates, self._instant, self._sigma

    def recall(self, time: float, table: Table) -> None:
        """Go back to the end of an interval; the arrays of `own` have been filled as they were then."""
        self.time = time
        self.table = {key: row.copy() for key, row in table.items()}
        self.judged = [one for one in self.judged if one.time <= time]
        self.restarts = [one for one in self.restarts if one.time <= time]
        if self._recorder is not None:
            self._recorder.recall(time)
