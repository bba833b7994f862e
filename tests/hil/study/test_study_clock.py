"""The study of a device's clock."""

from hil.study import study_names
from hil.study.clock import TRANSPORTS, run


def test_every_limit_is_kept() -> None:
    found = run()
    assert [row for row in found.rows if not row.ok] == []
    ours = {row.id: row.ours for row in found.rows}
    assert len(ours) == len(found.rows) == 4 * len(TRANSPORTS) + 4 * 2 + 4 * 2
    assert all(ours[f"error-{name}"] <= 3.0 * ours[f"bound-{name}"] for name in TRANSPORTS), "no bound by luck"
    assert "clock" in study_names()
