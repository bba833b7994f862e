"""How every numerical kernel of the project is compiled: one decorator, one set of options."""

from collections.abc import Callable
from typing import Any, TypeVar

import numba
from numba.extending import intrinsic

from nav.kernel_cache import KernelCache

F = TypeVar("F", bound=Callable[..., Any])


def kernel(function: F) -> F:
    """Compile `function` with numba: cached on disk, no GIL, IEEE arithmetic (no fast-math), division by zero as in numpy."""
    return _compiled(function)


def inline_kernel(function: F) -> F:
    """Compile a small helper that is inlined into the kernels calling it (LLVM decides)."""
    return _compiled(function, forceinline=True)


def _compiled(function: F, **options: bool) -> F:
    compiled: Any = numba.njit(nogil=True, error_model="numpy", **options)(function)
    if not numba.config.DISABLE_JIT:
        compiled._cache = KernelCache(function, compiled.targetoptions)  # as its `enable_caching` does with numba's own
    kept: F = compiled
    return kept


@intrinsic  # type: ignore[untyped-decorator]
def float_pointer(context: Any, address: Any) -> Any:
    """In a kernel: pointer to the floats at an address, for `numba.carray`.

    An address reaches a kernel five times faster from Python than an array. Its array must outlive the call.
    """
    signature = numba.types.CPointer(numba.types.float64)(numba.types.intp)

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return builder.inttoptr(arguments[0], context.get_value_type(signature.return_type))

    return signature, generate
