"""The right images of a recording: whether they may be used, and which one belongs to a frame."""

from __future__ import annotations

from vio.findings import Finding
from vio.frontend.right_camera import RightCamera
from vio.frontend.right_delay import RightDelay
from vio.geometry.stereo import StereoCamera
from vio.records import CheckedFrame, Image, StereoFrame


class RightImages:
    """What is known of the right images, by themselves and by their matches."""

    def __init__(self, camera: StereoCamera) -> None:
        self._is_pair = camera.kind == "stereo"
        self.camera = RightCamera()
        self.delay = RightDelay(camera)

    @property
    def usable(self) -> bool:
        """Whether the right image of the last frame may be used, perhaps as that of another
        time.
        """
        return self.camera.usable

    @property
    def delayed(self) -> bool:
        """Whether right images are of another time than the left ones."""
        return self.delay.frames != 0.0

    @property
    def of_present(self) -> bool:
        """Whether the right image of the last frame may be used as that of its time."""
        return self.usable and not self.delayed

    @property
    def needed(self) -> bool:
        """Whether a feature must be seen in the right image to be trusted."""
        return self._is_pair and self.usable

    def of_frame(self, frame: StereoFrame, right: Image) -> Image | None:
        """Return the right image (H, W) of a frame's time, given the one that came with it; None:
        it was not kept.
        """
        lives = not isinstance(frame, CheckedFrame) or frame.right_usable
        self.camera.by_image(frame.index, usable=lives)
        if isinstance(frame, CheckedFrame) and frame.begin_again:
            self.delay.know(frame.right_delay)
            self.camera.explained()
        return self.delay.paired(right)

    def take_findings(self) -> tuple[Finding, ...]:
        """Return what was found since the last call."""
        return self.camera.take_findings() + self.delay.take_findings()
