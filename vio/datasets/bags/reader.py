"""A ROS bag as a recording: indexed in one pass, then streamed."""

from __future__ import annotations

import heapq
from collections import deque
from collections.abc import Generator, Iterator, Sequence
from dataclasses import dataclass, field
from functools import partial
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np

from vio.cameras.rig import Rectifier, Rig
from vio.datasets.bags.companions import Contents, chosen_rig, contents, is_rectified, motion_of, white_level
from vio.datasets.bags.index import BagIndex, stamp_of
from vio.datasets.bags.one_camera import OneCameraBag, read_one_camera
from vio.datasets.bags.pictures import gray_of
from vio.datasets.bags.store import Bag
from vio.datasets.bags.topics import COMPRESSED, Roles
from vio.datasets.common import blank_frames, chosen_frames, merge_events, naming
from vio.datasets.image_pairs import BadFrame, ImageSize, readable_frames
from vio.datasets.images import UnreadableImageError
from vio.datasets.overlap import reference_of_body
from vio.datasets.pairing import PAIRED_NS, pair_stamps
from vio.datasets.rigs import load_rig
from vio.datasets.rigs.camera_info import rig_from_camera_infos
from vio.datasets.settings import DatasetSettings
from vio.errors import CalibrationError, DataError
from vio.records import Event, ImuDensities, IntArray, MotionSample, Observations, Recording, StereoFrame


@dataclass(frozen=True, slots=True)
class _Pair:
    """The two messages of a frame, decoded but for their pixels."""

    index: int
    left: Any
    right: Any


@dataclass(frozen=True, slots=True)
class BagDataset:
    """Implements `vio.protocols.Dataset` over a ROS bag; every pass streams it again."""

    recording: Recording
    roles: Roles
    left_ns: IntArray  # (F,) stamps of the paired left images
    right_ns: IntArray  # (F,) of the right ones
    logged_ns: IntArray  # (F,) when the bag received the first of each pair
    motion: Sequence[MotionSample] = field(repr=False)
    sizes: tuple[ImageSize, ImageSize]
    settings: DatasetSettings
    rectifier: Rectifier
    white: int  # level of white of 16-bit images
    unstamped: tuple[bool, bool]  # left, right: the headers have no stamps, the times of logging serve
    imu_noise: ImuDensities | None = None

    def events(self, start: int = 0, stop: int | None = None, *, images: bool = True) -> Iterator[Event]:
        """Yield events of the frames `start <= index < stop` in time order.

        A frame whose image does not decode or has another size is skipped with a warning, as the settings allow.

        Raises:
            DataError: the range holds no frame, an image has another size, or the bag is damaged.
        """
        chosen = chosen_frames(self.recording, start, stop, self.settings.max_frame_rate)
        frames = (
            readable_frames(self._load, self._pairs(chosen), self.settings)
            if images
            else blank_frames(self.recording, chosen)
        )
        return merge_events(self.recording, chosen, self.motion, frames)

    def observations(self, index: int) -> Observations | None:
        """Return None: the recording holds images only."""
        return None

    def _pairs(self, chosen: Sequence[int]) -> Generator[_Pair]:
        """Yield chosen pairs in the order of frames, however their messages were recorded."""
        frame_of = [
            {int(stamps[k]): k for k in chosen} for stamps in (self.left_ns, self.right_ns)
        ]  # each entry is taken once
        names = [topic.name for topic in self.roles.cameras]
        waiting: dict[int, Any] = {}
        complete: list[tuple[int, Any, Any]] = []
        due = deque(chosen)
        with Bag(self.recording.path) as bag:
            for message in bag.messages(names, int(self.logged_ns[chosen].min())):
                side = names.index(message.topic)
                fields = bag.decoded(message)
                stamp_ns = message.logged_ns if self.unstamped[side] else stamp_of(fields)
                k = frame_of[side].pop(stamp_ns, None)
                if k is None:
                    continue
                if k not in waiting:
                    waiting[k] = fields
                    continue
                first = waiting.pop(k)
                heapq.heappush(complete, (k, *((first, fields) if side == 1 else (fields, first))))
                while complete and complete[0][0] == due[0]:
                    yield _Pair(*heapq.heappop(complete))
                    due.popleft()
                if not due:
                    return

    def _load(self, pair: _Pair) -> StereoFrame | BadFrame:
        """Decode and rectify one pair; runs in the prefetch thread."""
        images = []
        of_both = zip(self.roles.cameras, (pair.left, pair.right), self.sizes, strict=True)
        for topic, fields, size in islice(of_both, self.settings.cameras):
            where = f"{self.recording.path}, {topic.name}, frame {pair.index}"
            try:
                image = gray_of(fields, where, compressed=topic.kind == COMPRESSED, white=self.white)
                size.check(image, Path(where))
            except UnreadableImageError as error:
                return BadFrame(pair.index, str(error))
            images.append(image)
        time_ns = int(self.recording.frame_times_ns[pair.index])
        if len(images) == 1:
            return StereoFrame(pair.index, time_ns, self.rectifier.left(images[0]), None)
        return StereoFrame(pair.index, time_ns, *self.rectifier(*images))


def read_bag(path: Path, settings: DatasetSettings) -> BagDataset | OneCameraBag:
    """Read a ROS bag.

    Raises:
        MissingDependencyError: the package rosbags is not installed.
        DataError: the bag is damaged, its topics do not make a recording, or no images match.
        CalibrationError: there is no calibration, or it is invalid.
    """
    found = contents(path, settings)
    return read_one_camera(found, settings) if found.roles.right is None else _read_pair(found, settings)


def _read_pair(found: Contents, settings: DatasetSettings) -> BagDataset:
    path, roles, index, infos = found.path, found.roles, found.index, found.infos
    rig, file, rig_notes = chosen_rig(found, settings, partial(_rig, found))
    left_ns, right_ns, logged_ns, pair_notes = _paired(index, roles, path)
    where = file or path
    with naming(where):
        rectifier = rig.rectifier(settings.interpolation, settings.projection)
    motion, sources, motion_notes = motion_of(found, rig, left_ns)
    truth = index.reference(imu=rig.T_cam0_imu is not None)
    white, white_notes = white_level(index)
    recording = Recording(
        kind="bag",
        path=path,
        camera=rectifier.camera,
        T_cam0_imu=None if rig.T_cam0_imu is None else rectifier.T_rect0_imu,
        frame_times_ns=left_ns,
        has_images=True,
        motion=sources,
        reference=None if truth is None else reference_of_body(truth, rig, rectifier),
        notes=(
            *(*rig.notes, *rectifier.notes, *pair_notes, *motion_notes),
            *(*white_notes, *rig_notes, *found.notes),
        ),
    )
    sizes = (
        ImageSize(rig.cam0.width, rig.cam0.height, Path(infos[0] or where)),
        ImageSize(rig.cam1.width, rig.cam1.height, Path(infos[1] or where)),
    )
    unstamped = index.left.unstamped, index.right.unstamped
    return BagDataset(
        recording,
        roles,
        left_ns,
        right_ns,
        logged_ns,
        motion,
        sizes,
        settings,
        rectifier,
        white,
        unstamped,
        rig.imu_noise,
    )


def _rig(found: Contents, file: Path | None) -> Rig:
    """Return the rig of a calibration file; of None, that of the CameraInfos."""
    if file is not None:
        return load_rig(file, image_size=found.size)
    infos = found.infos
    stated = [found.index.infos[name] for name in infos if name is not None and name in found.index.infos]
    if len(stated) != 2:
        raise CalibrationError(f"{infos}: no CameraInfo could be read; give --calibration FILE")
    if infos[0] == infos[1]:
        raise CalibrationError(f"{infos[0]} belongs to both images; give --calibration FILE")
    return rig_from_camera_infos(*stated, rectified=is_rectified(found.roles.left))


def _paired(index: BagIndex, roles: Roles, path: Path) -> tuple[IntArray, IntArray, IntArray, list[str]]:
    """Return the stamps of the paired left and right images (F,), when they were logged (F,), and notes."""
    (left, left_logged, left_twice), (right, right_logged, right_twice) = index.left.ordered(), index.right.ordered()
    names = [topic.name for topic in roles.cameras]
    if not (len(left) and len(right)):
        raise DataError(f"{path}: no image could be read of {names[0]} and {names[1]}; copy it again")
    a, b = pair_stamps(left, right)
    if not len(a):
        spans = [f"{t[0]} to {t[-1]} ns" for t in (left, right)]
        raise DataError(
            f"{path}: no image of {names[0]} ({spans[0]}) has one of {names[1]} ({spans[1]}) within "
            f"{PAIRED_NS / 1e6:g} ms; the cameras must be synchronised"
        )
    notes = []
    for name, stamps in zip(names, (index.left, index.right), strict=True):
        if stamps.unstamped:
            notes.append(f"the headers of {name} have no stamps; the times of logging are used, which jitter")
    if left_twice + right_twice:
        notes.append(f"{left_twice} left and {right_twice} right images repeat a stamp and are skipped")
    alone = len(left) - len(a), len(right) - len(b)
    if any(alone):
        notes.append(f"{alone[0]} left and {alone[1]} right images have no partner and are skipped")
    if (offset := float(np.median(right[b] - left[a])) / 1e6) != 0:
        notes.append(f"the right images are stamped {offset:+.3f} ms from the left ones (median)")
    return left[a], right[b], np.minimum(left_logged[a], right_logged[b]), notes
