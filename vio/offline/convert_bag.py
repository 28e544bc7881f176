"""Write any recording of images as a ROS 2 bag: streamed, rectified as a run sees them."""

from __future__ import annotations

import heapq
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from vio.datasets.bags.writer import BagWriter, Storage, bag_writer
from vio.geometry.lie import FloatArray, se3_from_parts, se3_inverse
from vio.protocols import Dataset, Progress
from vio.records import Event, ImuSample, Recording, StereoFrame, Trajectory, VelocitySample

_WORLD, _LEFT, _RIGHT, _IMU = "world", "cam0", "cam1", "imu"


@dataclass(slots=True)
class BagCounts:
    """What went into the bag."""

    frames: int = 0
    imu_samples: int = 0
    velocities: int = 0

    def notes(self, recording: Recording) -> list[str]:
        """Return what a reader of the bag must be given."""
        if not self.velocities:
            return []
        if recording.T_cam0_imu is None:
            return ["velocities need the pose of their sensor in the camera, which this recording does not have"]
        if self.imu_samples:
            return ["a run reads the IMU alone; for the velocities as well: --topics velocity=/velocity"]
        return []


@dataclass(frozen=True, slots=True)
class _Pose:
    """A pose of the ground truth."""

    time_ns: int
    T_world_body: FloatArray  # (4, 4)


def write_bag(
    dataset: Dataset, out: Path, storage: Storage, start: int, stop: int | None, progress: Progress
) -> BagCounts:
    """Write a range of a recording as a bag; the arguments are those of `convert`.

    Topics: /left/image_rect, /right/image_rect and their camera_info, /imu, /velocity, /ground_truth, /tf_static.

    Raises:
        MissingDependencyError: rosbags is not installed.
        DataError: too many images are unreadable, or the bag cannot be written.
    """
    recording, counts = dataset.recording, BagCounts()
    count = len(recording.frame_times_ns)
    total = (count if stop is None else min(stop, count)) - start
    with bag_writer(out, storage) as bag:
        for k, event in enumerate(_in_order(dataset, start, stop)):
            if k == 0:
                bag.static_transforms(event.time_ns, _frames(recording))
            if isinstance(event, StereoFrame):
                _write_frame(bag, recording, event)
                counts.frames += 1
                progress(counts.frames, total)
            elif isinstance(event, ImuSample):
                bag.imu("/imu", _IMU, event)
                counts.imu_samples += 1
            elif isinstance(event, VelocitySample):
                bag.twist("/velocity", _IMU, event)
                counts.velocities += 1
            else:
                bag.pose("/ground_truth", _WORLD, event.time_ns, event.T_world_body)
    return counts


def _in_order(dataset: Dataset, start: int, stop: int | None) -> Iterator[Event | _Pose]:
    """Yield the events of a range and all poses of the ground truth in time order."""
    return heapq.merge(dataset.events(start, stop), _poses(dataset.recording), key=lambda x: x.time_ns)


def _poses(recording: Recording) -> Iterator[_Pose]:
    """Yield the ground truth: that of the IMU, or of the left camera where there is none."""
    truth = recording.reference
    if truth is None or truth.times_ns is None:
        return
    T = recording.T_cam0_imu
    here: Trajectory = truth if T is None else truth.in_imu(T)
    for time_ns, T_world_body in zip(here.times_ns.tolist(), here.T_world_body, strict=True):  # type: ignore[union-attr]
        yield _Pose(time_ns, T_world_body)


def _frames(recording: Recording) -> list[tuple[str, str, FloatArray]]:
    """Return the static transforms: the IMU carries the left camera, which carries the right one."""
    T_cam0_cam1 = se3_from_parts(np.eye(3), [recording.camera.baseline_m, 0.0, 0.0])
    right = [(_LEFT, _RIGHT, T_cam0_cam1)]
    if recording.T_cam0_imu is None:
        return right
    return [(_IMU, _LEFT, se3_inverse(recording.T_cam0_imu)), *right]


def _write_frame(bag: BagWriter, recording: Recording, frame: StereoFrame) -> None:
    sides = (("left", _LEFT, frame.left, False), ("right", _RIGHT, frame.right, True))
    for side, name, image, right in sides:
        assert image is not None
        bag.camera_info(f"/{side}/camera_info", name, frame.time_ns, recording.camera, right=right)
        bag.image(f"/{side}/image_rect", name, frame.time_ns, image)
