"""How every numerical kernel of the project is compiled: one decorator, one set of options."""

from collections.abc import Callable
from typing import Any, TypeVar

import numba

F = TypeVar("F", bound=Callable[..., Any])


def kernel(function: F) -> F:
    """Compile `function` with numba: cached on disk, no GIL, IEEE arithmetic (no fast-math), division by zero as in numpy."""
    compiled: F = numba.njit(cache=True, nogil=True, error_model="numpy")(function)
    return compiled


def inline_kernel(function: F) -> F:
    """Compile a small helper that is inlined into the kernels calling it (LLVM decides)."""
    compiled: F = numba.njit(cache=True, nogil=True, error_model="numpy", forceinline=True)(function)
    return compiled
