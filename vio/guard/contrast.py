"""Images without contrast: black, saturated or covered for a moment."""

from __future__ import annotations

from typing import NamedTuple

from vio.frontend.patches import mean_and_contrast
from vio.guard.image_check import FrameImages, ImageCheck
from vio.numerics.kinds import Capacity


class _ContrastRules(NamedTuple):
    """When an image has lost its contrast."""

    # in a row that are left out; then the front end sees them, and drops its tracks
    max_frames: int = 5
    stride_px: Capacity[int] = 4  # every fourth pixel of the half image is used
    # share of the last image's contrast below which the contrast counts as lost
    lost_share: float = 0.1


_CONTRAST = _ContrastRules()


class LostContrast(ImageCheck):
    """Leaves frames out whose left image lost its contrast; tracking continues from the frame
    before.
    """

    def __init__(self) -> None:
        super().__init__()
        self._contrast: float | None = None  # of the last frame that was not left out
        self._skipped = 0  # frames in a row

    def inspect(self, images: FrameImages) -> FrameImages:
        """Leave out a frame without contrast where the previous one had some."""
        contrast = mean_and_contrast(images.halves[0], _CONTRAST.stride_px)[1]
        lost = self._contrast is not None and contrast < _CONTRAST.lost_share * self._contrast
        if lost and self._skipped < _CONTRAST.max_frames:
            self._skipped += 1
            return images.marked(skipped=True)
        self._skipped = 0
        self._contrast = contrast
        return images
