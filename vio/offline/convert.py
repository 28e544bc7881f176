"""Write any recording of images as a folder of another form or as a ROS 2 bag: streamed,
rectified as a run sees it.
"""

from __future__ import annotations

import heapq
import shutil
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Literal, TypeAlias

import numpy as np

from vio.cameras.rig import rig_of_rectified
from vio.datasets.bags.writer import BagWriter, Storage, bag_writer
from vio.datasets.euroc import euroc_base
from vio.datasets.euroc_files import (
    STATE_CSV,
    image_name,
    imu_csv,
    imu_yaml,
    median_rate_hz,
    read_imu_yaml,
    rig_read_as,
    write_cameras,
)
from vio.datasets.euroc_files import TUM_FILE as EUROC_TUM
from vio.datasets.image_pairs import ImageDataset
from vio.datasets.images import write_png
from vio.datasets.kitti import write_calibration, write_times, write_velocity
from vio.datasets.rigs.kalibr import kalibr_text
from vio.datasets.samples import motion_samples
from vio.datasets.yaml_files import densities_text
from vio.errors import DataError
from vio.files.text import exact_text, seconds_text, write_text
from vio.files.trajectories import in_first_cam0, write_tum
from vio.geometry.lie import FloatArray, se3_from_parts, se3_inverse
from vio.offline.convert_spectacularai import write_spectacularai
from vio.protocols import Dataset, Progress
from vio.records import (
    Event,
    ImuDensities,
    ImuRecord,
    ImuSample,
    Recording,
    StereoFrame,
    VelocitySample,
)

Folder: TypeAlias = Literal["euroc", "kitti", "plain"]
Form: TypeAlias = Literal["euroc", "kitti", "plain", "rosbag2", "mcap", "spectacularai"]


@dataclass(slots=True)
class _Written:
    """What went into the folder."""

    last_ns: int = 0  # of the last frame of the range, by whose digits images are named
    times_ns: list[int] = field(default_factory=list)
    imu: list[ImuSample] = field(default_factory=list)
    velocities: list[VelocitySample] = field(default_factory=list)


@dataclass(frozen=True, slots=True)
class Converted:
    """The counts of a conversion, and what the form could not hold or a reader must be given."""

    frames: int
    imu_samples: int
    velocities: int
    notes: tuple[str, ...] = ()


def convert(
    dataset: Dataset,
    out: Path,
    form: Form,
    *,
    start: int = 0,
    stop: int | None = None,
    progress: Progress = lambda done, total: None,
) -> Converted:
    """Write a recording into an existing, empty folder.

    Args:
        dataset: a recording with images.
        out: the folder.
        form: "euroc" (mav0), "kitti" (image_0 image_1 calib.txt times.txt), "plain" (left right,
            Kalibr's file), a ROS 2 bag of SQLite ("rosbag2") or MCAP ("mcap") with Kalibr's file
            beside it, or what the SDK of Spectacular AI replays ("spectacularai").
        start: first frame.
        stop: frame after the last one; None: to the end.
        progress: called after each frame.

    Raises:
        DataError: the recording has no images, or too many cannot be read.
        MissingDependencyError: bags need the package rosbags.
    """
    recording = dataset.recording
    if not recording.has_images or recording.camera.width is None:
        raise DataError(f"{recording.path}: holds no images, so there is nothing to convert")
    noise: ImuDensities | None = getattr(dataset, "imu_noise", None)
    if form == "rosbag2" or form == "mcap":  # mypy narrows the type by these
        done = _write_bag(dataset, out, form, start, stop, progress)
        _check_frames(done.frames, recording)
        _write_kalibr(out, recording, noise if done.imu_samples else None)
        return replace(done, notes=_bag_notes(done, recording))
    if form == "spectacularai":
        frames, samples, origin_ns = write_spectacularai(dataset, out, start, stop, progress)
        _check_frames(frames, recording)
        note = f"times are seconds from {origin_ns} ns; velocities and ground truth have no place"
        return Converted(frames, samples, 0, (note,))
    written = _write_images(dataset, out, form, start, stop, progress)
    _check_frames(len(written.times_ns), recording)
    writers: dict[Folder, Callable[[Path, Recording, _Written, ImuDensities | None], list[str]]] = {
        "euroc": _finish_euroc,
        "kitti": _finish_kitti,
        "plain": _finish_plain,
    }
    lacking = writers[form](out, recording, written, noise)
    return Converted(
        len(written.times_ns), len(written.imu), len(written.velocities), tuple(lacking)
    )


def write_rectified_euroc(dataset: ImageDataset, out: Path, progress: Progress) -> int:
    """Write an EuRoC recording as a folder of rectified images; the IMU and the ground truth are
    copied as they are.

    Returns:
        The number of frames written.

    Raises:
        DataError: too many images are unreadable, or a file cannot be copied.
    """
    source = euroc_base(dataset.recording.path)
    mav = out / "mav0"
    rig = rig_read_as(dataset.recording.camera, dataset.rectifier.T_rect0_imu)
    sensor = source / "imu0" / "sensor.yaml"
    if sensor.is_file():
        T_body_imu = read_imu_yaml(sensor)[0]
    else:
        T_body_imu = np.eye(4)
    written = _write_images(dataset, out, "euroc", 0, None, progress)
    _check_frames(len(written.times_ns), dataset.recording)
    times = np.array(written.times_ns, dtype=np.int64)
    write_cameras(mav, rig, times, written.last_ns, kind="rectified", T_body_imu=T_body_imu)
    copied = [
        (source / part, mav / part)
        for part in (Path("imu0", "sensor.yaml"), Path("imu0", "data.csv"), STATE_CSV)
    ]
    for file, target in (*copied, (source.absolute().parent / EUROC_TUM, out / EUROC_TUM)):
        if file.is_file():
            target.parent.mkdir(parents=True, exist_ok=True)
            try:
                shutil.copyfile(file, target)
            except shutil.SameFileError as error:
                raise DataError(
                    f"{file}: cannot be copied onto itself; choose another folder"
                ) from error
    return len(times)


def _frames_in(dataset: Dataset, start: int, stop: int | None) -> int:
    count = len(dataset.recording.frame_times_ns)
    return (count if stop is None else min(stop, count)) - start


def _check_frames(count: int, recording: Recording) -> None:
    if not count:
        raise DataError(f"{recording.path}: no frame could be read; see the warnings above")


def _write_images(
    dataset: Dataset, out: Path, form: Folder, start: int, stop: int | None, progress: Progress
) -> _Written:
    """Write the images of a range, and collect its samples."""
    written = _Written()
    names = {
        "euroc": ("mav0/cam0/data", "mav0/cam1/data"),
        "kitti": ("image_0", "image_1"),
        "plain": ("left", "right"),
    }
    folders = [out / name for name in names[form]]
    for folder in folders:
        folder.mkdir(parents=True)
    total = _frames_in(dataset, start, stop)
    written.last_ns = int(dataset.recording.frame_times_ns[total + start - 1])
    for event in dataset.events(start, stop):
        if isinstance(event, ImuSample):
            written.imu.append(event)
        elif isinstance(event, VelocitySample):
            written.velocities.append(event)
        else:
            assert event.left is not None
            assert event.right is not None
            name = (
                f"{len(written.times_ns):06d}.png"
                if form == "kitti"
                else image_name(event.time_ns, written.last_ns)
            )
            for folder, image in zip(folders, (event.left, event.right), strict=True):
                write_png(folder / name, image)
            written.times_ns.append(event.time_ns)
            progress(len(written.times_ns), total)
    return written


def _finish_euroc(
    out: Path, recording: Recording, written: _Written, noise: ImuDensities | None
) -> list[str]:
    times = np.array(written.times_ns, dtype=np.int64)
    rig = rig_read_as(recording.camera, recording.T_cam0_body)
    mav = out / "mav0"
    write_cameras(mav, rig, times, written.last_ns, kind="rectified")
    notes = []
    if written.imu:
        samples = motion_samples(written.imu)
        record = ImuRecord(samples.times_ns, samples.values[:, :3], samples.values[:, 3:])
        (mav / "imu0").mkdir()
        write_text(mav / "imu0" / "data.csv", imu_csv(record))
        if noise is not None:
            text = imu_yaml(
                np.eye(4), noise, comment="imu0", rate_hz=median_rate_hz(record.times_ns)
            )
            write_text(mav / "imu0" / "sensor.yaml", text)
    if written.velocities:
        notes.append(
            "velocities have no place in EuRoC's form and are left out; --to plain keeps them"
        )
    if recording.reference is not None and recording.reference.times_ns is not None:
        write_tum(out / EUROC_TUM, recording.reference)
    return notes


def _finish_kitti(
    out: Path, recording: Recording, written: _Written, noise: ImuDensities | None
) -> list[str]:
    times = np.array(written.times_ns, dtype=np.int64)
    first_ns = int(times[0])
    write_calibration(out, recording.camera, recording.T_cam0_imu)
    write_times(out, times)
    if written.velocities:
        write_velocity(out, written.velocities, first_ns)
    notes = []
    if written.imu:
        write_text(out / "imu.csv", _imu_text(written.imu, first_ns))
        notes.append(
            "KITTI's form has no IMU: imu.csv is beside it, and makes the folder one of kind plain"
        )
    truth = recording.reference
    if truth is None or truth.times_ns is None:
        return notes
    at = np.searchsorted(truth.times_ns, times)
    if (at < len(truth)).all() and np.array_equal(truth.times_ns[at], times):
        here = replace(truth, T_world_body=truth.T_world_body[at], times_ns=times)
        T_cam0_imu = recording.T_cam0_body
        rows = in_first_cam0(here, T_cam0_imu).T_world_body[:, :3].reshape(-1, 12)
        write_text(out / "poses.txt", "".join(f"{exact_text(row)}\n" for row in rows))
    else:
        write_tum(out / "reference.tum", replace(truth, times_ns=truth.times_ns - first_ns))
        notes.append(
            "the ground truth is not at the frames' times: it is in reference.tum, not in poses.txt"
        )
    return notes


def _finish_plain(
    out: Path, recording: Recording, written: _Written, noise: ImuDensities | None
) -> list[str]:
    _write_kalibr(out, recording, noise if written.imu else None)
    write_text(out / "times.txt", "".join(f"{seconds_text(t)}\n" for t in written.times_ns))
    if written.imu:
        write_text(out / "imu.csv", _imu_text(written.imu, 0))
    if written.velocities:
        write_velocity(out, written.velocities, 0)
    if recording.reference is not None and recording.reference.times_ns is not None:
        write_tum(out / "reference.tum", recording.reference)
    return []


def _write_kalibr(out: Path, recording: Recording, noise: ImuDensities | None) -> None:
    """Write the rectified rig as Kalibr's camchain, and the IMU's noise beside it."""
    rig = rig_of_rectified(recording.camera, recording.T_cam0_imu)
    imu = recording.T_cam0_imu is not None
    assert rig is not None
    write_text(out / ("camchain-imucam.yaml" if imu else "camchain.yaml"), kalibr_text(rig))
    if noise is not None:
        write_text(out / "imu.yaml", densities_text(noise, units=False))


def _imu_text(samples: list[ImuSample], first_ns: int) -> str:
    """Return `imu.csv` of a plain folder, with all digits."""
    rows = (f"{s.time_ns - first_ns},{exact_text([*s.gyro, *s.accel], ',')}" for s in samples)
    return "\n".join(["timestamp [ns],wx,wy,wz,ax,ay,az", *rows]) + "\n"


_WORLD = "world"
_LEFT = "cam0"
_RIGHT = "cam1"
_IMU = "imu"


def _bag_notes(done: Converted, recording: Recording) -> tuple[str, ...]:
    """Return what a reader of a bag must be given."""
    if not done.velocities:
        return ()
    if recording.T_cam0_imu is None:
        return (
            "velocities need the pose of their sensor in the camera, which this recording does not "
            "have",
        )
    if done.imu_samples:
        return (
            "a run reads the IMU alone; for the velocities as well: --topics velocity=/velocity",
        )
    return ()


@dataclass(frozen=True, slots=True)
class _Pose:
    """A pose of the ground truth."""

    time_ns: int
    T_world_body: FloatArray  # (4, 4)


def _write_bag(
    dataset: Dataset, out: Path, storage: Storage, start: int, stop: int | None, progress: Progress
) -> Converted:
    """Write a range of a recording as a bag; the arguments are those of `convert`.

    Topics: /left/image_rect, /right/image_rect and their camera_info, /imu, /velocity,
    /ground_truth, /tf_static.
    """
    recording = dataset.recording
    total = _frames_in(dataset, start, stop)
    frames = samples = velocities = 0
    in_order: Iterator[Event | _Pose]
    in_order = heapq.merge(dataset.events(start, stop), _poses(recording), key=lambda x: x.time_ns)
    with bag_writer(out, storage) as bag:
        for k, event in enumerate(in_order):
            if k == 0:
                bag.static_transforms(event.time_ns, _frames(recording))
            if isinstance(event, StereoFrame):
                _write_frame(bag, recording, event)
                frames += 1
                progress(frames, total)
            elif isinstance(event, ImuSample):
                bag.imu("/imu", _IMU, event)
                samples += 1
            elif isinstance(event, VelocitySample):
                bag.twist("/velocity", _IMU, event)
                velocities += 1
            else:
                bag.pose("/ground_truth", _WORLD, event.time_ns, event.T_world_body)
    return Converted(frames, samples, velocities)


def _poses(recording: Recording) -> list[_Pose]:
    """Return the ground truth: that of the IMU, or of the left camera where there is none."""
    truth = recording.reference
    T = recording.T_cam0_imu
    if truth is None or truth.times_ns is None:
        return []
    if T is None:
        poses = truth.T_world_body
    else:
        poses = truth.in_imu(T).T_world_body
    return [
        _Pose(time_ns, T_world_body)
        for time_ns, T_world_body in zip(truth.times_ns.tolist(), poses, strict=True)
    ]


def _frames(recording: Recording) -> list[tuple[str, str, FloatArray]]:
    """Return the static transforms: the IMU carries the left camera, which carries the right
    one.
    """
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
