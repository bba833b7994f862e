"""Compiled kernels on disk: a file for each kernel and signature, with what it was made of.

numba's own cache has an index for each kernel. Two processes that compile at the same time may there give one file to two
signatures, and one whose disk is full leaves the name of a new kernel on the code of an old one: every process then runs code
that was made for something else. And it asks only whether the file of a kernel has changed: a kernel of another file that is
compiled into it, or a constant from there, stays the old one. Here a file is whole or not used, and a kernel that cannot be
kept is compiled again by the next process.
"""

import hashlib
import os
import pickle
import sys
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from enum import Enum, EnumType
from functools import cache
from types import CodeType, ModuleType
from typing import Any

import numba
import numpy as np
from numba.core import types
from numba.core.caching import FunctionCache
from numba.core.serialize import dumps

_PLAIN = (bool, int, float, complex, str, bytes, type(None), np.generic, np.dtype, types.Type)
_VERSIONED = {"numba", "numpy", "math", "builtins"}
"""What is compiled in from here changes with numba's version."""
_DIGEST = 32


class KernelCache(FunctionCache):  # type: ignore[misc]
    """What the dispatcher of `function`, compiled with `options`, takes for its cache."""

    def __init__(self, function: Callable[..., Any], options: Mapping[str, Any]) -> None:
        super().__init__(function)
        self._made_by = (numba.__version__, self._impl.locator.get_source_stamp(), sorted(options.items()))

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        """The compiled kernel for a signature; None when there is none."""
        target_context.refresh()
        try:
            with open(self._path(sig), "rb") as file:
                key, check, kept = file.read(_DIGEST), file.read(_DIGEST), file.read()
        except OSError:
            return None
        if key != self._key(sig, target_context.codegen()) or check != _digest(kept):
            return None
        return self._impl.rebuild(target_context, pickle.loads(kept))

    def save_overload(self, sig: Any, data: Any) -> None:
        """Keep a compiled kernel where there is room."""
        if not self._impl.check_cachable(data):
            return
        kept = dumps(self._impl.reduce(data))
        path = self._path(sig)
        own = f"{path}.{os.getpid()}"
        try:
            self._impl.locator.ensure_cache_path()
            with open(own, "wb") as file:
                file.write(self._key(sig, data.codegen) + _digest(kept) + kept)
            os.replace(own, path)
        except OSError:
            with suppress(OSError):
                os.unlink(own)

    def _path(self, sig: Any) -> str:
        return os.path.join(self.cache_path, f"{self._impl.filename_base}.{_digest(_signature(sig)).hex()[:16]}.nbk")

    def _key(self, sig: Any, codegen: Any) -> bytes:
        return _digest(repr((_signature(sig), codegen.magic_tuple(), self._made_by, made_of(self._py_func))).encode())


@cache
def made_of(function: Callable[..., Any]) -> str:
    """Digest of a kernel, the kernels that it calls and the constants that are compiled into it, the same in every process."""
    return _digest("\0".join(_parts(function, set())).encode()).hex()


def _digest(data: bytes) -> bytes:
    return hashlib.sha256(data).digest()


def _signature(kinds: Any) -> bytes:
    """The types of arguments; a named tuple's name alone does not say what its fields are called."""
    return repr(
        [(kind, getattr(kind, "fields", ()), _signature(getattr(kind, "types", ()))) for kind in kinds]
    ).encode()


def _parts(function: Callable[..., Any], seen: set[Any]) -> Iterator[str]:
    if function in seen:
        return
    seen.add(function)
    names: list[str] = []
    yield from _code(function.__code__, names)
    cells = [cell.cell_contents for cell in function.__closure__ or ()]
    for value in [function.__defaults__, *cells, *_named(function.__globals__, names)]:
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
        yield repr(sorted(value.targetoptions.items()))
        yield from _parts(value.py_func, seen)
    else:
        module = str(getattr(value, "__module__", ""))
        yield f"{module}.{getattr(value, '__qualname__', type(value).__qualname__)}"
        yield _file(module)


@cache
def _file(module: str) -> str:
    """Digest of the source of what numba asks to be compiled in (intrinsics, overloads)."""
    path = getattr(sys.modules.get(module), "__file__", None)
    if path is None or module.partition(".")[0] in _VERSIONED:
        return ""
    with suppress(OSError), open(path, "rb") as file:
        return _digest(file.read()).hex()
    return ""
