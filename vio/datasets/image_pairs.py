"""Recordings of two image folders: paired by name, prefetched, with a few unreadable frames skipped."""

from __future__ import annotations

import contextlib
import logging
from collections.abc import Callable, Generator, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

from vio.datasets.common import frame_range, merge_events
from vio.datasets.images import UnreadableImageError, list_images, load_gray, prefetch
from vio.datasets.settings import DatasetSettings
from vio.errors import DataError
from vio.records import Event, Image, MotionSample, Observations, Recording, StereoFrame

logger = logging.getLogger(__name__)

Item = TypeVar("Item")
ImagePairs = tuple[tuple[Path, Path], ...]  # left and right image of each frame


def pair_images(left: Path, right: Path) -> ImagePairs:
    """Pair the image files of two folders by name.

    Raises:
        DataError: a file lacks its partner; the message gives both counts and names the first one.
    """
    lefts, rights = list_images(left), list_images(right)
    by_name = ({path.stem: path for path in lefts}, {path.stem: path for path in rights})
    for here, there, folder in ((by_name[0], by_name[1], right), (by_name[1], by_name[0], left)):
        if missing := next((path for stem, path in here.items() if stem not in there), None):
            raise DataError(
                f"{left} holds {len(lefts)} images and {right} {len(rights)}: {folder / missing.name} is missing; "
                "remove its partner or copy it again"
            )
    return tuple((path, by_name[1][path.stem]) for path in lefts)


@dataclass(frozen=True, slots=True)
class BadFrame:
    """A frame with an unreadable image, and the reason."""

    index: int
    why: str


def readable_frames(
    load: Callable[[Item], StereoFrame | BadFrame], chosen: Iterable[Item], settings: DatasetSettings
) -> Generator[StereoFrame]:
    """Prefetch frames in a thread, and skip unreadable ones with a warning up to the limit of the settings.

    Raises:
        DataError: too many frames are unreadable, or whatever `load` raises.
    """
    bad = 0
    with contextlib.closing(prefetch(load, chosen, settings.prefetch_frames)) as loaded:
        for frame in loaded:
            if isinstance(frame, StereoFrame):
                yield frame
                continue
            bad += 1
            if bad > settings.max_bad_frames:
                raise DataError(
                    f"{frame.why} ({bad} unreadable frames, dataset.max_bad_frames allows {settings.max_bad_frames})"
                )
            logger.warning("frame %d is skipped: %s", frame.index, frame.why)


def first_readable(pairs: ImagePairs, max_bad_frames: int) -> tuple[Path, Image, int]:
    """The first left image that can be read: its file, its pixels (H, W) and its bits per channel.

    Raises:
        UnreadableImageError: the first `max_bad_frames` images are all unreadable.
    """
    for path, _ in pairs[:max_bad_frames]:
        with contextlib.suppress(UnreadableImageError):
            return path, *load_gray(path)
    last = pairs[min(max_bad_frames, len(pairs) - 1)][0]
    return last, *load_gray(last)


@dataclass(frozen=True, slots=True)
class ImageSize:
    """The size that the images of one camera must have."""

    width: int  # pixels
    height: int  # pixels
    stated_by: Path  # a calibration, or the image that was measured

    def check(self, image: Image, path: Path) -> None:
        """Raise DataError unless an image (H, W) has this size."""
        if image.shape != (self.height, self.width):
            raise DataError(
                f"{path} is {image.shape[1]} x {image.shape[0]} pixels but {self.stated_by} specifies {self.width} x "
                f"{self.height}; give images of one size, and the calibration of these images"
            )


@dataclass(frozen=True, slots=True)
class ImageDataset:
    """Implements `vio.protocols.Dataset` over pairs of image files that are rectified."""

    recording: Recording
    pairs: ImagePairs
    motion: tuple[MotionSample, ...]  # in time order
    sizes: tuple[ImageSize, ImageSize]  # of the left and the right files
    settings: DatasetSettings

    def events(self, start: int = 0, stop: int | None = None, *, images: bool = True) -> Iterator[Event]:
        """Yield events of the frames `start <= index < stop` in time order.

        A frame with an unreadable image is skipped with a warning, up to `max_bad_frames` of them.

        Raises:
            DataError: the range holds no frame, an image has another size, or too many are unreadable.
        """
        chosen = frame_range(self.recording, start, stop)
        if images:
            frames = readable_frames(self._load, chosen, self.settings)
        else:
            frames = (self._frame(index, None, None) for index in chosen)
        return merge_events(self.recording, chosen, self.motion, frames)

    def observations(self, index: int) -> Observations | None:
        """Return None: the recording holds images only."""
        return None

    def prepared(self, left: Image, right: Image) -> tuple[Image, Image]:
        """Preprocess a pair as read from the files (H, W each); returned unchanged, as it is rectified."""
        return left, right

    def _frame(self, index: int, left: Image | None, right: Image | None) -> StereoFrame:
        return StereoFrame(index, int(self.recording.frame_times_ns[index]), left, right)

    def _load(self, index: int) -> StereoFrame | BadFrame:
        """Read one frame; runs in the prefetch thread."""
        paths = self.pairs[index]
        try:
            left, right = (load_gray(path)[0] for path in paths)
        except UnreadableImageError as error:
            return BadFrame(index, str(error))
        for size, image, path in zip(self.sizes, (left, right), paths, strict=True):
            size.check(image, path)
        return self._frame(index, *self.prepared(left, right))
