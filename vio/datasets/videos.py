"""Two video files, left and right, or one with both images side by side, with a calibration and, as
in a plain folder, what else is beside them.

Frame k of the one file belongs to frame k of the other. One file alone is taken to be side by side
where the calibration is that of a pair whose images have half of its width. Frames are decoded in order, from the first
on, because seeking in compressed video is not exact. Times come from `times.txt`, else from the
frame rate that the files state.
"""

from __future__ import annotations

import contextlib
from collections.abc import Generator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from vio.cameras.rig import Rig
from vio.datasets.companions import ReadImages, find_calibration_of, read_companions
from vio.datasets.image_pairs import ImageRecording, half_of
from vio.datasets.image_times import times_of
from vio.datasets.images import prefetch
from vio.datasets.reader import Reader
from vio.datasets.rigs import load_rig
from vio.datasets.settings import DatasetSettings
from vio.datasets.sides import pairs_of
from vio.datasets.unused import Layout
from vio.errors import DataError
from vio.records import NS_PER_S, Image, IntArray, StereoFrame

SUFFIXES = (".mp4", ".avi", ".mkv", ".mov", ".webm", ".m4v")
_NAMES = (
    ("left", "right"),
    ("Left", "Right"),
    ("cam0", "cam1"),
    ("image_0", "image_1"),
    ("video_0", "video_1"),
)
_RATES = (1.0, 1000.0)  # frames per second that a file can plausibly state


@dataclass(frozen=True, slots=True)
class _Facts:
    """What a video file states of itself."""

    count: int  # frames; containers may state a few too many
    rate_hz: float
    width: int  # pixels
    height: int


def video_files(path: Path) -> tuple[Path, Path] | None:
    """Return the left and right video file of a folder, twice the same where there is one alone;
    None: it has none, or several that are no pair.
    """
    found = {
        child.stem: child for child in sorted(path.iterdir()) if child.suffix.lower() in SUFFIXES
    }
    if len(found) == 1:
        (alone,) = found.values()
        return alone, alone
    pairs = pairs_of(list(found))
    known = [pair for pair in pairs if pair in _NAMES] or pairs
    return (found[known[0][0]], found[known[0][1]]) if len(known) == 1 else None


def read_video(path: Path, settings: DatasetSettings) -> VideoDataset:
    """Read a folder with two video files.

    Raises:
        DataError: a file is no video, the two differ in rate or size, or times and samples do not
            fit.
        CalibrationError: there is no calibration, or it is invalid.
    """
    files = video_files(path) if path.is_dir() else None
    if files is None:
        raise DataError(
            f"{path}: holds no pair of videos (left.mp4 and right.mp4, or others); give a folder "
            "with both"
        )
    left, right = (_facts(file) for file in files)
    if abs(left.rate_hz - right.rate_hz) > 1e-3 * left.rate_hz:
        raise DataError(
            f"{files[0]} has {left.rate_hz:g} and {files[1].name} {right.rate_hz:g} frames per "
            "second; record both "
            "with one trigger, or write image folders"
        )
    layout = Layout(path, path, *files)
    file = settings.calibration or find_calibration_of(layout)
    one = files[0] == files[1]
    size = (left.width // 2, left.height) if one else (left.width, left.height)
    rig = load_rig(file, image_size=size, cameras=2)
    if one:
        _check_side_by_side(rig, left, files[0], file)
    times_ns, times_file, notes = _times(path, files, min(left.count, right.count), left.rate_hz)
    if one:
        notes.append(f"{files[0].name} holds the left and the right image side by side")
    if left.count != right.count:
        notes.append(
            f"{files[0].name} states {left.count} frames, {files[1].name} {right.count}; the "
            "shorter counts"
        )
    read = ReadImages("video", layout, (file, rig), (times_ns, times_file), notes, files)
    parts = read_companions(read, settings)
    return VideoDataset(*parts, files, imu_noise=rig.imu_noise)


def _check_side_by_side(rig: Rig, video: _Facts, path: Path, calibration: Path) -> None:
    """Raise DataError where a calibration is not of half the width of a single video."""
    if (rig.cam0.width, rig.cam0.height) != (video.width // 2, video.height):
        raise DataError(
            f"{path} is the only video, of {video.width} x {video.height} pixels, and "
            f"{calibration} is for images of {rig.cam0.width} x {rig.cam0.height}; side by side "
            "they would have twice that width; give left.mp4 and right.mp4, or the calibration of "
            "these images"
        )


def _facts(file: Path) -> _Facts:
    import cv2

    capture = cv2.VideoCapture(str(file))
    try:
        count = int(capture.get(cv2.CAP_PROP_FRAME_COUNT))
        rate_hz = float(capture.get(cv2.CAP_PROP_FPS))
        found, image = capture.read()
    finally:
        capture.release()
    if not found or count < 1:
        raise DataError(
            f"{file}: no frame can be decoded; the file is damaged, or OpenCV has no decoder for it"
        )
    if not _RATES[0] <= rate_hz <= _RATES[1]:
        rate_hz = 0.0
    return _Facts(count, rate_hz, image.shape[1], image.shape[0])


def _times(
    path: Path, files: tuple[Path, Path], count: int, rate_hz: float
) -> tuple[IntArray, Path | None, list[str]]:
    """Return the times (F,) of the frames, the file that states them, and notes."""
    if (file := path / "times.txt").is_file():
        names = [(Path(f"{k}"), Path(f"{k}")) for k in range(count)]
        doubts = list[str]()
        times_ns = times_of(file, tuple(names), doubts)
        return times_ns, file, doubts
    if rate_hz == 0.0:
        raise DataError(
            f"{files[0]}: states no frame rate; write one time a frame into times.txt beside it"
        )
    note = f"no times.txt: frames are {1e3 / rate_hz:.4g} ms apart, as {files[0].name} states; real cameras jitter"
    return np.rint(np.arange(count) * (NS_PER_S / rate_hz)).astype(np.int64), None, [note]


@dataclass(frozen=True, slots=True)
class VideoDataset(ImageRecording):
    """Implements `vio.protocols.Dataset` over two video files; a frame that cannot be decoded is
    an error.
    """

    files: tuple[Path, Path]

    def _frames(self, chosen: Sequence[int]) -> Generator[StereoFrame]:
        """Decode in order; the prefetch thread is the only one that uses the decoders."""
        import cv2

        one = self.files[0] == self.files[1]
        files = self.files[: 1 if one else self.settings.cameras]
        captures = [cv2.VideoCapture(str(file)) for file in files]

        # where the decoders are before a frame
        after = dict(zip(chosen, [0, *(k + 1 for k in chosen)], strict=False))

        def load(index: int) -> StereoFrame:
            for capture in captures:
                for _ in range(after[index], index):
                    capture.grab()
            images = [self._image(capture, side, index) for side, capture in enumerate(captures)]
            if one:
                images = [half_of(images[0], side) for side in range(self.settings.cameras)]
            for side, image in enumerate(images):
                self.sizes[side].check(image, self.files[side])
            return self.rectifier.frame(index, int(self.recording.frame_times_ns[index]), *images)

        try:
            with contextlib.closing(
                prefetch(load, chosen, self.settings.prefetch_frames)
            ) as loaded:
                yield from loaded
        finally:
            for capture in captures:
                capture.release()

    def _image(self, capture: Any, side: int, index: int) -> Image:
        import cv2

        found, pixels = capture.read()
        if not found:
            raise DataError(
                f"{self.files[side]}: frame {index} of {len(self.recording.frame_times_ns)} cannot "
                "be decoded; "
                f"the file is truncated, or states too many frames: use --stop {index}"
            )
        code = cv2.COLOR_BGR2RGB if self.colour else cv2.COLOR_BGR2GRAY
        image: Image = np.asarray(pixels if pixels.ndim == 2 else cv2.cvtColor(pixels, code))
        return image


def _is_pair(path: Path) -> bool:
    files = video_files(path)
    return files is not None and files[0] != files[1]


READERS = (
    Reader(
        kind="video",
        looked_for="two videos (left.mp4 right.mp4)",
        read=read_video,
        is_folder=_is_pair,
        may_be_folder=lambda path: video_files(path) is not None,
        calibrated_as="video",
    ),
)
