"""The frames of a bag's sensors where /tf_static does not connect them, and a stereo baseline that
only they state.

RealSense's own recorder writes one geometry_msgs/Transform a stream, `STREAM/tf/GROUP`, between the
stream and one that is common to the group. Which way it maps is settled by the cameras: the second
one is to the right of the first one.
"""

from __future__ import annotations

import re
from collections.abc import Sequence

import numpy as np

from vio.cameras.rig import Rig
from vio.datasets.bags.index import BagIndex, names_of, transform_of
from vio.datasets.bags.store import Bag, Topic
from vio.datasets.bags.topics import TF, TRANSFORM, Roles
from vio.datasets.rigs.camera_info import CameraInfo, rig_from_camera_infos
from vio.errors import CalibrationError
from vio.geometry.lie import FloatArray, se3_inverse

_SAME = 1e-6  # metres and entries of a rotation, within which a frame of /tf does not move
_SDK_STREAM = re.compile(r"(.+)/(?:image|imu)/data")
_SIDEWAYS = 0.7  # share of a baseline that is along the rows of the left image


def states_baseline(left: CameraInfo, right: CameraInfo) -> bool:
    """Return whether CameraInfos state the place of the right camera: P[0, 3] is not zero there, and
    puts it to the right of the left camera.
    """
    if not (right.P[0, 0] > 0 and right.P[0, 3] != 0):
        return False
    return not left.P[0, 0] > 0 or bool(right.P[0, 3] / right.P[0, 0] < left.P[0, 3] / left.P[0, 0])


def rig_with_baseline(
    infos: Sequence[CameraInfo], T_right_left: FloatArray, source: str, *, rectified: bool
) -> Rig:
    """Return the rig of a pair whose CameraInfos state no baseline, by the frames of its images.

    Args:
        infos: of the left and the right camera.
        T_right_left: (4, 4) between the frames of the images.
        source: what states them, for the note.
        rectified: the images are those after ROS's rectification.

    Raises:
        CalibrationError: the right camera is not beside the left one.
    """
    position = se3_inverse(T_right_left)[:3, 3]
    baseline_m = float(np.linalg.norm(position))
    where = infos[1].where
    stated = float(infos[1].P[0, 3])
    fault = f"P[0, 3] is {stated:g}" + (" and gives no positive baseline" if stated else "")
    if not position[0] > _SIDEWAYS * baseline_m:
        place = ", ".join(f"{x:.3f}" for x in position)
        raise CalibrationError(
            f"{where}: {fault}, and the frames of the images put the right camera at {place} m "
            "in the left one, not beside it (x to the right, z forward); give a calibration with "
            "--calibration FILE"
        )
    note = f"{where}: {fault}; the baseline of {baseline_m:.4f} m is that of {source}"
    left, right = (rig_from_camera_infos([info], rectified=rectified).cam0 for info in infos)
    parallel = np.allclose(T_right_left[:3, :3], np.eye(3), atol=_SAME)
    same = all(
        getattr(left, name) == getattr(right, name) for name in ("fu", "fv", "cu", "cv", "model")
    )
    if parallel and same and left.model == "pinhole" and position[0] > (1 - _SAME) * baseline_m:
        rig = Rig.rectified(left.fu, left.fv, left.cu, left.cv, baseline_m, left.width, left.height)
        return rig.noting(note)
    return Rig(left, right, T_right_left).noting(note)


def add_frames_of_tf(bag: Bag, index: BagIndex, roles: Roles, infos: Sequence[str | None]) -> None:
    """Add the frames that do not move of /tf, or those of RealSense's recorder, where the static
    ones do not connect the sensors in use.

    Args:
        bag: the opened bag.
        index: what one pass over it found.
        roles: its topics.
        infos: topic of the CameraInfo of each camera.
    """
    if _add_sdk_frames(bag, index, roles) or _connected(index, roles, infos):
        return
    fixed = {key: T for key, T in _fixed_frames(bag).items() if key not in index.frames}
    index.frames.update(fixed)
    if fixed and _connected(index, roles, infos):
        index.frames_from = "/tf, where it does not change"


def _fixed_frames(bag: Bag) -> dict[tuple[str, str], FloatArray]:
    """Return the transforms (4, 4) on /tf that never change, by parent and child."""
    topics = [t.name for t in bag.topics if t.kind == TF and not t.name.endswith("tf_static")]
    first: dict[tuple[str, str], FloatArray] = {}
    moving: set[tuple[str, str]] = set()
    for message in bag.messages(topics):
        for item in bag.decoded(message).transforms:
            key = names_of(item)
            T = transform_of(item.transform)
            if np.abs(T - first.setdefault(key, T)).max() > _SAME:
                moving.add(key)
    return {key: T for key, T in first.items() if key not in moving}


def _connected(index: BagIndex, roles: Roles, infos: Sequence[str | None]) -> bool:
    """Return whether the static frames connect the sensors whose place nothing else states."""
    left = index.left.frame_id.lstrip("/")
    others = [index.imu_frame] if roles.imu is not None else []
    stated = [index.infos[name] for name in infos if name in index.infos]
    if len(stated) > 1 and not states_baseline(*stated):
        others.append(index.right.frame_id)
    return all(index.transform(left, name.lstrip("/")) is not None for name in others)


def _add_sdk_frames(bag: Bag, index: BagIndex, roles: Roles) -> bool:
    """Take the frames of RealSense's recorder; return whether the bag is one of it."""
    left = _SDK_STREAM.fullmatch(roles.left.name)
    if left is None:
        return False
    transforms = _sdk_transforms(bag, list(filter(None, (*roles.cameras, roles.imu))))
    if roles.left.name not in transforms:
        return False
    T_left = transforms[roles.left.name]
    right = None if roles.right is None else transforms.get(roles.right.name)
    if right is not None and (se3_inverse(T_left) @ right)[0, 3] < 0:
        transforms = {name: se3_inverse(T) for name, T in transforms.items()}
    index.left.frame_id = roles.left.name
    index.right.frame_id = "" if roles.right is None else roles.right.name
    index.imu_frame = "" if roles.imu is None else roles.imu.name
    index.frames |= {("realsense", name.lstrip("/")): T for name, T in transforms.items()}
    index.frames_from = "the transforms of RealSense's recorder"
    return True


def _sdk_transforms(bag: Bag, sensors: Sequence[Topic]) -> dict[str, FloatArray]:
    """Return the transform of each sensor's stream, in the first group that the left camera has."""
    first = _first_transforms(bag)
    found: dict[str, FloatArray] = {}
    group = None
    for sensor in sensors:
        stream = _SDK_STREAM.fullmatch(sensor.name)
        if stream is None:
            names = []
        else:
            names = [n for n in first if n.startswith(f"{stream[1]}/tf/")]
        named = {name.rsplit("/", 1)[-1]: name for name in names}
        if group is None and named:
            group = min(named)
        if group in named:
            found[sensor.name] = first[named[group]]
    return found


def _first_transforms(bag: Bag) -> dict[str, FloatArray]:
    """Return the first transform (4, 4) of each topic of transforms."""
    known = [t.name for t in bag.topics if t.kind == TRANSFORM and t.count]
    first: dict[str, FloatArray] = {}
    for message in bag.messages(known):
        if message.topic not in first:
            first[message.topic] = transform_of(bag.decoded(message))
    return first
