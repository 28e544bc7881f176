"""Recordings of real, unrectified cameras: frames are rectified as they are read."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from vio.cameras.rig import Rectifier
from vio.datasets.image_pairs import ImageDataset
from vio.datasets.images import UnreadableImageError, load_depth
from vio.errors import DataError
from vio.geometry.lie import FloatArray
from vio.records import Image, ImuDensities, StereoFrame


@dataclass(frozen=True, slots=True)
class RectifiedDataset(ImageDataset):
    """Implements `vio.protocols.Dataset` over image files of one or two real cameras, rectified as they are read."""

    rectifier: Rectifier
    imu_noise: ImuDensities | None = None
    depths: Sequence[Path] | None = None  # depth image of each frame; None: there are none
    depth_factor: float = 1.0  # levels of a depth image per metre

    def frame(self, index: int, left: Image, right: Image | None = None) -> StereoFrame:
        """Return the rectified frame of raw images (H, W each), with its depths.

        Raises:
            UnreadableImageError: the depth image cannot be read, or is of another size.
        """
        depth_m = None if self.depths is None else _depth_m(self.depths[index], left, self.depth_factor)
        return self.rectifier.frame(index, int(self.recording.frame_times_ns[index]), left, right, depth_m=depth_m)


def _depth_m(file: Path, image: Image, factor: float) -> FloatArray:
    """Read the depths (H, W) of an image (H, W), metres."""
    levels = load_depth(file)
    if levels.shape != image.shape[:2]:
        raise UnreadableImageError(
            f"{file} is {levels.shape[1]} x {levels.shape[0]} pixels, but its image is {image.shape[1]} x "
            f"{image.shape[0]}; depth images must be registered to the images"
        )
    return levels / factor


def check_not_rectified(dataset: RectifiedDataset) -> None:
    """Raise DataError if a recording is rectified already, as rectifying would only copy it."""
    if dataset.rectifier.maps is None:
        raise DataError(
            f"{dataset.recording.path} is rectified already (equal pinhole cameras, rows aligned): there is nothing to "
            "do; use it as it is"
        )
