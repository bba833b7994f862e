"""Fixed-interval smoothing of a recorded filter: every epoch by all measurements of its run, those that came later too.

Modified Bryson-Frazier form (Bierman 1973). A vector l and a matrix L go back in time, both zero at the end. The errors x at
an epoch, after its measurements, are zero as far as the filter knows, since they were taken off; P is their covariance:

    smoothed           x = -P l,    P_s = P - P L P
    measurement h      l -= h (k l + nu / s),    L = (I - k h)^T L (I - k h) + h^T h / s
    interval Phi       l = Phi^T l,    L = Phi^T L Phi

where k is the gain, s the variance of the innovation nu. Nothing is inverted and the noise does not enter, so a parameter that
does not walk and a state without doubt do no harm; a Rauch-Tung-Striebel smoother needs the inverse of every predicted
covariance, which the factored filter never forms and which need not exist. What the filter took off the navigator is in
the solutions; the reset of the attitude is in Phi. A start and a restart end the way back.

Between the marks of the record the filter is run again, `nav.filter.record.STRIDE` epochs at a time.
"""

import math
from dataclasses import dataclass

import numpy as np

from nav.earth import curvature_radii
from nav.errors import HilError
from nav.filter.backward import fill_gain, go_back
from nav.filter.error_state import ErrorState
from nav.filter.record import STRIDE, Mark, Recorder
from nav.filter.states import STATES
from nav.increments import FloatArray
from nav.kernel import kernel
from nav.rotation import attitude_error, product, quaternion_from_rotation_vector


@dataclass(frozen=True, slots=True)
class Smoothed:
    """The smoothed solution at each epoch: the ends of the filter's intervals.

    Attributes
    ----------
    time : (n,) float
        s. An epoch of a restart comes twice, by what was before and by what comes behind.
    position, velocity, attitude : (n, 3), (n, 3), (n, 4) float
        lat, lon (rad), height (m); vel_n, m/s; q_nb.
    estimates, sigma : (n, STATES) float
        Of the parameters, the first nine are 0; one sigma of every state, 0 of one that is not used.
    covariance : (n, 9, 9) float
        Of the navigator's errors: m, m/s, rad.
    rate : (n, 3) float
        Mean w_ib_b over the interval as the filter corrected it, rad/s; zero at a start.
    runs : tuple of int
        Epochs at which the navigator was started.
    """

    time: FloatArray
    position: FloatArray
    velocity: FloatArray
    attitude: FloatArray
    estimates: FloatArray
    sigma: FloatArray
    covariance: FloatArray
    rate: FloatArray
    runs: tuple[int, ...]
    _before: FloatArray
    _after: FloatArray

    def correct(
        self, time: FloatArray, position: FloatArray, velocity: FloatArray, attitude: FloatArray
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Smoothed solutions between the epochs: the correction is linear there, from behind one to before the next.

        Parameters
        ----------
        time : (m,) float
            Of samples of the one run, s.
        position, velocity, attitude : (m, 3), (m, 3), (m, 4) float
            The navigator's answers at the samples.

        Raises
        ------
        HilError
            There is more than one run.
        """
        if len(self.runs) != 1:
            raise HilError(f"smoother: the navigator was started {len(self.runs)} times: smooth each run by itself")
        times = np.repeat(self.time, 2)
        errors = np.stack([self._before, self._after], axis=1).reshape(-1, 9)
        behind = np.clip(np.searchsorted(times, time, side="right"), 1, len(times) - 1)
        length = times[behind] - times[behind - 1]
        part = np.where(length > 0.0, (time - times[behind - 1]) / np.where(length > 0.0, length, 1.0), 1.0)
        part = np.clip(part, 0.0, 1.0)[:, None]
        return _taken_off((1.0 - part) * errors[behind - 1] + part * errors[behind], position, velocity, attitude)


def smooth(record: Recorder) -> Smoothed:
    """The smoothed solution of all runs of a record.

    Raises
    ------
    HilError
        Nothing was recorded.
    """
    if not record.runs:
        raise HilError("smoother: nothing was recorded: give the recorder to a navigator and start it")
    epochs, used = record.epochs, record.filter.used
    n, m = len(epochs), len(used)
    x, spread, covariance = np.empty((n, m)), np.empty((n, m)), np.empty((n, 9, 9))
    state, room = ErrorState(record.filter.tuning), _Room(m)
    back, curvature = np.zeros(m), np.zeros((m, m))
    stop = n
    for mark in reversed(record.marks):
        part = slice(mark.epoch, stop)
        _run_again(record, state, mark, stop, room)
        how = room.phi, room.u, room.d, room.scalars, room.first
        go_back(*how, back, curvature, room.work, x[part], spread[part], covariance[part])
        if mark.begin:
            back[:], curvature[:] = 0.0, 0.0
        stop = mark.epoch
    sigma, estimates = np.zeros((n, STATES)), epochs["estimates"].copy()
    sigma[:, used] = np.sqrt(spread)
    estimates[:, used[9:]] += x[:, 9:]
    after, before = epochs["after"], epochs["before"]
    solution = _taken_off(x[:, :9], after[:, :3], after[:, 3:6], after[:, 6:10])
    step = np.where(epochs["sums"][:, 0] > 0.0, epochs["sums"][:, 0], 1.0)[:, None]
    rate, left = epochs["sums"][:, 1:4] / step, _apart(before, *solution)
    return Smoothed(
        epochs["time"].copy(), *solution, estimates, sigma, covariance, rate, tuple(record.runs), left, x[:, :9].copy()
    )


class _Room:
    """What a stretch of the filter leaves for the way back, as of `go_back`."""

    def __init__(self, m: int) -> None:
        self.phi, self.u, self.d = np.empty((STRIDE, 9, m)), np.empty((STRIDE, m, m)), np.empty((STRIDE, m))
        self.first, self.scalars = np.zeros(STRIDE + 1, np.int64), np.empty((0, 2 * m + 2))
        self.work = np.zeros((3, m, m))


def _run_again(record: Recorder, state: ErrorState, mark: Mark, stop: int, room: _Room) -> None:
    """Fill `room` with the epochs from a mark to `stop`."""
    epochs, used = record.epochs, state.used
    edges = np.append(epochs["first_row"], len(record.rows))[mark.epoch : stop + 1]
    rows = record.rows[edges[0] : edges[-1]]
    room.first[: len(edges)] = edges - edges[0]
    room.scalars = np.empty((len(rows), 2 * len(used) + 2))
    h, x = np.zeros((1, STATES)), np.zeros(STATES)
    state.u[:], state.d[:], state.turn[:], state.transition[:] = mark.u, mark.d, mark.turn, mark.transition
    for k in range(stop - mark.epoch):
        epoch = mark.epoch + k
        if k:
            state.predict(epochs["after"][epoch - 1], epochs["before"][epoch], epochs["sums"][epoch])
        still = k > 0 and not epochs["sums"][epoch, 0] > 0.0
        room.phi[k] = np.eye(9, len(used)) if still else state.transition
        for i in range(room.first[k], room.first[k + 1]):
            h[0, used] = rows[i, :-3]
            if rows[i, -1] > 0.0:
                x[:] = 0.0
            innovation = rows[i, -3:-2] - h @ x
            fill_gain(state.u, state.d, rows[i], float(innovation[0]), room.scalars[i])
            x += state.absorb(h, innovation, rows[i, -2:-1])
        room.u[k], room.d[k] = state.u, state.d


def _taken_off(
    x: FloatArray, position: FloatArray, velocity: FloatArray, attitude: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Solutions without their errors (n, 9), as `nav.strapdown.Strapdown.correct` does it."""
    to_angle = 1.0 / _metres(position)
    lon = _wrapped(position[:, 1] - x[:, 1] * to_angle[:, 1])
    place = np.stack([position[:, 0] - x[:, 0] * to_angle[:, 0], lon, position[:, 2] + x[:, 2]], axis=1)
    return place, velocity - x[:, 3:6], product(quaternion_from_rotation_vector(-x[:, 6:9]), attitude)


def _apart(solution: FloatArray, position: FloatArray, velocity: FloatArray, attitude: FloatArray) -> FloatArray:
    """Errors (n, 9) that `_taken_off` takes off `solution` (n, 10) to make it the others."""
    radii = _metres(solution[:, :3])
    east = _wrapped(solution[:, 1] - position[:, 1])
    north, down = (solution[:, 0] - position[:, 0]) * radii[:, 0], position[:, 2] - solution[:, 2]
    place = np.stack([north, east * radii[:, 1], down], axis=1)
    return np.hstack([place, solution[:, 3:6] - velocity, attitude_error(solution[:, 6:10], attitude)])


def _wrapped(angle: FloatArray) -> FloatArray:
    """Into -pi to pi, to the same bits where it is there."""
    wrapped: FloatArray = angle - 2.0 * math.pi * np.rint(angle / (2.0 * math.pi))
    return wrapped


def _metres(position: FloatArray) -> FloatArray:
    """(n, 2): metres to the north and east in a radian of latitude and longitude."""
    return np.array([_radii(*row) for row in position[:, ::2]]).reshape(-1, 2)


@kernel
def _radii(lat: float, height: float) -> tuple[float, float]:
    meridian, prime = curvature_radii(math.sin(lat))
    return meridian + height, (prime + height) * math.cos(lat)
