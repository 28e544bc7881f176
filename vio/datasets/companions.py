"""What is beside the images of a plain recording: calibration, motion samples, ground truth, and
the rest.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TypeAlias

import numpy as np

from vio.cameras.rig import Rectifier, Rig
from vio.dataclass import dataclass
from vio.datasets import rigs
from vio.datasets.common import naming
from vio.datasets.image_pairs import ImageSize
from vio.datasets.json_lines import read_imu_lines
from vio.datasets.kitti import read_extrinsics
from vio.datasets.rigs.camera_json import REPLICA
from vio.datasets.rigs.eth3d import EXTRINSICS, FOLDERS, is_eth3d, truth_of_left
from vio.datasets.rigs.four_seasons import STEREO, TRANSFORMS, read_imu_transform
from vio.datasets.rigs.plausible import noting_imu_place
from vio.datasets.rigs.virtual_kitti import EXTRINSICS as EXTRINSICS_OF_VIRTUAL_KITTI
from vio.datasets.rigs.virtual_kitti import poses_of_left
from vio.datasets.samples import MotionSamples, imu_samples, in_time_order
from vio.datasets.settings import DatasetSettings
from vio.datasets.tables import (
    names_readings,
    read_imu_table,
    read_sensor_table,
    read_velocity_table,
)
from vio.datasets.unused import Layout, unused_note
from vio.errors import CalibrationError, DataError, EvaluationError
from vio.evaluation.numbering import numbered_by_images
from vio.files.trajectories import is_trajectory_file, read_trajectory
from vio.geometry.lie import FloatArray, se3_from_parts, se3_inverse
from vio.imu.clocks import judge_clocks
from vio.imu.sampling import sampling_notes
from vio.imu.two_sensors import joined_record
from vio.records import (
    NS_PER_S,
    ImuRecord,
    ImuSample,
    IntArray,
    MotionSample,
    Recording,
    Trajectory,
)

IMU_FILES = (
    "imu.csv", "imu.txt", "imu0.csv", "imu_data.csv", "imu0/data.csv", "gyro_accel.csv",
)  # fmt: skip
# of data sets and SDKs, read where the pose of the IMU is known
_LOGGED_IMU_FILES = (
    "sensor_data/xsens_imu.csv", "xsens_imu.csv", "ms25.csv", "imu.jsonl", "data.jsonl",
    "imu_data.txt",
)  # fmt: skip
# of a gyro and an accelerometer that have a file each
_GYRO_FILES = ("gyro.csv", "gyro.txt", "gyr.csv", "gyr.txt", "gyroscope.csv", "gyroscope.txt")
_ACCEL_FILES = (
    "accel.csv", "accel.txt", "acc.csv", "acc.txt",
    "totalacceleration.csv",  # of a logger whose accelerometer.csv lacks gravity
    "accelerometer.csv", "accelerometer.txt",
)  # fmt: skip
_REFERENCES = (
    "reference.tum", "reference.txt", "reference.csv",
    "groundtruth.tum", "groundtruth_tum.txt", "groundtruth.txt", "gt_imu.csv",
    "mocap0/data.csv", "state_groundtruth_estimate0/data.csv", "poses.txt",
)  # fmt: skip
# files of poses by other names that may be ground truth; an estimate is not called so
_NAMED_TRUTH = re.compile(r"truth|pose|vicon|mocap|optitrack|leica|(?:^|_)gt(?:_|$)")
_LONG_SHIFT_S = 1.0  # as of one that was written in milliseconds
_CALIBRATION_FOLDERS = ("", "dso", "calibration", "calib", "extras")
# of files that may be calibrations, and names of those beside them that are none
_OF_CALIBRATIONS = (".yaml", ".yml", ".json", ".xml", ".conf", ".ini", ".npz", ".mat", ".edex")
_NO_CALIBRATION = ("imu", "conversion", "simulation", "metrics", "config")
_NAMED = 3  # of these
_SHARED_FOLDERS = ("calibration", "extras")  # of 4Seasons and Monado


def calibration_beside(layout: Layout) -> Path | None:
    """Return the calibration file of a recording; None: there is none."""
    if is_pair_of_eth3d(layout):
        return layout.root / EXTRINSICS
    for folder in _folders_of_calibrations(layout):
        if not folder.is_dir():
            continue
        if "undistorted" in str(layout.left) and (folder / STEREO).is_file():
            return folder / "undistorted_calib_0.txt"
        if (found := rigs.find_calibration(folder)) is not None:
            return found
    of_all = layout.root.absolute().parent / REPLICA
    return of_all if of_all.is_file() else None


def _folders_of_calibrations(layout: Layout) -> list[Path]:
    """Return where a recording's calibration may lie: in it, above it, or beside all of its rig."""
    above = []
    if layout.root.name == "mav0":
        above = [layout.root.parent]
    own = dict.fromkeys((layout.root, layout.base, *above))
    folders = [base / inside for base in own for inside in _CALIBRATION_FOLDERS]
    shared = layout.root.absolute().parent
    return [*folders, *(shared / name for name in _SHARED_FOLDERS)]


def find_calibration_of(layout: Layout) -> Path:
    """Return the calibration file of a recording.

    Raises:
        CalibrationError: there is none; the message names the known forms.
    """
    if (found := calibration_beside(layout)) is not None:
        return found
    raise CalibrationError(
        f"{layout.root}: no calibration; add one as calibration.yaml (Kalibr's camchain, OpenCV's "
        "M1 D1 M2 D2 R T), "
        "calib.txt (KITTI's, or of a rectified pair lines 'fx: …', cx, cy, baseline in metres) or another "
        "that vio.load_rig reads, or name it with "
        f"--calibration FILE; vio calibrate-rig makes one from a printed board{_unread(layout)}"
    )


def _unread(layout: Layout) -> str:
    """Return which files of a recording may be calibrations of forms that are not read, for a
    message.
    """
    files = sorted({*layout.root.iterdir(), *layout.base.iterdir()})
    names = [
        file.name
        for file in files
        if file.suffix.lower() in _OF_CALIBRATIONS and not file.name.startswith(_NO_CALIBRATION)
    ]
    if not names:
        return ""
    return f"; of no form that is read: {', '.join(names[:_NAMED])}"


def is_pair_of_eth3d(layout: Layout) -> bool:
    """Return whether images are those of both cameras of ETH3D."""
    return layout.left != layout.right and is_eth3d(layout.root) and layout.left.name == FOLDERS[0]


@dataclass(frozen=True, slots=True)
class Beside:
    """What lies beside the images of a recording."""

    motion: MotionSamples[MotionSample]  # in time order
    motion_notes: Sequence[str]
    reference: Trajectory | None
    files: Sequence[Path]  # that were read, or are known not to matter
    notes: Sequence[str]  # about all but motion samples
    stated_by: Sequence[Path]  # file that states the size of the images, for each camera


Parts: TypeAlias = tuple[
    Recording, MotionSamples[MotionSample], tuple[ImageSize, ...], DatasetSettings, Rectifier
]  # of an `ImageRecording`


def parts_of(
    kind: str,
    layout: Layout,
    rectifier: Rectifier,
    settings: DatasetSettings,
    times_ns: IntArray,
    beside: Beside,
    *,
    has_body: bool = True,
) -> Parts:
    """Return what a recording of image files or videos is made of.

    Args:
        kind: of the recording.
        layout: where its parts lie.
        rectifier: of its images.
        settings: reader settings.
        times_ns: of the frames (F,).
        beside: what was read beside the images.
        has_body: whether the pose of an IMU is known.
    """
    T_cam0_imu = None
    if has_body:
        T_cam0_imu = rectifier.T_rect0_imu
    recording = Recording(
        kind=kind,
        path=layout.root,
        camera=rectifier.camera,
        T_cam0_imu=T_cam0_imu,
        frame_times_ns=times_ns,
        has_images=True,
        motion=beside.motion.kinds,
        reference=beside.reference,
        notes=(
            *beside.notes,
            *rectifier.notes,
            *beside.motion_notes,
            *unused_note(layout, beside.files),
        ),
        motion_notes=tuple(beside.motion_notes),
    )
    cameras = zip(rectifier.cameras, beside.stated_by, strict=True)
    sizes = tuple(ImageSize(camera.width, camera.height, file) for camera, file in cameras)
    return recording, beside.motion, sizes, settings, rectifier


@dataclass(frozen=True, slots=True)
class ReadImages:
    """What was read of the images of a recording, before what lies beside them."""

    kind: str  # of the recording
    layout: Layout  # where its parts lie
    calibration: tuple[Path, Rig]  # the file, and its rig
    times: tuple[IntArray, Path | None]  # of the frames (F,), and their file; None: assumed
    notes: Sequence[str]  # about images and times
    used: Sequence[Path]  # further files and folders that were read, or are known not to matter
    has_depths: bool = False  # whether one camera has depth images
    numbers: IntArray | None = (
        None  # (F,) in the names of the images; None: they do not count frames
    )


def read_companions(
    images: ReadImages, settings: DatasetSettings, reference: Trajectory | None = None
) -> Parts:
    """Read what lies beside images: the pose of the IMU, its samples, velocities and ground truth.

    Args:
        images: what was read of the images.
        settings: reader settings.
        reference: ground truth that was read already.

    Raises:
        DataError: samples or ground truth cannot be used.
        CalibrationError: the rig cannot be rectified, or samples need the pose of their sensor.
    """
    layout = images.layout
    (file, rig) = images.calibration
    (times_ns, times_file) = images.times
    rig, extrinsics = _with_extrinsics(rig, layout, file)
    motion, motion_files, motion_notes = _read_motion(layout, rig, times_ns, times_file is not None)
    with naming(file):
        depth_noise = settings.depth_noise if images.has_depths else None
        rectifier = rig.rectifier(
            settings.interpolation, settings.projection, depth_noise=depth_noise
        )
    reference_file = None
    truth_notes: Sequence[str] = ()
    if reference is None:
        reference, reference_file = _read_reference(images, rig, rectifier)
        if reference is None:
            truth_notes = _other_truth_notes(layout, motion_files)
    read = [source for source in (file, times_file, reference_file) if source is not None]
    beside = Beside(
        motion,
        motion_notes,
        reference,
        [*read, *extrinsics, *motion_files, *images.used],
        (*images.notes, *truth_notes, *rig.notes),
        [file] * len(rig.cameras),
    )
    has_body = rig.T_cam0_imu is not None and (rig.cam1 is not None or len(motion_files) > 0)
    parts = parts_of(images.kind, layout, rectifier, settings, times_ns, beside, has_body=has_body)
    return (replace(parts[0], image_numbers=images.numbers), *parts[1:])


def _with_extrinsics(rig: Rig, layout: Layout, file: Path) -> tuple[Rig, list[Path]]:
    """Add `T_cam0_imu.txt`, or what 4Seasons has in its place, where the calibration itself has
    none.
    """
    path = layout.root / "T_cam0_imu.txt"
    transforms = layout.root / TRANSFORMS
    if rig.T_cam0_imu is None and not path.is_file() and transforms.is_file():
        rig = replace(rig, T_cam0_imu=read_imu_transform(transforms))
        return noting_imu_place(rig, transforms), [transforms]
    if rig.T_cam0_imu is not None or not path.is_file():
        return rig, [path] if file.name == "calib.txt" else []
    return noting_imu_place(replace(rig, T_cam0_imu=read_extrinsics(path)), path), [path]


def _read_motion(
    layout: Layout, rig: Rig, times_ns: IntArray, timed: bool
) -> tuple[MotionSamples[MotionSample], list[Path], list[str]]:
    """Read the IMU and the velocities, on the clock of the images; return the samples, their
    files and notes.
    """
    imu = imu_files(layout.root, layout.base)
    velocity = layout.root / "velocity.csv"
    files = [*imu, *([velocity] if velocity.is_file() else [])]
    if not files:
        return _read_logged(layout, rig, times_ns, timed)
    others = [] if imu else _other_imu_notes(layout)
    if not timed:
        raise DataError(
            f"{files[0]}: needs the times of the images on the same clock; add times.txt, or "
            "remove it"
        )
    if rig.T_cam0_imu is None:
        raise CalibrationError(
            f"{files[0]}: needs the pose of its sensor; add T_cam0_imu.txt (IMU to left camera), "
            "or use a calibration "
            "with T_cam_imu (Kalibr's camchain-imucam), or remove the file to use the images alone"
        )
    parts: list[Sequence[MotionSample]] = []
    notes = others
    if imu:
        record, notes_read = _read_imu(imu, notes)
        samples, notes_moved = imu_on_camera_clock(record, rig, times_ns, imu[0])
        notes += [*notes_read, *notes_moved]
        parts.append(samples)
    if velocity.is_file():
        speeds = read_velocity_table(velocity, notes)
        check_overlap(times_ns, speeds.times_ns, velocity)
        parts.append(speeds)
    return in_time_order(*parts), files, notes


def _read_logged(
    layout: Layout, rig: Rig, times_ns: IntArray, timed: bool
) -> tuple[MotionSamples[MotionSample], list[Path], list[str]]:
    """Read the IMU of a data set or an SDK, as `_read_motion`; where that is not possible, the
    images are used alone, with a note.
    """
    file = _first_file((layout.root, layout.base), _LOGGED_IMU_FILES)
    if file is None:
        return in_time_order(), [], _other_imu_notes(layout)
    if rig.T_cam0_imu is None or not timed:
        lacks = (
            "the images have no times"
            if rig.T_cam0_imu is not None
            else "the pose of its sensor is not known; add T_cam0_imu.txt (IMU to left camera)"
        )
        return in_time_order(), [], [f"{file}: not read, as {lacks}"]
    notes: list[str] = []
    try:
        record, notes_read = _read_imu((file,), notes)
        samples, notes_moved = imu_on_camera_clock(record, rig, times_ns, file)
    except DataError as error:
        return in_time_order(), [], [f"not read: {error}"]
    return in_time_order(samples), [file], [*notes, *notes_read, *notes_moved]


def imu_files(*folders: Path) -> tuple[Path, ...]:
    """Return the table of the IMU in one of some folders, or those of a gyro and an accelerometer,
    in this order; none: there are none.
    """
    if (imu := _first_file(folders, IMU_FILES)) is not None:
        return (imu,)
    for folder in folders:
        gyro = _first_file([folder], _GYRO_FILES)
        accel = _first_file([folder], _ACCEL_FILES)
        if gyro is not None and accel is not None:
            return gyro, accel
    return ()


def _first_file(folders: Sequence[Path], names: Sequence[str]) -> Path | None:
    """Return the first file of some names, in the first folder that has one; None: there is none."""
    for folder in folders:
        files = (folder / name for name in names)
        if (found := next((file for file in files if file.is_file()), None)) is not None:
            return found
        if folder.is_dir():
            listed = {file.name.lower(): file for file in folder.iterdir()}
        else:
            listed = {}
        found = next((listed[name] for name in names if name in listed), None)
        if found is not None and found.is_file():
            return found  # as a phone's logger names them: Gyro.txt
    return None


def _read_imu(files: Sequence[Path], notes: list[str]) -> tuple[ImuRecord, Sequence[str]]:
    """Read what `imu_files` has found, and what is to be noted of it; `notes` gets what tables cut
    short are noted with.

    Raises:
        DataError: as `read_imu_table`, or no reading of the gyro lies between two of the
            accelerometer.
    """
    if files[0].suffix.lower() == ".jsonl":
        return read_imu_lines(files[0])
    if len(files) == 1:
        return read_imu_table(files[0], cut=notes)
    gyro, accel = files
    record = joined_record(
        read_sensor_table(gyro, "gyro", notes), read_sensor_table(accel, "accelerometer", notes)
    )
    if record is None:
        raise DataError(f"{gyro}: none of its times lies between those of {accel}")
    joined = (
        f"{gyro} and {accel.name} are joined, the acceleration interpolated at the gyro's stamps"
    )
    return record, (joined, *sampling_notes(record, str(gyro)))


def _files_beside(layout: Layout, pattern: str) -> list[Path]:
    """Return what lies beside the images under names of a pattern."""
    folders = dict.fromkeys((layout.root, layout.base))
    return [file for folder in folders for file in sorted(folder.glob(pattern))]


def _other_imu_notes(layout: Layout) -> list[str]:
    """Say how to name tables that seem to be the IMU's and are not read by their names."""
    files = _files_beside(layout, "*.[cCtT][sSxX][vVtT]")
    found = {file: names_readings(file) for file in files if file.is_file()}
    return [
        f"{file}: not read; name it {wanted} if it is the IMU's"
        for file, wanted in found.items()
        if wanted is not None
    ]


def _read_reference(
    images: ReadImages, rig: Rig, rectifier: Rectifier
) -> tuple[Trajectory | None, Path | None]:
    """Read the ground truth as that of the body: the IMU, or the rectified left camera where
    there is none.
    """
    layout = images.layout
    bases = (layout.root, layout.base, layout.root / "dso")
    file = next((f for n in _REFERENCES for base in bases if (f := base / n).is_file()), None)
    of_replica = layout.root / "traj.txt"
    if file is None and images.calibration[0].name == REPLICA and of_replica.is_file():
        file = of_replica
    if file is None:
        file = layout.root / EXTRINSICS_OF_VIRTUAL_KITTI
        truth = poses_of_left(layout.root)
    else:
        truth = read_trajectory(file)
    if truth is None:
        return None, None
    if truth.times_ns is None:
        truth = reference_of_images(truth, images.times[0], images.numbers, file)
    if is_pair_of_eth3d(layout):
        truth = truth_of_left(truth, rig)
    with naming(file):
        return reference_of_body(truth, rig, rectifier), file


def _other_truth_notes(layout: Layout, read: Sequence[Path]) -> list[str]:
    """Say how to name files of poses that are not read by their names."""
    return [
        f"{file}: poses, not read; name it reference{file.suffix} if it is the ground truth"
        for file in _files_beside(layout, "*.[tc][xus][tmv]")
        if file not in read and _NAMED_TRUTH.search(file.stem.lower()) and is_trajectory_file(file)
    ]


def reference_of_images(
    truth: Trajectory, times_ns: IntArray, image_numbers: IntArray | None, file: Path
) -> Trajectory:
    """Return ground truth without times with those of the frames that its poses belong to.

    Args:
        truth: a pose for each image, or for each number of an image.
        times_ns: of the frames (F,).
        image_numbers: (F,) by which the images are named; None: not known.
        file: of the ground truth, for messages.

    Raises:
        DataError: there are more poses than images that follow one another from the first, or which
            images they are of is not known.
    """
    counted = image_numbers is None or int(image_numbers[-1]) <= len(times_ns)
    if len(truth) > len(times_ns) and counted:
        raise DataError(
            f"{file} holds {len(truth)} poses for {len(times_ns)} images; give one line for each "
            "image"
        )
    try:
        truth = numbered_by_images(truth, image_numbers)
    except EvaluationError as error:
        raise DataError(f"{file}: {error}") from error
    assert truth.frame_indices is not None
    return replace(truth, times_ns=times_ns[truth.frame_indices])


def imu_on_camera_clock(
    record: ImuRecord, rig: Rig, frame_times_ns: IntArray, where: Path | str
) -> tuple[MotionSamples[ImuSample], list[str]]:
    """Return samples whose stamps are moved by the calibration's time offset, and a note where that
    is not zero.

    Raises:
        DataError: no sample is within the time of the images.
    """
    shift_ns = round(rig.time_offset_s * NS_PER_S)
    record = replace(record, times_ns=record.times_ns - shift_ns)
    if abs(rig.time_offset_s) > _LONG_SHIFT_S:
        where = f"{where}, moved by the calibration's time shift of {rig.time_offset_s:g} s"
    check_overlap(frame_times_ns, record.times_ns, where)
    moved = f"the IMU's stamps are moved by {-1e3 * rig.time_offset_s:+.3f} ms, as the calibration states"
    return imu_samples(record), [moved] if shift_ns else []


def check_overlap(frame_times_ns: IntArray, times_ns: IntArray, where: Path | str) -> None:
    """Raise DataError where no sample lies within the time of the images."""
    if times_ns[-1] < frame_times_ns[0] or times_ns[0] > frame_times_ns[-1]:
        (finding,) = judge_clocks(frame_times_ns, times_ns)
        raise DataError(
            f"{where}: no sample is within the time of the images; {finding.message}; or remove it"
        )


def reference_of_body(truth: Trajectory, rig: Rig, rectifier: Rectifier) -> Trajectory:
    """Return ground truth of the raw left camera or of the IMU as that of the run's body.

    Raises:
        CalibrationError: poses of the IMU cannot be used, as its place is unknown.
    """
    if rig.T_cam0_imu is not None:
        return truth.in_imu(rig.T_cam0_imu)
    if truth.body == "imu":
        # Without extrinsics IMU and camera cannot be distinguished; a TUM file without a comment is
        # the camera's.
        truth = replace(truth, body="cam0")
    R_rect_cam0: FloatArray = rectifier.T_rect0_imu[:3, :3]
    return replace(
        truth,
        T_world_body=truth.T_world_body @ se3_inverse(se3_from_parts(R_rect_cam0, np.zeros(3))),
    )
