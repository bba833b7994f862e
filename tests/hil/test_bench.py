"""The speed measurement: its rows, how its ratios are made, and that what it compares with does the same work."""

import numpy as np
import pytest

from hil.bench import aided, attitude, feeds, receive, strapdown
from hil.bench.strapdown import StrapdownRecord, c_two_sample
from hil.bench.timing import Sizes, Work, paired_ratio, rows_in_turns
from nav.strapdown import MECHANIZATIONS, Strapdown

KEYS = {"id", "what", "ns", "ratio_to_c", "peer", "peer_ns"}
SMALL = Sizes(repeats=2, batch=400, calls=3)


def test_the_c_reference_computes_the_same():
    function = c_two_sample()
    if function is None:
        pytest.skip("no C compiler")
    record = StrapdownRecord(4000)
    record.by(Strapdown("two-sample", "geographic"))
    ours = [array.copy() for array in record.out]
    for array in record.out:
        array.fill(np.nan)
    record.by_c(function)
    for mine, theirs, scale in zip(ours, record.out, (1e-14, 1e-9, 1e-14), strict=True):
        assert (np.abs(theirs - mine) <= scale * np.abs(mine).max(axis=0)).all()


def test_one_by_one_is_the_same_work():
    record, core = StrapdownRecord(50), Strapdown("two-sample", "wander")
    record.by(core)
    whole = core.solution.copy()
    core.start(*record.start)
    record.one_by_one(core, 50)
    np.testing.assert_array_equal(core.solution, whole)


def test_every_core_has_a_row_in_batch_and_per_call():
    rows = {row["id"]: row for row in strapdown.rows(SMALL)}
    for kind in ("strapdown", "strapdown-call"):
        for mechanization in MECHANIZATIONS:
            orders = (2,) if mechanization == "inertial-source" else (2, 4, 6)
            assert {f"{kind}-{n}-{mechanization}" for n in orders} <= set(rows)
    assert all(set(row) == KEYS and row["ns"] > 0.0 for row in rows.values())
    compared = {name for name, row in rows.items() if row["ratio_to_c"] is not None}
    if c_two_sample() is not None:
        assert rows["strapdown-c"]["ratio_to_c"] == 1.0
        assert {"strapdown-2-geographic", "strapdown-4-geographic", "strapdown-6-inertial"} <= compared
    assert not any("call" in name for name in compared)


def test_every_attitude_method_has_a_row_in_batch_and_per_call():
    rows = attitude.rows(SMALL)
    assert [row["id"] for row in rows] == [
        f"attitude-{kind}{name}" for name in attitude.NAMES for kind in ("", "call-")
    ]
    assert all(set(row) == KEYS and row["ns"] > 0.0 and row["peer_ns"] is None for row in rows)
    assert {"poisson-rk4", "coning:5", "coning-uncompressed:2", "high-order:8", "high-order-stream:4"} <= {
        *attitude.NAMES
    }


def test_a_ratio_is_of_one_turn_each():
    """The machine slows down between the two in one turn: their medians are 1 to 15, their turns 1 to 3."""
    assert paired_ratio([1.0, 1.0, 1.0, 5.0, 5.0], [3.0, 3.0, 15.0, 15.0, 15.0]) == pytest.approx(1.0 / 3.0)


def test_works_take_turns():
    done = []
    works = [
        Work("ours", "ours", lambda: done.append("ours"), 1, "peer", "theirs", "ours"),
        Work("theirs", "theirs", lambda: done.append("theirs"), 1),
    ]
    mine, theirs = rows_in_turns(works, 3)
    assert done == ["ours", "theirs"] * 4
    assert (mine["peer"], mine["ratio_to_c"]) == ("peer", 1.0)
    assert mine["peer_ns"] > 0.0
    assert (theirs["peer"], theirs["peer_ns"], theirs["ratio_to_c"]) == ("", None, None)


def test_a_missing_peer_leaves_no_trace():
    (row,) = rows_in_turns([Work("a", "a", lambda: None, 1, "absent", "b", "c")], 2)
    assert (row["peer"], row["peer_ns"], row["ratio_to_c"]) == ("", None, None)


@pytest.mark.socketcan
def test_receiving_has_its_rows_beside_python_can():
    rows = {row["id"]: row for row in receive.rows(SMALL)}
    for layout in receive.LAYOUTS:
        ours, theirs = rows[f"receive-socketcan-{layout}"], rows[f"receive-python-can-{layout}"]
        assert (ours["peer"], theirs["peer"]) == ("python-can", "")
        assert 0.0 < ours["ns"] < theirs["ns"]


def test_the_aided_loop_has_its_rows_and_every_measurement_is_taken():
    rows = {row["id"]: row for row in aided.rows(Sizes(repeats=1, batch=1, calls=60))}
    assert set(rows) == {"aided-core", "aided-27", "aided-27-beside", "aided-35", "aided-35-beside"}
    for states in (27, 35):
        assert rows[f"aided-{states}-beside"]["ns"] == rows[f"aided-{states}"]["ns"] - rows["aided-core"]["ns"]
    navigator = aided.AidedRecord(1000).aided(aided.STATES[35])
    taken = {(one.channel.name, one.accepted + one.rejected) for one in navigator.health}
    assert taken == {("GNSS_POSITION", 5), ("GNSS_VELOCITY", 5), ("BARO", 10), ("MAGNETIC", 25)}
    assert len(navigator.used) == 35


def test_the_feeds_have_a_row_for_each_lockstep():
    rows = feeds.rows(Sizes(repeats=2, batch=1, calls=20))
    assert [row["id"] for row in rows] == ["feed-json", "feed-px4"]
    assert all(set(row) == KEYS and row["ns"] > 0.0 for row in rows)
