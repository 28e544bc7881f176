"""The frames of a recording, and two recordings compared bit by bit."""

from __future__ import annotations

import numpy as np

from vio.protocols import Dataset
from vio.records import ImuSample, StereoFrame


def frames_of(dataset: Dataset, start: int = 0, stop: int | None = None) -> list[StereoFrame]:
    """The frames of a range."""
    return [event for event in dataset.events(start, stop) if isinstance(event, StereoFrame)]


def assert_same_events(a: Dataset, b: Dataset, start: int = 0, stop: int | None = None) -> None:
    """Every frame and sample of the two recordings has the same bits."""
    ours, theirs = list(a.events(start, stop)), list(b.events(start, stop))
    assert [(type(x), x.time_ns) for x in ours] == [(type(x), x.time_ns) for x in theirs]
    for x, y in zip(ours, theirs, strict=True):
        if isinstance(x, StereoFrame) and isinstance(y, StereoFrame):
            assert x.index == y.index
            np.testing.assert_array_equal(x.left, y.left)
            np.testing.assert_array_equal(x.right, y.right)
        elif isinstance(x, ImuSample) and isinstance(y, ImuSample):
            np.testing.assert_array_equal([x.gyro, x.accel], [y.gyro, y.accel])
