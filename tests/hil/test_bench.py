"""What the speed measurement compares with does the same work."""

import numpy as np
import pytest

from hil.bench import StrapdownRecord, c_two_sample
from nav.strapdown import Strapdown


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
