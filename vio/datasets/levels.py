"""Levels of black and white of images with 16 bits, and whether an image is a raw Bayer mosaic.

One rule serves every path of reading: files, raw and compressed messages, live topics.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from vio.dataclass import dataclass
from vio.records import Image

_FULL = 65535
_SENSOR_BITS = (10, 12, 14)  # of cameras whose pixels are stored in the low bits of 16


class _LevelRules(NamedTuple):
    """What gray levels tell of the bits in use."""

    # of the pixels are no brighter than the level that shows the bits in use
    bright_share: float = 0.999
    # see `is_mosaic`; photographs have 0.5 to 0.8, white noise 1, mosaics 1.35 to 18
    mosaic_ratio: float = 1.2


_LEVELS = _LevelRules()
# of a camera that determine black and white, spread over the recording: the first may be dark
LEVEL_IMAGES = 8


@dataclass(frozen=True, slots=True)
class Levels:
    """The levels of 16-bit pixels that become 0 and 255."""

    black: int = 0
    white: int = _FULL

    @property
    def note(self) -> tuple[str, ...]:
        """A note where they are not those of all 16 bits."""
        if self.black:
            return (
                f"the images have 16 bits and little contrast about a high level, as of a thermal "
                f"camera: the levels {self.black} to {self.white} are scaled to 8 bits",
            )
        if self.white == _FULL:
            return ()
        return (
            f"the images have 16 bits but use {self.white.bit_length()}: the levels 0 to "
            f"{self.white} are scaled to 8 bits",
        )


FULL_SCALE = Levels()
Band = tuple[float, float]  # the levels that hardly any pixel of an image is below and above


def band_of(pixels: npt.NDArray[Any]) -> Band:
    """Return the levels that hardly any pixel is below and above; pixels of 0, as of borders and
    dead ones, do not count below.
    """
    seen = pixels[pixels > 0]
    low = 0.0
    if seen.size:
        low = float(np.quantile(seen, 1 - _LEVELS.bright_share))
    return low, float(np.quantile(pixels, _LEVELS.bright_share))


def levels_of(bands: Iterable[Band]) -> Levels:
    """Return the levels of black and white of a recording, by some of its images.

    White is that of 10, 12, 14 or 16 bits, the fewest that hold the images: cameras of 12 bits
    store 0 to 4095 in 16 bits, which full scale would make almost black. Where the lowest level is
    further from zero than from the highest, as a thermal camera's 29400 to 30675, the band is
    scaled, with half of its width beside it on both sides for images that were not looked at.
    """
    found = list(bands)
    high = max((band[1] for band in found), default=0.0)
    low = min((band[0] for band in found), default=0.0)
    if high <= 0:
        return FULL_SCALE
    width = high - low
    if 0 < width <= low:
        black = max(0, math.floor(low - width / 2))
        return Levels(black, min(_FULL, math.ceil(high + width / 2)))
    fitting = (2**bits - 1 for bits in _SENSOR_BITS if high <= 2**bits - 1)
    return Levels(0, next(fitting, _FULL))


def to_8_bits(pixels: npt.NDArray[Any], levels: Levels) -> Image:
    """Return pixels of 8 or 16 bits as uint8; of 16 bits, the levels become 0 and 255."""
    if pixels.dtype.itemsize == 2:
        if levels.black == 0:
            above = pixels
        else:
            above = pixels.astype(np.float64) - levels.black
        scaled = np.rint(above / ((levels.white - levels.black) / 255))
        if levels.black == 0:
            pixels = np.minimum(scaled, 255)
        else:
            pixels = np.clip(scaled, 0, 255)
    return np.ascontiguousarray(pixels, dtype=np.uint8)


def is_mosaic(pixels: npt.NDArray[Any]) -> bool:
    """Return whether gray pixels (H, W) are those of a raw Bayer mosaic.

    In a photograph, neighbours differ less than pixels two apart. In a mosaic, pixels two apart
    have one colour, and neighbours another, along both axes.
    """
    if pixels.ndim != 2 or min(pixels.shape) < 8:
        return False
    values = pixels.astype(np.float32)
    return all(_roughness(v) > _LEVELS.mosaic_ratio for v in (values, values.T))


def _roughness(values: npt.NDArray[np.float32]) -> float:
    near = float(np.abs(np.diff(values, axis=0)).mean())
    far = float(np.abs(values[2:] - values[:-2]).mean())
    return near / far if far > 0 else 0.0


def mosaic_note(where: str) -> str:
    """Return the doubt about images that look like a mosaic."""
    return (
        f"{where}: doubtful: read as gray, but pixels two apart are more alike than neighbours, as "
        "in raw images of a colour camera (Bayer); if they are, convert them to gray before (such "
        "as OpenCV's COLOR_BayerRG2GRAY), or record them with their encoding (bayer_rggb8)"
    )
