"""The default front end: corners followed by Lucas-Kanade."""

from __future__ import annotations

from vio.frontend.flow import LucasKanade
from vio.frontend.settings import FrontendSettings
from vio.frontend.tracking import TrackingFrontend
from vio.frontend.tracks import AnchorBank
from vio.geometry.stereo import StereoCamera
from vio.protocols import Detector


class KltFrontend(TrackingFrontend):
    """Track corners by Lucas-Kanade."""

    def __init__(
        self,
        camera: StereoCamera,
        settings: FrontendSettings | None = None,
        detector: Detector | None = None,
    ) -> None:
        """Prepare; a `detector` finds the corners in place of the built-in one."""
        settings = FrontendSettings() if settings is None else settings
        bank = AnchorBank.for_features(settings.grid.target_features)
        flow = LucasKanade(settings.klt.pyramid_levels)
        super().__init__(camera, settings, "klt", bank, flow, detector)
