"""Decode ROS image messages to 8-bit gray, or colour."""

from __future__ import annotations

import importlib
import struct
import zlib
from types import SimpleNamespace
from typing import Any

import numpy as np
import numpy.typing as npt

from vio.datasets.images import UnreadableImageError, band_in, decode_gray
from vio.datasets.levels import FULL_SCALE, Band, Levels, band_of, to_8_bits
from vio.errors import DataError
from vio.records import Image

# OpenCV names a Bayer pattern by its second row and column; ROS by its first pixels.
_BAYER = {"rggb": "BG", "bggr": "RG", "gbrg": "GR", "grbg": "GB"}
_YUV = {"yuv422": "UYVY", "uyvy": "UYVY", "yuv422_yuy2": "YUY2", "yuyv": "YUY2"}
# their rows of brightness come first, those of colour behind the image's height
_PLANAR = ("nv12", "nv21", "nv24", "i420", "yuv420", "yuv420p")


def gray_of(
    fields: Any, where: str, *, compressed: bool, levels: Levels = FULL_SCALE, colour: bool = False
) -> Image:
    """Return a sensor_msgs/Image or CompressedImage as gray (H, W), or in colour (H, W, 3) where it
    is asked for.

    Args:
        fields: the decoded message.
        where: topic and frame, for messages.
        compressed: whether it is a CompressedImage.
        levels: those of 16-bit pixels that become 0 and 255.
        colour: keep red, green and blue, where the message has them.

    Raises:
        UnreadableImageError: the pixels are truncated or do not decode.
        DataError: the encoding is not read.
    """
    raw = _raw_fields(fields, where, compressed=compressed)
    if raw is None:
        return decode_gray(bytes(fields.data), where, levels, colour=colour)
    return to_8_bits(raw_gray(raw, where, colour=colour), levels)


# height, width, whether big-endian, bytes a row, and length of the encoding that follows
_PACKED = struct.Struct("<IIBII")
_ZSTD_START = b"\x28\xb5\x2f\xfd"


def _raw_fields(fields: Any, where: str, *, compressed: bool) -> Any | None:
    """Return the fields of a sensor_msgs/Image, also of one that `zstd_image_transport` packed; None:
    they are those of an encoded picture.
    """
    if not compressed:
        return fields
    return _unpacked(fields, where) if str(fields.format).strip() == "zstd" else None


def _unpacked(fields: Any, where: str) -> Any:
    """Return the fields of a sensor_msgs/Image that `zstd_image_transport` packed.

    Its name is that of its later versions' compression; that of earlier ones is gzip.

    Reference: image_transport_plugins, zstd_publisher.cpp.

    Raises:
        UnreadableImageError: the message is truncated or damaged.
    """
    data = bytes(fields.data)
    try:
        height, width, big, step, length = _PACKED.unpack_from(data)
        encoding = data[_PACKED.size : _PACKED.size + length].decode("ascii")
        pixels = _decompressed(data[_PACKED.size + length :])
    except (struct.error, zlib.error, UnicodeDecodeError) as error:
        raise UnreadableImageError(f"{where}: does not decompress ({error})") from error
    return SimpleNamespace(
        encoding=encoding, height=height, width=width, is_bigendian=big, step=step, data=pixels
    )


def _decompressed(data: bytes) -> bytes:
    if not data.startswith(_ZSTD_START):
        return zlib.decompress(data, zlib.MAX_WBITS | 32)  # gzip or zlib, by its header
    # Python's own, or that of a package, as rosbags takes it
    zstd: Any = vars(importlib.import_module("rosbags.rosbag2.reader"))["zstd"]
    try:
        return bytes(zstd.decompress(data))
    except zstd.ZstdError as error:
        raise zlib.error(str(error)) from error


def band_of_message(fields: Any, where: str, *, compressed: bool) -> Band | None:
    """Return the band of levels of a 16-bit image; None: it has 8 bits, or is damaged."""
    try:
        raw = _raw_fields(fields, where, compressed=compressed)
        if raw is None:
            return band_in(bytes(fields.data), where)
        return band_of(raw_gray(raw, where)) if "16" in str(raw.encoding) else None
    except UnreadableImageError:
        return None  # the reader skips it and says so


def raw_gray(fields: Any, where: str, *, colour: bool = False) -> npt.NDArray[Any]:
    """Return the pixels of a sensor_msgs/Image as gray (H, W), or colour (H, W, 3), of its own
    depth.
    """
    import cv2

    encoding = str(fields.encoding)
    height = int(fields.height)
    width = int(fields.width)
    bayer = encoding.startswith("bayer_")
    yuv = _YUV.get(encoding.lower())
    depth, channels = _form(encoding, where, bayer=bayer, yuv=yuv)
    dtype = np.dtype(depth).newbyteorder(">" if fields.is_bigendian else "<")
    row = int(fields.step)
    needed = width * channels * dtype.itemsize
    data = np.frombuffer(bytes(fields.data), dtype=np.uint8)
    _check_whole(len(data), (height, width, row), needed, encoding, where)
    rows = np.ascontiguousarray(data[: row * height].reshape(height, row)[:, :needed])
    pixels = rows.view(dtype).astype(np.dtype(depth), copy=False).reshape(height, width, channels)
    to = "RGB" if colour else "GRAY"
    if bayer:
        code = f"COLOR_Bayer{_BAYER[encoding[6:10]]}2{to}"
        return np.asarray(cv2.cvtColor(pixels[..., 0], getattr(cv2, code)))
    if yuv is not None:
        return np.asarray(cv2.cvtColor(pixels, getattr(cv2, f"COLOR_YUV2{to}_{yuv}")))
    if channels == 1:
        return pixels[..., 0]
    order = _channel_order(encoding, channels)
    if order == to:
        return pixels
    return np.asarray(cv2.cvtColor(pixels, getattr(cv2, f"COLOR_{order}2{to}")))


def _check_whole(
    size: int, shape: tuple[int, int, int], least: int, encoding: str, where: str
) -> None:
    """Raise UnreadableImageError where a message has fewer bytes than its image of rows of a length,
    height, width and bytes a row, which are `least` or more.
    """
    height, width, row = shape
    if min(width, height) < 1 or row < least or size < row * height:
        raise UnreadableImageError(
            f"{where}: {size} bytes are not {width} x {height} pixels of {encoding} in rows "
            f"of {row}; the message is truncated"
        )


def _channel_order(encoding: str, channels: int) -> str:
    """Return the order of the colours, as OpenCV names it: that of `rgb8`, BGR of `8UC3`."""
    if encoding[:1].isdigit():
        return {3: "BGR", 4: "BGRA"}[channels]
    return encoding.rstrip("0123456789").upper()


def _form(encoding: str, where: str, *, bayer: bool, yuv: str | None) -> tuple[str, int]:
    """Return the NumPy type and the channels of an encoding of sensor_msgs/image_encodings."""
    if yuv is not None:
        return "u1", 2
    if encoding.lower() in _PLANAR:  # gray also where colour is asked for
        return "u1", 1
    if bayer and encoding[6:10] in _BAYER and encoding[10:] in ("8", "16"):
        return f"u{int(encoding[10:]) // 8}", 1
    for name, channels in (("mono", 1), ("bgra", 4), ("rgba", 4), ("bgr", 3), ("rgb", 3)):
        if encoding in (f"{name}8", f"{name}16"):
            return f"u{int(encoding[len(name) :]) // 8}", channels
    for bits in (8, 16):
        if encoding.startswith(f"{bits}UC") and encoding[len(f"{bits}UC") :] in ("1", "3", "4"):
            return f"u{bits // 8}", int(encoding[-1])
    raise DataError(
        f"{where}: images of encoding {encoding!r} are not read; use mono8, mono16, bgr8, rgb8 or "
        "bayer_*8"
    )
