"""What checks of the images have in common."""

from __future__ import annotations

from dataclasses import replace
from functools import cached_property
from typing import Any

import numpy as np

from vio.dataclass import dataclass
from vio.findings import Finder
from vio.frontend.patches import half_image
from vio.records import CheckedFrame, Image, StereoFrame


@dataclass(frozen=True)
class FrameImages:
    """The images of a frame, as one check hands them to the next."""

    frame: StereoFrame
    raw: tuple[Image, ...]  # (H, W) left and right, or that of one camera
    skipped: bool = False  # the frame is left out
    left_usable: bool = True  # False: it is known to be frozen
    right_usable: bool = True  # False: it is known to be frozen, dark or covered
    right_delay: int = 0  # frames by which the right image is known to be late
    begin_again: bool = False  # the pairs so far were wrong

    @cached_property
    def halves(self) -> tuple[Image, ...]:
        """The images (H/2, W/2) at half resolution."""
        return tuple(half_image(image) for image in self.raw)

    @property
    def index(self) -> int:
        """Frame number."""
        return self.frame.index

    def with_raw(self, raw: tuple[Image, ...]) -> FrameImages:
        """Return the frame with other images (H, W); itself where they are the same."""
        same = all(a is b for a, b in zip(raw, self.raw, strict=True))
        return self if same else replace(self, raw=raw)

    def marked(self, **changes: Any) -> FrameImages:
        """Return the frame with other marks; its images, and what was made of them, stay."""
        return self._copy(self.halves if "halves" in self.__dict__ else None, **changes)

    def exchanged(self) -> FrameImages:
        """Return the frame with left and right images exchanged."""
        halves = None
        if "halves" in self.__dict__:
            halves = self.halves[::-1]
        return self._copy(halves, raw=self.raw[::-1])

    def _copy(self, halves: tuple[Image, ...] | None, **changes: Any) -> FrameImages:
        """Return a changed copy whose halves are known, unless they are None."""
        out = replace(self, **changes)
        if halves is not None:
            out.__dict__["halves"] = halves
        return out

    def checked(self) -> CheckedFrame:
        """Return the frame for the front end."""
        frame = self.frame
        pair = len(self.raw) == 2
        return CheckedFrame(
            frame.index,
            frame.time_ns,
            self.raw[0],
            self.raw[1] if pair else frame.right,
            frame.depth,
            left_half=self.halves[0],
            right_half=self.halves[1] if pair else None,
            right_usable=self.right_usable,
            right_delay=self.right_delay,
            begin_again=self.begin_again,
        )


def images_of(frame: StereoFrame, *, pair: bool) -> FrameImages | None:
    """Return the images of a frame for the checks.

    None: it has none, or none that a front end takes, which is for the front end to say.
    """
    raw = (frame.left, frame.right) if pair else (frame.left,)
    images = [
        image
        for image in raw
        if isinstance(image, np.ndarray)
        and image.dtype == np.uint8
        and image.ndim == 2
        and min(image.shape) >= 2
    ]
    if len(images) < len(raw) or len({image.shape for image in images}) > 1:
        return None
    return FrameImages(frame, tuple(images))


class ImageCheck(Finder):
    """Base of the checks: sees all frames of a recording in order of time, and reports each
    event once.
    """

    def inspect(self, images: FrameImages) -> FrameImages:
        """Return the images to use, corrected or marked where necessary.

        Raises:
            DataError: the recording cannot be used.
        """
        return images
