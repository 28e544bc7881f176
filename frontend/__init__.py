"""Front ends: stereo images to tracked observations.

They use OpenCV; the filters of `vio` do not import them.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager

from vio.errors import ConfigError
from vio.frontend.settings import FrontendSettings
from vio.geometry.stereo import StereoCamera
from vio.protocols import Dataset, Frontend

__all__ = ["BUILDERS", "FrontendSettings", "build_frontend", "one_opencv_thread"]


def _build_klt(
    camera: StereoCamera, settings: FrontendSettings, dataset: Dataset | None
) -> Frontend:
    from vio.frontend.klt import KltFrontend

    return KltFrontend(camera, settings)


def _build_orb(
    camera: StereoCamera, settings: FrontendSettings, dataset: Dataset | None
) -> Frontend:
    from vio.frontend.descriptors import DescriptorFrontend
    from vio.frontend.keypoints import MutualNearest, orb_extractor

    return DescriptorFrontend(
        camera, settings, "orb", orb_extractor(settings.match), MutualNearest()
    )


def _build_sift(
    camera: StereoCamera, settings: FrontendSettings, dataset: Dataset | None
) -> Frontend:
    from vio.frontend.descriptors import DescriptorFrontend
    from vio.frontend.keypoints import MutualNearest, sift_extractor

    return DescriptorFrontend(
        camera, settings, "sift", sift_extractor(settings.match), MutualNearest()
    )


def _build_kornia(
    camera: StereoCamera, settings: FrontendSettings, dataset: Dataset | None
) -> Frontend:
    from vio.frontend.learned import build_learned

    return build_learned(camera, settings)


def _build_precomputed(
    camera: StereoCamera, settings: FrontendSettings, dataset: Dataset | None
) -> Frontend:
    from vio.frontend.precomputed import PrecomputedFrontend

    if dataset is None:
        raise ConfigError("frontend.name: precomputed needs a recording of features")
    recording = dataset.recording
    return PrecomputedFrontend(
        dataset.observations,
        checks_matches=recording.run_motion is not None,
        checks_repeats=recording.repeats_settled,
    )


BUILDERS: dict[str, Callable[[StereoCamera, FrontendSettings, Dataset | None], Frontend]] = {
    "klt": _build_klt,
    "orb": _build_orb,
    "sift": _build_sift,
    "kornia": _build_kornia,
    "precomputed": _build_precomputed,
}


@contextmanager
def one_opencv_thread() -> Iterator[None]:
    """Let OpenCV work in the caller's thread inside the block: waiting for helpers costs more than
    they save.

    Measured on `klt`: 7 % of a run's CPU time at 752x480, and 4 % at 1242x375.
    """
    import cv2

    before = cv2.getNumThreads()
    cv2.setNumThreads(1)
    try:
        yield
    finally:
        cv2.setNumThreads(before)


def build_frontend(
    name: str, camera: StereoCamera, settings: FrontendSettings, dataset: Dataset | None = None
) -> Frontend:
    """Build the front end called `name`; "auto" selects by what the recording contains, None being
    a live camera.

    Raises:
        ConfigError: no front end has this name, or camera or settings are of another kind.
    """
    if not isinstance(camera, StereoCamera) or not isinstance(settings, FrontendSettings):
        raise ConfigError(
            "build_frontend takes a StereoCamera and FrontendSettings, got "
            f"{type(camera).__name__} and "
            f"{type(settings).__name__}"
        )
    if name == "auto":
        name = "precomputed"
        if dataset is None or dataset.recording.has_images:
            name = "klt"
    if name not in BUILDERS:
        raise ConfigError(
            f"frontend.name: there is no front end {name!r}; choose one of auto, "
            f"{', '.join(BUILDERS)}"
        )
    return BUILDERS[name](camera, settings, dataset)
