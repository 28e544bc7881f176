"""Key points and descriptors from kornia's networks and operators."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias, cast

import numpy as np

from vio.errors import DataError
from vio.frontend.keypoints import Extractor, Keypoints
from vio.frontend.learned.weights import SECTION, Module, filled, half_precision, load_weights
from vio.frontend.settings import LearnedSettings, MatchSettings
from vio.records import Image

if TYPE_CHECKING:
    import torch

Tensor: TypeAlias = "torch.Tensor"

_PATCH_RADIUS_PX = 12.0  # of the patch around a corner that sift, mkd, ... describe
_PATCH_PX = {"sift": 41}
_NMS_PX = 5


def build_extractor(
    learned: LearnedSettings, match: MatchSettings, device: torch.device
) -> Extractor:
    """Build the detector and descriptor of key points.

    Raises:
        ConfigError: a required weights file is not set.
        DataError: a file of weights cannot be read, or is of another network.
    """
    import kornia.feature as kf

    name = learned.detector
    count = match.max_keypoints
    if name == "aliked":
        aliked: Any = kf.ALIKED(
            learned.aliked_model, max_num_keypoints=count, detection_threshold=0.0
        )
        filled(aliked, learned.detector_weights, "detector_weights").to(device)
        if device.type == "cuda":
            aliked.extract_dense_map = _Replayed(aliked.extract_dense_map)
        return _Whole(aliked, name, count, device)
    if name == "disk":
        return _Whole(
            filled(kf.DISK(), learned.detector_weights, "detector_weights").to(device),
            name,
            count,
            device,
        )
    if name == "xfeat":
        xfeat = kf.XFeat(top_k=count)
        filled(xfeat.net, learned.detector_weights, "detector_weights")
        return _Whole(xfeat.eval().to(device), name, count, device)
    describe = _descriptor(learned).to(device)
    patch_px = _PATCH_PX.get(learned.descriptor, 32)
    if name == "keynet":
        keynet = kf.KeyNetDetector(
            pretrained=False,
            num_features=count,
            aff_module=_affine(learned),
            ori_module=_orienter(learned),
        )
        filled(keynet.model, learned.detector_weights, "detector_weights")
        return _Patches(keynet.eval().to(device), describe, patch_px, device)
    corners = _Corners(name, count, _affine(learned), _orienter(learned), device)
    return _Patches(corners, describe, patch_px, device)


def _affine(learned: LearnedSettings) -> Module | None:
    import kornia.feature as kf

    if learned.affine_weights is None:
        return None
    return filled(
        kf.LAFAffNetShapeEstimator(pretrained=False), learned.affine_weights, "affine_weights"
    )


def _orienter(learned: LearnedSettings) -> Module | None:
    import kornia.feature as kf

    if learned.orientation_weights is None:
        return None
    angle = filled(kf.OriNet(pretrained=False), learned.orientation_weights, "orientation_weights")
    return kf.LAFOrienter(32, angle_detector=angle).eval()


def _descriptor(learned: LearnedSettings) -> Module:
    import kornia.feature as kf

    name = learned.descriptor
    path = learned.descriptor_weights
    if name == "sift":
        return kf.SIFTDescriptor(_PATCH_PX["sift"]).eval()
    if name == "mkd":
        return _mkd(path)
    networks: dict[str, Any] = {"hardnet": kf.HardNet, "hynet": kf.HyNet, "sosnet": kf.SOSNet}
    return filled(networks[name](pretrained=False), path, "descriptor_weights")


def _mkd(path: Path | None) -> Module:
    """Multiple kernel descriptor; its weights are the whitening, whose size determines the kernels.

    Reference: Mukundan et al., Understanding and improving kernel local descriptors, IJCV (2019).
    """
    import kornia.feature as kf
    from kornia.feature.mkd import Whitening

    models = load_weights(path, "descriptor_weights")
    whitening = models.get("liberty")
    if not isinstance(whitening, dict) or "pca" not in whitening:
        raise DataError(
            f"{path} ({SECTION}.descriptor_weights) holds no whitening of MKD; give one of its "
            ".pth files"
        )
    size = len(whitening["pca"]["mean"])
    for kernel in ("cart", "polar", "concat"):
        module = kf.MKDDescriptor(patch_size=32, kernel_type=kernel, whitening=cast(Any, None))
        if module.odims == size:
            module.whitening_layer = Whitening(
                "pcawt", whitening, in_dims=size, output_dims=min(128, size)
            )
            module.whitening = "pcawt"
            return module.eval()
    raise DataError(
        f"{path} ({SECTION}.descriptor_weights) whitens {size} numbers, as no kernel of MKD has; "
        "give another file"
    )


def _as_tensor(images: Sequence[Image], device: torch.device) -> Tensor:
    """Images (B, 1, H, W) in 0..1."""
    import torch

    return torch.from_numpy(np.stack(images)[:, None]).to(device).float() / 255.0


def _keypoints(pixels: Tensor, descriptors: Tensor, strength: Tensor) -> Keypoints:
    """Move key points (N, ...) to NumPy, strongest first, descriptors as unit vectors;
    non-finite ones are dropped.
    """
    columns = (
        np.asarray(t.detach().float().cpu().numpy()) for t in (pixels, descriptors, strength)
    )
    uv, described, weight = columns
    order = np.argsort(-weight, kind="stable")
    finite = np.isfinite(described[order]).all(axis=1) & np.isfinite(uv[order]).all(axis=1)
    order = order[finite]
    norm = np.maximum(np.linalg.norm(described[order], axis=1, keepdims=True), 1e-9)
    return Keypoints(uv[order].astype(np.float64), (described[order] / norm).astype(np.float32))


class _Replayed:
    """A network's calls of CUDA kernels, recorded at the first call for a shape and then made as
    one.

    To make them takes longer than to run them. What is returned is overwritten by the next call.
    """

    def __init__(self, network: Callable[[Tensor], tuple[Tensor, ...]]) -> None:
        self._network = network
        self._input: Tensor | None = None

    def __call__(self, images: Tensor) -> tuple[Tensor, ...]:
        import torch

        if self._input is None or self._input.shape != images.shape:
            self._input = images.clone()
            self._graph = torch.cuda.CUDAGraph()
            # Weights of half precision that autocast keeps for a while would be read after they are
            # freed.
            with torch.autocast("cuda", dtype=torch.float16, cache_enabled=False):
                # the libraries choose their kernels before the recording
                self._network(self._input)
                with torch.cuda.graph(self._graph):
                    self._output = self._network(self._input)
        self._input.copy_(images)
        self._graph.replay()
        return self._output


@dataclass(frozen=True, slots=True)
class _Whole:
    """A network that detects and describes: ALIKED, DISK, XFeat.

    Reference: Zhao et al., ALIKED (2023); Tyszkiewicz et al., DISK (2020); Potje et al., XFeat
    (2024).
    """

    network: Any
    name: str
    count: int
    device: torch.device

    def __call__(self, *images: Image) -> list[Keypoints]:
        import torch

        # Calls of the network's kernels take longer than the kernels on a GPU, so that all images
        # share them.
        if self.device.type == "cuda":
            batches = [images]
        else:
            batches = [(image,) for image in images]
        with torch.inference_mode(), half_precision(self.device):
            return [_keypoints(*columns) for batch in batches for columns in self._found(batch)]

    def _found(self, images: Sequence[Image]) -> list[tuple[Tensor, Tensor, Tensor]]:
        """Pixels (N, 2), descriptors (N, D) and scores (N,) in each image."""
        colour = _as_tensor(images, self.device).repeat(1, 3, 1, 1)
        if self.name == "xfeat":
            found = self.network.detectAndCompute(colour)
            return [(f["keypoints"], f["descriptors"], f["scores"].reshape(-1)) for f in found]
        if self.name == "disk":
            found = self.network(colour, n=self.count, pad_if_not_divisible=True)
            return [(f.keypoints, f.descriptors, f.detection_scores) for f in found]
        return [(f.keypoints, f.descriptors, f.keypoint_scores) for f in self.network(colour)]


@dataclass(frozen=True, slots=True)
class _Patches:
    """A detector of local affine frames, and a descriptor of the patches in them."""

    detector: Any  # image (1, 1, H, W) to frames (1, N, 2, 3) and responses (1, N)
    descriptor: Any  # patches (N, 1, P, P) to descriptors (N, D)
    patch_px: int
    device: torch.device

    def __call__(self, *images: Image) -> list[Keypoints]:
        return [self._keypoints(image) for image in images]

    def _keypoints(self, image: Image) -> Keypoints:
        import kornia.feature as kf
        import torch

        with torch.inference_mode():
            pixels = _as_tensor([image], self.device)
            frames, response = self.detector(pixels)
            if frames.shape[1] == 0:
                return _keypoints(torch.zeros(0, 2), torch.zeros(0, 1), torch.zeros(0))
            patches = kf.extract_patches_from_pyramid(pixels, frames, self.patch_px)[0]
            with half_precision(self.device):
                described = self.descriptor(patches)
            centre = kf.get_laf_center(frames)[0]
        return _keypoints(centre, described, response.reshape(-1))


@dataclass(frozen=True, slots=True)
class _Corners:
    """Corners by kornia's structure-tensor responses, as frames of one size.

    Reference: Shi & Tomasi (1994) for gftt, Harris & Stephens (1988) for harris.
    """

    name: str
    count: int
    affine: Any  # module on (frames, image) or None
    orient: Any  # the same
    device: torch.device

    def __call__(self, pixels: Tensor) -> tuple[Tensor, Tensor]:
        import kornia.feature as kf
        import torch

        response = (
            kf.gftt_response(pixels)
            if self.name == "gftt"
            else kf.harris_response(pixels, torch.tensor(0.04))
        )[0, 0]
        peak = torch.nn.functional.max_pool2d(response[None, None], _NMS_PX, 1, _NMS_PX // 2)[0, 0]
        border = torch.zeros_like(response, dtype=torch.bool)
        border[2:-2, 2:-2] = True
        rows, columns = torch.nonzero(
            (response == peak) & (response > 1e-8) & border, as_tuple=True
        )
        strength = response[rows, columns]
        order = torch.argsort(-strength, stable=True)[: self.count]
        rows = rows[order]
        columns = columns[order]
        strength = strength[order]
        middle = response[rows, columns]

        def offset(before: Tensor, after: Tensor) -> Tensor:
            bend = before - 2 * middle + after
            divisor = torch.where(bend < 0, bend, -1.0)
            return torch.clamp((before - after) / 2 / divisor, -0.5, 0.5)

        du = offset(response[rows, columns - 1], response[rows, columns + 1])
        dv = offset(response[rows - 1, columns], response[rows + 1, columns])
        centre = torch.stack([columns + du, rows + dv], dim=1)[None]
        radius = torch.full((1, len(order), 1, 1), _PATCH_RADIUS_PX, device=self.device)
        frames = kf.laf_from_center_scale_ori(centre, radius)
        for module in (self.affine, self.orient):
            if module is not None and len(order):
                frames = module.to(self.device)(frames, pixels)
        return frames, strength[None]
