"""Parts shared by all image-based front ends: validation of frames and priors, a stopwatch, the
output.
"""

from __future__ import annotations

import time
from dataclasses import field
from typing import Protocol

import numpy as np

from vio.dataclass import dataclass
from vio.errors import DataError
from vio.findings import Finding
from vio.geometry.lie import FloatArray
from vio.geometry.stereo import StereoCamera
from vio.numerics.arrays import distinct_rows
from vio.records import (
    BoolArray,
    FrontendOutput,
    Image,
    IntArray,
    Observations,
    SigmaArray,
    StereoFrame,
    TrackPrior,
)

_I3 = np.eye(3)
_ROTATION_SLACK = 1e-3  # largest deviation of R R' of a predicted rotation from the identity


@dataclass(slots=True)
class Stopwatch:
    """Wall time per stage in milliseconds."""

    stages_ms: dict[str, float] = field(default_factory=dict)
    _last: float = field(default_factory=time.perf_counter)

    def lap(self, stage: str) -> None:
        """Add the time since the last lap to a stage."""
        now = time.perf_counter()
        if stage not in self.stages_ms:
            self.stages_ms[stage] = 0.0
        self.stages_ms[stage] += 1e3 * (now - self._last)
        self._last = now


@dataclass(slots=True)
class FrameValidator:
    """Checks that frames fit the calibration, have one image size, and are in order of time."""

    camera: StereoCamera
    name: str  # of the front end, for messages
    _index: int = -1
    _time_ns: int | None = None
    _shape: tuple[int, ...] | None = None

    def validate(self, frame: StereoFrame) -> tuple[Image, Image]:
        """Check a frame and return both of its images, (H, W) uint8.

        Raises:
            DataError: no images, images of a wrong size or type, or a time not after the previous
                frame's.
        """
        if not isinstance(frame, StereoFrame):
            raise DataError(
                f"the {self.name} front end takes a StereoFrame, got {type(frame).__name__}"
            )
        if frame.left is None or frame.right is None:
            raise DataError(
                f"frame {frame.index} has no images, but the {self.name} front end needs them; "
                "use the precomputed front end, or a recording with images"
            )
        self._check(frame, {"left": frame.left, "right": frame.right})
        return frame.left, frame.right

    def validate_one(self, frame: StereoFrame) -> tuple[Image]:
        """Check a frame of one camera, with its depths where it has such, and return its image, (H,
        W) uint8.

        Raises:
            DataError: as `validate`; or depths that are missing, or of another size or type.
        """
        if not isinstance(frame, StereoFrame):
            raise DataError(
                f"the {self.name} front end takes a StereoFrame, got {type(frame).__name__}"
            )
        if frame.left is None:
            raise DataError(
                f"frame {frame.index} has no image, but the {self.name} front end needs one"
            )
        self._check(frame, {"left": frame.left})
        if self.camera.kind == "rgbd" and (
            frame.depth is None or frame.depth.shape != frame.left.shape
        ):
            found = (
                "no depths"
                if frame.depth is None
                else f"depths of {frame.depth.shape[1]}x{frame.depth.shape[0]}"
            )
            raise DataError(
                f"frame {frame.index} has {found}; a camera with depth images needs metres for "
                "each pixel of the "
                f"image, {frame.left.shape[1]}x{frame.left.shape[0]}, 0 where there is none"
            )
        return (frame.left,)

    def _check(self, frame: StereoFrame, images: dict[str, Image]) -> None:
        """Check time and images of a frame, the left one first, and note them."""
        if self._time_ns is not None and frame.time_ns <= self._time_ns:
            raise DataError(
                f"frame {frame.index} is not later than frame {self._index} ({frame.time_ns} ns "
                "after "
                f"{self._time_ns} ns); sort the frames by time"
            )
        for name, image in images.items():
            if (
                not isinstance(image, np.ndarray)
                or image.ndim != 2
                or image.dtype != np.uint8
                or not image.size
            ):
                raise DataError(
                    f"frame {frame.index}: the {name} image {_described(image)}; "
                    f"the {self.name} front end needs 8-bit gray images: read them with "
                    "vio.datasets.images.load_gray"
                )
            self._check_size(frame.index, name, image.shape, images["left"].shape)
        self._index = frame.index
        self._time_ns = frame.time_ns
        self._shape = images["left"].shape

    def _check_size(
        self, index: int, name: str, size: tuple[int, ...], left: tuple[int, ...]
    ) -> None:
        """Check an image's size (height, width) by the calibration, the left and the last image."""
        expected = (self.camera.height, self.camera.width)
        if None not in expected and size != expected:
            raise DataError(
                f"frame {index}: the {name} image is {size[1]}x{size[0]}, but the "
                f"calibration is for {self.camera.width}x{self.camera.height}; check that "
                "calibration and images belong together"
            )
        if size != left or (self._shape is not None and size != self._shape):
            raise DataError(
                f"frame {index}: the {name} image is {size[1]}x{size[0]}, unlike the "
                "previous images; all images of a recording must have one size"
            )


def _is_rotation(R: FloatArray) -> bool:
    if not np.isfinite(R).all():
        return False
    return bool(np.abs(R @ R.T - _I3).max() < _ROTATION_SLACK)


def usable_prior(prior: TrackPrior | None) -> TrackPrior | None:
    """Return the valid part of a prior: finite left pixels, one row per id, and the rotation if
    it is orthonormal.
    """
    if prior is None:
        return None
    ids = prior.ids
    z = prior.z
    if (ids[1:] <= ids[:-1]).any():
        first = distinct_rows(ids)
        ids = ids[first]
        z = z[first]
    finite = np.isfinite(z[:, :2]).all(axis=1)
    R = prior.R_cam_prev
    if R is not None and not _is_rotation(R):
        R = None
    if R is None and not finite.any():
        return None
    motion = prior.motion
    if motion is not None and not (
        np.isfinite(motion.T_curr_prev).all() and np.isfinite(motion.covariance).all()
    ):
        motion = None
    return TrackPrior(ids[finite], z[finite], R, motion)


class Features(Protocol):
    """Tracked features of any front end."""

    @property
    def ids(self) -> IntArray:
        """Ids (N,)."""

    @property
    def left(self) -> FloatArray:
        """Pixels (N, 2)."""

    @property
    def right(self) -> FloatArray:
        """Pixels (N, 2), arbitrary where `has_right` is False."""

    @property
    def has_right(self) -> BoolArray:
        """Mask (N,)."""


def make_output(
    frame: StereoFrame,
    features: Features,
    tracked: int,
    watch: Stopwatch,
    findings: tuple[Finding, ...] = (),
    *,
    shown: BoolArray | None = None,
    sigma: SigmaArray | None = None,
) -> FrontendOutput:
    """Return the output of a front end for a frame.

    Args:
        frame: the frame.
        features: those tracked.
        tracked: how many of those output were in the previous output, too.
        watch: the times of the stages.
        findings: what is wrong with the images.
        shown: mask (N,) of the features to output; None: all.
        sigma: (N, 3) as in `Observations`.
    """
    if shown is None:
        rows = np.arange(len(features.ids))
    else:
        rows = shown.nonzero()[0]
    z = np.empty((len(rows), 4))
    z[:, :2] = features.left[rows]
    z[:, 2:] = features.right[rows]
    has_right = features.has_right[rows]
    stale = np.zeros(len(rows), dtype=np.bool_)
    of_rows = None if sigma is None else sigma[rows]
    return FrontendOutput(
        Observations(frame.index, frame.time_ns, features.ids[rows], z, has_right, stale, of_rows),
        tracked=tracked,
        matched=int(has_right.sum()),
        detected=len(rows) - tracked,
        stages_ms=watch.stages_ms,
        findings=findings,
    )


def _described(image: object) -> str:
    if not isinstance(image, np.ndarray):
        return "is none"
    return f"has shape {image.shape} and type {image.dtype}"
