"""Recordings of real, unrectified cameras: frames are rectified as they are read."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from vio.datasets.common import naming
from vio.datasets.image_pairs import ImageDataset, ImageSize
from vio.datasets.images import write_png
from vio.datasets.settings import Interpolation
from vio.errors import DataError
from vio.geometry.distortion import StereoRig, rectified_pair
from vio.geometry.lie import FloatArray, se3_inverse
from vio.geometry.rectify import MapArray, rectify
from vio.geometry.stereo import StereoCamera
from vio.protocols import Progress
from vio.records import Image, ImuDensities, IntArray, StereoFrame


@dataclass(frozen=True, slots=True)
class Rectifier:
    """The rectification of a rig's raw images."""

    rig: StereoRig
    camera: StereoCamera  # rectified
    T_rect0_imu: FloatArray  # (4, 4)
    maps: tuple[tuple[MapArray, MapArray], tuple[MapArray, MapArray]] | None  # left, right; None: nothing to do
    interpolation: Interpolation

    def __call__(self, left: Image, right: Image) -> tuple[Image, Image]:
        """Rectify one raw pair, each image (H, W) of its camera's size."""
        if self.maps is None:
            return left, right
        return _remap(left, self.maps[0], self.interpolation), _remap(right, self.maps[1], self.interpolation)


def make_rectifier(rig: StereoRig, interpolation: Interpolation, where: Path) -> Rectifier:
    """Prepare the rectification of a rig; a rig that is rectified already passes images through unchanged.

    Args:
        rig: both cameras as calibrated.
        interpolation: how gray values between pixels are found.
        where: the calibration file, for messages.

    Raises:
        CalibrationError: the cameras coincide, diverge, are swapped, or share no field of view.
    """
    if (pair := rectified_pair(rig)) is not None:
        return Rectifier(rig, pair, se3_inverse(rig.T_imu_cam0), None, interpolation)
    with naming(where):
        done = rectify(rig)
    return Rectifier(rig, done.camera, done.T_rect0_imu, (done.map0, done.map1), interpolation)


def rig_sizes(rig: StereoRig, calibrated_in: tuple[Path, Path]) -> tuple[ImageSize, ImageSize]:
    """Return the calibrated sizes of left and right images, and the files that specify them."""
    left, right = calibrated_in
    return ImageSize(rig.cam0.width, rig.cam0.height, left), ImageSize(rig.cam1.width, rig.cam1.height, right)


def _remap(image: Image, maps: tuple[MapArray, MapArray], interpolation: Interpolation) -> Image:
    import cv2

    codes = {"linear": cv2.INTER_LINEAR, "cubic": cv2.INTER_CUBIC, "lanczos4": cv2.INTER_LANCZOS4}
    # The maps stay inside the image, so only the outermost taps of the interpolation reach the border.
    out = cv2.remap(image, maps[0], maps[1], codes[interpolation], borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(out, dtype=np.uint8)


@dataclass(frozen=True, slots=True)
class RectifiedDataset(ImageDataset):
    """Implements `vio.protocols.Dataset` over image files of real cameras, rectified as they are read."""

    rectifier: Rectifier
    imu_noise: ImuDensities | None = None

    def prepared(self, left: Image, right: Image) -> tuple[Image, Image]:
        """Rectify one raw pair, each image (H, W) of its camera's size."""
        return self.rectifier(left, right)


def check_not_rectified(dataset: RectifiedDataset) -> None:
    """Raise DataError if a recording is rectified already, as rectifying would only copy it."""
    if dataset.rectifier.maps is None:
        raise DataError(
            f"{dataset.recording.path} is rectified already (equal pinhole cameras, rows aligned): there is nothing to "
            "do; use it as it is"
        )


def write_frames(
    dataset: RectifiedDataset, name: Callable[[StereoFrame, int], tuple[Path, Path]], progress: Progress
) -> IntArray:
    """Write every readable frame as two PNG files; return the times (N,) of those written.

    Args:
        dataset: the recording to rectify.
        name: the two files of a frame, given the frame and how many were written before it; folders must exist.
        progress: called after each frame.

    Raises:
        DataError: too many images are unreadable, or one has the wrong size.
    """
    times: list[int] = []
    for frame in (event for event in dataset.events() if isinstance(event, StereoFrame)):
        assert frame.left is not None
        assert frame.right is not None
        for path, image in zip(name(frame, len(times)), (frame.left, frame.right), strict=True):
            write_png(path, image)
        times.append(frame.time_ns)
        progress(len(times), len(dataset.recording.frame_times_ns))
    if not times:
        raise DataError(f"{dataset.recording.path}: no frame could be read; see the warnings above")
    return np.array(times, dtype=np.int64)
