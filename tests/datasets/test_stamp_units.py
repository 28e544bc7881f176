"""Stamps in another unit than nanoseconds are named in the first frames, in place of a pose that
stays at zero.
"""

from __future__ import annotations

import numpy as np
import pytest

from vio.errors import DataError
from vio.geometry.stereo import StereoCamera
from vio.live.inputs import Inputs

IMAGE = np.zeros((8, 8), dtype=np.uint8)


def _inputs() -> Inputs:
    camera = StereoCamera(8.0, 8.0, 4.0, 4.0, 0.1)
    return Inputs(camera, (None, None), "imu", 0, None, lambda line: None)


@pytest.mark.parametrize("step", [1, 50, 50_000])  # numbers, ms and us of a camera of 20 Hz
def test_frames_in_another_unit_are_refused(step: int) -> None:
    inputs = _inputs()
    for k in range(3):
        inputs.images(k * step, IMAGE, IMAGE)
    with pytest.raises(DataError, match="give integer nanoseconds"):
        inputs.images(3 * step, IMAGE, IMAGE)


@pytest.mark.parametrize("step", [1, 5, 5000])  # numbers, ms and us of an IMU of 200 Hz
def test_samples_in_another_unit_are_refused(step: int) -> None:
    inputs = _inputs()
    for k in range(3):
        inputs.samples("imu", k * step, np.zeros(3), np.zeros(3))
    with pytest.raises(DataError, match="give integer nanoseconds"):
        inputs.samples("imu", 3 * step, np.zeros(3), np.zeros(3))
    times = step * np.arange(10)
    with pytest.raises(DataError, match="give integer nanoseconds"):
        _inputs().samples("imu", times, np.zeros((10, 3)), np.zeros((10, 3)))


def test_fast_sensors_and_frames_that_share_an_arrival_are_taken() -> None:
    inputs = _inputs()
    times_ns = [0, 100_000, 200_000, 50_000_000, 50_100_000, 50_200_000, 50_300_000]
    assert all(inputs.images(t, IMAGE, IMAGE) is not None for t in times_ns)
    fast_ns = 31_250 * np.arange(10)  # 32 kHz
    assert len(_inputs().samples("imu", fast_ns, np.zeros((10, 3)), np.zeros((10, 3)))) == 10
