"""Each limit of `vio inspect`, from both sides."""

from __future__ import annotations

from collections.abc import Callable
from types import SimpleNamespace
from typing import Any
from unittest.mock import patch

import cv2
import numpy as np
import pytest

from vio.calibration.findings import NotObservable
from vio.calibration.stereo import RowResiduals
from vio.inspection import inspect, pictures
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
    return not _rows_faults(found, alike=False)


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


def _is_still_while_it_speeds_up(radps2: float) -> bool:
    record = _record(10.0, 1e-6, 1e-3)
    record.gyro[:, 2] += radps2 * 0.01 * np.arange(len(record.gyro))
    return bool(still_windows(record)[0].mean() > 0.5)


def _matching(rows_px: float) -> int:
    """How many of 200 pairs are kept, 20 of which are off by some rows."""
    rng = np.random.default_rng(0)
    u, v = rng.uniform(0.0, 400.0, (2, 200))
    off = np.zeros(200)
    off[::10] = np.where(np.arange(20) % 2, rows_px, -rows_px)
    disparities = rng.uniform(2.0, 40.0, 200)
    left = [cv2.KeyPoint(float(x), float(y), 1.0) for x, y in zip(u, v, strict=True)]
    right = [
        cv2.KeyPoint(float(x), float(y), 1.0) for x, y in zip(u - disparities, v + off, strict=True)
    ]
    with patch.object(pictures, "sift_points", lambda a, b: list(zip(left, right, strict=True))):
        return len(pictures.sift_pairs(np.zeros((1, 1), np.uint8), np.zeros((1, 1), np.uint8)))


class _Read:
    """A recording without content that counts which frames are read, by how many at once."""

    def __init__(self, frames: int, step_ns: int = 10**8, kind: str = "folder") -> None:
        self.frames = frames
        self.single: set[int] = set()
        self.several: set[int] = set()
        camera = SimpleNamespace(
            kind="mono",
            width=None,
            height=None,
            fu=1.0,
            fv=1.0,
            cu=0.0,
            cv=0.0,
            baseline_fault=None,
        )
        self.recording: Any = SimpleNamespace(
            frame_times_ns=step_ns * np.arange(frames),
            has_images=True,
            camera=camera,
            kind=kind,
            motion=(),
            T_cam0_imu=None,
            reference=None,
            notes=(),
        )

    def events(self, first: int, end: int | None = None, images: bool = True) -> Any:
        if images:
            frames = set(range(self.frames)[first:end])
            (self.single if len(frames) == 1 else self.several).update(frames)
        return []

    def inspected(self) -> _Read:
        inspect.inspect_recording(self, lambda dataset: None)  # type: ignore[arg-type,return-value]
        return self

    def compared(self) -> _Read:
        with patch.object(inspect, "find_delay", lambda frames, camera: None):
            inspect._pairs_parts(self, range(self.frames))  # type: ignore[arg-type]
        return self


def _tracks_all_of_5_s(frames: int) -> bool:
    """Whether all frames of the first 5 s are tracked where a doubt wants them."""
    seen: Any = SimpleNamespace(motion=("imu",), notes=())
    times = np.round(np.arange(frames) * 4.999e9 / (frames - 1)).astype(np.int64)
    with patch.object(inspect, "doubts_among", lambda notes: ["a doubt"]):
        return inspect._frames_to_track(seen, times, 60) == frames


def _video_is_seen_to_its_end(frames: int) -> bool:
    dataset: Any = _Read(frames, kind="video")
    return inspect._last_looked_at(dataset, range(frames)) == frames - 1


LIMITS: dict[str, tuple[Says, float, float]] = {
    "images: flat": (lambda x: _exposed(128.5, x), 2.5, 3.5),
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
    "rest: speeds up": (lambda x: not _is_still_while_it_speeds_up(x), 0.12, 0.16),
    "matches: rows": (lambda x: _matching(x) < 190, 1.2, 1.8),
    "matches: few": (
        lambda n: not pictures._unmatched_part(NotObservable("rows", "few match"), [int(n)]).faults,
        19,
        20,
    ),
    "frames: looked at": (lambda n: len(_Read(int(n)).inspected().single) < n, 12, 13),
    "frames: tracked": (lambda n: len(_Read(int(n)).inspected().several) < n, 60, 61),
    "frames: tracked in doubt": (lambda n: not _tracks_all_of_5_s(int(n)), 200, 201),
    "frames: of a video": (lambda n: not _video_is_seen_to_its_end(int(n)), 300, 301),
    "pairs: window": (lambda n: len(_Read(int(n)).compared().several) > 0, 8, 9),
    "pairs: windows": (lambda n: len(_Read(int(n)).compared().several) < n, 48, 49),
    "IMU: rate": (_quick_enough, 45.0, 55.0),
}


@pytest.mark.parametrize(("says", "below", "above"), LIMITS.values(), ids=LIMITS)
def test_limits_of_inspection(says: Says, below: float, above: float) -> None:
    assert not says(below)
    assert says(above)


def test_noise_is_that_of_a_tenth_of_a_second_where_a_sensor_drifts() -> None:
    """A ramp of R per second has an Allan deviation of R tau / sqrt(2)."""
    record = _record(20.0, 1e-9, 1e-9)
    record.gyro[:] += 1e-4 * record.times_ns[:, None] * 1e-9
    part = noise_part(record, None)
    assert part is not None
    assert part.facts["gyro_density"] == pytest.approx(1e-4 * 0.1**1.5 / np.sqrt(2.0), rel=0.05)


def test_points_of_a_picture_are_limited() -> None:
    image = np.random.default_rng(0).integers(0, 255, (90, 120), dtype=np.uint8)
    image = cv2.resize(image, (480, 360), interpolation=cv2.INTER_CUBIC)
    assert 1300 < len(pictures.sift_points(image, image)) < 1700


def test_opencvs_random_numbers_stay_the_callers() -> None:
    """A seed set before the matching would start the caller's sequence anew, and serve nothing."""
    cv2.setRNGSeed(7)
    expected = cv2.randu(np.zeros((1, 3)), 0, 1).copy()
    cv2.setRNGSeed(7)
    assert _matching(0.0) == 200
    np.testing.assert_array_equal(cv2.randu(np.zeros((1, 3)), 0, 1), expected)
