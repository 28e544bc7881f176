"""What goes with the images of a bag: topics, calibration, the IMU's pose, motion samples, the
level of white.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from vio.cameras.rig import Rig
from vio.datasets.bags.frames import add_frames_of_tf, rig_with_baseline, states_baseline
from vio.datasets.bags.index import BagIndex, index_bag, info_topic
from vio.datasets.bags.kinds import bag_files
from vio.datasets.bags.pictures import gray_of
from vio.datasets.bags.store import Bag, Topic
from vio.datasets.bags.topics import Roles, choose, without_transport
from vio.datasets.companions import check_overlap, imu_on_camera_clock
from vio.datasets.images import UnreadableImageError
from vio.datasets.rigs import find_calibration, load_rig
from vio.datasets.rigs.camera_info import CameraInfo, rig_from_camera_infos
from vio.datasets.samples import MotionSamples, in_time_order
from vio.datasets.settings import DatasetSettings
from vio.errors import CalibrationError, DataError
from vio.geometry.lie import FloatArray
from vio.imu.sampling import sampling_notes
from vio.records import IntArray, MotionSample

Size = tuple[int, int]


@dataclass(frozen=True, slots=True)
class Contents:
    """What one pass over a bag found, and where its calibration may come from."""

    path: Path
    roles: Roles
    index: BagIndex
    infos: tuple[str | None, ...]  # CameraInfo topic of each camera
    size: Size | None  # width and height of the left images, pixels
    beside: Path | None  # a calibration file in the bag's folder
    notes: tuple[str, ...]  # about joined files, and about topics


def contents(path: Path, settings: DatasetSettings) -> Contents:
    """Choose the topics of a bag and pass over it once.

    Raises:
        MissingDependencyError: the package rosbags is not installed.
        DataError: the bag is damaged, or its topics do not make a recording.
        CalibrationError: a camera has no CameraInfo, and no file serves.
    """
    beside, joined = _calibration_beside(path, settings)
    with Bag(path) as bag:
        roles, notes = choose(bag.topics, settings.topics, str(path))
        infos = tuple(info_topic(bag.topics, topic) for topic in roles.cameras)
        if settings.calibration is None and beside is None and None in infos:
            missing = roles.cameras[infos.index(None)].name
            whose = "camera's" if roles.right is None else "cameras'"
            raise CalibrationError(
                f"{path}: holds no CameraInfo for {missing}; give the {whose} calibration with "
                "--calibration FILE"
            )
        index = index_bag(bag, roles, [name for name in infos if name is not None])
        if settings.calibration is None:
            add_frames_of_tf(bag, index, roles, infos)
        size = index.left.size or _compressed_size(bag, roles.left)
        notes = (*notes, *bag.notes)
    return Contents(path, roles, index, infos, size, beside, (*joined, *notes))


def _calibration_beside(path: Path, settings: DatasetSettings) -> tuple[Path | None, list[str]]:
    """Return the calibration file in a bag's folder where no other is named, and a note on bags
    that are joined.
    """
    parts = bag_files(path)
    notes = (
        [f"{len(parts)} bags are joined: {', '.join(part.name for part in parts)}"]
        if len(parts) > 1
        else []
    )
    if settings.calibration is not None:
        return None, notes
    folders = [folder for folder in dict.fromkeys((path, *parts)) if folder.is_dir()]
    return next(
        (found for folder in folders if (found := find_calibration(folder)) is not None), None
    ), notes


def _compressed_size(bag: Bag, topic: Topic) -> tuple[int, int] | None:
    """Return width and height of the first compressed image that decodes.

    None: none of the first few does.
    """
    for count, message in enumerate(bag.messages([topic.name])):
        try:
            image = gray_of(bag.decoded(message), topic.name, compressed=True)
        except UnreadableImageError:
            if count > 4:
                return None
            continue
        return image.shape[1], image.shape[0]
    return None


def chosen_rig(found: Contents, settings: DatasetSettings) -> tuple[Rig, Path | None, list[str]]:
    """Return the rig of the named file, else of one beside the bag, else of the CameraInfos; its
    file; and notes.

    Where the calibration states no pose of the IMU, the static frames do.

    Raises:
        CalibrationError: there is no calibration, or it is invalid.
    """
    named = settings.calibration
    beside = found.beside
    if named is not None or beside is None:
        return _with_static_pose(_rig(found, named), found), named, []
    try:
        rig = _rig(found, beside)
    except CalibrationError as error:
        if None in found.infos:
            raise
        return (
            _with_static_pose(_rig(found, None), found),
            None,
            [f"the bag's CameraInfo serves, as {error}"],
        )
    return (
        _with_static_pose(rig, found),
        beside,
        [f"the calibration is {beside.name}, not the bag's CameraInfo"],
    )


def _rig(found: Contents, file: Path | None) -> Rig:
    """Return the rig of a calibration file; of None, that of the CameraInfos."""
    topics = found.roles.cameras
    infos = found.infos
    if file is not None:
        return load_rig(file, image_size=found.size, cameras=1 if len(topics) == 1 else 2)
    known = found.index.infos
    stated = [known[name] for name in infos if name is not None and name in known]
    if len(stated) != len(topics):
        raise CalibrationError(
            f"{found.path}: no CameraInfo could be read; give --calibration FILE"
        )
    if len(set(infos)) != len(topics):
        raise CalibrationError(f"{infos[0]} belongs to both images; give --calibration FILE")
    rectified = _is_rectified(topics[0])
    if len(stated) > 1 and not states_baseline(*stated):
        T_right_left = _stereo_pose_of_frames(found.index)
        if T_right_left is not None:
            source = found.index.frames_from
            images = _of_images(stated, found.size)
            return rig_with_baseline(images, T_right_left, source, rectified=rectified)
    return rig_from_camera_infos(stated, rectified=rectified, image_size=found.size)


def _of_images(infos: Sequence[CameraInfo], size: Size | None) -> list[CameraInfo]:
    """Return the calibrations of images of a size."""
    return [info.of_images(size) for info in infos]


def _stereo_pose_of_frames(index: BagIndex) -> FloatArray | None:
    """Return the pose (4, 4) of the left camera in the right one, as the bag's frames state it."""
    left = index.left.frame_id
    right = index.right.frame_id
    if left == right:
        return None
    return index.transform(right.lstrip("/"), left.lstrip("/"))


def _with_static_pose(rig: Rig, found: Contents) -> Rig:
    index = found.index
    if rig.T_cam0_imu is not None or found.roles.imu is None:
        return rig
    T = index.transform(index.left.frame_id.lstrip("/"), index.imu_frame.lstrip("/"))
    if T is None or index.left.frame_id == index.imu_frame:
        return rig
    source = index.frames_from
    note = f"the IMU's pose is that of {source} ({index.imu_frame} in {index.left.frame_id})"
    return replace(rig, T_cam0_imu=T).noting(note)


def _is_rectified(topic: Topic) -> bool:
    """Return whether a topic's name says that its images are those after ROS's rectification."""
    return "rect" in without_transport(topic.name).rsplit("/", 1)[-1]


def motion_of(
    found: Contents, rig: Rig, times_ns: IntArray
) -> tuple[MotionSamples[MotionSample], list[str]]:
    """Return the samples in time order on the cameras' clock, and notes."""
    index = found.index
    roles = found.roles
    notes = _left_out_notes(index)
    record = index.imu_record()
    if roles.imu is not None and record is not None and not record.accel.any():
        raise DataError(
            f"{found.path}: {roles.imu.name} holds no acceleration (0 in all {len(record.accel)} "
            "messages), as where gyro and accelerometer are two topics; name both with --topics "
            "imu=/GYRO,accel=/ACCEL, or leave it out with imu=none"
        )
    if record is None and index.accel and roles.imu is not None:
        raise DataError(_apart(found))
    if rig.T_cam0_imu is None and (record is not None or index.velocities):
        return in_time_order(), [*notes, _unusable_motion(roles)]
    parts: list[Sequence[MotionSample]] = []
    if record is not None and roles.imu is not None:
        samples, moved = imu_on_camera_clock(
            record, rig, times_ns, f"{found.path}, {roles.imu.name}"
        )
        notes += [*moved, *sampling_notes(record, roles.imu.name)]
        parts.append(samples)
    if roles.velocity is not None and (speeds := index.velocity_samples()):
        check_overlap(times_ns, speeds.times_ns, roles.velocity.name)
        notes.append(f"the twist of {roles.velocity.name} is taken in the frame of T_cam0_imu")
        parts.append(speeds)
    return in_time_order(*parts), notes


def _apart(found: Contents) -> str:
    """Return what is said of a gyro and an accelerometer that no time has both of."""
    index = found.index
    assert found.roles.imu is not None
    spans = [(min(rows.times_ns), max(rows.times_ns)) for rows in (index.imu, index.accel)]
    (gyro_0, gyro_1), (accel_0, accel_1) = spans
    accel = found.roles.accel or found.roles.imu
    return (
        f"{found.path}: {found.roles.imu.name} (gyro, {gyro_0} to {gyro_1} ns) and {accel.name} "
        f"(acceleration, {accel_0} to {accel_1} ns) have no time in common: their stamps are of two "
        "clocks, so they make no IMU; record both with one clock, or leave them out with --topics "
        "imu=none"
    )


def _left_out_notes(index: BagIndex) -> list[str]:
    """Return which messages were sorted, and which are left out."""
    return [
        *(
            f"{count} messages of {topic} were recorded out of order and are sorted"
            for topic, count in index.disordered.items()
        ),
        *(
            f"{count} messages of {topic} are not finite and are left out"
            for topic, count in index.not_finite.items()
        ),
    ]


def _unusable_motion(roles: Roles) -> str:
    """Return what is said of motion sensors whose pose in the camera is unknown."""
    which = " and ".join(t.name for t in (roles.imu, roles.velocity) if t is not None)
    return (
        f"{which} cannot be used: its pose in the camera is unknown; give --calibration FILE "
        "with T_cam_imu, as "
        "Kalibr's camchain-imucam; images alone"
    )
