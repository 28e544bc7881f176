"""Each limit of `vio inspect`, from both sides."""

from __future__ import annotations

from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from vio.calibration.stereo import RowResiduals
from vio.inspection.inertial import noise_part, still_windows
from vio.inspection.inspect import clock_facts, clock_part
from vio.inspection.pictures import _is_distinct, _rows_faults, depths_part, images_part
from vio.records import Image, ImuDensities, ImuRecord, StereoFrame

Says = Callable[[float], bool]


def _image(mean: float, spread: float, seed: int) -> Image:
    signs = np.sign(np.random.default_rng(seed).normal(size=(60, 80)))
    return np.clip(np.round(mean + spread * signs + 0.0), 0, 255).astype(np.uint8)


def _exposed(mean: float, spread: float) -> bool:
    frame = StereoFrame(0, 0, _image(mean, spread, 0), _image(mean, spread, 1))
    return not images_part([frame]).faults


def _depth_fits(depth_m: float) -> bool:
    depth = np.full((20, 20), depth_m)
    return not depths_part([StereoFrame(0, 0, None, None, depth)]).faults


def _rows_fit(rows_px: float = 0.0, positive: float = 1.0) -> bool:
    found = RowResiduals(
        matches=500,
        median_px=rows_px,
        spread_px=0.0,
        positive_disparity=positive,
        grid_px=np.zeros((5, 5)),
        rms_px=rows_px,
        disparity_px=10.0,
    )
    return not _rows_faults(found)


def _distinct(ratio: float) -> bool:
    nearest: Any = [SimpleNamespace(distance=ratio), SimpleNamespace(distance=1.0)]
    return _is_distinct(nearest)


def _record(
    seconds: float, gyro: float = 1e-3, accel: float = 1e-2, moved: float = 0.0
) -> ImuRecord:
    """Readings at 100 Hz with noise; from the end of the given time on it moves."""
    rng = np.random.default_rng(0)
    count = round(100 * (seconds + 2.0))
    turn = np.where(np.arange(count) < 100 * seconds, 0.0, 1.0)[:, None]
    waves = turn * np.sin(0.4 * np.arange(count))[:, None]
    return ImuRecord(
        10_000_000 * np.arange(count),
        gyro * rng.normal(size=(count, 3)) + moved * waves,
        accel * rng.normal(size=(count, 3)) + [0.0, 0.0, 9.81] + 10.0 * moved * waves,
    )


def _is_still(gyro: float = 1e-3, accel: float = 1e-2) -> bool:
    return bool(still_windows(_record(10.0, gyro, accel))[0].mean() > 0.5)


def _has_noise(seconds: float) -> bool:
    return noise_part(_record(seconds, moved=1.0), None) is not None


def _off_sheet(factor: float) -> bool:
    record = _record(20.0, 1e-2, 1e-2)
    sheet = ImuDensities(1e-3 / factor, 1e-5, 1e-3, 1e-4)
    part = noise_part(record, sheet)
    assert part is not None
    return "state the measured one" in part.text


def _gaps(steps: float) -> int:
    times = np.concatenate([np.arange(50), 49 + steps + np.arange(50)]) * 1e7
    return int(clock_facts(times.astype(np.int64))["gaps"] or 0)


def _quick_enough(rate_hz: float) -> bool:
    frames = np.arange(0, 10**10, 10**8)
    times = np.arange(0, 10**10 + 10**8, round(1e9 / rate_hz))
    return not clock_part("IMU", frames, times).faults


LIMITS: dict[str, tuple[Says, float, float]] = {
    "images: flat": (lambda x: _exposed(128.0, x), 2.0, 4.0),
    "images: dark": (lambda x: _exposed(x, 5.0), 11.0, 13.0),
    "images: bright": (lambda x: not _exposed(x, 5.0), 240.0, 246.0),
    "depth: near": (_depth_fits, 0.09, 0.11),
    "depth: far": (lambda x: not _depth_fits(x), 27.0, 33.0),
    "rows: off": (lambda x: not _rows_fit(x), 1.8, 2.2),
    "rows: in front": (lambda x: _rows_fit(positive=x), 0.45, 0.55),
    "matches: distinct": (lambda x: not _distinct(x), 0.75, 0.85),
    "rest: gyro": (lambda x: not _is_still(gyro=x / np.sqrt(3.0)), 0.017, 0.024),
    "rest: accelerometer": (lambda x: not _is_still(accel=x / np.sqrt(3.0)), 0.13, 0.18),
    "rest: time": (_has_noise, 2.6, 3.4),
    "noise: off the sheet": (_off_sheet, 2.4, 3.6),
    "stamps: gap": (lambda x: _gaps(x) > 0, 1.35, 1.65),
    "IMU: rate": (_quick_enough, 45.0, 55.0),
}


@pytest.mark.parametrize(("says", "below", "above"), LIMITS.values(), ids=LIMITS)
def test_limits_of_inspection(says: Says, below: float, above: float) -> None:
    assert not says(below)
    assert says(above)
