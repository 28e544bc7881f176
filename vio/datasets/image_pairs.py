"""Recordings of one or two image folders: paired by name, prefetched, with unusable frames
skipped.
"""

from __future__ import annotations

import contextlib
import logging
from abc import ABC, abstractmethod
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TypeVar

import numpy as np

from vio.cameras.rig import Rectifier
from vio.datasets.common import blank_frames, chosen_frames, merge_events
from vio.datasets.image_files import FilePairs, stem_of
from vio.datasets.images import (
    UnreadableImageError,
    exif_turn,
    levels_in,
    list_images,
    load_depth,
    load_gray,
    prefetch,
)
from vio.datasets.levels import FULL_SCALE, LEVEL_IMAGES, Levels, is_mosaic, mosaic_note
from vio.datasets.settings import DatasetSettings
from vio.errors import DataError
from vio.geometry.lie import FloatArray
from vio.records import (
    Event,
    Image,
    ImuDensities,
    MotionSample,
    Observations,
    Recording,
    StereoFrame,
)

logger = logging.getLogger(__name__)

Item = TypeVar("Item")
# left and right image of each frame; of one camera, the same twice
ImagePairs = Sequence[tuple[Path, Path]]

_NAMED = 5  # skipped frames that get a line each; the others are counted in one at the end


def pair_images(left: Path, right: Path) -> ImagePairs:
    """Pair the image files of two folders by name.

    Raises:
        DataError: a file lacks its partner; the message gives both counts and names the first one.
    """
    lefts = list_images(left)
    rights = list_images(right)
    rows = [{stem_of(name): k for k, name in enumerate(files.names)} for files in (lefts, rights)]
    for here, there, files, folder in (
        (rows[0], rows[1], lefts, right),
        (rows[1], rows[0], rights, left),
    ):
        if (
            missing := next((k for stem, k in here.items() if stem not in there), None)
        ) is not None:
            raise DataError(
                f"{left} holds {len(lefts)} images and {right} {len(rights)}: "
                f"{folder / files.names[missing]} is "
                "missing; remove its partner or copy it again"
            )
    return FilePairs(lefts, rights.take(rows[1][stem_of(name)] for name in lefts.names))


@dataclass(frozen=True, slots=True)
class BadFrame:
    """A frame with an image that is unreadable or of another size, and the reason."""

    index: int
    why: str


def readable_frames(
    load: Callable[[Item], StereoFrame | BadFrame],
    chosen: Iterable[Item],
    settings: DatasetSettings,
) -> Generator[StereoFrame]:
    """Prefetch frames in a thread, and skip unusable ones with a warning.

    Raises:
        DataError: every frame is unusable, more are than the settings allow, or whatever `load`
            raises.
    """
    good = 0
    first_bad = ""
    bad = 0
    unsaid: list[BadFrame] = []  # until a frame can be used: if none can, the error alone says why
    with contextlib.closing(prefetch(load, chosen, settings.prefetch_frames)) as loaded:
        for frame in loaded:
            if isinstance(frame, StereoFrame):
                good += 1
                _say_skipped(unsaid)
                yield frame
                continue
            bad = bad + 1
            first_bad = first_bad or frame.why
            if settings.max_bad_frames is not None and bad > settings.max_bad_frames:
                raise DataError(
                    f"{frame.why} ({bad} unusable frames, dataset.max_bad_frames allows "
                    f"{settings.max_bad_frames})"
                )
            if bad <= _NAMED:
                unsaid.append(frame)
            if good:
                _say_skipped(unsaid)
    if bad and not good:
        several = f"none of {bad} frames can be used; the first: " if bad > 1 else ""
        raise DataError(f"{several}{first_bad}")
    if bad > _NAMED:
        logger.warning(
            "%d of %d frames were skipped; the first %d are named above", bad, bad + good, _NAMED
        )


def _say_skipped(unsaid: list[BadFrame]) -> None:
    """Log frames that are skipped, and empty their list."""
    for frame in unsaid:
        logger.warning("frame %d is skipped: %s", frame.index, frame.why)
    unsaid.clear()


def gray_levels(pairs: ImagePairs) -> tuple[Levels, tuple[str, ...]]:
    """Return the levels of black and white of a recording's images, for `load_gray`, with notes
    where they are not 0 and 65535, and where the images look like raw ones of a colour camera.
    """
    last = len(pairs) - 1
    if pairs:
        chosen = {last * k // (LEVEL_IMAGES - 1) for k in range(LEVEL_IMAGES)}
    else:
        chosen = set()
    levels = levels_in([path for k in sorted(chosen) for path in pairs[k]])
    return levels, (*levels.note, *_mosaic_notes(pairs), *_turn_notes(pairs))


def _turn_notes(pairs: ImagePairs) -> tuple[str, ...]:
    """Return the doubt about a first pair of images that ask to be turned."""
    for path in dict.fromkeys(pairs[0] if pairs else ()):
        with contextlib.suppress(OSError):
            if turn := exif_turn(path):
                return (
                    f"{path.parent}: doubtful: the images ask to be {turn} (EXIF), as viewers and "
                    "OpenCV's imread do; they are read as they are stored; if the calibration is "
                    "of images as they are shown, write these, without EXIF",
                )
    return ()


def _mosaic_notes(pairs: ImagePairs) -> tuple[str, ...]:
    """Return the doubt about the first pair of images, each of which may be a mosaic."""
    for path in dict.fromkeys(pairs[0] if pairs else ()):
        with contextlib.suppress(UnreadableImageError):
            if is_mosaic(load_gray(path, colour=True)[0]):
                return (mosaic_note(str(path.parent)),)
    return ()


def measured_images(pairs: ImagePairs) -> tuple[tuple[int, int], Levels, tuple[str, ...]]:
    """Return width and height of the first left image that can be read, the levels of black and
    white of all, and notes.

    Raises:
        UnreadableImageError: all left images are unreadable.
    """
    for index, (path, _) in enumerate(pairs, start=1):
        try:
            image, bits = load_gray(path)
            break
        except UnreadableImageError:
            if index == len(pairs):
                raise
    levels, notes = gray_levels(pairs)
    if bits == 16 and not levels.note:
        notes = (f"images have 16 bits ({path.name}); scaled to 8 bits by 1/257", *notes)
    return (image.shape[1], image.shape[0]), levels, notes


@dataclass(frozen=True, slots=True)
class ImageSize:
    """The size that the images of one camera must have."""

    width: int  # pixels
    height: int  # pixels
    stated_by: Path  # a calibration, or the image that was measured

    def check(self, image: Image, path: Path) -> None:
        """Raise UnreadableImageError unless an image (H, W) or (H, W, 3) has this size."""
        if image.shape[:2] != (self.height, self.width):
            raise UnreadableImageError(
                f"{path} is {image.shape[1]} x {image.shape[0]} pixels but {self.stated_by} is for "
                f"{self.width} x "
                f"{self.height}"
                f"{stacked_hint((image.shape[1], image.shape[0]), (self.width, self.height))}; give "
                "images of one size, and the calibration of these images"
            )


def stacked_hint(size: tuple[int, int], stated: tuple[int, int]) -> str:
    """Return what images of twice the stated height may be; nothing where they have another size.

    Args:
        size: width and height of the images, pixels.
        stated: those that the calibration states.
    """
    if size != (stated[0], 2 * stated[1]):
        return ""
    return (
        ", of twice the height, as those that hold both cameras' images one above the other or "
        "in alternate rows: write each camera's images into a folder or a video of its own"
    )


@dataclass(frozen=True, slots=True)
class ImageRecording(ABC):
    """Implements `vio.protocols.Dataset` over images, which a subclass reads; they are rectified
    as they are read.
    """

    recording: Recording
    motion: Sequence[MotionSample] = field(repr=False)  # in time order
    sizes: tuple[ImageSize, ...]  # of the left and the right images; one of one camera
    settings: DatasetSettings
    rectifier: Rectifier
    imu_noise: ImuDensities | None = field(default=None, kw_only=True)
    colour: bool = field(default=False, kw_only=True)  # see `in_colour`

    def events(
        self, start: int = 0, stop: int | None = None, *, images: bool = True
    ) -> Iterator[Event]:
        """Yield events of the frames `start <= index < stop` in time order.

        A frame with an image that is unreadable or of another size is skipped with a warning.

        Raises:
            DataError: the range holds no frame, or none that can be used, or more are unusable than
                the settings allow.
        """
        chosen = chosen_frames(self.recording, start, stop, self.settings.max_frame_rate)
        if images:
            frames = self._frames(chosen)
        else:
            frames = blank_frames(self.recording, chosen)
        return merge_events(self.recording, chosen, self.motion, frames)

    def frames(self, chosen: Sequence[int]) -> Generator[StereoFrame]:
        """Yield frames by their numbers, increasing, as `events` does, and read no others."""
        return self._frames(chosen)

    def observations(self, index: int) -> Observations | None:
        """Return None: the recording holds images only."""
        return None

    @abstractmethod
    def _frames(self, chosen: Sequence[int]) -> Generator[StereoFrame]:
        """Yield the chosen frames that can be used."""


@dataclass(frozen=True, slots=True)
class ImageDataset(ImageRecording):
    """Implements `vio.protocols.Dataset` over image files."""

    pairs: ImagePairs
    # of 16-bit files, from `gray_levels`
    levels: Levels = field(default=FULL_SCALE, kw_only=True)
    # depth image of each frame; None: there are none
    depths: Sequence[Path] | None = field(default=None, kw_only=True)
    depth_factor: float = field(default=1.0, kw_only=True)  # levels of a depth image per metre
    # each file holds the left and the right image side by side
    side_by_side: bool = field(default=False, kw_only=True)

    def _frames(self, chosen: Sequence[int]) -> Generator[StereoFrame]:
        return readable_frames(self._load, chosen, self.settings)

    def _load(self, index: int) -> StereoFrame | BadFrame:
        """Read and rectify one frame; runs in the prefetch thread."""
        time_ns = int(self.recording.frame_times_ns[index])
        try:
            images = list[Image]()
            for size, path in zip(
                self.sizes[: self.settings.cameras], self.pairs[index], strict=False
            ):
                image = load_gray(path, self.levels, colour=self.colour)[0]
                images.append(half_of(image, len(images)) if self.side_by_side else image)
                size.check(images[-1], path)
            depth_m = (
                None
                if self.depths is None
                else _depth_m(self.depths[index], images[0], self.depth_factor)
            )
            return self.rectifier.frame(index, time_ns, *images, depth_m=depth_m)
        except UnreadableImageError as error:
            return BadFrame(index, str(error))


def half_of(image: Image, side: int) -> Image:
    """Return the left (0) or right (1) half of an image (H, 2 W) or (H, 2 W, 3)."""
    width = image.shape[1] // 2
    return np.ascontiguousarray(image[:, side * width : (side + 1) * width])


def _depth_m(file: Path, image: Image, factor: float) -> FloatArray:
    """Read the depths (H, W) of an image (H, W), metres."""
    levels = load_depth(file)
    if levels.shape != image.shape[:2]:
        raise UnreadableImageError(
            f"{file} is {levels.shape[1]} x {levels.shape[0]} pixels, but its image is "
            f"{image.shape[1]} x "
            f"{image.shape[0]}; depth images must be registered to the images"
        )
    return levels / factor
