"""Assertions on a summary, and their JUnit report."""

import math
import xml.etree.ElementTree as ET

import pytest
from hypothesis import given
from hypothesis import strategies as st

from hil.assertions import parse, write_junit
from nav.errors import HilError

SUMMARY = {"lost": 0, "mode": "navigate", "error": {"position_m": {"max": 0.25, "rms": math.nan}}, "difference": None}


@pytest.mark.parametrize(
    ("text", "holds"),
    [
        ("lost == 0", True),
        ("lost==0", True),
        (" lost != 0 ", False),
        ("error.position_m.max < 0.5", True),
        ("error.position_m.max <= 0.25", True),
        ("error.position_m.max < 0.25", False),
        ("error.position_m.max > -1e-3", True),
        ("error.position_m.max >= 1e9", False),
        ("error.position_m.max < inf", True),
        ("mode == navigate", True),
        ("mode != navigate", False),
        ("mode == degraded", False),
        ("error.position_m.rms < 1", False),  # what is not a number satisfies no limit
        ("error.position_m.rms > 1", False),
        ("difference < 1", False),
        ("error < 1", False),
        ("mode < 1", False),
    ],
)
def test_outcomes(text, holds):
    failure = parse(text).failure(SUMMARY)
    assert (failure is None) == holds
    if failure:
        assert text in failure


@pytest.mark.parametrize("text", ["error.speed.max < 1", "lost.max == 0", "difference.total_deg.rms < 1", "Lost == 0"])
def test_a_missing_key_fails_and_says_what_there_is(text):
    failure = parse(text).failure(SUMMARY)
    assert "the summary has no" in failure
    assert "there is: " in failure


@pytest.mark.parametrize(
    "text",
    ["", "lost", "lost = 0", "lost == ", "== 0", "lost < many", "lost <> 0", "lost == 0 0", "0 == lost", "a < 1; b"],
)
def test_bad_forms_are_refused(text):
    with pytest.raises(HilError, match="assertion"):
        parse(text)


@given(
    st.floats(allow_nan=False),
    st.floats(allow_nan=False),
    st.sampled_from(["<", "<=", ">", ">=", "==", "!="]),
)
def test_relations_are_those_of_numbers(value, limit, relation):
    holds = eval(f"a {relation} b", {"a": value, "b": limit})
    assert (parse(f"x {relation} {limit!r}").failure({"x": value}) is None) == holds


def test_junit(tmp_path):
    checks = [(parse(text), parse(text).failure(SUMMARY)) for text in ("lost == 0", "lost < -1", "mode != navigate")]
    write_junit(tmp_path / "out.xml", "flight <&>", checks, 1.5)
    suite = ET.parse(tmp_path / "out.xml").getroot()
    assert (suite.get("tests"), suite.get("failures")) == ("3", "2")
    assert [case.get("name") for case in suite] == ["lost == 0", "lost < -1", "mode != navigate"]
    assert [case.find("failure") is not None for case in suite] == [False, True, True]
    with pytest.raises(HilError, match="junit"):
        write_junit(tmp_path / "no" / "out.xml", "x", checks, 0.0)
