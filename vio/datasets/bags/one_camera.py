"""A ROS bag with one image topic as a recording of one camera."""

from __future__ import annotations

import heapq
from collections import deque
from collections.abc import Generator, Iterator, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

from vio.cameras.camera_rig import CameraRig, Undistorter
from vio.datasets.bags.companions import Contents, chosen_rig, is_rectified, motion_of, white_level
from vio.datasets.bags.index import stamp_of
from vio.datasets.bags.pictures import gray_of
from vio.datasets.bags.store import Bag, Topic
from vio.datasets.bags.topics import COMPRESSED
from vio.datasets.common import blank_frames, chosen_frames, merge_events, naming
from vio.datasets.image_pairs import BadFrame, ImageSize, readable_frames
from vio.datasets.images import UnreadableImageError
from vio.datasets.overlap import reference_of_body
from vio.datasets.rigs.camera_info import rig_from_camera_info
from vio.datasets.rigs.one_camera import load_camera
from vio.datasets.settings import DatasetSettings
from vio.errors import CalibrationError, DataError
from vio.records import Event, ImuDensities, IntArray, MotionSample, Observations, Recording, StereoFrame


@dataclass(frozen=True, slots=True)
class OneCameraBag:
    """Implements `vio.protocols.Dataset` over the one image topic of a ROS bag; every pass streams it again."""

    recording: Recording
    topic: Topic
    logged_ns: IntArray  # (F,) when the bag received each image
    motion: Sequence[MotionSample] = field(repr=False)  # in time order
    size: ImageSize
    settings: DatasetSettings
    undistorter: Undistorter
    white: int  # level of white of 16-bit images
    unstamped: bool  # the headers have no stamps, the times of logging serve
    imu_noise: ImuDensities | None = None

    def events(self, start: int = 0, stop: int | None = None, *, images: bool = True) -> Iterator[Event]:
        """Yield events of the frames `start <= index < stop` in time order.

        A frame whose image does not decode or has another size is skipped with a warning, as the settings allow.

        Raises:
            DataError: the range holds no frame, or none that can be used, or the bag is damaged.
        """
        chosen = chosen_frames(self.recording, start, stop, self.settings.max_frame_rate)
        frames = (
            readable_frames(self._load, self._messages(chosen), self.settings)
            if images
            else blank_frames(self.recording, chosen)
        )
        return merge_events(self.recording, chosen, self.motion, frames)

    def observations(self, index: int) -> Observations | None:
        """Return None: the recording holds images only."""
        return None

    def _messages(self, chosen: Sequence[int]) -> Generator[tuple[int, Any]]:
        """Yield frame numbers and image messages in the order of frames, however they were recorded."""
        times_ns = self.recording.frame_times_ns
        frame_of = {int(times_ns[k]): k for k in chosen}  # each entry is taken once
        early: list[tuple[int, Any]] = []
        due = deque(chosen)
        with Bag(self.recording.path) as bag:
            for message in bag.messages([self.topic.name], int(self.logged_ns[chosen].min())):
                fields = bag.decoded(message)
                k = frame_of.pop(message.logged_ns if self.unstamped else stamp_of(fields), None)
                if k is None:
                    continue
                heapq.heappush(early, (k, fields))
                while early and early[0][0] == due[0]:
                    yield heapq.heappop(early)
                    due.popleft()
                if not due:
                    return

    def _load(self, item: tuple[int, Any]) -> StereoFrame | BadFrame:
        """Decode and undistort one image; runs in the prefetch thread."""
        index, fields = item
        where = f"{self.recording.path}, {self.topic.name}, frame {index}"
        try:
            image = gray_of(fields, where, compressed=self.topic.kind == COMPRESSED, white=self.white)
            self.size.check(image, Path(where))
        except UnreadableImageError as error:
            return BadFrame(index, str(error))
        return StereoFrame(index, int(self.recording.frame_times_ns[index]), self.undistorter(image), None)


def read_one_camera(found: Contents, settings: DatasetSettings) -> OneCameraBag:
    """Read a bag with one image topic.

    Raises:
        DataError: no image could be read, or the IMU has another clock.
        CalibrationError: the calibration is invalid, or states no pose of the IMU.
    """
    path, roles, index = found.path, found.roles, found.index
    rig, file, rig_notes = chosen_rig(found, settings, partial(_camera_rig, found))
    if rig.T_cam0_imu is None and roles.imu is not None:
        raise CalibrationError(
            f"{path}: the pose of {roles.imu.name} in the camera is unknown, and one camera needs its IMU; give "
            "--calibration FILE with T_cam_imu (Kalibr's camchain-imucam), or record /tf_static"
        )
    times_ns, logged_ns, image_notes = _stamps(found)
    with naming(file or path):
        undistorter = rig.undistorter(settings.interpolation)
    motion, sources, motion_notes = motion_of(found, rig, times_ns)
    truth = index.reference(imu=rig.T_cam0_imu is not None)
    white, white_notes = white_level(index)
    recording = Recording(
        kind="bag",
        path=path,
        camera=undistorter.camera,
        T_cam0_imu=rig.T_cam0_imu,
        frame_times_ns=times_ns,
        has_images=True,
        motion=sources,
        reference=None if truth is None else reference_of_body(truth, rig, undistorter),
        notes=(*rig.notes, *image_notes, *motion_notes, *white_notes, *rig_notes, *found.notes),
    )
    size = ImageSize(rig.cam0.width, rig.cam0.height, Path(file or found.infos[0] or path))
    unstamped = index.left.unstamped
    return OneCameraBag(
        recording, roles.left, logged_ns, motion, size, settings, undistorter, white, unstamped, rig.imu_noise
    )


def _camera_rig(found: Contents, file: Path | None) -> CameraRig:
    """Return the rig of a calibration file; of None, that of the CameraInfo."""
    if file is not None:
        return load_camera(file, image_size=found.size)
    info = found.index.infos.get(found.infos[0] or "")
    if info is None:
        raise CalibrationError(f"{found.path}: no CameraInfo could be read; give --calibration FILE")
    return rig_from_camera_info(info, rectified=is_rectified(found.roles.left))


def _stamps(found: Contents) -> tuple[IntArray, IntArray, list[str]]:
    """Return the stamps of the images (F,), when they were logged (F,), and notes."""
    name, stamps = found.roles.left.name, found.index.left
    times_ns, logged_ns, twice = stamps.ordered()
    if not len(times_ns):
        raise DataError(f"{found.path}: no image could be read of {name}; copy it again")
    notes = []
    if stamps.unstamped:
        notes.append(f"the headers of {name} have no stamps; the times of logging are used, which jitter")
    if twice:
        notes.append(f"{twice} images repeat a stamp and are skipped")
    return times_ns, logged_ns, notes
