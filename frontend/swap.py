"""Recordings with swapped left and right images."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

from vio.errors import DataError
from vio.frontend.image_check import FrameImages, ImageCheck
from vio.frontend.tracks import Tracks
from vio.records import StereoFrame

_FRAMES = 3  # consecutive suspicious frames before an error is raised
_LEAST_POINTS = 20  # with fewer features the check is skipped
_MANY = 0.4  # share of features matched in the mirrored images that indicates a swap


class SwapDetector(ImageCheck):
    """Detects a recording with swapped left and right images: few matches, but many in the mirrored
    images.

    Several frames must show it; all after them are refused until one is in order. Once a few frames
    were in order, so is the recording: `ExchangeDetector` judges later ones.
    """

    def __init__(self, few: float) -> None:
        """Begin; `few` is the share of features with a match below which the mirrored images are
        checked.
        """
        super().__init__()
        self._few = few
        self._suspicious = self._in_order = 0  # frames

    @property
    def _certain(self) -> bool:
        return self._suspicious >= _FRAMES

    def inspect(self, images: FrameImages) -> FrameImages:
        """Return the images as given, marked where the recording was found to be swapped."""
        return replace(images, swapped=True) if self._certain else images

    def conclude(self, images: FrameImages, tracks: Tracks) -> None:
        """Check the features of a frame.

        Raises:
            DataError: left and right look swapped.
        """
        left, right = images.views
        matched = int(tracks.has_right.sum())
        if matched < self._few * len(tracks) and self._in_order < _FRAMES:
            matched += images.stereo.count_beyond(left, right, tracks.left[~tracks.has_right])
        self.check(
            images.frame,
            len(tracks),
            matched,
            lambda: images.stereo.count_mirrored(left, right, tracks.left),
        )

    def check(
        self, frame: StereoFrame, features: int, matched: int, count_mirrored: Callable[[], int]
    ) -> None:
        """Check the number of matched features; `count_mirrored` counts the matches in the mirrored
        images.

        Raises:
            DataError: left and right look swapped.
        """
        if features < _LEAST_POINTS or matched >= self._few * features:
            self._suspicious = 0
            self._in_order += features >= _LEAST_POINTS
            return
        if self._in_order >= _FRAMES:
            return
        mirrored = count_mirrored()
        if mirrored >= max(_MANY * features, 2 * matched):
            self._suspicious += 1
        elif not self._certain:
            self._suspicious = 0
        if self._certain:
            raise DataError(
                f"frame {frame.index}: left and right images look swapped ({mirrored} of "
                f"{features} features match "
                f"with a negative disparity, {matched} with a positive one, in {_FRAMES} frames); "
                "exchange the "
                "image folders or the cameras' calibration"
            )
