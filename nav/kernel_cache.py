"""Compiled kernels on disk: numba's cache, but safe among processes, and aware of what a kernel is made of.

By itself numba gives one file name to two signatures when two processes compile them at the same time. From then on every process
runs, for one of them, machine code that was made for the other one's arguments. And it asks only whether the file of a kernel has
changed: a kernel of another file that is compiled into it, or a constant from there, stays the old one.
"""

import fcntl
import hashlib
import os
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from enum import Enum, EnumType
from functools import cache
from types import CodeType, ModuleType
from typing import Any

import numpy as np
from numba.core.caching import FunctionCache

_LOCK = "kernels.lock"
_PLAIN = (bool, int, float, complex, str, bytes, type(None), np.generic, np.dtype)


class KernelCache(FunctionCache):  # type: ignore[misc]
    """What numba's dispatchers take for their cache."""

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        """The compiled kernel for a signature; None when there is none."""
        with self._locked(fcntl.LOCK_SH):
            return super().load_overload(sig, target_context)

    def save_overload(self, sig: Any, data: Any) -> None:
        """Keep a compiled kernel."""
        with self._locked(fcntl.LOCK_EX):
            super().save_overload(sig, data)

    def _index_key(self, sig: Any, codegen: Any) -> tuple[Any, ...]:
        return (*super()._index_key(sig, codegen), *_fields(sig), digest(self._py_func))

    @contextmanager
    def _locked(self, how: int) -> Iterator[None]:
        """No other process writes into the folder, or with LOCK_EX reads from it."""
        descriptor = -1
        with suppress(OSError):  # no leave, or a file system without locks: as numba does it
            os.makedirs(self.cache_path, exist_ok=True)
            descriptor = os.open(os.path.join(self.cache_path, _LOCK), os.O_RDONLY | os.O_CREAT | os.O_CLOEXEC, 0o644)
            fcntl.flock(descriptor, how)
        try:
            yield
        finally:
            if descriptor >= 0:
                with suppress(OSError):
                    fcntl.flock(descriptor, fcntl.LOCK_UN)  # a child that was forked meanwhile would hold it
                os.close(descriptor)


@cache
def digest(function: Callable[..., Any]) -> str:
    """Digest of a kernel, the kernels that it calls and the constants that are compiled into it, the same in every process."""
    found = hashlib.sha256()
    for part in _parts(function, set()):
        found.update(part.encode())
        found.update(b"\0")
    return found.hexdigest()


def _fields(types: Any) -> Iterator[tuple[str, ...]]:
    """Names of the fields of the named tuples among numba's types; to numba the class is all that counts."""
    for kind in types:
        yield getattr(kind, "fields", ())
        yield from _fields(getattr(kind, "types", ()))


def _parts(function: Callable[..., Any], seen: set[Any]) -> Iterator[str]:
    if function in seen:
        return
    seen.add(function)
    names: list[str] = []
    yield from _code(function.__code__, names)
    cells = [cell.cell_contents for cell in function.__closure__ or ()]
    for value in [*cells, *_named(function.__globals__, names)]:
        yield from _value(value, seen)


def _code(code: CodeType, names: list[str]) -> Iterator[str]:
    """Instructions and constants; the names that are looked up go into `names`."""
    yield code.co_code.hex()
    names += code.co_names
    for constant in code.co_consts:
        if isinstance(constant, CodeType):
            yield from _code(constant, names)
        else:
            yield from _value(constant, set())


def _named(scope: dict[str, Any], names: list[str]) -> Iterator[Any]:
    """What the names stand for, attributes of modules among them."""
    known = [scope[name] for name in names if name in scope]
    yield from known
    for module in known:
        if isinstance(module, ModuleType):
            yield from (vars(module)[name] for name in names if name in vars(module))


def _value(value: Any, seen: set[Any]) -> Iterator[str]:
    if isinstance(value, _PLAIN):
        yield repr(value)
    elif isinstance(value, np.ndarray):
        yield f"{value.dtype}{value.shape}{value.tobytes().hex()}"
    elif isinstance(value, tuple | list):
        for part in value:
            yield from _value(part, seen)
    elif isinstance(value, frozenset):
        yield from sorted(map(repr, value))
    elif isinstance(value, EnumType):
        members: Mapping[str, Enum] = value.__members__
        yield repr([(name, member.value) for name, member in members.items()])
    elif hasattr(value, "py_func"):
        yield from _parts(value.py_func, seen)
    else:
        yield f"{getattr(value, '__module__', '')}.{getattr(value, '__qualname__', type(value).__qualname__)}"
