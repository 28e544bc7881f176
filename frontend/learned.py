"""The front end `kornia`: key points and descriptors computed by torch, with weights that the user gives by path.

Nothing is ever downloaded: every network is built without weights and filled from a file, read with
`weights_only=True`. Detectors gftt and harris with descriptor sift need no weights. torch and kornia come with
the extra `learned`; this module imports them only when such a front end is built.
"""

from __future__ import annotations

import pickle
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias, cast

import numpy as np

from frontend.descriptors import DescriptorFrontend, Extractor, Keypoints, Matcher, MutualNearest
from frontend.settings import FrontendSettings, LearnedSettings, MatchSettings
from vio.errors import ConfigError, DataError, MissingDependencyError
from vio.geometry.stereo import StereoCamera
from vio.records import BoolArray, Image, IntArray

if TYPE_CHECKING:
    import torch

Tensor: TypeAlias = "torch.Tensor"
Module: TypeAlias = "torch.nn.Module"

_SECTION = "frontend.learned"
_PATCH_RADIUS_PX = 12.0  # of what sift, mkd, ... describe around a corner
_PATCH_PX = {"sift": 41}
_NMS_PX = 5
_LIGHTGLUE = {"aliked": "aliked", "disk": "disk", "xfeat": "xfeat"}  # detector to kornia's name of the weights


def build_learned(camera: StereoCamera, settings: FrontendSettings) -> DescriptorFrontend:
    """Build the front end that the settings describe.

    Raises:
        MissingDependencyError: torch or kornia is not installed.
        ConfigError: weights are needed but not named, CUDA is asked for but absent, or parts do not fit together.
        DataError: a file of weights cannot be read, or is of another network.
    """
    _require_torch()
    match, learned = settings.match, settings.learned
    device = pick_device(learned.device)
    extract = _extractor(learned, match, device)
    matcher: Matcher = MutualNearest(match.ratio)
    if learned.matcher == "lightglue":
        matcher = _lightglue(learned, camera, device)
    return DescriptorFrontend(camera, settings, "kornia", extract, matcher)


def _require_torch() -> None:
    try:
        import kornia.feature
        import torch  # noqa: F401
    except ImportError as error:
        raise MissingDependencyError(
            f"the kornia front end needs torch and kornia ({error}); "
            "install them with: pip install 'stereo-vio[learned]'"
        ) from error
    assert kornia.feature is not None


def pick_device(name: str) -> torch.device:
    """The torch device of a setting, "cpu" or "cuda".

    Raises:
        ConfigError: CUDA is asked for, but there is none.
    """
    import torch

    if name == "cuda" and not torch.cuda.is_available():
        raise ConfigError(f"{_SECTION}.device is cuda, but torch finds no CUDA device here; set it to cpu")
    return torch.device(name)


def load_weights(path: Path | None, setting: str) -> dict[str, Any]:
    """Read a file of weights; what lies below "state_dict" where there is such a key.

    Args:
        path: the file; None is an error that names the setting.
        setting: name of the setting in `frontend.learned`, for messages.

    Raises:
        ConfigError: no file is named.
        DataError: the file cannot be read as weights.
    """
    import torch

    if path is None:
        raise ConfigError(f"{_SECTION}.{setting} is not set; give the path of a file of weights (none is downloaded)")
    try:
        content = torch.load(path, map_location="cpu", weights_only=True)
    except (OSError, RuntimeError, EOFError, ValueError, KeyError, pickle.UnpicklingError) as error:
        reason = str(error).strip().split("\n", 1)[0][:120]
        raise DataError(
            f"{path} ({_SECTION}.{setting}) cannot be read as weights of torch: {reason}; give a .pth file"
        ) from error
    for key in ("state_dict", "extractor", "model"):
        if isinstance(content, dict) and isinstance(content.get(key), dict):
            content = content[key]
    if not isinstance(content, dict):
        raise DataError(f"{path} ({_SECTION}.{setting}) holds no named weights; give a .pth file of a state dict")
    return dict(content)


def _filled(module: Any, path: Path | None, setting: str) -> Module:
    """Fill a module with the weights of a file, all of them, for inference."""
    state = load_weights(path, setting)
    try:
        result = module.load_state_dict(state, strict=False)
        # Tables that the constructor computes need not be in the file; what was learned must be.
        learned = dict(module.named_parameters()).keys() | {k for k in module.state_dict() if k.endswith("running_var")}
        wrong = sorted(set(result.missing_keys) & learned) + sorted(result.unexpected_keys)
        problem = f"{len(wrong)} entries do not fit, such as {wrong[0]}" if wrong else None
    except (RuntimeError, TypeError, AttributeError) as error:
        problem = " ".join(str(error).split())[:140]
    if problem is not None:
        raise DataError(
            f"{path} ({_SECTION}.{setting}) holds weights of another network than {type(module).__name__} ({problem}); "
            "give the file that belongs to it"
        )
    return module.eval()


# --- extractors -----------------------------------------------------------------------------------------------------


def _extractor(learned: LearnedSettings, match: MatchSettings, device: torch.device) -> Extractor:
    import kornia.feature as kf

    name, count = learned.detector, match.max_keypoints
    if name == "aliked":
        aliked = kf.ALIKED(learned.aliked_model, max_num_keypoints=count, detection_threshold=0.0)
        return _Whole(_filled(aliked, learned.detector_weights, "detector_weights").to(device), name, count, device)
    if name == "disk":
        return _Whole(_filled(kf.DISK(), learned.detector_weights, "detector_weights").to(device), name, count, device)
    if name == "xfeat":
        xfeat = kf.XFeat(top_k=count)
        _filled(xfeat.net, learned.detector_weights, "detector_weights")
        return _Whole(xfeat.eval().to(device), name, count, device)
    describe = _descriptor(learned).to(device)
    patch_px = _PATCH_PX.get(learned.descriptor, 32)
    if name == "keynet":
        keynet = kf.KeyNetDetector(
            pretrained=False, num_features=count, aff_module=_affine(learned), ori_module=_orienter(learned)
        )
        _filled(keynet.model, learned.detector_weights, "detector_weights")
        return _Patches(keynet.eval().to(device), describe, patch_px, device)
    corners = _Corners(name, count, _affine(learned), _orienter(learned), device)
    return _Patches(corners, describe, patch_px, device)


def _affine(learned: LearnedSettings) -> Module | None:
    import kornia.feature as kf

    if learned.affine_weights is None:
        return None
    return _filled(kf.LAFAffNetShapeEstimator(pretrained=False), learned.affine_weights, "affine_weights")


def _orienter(learned: LearnedSettings) -> Module | None:
    import kornia.feature as kf

    if learned.orientation_weights is None:
        return None
    angle = _filled(kf.OriNet(pretrained=False), learned.orientation_weights, "orientation_weights")
    return kf.LAFOrienter(32, angle_detector=angle).eval()


def _descriptor(learned: LearnedSettings) -> Module:
    import kornia.feature as kf

    name, path = learned.descriptor, learned.descriptor_weights
    if name == "sift":
        return kf.SIFTDescriptor(_PATCH_PX["sift"]).eval()
    if name == "mkd":
        return _mkd(path)
    networks: dict[str, Any] = {"hardnet": kf.HardNet, "hynet": kf.HyNet, "sosnet": kf.SOSNet}
    return _filled(networks[name](pretrained=False), path, "descriptor_weights")


def _mkd(path: Path | None) -> Module:
    """Multiple kernel descriptor; its weights are the whitening, which also tells which kernels it is for.

    Reference: Mukundan et al., Understanding and improving kernel local descriptors, IJCV (2019).
    """
    import kornia.feature as kf
    from kornia.feature.mkd import Whitening

    models = load_weights(path, "descriptor_weights")
    whitening = models.get("liberty")
    if not isinstance(whitening, dict) or "pca" not in whitening:
        raise DataError(f"{path} ({_SECTION}.descriptor_weights) holds no whitening of MKD; give one of its .pth files")
    size = len(whitening["pca"]["mean"])
    for kernel in ("cart", "polar", "concat"):
        module = kf.MKDDescriptor(patch_size=32, kernel_type=kernel, whitening=cast(Any, None))
        if module.odims == size:
            module.whitening_layer = Whitening("pcawt", whitening, in_dims=size, output_dims=min(128, size))
            module.whitening = "pcawt"
            return module.eval()
    raise DataError(
        f"{path} ({_SECTION}.descriptor_weights) whitens {size} numbers, as no kernel of MKD has; give another file"
    )


def _as_tensor(image: Image, device: torch.device) -> Tensor:
    """Image (1, 1, H, W) in 0..1."""
    import torch

    return torch.from_numpy(image.astype(np.float32) / 255.0)[None, None].to(device)


def _half(device: torch.device) -> Any:
    """Context in which networks compute in half precision on CUDA, and as they are elsewhere."""
    import torch

    return torch.autocast("cuda", dtype=torch.float16, enabled=device.type == "cuda")


def _keypoints(pixels: Tensor, descriptors: Tensor, strength: Tensor) -> Keypoints:
    """Move key points (N, ...) to NumPy, strongest first, descriptors as unit vectors; those not finite are dropped."""
    columns = (np.asarray(t.detach().float().cpu().numpy()) for t in (pixels, descriptors, strength))
    uv, described, weight = columns
    order = np.argsort(-weight, kind="stable")
    order = order[np.isfinite(described[order]).all(axis=1) & np.isfinite(uv[order]).all(axis=1)]
    norm = np.maximum(np.linalg.norm(described[order], axis=1, keepdims=True), 1e-9)
    return Keypoints(uv[order].astype(np.float64), (described[order] / norm).astype(np.float32))


@dataclass(frozen=True, slots=True)
class _Whole:
    """A network that detects and describes: ALIKED, DISK, XFeat.

    Reference: Zhao et al., ALIKED (2023); Tyszkiewicz et al., DISK (2020); Potje et al., XFeat (2024).
    """

    network: Any
    name: str
    count: int
    device: torch.device

    def __call__(self, image: Image) -> Keypoints:
        import torch

        with torch.inference_mode(), _half(self.device):
            pixels = _as_tensor(image, self.device)
            if self.name == "disk":
                found = self.network(pixels.repeat(1, 3, 1, 1), n=self.count, pad_if_not_divisible=True)[0]
            elif self.name == "xfeat":
                found = self.network.detectAndCompute(pixels.repeat(1, 3, 1, 1))[0]
            else:
                found = self.network(pixels.repeat(1, 3, 1, 1))[0]
        if isinstance(found, dict):
            uv, described, score = found["keypoints"], found["descriptors"], found["scores"]
        else:
            uv, described = found.keypoints, found.descriptors
            score = found.keypoint_scores if hasattr(found, "keypoint_scores") else found.detection_scores
        return _keypoints(uv, described, score.reshape(-1))


@dataclass(frozen=True, slots=True)
class _Patches:
    """A detector of local affine frames, and a descriptor of the patches in them."""

    detector: Any  # image (1, 1, H, W) to frames (1, N, 2, 3) and responses (1, N)
    descriptor: Any  # patches (N, 1, P, P) to descriptors (N, D)
    patch_px: int
    device: torch.device

    def __call__(self, image: Image) -> Keypoints:
        import kornia.feature as kf
        import torch

        with torch.inference_mode():
            pixels = _as_tensor(image, self.device)
            frames, response = self.detector(pixels)
            if frames.shape[1] == 0:
                return _keypoints(torch.zeros(0, 2), torch.zeros(0, 1), torch.zeros(0))
            patches = kf.extract_patches_from_pyramid(pixels, frames, self.patch_px)[0]
            with _half(self.device):
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
            kf.gftt_response(pixels) if self.name == "gftt" else kf.harris_response(pixels, torch.tensor(0.04))
        )[0, 0]
        peak = torch.nn.functional.max_pool2d(response[None, None], _NMS_PX, 1, _NMS_PX // 2)[0, 0]
        border = torch.zeros_like(response, dtype=torch.bool)
        border[2:-2, 2:-2] = True
        rows, columns = torch.nonzero((response == peak) & (response > 1e-8) & border, as_tuple=True)
        strength = response[rows, columns]
        order = torch.argsort(-strength, stable=True)[: self.count]
        rows, columns, strength = rows[order], columns[order], strength[order]
        middle = response[rows, columns]

        def offset(before: Tensor, after: Tensor) -> Tensor:
            bend = before - 2 * middle + after
            return torch.clamp((before - after) / 2 / torch.where(bend < 0, bend, -1.0), -0.5, 0.5)

        du = offset(response[rows, columns - 1], response[rows, columns + 1])
        dv = offset(response[rows - 1, columns], response[rows + 1, columns])
        centre = torch.stack([columns + du, rows + dv], dim=1)[None]
        radius = torch.full((1, len(order), 1, 1), _PATCH_RADIUS_PX, device=self.device)
        frames = kf.laf_from_center_scale_ori(centre, radius)
        for module in (self.affine, self.orient):
            if module is not None and len(order):
                frames = module.to(self.device)(frames, pixels)
        return frames, strength[None]


# --- LightGlue ------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class _LightGlueMatcher:
    """Pairs key points by attention over both images; pairs that are not allowed are dropped afterwards.

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
            described = torch.from_numpy(points.descriptors.astype(np.float32))[None].to(self.device)
            size = self.size if self.size is not None else tuple(points.pixels.max(axis=0))
            return {
                "keypoints": uv,
                "descriptors": described,
                "image_size": torch.tensor([size]).float().to(self.device),
            }

        with torch.inference_mode(), _half(self.device):
            matches = self.network({"image0": view(a), "image1": view(b)})["matches"][0]
        pairs = np.asarray(matches.cpu().numpy(), dtype=np.int64).reshape(-1, 2)
        return np.asarray(pairs[allowed[pairs[:, 0], pairs[:, 1]]], dtype=np.int64)


def _lightglue(learned: LearnedSettings, camera: StereoCamera, device: torch.device) -> _LightGlueMatcher:
    import kornia.feature as kf

    if learned.detector not in _LIGHTGLUE:
        raise ConfigError(
            f"{_SECTION}.matcher is lightglue, which goes with the detectors {', '.join(_LIGHTGLUE)} here, not with "
            f"{learned.detector}; set matcher to nearest"
        )
    options = dict(kf.LightGlue.features[_LIGHTGLUE[learned.detector]])
    if learned.detector == "aliked" and learned.aliked_model == "aliked-t16":
        raise ConfigError(
            f"{_SECTION}.matcher is lightglue, which takes ALIKED's descriptors of 128 numbers, but "
            "aliked-t16 gives 64; set aliked_model to aliked-n16, with its weights"
        )
    network = kf.LightGlue(features=cast(Any, None), **(options | {"weights": None}))
    state = load_weights(learned.matcher_weights, "matcher_weights")
    state = {key.removeprefix("matcher."): value for key, value in state.items()}
    for i in range(network.conf.n_layers):
        for part in ("self_attn", "cross_attn"):
            state = {key.replace(f"{part}.{i}.", f"transformers.{i}.{part}."): value for key, value in state.items()}
    try:
        missing = (
            set(network.load_state_dict(state, strict=False).missing_keys) & dict(network.named_parameters()).keys()
        )
    except (RuntimeError, AttributeError) as error:
        missing = {" ".join(str(error).split())[:120]}
    if missing:
        raise DataError(
            f"{learned.matcher_weights} ({_SECTION}.matcher_weights) holds no weights of LightGlue for "
            f"{learned.detector}: {min(missing)}; give the file that belongs to it"
        )
    size = None if camera.width is None or camera.height is None else (camera.width, camera.height)
    return _LightGlueMatcher(network.eval().to(device), size, device)
