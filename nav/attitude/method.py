"""An attitude method as an object: whole records at once, or samples as they come."""

import math
from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from nav.attitude.advance import BLOCK_ENDS, EVERY_ROW, STREAM, advance, advance_rates, initial_state
from nav.checks import read_array
from nav.errors import HilError
from nav.increments import FloatArray
from nav.rotation import normalised

_NO_TABLE: FloatArray = np.zeros(0)


@dataclass(frozen=True, eq=False)
class Method:
    """One method of :mod:`nav.attitude`.

    Attributes
    ----------
    name : str
        As a user chooses it.
    needs : str
        "increments", or "rates": those of the cubic through four increments, or sampled ones (`integrate_rates`).
    kind : int
        Which of :mod:`nav.attitude.advance`.
    window : int
        Samples that an attitude is made of.
    block : int
        The samples among them that the attitude goes forward.
    table : (window - 1,) float
        Coefficients, where the kind has a family of them.
    """

    name: str
    needs: Literal["increments", "rates"]
    kind: int
    window: int
    block: int
    table: FloatArray = field(default_factory=lambda: _NO_TABLE)

    def integrate(self, q0: FloatArray, step: FloatArray, dtheta: FloatArray) -> FloatArray:
        """Attitudes after each step of a record.

        Rows between two block ends, and those before the first full window, are of the polynomial through the block.
        The rows of an unfinished last block are of the polynomial through the last `window` samples.

        Parameters
        ----------
        q0 : (4,) float
            Attitude q_ib at the start; normalised.
        step : (n,) float
            Steps, s. A step of zero or less repeats the row before it.
        dtheta : (n, 3) float
            Angle increments, rad.

        Returns
        -------
        (n, 4) float
            q_ib at the end of each step.

        Raises
        ------
        HilError
            The shapes do not fit, or a value is not a number.
        """
        q0, step, dtheta = _arrays(q0, step, dtheta, 0)
        out = np.empty((len(step), 4))
        state = initial_state(self.kind, q0)
        _advance(self, EVERY_ROW, state, step, dtheta, out)
        return out

    def block_ends(self, q0: FloatArray, step: FloatArray, dtheta: FloatArray) -> FloatArray:
        """As `integrate`, but only the rows at block ends, without the work for the rows between: (n // block, 4)."""
        if self.block == 1:
            return self.integrate(q0, step, dtheta)
        q0, step, dtheta = _arrays(q0, step, dtheta, 0)
        out = np.empty((len(step) // self.block, 4))
        state = initial_state(self.kind, q0)
        return out[: _advance(self, BLOCK_ENDS, state, step, dtheta, out)]

    def integrate_rates(self, q0: FloatArray, step: FloatArray, rate: FloatArray) -> FloatArray:
        """Attitudes after each step from sampled body rates, for methods that need rates.

        Parameters
        ----------
        q0 : (4,) float
            Attitude q_ib at the start; normalised.
        step : (n,) float
            Steps, s, all positive.
        rate : (n + 1, 3) float
            Body rates at the start and at the end of each step, rad/s.

        Returns
        -------
        (n, 4) float
            q_ib at the end of each step.

        Raises
        ------
        HilError
            The method takes increments, the shapes do not fit, a value is not a number, or a step is not positive.
        """
        if self.needs != "rates":
            raise HilError(f"{self.name} takes increments, not rates; poisson-rk4 and euler-vector-rk4 take rates")
        q0, step, rate = _arrays(q0, step, rate, 1)
        positive = (step > 0.0) & (step < np.inf)
        if not positive.all():
            raise HilError(f"step: expected positive steps, got {step[~positive][0]} s")
        if not np.isfinite(rate).all():
            raise HilError(
                f"rate: row {int(np.argwhere(~np.isfinite(rate))[0, 0])} is not a number: mend what measured it"
            )
        out = np.empty((len(step), 4))
        advance_rates(self.kind, initial_state(self.kind, q0), step, rate, out)
        return out

    def stream(self, q0: FloatArray) -> "AttitudeStream":
        """The method for samples as they come, from the attitude `q0` (4,)."""
        return AttitudeStream(self, q0)


class AttitudeStream:
    """A method fed with samples as they come; how they are split over calls changes no bit.

    A row at a block end is that of `Method.integrate`. A row between is the best that is known by then: it is made of
    the newest `window` samples, where `integrate` looks ahead to the end of the block; no later row builds on it.

    Parameters
    ----------
    method : Method
        The method.
    q0 : (4,) float
        Attitude q_ib at the start; normalised.

    Raises
    ------
    HilError
        `q0` is no rotation.
    """

    def __init__(self, method: Method, q0: FloatArray) -> None:
        self._method = method
        self._state = initial_state(method.kind, normalised(read_array("q0", q0, 4)))

    def push(self, step: FloatArray, dtheta: FloatArray, out: FloatArray) -> None:
        """Integrate samples, allocating nothing.

        The arrays are contiguous, of float64: the kernel is compiled anew for any other kind.

        Parameters
        ----------
        step : (n,) float
            Steps, s; one of zero or less repeats the row before.
        dtheta : (n, 3) float
            Angle increments, rad.
        out : (n, 4) float
            Out: q_ib at the end of each step.

        Raises
        ------
        HilError
            A shape does not fit, or a value is not a number: nothing has changed. Or an increment is too large.
        """
        _advance(self._method, STREAM, self._state, step, dtheta, out)


def _advance(m: Method, mode: int, state: FloatArray, step: FloatArray, dtheta: FloatArray, out: FloatArray) -> int:
    rows = int(advance(m.kind, m.window, m.block, m.table, mode, state, step, dtheta, out))
    if rows == -1 - len(step):
        raise HilError(
            f"attitude: expected step (n,), dtheta (n, 3) and out (n, 4), got {step.shape}, {dtheta.shape} and {out.shape}"
        )
    if rows < 0:
        raise HilError(f"attitude: step or dtheta of sample {-1 - rows} is not a number: mend the driver or the file")
    if rows and not math.isfinite(out[rows - 1, 0]):
        raise HilError("attitude: an increment is too large for the attitude to be a number: start again without it")
    return rows


def _arrays(q0: FloatArray, step: FloatArray, rows: FloatArray, more: int) -> tuple[FloatArray, FloatArray, FloatArray]:
    what, n = "rate" if more else "dtheta", len(step)
    q0, step, rows = read_array("q0", q0, 4), read_array("step", step, n), read_array(what, rows, n + more, 3)
    return normalised(q0), step, rows
