"""What every front end that looks at images needs: checks of a frame, a stopwatch, an alarm for swapped cameras."""

from __future__ import annotations

import time
from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np

from vio.errors import ConfigError, DataError
from vio.geometry.stereo import StereoCamera
from vio.records import BoolArray, Image, StereoFrame, TrackPrior

_SWAP_FRAMES = 3  # frames without matches before the mirrored search is believed
_ROTATION_SLACK = 1e-3  # how far a predicted rotation may be from one
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


def usable_prior(prior: TrackPrior | None) -> TrackPrior | None:
    """The part of a prior that says something: rows of finite left pixels, one an id, and a rotation that is one."""
    if prior is None:
        return None
    ids, first = np.unique(prior.ids, return_index=True)
    finite = np.isfinite(prior.z[first, :2]).all(axis=1)
    R = prior.R_cam_prev
    if R is not None and not (np.isfinite(R).all() and np.abs(R @ R.T - np.eye(3)).max() < _ROTATION_SLACK):
        R = None
    if R is None and not finite.any():
        return None
    return TrackPrior(ids[finite], prior.z[first[finite]], R)


@dataclass(slots=True)
class SwapAlarm:
    """Raises when left and right are exchanged: few matches, many in the mirrored images, repeatedly."""

    _suspicious: int = 0

    def clear(self) -> None:
        """Forget what was suspicious: a frame matched well."""
        self._suspicious = 0

    def check(self, frame: StereoFrame, features: int, matched: int, mirrored: int) -> None:
        """Take in the matches of one suspicious frame, as it is and mirrored.

        Raises:
            DataError: left and right look swapped.
        """
        self._suspicious = self._suspicious + 1 if mirrored >= max(_SWAP_MANY * features, 2 * matched) else 0
        if self._suspicious >= _SWAP_FRAMES:
            raise DataError(
                f"frame {frame.index}: left and right images look swapped ({mirrored} of {features} features match "
                f"with a negative disparity, {matched} with a positive one, in {_SWAP_FRAMES} frames); exchange the "
                "image folders or the cameras' calibration"
            )


def load_mask(path: Path) -> Image:
    """Read the image (H, W) whose black pixels must not hold corners.

    Raises:
        ConfigError: the file does not decode.
    """
    mask = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE) if path.is_file() else None
    if mask is None:
        raise ConfigError(f"frontend.klt.mask: {path} cannot be read as an image; give a PNG of the recording's size")
    return np.asarray(mask, dtype=np.uint8)


def half_mask(mask: Image, shape: tuple[int, ...], half_shape: tuple[int, ...]) -> BoolArray:
    """The mask (H, W) at half resolution: True where all pixels around are allowed.

    Raises:
        ConfigError: the mask is not of the images' shape.
    """
    if mask.shape != shape:
        raise ConfigError(
            f"frontend.klt.mask is {mask.shape[1]}x{mask.shape[0]}, but the images are {shape[1]}x{shape[0]}; "
            "give a mask of the recording's size"
        )
    solid = np.asarray(cv2.erode(mask, np.ones((3, 3), np.uint8)))
    return np.asarray(solid[::2, ::2][: half_shape[0], : half_shape[1]] > 0)
