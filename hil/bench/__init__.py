"""`hil bench`: what each part costs on this machine, in one run, beside its peers."""

from collections.abc import Callable

from hil.bench import aided, attitude, chain, feeds, instruments, receive, strapdown
from hil.bench.timing import Row, Sizes


def measure(say: Callable[[str], None], sizes: Sizes | None = None) -> list[Row]:
    """Rows ``{"id", "what", "ns", "ratio_to_c", "peer", "peer_ns"}``, ns a sample or a frame.

    `ratio_to_c` is the time over that of the two-sample core in C, where there is a C compiler. `peer` is one that is
    installed. See `hil.bench.timing.rows_in_turns` on how times and ratios are made.
    """
    say("compiling and measuring, about a minute")
    sizes = sizes or Sizes()
    return [
        *chain.rows(sizes),
        *receive.rows(sizes),
        *aided.rows(sizes),
        *strapdown.rows(sizes),
        *attitude.rows(sizes),
        *instruments.rows(sizes),
        *feeds.rows(sizes),
    ]
