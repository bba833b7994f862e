"""Frames of a board that make no sample: counted, and what is lacking in them.

A board of which one message is switched off sends without end what nobody can use. Its frames wait to be part of a sample; once
they have waited for `WAIT_NS` they are counted, and the user can be told which kind never came.
"""

from collections.abc import Iterable

from nav.increments import IntArray
from nav.kernel import inline_kernel

WAIT_NS, ENOUGH = 3_000_000_000, 10
"""How long, and how many frames, without a sample."""
HEARD, SINCE_NS, WAITING, LACKS, LACK = range(5)
"""Of the state: kinds since the last sample as bits, arrival of the first of them, frames not yet counted, whether it was too
long; its size."""


@inline_kernel
def wait(what: int, arrival_ns: int, lack: IntArray) -> int:
    """Take a frame of kind `what` that a sample may be made of; how many are to be counted as useless now."""
    if lack[HEARD] == 0:
        lack[SINCE_NS] = arrival_ns
    lack[HEARD] |= 1 << what
    lack[WAITING] += 1
    if lack[LACKS] == 0 and (lack[WAITING] < ENOUGH or arrival_ns - lack[SINCE_NS] < WAIT_NS):
        return 0
    useless = int(lack[WAITING])
    lack[WAITING], lack[LACKS] = 0, 1
    return useless


@inline_kernel
def again(lack: IntArray) -> int:
    """The frame that was taken last is one that came twice, and counted as that; how many it was counted as useless."""
    if lack[WAITING] == 0:
        return 1
    lack[WAITING] -= 1
    return 0


@inline_kernel
def made(lack: IntArray) -> None:
    """A sample was made."""
    lack[:] = 0


def told(lack: IntArray, wanted: Iterable[tuple[int, str]]) -> str:
    """What is lacking: of `wanted` (bits of the kinds that will do, name) those not heard; empty while samples are made."""
    if not lack[LACKS]:
        return ""
    names = [name for kinds, name in wanted if not lack[HEARD] & kinds]
    if not names:
        return "no sample is whole: does one board send all its messages at one rate, or do two send the same?"
    verb, them = ("does", "it") if len(names) == 1 else ("do", "them")
    return f"{' and '.join(names)} {verb} not come: switch {them} on"
