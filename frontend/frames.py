"""What every front end that looks at images needs: checks of a frame, a stopwatch, an alarm for swaps, the output."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np

from vio.errors import DataError
from vio.geometry.lie import FloatArray
from vio.geometry.stereo import StereoCamera
from vio.records import BoolArray, FrontendOutput, Image, IntArray, StereoFrame, observations

_SWAP_FRAMES = 3  # frames without matches before the mirrored search is believed
_SWAP_MIN_POINTS = 20  # with fewer features nothing is suspicious
_SWAP_MANY = 0.4  # share of matches in the mirrored images that proves the swap


@dataclass(slots=True)
class Stopwatch:
    """Wall time per stage in milliseconds."""

    stages_ms: dict[str, float] = field(default_factory=dict)
    _last: float = field(default_factory=time.perf_counter)

    def lap(self, stage: str) -> None:
        """Add the time since the last lap to a stage."""
        now = time.perf_counter()
        self.stages_ms[stage] = self.stages_ms.get(stage, 0.0) + 1e3 * (now - self._last)
        self._last = now


@dataclass(slots=True)
class FrameGate:
    """Lets frames through that fit the calibration, each other, and the order of time."""

    camera: StereoCamera
    name: str  # of the front end, for messages
    _index: int = -1
    _time_ns: int | None = None
    _shape: tuple[int, ...] | None = None

    def admit(self, frame: StereoFrame) -> tuple[Image, Image]:
        """Return both images of a frame, (H, W) uint8.

        Raises:
            DataError: no images, images of a wrong size or type, or a time not after the last one's.
        """
        if frame.left is None or frame.right is None:
            raise DataError(
                f"frame {frame.index} has no images, but the {self.name} front end needs them; "
                "use the precomputed front end, or a recording with images"
            )
        if self._time_ns is not None and frame.time_ns <= self._time_ns:
            raise DataError(
                f"frame {frame.index} is not later than frame {self._index} ({frame.time_ns} ns after "
                f"{self._time_ns} ns); sort the frames by time"
            )
        known = (self.camera.height, self.camera.width)
        for name, image in (("left", frame.left), ("right", frame.right)):
            if image.ndim != 2 or image.dtype != np.uint8:
                raise DataError(
                    f"frame {frame.index}: the {name} image has shape {image.shape} and type {image.dtype}; "
                    f"the {self.name} front end needs 8-bit gray images: read them with vio.datasets.images.load_gray"
                )
            size = image.shape
            if None not in known and size != known:
                raise DataError(
                    f"frame {frame.index}: the {name} image is {size[1]}x{size[0]}, but the calibration is for "
                    f"{self.camera.width}x{self.camera.height}; check that calibration and images belong together"
                )
            if size != frame.left.shape or (self._shape is not None and size != self._shape):
                raise DataError(
                    f"frame {frame.index}: the {name} image is {size[1]}x{size[0]}, unlike the images before; "
                    "all images of a recording must have one size"
                )
        self._index, self._time_ns, self._shape = frame.index, frame.time_ns, frame.left.shape
        return frame.left, frame.right


@dataclass(slots=True)
class SwapAlarm:
    """Raises when left and right are exchanged: few matches, many in the mirrored images, repeatedly."""

    few: float  # share of features with a match, below which the mirrored images are looked at
    _suspicious: int = 0

    def check(self, frame: StereoFrame, features: int, matched: int, count_mirrored: Callable[[], int]) -> None:
        """Take in how many features of a frame matched; `count_mirrored` tells how many do in the mirrored images.

        Raises:
            DataError: left and right look swapped.
        """
        if features < _SWAP_MIN_POINTS or matched >= self.few * features:
            self._suspicious = 0
            return
        mirrored = count_mirrored()
        self._suspicious = self._suspicious + 1 if mirrored >= max(_SWAP_MANY * features, 2 * matched) else 0
        if self._suspicious >= _SWAP_FRAMES:
            raise DataError(
                f"frame {frame.index}: left and right images look swapped ({mirrored} of {features} features match "
                f"with a negative disparity, {matched} with a positive one, in {_SWAP_FRAMES} frames); exchange the "
                "image folders or the cameras' calibration"
            )


class Seen(Protocol):
    """Features as any front end keeps them."""

    @property
    def ids(self) -> IntArray:
        """Names (N,)."""

    @property
    def left(self) -> FloatArray:
        """Pixels (N, 2)."""

    @property
    def right(self) -> FloatArray:
        """Pixels (N, 2), arbitrary where `has_right` is False."""

    @property
    def has_right(self) -> BoolArray:
        """Mask (N,)."""


def handed_out(frame: StereoFrame, seen: Seen, carried: int, watch: Stopwatch) -> FrontendOutput:
    """What a front end says of a frame: features, of which `carried` were handed out with the frame before."""
    z = np.concatenate([seen.left, seen.right], axis=1)
    return FrontendOutput(
        observations(frame.index, frame.time_ns, seen.ids, z, seen.has_right),
        tracked=carried,
        matched=int(seen.has_right.sum()),
        detected=len(seen.ids) - carried,
        stages_ms=watch.stages_ms,
    )
