"""Mean, scatter and rate of values that go on coming: of all of them, and of the newest."""

import math
from dataclasses import dataclass, field

import numpy as np

from nav.increments import FloatArray, IntArray


@dataclass(slots=True)
class Scatter:
    """Mean and scatter of a run of values."""

    count: int = 0
    mean: float = 0.0
    squares: float = 0.0
    low: float = math.inf
    high: float = -math.inf
    first_ns: int = 0
    last_ns: int = 0

    def take(self, values: FloatArray, times_ns: IntArray) -> None:
        """Add values (n,), n > 0, that came at these times."""
        mean = float(values.mean())
        squares = float(np.square(values - mean).sum())
        span = int(times_ns[0]), int(times_ns[-1])
        self.join(Scatter(len(values), mean, squares, float(values.min()), float(values.max()), *span))

    def join(self, other: "Scatter") -> None:
        """Add another run, which came later (Chan, Golub & LeVeque 1979)."""
        if other.count == 0:
            return
        count, apart = self.count + other.count, other.mean - self.mean
        self.squares += other.squares + apart**2 * self.count * other.count / count
        self.mean += apart * other.count / count
        self.low, self.high = min(self.low, other.low), max(self.high, other.high)
        self.first_ns = self.first_ns if self.count else other.first_ns
        self.count, self.last_ns = count, other.last_ns

    @property
    def sigma(self) -> float:
        """Standard deviation; 0 of a single value."""
        return math.sqrt(self.squares / (self.count - 1)) if self.count > 1 else 0.0

    @property
    def rate_hz(self) -> float:
        """Values a second; 0 of a single one."""
        span = 1e-9 * (self.last_ns - self.first_ns)
        return (self.count - 1) / span if span > 0.0 else 0.0


@dataclass(slots=True)
class Run:
    """A run as a whole, and its newest part."""

    whole: Scatter = field(default_factory=Scatter)
    before: Scatter = field(default_factory=Scatter)
    now: Scatter = field(default_factory=Scatter)

    def take(self, values: FloatArray, times_ns: IntArray) -> None:
        """As `Scatter.take`."""
        part = Scatter()
        part.take(values, times_ns)
        self.whole.join(part)
        self.now.join(part)

    def turn(self) -> None:
        """A window is over."""
        self.before, self.now = self.now, Scatter()

    def shown(self, *, recent: bool) -> Scatter:
        """The newest part, where there is one and it is asked for; else the whole."""
        newest = Scatter()
        newest.join(self.before)
        newest.join(self.now)
        return newest if recent and newest.count else self.whole
