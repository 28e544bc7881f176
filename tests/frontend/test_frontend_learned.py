"""The parts that need torch: weights from files only, clear errors, and Lucas-Kanade that agrees
with OpenCV.
"""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest

from tests.frontend.test_frontend_scene import CAMERA, SLANTED, flight, stereo_frame, truth
from vio.errors import ConfigError, DataError, MissingDependencyError
from vio.frontend import descriptors
from vio.frontend.descriptors import DescriptorFrontend
from vio.frontend.keypoints import Keypoints, MutualNearest
from vio.frontend.settings import FrontendSettings, GridSettings, LearnedSettings, MatchSettings
from vio.geometry.lie import FloatArray
from vio.geometry.stereo import StereoCamera
from vio.records import BoolArray, StereoFrame

REASON = "not installed: the extra learned"
MATCH = MatchSettings(max_keypoints=250)


@pytest.fixture(scope="module")
def torch() -> Any:
    pytest.importorskip("kornia", reason=REASON)
    return pytest.importorskip("torch", reason=REASON)


SMALL = replace(CAMERA, width=240, height=160)


def build(settings: LearnedSettings, match: MatchSettings = MATCH) -> DescriptorFrontend:
    from vio.frontend.learned import build_learned

    grid = GridSettings(target_features=200)
    return build_learned(SMALL, FrontendSettings(grid=grid, match=match, learned=settings))


def small_frame(index: int, pose: FloatArray) -> StereoFrame:
    """The upper left part of the rendered pair, where pixel coordinates are unchanged."""
    frame = stereo_frame(index, pose)
    left, right = (np.ascontiguousarray(image[:160, :240]) for image in (frame.left, frame.right))
    return replace(frame, left=left, right=right)


# --- without torch
# --------------------------------------------------------------------------------------------------


def test_error_without_torch_names_the_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    for module in ("torch", "kornia", "kornia.feature"):
        monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(MissingDependencyError, match=r"'.\[learned\]'"):
        build(LearnedSettings())


def test_rejects_kornia_without_the_networks(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "torch", ModuleType("torch"))
    monkeypatch.setitem(sys.modules, "kornia", ModuleType("kornia"))
    monkeypatch.setitem(sys.modules, "kornia.feature", ModuleType("kornia.feature"))
    with pytest.raises(MissingDependencyError, match=r"0\.8\.3 or newer.*ALIKED"):
        build(LearnedSettings())


# --- weights and devices
# ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("settings", "named"),
    [
        (LearnedSettings(detector="aliked"), "detector_weights"),
        (LearnedSettings(detector="disk"), "detector_weights"),
        (LearnedSettings(detector="xfeat"), "detector_weights"),
        (LearnedSettings(detector="keynet"), "detector_weights"),
        (LearnedSettings(descriptor="mkd"), "descriptor_weights"),
        (LearnedSettings(descriptor="hardnet"), "descriptor_weights"),
    ],
)
def test_required_weights_must_be_set(torch: Any, settings: LearnedSettings, named: str) -> None:
    with pytest.raises(ConfigError, match=f"frontend.learned.{named} is not set"):
        build(settings)


def test_rejects_files_that_are_not_weights(torch: Any, tmp_path: Path) -> None:
    text, lists = tmp_path / "text.pth", tmp_path / "list.pth"
    text.write_text("not weights")
    torch.save([1, 2, 3], lists)
    for path in (text, tmp_path / "missing.pth"):
        with pytest.raises(DataError, match=f"{path.name} .*cannot be read as weights"):
            build(LearnedSettings(detector="aliked", detector_weights=path))
    with pytest.raises(DataError, match="holds no named weights"):
        build(LearnedSettings(detector="aliked", detector_weights=lists))


class _Evil:
    def __reduce__(self) -> tuple[Any, tuple[str]]:
        return exec, ("raise SystemExit('a file of weights ran code')",)


def test_weights_file_cannot_run_code(torch: Any, tmp_path: Path) -> None:
    path = tmp_path / "evil.pth"
    torch.save({"state_dict": _Evil()}, path)
    with pytest.raises(DataError, match="cannot be read as weights"):
        build(LearnedSettings(detector="aliked", detector_weights=path))


def test_rejects_weights_of_another_network(
    torch: Any, files: dict[str, Path], tmp_path: Path
) -> None:
    path = tmp_path / "hardnet.pth"
    torch.save({"state_dict": torch.load(files["hardnet"])}, path)
    for settings in (
        LearnedSettings(detector="aliked", detector_weights=path),
        LearnedSettings(detector="disk", detector_weights=path),
        LearnedSettings(affine_weights=path),
        LearnedSettings(orientation_weights=path),
    ):
        with pytest.raises(DataError, match=r"hardnet.pth .* holds weights of another network"):
            build(settings)
    with pytest.raises(DataError, match="no whitening of MKD"):
        build(LearnedSettings(descriptor="mkd", descriptor_weights=path))


def test_rejects_absent_cuda(torch: Any) -> None:
    if torch.cuda.is_available():
        pytest.skip("this machine has CUDA")
    with pytest.raises(ConfigError, match="no CUDA device here; set it to cpu"):
        build(LearnedSettings(device="cuda"))


def test_lightglue_rejects_unsupported_detectors(torch: Any) -> None:
    with pytest.raises(ConfigError, match="goes with the detectors aliked, disk, xfeat"):
        build(LearnedSettings(matcher="lightglue"))


def test_rejects_lightglue_weights_for_other_descriptors(files: dict[str, Path]) -> None:
    for name, weights in (("disk", "hardnet"), ("xfeat", "lightglue")):
        settings = LearnedSettings(
            detector=name,  # type: ignore[arg-type]
            detector_weights=files[name],
            matcher="lightglue",
            matcher_weights=files[weights],
        )
        with pytest.raises(DataError, match="holds no weights of LightGlue"):
            build(settings)
    small = LearnedSettings(
        detector="aliked", detector_weights=files["aliked"], matcher="lightglue"
    )
    with pytest.raises(ConfigError, match="aliked-t16 gives 64"):
        build(replace(small, matcher_weights=files["lightglue"]))


# --- networks filled from files
# ---------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def files(torch: Any, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Files of random weights of every supported network; the results are meaningless, but of
    the right form.
    """
    import kornia.feature as kf

    folder = tmp_path_factory.mktemp("weights")
    torch.manual_seed(1)
    made = {
        "aliked": kf.ALIKED("aliked-t16"),
        "disk": kf.DISK(),
        "xfeat": kf.XFeatModel(),
        "hardnet": kf.HardNet(pretrained=False),
        "hynet": kf.HyNet(pretrained=False),
        "sosnet": kf.SOSNet(pretrained=False),
        "lightglue": kf.LightGlue(features=None, weights=None, input_dim=128),  # type: ignore[arg-type]
    }
    paths = {}
    for name, network in made.items():
        paths[name] = folder / f"{name}.pth"
        torch.save(network.state_dict(), paths[name])
    return paths


@pytest.mark.parametrize(
    "name", ["aliked", "disk", "xfeat", "hardnet", "hynet", "sosnet", "lightglue"]
)
def test_every_network_runs_with_weights_from_a_file(name: str, files: dict[str, Path]) -> None:
    settings = LearnedSettings(descriptor_weights=files.get(name))
    if name == "lightglue":
        settings = LearnedSettings(
            detector="disk",
            detector_weights=files["disk"],
            matcher="lightglue",
            matcher_weights=files[name],
        )
    elif name in ("aliked", "disk", "xfeat"):
        settings = LearnedSettings(detector=name, detector_weights=files[name])  # type: ignore[arg-type]
    else:
        settings = replace(settings, descriptor=name)  # type: ignore[arg-type]
    frontend = build(settings, replace(MATCH, max_keypoints=40))
    for k, pose in enumerate(flight(2)):
        seen = frontend.process(small_frame(k, pose)).observations
        assert np.isfinite(seen.z).all()
        assert ((seen.z[:, :2] >= 0) & (seen.z[:, :2] <= [239, 159])).all()


WEIGHTS: dict[str, dict[str, str]] = {
    "aliked-t16": {"detector": "aliked", "detector_weights": "aliked/aliked-t16.pth"},
    "aliked-n16": {
        "detector": "aliked",
        "aliked_model": "aliked-n16",
        "detector_weights": "aliked/aliked-n16.pth",
    },
    "keynet-affnet-mkd": {
        "detector": "keynet",
        "detector_weights": "keynet/keynet_pytorch.pth",
        "descriptor": "mkd",
        "descriptor_weights": "mkd/mkd-cart-64.pth",
        "affine_weights": "affnet/AffNet.pth",
        "orientation_weights": "affnet/OriNet.pth",
    },
}  # settings of `frontend.learned`, with files in the folder `weights` of VIO_DATA


@pytest.mark.parametrize("name", list(WEIGHTS))
def test_real_weights_track_and_match(torch: Any, data_dir: Path, name: str) -> None:
    """On the rendered wall, with known ground truth."""
    folder = data_dir / "weights"
    if not folder.is_dir():
        pytest.skip("no weights in VIO_DATA")
    options: Any = {
        k: folder / v if k.endswith("_weights") else v for k, v in WEIGHTS[name].items()
    }
    frontend = build(LearnedSettings(**options), replace(MATCH, max_keypoints=120))
    poses = flight(2)
    a, b = (frontend.process(small_frame(k, pose)).observations for k, pose in enumerate(poses))
    _, i, j = np.intersect1d(a.ids, b.ids, return_indices=True)
    assert len(i) > 0.3 * len(a)
    expected = truth(SLANTED, poses[0], a.z[i, :2], poses[1])[:, :2]
    assert np.median(np.linalg.norm(b.z[j, :2] - expected, axis=1)) < 0.08
    stereo = a.take(a.has_right)
    assert len(stereo) > 25
    assert (
        np.median(
            np.abs(stereo.z[:, 2] - truth(SLANTED, poses[0], stereo.z[:, :2], poses[0])[:, 2])
        )
        < 0.05
    )


@pytest.mark.parametrize("detector", ["gftt", "harris"])
def test_corner_positions_are_unbiased(torch: Any, detector: str) -> None:
    """White squares: the errors of the four corners cancel, so that a shift of half a pixel
    would be detected.
    """
    from vio.frontend.learned.extractors import build_extractor
    from vio.frontend.learned.weights import pick_device

    image = np.full((192, 256), 40, dtype=np.uint8)
    true = []
    for v in range(20, 170, 40):
        for u in range(20, 230, 40):
            image[v : v + 17, u : u + 17] = 200
            true += [(u + a, v + b) for a in (-0.5, 16.5) for b in (-0.5, 16.5)]
    (found,) = build_extractor(LearnedSettings(detector=detector), MATCH, pick_device("cpu"))(image)  # type: ignore[arg-type]
    gap = found.pixels[:, None] - np.array(true)
    nearest = np.abs(gap).max(axis=2).argmin(axis=0)
    offset = gap[nearest, np.arange(len(true))]
    assert np.abs(offset).max() < 1.5
    assert np.abs(offset.mean(axis=0)).max() < 0.01


# --- matching
# --------------------------------------------------------------------------------------------------


def points_of(descriptors: FloatArray) -> Keypoints:
    unit = (descriptors / np.linalg.norm(descriptors, axis=1, keepdims=True)).astype(np.float32)
    return Keypoints(np.zeros((len(unit), 2)), unit)


def matched_by_a_loop(gap: FloatArray, allowed: BoolArray, ratio: float) -> list[list[int]]:
    gap, pairs = np.where(allowed, gap, np.inf), []
    for i in range(len(gap)):
        order = np.argsort(gap[i], kind="stable")
        j = int(order[0])
        if (
            np.isfinite(gap[i, j])
            and np.argmin(gap[:, j]) == i
            and gap[i, j] <= ratio * gap[i, order[1]]
        ):
            pairs.append([i, j])
    assert len(pairs) > 5
    return pairs


def test_mutual_nearest_equals_a_loop() -> None:
    rng = np.random.default_rng(3)
    a, b = points_of(rng.normal(size=(40, 8))), points_of(rng.normal(size=(50, 8)))
    allowed = rng.random((40, 50)) < 0.5
    gap = np.linalg.norm(
        a.descriptors[:, None].astype(float) - b.descriptors[None].astype(float), axis=2
    )
    np.testing.assert_array_equal(
        MutualNearest(0.9)(a, b, allowed), matched_by_a_loop(gap, allowed, 0.9)
    )


def test_binary_descriptors_use_hamming_distance() -> None:
    """Two bytes have many equal distances, of which the first one counts."""
    rng = np.random.default_rng(4)
    a, b = (
        Keypoints(np.zeros((n, 2)), rng.integers(0, 256, (n, 2), dtype=np.uint8)) for n in (40, 50)
    )
    allowed = rng.random((40, 50)) < 0.5
    gap = np.array(
        [[sum(int(x).bit_count() for x in p ^ q) for q in b.descriptors] for p in a.descriptors],
        float,
    )
    np.testing.assert_array_equal(
        MutualNearest(1.0)(a, b, allowed), matched_by_a_loop(gap, allowed, 1.0)
    )


def test_pairs_in_a_window_equal_a_formula() -> None:
    rng = np.random.default_rng(5)
    # many at the limits
    a, b, guess = (rng.integers(0, 2 * np.array([40, 12]), (n, 2)) / 2 for n in (60, 70, 60))
    found = np.empty((60, 70), dtype=np.bool_)
    descriptors._near_either(guess, a, np.ascontiguousarray(b.T), 2.5, found)
    expected = [np.abs(centre[:, None] - b).max(axis=2) <= 2.5 for centre in (guess, a)]
    np.testing.assert_array_equal(found, expected[0] | expected[1])
    assert 0.01 < found.mean() < 0.5
    nearest = np.empty(60, dtype=np.int64)
    descriptors._nearest_point(a, b, 1.5, nearest)
    off = np.abs(a[:, None] - b).max(axis=2)
    np.testing.assert_array_equal(nearest, np.where(off.min(axis=1) <= 1.5, off.argmin(axis=1), -1))
    assert 0.1 < (nearest < 0).mean() < 0.9


# --- CUDA
# --------------------------------------------------------------------------------------------------


def test_cuda_is_warmed_up_by_a_front_end_of_its_own(
    torch: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With both kinds of matches, in images of the camera's size; without CUDA here, all runs on
    the CPU.
    """
    from vio.frontend import learned

    process, outputs = DescriptorFrontend.process, []

    def noted(self: DescriptorFrontend, frame: StereoFrame) -> Any:
        outputs.append(process(self, frame))
        return outputs[-1]

    monkeypatch.setattr(learned, "pick_device", lambda name: torch.device("cpu"))
    monkeypatch.setattr(DescriptorFrontend, "process", noted)
    frontend = build(LearnedSettings(device="cuda"))
    assert len(outputs) == 2
    assert outputs[0].matched > 20
    assert outputs[1].tracked > 20
    for kind in ("rgbd", "mono"):
        one: StereoCamera = replace(SMALL, kind=kind)
        settings = FrontendSettings(match=MATCH, learned=LearnedSettings(device="cuda"))
        learned.build_learned(one, settings)
        assert outputs[-1].tracked > 20
    assert frontend.process(small_frame(0, flight(1)[0])).observations.ids[0] == 0


def test_network_recorded_on_cuda_gives_the_same_key_points(
    torch: Any, files: dict[str, Path]
) -> None:
    """Left and right at once, in a recording of the network's calls that is made anew for
    another size.
    """
    if not torch.cuda.is_available():
        pytest.skip("no CUDA here")
    from vio.frontend.learned.extractors import _Replayed, build_extractor

    settings = LearnedSettings(detector="aliked", detector_weights=files["aliked"])
    recorded: Any = build_extractor(settings, MATCH, torch.device("cuda"))
    plain: Any = build_extractor(settings, MATCH, torch.device("cuda"))
    assert isinstance(recorded.network.extract_dense_map, _Replayed)
    plain.network.extract_dense_map = plain.network.extract_dense_map._network
    for k, width in enumerate((240, 240, 200)):
        frame = small_frame(k, flight(3)[k])
        images = [np.ascontiguousarray(image[:, :width]) for image in (frame.left, frame.right)]  # type: ignore[index]
        for a, b in zip(recorded(*images), plain(*images), strict=True):
            assert len(a) > 50
            np.testing.assert_allclose(a.pixels, b.pixels, atol=0.01)
