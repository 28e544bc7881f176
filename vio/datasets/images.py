"""Gray images, read strictly and ahead of time.

OpenCV fills what a truncated file lacks with gray and reports nothing, so a file's end is checked before it is
decoded.
"""

from __future__ import annotations

import contextlib
import logging
import struct
import zlib
from collections import deque
from collections.abc import Callable, Generator, Iterable
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import TypeVar

import numpy as np

from vio.datasets.settings import DatasetSettings
from vio.errors import DataError
from vio.records import Image, StereoFrame

logger = logging.getLogger(__name__)

SUFFIXES = (".png", ".jpg", ".jpeg")
_PNG_START = b"\x89PNG\r\n\x1a\n"
_JPEG_START, _JPEG_END = b"\xff\xd8", b"\xff\xd9"
_FULL_16_TO_8 = 257  # 65535 / 255

Item = TypeVar("Item")
Loaded = TypeVar("Loaded")


class UnreadableImageError(DataError):
    """One image file is missing, truncated or damaged; a reader may skip its frame."""


def load_gray(path: Path) -> tuple[Image, int]:
    """Read a PNG or JPEG as 8-bit gray (H, W); return it with the file's own bits per channel (8 or 16).

    Colour is turned to gray with OpenCV's weights (.299 R + .587 G + .114 B); 16 bits are scaled to 8 by 1/257.

    Raises:
        UnreadableImageError: the file cannot be read, is truncated, or does not decode.
    """
    import cv2

    try:
        data = path.read_bytes()
    except OSError as error:
        raise UnreadableImageError(f"cannot read {path}: {error.strerror or error}") from error
    if problem := _damage(data):
        raise UnreadableImageError(f"{path}: {problem}; copy the image again")
    pixels = cv2.imdecode(np.frombuffer(data, dtype=np.uint8), cv2.IMREAD_UNCHANGED)
    if pixels is None or pixels.dtype not in (np.uint8, np.uint16):
        raise UnreadableImageError(f"{path}: does not decode as an image of 8 or 16 bits; copy the image again")
    bits = pixels.dtype.itemsize * 8
    if pixels.ndim == 3:
        code = {1: None, 3: cv2.COLOR_BGR2GRAY, 4: cv2.COLOR_BGRA2GRAY}[pixels.shape[2]]
        pixels = pixels[..., 0] if code is None else cv2.cvtColor(pixels, code)
    if bits == 16:
        pixels = np.rint(pixels / _FULL_16_TO_8).astype(np.uint8)
    gray: Image = np.ascontiguousarray(pixels, dtype=np.uint8)
    return gray, bits


def _damage(data: bytes) -> str | None:
    """What is wrong with an encoded image, in words; None: it is whole."""
    if not data:
        return "the file is empty"
    if data.startswith(_PNG_START):
        return _png_damage(data)
    if data.startswith(_JPEG_START):
        return None if data.rstrip(b"\0").endswith(_JPEG_END) else "the JPEG is truncated"
    return "neither PNG nor JPEG"


def _png_damage(data: bytes) -> str | None:
    """Walk the chunks up to IEND and check their sums. Reference: PNG specification (W3C), section 5."""
    at = len(_PNG_START)
    while at + 12 <= len(data):
        size, kind = struct.unpack_from(">I4s", data, at)
        end = at + 12 + size
        if end > len(data):
            break
        if zlib.crc32(data[at + 4 : end - 4]) != struct.unpack_from(">I", data, end - 4)[0]:
            return f"the PNG is damaged (wrong check sum in its {kind.decode('latin-1')!r} chunk)"
        if kind == b"IEND":
            return None
        at = end
    return "the PNG is truncated"


def refuse_other_size(image: Image, path: Path, width: int, height: int, other: Path) -> None:
    """Raise DataError unless an image (H, W) is as large as the other one named."""
    if image.shape != (height, width):
        raise DataError(
            f"{path} is {image.shape[1]} x {image.shape[0]} pixels but {other} is {width} x {height}; "
            "all images of a recording must have one size"
        )


def list_images(folder: Path) -> tuple[Path, ...]:
    """The image files of a folder, sorted by name.

    Raises:
        DataError: the folder is missing or holds no image.
    """
    try:
        found = sorted(
            path for path in folder.iterdir() if path.suffix.lower() in SUFFIXES and not path.name.startswith(".")
        )
    except OSError as error:
        raise DataError(f"cannot list {folder}: {error.strerror or error}; give a folder of images") from error
    if not found:
        raise DataError(f"{folder}: holds no image ({', '.join(SUFFIXES)})")
    return tuple(found)


def pair_images(left: Path, right: Path) -> tuple[tuple[Path, Path], ...]:
    """The image files of two folders, paired by name.

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


def prefetch(load: Callable[[Item], Loaded], items: Iterable[Item], depth: int) -> Generator[Loaded]:
    """Yield `load(item)` in order, loading up to `depth` items ahead in one thread; 0 loads in the caller's.

    What `load` raises reaches the caller at its item. Closing the generator drops what waits and ends the thread.
    """
    if depth <= 0:
        yield from map(load, items)
        return
    source = iter(items)
    waiting: deque[Future[Loaded]] = deque()
    pool = ThreadPoolExecutor(max_workers=1, thread_name_prefix="vio-prefetch")
    try:
        waiting.extend(pool.submit(load, item) for item in islice(source, depth))
        while waiting:
            result = waiting.popleft().result()
            waiting.extend(pool.submit(load, item) for item in islice(source, 1))
            yield result
    finally:
        pool.shutdown(wait=True, cancel_futures=True)


@dataclass(frozen=True, slots=True)
class BadFrame:
    """A frame with an unreadable image, and why."""

    index: int
    why: str


def readable_frames(
    load: Callable[[int], StereoFrame | BadFrame], chosen: Iterable[int], settings: DatasetSettings
) -> Generator[StereoFrame]:
    """Load frames ahead in a thread, leaving unreadable ones out with a warning up to the limit of the settings.

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
