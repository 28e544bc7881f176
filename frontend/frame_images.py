"""The images of a frame as front ends use them that follow features: checked, equalised, paired by
time, at two resolutions.
"""

from __future__ import annotations

from typing import Literal

import cv2
import numpy as np

from vio.dataclass import dataclass
from vio.frontend.detect import half_mask, load_mask
from vio.frontend.frames import FrameValidator
from vio.frontend.patches import ImageLevels, half_image
from vio.frontend.right_images import RightImages
from vio.frontend.settings import FrontendSettings
from vio.frontend.stereo_fit import StereoFit
from vio.frontend.tracks import AnchorBank
from vio.geometry.stereo import StereoCamera
from vio.records import BoolArray, CheckedFrame, Image, StereoFrame


@dataclass(frozen=True, slots=True)
class FrameImages:
    """The images of a frame in the forms that tracking needs."""

    frame: StereoFrame
    left: ImageLevels
    right: ImageLevels | None  # None: one camera
    stereo: StereoFit
    allowed: BoolArray | None = None  # (H/2, W/2) where corners may be; None: everywhere


class ImagePreparation:
    """Brings the images of frames into the forms that tracking needs."""

    def __init__(
        self,
        camera: StereoCamera,
        settings: FrontendSettings,
        bank: AnchorBank,
        right: RightImages,
        name: str,
    ) -> None:
        """Prepare for the front end of that name; which right image is a frame's is for `right` to
        say.
        """
        self._camera = camera
        self._disparity = settings.disparity
        self._bank = bank
        self._right = right
        is_equalised = settings.klt.equalise == "clahe"
        self._clahe = cv2.createCLAHE(2.0, (8, 8)) if is_equalised else None
        if settings.klt.mask is None:
            self._mask = None
        else:
            self._mask = load_mask(settings.klt.mask)
        self._validator = FrameValidator(camera, name)
        # made with the image size of the first frame
        self._setup: tuple[StereoFit, BoolArray | None] | None = None

    def __call__(self, frame: StereoFrame) -> FrameImages | None:
        """Return the images of a frame; None: the right image of its time was not kept.

        Raises:
            DataError: the images do not fit the calibration or each other.
            ConfigError: the mask is not of the images' size.
        """
        if self._camera.kind != "stereo":
            (left,) = self._validator.validate_one(frame)
            return self._with(frame, left, None)
        left, right = self._validator.validate(frame)
        stereo, _ = self._set_up(left.shape)
        paired = self._right.of_frame(frame, right)
        if isinstance(frame, CheckedFrame) and frame.begin_again:
            stereo.restart_rows()
        if paired is None:
            return None
        half = _half(frame, "right") if paired is right else None
        return self._with(frame, left, self._levels(paired, half))

    def _with(self, frame: StereoFrame, left: Image, right: ImageLevels | None) -> FrameImages:
        stereo, allowed = self._set_up(left.shape)
        levels = self._levels(left, _half(frame, "left"))
        return FrameImages(frame, levels, right, stereo, allowed)

    def _levels(self, image: Image, half: Image | None) -> ImageLevels:
        """Equalise and convert an image; the result may share memory with it.

        `half` is the image as given at half resolution, where that is known.
        """
        if self._clahe is not None:
            image = np.asarray(self._clahe.apply(image), dtype=np.uint8)
            half = None
        return ImageLevels(image, half_image(image) if half is None else half)

    def _set_up(self, shape: tuple[int, ...]) -> tuple[StereoFit, BoolArray | None]:
        """Return the stereo matcher and the mask (H/2, W/2) of allowed corners, set up with the
        first frame's shape.
        """
        if self._setup is None:
            height, width = shape
            if self._mask is None:
                allowed = None
            else:
                allowed = half_mask(self._mask, shape)
            stereo = StereoFit(self._camera, self._disparity, self._bank, (width, height))
            self._setup = stereo, allowed
        return self._setup


def _half(frame: StereoFrame, camera: Literal["left", "right"]) -> Image | None:
    """The image (H/2, W/2) of a camera at half resolution, where the guards have made it."""
    if not isinstance(frame, CheckedFrame):
        return None
    return frame.left_half if camera == "left" else frame.right_half
