"""Attitude methods by name, behind one interface.

| name | needs | block | order | order, unequal steps |
| --- | --- | --- | --- | --- |
| `poisson-rk4`, `euler-vector-rk4` | rates: sampled, or of the cubic through 4 increments | 4 | 4 | 4 |
| `picard3` | increments, the previous one | 1 | 3 | 3 |
| `picard3-source` | as `picard3`, with the source's scaling | 1 | 3 | 2 |
| `four-sample`, `four-sample-series` | increments | 4 | 4 | 2 |
| `coning:N`, N = 1..5 | increments | N | 2, 4, 3, 3, 3 | 2, 3, 2, 2, 2 |
| `coning-uncompressed:N`, N = 1..5 | increments | N | 2, 4, 4, 4, 4 | 2, 3, 2, 2, 2 |
| `coning-stream:N`, N = 1..5 | increments, N - 1 previous ones | 1 | 2, 3, 3, 3, 3 | 2, 3, 2, 2, 2 |
| `high-order:N`, N = 1..10 (4) | increments | N | N + 1, N even: N + 2 | N + 1 |
| `high-order-stream:N`, N = 1..10 (4) | increments, N - 1 previous ones | 1 | N + 1 | N + 1 |

`two-sample` is another name of `coning-stream:2`. The order is that of the largest attitude error in the step, under
any smooth motion and over a fixed time; the coning family's error on pure coning falls much faster. Each method's
kernels are usable alone, in the module of its name: they give the quaternion of the rotation over a block or a step from
a window of increments, and allocate nothing.
"""

from collections.abc import Callable
from typing import Literal, Protocol

from nav.attitude import advance as kinds
from nav.attitude.coning import BLOCK, MAX_SAMPLES, STREAM, coefficients
from nav.attitude.high_order import MAX_SAMPLES as MAX_POLYNOMIAL
from nav.attitude.method import AttitudeStream, Method
from nav.errors import HilError
from nav.increments import FloatArray

__all__ = ["NAMES", "AttitudeMethod", "AttitudeStream", "method"]


class AttitudeMethod(Protocol):
    """An attitude method."""

    @property
    def name(self) -> str:
        """As a user chooses it."""
        ...

    @property
    def needs(self) -> Literal["increments", "rates"]:
        """What the method integrates; rates are made from increments where none are given."""
        ...

    @property
    def block(self) -> int:
        """Samples from one exact attitude to the next."""
        ...

    @property
    def window(self) -> int:
        """Samples that an attitude is made of: the block, and past ones."""
        ...

    def integrate(self, q0: FloatArray, step: FloatArray, dtheta: FloatArray) -> FloatArray:
        """Attitudes q_ib (n, 4) after each of n steps from `q0`; see `Method.integrate`."""
        ...

    def block_ends(self, q0: FloatArray, step: FloatArray, dtheta: FloatArray) -> FloatArray:
        """The rows of `integrate` at block ends only."""
        ...

    def integrate_rates(self, q0: FloatArray, step: FloatArray, rate: FloatArray) -> FloatArray:
        """Attitudes from sampled rates, where `needs` is "rates"; see `Method.integrate_rates`."""
        ...

    def stream(self, q0: FloatArray) -> AttitudeStream:
        """The method for samples as they come, from `q0`."""
        ...


def _plain(
    kind: int, window: int, block: int, needs: Literal["increments", "rates"] = "increments"
) -> Callable[..., Method]:
    return lambda name: Method(name, needs, kind, window, block)


def _coning(kind: int, table: dict[int, tuple[float, ...]], *, stream: bool) -> Callable[..., Method]:
    return lambda name, n: Method(name, "increments", kind, n, 1 if stream else n, coefficients(table, n))


def _high_order(*, stream: bool) -> Callable[..., Method]:
    return lambda name, n: Method(name, "increments", kinds.HIGH_ORDER, n, 1 if stream else n)


_FIXED: dict[str, Callable[[str], Method]] = {
    "poisson-rk4": _plain(kinds.POISSON, kinds.RATE_SAMPLES, kinds.RATE_SAMPLES, "rates"),
    "euler-vector-rk4": _plain(kinds.EULER_VECTOR, kinds.RATE_SAMPLES, kinds.RATE_SAMPLES, "rates"),
    "picard3": _plain(kinds.PICARD3, 2, 1),
    "picard3-source": _plain(kinds.PICARD3_SOURCE, 2, 1),
    "four-sample": _plain(kinds.FOUR_SAMPLE, 4, 4),
    "four-sample-series": _plain(kinds.FOUR_SAMPLE_SERIES, 4, 4),
}
_FAMILIES: dict[str, tuple[Callable[[str, int], Method], int, int | None]] = {
    "coning": (_coning(kinds.CONING, BLOCK, stream=False), MAX_SAMPLES, None),
    "coning-uncompressed": (_coning(kinds.CONING_UNCOMPRESSED, BLOCK, stream=False), MAX_SAMPLES, None),
    "coning-stream": (_coning(kinds.CONING_STREAM, STREAM, stream=True), MAX_SAMPLES, None),
    "high-order": (_high_order(stream=False), MAX_POLYNOMIAL, 4),
    "high-order-stream": (_high_order(stream=True), MAX_POLYNOMIAL, 4),
}
_ALIASES = {"two-sample": "coning-stream:2"}

NAMES: tuple[str, ...] = (
    *_FIXED,
    *(f"{family}{'[:N]' if default else ':N'} (N = 1..{most})" for family, (_, most, default) in _FAMILIES.items()),
    *_ALIASES,
)
"""What there is, for messages and help."""


def method(name: str) -> AttitudeMethod:
    """The attitude method of that name.

    Raises
    ------
    HilError
        There is none; the message lists what there is.
    """
    name = _ALIASES.get(name, name)
    if name in _FIXED:
        return _FIXED[name](name)
    family, colon, number = name.partition(":")
    if family in _FAMILIES:
        make, most, default = _FAMILIES[family]
        if not colon and default is not None:
            return make(f"{family}:{default}", default)
        if number.isascii() and number.isdigit() and 1 <= int(number) <= most:
            return make(f"{family}:{int(number)}", int(number))
        raise HilError(f"attitude method {name!r}: expected {family}:N with N from 1 to {most}")
    raise HilError(f"unknown attitude method {name!r}; there is: {', '.join(NAMES)}")
