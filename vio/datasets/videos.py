"""Two video files, left and right, or one with both images side by side, with a calibration and, as
in a plain folder, what else is beside them.

Frame k of the one file belongs to frame k of the other. One file alone is taken to be side by side
where the calibration is that of a pair whose images have half of its width. Frames are decoded in
order, from the first on, because seeking in compressed video is not exact. Times come from
`times.txt`, else from a list for each of two videos (`left.txt`, `right_timestamps.csv`), by which
frames are paired, else from the frame rate that the files state. Where the presentation times of their
frames do not follow that rate (phones, recorders that drop frames), these count, and frames belong
together that have one time.
"""

from __future__ import annotations

import contextlib
import re
from collections.abc import Callable, Generator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from vio.cameras.rig import Rig
from vio.datasets.alternation import alternating_note
from vio.datasets.companions import ReadImages, find_calibration_of, read_companions
from vio.datasets.frame_times import nearest, paired
from vio.datasets.image_pairs import ImageRecording, half_of, stacked_hint
from vio.datasets.image_times import TIME_LISTS, time_lines, times_of
from vio.datasets.images import UnreadableImageError, prefetch
from vio.datasets.reader import Reader
from vio.datasets.rigs import load_rig
from vio.datasets.settings import DatasetSettings
from vio.datasets.sides import pairs_of
from vio.datasets.unused import Layout
from vio.errors import DataError
from vio.records import NS_PER_S, Image, IntArray, StereoFrame

SUFFIXES = (".mp4", ".avi", ".mkv", ".mov", ".webm", ".m4v")
# of half the width of a video, beyond which a principal point is that of its whole width
_OF_WHOLE_WIDTH = 0.85
_NAMES = (
    ("left", "right"),
    ("Left", "Right"),
    ("cam0", "cam1"),
    ("image_0", "image_1"),
    ("video_0", "video_1"),
    ("data", "data2"),  # of Spectacular AI's recordings
)
_FRAMES = "data.jsonl"  # that holds the times of the latter
# of the name of a list, what is no video's: `left_timestamps.csv`, `timestamps-left.txt`
_LIST_WORDS = re.compile(r"time[-_ ]?stamps?|times?|stamps?|frames?|[-_. ]", re.IGNORECASE)
_LIST_SUFFIXES = (".txt", ".csv")
_RATES = (1.0, 1000.0)  # frames per second that a file can plausibly state
_LOOKED_AT = 48  # frames of a single video that may alternate between two cameras


class _TimeRules(NamedTuple):
    """When the times of frames are even, and when two frames are a pair."""

    even_ns: int = 2_000_000  # frames this close to an even grid have a constant rate
    paired: float = 0.25  # of the usual interval: how far apart the times of a pair may be


_TIMES = _TimeRules()


@dataclass(frozen=True, slots=True)
class _Facts:
    """What a video file states of itself."""

    count: int  # frames; containers may state a few too many
    rate_hz: float
    times_ns: IntArray | None  # presentation times (F,); None: at a constant rate, or not stated
    width: int  # pixels
    height: int


def video_files(path: Path) -> tuple[Path, Path] | None:
    """Return the left and right video file of a folder, twice the same where there is one alone;
    None: it has none, or several that are no pair.

    Each may be the only video in a folder of its own (`left/video.mp4 right/video.mp4`).
    """
    found = {video.stem: video for video in _videos_in(path)}
    if not found:
        for names in _NAMES:
            inside = [_videos_in(path / name) for name in names]
            if all(len(videos) == 1 for videos in inside):
                return inside[0][0], inside[1][0]
        return None
    if len(found) == 1:
        (alone,) = found.values()
        return alone, alone
    known = [pair for pair in _NAMES if set(pair) <= set(found)] or pairs_of(list(found))
    if len(known) == 1:
        return (found[known[0][0]], found[known[0][1]])
    return None


def _videos_in(folder: Path) -> list[Path]:
    """Return the videos of a folder by name; none: it has none, or is no folder."""
    if not folder.is_dir():
        return []
    return [file for file in sorted(folder.iterdir()) if file.suffix.lower() in SUFFIXES]


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
    left = _facts(files[0])
    right = left if files[1] == files[0] else _facts(files[1])
    one = files[0] == files[1]
    own = None if one else _own_lists(path, files)
    stated_ns = None if own is not None else _times_of_frames(path, files)
    known = (own, stated_ns, left.times_ns, right.times_ns)
    if (
        all(times is None for times in known)
        and abs(left.rate_hz - right.rate_hz) > 1e-3 * left.rate_hz
    ):
        raise DataError(
            f"{files[0]} has {left.rate_hz:g} and {files[1].name} {right.rate_hz:g} frames per "
            "second; record both "
            "with one trigger, or write image folders"
        )
    layout = Layout(path, path, *files)
    file = settings.calibration or find_calibration_of(layout)
    if one:
        size = (left.width // 2, left.height)
    else:
        size = (left.width, left.height)
    rig = load_rig(file, image_size=size, cameras=2)
    if one:
        _check_side_by_side(rig, left, files[0], file)
    times_ns, times_file, rows, notes = _times(path, files, (left, right), own, stated_ns)
    if one:
        notes.append(f"{files[0].name} holds the left and the right image side by side")
    used = files if own is None else (*files, own[1])
    read = ReadImages("video", layout, (file, rig), (times_ns, times_file), notes, used)
    parts = read_companions(read, settings)
    return VideoDataset(*parts, files, rows, imu_noise=rig.imu_noise)


def _check_side_by_side(rig: Rig, video: _Facts, path: Path, calibration: Path) -> None:
    """Raise DataError where a calibration is not of half the width of a single video, by the size
    that it states, or by a principal point in the middle of the whole width.
    """
    if (rig.cam0.width, rig.cam0.height) != (video.width // 2, video.height):
        # no frame in the middle: all before it would be decoded
        doubt = alternating_note(min(video.count, _LOOKED_AT), _loader(path))
        hint = stacked_hint((video.width, video.height), (rig.cam0.width, rig.cam0.height))
        raise DataError(
            f"{path} is the only video, of {video.width} x {video.height} pixels, and "
            f"{calibration} is for images of {rig.cam0.width} x {rig.cam0.height}{hint}; side by "
            "side they would have twice that width; give left.mp4 and right.mp4, or the "
            f"calibration of these images{'' if doubt is None else f'; {doubt}'}"
        )
    if rig.cam0.cu > _OF_WHOLE_WIDTH * rig.cam0.width:
        size = (video.width, video.height)
        is_low = rig.cam0.cv < video.height / 3  # the middle of an upper half is at a quarter
        hint = stacked_hint(size, (video.width, video.height // 2)) if is_low else ""
        raise DataError(
            f"{path} is the only video, of {video.width} x {video.height} pixels, and the principal "
            f"point of {calibration}, {rig.cam0.cu:.0f}, {rig.cam0.cv:.0f}, is near the middle of its "
            f"whole width, not of its left half{hint}; give left.mp4 and right.mp4, or the calibration "
            "of these images"
        )


def _own_lists(path: Path, files: tuple[Path, Path]) -> tuple[Path, Path] | None:
    """Return the list of times of each of two videos, beside it and named as it (`left.txt`,
    `left_timestamps.csv`), or in a folder of its own (`left/timestamps.txt`); None: there are not
    both.
    """
    found = []
    for video in files:
        lists = sorted(video.parent.iterdir())
        named = {
            _LIST_WORDS.sub("", file.stem.lower()): file
            for file in lists
            if file.suffix.lower() in _LIST_SUFFIXES
        }
        own = named.get(_LIST_WORDS.sub("", video.stem.lower()))
        found.append(own or (named.get("") if video.parent != path else None))
    left, right = found
    return None if left is None or right is None or left == right else (left, right)


def _loader(file: Path) -> Callable[[int], Image]:
    """Return what decodes a frame of a video by its number, in increasing order."""
    import cv2

    capture = cv2.VideoCapture(str(file))
    past = 0  # frames that the decoder is past

    def load(frame: int) -> Image:
        nonlocal past
        for _ in range(past, frame):
            capture.grab()
        past = frame + 1
        found, image = capture.read()
        if not found:
            raise UnreadableImageError(f"{file}: frame {frame} cannot be decoded")
        return np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY))

    return load


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
    times_ns = _stated_times(file)
    if times_ns is not None and rate_hz and _is_even(times_ns, rate_hz):
        times_ns = None
    return _Facts(count, rate_hz, times_ns, image.shape[1], image.shape[0])


def _stated_times(file: Path) -> IntArray | None:
    """Return the presentation times (F,) of a file's frames, of its packets, which are not decoded;
    None: it states none, or not one for each.
    """
    import cv2

    packets = cv2.VideoCapture(str(file), cv2.CAP_FFMPEG, [cv2.CAP_PROP_FORMAT, -1])
    times_ms = []
    try:
        while packets.grab():
            times_ms.append(packets.get(cv2.CAP_PROP_POS_MSEC))
    finally:
        packets.release()
    times_ns = np.rint(1e6 * np.sort(times_ms)).astype(np.int64)  # packets are in decoding order
    if len(times_ns) > 1 and np.diff(times_ns).min() > 0:
        return times_ns
    return None


def _is_even(times_ns: IntArray, rate_hz: float) -> bool:
    """Whether times follow a rate."""
    grid_ns = times_ns[0] + np.arange(len(times_ns)) * (NS_PER_S / rate_hz)
    return bool(np.abs(times_ns - grid_ns).max() < _TIMES.even_ns)


def _times(
    path: Path,
    files: tuple[Path, Path],
    facts: tuple[_Facts, _Facts],
    own: tuple[Path, Path] | None,
    stated_ns: IntArray | None,
) -> tuple[IntArray, Path | None, IntArray, list[str]]:
    """Return the times (F,) of the pairs, the file that states them, the frames (F, 2) of each pair
    in both files, and notes.

    Args:
        path: the folder.
        files: both videos.
        facts: what they state.
        own: the list of times of each; None: there are not both.
        stated_ns: times by Spectacular AI's record; None: there is none.
    """
    left, right = facts
    count = min(left.count, right.count)
    rows = np.repeat(np.arange(count)[:, None], 2, axis=1)
    shorter = (
        [
            f"{files[0].name} states {left.count} frames, {files[1].name} {right.count}; the "
            "shorter counts"
        ]
        if left.count != right.count
        else []
    )
    lists = (path / name for name in TIME_LISTS)
    if (file := next((file for file in lists if file.is_file()), None)) is not None:
        doubts = list[str]()
        # a line for each frame of the longer one as well
        listed = len(time_lines(file)[0])
        frames = listed if listed in (left.count, right.count) else count
        times_ns = _listed_times(file, frames, doubts)[:count]
        return times_ns, file, rows, doubts + shorter
    if own is not None:
        return _times_of_own_lists(path, files, facts, own)
    if stated_ns is not None:
        notes = list(shorter)
        if len(stated_ns) != count:
            notes.append(
                f"{_FRAMES} has {len(stated_ns)} frames, the videos {count}; the first ones count"
            )
        count = min(count, len(stated_ns))
        return stated_ns[:count], path / _FRAMES, rows[:count], notes
    if left.times_ns is not None or right.times_ns is not None:
        return _uneven_times(files, facts)
    if left.rate_hz == 0.0:
        raise DataError(
            f"{files[0]}: states no frame rate; write one time a frame into times.txt beside it"
        )
    note = f"no times.txt: frames are {1e3 / left.rate_hz:.4g} ms apart, as {files[0].name} states; real cameras jitter"
    times_ns = np.rint(np.arange(count) * (NS_PER_S / left.rate_hz)).astype(np.int64)
    return times_ns, None, rows, [note, *shorter]


def _times_of_frames(path: Path, files: tuple[Path, Path]) -> IntArray | None:
    """Return the times (F,) of the frames of a recording of Spectacular AI; None: it is another, or
    states none.
    """
    file = path / _FRAMES
    if files[0].stem != _NAMES[-1][0] or not file.is_file():
        return None
    from vio.datasets.json_lines import read_frame_times

    times_ns = read_frame_times(file)
    return times_ns if len(times_ns) else None


def _listed_times(file: Path, frames: int, doubts: list[str]) -> IntArray:
    """Return the times (F,) of as many frames by a list; doubts about its unit are added."""
    names = [(Path(f"{k}"), Path(f"{k}")) for k in range(frames)]
    return times_of(file, tuple(names), doubts)


def _times_of_own_lists(
    path: Path,
    files: tuple[Path, Path],
    facts: tuple[_Facts, _Facts],
    lists: tuple[Path, Path],
) -> tuple[IntArray, Path | None, IntArray, list[str]]:
    """Return what `_times` does, of videos each of which has its list of times; frames are paired
    by them.
    """
    doubts = list[str]()
    left_ns, right_ns = (
        _listed_times(file, video.count, doubts) for file, video in zip(lists, facts, strict=True)
    )
    a, b, notes = paired(left_ns, right_ns, [file.name for file in files], path)
    return left_ns[a], lists[0], np.column_stack([a, b]), doubts + notes


def _uneven_times(
    files: tuple[Path, Path], facts: tuple[_Facts, _Facts]
) -> tuple[IntArray, Path | None, IntArray, list[str]]:
    """Return what `_times` does, of files at least one of which has no constant rate."""
    left_ns, right_ns = (
        np.rint(np.arange(f.count) * (NS_PER_S / f.rate_hz)).astype(np.int64)
        if f.times_ns is None
        else f.times_ns
        for f in facts
    )
    usual_ns = float(np.median(np.diff(left_ns)))
    partner = nearest(left_ns, right_ns)
    mutual = nearest(right_ns, left_ns)[partner] == np.arange(len(left_ns))
    near = np.abs(right_ns[partner] - left_ns) <= _TIMES.paired * usual_ns
    paired = np.flatnonzero(mutual & near)
    rows = np.column_stack([paired, partner[paired]])
    if not len(rows):
        raise DataError(
            f"{files[0]} and {files[1].name} have no two frames with one time; write one time a "
            "frame into times.txt beside them"
        )
    times_ns = left_ns[rows[:, 0]]
    if len(times_ns) > 1:
        apart_ms = 1e-6 * np.diff(times_ns)
    else:
        apart_ms = np.zeros(1)
    notes = [
        f"no times.txt: frames have the presentation times of {files[0].name}, "
        f"{apart_ms.min():.3g} to {apart_ms.max():.3g} ms apart"
    ]
    alone = tuple(len(times) - len(rows) for times in (left_ns, right_ns))
    if any(alone):
        notes.append(
            f"{alone[0]} frames of {files[0].name} and {alone[1]} of {files[1].name} have no partner "
            "of their time, and are left out"
        )
    return times_ns, None, rows, notes


@dataclass(frozen=True, slots=True)
class VideoDataset(ImageRecording):
    """Implements `vio.protocols.Dataset` over two video files; a frame that cannot be decoded is
    an error.
    """

    files: tuple[Path, Path]
    rows: IntArray  # (F, 2) which frame of each file is in pair k

    def _frames(self, chosen: Sequence[int]) -> Generator[StereoFrame]:
        """Decode in order; the prefetch thread is the only one that uses the decoders."""
        import cv2

        one = self.files[0] == self.files[1]
        files = self.files[: 1 if one else self.settings.cameras]
        captures = [cv2.VideoCapture(str(file)) for file in files]

        decoded = [0] * len(captures)  # frames that each decoder is past

        def load(index: int) -> StereoFrame:
            for side, capture in enumerate(captures):
                wanted = int(self.rows[index, side])
                for _ in range(decoded[side], wanted):
                    capture.grab()
                decoded[side] = wanted + 1
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
