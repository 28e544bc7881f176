"""Key point matching by LightGlue."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, TypeAlias, cast

import numpy as np

from vio.errors import ConfigError, DataError
from vio.frontend.keypoints import Keypoints, Matcher
from vio.frontend.learned.weights import SECTION, half_precision, load_weights
from vio.frontend.settings import LearnedSettings
from vio.geometry.stereo import StereoCamera
from vio.records import BoolArray, IntArray

if TYPE_CHECKING:
    import torch

Tensor: TypeAlias = "torch.Tensor"

_DETECTORS = ("aliked", "disk", "xfeat")  # kornia names the weights after their detectors


@dataclass(frozen=True, slots=True)
class _LightGlueMatcher:
    """Matches key points by attention over both images; pairs that are not allowed are dropped
    afterwards.

    Reference: Lindenberger et al., LightGlue: local feature matching at light speed, ICCV (2023).
    """

    network: Any
    size: tuple[int, int] | None  # width and height of the images
    device: torch.device

    def __call__(self, a: Keypoints, b: Keypoints, allowed: BoolArray) -> IntArray:
        import torch

        if min(len(a), len(b)) < 2:
            return np.zeros((0, 2), dtype=np.int64)

        def view(points: Keypoints) -> dict[str, Tensor]:
            uv = torch.from_numpy(points.pixels.astype(np.float32))[None].to(self.device)
            described = torch.from_numpy(points.descriptors.astype(np.float32))[None].to(
                self.device
            )
            if self.size is not None:
                size = self.size
            else:
                size = tuple(points.pixels.max(axis=0))
            return {
                "keypoints": uv,
                "descriptors": described,
                "image_size": torch.tensor([size]).float().to(self.device),
            }

        with torch.inference_mode(), half_precision(self.device):
            matches = self.network({"image0": view(a), "image1": view(b)})["matches"][0]
        pairs = np.asarray(matches.cpu().numpy(), dtype=np.int64).reshape(-1, 2)
        return np.asarray(pairs[allowed[pairs[:, 0], pairs[:, 1]]], dtype=np.int64)


def _check_detector(learned: LearnedSettings) -> None:
    if learned.detector not in _DETECTORS:
        raise ConfigError(
            f"{SECTION}.matcher is lightglue, which goes with the detectors "
            f"{', '.join(_DETECTORS)} here, not with "
            f"{learned.detector}; set matcher to nearest"
        )
    if learned.detector == "aliked" and learned.aliked_model == "aliked-t16":
        raise ConfigError(
            f"{SECTION}.matcher is lightglue, which takes ALIKED's descriptors of 128 numbers, but "
            "aliked-t16 gives 64; set aliked_model to aliked-n16, with its weights"
        )


def build_lightglue(
    learned: LearnedSettings, camera: StereoCamera, device: torch.device
) -> Matcher:
    """Build the matcher for the key points of the detector in use.

    Raises:
        ConfigError: LightGlue does not support the detector, or its weights are not set.
        DataError: the file of weights cannot be read, or is of another network or detector.
    """
    import kornia.feature as kf

    _check_detector(learned)
    options = dict(kf.LightGlue.features[learned.detector])
    network = kf.LightGlue(features=cast(Any, None), **(options | {"weights": None}))
    state = load_weights(learned.matcher_weights, "matcher_weights")
    state = {key.removeprefix("matcher."): value for key, value in state.items()}
    for i in range(network.conf.n_layers):
        for part in ("self_attn", "cross_attn"):
            state = {
                key.replace(f"{part}.{i}.", f"transformers.{i}.{part}."): value
                for key, value in state.items()
            }
    try:
        missing = (
            set(network.load_state_dict(state, strict=False).missing_keys)
            & dict(network.named_parameters()).keys()
        )
    except (RuntimeError, AttributeError) as error:
        missing = {" ".join(str(error).split())[:120]}
    if missing:
        raise DataError(
            f"{learned.matcher_weights} ({SECTION}.matcher_weights) holds no weights of LightGlue "
            "for "
            f"{learned.detector}: {min(missing)}; give the file that belongs to it"
        )
    if camera.width is None or camera.height is None:
        size = None
    else:
        size = (camera.width, camera.height)
    return _LightGlueMatcher(network.eval().to(device), size, device)
