"""Parts that need torch (extra `learned`): the front end `kornia`.

Nothing is ever downloaded: networks are built without weights and loaded from a file with
`weights_only=True`. Detectors gftt and harris with descriptor sift need no weights. torch and
kornia are imported only when a part that needs them is built.
"""

from __future__ import annotations

import numpy as np

from vio.errors import MissingDependencyError, extra_text
from vio.frontend.descriptors import DescriptorFrontend
from vio.frontend.keypoints import Matcher, MutualNearest
from vio.frontend.learned.extractors import build_extractor
from vio.frontend.learned.lightglue import build_lightglue
from vio.frontend.learned.weights import pick_device
from vio.frontend.settings import FrontendSettings
from vio.geometry.stereo import StereoCamera
from vio.records import StereoFrame


def build_learned(camera: StereoCamera, settings: FrontendSettings) -> DescriptorFrontend:
    """Build the front end `kornia` from the settings.

    Raises:
        MissingDependencyError: torch or kornia is not installed, or kornia is too old.
        ConfigError: a required weights file is not set, CUDA is requested but absent, or parts do
            not fit together.
        DataError: a file of weights cannot be read, or is of another network.
    """
    _require_torch()
    match = settings.match
    learned = settings.learned
    device = pick_device(learned.device)
    extract = build_extractor(learned, match, device)
    matcher: Matcher = MutualNearest()
    if learned.matcher == "lightglue":
        matcher = build_lightglue(learned, camera, device)
    if learned.device == "cuda":
        _warm_up(DescriptorFrontend(camera, settings, "kornia", extract, matcher), camera)
    return DescriptorFrontend(camera, settings, "kornia", extract, matcher)


def _warm_up(frontend: DescriptorFrontend, camera: StereoCamera) -> None:
    """Process two frames of noise: the first call of CUDA loads its libraries, which takes
    seconds.
    """
    if camera.width is None or camera.height is None:
        return
    left = np.random.default_rng(0).integers(0, 256, (camera.height, camera.width), dtype=np.uint8)
    right = np.roll(left, -8, axis=1) if camera.kind == "stereo" else None
    depth = np.ones(left.shape) if camera.kind == "rgbd" else None
    for k in range(2):
        frontend.process(StereoFrame(k, k * 10**8, left, right, depth=depth))


def _require_torch() -> None:
    try:
        import torch  # noqa: F401
        from kornia.feature import ALIKED, XFeat  # noqa: F401  (the newest that are used)
    except ImportError as error:
        raise MissingDependencyError(
            "the kornia front end needs torch and kornia 0.8.3 or newer, on Python 3.11 or newer "
            f"({error}); {extra_text('learned')}"
        ) from error
