"""What is cut from buffers to a number of samples, made once for each number: ten slices cost more than a kernel."""

from collections.abc import Callable
from typing import TypeVar

T = TypeVar("T")


class Cut(dict[int, T]):
    """``cut[n]`` is ``make(n)``, made when it is first wanted; `clear` it when the buffers are new."""

    def __init__(self, make: Callable[[int], T]) -> None:
        super().__init__()
        self._make = make

    def __missing__(self, n: int) -> T:
        """Make what is not there yet."""
        made = self[n] = self._make(n)
        return made
