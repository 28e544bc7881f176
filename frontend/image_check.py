"""What checks of the images have in common.

A new check is a file of its own and a line in `vio.frontend.klt`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property

from vio.frontend.patches import ImageLevels
from vio.frontend.stereo_fit import StereoFit
from vio.frontend.tracks import PreviousFrame, Tracks
from vio.records import Image, StereoFrame


@dataclass(frozen=True)
class FrameImages:
    """The images of a frame, as the checks pass them on."""

    frame: StereoFrame
    raw: tuple[Image, ...]  # (H, W) left and right, or that of one camera
    view: Callable[[Image], ImageLevels]  # equalises and halves an image
    previous: PreviousFrame | None  # the last frame that was not skipped
    stereo: StereoFit
    right_trusted: bool  # the right image of the last frame was used
    # False: the right image of this frame is known to be frozen, dark or covered
    right_lives: bool = True
    # all frames so far were exchanged: a fault of the recording, which is not put back
    swapped: bool = False

    @cached_property
    def views(self) -> tuple[ImageLevels, ...]:
        """Left and right, or that of one camera."""
        return tuple(self.view(image) for image in self.raw)

    @property
    def left(self) -> ImageLevels:
        """Image that features are tracked in."""
        return self.views[0]

    @property
    def right(self) -> ImageLevels | None:
        """Image that they are matched in; None: one camera."""
        return self.views[1] if len(self.views) > 1 else None

    def with_raw(self, raw: tuple[Image, ...]) -> FrameImages:
        """Return the frame with other images."""
        return (
            self
            if all(a is b for a, b in zip(raw, self.raw, strict=True))
            else replace(self, raw=raw)
        )


class ImageCheck:
    """Base of the checks: sees all frames of a recording in order of time, and reports each
    event once.
    """

    def __init__(self) -> None:
        self._lines: list[str] = []

    def inspect(self, images: FrameImages) -> FrameImages | None:
        """Return the images to use, corrected where necessary; None: skip the frame. Called before
        tracking.

        Raises:
            DataError: the recording cannot be used.
        """
        return images

    def conclude(self, images: FrameImages, tracks: Tracks) -> None:
        """Take the tracked and matched features of a frame that was not skipped.

        Raises:
            DataError: the recording cannot be used.
        """

    def take_lines(self) -> tuple[str, ...]:
        """Return the reports since the last call."""
        lines = tuple(self._lines)
        self._lines = []
        return lines
