"""An attitude method as an object: whole records at once, or samples as they come."""

from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from nav.attitude.advance import BLOCK_ENDS, EVERY_ROW, STREAM, advance, advance_rates, initial_state
from nav.errors import HilError
from nav.increments import FloatArray

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
            Attitude q_ib at the start, of unit norm.
        step : (n,) float
            Steps, s. A step of zero repeats the row before it.
        dtheta : (n, 3) float
            Angle increments, rad.

        Returns
        -------
        (n, 4) float
            q_ib at the end of each step.

        Raises
        ------
        HilError
            The shapes do not fit.
        """
        q0, step, dtheta = _arrays(q0, step, dtheta, 0)
        out = np.empty((len(step), 4))
        state = initial_state(self.kind, q0)
        advance(self.kind, self.window, self.block, self.table, EVERY_ROW, state, step, dtheta, out)
        return out

    def block_ends(self, q0: FloatArray, step: FloatArray, dtheta: FloatArray) -> FloatArray:
        """As `integrate`, but only the rows at block ends, without the work for the rows between: (n // block, 4)."""
        if self.block == 1:
            return self.integrate(q0, step, dtheta)
        q0, step, dtheta = _arrays(q0, step, dtheta, 0)
        out = np.empty((len(step) // self.block, 4))
        state = initial_state(self.kind, q0)
        n = advance(self.kind, self.window, self.block, self.table, BLOCK_ENDS, state, step, dtheta, out)
        return out[:n]

    def integrate_rates(self, q0: FloatArray, step: FloatArray, rate: FloatArray) -> FloatArray:
        """Attitudes after each step from sampled body rates, for methods that need rates.

        Parameters
        ----------
        q0 : (4,) float
            Attitude q_ib at the start, of unit norm.
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
            The method takes increments, the shapes do not fit, or a step is not positive.
        """
        if self.needs != "rates":
            raise HilError(f"{self.name} takes increments, not rates; poisson-rk4 and euler-vector-rk4 take rates")
        q0, step, rate = _arrays(q0, step, rate, 1)
        if not (step > 0.0).all():
            raise HilError(f"step: expected positive steps, got {step[~(step > 0.0)][0]} s")
        out = np.empty((len(step), 4))
        advance_rates(self.kind, initial_state(self.kind, q0), step, rate, out)
        return out

    def stream(self, q0: FloatArray) -> "AttitudeStream":
        """The method for samples as they come, from the unit attitude `q0` (4,)."""
        return AttitudeStream(self, np.asarray(q0, dtype=np.float64))


class AttitudeStream:
    """A method fed with samples as they come; how they are split over calls changes no bit.

    A row at a block end is that of `Method.integrate`. A row between is the best that is known by then: it is made of
    the newest `window` samples, where `integrate` looks ahead to the end of the block; no later row builds on it.

    Parameters
    ----------
    method : Method
        The method.
    q0 : (4,) float
        Attitude q_ib at the start, of unit norm.
    """

    def __init__(self, method: Method, q0: FloatArray) -> None:
        self._method = method
        self._state = initial_state(method.kind, q0)

    def push(self, step: FloatArray, dtheta: FloatArray, out: FloatArray) -> None:
        """Integrate samples, allocating nothing.

        Parameters
        ----------
        step : (n,) float
            Steps, s; one of zero repeats the row before.
        dtheta : (n, 3) float
            Angle increments, rad.
        out : (n, 4) float
            Out: q_ib at the end of each step.
        """
        m = self._method
        advance(m.kind, m.window, m.block, m.table, STREAM, self._state, step, dtheta, out)


def _arrays(q0: FloatArray, step: FloatArray, rows: FloatArray, more: int) -> tuple[FloatArray, FloatArray, FloatArray]:
    q0, step, rows = (np.ascontiguousarray(a, dtype=np.float64) for a in (q0, step, rows))
    if q0.shape != (4,) or step.ndim != 1 or rows.shape != (len(step) + more, 3):
        raise HilError(
            f"attitude: expected q0 (4,), step (n,) and {'rates (n + 1, 3)' if more else 'dtheta (n, 3)'}, "
            f"got {q0.shape}, {step.shape} and {rows.shape}"
        )
    return q0, step, rows
