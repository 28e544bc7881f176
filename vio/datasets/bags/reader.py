"""A ROS bag of one camera or two as a recording: indexed in one pass, then streamed."""

from __future__ import annotations

import heapq
from collections import deque
from collections.abc import Generator, Sequence
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np

from vio.datasets.bags.companions import chosen_rig, contents, motion_of
from vio.datasets.bags.index import Stamps, stamp_of
from vio.datasets.bags.pictures import gray_of
from vio.datasets.bags.store import Bag, Topic
from vio.datasets.bags.topics import COMPRESSED
from vio.datasets.common import naming
from vio.datasets.companions import reference_of_body
from vio.datasets.frame_times import paired
from vio.datasets.image_pairs import BadFrame, ImageRecording, ImageSize, readable_frames
from vio.datasets.images import UnreadableImageError
from vio.datasets.levels import Levels, levels_of, mosaic_note
from vio.datasets.settings import DatasetSettings
from vio.errors import CalibrationError, DataError
from vio.records import IntArray, Recording, StereoFrame

# of a frame: its number, and the image of each camera, decoded but for its pixels
_Messages = tuple[int, list[Any]]


@dataclass(frozen=True, slots=True)
class BagDataset(ImageRecording):
    """Implements `vio.protocols.Dataset` over the images of one or two topics; every pass
    streams the bag again.
    """

    topics: tuple[Topic, ...]  # of the images: left, and right where there is one
    stamps_ns: tuple[IntArray, ...]  # (F,) stamps of the images of each topic, of a pair in one row
    logged_ns: IntArray  # (F,) when the bag received the first image of each frame
    levels: Levels  # of 16-bit images
    # of each topic: the headers have no stamps, the times of logging serve
    unstamped: tuple[bool, ...]

    def _frames(self, chosen: Sequence[int]) -> Generator[StereoFrame]:
        return readable_frames(self._load, self._messages(chosen), self.settings)

    def _messages(self, chosen: Sequence[int]) -> Generator[_Messages]:
        """Yield the chosen frames' messages in the order of frames, however they were recorded."""
        # each entry is taken once
        frame_of = [{int(stamps[k]): k for k in chosen} for stamps in self.stamps_ns]
        names = [topic.name for topic in self.topics]
        waiting: dict[int, list[Any]] = {}
        complete: list[_Messages] = []
        due = deque(chosen)
        with Bag(self.recording.path) as bag:
            for message in bag.messages(names, int(self.logged_ns[chosen].min())):
                side = names.index(message.topic)
                fields = bag.decoded(message)
                k = frame_of[side].pop(
                    message.logged_ns if self.unstamped[side] else stamp_of(fields), None
                )
                if k is None:
                    continue
                waiting.setdefault(k, [None] * len(names))[side] = fields
                if any(part is None for part in waiting[k]):
                    continue
                heapq.heappush(complete, (k, waiting.pop(k)))
                while complete and complete[0][0] == due[0]:
                    yield heapq.heappop(complete)
                    due.popleft()
                if not due:
                    return

    def _load(self, item: _Messages) -> StereoFrame | BadFrame:
        """Decode and rectify one frame; runs in the prefetch thread."""
        index, messages = item
        images = []
        for topic, fields, size in islice(
            zip(self.topics, messages, self.sizes, strict=True), self.settings.cameras
        ):
            where = f"{self.recording.path}, {topic.name}, frame {index}"
            try:
                compressed = topic.kind == COMPRESSED
                images.append(
                    gray_of(
                        fields, where, compressed=compressed, levels=self.levels, colour=self.colour
                    )
                )
                size.check(images[-1], Path(where))
            except UnreadableImageError as error:
                return BadFrame(index, str(error))
        return self.rectifier.frame(index, int(self.recording.frame_times_ns[index]), *images)


def read_bag(path: Path, settings: DatasetSettings) -> BagDataset:
    """Read a ROS bag.

    Raises:
        MissingDependencyError: the package rosbags is not installed.
        DataError: the bag is damaged, its topics do not make a recording, or no images match.
        CalibrationError: there is no calibration, it is invalid, or that of one camera states no
            pose of its IMU.
    """
    found = contents(path, settings)
    roles = found.roles
    index = found.index
    rig, file, rig_notes = chosen_rig(found, settings)
    if rig.cam1 is None and rig.T_cam0_imu is None and roles.imu is not None:
        raise CalibrationError(
            f"{path}: the pose of {roles.imu.name} in the camera is unknown, and one camera needs "
            "its IMU; give "
            "--calibration FILE with T_cam_imu (Kalibr's camchain-imucam), or record /tf_static"
        )
    stamps = (index.left, index.right)[: len(roles.cameras)]
    stamps_ns, logged_ns, image_notes = _frames(
        stamps, [topic.name for topic in roles.cameras], path
    )
    with naming(file or path):
        rectifier = rig.rectifier(settings.interpolation, settings.projection)
    motion, motion_notes = motion_of(found, rig, stamps_ns[0])
    truth = index.reference(imu=rig.T_cam0_imu is not None)
    levels = levels_of([*index.left.bands, *index.right.bands])
    level_notes = [
        *levels.note,
        *(
            mosaic_note(f"{path}, {topic.name}")
            for topic, images in zip(roles.cameras, stamps, strict=True)
            if images.mosaic
        ),
    ]
    recording = Recording(
        kind="bag",
        path=path,
        camera=rectifier.camera,
        T_cam0_imu=None if rig.T_cam0_imu is None else rectifier.T_rect0_imu,
        frame_times_ns=stamps_ns[0],
        has_images=True,
        motion=motion.kinds,
        reference=None if truth is None else reference_of_body(truth, rig, rectifier),
        notes=(
            *(*rig.notes, *rectifier.notes, *image_notes, *motion_notes),
            *(*level_notes, *rig_notes, *found.notes),
        ),
    )
    sizes = tuple(
        ImageSize(camera.width, camera.height, Path(file or info or path))
        for camera, info in zip(rig.cameras, found.infos, strict=True)
    )
    images = roles.cameras, stamps_ns, logged_ns, levels, tuple(each.unstamped for each in stamps)
    return BagDataset(
        recording, motion, sizes, settings, rectifier, *images, imu_noise=rig.imu_noise
    )


def _frames(
    images: Sequence[Stamps], names: Sequence[str], path: Path
) -> tuple[tuple[IntArray, ...], IntArray, list[str]]:
    """Return the stamps of each topic's images (F,), when the first of each frame was logged
    (F,), and notes.
    """
    ordered = [stamps.ordered() for stamps in images]
    times = [each[0] for each in ordered]
    logged = [each[1] for each in ordered]
    if not all(len(each) for each in times):
        raise DataError(f"{path}: no image could be read of {' and '.join(names)}; copy it again")
    notes = [
        f"the headers of {name} have no stamps; the times of logging are used, which jitter"
        for name, stamps in zip(names, images, strict=True)
        if stamps.unstamped
    ]
    twice = [each[2] for each in ordered]
    if any(twice):
        which = f"{twice[0]}" if len(twice) == 1 else f"{twice[0]} left and {twice[1]} right"
        notes.append(f"{which} images repeat a stamp and are skipped")
    if len(images) == 1:
        return (times[0],), logged[0], notes
    left, right = times
    a, b, differing = paired(left, right, names, path)
    return (left[a], right[b]), np.minimum(logged[0][a], logged[1][b]), [*notes, *differing]
