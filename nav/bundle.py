"""Many arrays and numbers that kernels take as one argument: handing each over by itself costs more than what most kernels do."""

from typing import Any

from numba import types
from numba.experimental import structref
from numba.extending import overload

from nav.kernel import kernel


@structref.register
class _BundleType(types.StructRef):  # type: ignore[misc]
    """Its one field, `parts`, is a tuple, of tuples maybe."""


class Bundle(structref.StructRefProxy):  # type: ignore[misc]
    """What a kernel finds as the tuple ``bundle.parts``; made by `bundle`, and never changed but in its arrays."""

    parts: tuple[Any, ...]


structref.define_boxing(_BundleType, Bundle)


def _made(parts: tuple[Any, ...]) -> Any:
    raise NotImplementedError  # pragma: no cover - what kernels call is below


@overload(_made)  # type: ignore[untyped-decorator]
def _compile_made(parts: Any) -> Any:
    kind = _BundleType([("parts", parts)])

    def make(parts: Any) -> Any:
        made = structref.new(kind)
        made.parts = parts
        return made

    return make


@kernel
def bundle(parts: tuple[Any, ...]) -> Bundle:
    """The tuple `parts` of arrays, numbers and such tuples as a `Bundle`."""
    made: Bundle = _made(parts)
    return made
