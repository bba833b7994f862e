"""Every parser takes 10 000 damaged inputs in CI: nothing but `HilError` leaves it, nothing hangs, memory stays bounded.

An input is one of the target's valid seeds with the edits that drawn bytes spell.
"""

import os
import resource
import signal
from collections.abc import Iterator
from typing import Any

import pytest
from fuzz.edits import EDIT, edited
from fuzz.targets import TARGETS, Target
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from nav.errors import HilError

EXAMPLES = 10_000 if os.environ.get("CI") else 500
HANG_S = 30.0
"""No input takes a thousandth of it; what takes it all hangs."""
GROWTH_KIB = 256 << 10
"""All inputs of a target together need less memory than this beyond what its first ones do."""


@pytest.fixture(params=TARGETS)
def target(request: pytest.FixtureRequest) -> Iterator[Target]:
    """Each target, under a watch that ends what hangs."""

    def hangs(*_: Any) -> None:
        raise TimeoutError(f"one input takes {request.param} more than {HANG_S:g} s")

    made: Target = TARGETS[request.param]()
    before = signal.signal(signal.SIGALRM, hangs)
    yield made
    signal.setitimer(signal.ITIMER_REAL, 0.0)
    signal.signal(signal.SIGALRM, before)


def test_seeds_are_valid(target: Target) -> None:
    for seed in target.seeds:
        target.take(seed)


def test_damaged_input_does_no_harm(target: Target) -> None:
    for seed in target.seeds:
        target.take(seed)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss

    @settings(max_examples=EXAMPLES, database=None, suppress_health_check=[*HealthCheck])
    @given(st.binary(max_size=1 + 6 * EDIT))
    def damaged(script: bytes) -> None:
        signal.setitimer(signal.ITIMER_REAL, HANG_S)
        try:
            target.take(edited(target.seeds, script))
        except HilError:
            pass

    damaged()
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < GROWTH_KIB
