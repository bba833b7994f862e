"""Damage to valid input, spelled by bytes: the same bytes always do the same, fewer bytes do less."""

from collections.abc import Callable, Sequence

_WORDS = (
    b"\x00" * 8,
    b"\xff" * 8,
    b"\x7f" + b"\xff" * 7,
    b"\x80" + b"\x00" * 7,
    b"nan",
    b"1e999",
    b"9" * 400,
    b"[" * 2000,
)
EDIT = 4
"""Bytes that spell one edit."""


def edited(seeds: Sequence[bytes], script: bytes) -> bytes:
    """The seed that the first byte of `script` names, with an edit for each four bytes that follow."""
    data = seeds[script[0] % len(seeds)] if script else seeds[0]
    for k in range(1, len(script) - EDIT + 1, EDIT):
        op, high, low, value = script[k : k + EDIT]
        at = (high << 8 | low) % (len(data) + 1)
        data = data[:at] + _patch(op, value, data, at, seeds)
    return data


def _patch(op: int, value: int, data: bytes, at: int, seeds: Sequence[bytes]) -> bytes:
    """What stands from `at` on after an edit."""
    rest = data[at:]
    word = _WORDS[value % len(_WORDS)]
    edits: tuple[Callable[[], bytes], ...] = (
        lambda: bytes([value]) + rest[1:],
        lambda: bytes([rest[0] ^ 1 << value % 8]) + rest[1:] if rest else rest,
        lambda: rest[value:],
        lambda: bytes([value]) * (op // 9 + 1) + rest,
        lambda: rest[:value] * 2 + rest[value:],
        lambda: b"",
        lambda: word + rest[len(word) if value & 128 else 0 :],
        lambda: seeds[value % len(seeds)][min(at, 1) :],
        lambda: rest[value:] + rest[:value],
    )
    return edits[op % len(edits)]()
