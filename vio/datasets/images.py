"""Read gray image files with strict checks and prefetching, and write them.

OpenCV fills the missing part of a truncated file with gray and reports no error, so a file's end is checked before it
is decoded.
"""

from __future__ import annotations

import re
import struct
import zlib
from collections import deque
from collections.abc import Callable, Generator, Iterable
from concurrent.futures import Future, ThreadPoolExecutor
from itertools import islice
from pathlib import Path
from typing import TypeVar

import numpy as np

from vio.datasets.image_formats import OTHER_SUFFIXES, other_damage
from vio.errors import DataError
from vio.records import Image

SUFFIXES = (".png", ".jpg", ".jpeg", *OTHER_SUFFIXES)
_PNG_START = b"\x89PNG\r\n\x1a\n"
_JPEG_START, _JPEG_END = b"\xff\xd8", b"\xff\xd9"
_FULL_16_TO_8 = 257  # 65535 / 255
_PNG_LEVEL = 1  # files a tenth larger than at the usual level 3, in a third of the time

Item = TypeVar("Item")
Loaded = TypeVar("Loaded")


class UnreadableImageError(DataError):
    """An image file is missing, truncated, corrupt or of another size; a reader may skip its frame."""


def load_gray(path: Path) -> tuple[Image, int]:
    """Read a PNG or JPEG as 8-bit gray (H, W); return it with the file's own bits per channel (8 or 16).

    Colour is converted to gray with OpenCV's weights (.299 R + .587 G + .114 B); 16 bits are scaled to 8 by 1/257.

    Raises:
        UnreadableImageError: the file cannot be read, is truncated, or does not decode.
    """
    try:
        data = path.read_bytes()
    except OSError as error:
        raise UnreadableImageError(f"cannot read {path}: {error.strerror or error}") from error
    return decode_gray(data, path)


def decode_gray(data: bytes, path: Path | str) -> tuple[Image, int]:
    """Decode an image file in memory as `load_gray` does; `path` names it in messages."""
    import cv2

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


def write_png(path: Path, image: Image) -> None:
    """Write a gray image (H, W) as PNG, with fast compression."""
    import cv2

    _, data = cv2.imencode(".png", image, [cv2.IMWRITE_PNG_COMPRESSION, _PNG_LEVEL])
    path.write_bytes(data.tobytes())


def _damage(data: bytes) -> str | None:
    """Describe the damage of an encoded image; None: it is complete."""
    if not data:
        return "the file is empty"
    if data.startswith(_PNG_START):
        return _png_damage(data)
    if data.startswith(_JPEG_START):
        return None if data.rstrip(b"\0").endswith(_JPEG_END) else "the JPEG is truncated"
    return other_damage(data)


def _png_damage(data: bytes) -> str | None:
    """Check the chunks up to IEND and their checksums. Reference: PNG specification (W3C), section 5."""
    at = len(_PNG_START)
    while at + 12 <= len(data):
        size, kind = struct.unpack_from(">I4s", data, at)
        end = at + 12 + size
        if end > len(data):
            break
        if zlib.crc32(data[at + 4 : end - 4]) != struct.unpack_from(">I", data, end - 4)[0]:
            return f"the PNG is damaged (wrong checksum in its {kind.decode('latin-1')!r} chunk)"
        if kind == b"IEND":
            return None
        at = end
    return "the PNG is truncated"


def list_images(folder: Path) -> tuple[Path, ...]:
    """The image files of a folder, sorted by name, numbers as numbers: `left2.png` before `left10.png`.

    Raises:
        DataError: the folder is missing or holds no image.
    """
    try:
        images = (p for p in folder.iterdir() if p.suffix.lower() in SUFFIXES and not p.name.startswith("."))
        found = sorted(images, key=natural_key)
    except OSError as error:
        raise DataError(f"cannot list {folder}: {error.strerror or error}; give a folder of images") from error
    if not found:
        raise DataError(f"{folder}: holds no image ({', '.join(SUFFIXES)})")
    return tuple(found)


def natural_key(path: Path) -> tuple[tuple[tuple[int, str], ...], str]:
    """Sort key of a name with its runs of digits as numbers; equal ones (`1.png`, `01.png`) by their text."""
    parts = re.split(r"(\d+)", path.stem)
    return tuple((int(p), "") if k % 2 else (-1, p) for k, p in enumerate(parts)), path.name


def prefetch(load: Callable[[Item], Loaded], items: Iterable[Item], depth: int) -> Generator[Loaded]:
    """Yield `load(item)` in order, loading up to `depth` items ahead in one thread; 0 loads in the caller's.

    An exception of `load` is raised at its item. Closing the generator drops pending items and ends the thread.
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
