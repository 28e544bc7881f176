"""Read image files with strict checks and prefetching, as gray ones where nothing else is asked
for, and write them.

OpenCV fills the missing part of a truncated file with gray and reports no error, so a file's end is
checked before it is decoded.
"""

from __future__ import annotations

import contextlib
import itertools
import os
import re
import struct
from collections import deque
from collections.abc import Callable, Generator, Iterable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import numpy.typing as npt

from vio.datasets.image_files import ImageFiles, stem_of
from vio.datasets.levels import FULL_SCALE, Band, Levels, band_of, levels_of, to_8_bits
from vio.datasets.png import MAX_PIXELS, crc32, decode_gray8
from vio.errors import DataError
from vio.files.inputs import check_regular, read_input
from vio.geometry.lie import FloatArray
from vio.numerics.kinds import Capacity
from vio.records import Image

OTHER_SUFFIXES = (".bmp", ".tif", ".tiff", ".pgm", ".ppm", ".pnm", ".webp")
SUFFIXES = (".png", ".jpg", ".jpeg", ".jpe", ".jfif", *OTHER_SUFFIXES)
_TIFF_STARTS = (b"II*\0", b"MM\0*")
_PNG_START = b"\x89PNG\r\n\x1a\n"
_JPEG_START = b"\xff\xd8"
_JPEG_END = b"\xff\xd9"
_NETPBM = (b"P2", b"P3", b"P5", b"P6")  # as text, and in binary
_MAX_BYTES: Capacity[int] = 2**29  # of a file: more than 64 Mpx of 16 bits in colour
# start-of-frame markers, with the image size
_JPEG_FRAMES = frozenset({*range(0xC0, 0xD0)} - {0xC4, 0xC8, 0xCC})
_EXIF_BYTES = 4096  # from the beginning of a file, where its orientation stands
_EXIF_ORIENTATION = 0x0112
_EXIF_TURNS = {
    2: "mirrored",
    3: "turned by 180 degrees",
    4: "flipped, top to bottom",
    5: "mirrored and turned by 270 degrees",
    6: "turned by 90 degrees",
    7: "mirrored and turned by 90 degrees",
    8: "turned by 270 degrees",
}
_PNG_LEVEL: Capacity[int] = (
    1  # files a tenth larger than at the usual level 3, in a third of the time
)


Item = TypeVar("Item")
Loaded = TypeVar("Loaded")


class UnreadableImageError(DataError):
    """An image file is missing, truncated, corrupt or of another size; a reader may skip its
    frame.
    """


def load_gray(
    path: Path, levels: Levels = FULL_SCALE, *, colour: bool = False
) -> tuple[Image, int]:
    """Read a PNG or JPEG as 8-bit gray (H, W); return it with the file's own bits per channel (8 or
    16).

    Colour is converted to gray with OpenCV's weights (.299 R + .587 G + .114 B), or kept as (H, W,
    3) with `colour`.

    Args:
        path: the file.
        levels: those of a file of 16 bits that become 0 and 255; see `levels_in`.
        colour: keep red, green and blue, where the file has them.

    Raises:
        UnreadableImageError: the file cannot be read, is truncated or too large, or does not
            decode.
    """
    pixels = _load(path, colour=colour)
    return to_8_bits(pixels, levels), pixels.dtype.itemsize * 8


def decode_gray(
    data: bytes, path: Path | str, levels: Levels = FULL_SCALE, *, colour: bool = False
) -> Image:
    """Decode an image file in memory as `load_gray` does; `path` names it in messages."""
    return to_8_bits(_decoded(data, path, colour=colour), levels)


def levels_in(paths: Sequence[Path]) -> Levels:
    """Return the levels of black and white of 16-bit images, see `vio.datasets.levels`.

    One pair of levels serves all frames of a recording, so that its brightness does not jump.
    Images of 8 bits, and unreadable ones, are passed over.

    Args:
        paths: some images of the recording, spread over it.
    """
    bands = []
    for path in paths:
        with contextlib.suppress(UnreadableImageError, OSError):
            check_regular(path)
            with path.open("rb") as stream:
                start = stream.read(64)
            if has_16_bits(start) is not False:
                pixels = _load(path)
                bands += [band_of(pixels)] if pixels.dtype.itemsize == 2 else []
    return levels_of(bands)


def has_16_bits(start: bytes) -> bool | None:
    """Return whether an encoded image has 16 bits a channel, by its first 64 bytes; None: they do
    not say.
    """
    if start.startswith(_PNG_START):
        return start[24:25] == b"\x10"  # the depth in the header
    if start.startswith(_TIFF_STARTS) or start[:2] in _NETPBM:
        return None
    return False


def band_in(data: bytes, where: str) -> Band | None:
    """Return the band of levels of an encoded image in memory; None: it has 8 bits.

    Raises:
        UnreadableImageError: it does not decode.
    """
    if has_16_bits(data[:64]) is False:
        return None
    pixels = _decoded(data, where, colour=False)
    return band_of(pixels) if pixels.dtype.itemsize == 2 else None


def exif_turn(path: Path) -> str:
    """Return how a JPEG file asks to be turned (clockwise) or mirrored when it is shown; nothing: it
    does not ask.

    Reference: Exif 2.3, tag 0x0112, in the segment APP1.

    Raises:
        OSError: it cannot be read, or is no regular file.
    """
    check_regular(path)
    with path.open("rb") as stream:
        data = stream.read(_EXIF_BYTES)
    at = data.find(b"Exif\0\0")
    if not data.startswith(_JPEG_START) or at < 0:
        return ""
    tiff = data[at + 6 :]
    order = ">" if tiff.startswith(b"MM") else "<"
    try:
        (first,) = struct.unpack_from(f"{order}I", tiff, 4)
        (count,) = struct.unpack_from(f"{order}H", tiff, first)
        for k in range(count):
            entry = first + 2 + 12 * k
            (tag,) = struct.unpack_from(f"{order}H", tiff, entry)
            if tag == _EXIF_ORIENTATION:
                (value,) = struct.unpack_from(f"{order}H", tiff, entry + 8)
                return _EXIF_TURNS.get(value, "")
    except struct.error:  # a part of another file, or a damaged one
        return ""
    return ""


def _load(path: Path, *, colour: bool = False) -> npt.NDArray[Any]:
    """Read a file as gray (H, W) of its own depth, or in colour (H, W, 3) where it has any and
    it is asked for.
    """
    try:
        data = read_input(path, _MAX_BYTES)
    except OSError as error:
        raise UnreadableImageError(f"cannot read {path}: {error.strerror or error}") from error
    return _decoded(data, path, colour=colour)


def _decoded(data: bytes, path: Path | str, *, colour: bool) -> npt.NDArray[Any]:
    """Decode a file in memory as `_load` does."""
    if data.startswith(_PNG_START) and (gray := decode_gray8(data)) is not None:
        return gray
    if problem := _damage(data):
        raise UnreadableImageError(f"{path}: {problem}; copy the image again")
    import cv2

    try:
        pixels = cv2.imdecode(np.frombuffer(data, dtype=np.uint8), cv2.IMREAD_UNCHANGED)
    except (cv2.error, MemoryError) as error:
        raise UnreadableImageError(
            f"{path}: does not decode ({' '.join(str(error).split())})"
        ) from error
    if pixels is not None and pixels.dtype not in (np.uint8, np.uint16):
        raise UnreadableImageError(
            f"{path}: its pixels are {pixels.dtype}, and images of 8 or 16 bits are read; write it so, "
            "all images by one factor"
        )
    if pixels is None or not pixels.size:
        raise UnreadableImageError(
            f"{path}: does not decode as an image of 8 or 16 bits; copy the image again"
        )
    return np.asarray(_in_channels(pixels, colour=colour))


def _in_channels(pixels: npt.NDArray[Any], *, colour: bool) -> npt.NDArray[Any]:
    """Return decoded pixels as RGB (H, W, 3) or gray (H, W); gray ones stay gray."""
    import cv2

    if pixels.ndim != 3:
        return pixels
    channels = pixels.shape[2]
    if channels == 1:
        return pixels[..., 0]
    if colour:
        code = {3: cv2.COLOR_BGR2RGB, 4: cv2.COLOR_BGRA2RGB}[channels]
    else:
        code = {3: cv2.COLOR_BGR2GRAY, 4: cv2.COLOR_BGRA2GRAY}[channels]
    return cv2.cvtColor(pixels, code)


def load_depth(path: Path) -> FloatArray:
    """Read a depth image (H, W) of 16 bits as the levels that it holds, 0 where the depth is not
    known.

    Raises:
        UnreadableImageError: the file cannot be read, or is no gray image of 16 bits.
    """
    pixels = _load(path)
    if pixels.dtype != np.uint16:
        raise UnreadableImageError(
            f"{path}: has 8 bits a pixel, too few for depths; give depth images of 16 bits (PNG or "
            "TIFF)"
        )
    return pixels.astype(np.float64)


def write_png(path: Path, image: Image) -> None:
    """Write a gray image (H, W), or one in colour (H, W, 3), as PNG, with fast compression."""
    import cv2

    shown = image if image.ndim == 2 else image[:, :, ::-1]
    _, data = cv2.imencode(".png", shown, [cv2.IMWRITE_PNG_COMPRESSION, _PNG_LEVEL])
    path.write_bytes(data.tobytes())


def _damage(data: bytes) -> str | None:
    """Describe the damage of an encoded image; None: it is complete."""
    if not data:
        return "the file is empty"
    if data.startswith(_PNG_START):
        return _png_damage(data)
    if data.startswith(_JPEG_START):
        return _jpeg_damage(data)
    return other_damage(data)


def _size_fault(width: int, height: int) -> str | None:
    """Say what is wrong with the size that a header states; None: nothing."""
    if width * height <= 0:
        return f"its header states {width} x {height} pixels, which is no image"
    if width * height <= MAX_PIXELS:
        return None
    return f"its header states {width} x {height} pixels, more than {MAX_PIXELS / 2**20:g} Mpx"


def _jpeg_damage(data: bytes) -> str | None:
    """Check the segments up to the end of the image; what follows it (a preview, a video) is not
    looked at.

    Reference: ITU-T T.81, annex B.
    """
    at = len(_JPEG_START)
    while 0 <= at <= len(data) - 4:
        if data[at] != 0xFF:
            break
        kind = data[at + 1]
        if kind == 0xFF:  # fill bytes may precede a marker
            at += 1
            continue
        if kind == _JPEG_END[1]:
            return None
        (size,) = struct.unpack_from(">H", data, at + 2)
        if kind in _JPEG_FRAMES and at + 9 <= len(data):
            height, width = struct.unpack_from(">HH", data, at + 5)
            if problem := _size_fault(width, height):
                return problem
        at += 2 + size
        if kind == 0xDA:  # the compressed pixels of a scan, up to a marker
            if data.rstrip(b"\0").endswith(_JPEG_END):
                return None
            at = _end_of_scan(data, at)
    if at >= 0 and data[at : at + 2] == _JPEG_END:
        return None
    return "the JPEG is truncated"


def _end_of_scan(data: bytes, at: int) -> int:
    """Return where the marker after a scan begins; -1: there is none."""
    while True:
        at = data.find(b"\xff", at)
        if at < 0 or at + 1 >= len(data):
            return -1
        # neither a data byte of 255 nor a restart
        if data[at + 1] != 0 and not 0xD0 <= data[at + 1] <= 0xD7:
            return at
        at += 2


def _png_damage(data: bytes) -> str | None:
    """Check the chunks up to IEND and their checksums.

    Reference: PNG specification (W3C), section 5.
    """
    at = len(_PNG_START)
    while at + 12 <= len(data):
        size, kind = struct.unpack_from(">I4s", data, at)
        end = at + 12 + size
        if end > len(data):
            break
        if crc32(data[at + 4 : end - 4]) != struct.unpack_from(">I", data, end - 4)[0]:
            return f"the PNG is damaged (wrong checksum in its {kind.decode('latin-1')!r} chunk)"
        if (
            kind == b"IHDR"
            and size >= 8
            and (problem := _size_fault(*struct.unpack_from(">II", data, at + 8)))
        ):
            return problem
        if kind == b"IEND":
            return None
        at = end
    return "the PNG is truncated"


def list_images(folder: Path) -> ImageFiles:
    """The image files of a folder, sorted by name, numbers as numbers: `left2.png` before
    `left10.png`.

    Raises:
        DataError: the folder is missing or holds no image.
    """
    try:
        images = (
            n
            for n in os.listdir(folder)
            if os.path.splitext(n)[1].lower() in SUFFIXES and n[0] != "."
        )
        found = sorted(images, key=natural_key)
    except OSError as error:
        raise DataError(
            f"cannot list {folder}: {error.strerror or error}; give a folder of images"
        ) from error
    if not found:
        raise DataError(f"{folder}: holds no image ({', '.join(SUFFIXES)})")
    return ImageFiles(folder, tuple(found))


def natural_key(name: str) -> tuple[tuple[tuple[int, str], ...], str]:
    """Sort key of a name with its runs of digits as numbers; equal ones (`1.png`, `01.png`) by
    their text.

    Digits behind a point are those of a decimal where seconds since 1970 stand before it.
    """
    seconds = re.fullmatch(r"(.*?)(\d{9,10})\.(\d{1,9})", stem_of(name))
    if seconds is not None:
        fraction = seconds[3].ljust(9, "0")
        return (
            (-1, seconds[1]),
            (int(seconds[2]), ""),
            (-1, "."),
            (int(fraction), ""),
        ), name
    parts = re.split(r"(\d+)", stem_of(name))
    return tuple((int(p), "") if k % 2 else (-1, p) for k, p in enumerate(parts)), name


def prefetch(
    load: Callable[[Item], Loaded], items: Iterable[Item], depth: int
) -> Generator[Loaded]:
    """Yield `load(item)` in order, taking and loading up to `depth` items ahead in one thread; 0:
    in the caller's.

    An exception of `load` or of the items is raised at its item. Closing the generator drops
    pending items, ends the thread, and closes the items where they are a generator.
    """
    if depth <= 0:
        yield from map(load, items)
        return
    source = iter(items)

    def step() -> list[Loaded]:
        """Take and load an item, if any is left; all in the thread, as the items may be read
        from a file, too.
        """
        return [load(item) for item in itertools.islice(source, 1)]

    waiting: deque[Future[list[Loaded]]] = deque()
    pool = ThreadPoolExecutor(max_workers=1, thread_name_prefix="vio-prefetch")
    try:
        waiting.extend(pool.submit(step) for _ in range(depth))
        while loaded := waiting.popleft().result():
            waiting.append(pool.submit(step))
            yield from loaded
    finally:
        pool.shutdown(wait=True, cancel_futures=True)
        if isinstance(source, Generator):
            source.close()


def other_damage(data: bytes) -> str | None:
    """Describe the damage of an encoded BMP, TIFF, PGM, PPM or WebP image; None: it is complete.

    References: the formats' headers. TIFF states no length; the decoder refuses what it cannot
    read.
    """
    if data.startswith(b"BM") and len(data) >= 6:
        return "the BMP is truncated" if _size_at(data, 2) > len(data) else None
    if data.startswith(b"RIFF") and data[8:12] == b"WEBP":
        if _size_at(data, 4) + 8 > len(data):
            return "the WebP is truncated"
        return None
    if data[:2] in _NETPBM:
        return _netpbm_damage(data)
    if data.startswith(_TIFF_STARTS):
        return None
    return "neither PNG nor JPEG, BMP, TIFF, PGM, PPM or WebP"


def _size_at(data: bytes, offset: int) -> int:
    """Return the size that a header states, in bytes."""
    (size,) = struct.unpack_from("<I", data, offset)
    return int(size)


def _netpbm_damage(data: bytes) -> str | None:
    """Describe the damage of a PGM or PPM image; None: it is complete."""
    header = re.match(rb"P[2356]\s+(?:#.*\s+)*(\d+)\s+(?:#.*\s+)*(\d+)\s+(?:#.*\s+)*(\d+)\s", data)
    if header is None:
        return "the PGM or PPM has no valid header"
    width, height, top = (int(x) for x in header.groups())
    values = width * height * (3 if data[:2] in (b"P3", b"P6") else 1)
    if data[:2] in (b"P2", b"P3"):
        found = len(data[header.end() :].split(maxsplit=values)[:values])
    else:
        found = (len(data) - header.end()) // (2 if top > 255 else 1)
    return "the PGM or PPM is truncated" if found < values else None
