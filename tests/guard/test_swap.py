"""What is said of left and right images that look exchanged."""

from __future__ import annotations

import pytest

from vio.errors import DataError
from vio.guard.probe import RowProbe
from vio.guard.swap import SwapDetector


@pytest.mark.parametrize("rows", [0, -7])
def test_rows_that_are_off_are_another_cause(rows: int) -> None:
    """Raw images with the calibration of rectified ones have negative disparities as well."""
    probe = RowProbe()
    probe._rows = rows
    detector = SwapDetector(probe)
    for index in range(2):
        detector.check(index, 80, 10, lambda: 60)
    with pytest.raises(DataError, match="look swapped") as caught:
        detector.check(2, 80, 10, lambda: 60)
    assert ("rows differ by 14 px, these are raw images" in str(caught.value)) is bool(rows)
