"""Image files other than PNG and JPEG: their suffixes, and whether a file is whole."""

from __future__ import annotations

import re
import struct

OTHER_SUFFIXES = (".bmp", ".tif", ".tiff", ".pgm", ".ppm", ".pnm", ".webp")
_TIFF_STARTS = (b"II*\0", b"MM\0*")


def other_damage(data: bytes) -> str | None:
    """Describe the damage of an encoded BMP, TIFF, PGM, PPM or WebP image; None: it is complete.

    References: the formats' headers. TIFF states no length; the decoder refuses what it cannot read.
    """
    if data.startswith(b"BM") and len(data) >= 6:
        return "the BMP is truncated" if struct.unpack_from("<I", data, 2)[0] > len(data) else None
    if data.startswith(b"RIFF") and data[8:12] == b"WEBP":
        return "the WebP is truncated" if struct.unpack_from("<I", data, 4)[0] + 8 > len(data) else None
    if data[:2] in (b"P5", b"P6"):
        header = re.match(rb"P[56]\s+(?:#.*\s+)*(\d+)\s+(?:#.*\s+)*(\d+)\s+(?:#.*\s+)*(\d+)\s", data)
        if header is None:
            return "the PGM or PPM has no valid header"
        width, height, top = (int(x) for x in header.groups())
        size = width * height * (3 if data[:2] == b"P6" else 1) * (2 if top > 255 else 1)
        return "the PGM or PPM is truncated" if len(data) - header.end() < size else None
    if data.startswith(_TIFF_STARTS):
        return None
    return "neither PNG nor JPEG, BMP, TIFF, PGM, PPM or WebP"
