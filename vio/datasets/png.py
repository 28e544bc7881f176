"""PNG files of 8-bit gray pixels, in about half the time that OpenCV takes for them.

Such files hold the images of most recordings, and libpng takes more of a frame's time than
Lucas-Kanade. Here zlib inflates all pixels at once, and a compiled loop undoes the filters. Nearly
all rows of a photograph have Paeth's, which predicts a byte from its neighbours left, above, and
above left, so that a row waits for itself at each pixel; rows are therefore decoded side by side,
each one pixel behind the row above it.
Reference: PNG specification (W3C), sections 7 to 10.
"""

from __future__ import annotations

import struct

import numpy as np

from vio.records import Image

__all__ = ["MAX_PIXELS", "crc32", "decode_gray8"]

try:
    from isal.isal_zlib import IsalError as ZlibError  # inflates in half to two thirds of the time
    from isal.isal_zlib import crc32, decompressobj
except ImportError:  # a processor without its wheels
    from zlib import crc32, decompressobj  # type: ignore[assignment]
    from zlib import error as ZlibError  # type: ignore[assignment]  # noqa: N812

# 8192 x 8192; a header may state 2^62, and decoding would try to get the memory
MAX_PIXELS = 2**26
_START = b"\x89PNG\r\n\x1a\n"
_GRAY_8 = (8, 0, 0, 0, 0)  # depth, colour type, compression, filter method, no interlacing
# Chunks that change no pixel. With any other, such as transparency or an animation, the file is
# left to OpenCV.
_PASSED_OVER = frozenset(
    {b"tEXt", b"zTXt", b"iTXt", b"pHYs", b"tIME", b"gAMA", b"cHRM", b"sRGB", b"iCCP", b"sBIT"}
)
_LAST_FILTER = 4  # Paeth's


def decode_gray8(data: bytes) -> Image | None:
    """Return the pixels (H, W) of a PNG file in memory, which are whole by the checksum of all of
    them.

    None where the file is not of 8-bit gray without interlacing, or where it is damaged, empty or
    too large: OpenCV reads the other kinds, and `vio.datasets.images` says what is damaged, by the
    checksums of the chunks.
    """
    parts = []
    size = None
    at = len(_START)
    while at + 12 <= len(data):
        length, kind = struct.unpack_from(">I4s", data, at)
        if at + 12 + length > len(data):
            return None
        if kind == b"IDAT":
            parts.append(data[at + 8 : at + 8 + length])
        elif kind == b"IHDR" and length == 13:
            size = _size_of_gray_8(data, at + 8)
        elif kind == b"IEND":
            if size is None:
                return None
            return _pixels(b"".join(parts), *size)
        elif kind not in _PASSED_OVER:
            return None
        if size is None:
            return None
        at += 12 + length
    return None


def _size_of_gray_8(data: bytes, at: int) -> tuple[int, int] | None:
    """Return height and width of a header; None: of another form, empty or too large."""
    width, height, *form = struct.unpack_from(">IIBBBBB", data, at)
    if tuple(form) == _GRAY_8 and 0 < height * width <= MAX_PIXELS:
        return height, width
    return None


def _pixels(compressed: bytes, height: int, width: int) -> Image | None:
    """Inflate and unfilter the rows of an image."""
    size = height * (width + 1)
    stream = decompressobj()
    try:
        raw = stream.decompress(compressed, size)  # no more than the header states
    except ZlibError:  # type: ignore[misc]  # an instance by the stubs of isal, a class in fact
        return None
    if len(raw) != size or not stream.eof:  # at its end the checksum has been compared
        return None
    rows = np.frombuffer(raw, dtype=np.uint8).reshape(height, width + 1)
    if int(rows[:, 0].max()) > _LAST_FILTER:
        return None
    from vio.datasets.png_rows import unfilter  # it loads numba

    out: Image = np.empty((height, width), dtype=np.uint8)
    unfilter(rows, out)
    return out
