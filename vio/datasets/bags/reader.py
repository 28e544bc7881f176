"""A ROS bag as a recording: indexed in one pass, then streamed."""

from __future__ import annotations

import heapq
from collections.abc import Generator, Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from vio.datasets.bags import bag_files
from vio.datasets.bags.index import BagIndex, index_bag, info_topic, stamp_of
from vio.datasets.bags.pictures import gray_of, white_of
from vio.datasets.bags.store import Bag, Topic
from vio.datasets.bags.topics import COMPRESSED, Roles, choose
from vio.datasets.common import frame_range, imu_samples, merge_events, naming
from vio.datasets.image_pairs import BadFrame, ImageSize, readable_frames
from vio.datasets.images import UnreadableImageError, decode_gray
from vio.datasets.overlap import check_overlap, reference_of_body
from vio.datasets.pairing import PAIRED_NS, pair_stamps
from vio.datasets.rigs import find_calibration, load_rig
from vio.datasets.rigs.camera_info import rig_from_camera_infos
from vio.datasets.settings import DatasetSettings
from vio.datasets.tables import imu_notes
from vio.errors import CalibrationError, DataError
from vio.records import (
    NS_PER_S,
    Event,
    ImuDensities,
    IntArray,
    MotionSample,
    MotionSource,
    Observations,
    Recording,
    StereoFrame,
)
from vio.rig import Rectifier, Rig


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
    motion: tuple[MotionSample, ...] = field(repr=False)
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
        chosen = frame_range(self.recording, start, stop)
        if images:
            frames = readable_frames(self._load, self._pairs(chosen), self.settings)
        else:
            times = self.recording.frame_times_ns
            frames = (StereoFrame(k, int(times[k]), None, None) for k in chosen)
        return merge_events(self.recording, chosen, self.motion, frames)

    def observations(self, index: int) -> Observations | None:
        """Return None: the recording holds images only."""
        return None

    def _pairs(self, chosen: range) -> Generator[_Pair]:
        """Yield the pairs of a range in the order of frames, however their messages were recorded."""
        frame_of = [
            {int(stamps[k]): k for k in chosen} for stamps in (self.left_ns, self.right_ns)
        ]  # each entry is taken once
        names = self.roles.left.name, self.roles.right.name
        waiting: dict[int, Any] = {}
        complete: list[tuple[int, Any, Any]] = []
        due = chosen.start
        with Bag(self.recording.path) as bag:
            for message in bag.messages(names, int(self.logged_ns[chosen.start : chosen.stop].min())):
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
                while complete and complete[0][0] == due:
                    yield _Pair(*heapq.heappop(complete))
                    due += 1
                if due == chosen.stop:
                    return

    def _load(self, pair: _Pair) -> StereoFrame | BadFrame:
        """Decode and rectify one pair; runs in the prefetch thread."""
        images = []
        sides = ((self.roles.left, pair.left, self.sizes[0]), (self.roles.right, pair.right, self.sizes[1]))
        for topic, fields, size in sides:
            where = f"{self.recording.path}, {topic.name}, frame {pair.index}"
            try:
                image = gray_of(fields, where, compressed=topic.kind == COMPRESSED, white=self.white)
                size.check(image, Path(where))
            except UnreadableImageError as error:
                return BadFrame(pair.index, str(error))
            images.append(image)
        left, right = self.rectifier(*images)
        return StereoFrame(pair.index, int(self.recording.frame_times_ns[pair.index]), left, right)


def read_bag(path: Path, settings: DatasetSettings) -> BagDataset:
    """Read a ROS bag.

    Raises:
        MissingDependencyError: the package rosbags is not installed.
        DataError: the bag is damaged, its topics do not make a stereo recording, or no images match.
        CalibrationError: there is no calibration, or it is invalid.
    """
    beside, notes_on_files = _calibration_beside(path, settings)
    with Bag(path) as bag:
        topics = bag.topics
        roles, notes = choose(topics, settings.topics, str(path))
        infos = [info_topic(topics, topic) for topic in (roles.left, roles.right)]
        if settings.calibration is None and beside is None and None in infos:
            missing = (roles.left, roles.right)[infos.index(None)].name
            raise CalibrationError(
                f"{path}: holds no CameraInfo for {missing}; give the cameras' calibration with --calibration FILE"
            )
        index = index_bag(bag, roles, [name for name in infos if name is not None])
        size = index.left.size or _compressed_size(bag, roles.left)
    rig, file, rig_notes = _chosen_rig(index, infos, roles, settings.calibration, beside, size)
    left_ns, right_ns, logged_ns, pair_notes = _paired(index, roles, path)
    where = file or path
    with naming(where):
        rectifier = rig.rectifier(settings.interpolation, settings.projection)
    motion, sources, motion_notes = _motion(index, roles, rig, left_ns, path)
    truth = index.reference(imu=rig.T_cam0_imu is not None)
    white = white_of(max(index.left.white, index.right.white)) if index.left.white else white_of(65535)
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
            *(*_white_note(white), *notes_on_files, *rig_notes, *notes),
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


def _calibration_beside(path: Path, settings: DatasetSettings) -> tuple[Path | None, list[str]]:
    """Return the calibration file in a bag's folder where no other is named, and a note on bags that are joined."""
    parts = bag_files(path)
    notes = [f"{len(parts)} bags are joined: {', '.join(part.name for part in parts)}"] if len(parts) > 1 else []
    if settings.calibration is not None:
        return None, notes
    folders = [folder for folder in dict.fromkeys((path, *parts)) if folder.is_dir()]
    return next((found for folder in folders if (found := find_calibration(folder)) is not None), None), notes


def _compressed_size(bag: Bag, topic: Topic) -> tuple[int, int] | None:
    """Return width and height of the first compressed image that decodes; None: none of the first few does."""
    for count, message in enumerate(bag.messages([topic.name])):
        try:
            image, _ = decode_gray(bytes(bag.decoded(message).data), topic.name)
        except UnreadableImageError:
            if count > 4:
                return None
            continue
        return image.shape[1], image.shape[0]
    return None


def _chosen_rig(
    index: BagIndex,
    infos: Sequence[str | None],
    roles: Roles,
    named: Path | None,
    beside: Path | None,
    size: tuple[int, int] | None,
) -> tuple[Rig, Path | None, list[str]]:
    """Return the rig of the named file, else of one beside the bag, else of the CameraInfos; its file; and notes."""
    if named is not None or beside is None:
        return _rig(index, infos, roles, named, size), named, []
    try:
        rig = _rig(index, infos, roles, beside, size)
    except CalibrationError as error:
        if None in infos:
            raise
        return _rig(index, infos, roles, None, size), None, [f"the bag's CameraInfo serves, as {error}"]
    return rig, beside, [f"the calibration is {beside.name}, not the bag's CameraInfo"]


def _rig(
    index: BagIndex, infos: Sequence[str | None], roles: Roles, file: Path | None, size: tuple[int, int] | None
) -> Rig:
    """Return the rig of a calibration file, or of the CameraInfos, with the IMU's place from the static frames."""
    if file is not None:
        rig = load_rig(file, image_size=size)
    else:
        found = [index.infos[name] for name in infos if name is not None and name in index.infos]
        if len(found) != 2:
            raise CalibrationError(f"{infos}: no CameraInfo could be read; give --calibration FILE")
        if infos[0] == infos[1]:
            raise CalibrationError(f"{infos[0]} belongs to both images; give --calibration FILE")
        rig = rig_from_camera_infos(*found, rectified="rect" in roles.left.name.rsplit("/", 1)[-1])
    if rig.T_cam0_imu is not None or roles.imu is None:
        return rig
    T = index.transform(index.left.frame_id.lstrip("/"), index.imu_frame.lstrip("/"))
    if T is None or index.left.frame_id == index.imu_frame:
        return rig
    note = f"the IMU's pose is that of /tf_static ({index.imu_frame} in {index.left.frame_id})"
    return replace(rig, T_cam0_imu=T).noting(note)


def _paired(index: BagIndex, roles: Roles, path: Path) -> tuple[IntArray, IntArray, IntArray, list[str]]:
    """Return the stamps of the paired left and right images (F,), when they were logged (F,), and notes."""
    (left, left_logged, left_twice), (right, right_logged, right_twice) = index.left.ordered(), index.right.ordered()
    if not (len(left) and len(right)):
        raise DataError(f"{path}: no image could be read of {roles.left.name} and {roles.right.name}; copy it again")
    a, b = pair_stamps(left, right)
    if not len(a):
        spans = [f"{t[0]} to {t[-1]} ns" for t in (left, right)]
        raise DataError(
            f"{path}: no image of {roles.left.name} ({spans[0]}) has one of {roles.right.name} ({spans[1]}) within "
            f"{PAIRED_NS / 1e6:g} ms; the cameras must be synchronised"
        )
    notes = []
    for topic, stamps in ((roles.left, index.left), (roles.right, index.right)):
        if stamps.unstamped:
            notes.append(f"the headers of {topic.name} have no stamps; the times of logging are used, which jitter")
    if left_twice + right_twice:
        notes.append(f"{left_twice} left and {right_twice} right images repeat a stamp and are skipped")
    alone = len(left) - len(a), len(right) - len(b)
    if any(alone):
        notes.append(f"{alone[0]} left and {alone[1]} right images have no partner and are skipped")
    if (offset := float(np.median(right[b] - left[a])) / 1e6) != 0:
        notes.append(f"the right images are stamped {offset:+.3f} ms from the left ones (median)")
    return left[a], right[b], np.minimum(left_logged[a], right_logged[b]), notes


def _motion(
    index: BagIndex, roles: Roles, rig: Rig, times_ns: IntArray, path: Path
) -> tuple[tuple[MotionSample, ...], frozenset[MotionSource], list[str]]:
    """Return the samples in time order on the cameras' clock, their kinds, and notes."""
    notes = [
        f"{count} messages of {topic} were recorded out of order and are sorted"
        for topic, count in index.disordered.items()
    ]
    samples: list[MotionSample] = []
    sources: set[MotionSource] = set()
    record = index.imu_record()
    if rig.T_cam0_imu is None and (record is not None or index.velocities):
        which = " and ".join(t.name for t in (roles.imu, roles.velocity) if t is not None)
        notes.append(
            f"{which} cannot be used: its pose in the camera is unknown; give --calibration FILE with T_cam_imu, as "
            "Kalibr's camchain-imucam; images alone"
        )
        return (), frozenset(), notes
    if record is not None and roles.imu is not None:
        shift_ns = round(rig.time_offset_s * NS_PER_S)
        record = replace(record, times_ns=record.times_ns - shift_ns)
        if shift_ns:
            notes.append(f"the IMU's stamps are moved by {-1e3 * rig.time_offset_s:+.3f} ms, as the calibration states")
        check_overlap(times_ns, record.times_ns, f"{path}, {roles.imu.name}")
        notes += imu_notes(record.times_ns, roles.imu.name)
        samples += imu_samples(record)
        sources.add("imu")
    if roles.velocity is not None and (speeds := index.velocity_samples()):
        check_overlap(times_ns, np.array([s.time_ns for s in speeds], dtype=np.int64), roles.velocity.name)
        notes.append(f"the twist of {roles.velocity.name} is taken in the frame of T_cam0_imu")
        samples += speeds
        sources.add("velocity")
    return tuple(sorted(samples, key=lambda s: s.time_ns)), frozenset(sources), notes


def _white_note(white: int) -> list[str]:
    if white == white_of(65535):
        return []
    return [f"the images have 16 bits but use {white.bit_length()}: the levels 0 to {white} are scaled to 8 bits"]
