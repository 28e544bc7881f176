"""Images without contrast: black, saturated or covered for a moment."""

from __future__ import annotations

from vio.frontend.image_check import FrameImages, ImageCheck
from vio.frontend.patches import mean_and_contrast

_MAX_FRAMES = 5  # in a row that are skipped; then all tracks are dropped
_STRIDE = 4  # every fourth pixel of the half image is used
_LOST_SHARE = 0.1  # share of the last image's contrast below which the contrast counts as lost


class LostContrast(ImageCheck):
    """Skips frames whose left image lost its contrast; tracking continues from the frame before."""

    def __init__(self) -> None:
        super().__init__()
        self._skipped = 0  # frames in a row

    def inspect(self, images: FrameImages) -> FrameImages | None:
        """Skip a frame without contrast where the previous one had some."""
        previous = images.previous
        before = self._skipped
        self._skipped = 0
        if previous is None or len(previous.tracks) == 0 or before >= _MAX_FRAMES:
            return images
        now, last = (
            mean_and_contrast(view.half, _STRIDE)[1] for view in (images.left, previous.left)
        )
        if now >= _LOST_SHARE * last:
            return images
        self._skipped = before + 1
        return None
