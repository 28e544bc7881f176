"""A limit on the frame rate: which frames are used, that the others are not read, and the same
poses live.
"""

from __future__ import annotations

import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tests.datasets.test_datasets_videos import make_videos
from tests.filters.test_msckf import CAMERA, STEP_NS, T_CAM0_IMU, Flight
from tests.same_events import frames_of
from vio.bench.worker import _Truth, _used
from vio.cli import main
from vio.config import Config, load_config
from vio.datasets import DatasetSettings, open_dataset
from vio.datasets.frame_times import FrameRateLimit
from vio.errors import DataError
from vio.live.odometry import Odometry
from vio.monitor.run import RunMonitor
from vio.records import StereoFrame
from vio.runs.pipeline import run

TEN = DatasetSettings(max_frame_rate=10.0)


@pytest.mark.parametrize(
    ("rate_hz", "most_hz", "every"),
    [(20, 10, 2), (20.02, 10, 2), (30, 10, 3), (29.97, 10, 3), (15, 10, 2), (10, 10, 1)],
)
def test_a_multiple_of_the_interval_is_kept(rate_hz: float, most_hz: float, every: int) -> None:
    jitter = np.random.default_rng(0).uniform(-2e6, 2e6, 60)
    limit = FrameRateLimit(most_hz)
    taken = [k for k, t in enumerate(np.arange(60) * 1e9 / rate_hz + jitter) if limit.takes(int(t))]
    assert taken == list(range(0, 60, every))


def test_frames_left_out_are_not_read(flight: Path, tmp_path: Path) -> None:
    folder = tmp_path / "f"
    shutil.copytree(flight, folder)
    for camera in ("cam0", "cam1"):
        for file in sorted((folder / "mav0" / camera / "data").iterdir())[1::2]:
            file.write_bytes(b"no image")
    found = frames_of(open_dataset(folder, TEN))
    assert [e.index for e in found] == list(range(0, 16, 2))
    whole = {e.index: e for e in open_dataset(flight).events() if isinstance(e, StereoFrame)}
    for frame in found:
        np.testing.assert_array_equal(frame.right, whole[frame.index].right)


def _cut_bag(flight: Path, folder: Path) -> Path:
    pytest.importorskip("rosbags")
    from tests.datasets.test_datasets_bags import bag_of

    return bag_of(open_dataset(flight), "mcap", folder / "f")


def _one_camera(flight: Path, folder: Path) -> Path:
    shutil.copytree(flight, folder / "f", ignore=shutil.ignore_patterns("cam1"))
    return folder / "f"


RECORDINGS: dict[str, Callable[[Path, Path], Path]] = {
    "videos": lambda flight, folder: make_videos(flight, folder / "v"),
    "bag": _cut_bag,
    "one camera": _one_camera,
}


@pytest.mark.parametrize("name", RECORDINGS)
def test_every_reader_leaves_the_same_frames_out(name: str, flight: Path, tmp_path: Path) -> None:
    path = RECORDINGS[name](flight, tmp_path)
    calibration = flight if name == "bag" else None
    whole = open_dataset(path, DatasetSettings(calibration=calibration))
    cut = open_dataset(path, DatasetSettings(calibration=calibration, max_frame_rate=10.0))
    frames = {e.index: e for e in whole.events() if isinstance(e, StereoFrame)}
    found = frames_of(cut, 3, 12)
    # the frames that a run from the first one on takes
    assert [e.index for e in found] == [4, 6, 8, 10]
    for frame in found:
        np.testing.assert_array_equal(frame.left, frames[frame.index].left)


def test_a_range_that_the_limit_empties_is_an_error(flight: Path) -> None:
    with pytest.raises(DataError, match=r"dataset.max_frame_rate 10 leaves no frame of 5 to 6"):
        list(open_dataset(flight, TEN).events(5, 6))


def test_a_live_run_leaves_out_what_a_recorded_one_does() -> None:
    """The same poses as from half of the frames, given to an odometry without a limit."""
    every, half = (
        Odometry(CAMERA, replace(Config(), dataset=settings), T_cam0_imu=T_CAM0_IMU)
        for settings in (DatasetSettings(), TEN)
    )
    flight, noise = Flight(frames=21), np.random.default_rng(3)
    samples = flight.imu(noise, np.zeros(6))
    for k in range(20):
        seen = flight.observe(k, 0.3, noise)
        for odometry in (every, half):
            for s in samples:
                if (k - 1) * STEP_NS < s.time_ns <= k * STEP_NS:
                    odometry.add_imu(s.time_ns, s.gyro, s.accel)
        assert (half.add_observations(k * STEP_NS, seen.ids, seen.z) is None) == (k % 2 == 1)
        if k % 2 == 0:
            every.add_observations(k * STEP_NS, seen.ids, seen.z)
    np.testing.assert_array_equal(every.estimate.T_world_imu, half.estimate.T_world_imu)
    assert half.estimate.time_ns == 18 * STEP_NS


def test_the_summary_says_how_many_frames_were_used(
    flight: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert (
        main(["run", str(flight), "--config", "fast", "--out", str(tmp_path / "r"), "--quiet"]) == 0
    )
    assert "8 of 15, path" in capsys.readouterr().out


def test_any_dataset_of_a_run_takes_the_frames_counted_from_the_first(flight: Path) -> None:
    """Also one that was opened without the limit, and from a frame on that is left out."""
    config = replace(load_config("fast"), motion="none")
    result = run(open_dataset(flight), config, start=3, stop=12)
    assert [f.index for f in result.frames] == [4, 6, 8, 10]


def test_an_inspection_may_look_at_any_frame(flight: Path) -> None:
    assert main(["inspect", str(flight), "--config", "fast", "--json"]) in (0, 1)


def test_refused_frames_in_a_row_are_one_line(caplog: pytest.LogCaptureFixture) -> None:
    monitor = RunMonitor(CAMERA, T_CAM0_IMU, imu=False)
    for index in (0, 2, 4, 6):
        monitor.repeats(StereoFrame(index, index * STEP_NS, None, None), None)
        if index > 0:
            monitor.refused(index, "left and right look swapped")
    assert len(monitor.lines) == 1
    monitor.repeats(StereoFrame(8, 8 * STEP_NS, None, None), None)
    monitor.repeats(StereoFrame(10, 10 * STEP_NS, None, None), None)
    monitor.refused(10, "left and right look swapped")
    assert len(monitor.lines) == 2


def test_coverage_is_of_the_frames_that_are_used(flight: Path) -> None:
    dataset = open_dataset(flight)
    times_ns = dataset.recording.frame_times_ns
    used = _used(_Truth(dataset, None, 3, 12), replace(Config(), dataset=TEN))
    np.testing.assert_array_equal(used, times_ns[[4, 6, 8, 10]])
