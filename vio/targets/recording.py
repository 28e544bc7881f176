"""A recording of a board: its raw images, whatever its calibration says, and its IMU.

Any recording that the readers know can be read, and needs no calibration: it is opened with a
stand-in, two equal pinholes with rows aligned, by which images pass unchanged. A folder with files
`left*` and `right*` is read as well.
"""

from __future__ import annotations

import os
import tempfile
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import NamedTuple

import numpy as np

from vio.cameras.rig import Rig
from vio.datasets import DatasetSettings, open_dataset
from vio.datasets.image_files import ImageFiles
from vio.datasets.image_pairs import ImagePairs, ImageRecording, measured_images, pair_images
from vio.datasets.image_times import pair_files
from vio.datasets.images import SUFFIXES, UnreadableImageError, list_images, load_gray
from vio.datasets.plain import image_layout
from vio.datasets.rigs.kalibr import kalibr_text
from vio.datasets.videos import video_files
from vio.errors import CalibrationError, DataError
from vio.geometry.distortion import CameraModel
from vio.protocols import Dataset, Progress
from vio.records import NS_PER_S, Image, ImuRecord, ImuSample
from vio.targets.corners import NO_CORNERS, CornerDetector, Corners, numbered_alike
from vio.targets.views import View

MAX_FRAMES = 80  # in which the board is looked for, spread over the recording


class _FrameRules(NamedTuple):
    """Which frames of a recording are used."""

    min_motion_hz: float = 5.0  # of frames, where an IMU is calibrated
    max_motion_frames: int = 400
    measured_images: int = 5  # images whose size is measured
    kept_frames: int = 4  # frames that are kept to explain a failure


_FRAMES = _FrameRules()

Images = tuple[Image, ...]


@dataclass(frozen=True, slots=True)
class Filmed:
    """What a recording shows of a board."""

    views: list[View]  # those in which a camera sees the board
    sizes: tuple[tuple[int, int], ...]  # width and height of each camera's images
    frames: int  # in which it was looked for
    imu: ImuRecord | None
    notes: tuple[str, ...]
    samples: tuple[Images, ...] = ()  # images of some frames, by which a failure is explained


@dataclass(frozen=True, slots=True)
class RawRecording:
    """Raw images of one or two cameras, and an IMU where there is one."""

    path: Path
    times_ns: Sequence[int]
    load: Callable[[Sequence[int]], Iterator[tuple[int, Images]]]  # chosen frames: time and images
    imu: Callable[[], ImuRecord | None]
    notes: tuple[str, ...] = ()


def open_raw(
    source: str, *, topics: str | None = None, size: tuple[int, int] | None = None
) -> RawRecording:
    """Open a recording without its calibration.

    Args:
        source: a recording, or a folder with files `left*` and `right*`.
        topics: of a bag, as for the other commands.
        size: width and height of the images where no file states it, pixels.

    Raises:
        DataError: it is no recording with images.
        CalibrationError: the size of the images is not known.
    """
    path = Path(source)
    flat = None
    if path.is_dir() and image_layout(path) is None:
        flat = _flat_pairs(path)
    if flat is not None:
        return _folder_of_pairs(path, flat)
    known, cameras = _size_and_cameras(source, path, size)
    dataset = _with_stand_in(source, known, cameras, topics)
    recording = dataset.recording
    if not isinstance(dataset, ImageRecording):
        raise DataError(f"{recording.path}: holds no images; give a recording of a board")

    def load(chosen: Sequence[int]) -> Iterator[tuple[int, Images]]:
        return _frames_of(dataset, chosen)

    def imu() -> ImuRecord | None:
        return _imu_of(dataset)

    times = recording.frame_times_ns.tolist()
    return RawRecording(recording.path, times, load, imu, recording.notes)


def _flat_pairs(path: Path) -> ImagePairs | None:
    """Return pairs of one folder's files `left*` and `right*`; None: there are none."""
    names = sorted(child.name for child in path.iterdir() if child.suffix.lower() in SUFFIXES)
    lefts = tuple(name for name in names if name.lower().startswith("left"))
    rights = tuple(name for name in names if name.lower().startswith("right"))
    if not lefts or not rights:
        return None
    return pair_files(ImageFiles(path, lefts), ImageFiles(path, rights))[0]


def _folder_of_pairs(path: Path, pairs: ImagePairs) -> RawRecording:
    times = [k * NS_PER_S for k in range(len(pairs))]  # of photographs, which have no clock

    def load(chosen: Sequence[int]) -> Iterator[tuple[int, Images]]:
        for k in chosen:
            left, right = pairs[k]
            yield times[k], (load_gray(left)[0], load_gray(right)[0])

    return RawRecording(path, times, load, lambda: None)


def _size_and_cameras(
    source: str, path: Path, size: tuple[int, int] | None
) -> tuple[tuple[int, int], int]:
    """Return width and height of the images, and the number of cameras."""
    layout = image_layout(path) if path.is_dir() else None
    if layout is not None and layout.left == layout.right:
        return size or _usual_size(list_images(layout.left)), 1
    if layout is not None:
        return size or _size_of_pair(path, layout.left, layout.right), 2
    if size is not None:
        return size, 2
    videos = video_files(path) if path.is_dir() else None
    if videos is not None:
        return _size_of_video(videos[0]), 2
    return _size_and_cameras_as_read(source, path)


def _size_and_cameras_as_read(source: str, path: Path) -> tuple[tuple[int, int], int]:
    """Return what the reader of a recording knows of size and cameras."""
    try:
        dataset = open_dataset(source)
    except CalibrationError as error:
        raise CalibrationError(
            f"{path}: the size of its images is not known; give it by --image-size WIDTHxHEIGHT"
        ) from error
    if not isinstance(dataset, ImageRecording):
        raise DataError(f"{path}: holds no images; give a recording of a board")
    first = dataset.sizes[0]
    return (first.width, first.height), len(dataset.sizes)


def _size_of_pair(path: Path, left: Path, right: Path) -> tuple[int, int]:
    lefts = list_images(left)
    rights = list_images(right)
    if not len(lefts) or not len(rights):
        return measured_images(pair_images(left, right))[0]
    sizes = (_usual_size(lefts), _usual_size(rights))
    if sizes[0] != sizes[1]:
        (width, height), (other_width, other_height) = sizes
        turned = sizes[0] == sizes[1][::-1]
        advice = "turn those of one camera" if turned else "record both cameras at one size"
        raise DataError(
            f"{path}: left images have {width} x {height} pixels, and right ones {other_width} x "
            f"{other_height}: {advice}, or calibrate each camera alone"
        )
    return sizes[0]


def _usual_size(files: Sequence[Path]) -> tuple[int, int]:
    """Return width and height that most of a few images have."""
    sizes: list[tuple[int, int]] = []
    for k in np.unique(
        np.linspace(0, len(files) - 1, _FRAMES.measured_images).astype(int)
    ).tolist():
        try:
            image = load_gray(files[k])[0]
        except UnreadableImageError:
            continue
        sizes.append((image.shape[1], image.shape[0]))
    if not sizes:
        return measured_images([(file, file) for file in files])[0]
    return max(sizes, key=sizes.count)


def _size_of_video(file: Path) -> tuple[int, int]:
    import cv2

    capture = cv2.VideoCapture(str(file))
    try:
        width = int(capture.get(cv2.CAP_PROP_FRAME_WIDTH))
        height = int(capture.get(cv2.CAP_PROP_FRAME_HEIGHT))
    finally:
        capture.release()
    if width < 1 or height < 1:
        raise DataError(f"{file}: is no video that can be read; copy it again")
    return width, height


def _with_stand_in(source: str, size: tuple[int, int], cameras: int, topics: str | None) -> Dataset:
    """Open a recording by a calibration that leaves its images as they are."""
    width, height = size
    rig = Rig.rectified(
        width, width, 0.5 * width, 0.5 * height, 0.1, width, height, T_cam0_imu=np.eye(4)
    )
    if cameras == 1:
        rig = Rig(CameraModel(width, width, 0.5 * width, 0.5 * height, width, height))
        rig = Rig(rig.cam0, T_cam0_imu=np.eye(4))
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "camchain.yaml"
        file.write_text(kalibr_text(rig), encoding="utf-8")
        if cameras == 1 and Path(source).is_dir():
            # Images of one camera alone are a recording only by the calibration beside them.
            source = f"mono:{source}"
        return open_dataset(source, DatasetSettings(calibration=file, topics=topics))


def _frames_of(dataset: ImageRecording, chosen: Sequence[int]) -> Iterator[tuple[int, Images]]:
    """Yield time and images of frames, increasing."""
    for frame in dataset.frames(chosen):
        if frame.left is not None:
            images: Images = (frame.left,)
            if frame.right is not None:
                images = (frame.left, frame.right)
            yield frame.time_ns, images


def _imu_of(dataset: ImageRecording) -> ImuRecord | None:
    samples = [sample for sample in dataset.motion if isinstance(sample, ImuSample)]
    if len(samples) < 2:
        return None
    return ImuRecord(
        np.array([sample.time_ns for sample in samples], dtype=np.int64),
        np.array([sample.gyro for sample in samples]),
        np.array([sample.accel for sample in samples]),
    )


def _detect(
    loaded: Iterator[tuple[int, Images]], detector: CornerDetector
) -> Iterator[tuple[int, Images, tuple[Corners, ...]]]:
    """Yield time and images of each frame, and the corners that each image shows, which are found
    on all processor cores.
    """
    workers = os.cpu_count() or 1
    with ThreadPoolExecutor(workers) as pool:
        while batch := list(islice(loaded, 2 * workers)):
            flat = [image for _, images in batch for image in images]
            found = iter(list(pool.map(detector.detect, flat)))
            for time_ns, images in batch:
                yield time_ns, images, tuple(next(found) for _ in images)


def film(
    raw: RawRecording,
    detector: CornerDetector,
    *,
    max_frames: int | None = None,
    progress: Progress = lambda done, total: None,
) -> Filmed:
    """Look for the board in frames that are spread over a recording.

    Args:
        raw: the recording.
        detector: of the board.
        max_frames: in which it is looked for; None: `MAX_FRAMES`, or more where an IMU needs them.
        progress: called after each frame.

    Raises:
        DataError: no frame can be read.
    """
    imu = raw.imu()
    count = len(raw.times_ns)
    wanted = max_frames or _frames_wanted(raw, has_imu=imu is not None)
    chosen = np.unique(np.linspace(0, count - 1, min(wanted, count)).round().astype(int)).tolist()
    views: list[View] = []
    samples: list[Images] = []
    sizes: tuple[tuple[int, int], ...] = ()
    frames = 0
    latest = NO_CORNERS  # of the image in which the board was last seen
    between = max(len(chosen) // _FRAMES.kept_frames, 1)
    for time_ns, images, corners in _detect(raw.load(chosen), detector):
        if frames % between == 0:
            samples.append(images)
        frames += 1
        sizes = tuple((image.shape[1], image.shape[0]) for image in images)
        if any(len(one) for one in corners):
            alike: list[Corners] = []
            for one in corners:
                alike.append(numbered_alike(one, latest, detector.target))
                latest = alike[-1] if len(one) else latest
            views.append(View(time_ns, tuple(alike)))
        progress(frames, len(chosen))
    if not frames:
        raise DataError(f"{raw.path}: no image could be read; copy it again")
    return Filmed(views, sizes, frames, imu, raw.notes, tuple(samples))


def _frames_wanted(raw: RawRecording, *, has_imu: bool) -> int:
    if not has_imu or len(raw.times_ns) < 2:
        return MAX_FRAMES
    seconds = 1e-9 * (raw.times_ns[-1] - raw.times_ns[0])
    return int(np.clip(_FRAMES.min_motion_hz * seconds, MAX_FRAMES, _FRAMES.max_motion_frames))
