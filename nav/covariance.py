"""Linear covariance of a navigator's errors along a path, source by source.

The sources are independent, so each is carried alone and the covariances add up; what each contributes is the error budget.
With x = Phi x + Gamma e over a step T (:mod:`nav.error_dynamics`), e the errors of the increments in b:

    constant   e = T K r, r = (1, w_ib_b, f_b): the response s to one sigma is carried, P = s s^T
    white      e of variance N^2 T: P = Phi P Phi^T + N^2 T Gamma Gamma^T
    drift      Gauss-Markov b of variance S^2 and correlation time tau: with d = exp(-T / tau), p = E[x b], the integral J of b

               P = Phi P Phi^T + Phi p' Gamma^T + Gamma p'^T Phi^T + E[J^2] Gamma Gamma^T,   p' = E[x J] = tau (1 - d) p
               p = d Phi p + tau (1 - d) S^2 Gamma,   E[J^2] = 2 tau^2 (T / tau - 1 + d) S^2

The last three are exact for any T / tau.
"""

from collections.abc import Iterable
from dataclasses import dataclass, field

import numpy as np

from nav.checks import read_array
from nav.error_dynamics import STATES, fill_dynamics, fill_input, fill_transition
from nav.errors import HilError
from nav.increments import FloatArray
from nav.kernel import inline_kernel, kernel
from nav.rotation import normalised
from nav.turn import matrix_from_quaternion


@dataclass(frozen=True, slots=True)
class Path:
    """What is true in the middle of `n` equal steps.

    Attributes
    ----------
    step : float
        s.
    lat, height : (n,) float
        rad, m.
    vel_n, q_nb, w_ib_b, f_b : (n, 3), (n, 4), (n, 3), (n, 3) float
        m/s, attitude, rad/s, m/s^2.

    Raises
    ------
    HilError
        A shape does not fit, a value is not finite, the step is not positive, or the path meets a pole.
    """

    step: float
    lat: FloatArray
    height: FloatArray
    vel_n: FloatArray
    q_nb: FloatArray
    w_ib_b: FloatArray
    f_b: FloatArray

    def __post_init__(self) -> None:
        """Refuse what would end in NaN."""
        if not 0.0 < self.step < np.inf:
            raise HilError(f"path: a step of {self.step:g} s; it must be positive")
        n = len(self.lat)
        for name, tail in (
            ("lat", ()),
            ("height", ()),
            ("vel_n", (3,)),
            ("q_nb", (4,)),
            ("w_ib_b", (3,)),
            ("f_b", (3,)),
        ):
            array = read_array(f"path: {name}", getattr(self, name), n, *tail)
            if not np.isfinite(array).all():
                raise HilError(f"path: {name} is not finite at step {int(np.argwhere(~np.isfinite(array))[0, 0])}")
            object.__setattr__(self, name, normalised(array) if name == "q_nb" else array)
        if not (np.abs(self.lat) < 0.5 * np.pi).all():
            raise HilError("path: it meets a pole, where north is no direction")


def _none(*shape: int) -> FloatArray:
    return np.zeros((0, *shape))


@dataclass(frozen=True, slots=True)
class Source:
    """One line of the budget: independent errors of one kind.

    Attributes
    ----------
    name : str
    constant : (m, 6, 7) float
        Of m constants, one sigma of each: K, what it adds to gyros and accelerometers in b (6; rad/s, m/s^2), by r (7).
    white : (c, 6) float
        Of c white noises: N in b, rad/sqrt(s), m/s/sqrt(s).
    drift : (d, 6) float
        Of d sums of Gauss-Markov processes, independent and alike: S in b.
    times : (p,) float
        Correlation times of the processes in each sum, s.

    Raises
    ------
    HilError
        A shape does not fit, a value is not finite, or a correlation time is not positive.
    """

    name: str
    constant: FloatArray = field(default_factory=lambda: _none(6, 7))
    white: FloatArray = field(default_factory=lambda: _none(6))
    drift: FloatArray = field(default_factory=lambda: _none(6))
    times: FloatArray = field(default_factory=_none)

    def __post_init__(self) -> None:
        """Refuse what would end in NaN."""
        for name, tail in (("constant", (6, 7)), ("white", (6,)), ("drift", (6,)), ("times", ())):
            values = getattr(self, name)
            array = read_array(f"source {self.name!r}: {name}", values, len(values), *tail)
            if not np.isfinite(array).all():
                raise HilError(f"source {self.name!r}: {name} is not finite")
            object.__setattr__(self, name, array)
        if not (self.times > 0.0).all() or (len(self.drift) > 0 and len(self.times) == 0):
            raise HilError(f"source {self.name!r}: a drift needs correlation times, and positive ones")


def response(
    path: Path, start: FloatArray, constant: FloatArray, *, every: int = 1, height_held: bool = False
) -> FloatArray:
    """Errors along the path that m errors of the start with constant errors of the instruments make, to first order.

    Parameters
    ----------
    path : Path
        True states in the middle of steps.
    start : (m, 9) float
        Errors at the start.
    constant : (m, 6, 7) float
        As in `Source`.
    every : int
        Steps between the answers.
    height_held : bool
        Height and vertical velocity are known from elsewhere: they have no error.

    Returns
    -------
    (n // every, m, 9) float
        At the end of each `every`th step.

    Raises
    ------
    HilError
        A shape does not fit, or `every` is below 1.
    """
    m = len(start)
    start, constant = read_array("start", start, m, STATES), read_array("constant", constant, m, 6, 7)
    if every < 1:
        raise HilError(f"response: an answer every {every} steps; it must be 1 or more")
    out = np.empty((len(path.lat) // every, len(start), STATES))
    _respond(_table(path), path.step, height_held, every, start.copy(), constant, out)
    return out


def covariance(path: Path, source: Source, *, every: int = 1, height_held: bool = False) -> FloatArray:
    """Covariance (n // every, 9, 9) of the errors that a source makes; parameters as in `response`."""
    s = response(path, np.zeros((len(source.constant), STATES)), source.constant, every=every, height_held=height_held)
    out = np.einsum("kmi,kmj->kij", s, s)
    if len(source.white) or len(source.drift):
        noise = source.white, source.drift, source.times
        _spread(_table(path), path.step, height_held, every, *noise, out)
    return np.asarray(out, np.float64)


def budget(
    path: Path, sources: Iterable[Source], *, every: int = 1, height_held: bool = False
) -> dict[str, FloatArray]:
    """`covariance` of each source by its name; their sum is the whole.

    Raises
    ------
    HilError
        Two sources have one name.
    """
    found: dict[str, FloatArray] = {}
    for source in sources:
        if source.name in found:
            raise HilError(f"budget: two sources of one name, {source.name!r}: one would be lost")
        found[source.name] = covariance(path, source, every=every, height_held=height_held)
    return found


def _table(path: Path) -> FloatArray:
    return np.column_stack([path.lat, path.height, path.vel_n, path.q_nb, path.w_ib_b, path.f_b])


@kernel
def _linearize(
    row: FloatArray, step: float, held: bool, c: FloatArray, f: FloatArray, phi: FloatArray, gain: FloatArray
) -> None:
    """Transition and input of one step; C_nb and F are room to work in."""
    matrix_from_quaternion(row[5:9], c)
    fill_dynamics(row[0], row[1], row[2:5], c, row[12:15], f)
    if held:
        f[2], f[5] = 0.0, 0.0
    fill_transition(f, step, phi)
    fill_input(f, c, step, gain)
    if held:
        gain[2], gain[5] = 0.0, 0.0


@kernel
def _respond(
    path: FloatArray, step: float, held: bool, every: int, x: FloatArray, constant: FloatArray, out: FloatArray
) -> None:
    c, f, phi, gain = np.empty((3, 3)), np.empty((9, 9)), np.empty((9, 9)), np.empty((9, 6))
    new, wrong = np.empty(9), np.empty(6)
    for k in range(len(path)):
        row = path[k]
        _linearize(row, step, held, c, f, phi, gain)
        for m in range(len(x)):
            for i in range(6):
                total = constant[m, i, 0]
                for j in range(6):
                    total += constant[m, i, 1 + j] * row[9 + j]
                wrong[i] = step * total
            for i in range(9):
                total = 0.0
                for j in range(9):
                    total += phi[i, j] * x[m, j]
                for j in range(6):
                    total += gain[i, j] * wrong[j]
                new[i] = total
            x[m] = new
        if (k + 1) % every == 0:
            out[k // every] = x


@kernel
def _spread(
    path: FloatArray,
    step: float,
    held: bool,
    every: int,
    white: FloatArray,
    drift: FloatArray,
    times: FloatArray,
    out: FloatArray,
) -> None:
    """Add the covariance of noises to `out`."""
    c, f, phi, gain = np.empty((3, 3)), np.empty((9, 9)), np.empty((9, 9)), np.empty((9, 6))
    p, room = np.zeros((9, 9)), np.empty((9, 9))
    push, joint, new = np.empty(9), np.empty(9), np.empty(9)
    cross = np.zeros((len(drift), len(times), 9))
    decay = np.exp(-step / times)
    reach = times * (1.0 - decay)
    square = 2.0 * (times * times * (step / times - 1.0 + decay)).sum()
    for k in range(len(path)):
        _linearize(path[k], step, held, c, f, phi, gain)
        for i in range(9):
            for j in range(9):
                total = 0.0
                for n in range(9):
                    total += phi[i, n] * p[n, j]
                room[i, j] = total
        for i in range(9):
            for j in range(9):
                total = 0.0
                for n in range(9):
                    total += room[i, n] * phi[j, n]
                p[i, j] = total
        for m in range(len(white)):
            _push(gain, white[m], push)
            for i in range(9):
                for j in range(9):
                    p[i, j] += step * push[i] * push[j]
        for m in range(len(drift)):
            _push(gain, drift[m], push)
            joint[:] = 0.0  # Phi E[x J], J of all processes together
            for q in range(len(times)):
                for i in range(9):
                    total = 0.0
                    for j in range(9):
                        total += phi[i, j] * cross[m, q, j]
                    joint[i] += reach[q] * total
                    new[i] = decay[q] * total + reach[q] * push[i]
                cross[m, q] = new
            for i in range(9):
                for j in range(9):
                    p[i, j] += joint[i] * push[j] + push[i] * joint[j] + square * push[i] * push[j]
        if (k + 1) % every == 0:
            out[k // every] += p


@inline_kernel
def _push(gain: FloatArray, direction: FloatArray, out: FloatArray) -> None:
    for i in range(9):
        total = 0.0
        for j in range(6):
            total += gain[i, j] * direction[j]
        out[i] = total
