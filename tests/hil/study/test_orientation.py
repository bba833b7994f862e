"""The study of the attitude methods, and the report that it writes."""

import json
import math
from xml.etree import ElementTree

import numpy as np
import pytest

from hil.study import study, study_names
from hil.study.orientation import run
from hil.study.orientation.measure import METHODS, errors, uniform
from hil.study.report import Line, Plot, Row, Study, at_most, near, shown, write
from nav import attitude
from nav.attitude.signals import Precession
from nav.errors import HilError

KEYS = {"id", "what", "published", "reference", "ours", "unit", "limit", "ok"}


@pytest.fixture(scope="module")
def result():
    return run()


def test_every_limit_is_kept(result):
    assert [row for row in result.rows if not row.ok] == []
    assert len({row.id for row in result.rows}) == len(result.rows)


def test_every_method_has_its_coning_table_and_its_orders(result):
    ids = {row.id for row in result.rows}
    families = {name.partition(":")[0].partition("[")[0] for name in attitude.NAMES} - {"two-sample"}
    assert {name.partition(":")[0] for name in METHODS} == families
    for name in METHODS:
        assert {f"coning-{cone}deg-{hz}hz-{name}" for cone in (1, 10) for hz in (1, 10, 74)} <= ids
        assert {f"order-{name}-equal", f"order-{name}-unequal"} <= ids


@pytest.mark.parametrize(
    ("id", "published"),
    [
        ("fomichev-peak", 2.5),
        ("fomichev-worst", 2.7),
        ("fomichev-worst-angle", 60.0),
        ("fomichev-1.5pi", 1.0),
        ("fomichev-pi", 0.15),
        ("fomichev-spin-4pi", 0.029),
        ("fomichev-spin-2pi", 0.03),
    ],
)
def test_published_figures_within_30_percent(result, id, published):
    row = next(row for row in result.rows if row.id == id)
    assert row.published == published
    assert row.ours == pytest.approx(published, rel=0.3)


def test_precession_error_peaks_in_the_middle_of_the_turn_and_vanishes_after_it():
    time, error = errors("four-sample", Precession(2 * math.pi, 2 * math.pi, math.pi / 4), uniform(1.0, 160.0))
    assert time[error.argmax()] == pytest.approx(0.5)
    assert error[-1] < 0.01 * error.max()
    assert (np.diff(error[:20]) > 0).all()
    assert (np.diff(error[20:]) < 0).all()


def test_growth_of_the_incommensurate_precession(result):
    """Not what the source says: the drift of one block, summed."""
    row = next(row for row in result.rows if row.id == "fomichev-growth")
    assert row.ours == pytest.approx(row.reference, rel=0.05)
    assert row.ours > 0.1


def test_study_writes_json_html_and_figures(tmp_path, result):
    rows = [row.as_dict() for row in result.rows]
    paths = write(result, tmp_path / "new" / "folder")
    names = {path.name for path in paths}
    assert {"orientation.json", "orientation.html", "orientation-time.svg", "orientation-angle.svg"} <= names
    data = json.loads((tmp_path / "new/folder/orientation.json").read_text())
    assert data["study"] == "orientation"
    assert data["rows"] == json.loads(json.dumps(rows))
    assert all(set(row) == KEYS for row in data["rows"])
    page = (tmp_path / "new/folder/orientation.html").read_text()
    assert page.count("<svg") == len(result.plots)
    assert "http://" not in page.replace("http://www.w3.org", "").replace("http://purl.org", "").replace(
        "http://creativecommons.org", ""
    )
    for path in paths:
        if path.suffix == ".svg":
            ElementTree.parse(path)


def test_registry(tmp_path):
    assert "orientation" in study_names()
    with pytest.raises(HilError, match="there is: orientation"):
        study("orientations")


def test_report_is_the_same_for_the_same_rows_and_escapes(tmp_path):
    x = np.arange(1.0, 4.0)
    rows = [
        near("a", "a < b & c", 1.1, '"', 0.2, published=1.0),
        near("b", "far", 2.0, "m", 0.5, reference=1.0),
        at_most("c", "goal", float("nan"), "m", 1.0),
        shown("d", "shown", 3.0, "m"),
    ]
    assert [row.ok for row in rows] == [True, False, False, True]
    made = Study(
        "small", "Small <study>", "About & more", rows, [Plot("p", "t", "x", "y", [Line("l", x, x)], log=True)]
    )
    assert not made.ok
    first = [path.read_bytes() for path in write(made, tmp_path)]
    assert first == [path.read_bytes() for path in write(made, tmp_path)]
    page = (tmp_path / "small.html").read_text()
    assert "a &lt; b &amp; c" in page
    assert "Small &lt;study&gt;" in page
    assert page.count('class="bad"') == 2
    parsed = json.loads((tmp_path / "small.json").read_text())
    assert parsed["rows"][2]["ours"] is None
    with pytest.raises(ValueError, match="near what"):
        near("e", "e", 1.0, "m", 1.0)
    blocked = tmp_path / "file"
    blocked.write_text("")
    with pytest.raises(HilError, match="cannot write"):
        write(made, blocked)
    assert isinstance(rows[0], Row)
