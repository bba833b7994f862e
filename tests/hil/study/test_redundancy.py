"""The study of the head's redundancy, with a short flight in the place of the hour."""

import math

import pytest

from hil.study import study_names
from hil.study.redundancy import run


@pytest.mark.slow
def test_every_limit_is_kept():
    found = run(hour_s=20.0)
    assert [row for row in found.rows if not row.ok] == []
    ours = {row.id: row.ours for row in found.rows}
    assert len(ours) == len(found.rows) == 2 + 8 + 14
    # What nobody else measures cannot be found, and the study says so.
    assert [key for key, value in ours.items() if math.isinf(value)] == ["jump-orthogonal-g1x", "jump-orthogonal-g2z"]
    assert "redundancy" in study_names()
