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
from vio.datasets.frame_times import nearest, paired
from vio.datasets.image_pairs import BadFrame, ImageRecording, ImageSize, readable_frames
from vio.datasets.images import UnreadableImageError
from vio.datasets.levels import Levels, levels_of, mosaic_note
from vio.datasets.settings import DatasetSettings
from vio.errors import CalibrationError, DataError
from vio.numerics.robust import median
from vio.records import IntArray, Recording, StereoFrame

# of a frame: its number, and the image of each camera, decoded but for its pixels
_Messages = tuple[int, list[Any]]


@dataclass(frozen=True, slots=True)
class BagDataset(ImageRecording):
    """Implements `vio.protocols.Dataset` over the images of one or two topics; every pass
    streams the bag again.
    """

    topics: tuple[Topic, ...]  # of the images: left, and right where there is one
    # stamp and time of recording of the images of each topic (F, 2), of a pair in one row
    keys: tuple[IntArray, ...]
    logged_ns: IntArray  # (F,) when the bag received the first image of each frame
    levels: Levels  # of 16-bit images

    def _frames(self, chosen: Sequence[int]) -> Generator[StereoFrame]:
        return readable_frames(self._load, self._messages(chosen), self.settings)

    def _messages(self, chosen: Sequence[int]) -> Generator[_Messages]:
        """Yield the chosen frames' messages in the order of frames, however they were recorded."""
        # each entry is taken once
        frame_of = [{(int(keys[k, 0]), int(keys[k, 1])): k for k in chosen} for keys in self.keys]
        names = [topic.name for topic in self.topics]
        waiting: dict[int, list[Any]] = {}
        complete: list[_Messages] = []
        due = deque(chosen)
        with Bag(self.recording.path) as bag:
            for message in bag.messages(names, int(self.logged_ns[chosen].min())):
                side = names.index(message.topic)
                fields = bag.decoded(message)
                k = frame_of[side].pop((stamp_of(fields), message.logged_ns), None)
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
    topics = [topic.name for topic in roles.cameras]
    times_ns, keys, image_notes = _frames(stamps, topics, path)
    logged_ns = np.min([key[:, 1] for key in keys], axis=0)
    with naming(file or path):
        rectifier = rig.rectifier(settings.interpolation, settings.projection)
    motion, motion_notes = motion_of(found, rig, times_ns)
    truth = index.reference(imu=rig.T_cam0_imu is not None)
    levels = levels_of([*index.left.bands, *index.right.bands])
    level_notes = [*levels.note, *_mosaic_notes(stamps, topics, path)]
    T_cam0_imu = None
    if rig.T_cam0_imu is not None:
        T_cam0_imu = rectifier.T_rect0_imu
    reference = None
    if truth is not None:
        reference = reference_of_body(truth, rig, rectifier)
    recording = Recording(
        kind="bag",
        path=path,
        camera=rectifier.camera,
        T_cam0_imu=T_cam0_imu,
        frame_times_ns=times_ns,
        has_images=True,
        motion=motion.kinds,
        reference=reference,
        notes=(
            *(*rig.notes, *rectifier.notes, *image_notes, *motion_notes),
            *(*level_notes, *rig_notes, *index.notes, *found.notes),
        ),
    )
    sizes = tuple(
        ImageSize(camera.width, camera.height, Path(file or info or path))
        for camera, info in zip(rig.cameras, found.infos, strict=True)
    )
    images = roles.cameras, keys, logged_ns, levels
    return BagDataset(
        recording, motion, sizes, settings, rectifier, *images, imu_noise=rig.imu_noise
    )


def _mosaic_notes(images: Sequence[Stamps], topics: Sequence[str], path: Path) -> list[str]:
    """Return a note for each topic whose images are a mosaic of colours said to be gray."""
    return [
        mosaic_note(f"{path}, {topic}")
        for topic, stamps in zip(topics, images, strict=True)
        if stamps.mosaic
    ]


def _frames(
    images: Sequence[Stamps], names: Sequence[str], path: Path
) -> tuple[IntArray, tuple[IntArray, ...], list[str]]:
    """Return the times of the frames (F,), the stamp and the time of recording of each topic's
    images (F, 2), and notes.
    """
    ordered = [stamps.ordered() for stamps in images]
    times = [each[0] for each in ordered]
    keys = [_keys(stamps)[each[1]] for stamps, each in zip(images, ordered, strict=True)]
    if not all(len(each) for each in times):
        raise DataError(f"{path}: no image could be read of {' and '.join(names)}; copy it again")
    notes = _stamp_notes(images, names, [each[2] for each in ordered])
    if len(images) == 1:
        return times[0], (keys[0],), notes
    left, right = times
    if images[0].unstamped != images[1].unstamped:
        a, b = _paired_by_logging(keys[0][:, 1], keys[1][:, 1])
        stamped_ns = left[a] if images[1].unstamped else right[b]
        notes.append("the images are paired by their times of logging")
        return stamped_ns, (keys[0][a], keys[1][b]), notes
    a, b, differing = paired(left, right, names, path)
    return left[a], (keys[0][a], keys[1][b]), [*notes, *differing]


def _stamp_notes(images: Sequence[Stamps], names: Sequence[str], twice: Sequence[int]) -> list[str]:
    """Return what is said of the stamps of one or two topics, of which some images repeat one."""
    notes = [
        f"the headers of {name} have no stamps; the times of logging are used, which jitter"
        for name, stamps in zip(names, images, strict=True)
        if stamps.unstamped
    ]
    if any(twice):
        if len(twice) == 1:
            which = f"{twice[0]}"
        else:
            which = f"{twice[0]} left and {twice[1]} right"
        notes.append(f"{which} images repeat a stamp and are skipped")
    return notes


def _keys(stamps: Stamps) -> IntArray:
    return np.array(stamps.raw, dtype=np.int64).reshape(-1, 2)


def _paired_by_logging(left_ns: IntArray, right_ns: IntArray) -> tuple[IntArray, IntArray]:
    """Return the rows (F,), (F,) of images that were recorded closest to each other, and closer
    than half of the left camera's interval.
    """
    interval_ns = 0.0
    if len(left_ns) > 1:
        interval_ns = median(np.diff(left_ns))
    b = nearest(left_ns, right_ns)
    a = np.arange(len(left_ns))
    close = np.abs(right_ns[b] - left_ns) <= interval_ns / 2
    rows = np.flatnonzero(close & (nearest(right_ns, left_ns)[b] == a))
    return rows, b[rows]
