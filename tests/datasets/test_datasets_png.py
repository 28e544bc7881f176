"""PNG files of 8-bit gray: read to the bit whatever their filters; OpenCV reads the other kinds."""

from __future__ import annotations

import struct
import zlib
from pathlib import Path

import cv2
import numpy as np
import pytest

from vio.datasets.images import UnreadableImageError, decode_gray
from vio.datasets.png import decode_gray8
from vio.records import Image


def chunk(kind: bytes, data: bytes) -> bytes:
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))


def filtered(pixels: Image, kinds: list[int]) -> bytes:
    """Rows with filters of given kinds, by the definitions of the specification, byte by byte."""
    out = bytearray()
    for y, kind in enumerate(kinds):
        out.append(kind)
        for x, value in enumerate(pixels[y].tolist()):
            a = int(pixels[y, x - 1]) if x else 0
            b = int(pixels[y - 1, x]) if y else 0
            c = int(pixels[y - 1, x - 1]) if x and y else 0
            p = a + b - c
            nearest = min((abs(p - a), 0, a), (abs(p - b), 1, b), (abs(p - c), 2, c))[2]
            out.append((value - (0, a, b, (a + b) // 2, nearest)[kind]) % 256)
    return bytes(out)


def png(
    pixels: Image,
    kinds: list[int],
    *,
    extra: bytes = b"",
    raw: bytes | None = None,
    cut_end: int = 0,
) -> bytes:
    height, width = pixels.shape
    header = chunk(b"IHDR", struct.pack(">IIBBBBB", width, height, 8, 0, 0, 0, 0))
    data = zlib.compress(filtered(pixels, kinds) if raw is None else raw)
    data = data[: len(data) - cut_end]
    cut = len(data) // 2
    parts = chunk(b"IDAT", data[:cut]) + chunk(b"IDAT", data[cut:])
    return b"\x89PNG\r\n\x1a\n" + header + extra + parts + chunk(b"IEND", b"")


@pytest.mark.parametrize("size", [(1, 1), (40, 3), (37, 16), (50, 61)])
def test_all_filters_are_undone_to_the_bit(size: tuple[int, int]) -> None:
    rng = np.random.default_rng(8)
    pixels = np.clip(rng.normal(128, 90, size), 0, 255).astype(np.uint8)
    for kinds in ([4] * size[0], rng.integers(0, 5, size[0]).tolist(), [1] + [4] * (size[0] - 1)):
        data = png(pixels, kinds)
        found = decode_gray8(data)
        np.testing.assert_array_equal(found, pixels)
        np.testing.assert_array_equal(
            cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED), pixels
        )


def test_other_kinds_are_left_to_opencv() -> None:
    pixels = np.full((20, 30), 77, dtype=np.uint8)
    for image in (np.stack([pixels] * 3, axis=2), pixels.astype(np.uint16)):
        data = cv2.imencode(".png", image)[1].tobytes()
        assert decode_gray8(data) is None
    see_through = png(pixels, [0] * 20, extra=chunk(b"tRNS", b"\0\x05"))
    assert decode_gray8(see_through) is None
    np.testing.assert_array_equal(decode_gray(see_through, "a.png"), pixels)
    named = png(pixels, [0] * 20, extra=chunk(b"tEXt", b"Title\0room"))
    assert decode_gray8(named) is not None


@pytest.mark.parametrize("raw", [b"", b"\0" * 100, b"\7" * (20 * 31)])
def test_damaged_pixels_are_refused(raw: bytes, tmp_path: Path) -> None:
    data = png(np.zeros((20, 30), dtype=np.uint8), [0] * 20, raw=raw)
    assert decode_gray8(data) is None
    if not raw:
        with pytest.raises(UnreadableImageError, match="does not decode"):
            decode_gray(data, tmp_path / "a.png")


@pytest.mark.parametrize("shape", [(0, 0), (0, 30), (20, 0)])
@pytest.mark.parametrize("depth", [8, 16])
def test_an_image_without_pixels_is_refused(
    shape: tuple[int, int], depth: int, tmp_path: Path
) -> None:
    height, width = shape
    header = struct.pack(">IIBBBBB", width, height, depth, 0, 0, 0, 0)
    parts = chunk(b"IHDR", header) + chunk(b"IDAT", zlib.compress(b"")) + chunk(b"IEND", b"")
    data = b"\x89PNG\r\n\x1a\n" + parts
    assert decode_gray8(data) is None
    with pytest.raises(UnreadableImageError, match=f"states {width} x {height} pixels"):
        decode_gray(data, tmp_path / "a.png")


@pytest.mark.parametrize("cut_end", [1, 4])
def test_pixels_without_their_checksum_are_refused(cut_end: int) -> None:
    assert decode_gray8(png(np.zeros((20, 30), dtype=np.uint8), [0] * 20, cut_end=cut_end)) is None


def test_no_changed_bit_changes_a_pixel() -> None:
    rng = np.random.default_rng(3)
    pixels = rng.integers(0, 256, (6, 7), dtype=np.uint8)
    whole = png(pixels, [4, 0, 1, 2, 3, 4], extra=chunk(b"tEXt", b"Title\0room"))
    for at in range(8, len(whole)):
        for bit in range(8):
            data = bytearray(whole)
            data[at] ^= 1 << bit
            found = decode_gray8(bytes(data))
            assert found is None or np.array_equal(found, pixels), (at, bit)
