"""Recordings with swapped left and right images."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

from vio.errors import DataError
from vio.guard.image_check import FrameImages, ImageCheck
from vio.guard.probe import RowProbe


class _SwapRules(NamedTuple):
    """When images are exchanged."""

    frames: int = 3  # consecutive suspicious frames before an error is raised
    min_points: int = 20  # with fewer corners the check is skipped
    # share of corners with a match below which the mirrored images are checked
    few_share: float = 0.3
    many_share: float = 0.4  # share of corners matched in the mirrored images that indicates a swap


_SWAP = _SwapRules()


class SwapDetector(ImageCheck):
    """Detects a recording with swapped left and right images: few matches, but many in the mirrored
    images.

    Several frames must show it; all after them are refused until one is in order. Once a few frames
    were in order, so is the recording: `ExchangeDetector` judges later ones.
    """

    def __init__(self, probe: RowProbe) -> None:
        super().__init__()
        self._probe = probe
        self._suspicious = 0  # frames in a row
        self._in_order = 0  # frames

    @property
    def decided(self) -> bool:
        """Whether the recording is known to be in order."""
        return self._in_order >= _SWAP.frames

    def inspect(self, images: FrameImages) -> FrameImages:
        """Compare the images of the first frames.

        Raises:
            DataError: left and right look swapped.
        """
        if self.decided or not images.right_usable:
            return images
        left, right = images.halves
        points = self._probe.corners(left)
        matched = 0
        if len(points) >= _SWAP.min_points:
            matched = self._probe.positive(left, right, points)
        self.check(
            images.index,
            len(points),
            matched,
            lambda: self._probe.negative(left, right, points),
        )
        return images

    def check(
        self, index: int, corners: int, matched: int, count_mirrored: Callable[[], int]
    ) -> None:
        """Check the number of matched corners of a frame; `count_mirrored` counts the matches in
        the mirrored images.

        Raises:
            DataError: left and right look swapped.
        """
        if corners < _SWAP.min_points:
            return
        if matched >= _SWAP.few_share * corners:
            self._suspicious = 0
            self._in_order += 1
            return
        mirrored = count_mirrored()
        if mirrored >= max(_SWAP.many_share * corners, 2 * matched):
            self._suspicious += 1
        elif self._suspicious < _SWAP.frames:
            self._suspicious = 0
        if self._suspicious >= _SWAP.frames:
            raise DataError(
                f"frame {index}: left and right images look swapped ({mirrored} of "
                f"{corners} features match with a negative disparity, {matched} with a positive "
                f"one, in {_SWAP.frames} frames); exchange the image folders or the cameras' "
                f"calibration{self._other_cause()}"
            )

    def _other_cause(self) -> str:
        """Return what else such matches may be, where rows are off as well: disparities of raw
        images are off by as much.
        """
        rows_px = self._probe.rows_px
        return (
            f"; or, as rows differ by {abs(rows_px)} px, these are raw images and the calibration is "
            "that of rectified ones: give the one that belongs to them"
            if rows_px
            else ""
        )
