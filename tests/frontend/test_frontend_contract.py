"""Contract tests for every front end: properties of the observations, and behaviour on bad
input.
"""

from __future__ import annotations

import importlib.util
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from tests.frontend.test_frontend_scene import CAMERA, SLANTED, flight, stereo_frame, truth
from vio.errors import DataError
from vio.frontend import BUILDERS, FrontendSettings, build_frontend
from vio.frontend.klt import KltFrontend
from vio.frontend.precomputed import PrecomputedFrontend
from vio.frontend.settings import GridSettings, LearnedSettings, MatchSettings
from vio.geometry.stereo import StereoCamera
from vio.guard.guarded import guarded
from vio.protocols import Frontend
from vio.records import FrontendOutput, Observations, StereoFrame, observations
from vio.sim.motion import hand_held
from vio.sim.oracle import OracleFrontend, OracleSettings
from vio.sim.rigs import small_rig
from vio.sim.sequence import simulate
from vio.sim.world import room

POSES = flight(5)
FRAMES = [stereo_frame(k, pose) for k, pose in enumerate(POSES)]
SETTINGS = FrontendSettings(
    grid=GridSettings(target_features=200),
    match=MatchSettings(max_keypoints=400),
    learned=LearnedSettings(detector="gftt", descriptor="sift"),
)
needs_torch = pytest.mark.skipif(
    importlib.util.find_spec("kornia") is None or importlib.util.find_spec("torch") is None,
    reason="torch and kornia are not installed: the extra learned",
)
IMAGE_BASED = ["klt", "orb", "sift", pytest.param("kornia", marks=needs_torch)]
ALL = [*IMAGE_BASED, "precomputed", "oracle"]


class _NoDataset:
    """A dataset without observations: image-based front ends do not use it."""

    def observations(self, index: int) -> Observations | None:
        return None


def make(name: str, camera: StereoCamera = CAMERA) -> Frontend:
    if name == "oracle":
        simulation = simulate(
            room(seed=1), small_rig(320, 180), hand_held(duration_s=3.0), rate_hz=10.0
        )
        return OracleFrontend(
            simulation, OracleSettings(max_features=60, left_only_fraction=0.1), seed=2
        )
    if name == "precomputed":
        klt = KltFrontend(CAMERA, SETTINGS)
        rows = [klt.process(frame).observations for frame in FRAMES]
        return PrecomputedFrontend(lambda index: rows[index])
    settings = SETTINGS
    if name == "kornia":  # its descriptors take a millisecond each
        settings = replace(SETTINGS, match=replace(SETTINGS.match, max_keypoints=200))
    return build_frontend(name, camera, settings, _NoDataset())  # type: ignore[arg-type]


def run(
    name: str, frames: list[StereoFrame], camera: StereoCamera = CAMERA
) -> list[FrontendOutput]:
    frontend = guarded(make(name, camera), camera)
    return [frontend.process(frame) for frame in frames]


@pytest.fixture(scope="module")
def ran() -> Callable[[str], list[FrontendOutput]]:
    """Outputs of a front end on the plain frames, computed once."""
    made: dict[str, list[FrontendOutput]] = {}

    def outputs(name: str) -> list[FrontendOutput]:
        if name not in made:
            made[name] = run(name, FRAMES)
        return made[name]

    return outputs


Ran = Callable[[str], list[FrontendOutput]]


def test_suite_covers_every_front_end() -> None:
    assert set(BUILDERS) | {"oracle"} == {"klt", "orb", "sift", "kornia", "precomputed", "oracle"}


@pytest.mark.parametrize("name", ALL)
def test_observations_fulfil_the_contract(name: str, ran: Ran) -> None:
    newest = -1
    for k, output in enumerate(ran(name)):
        seen = output.observations
        assert seen.frame_index == k
        assert len(seen) > 20
        assert seen.ids.dtype == np.int64
        assert len(np.unique(seen.ids)) == len(seen)
        assert seen.z.shape == (len(seen), 4)
        assert np.isfinite(seen.z[:, :2]).all()
        assert np.isfinite(seen.z[seen.has_right]).all()
        stereo = seen.z[seen.has_right]
        assert (
            (stereo[:, 0] > stereo[:, 2]).all() or name == "oracle"
        )  # the oracle's noise may make the disparity of far points negative
        assert not seen.stale.any()
        assert output.tracked + output.detected == len(seen)
        assert output.matched == seen.has_right.sum()
        assert (seen.ids > newest).sum() == output.detected
        assert all(ms >= 0 for ms in output.stages_ms.values())
        newest = max(newest, int(seen.ids.max()))


@pytest.mark.parametrize("name", ALL)
def test_equal_input_gives_identical_output(name: str, ran: Ran) -> None:
    for a, b in zip(ran(name), run(name, FRAMES), strict=True):
        np.testing.assert_array_equal(a.observations.ids, b.observations.ids)
        np.testing.assert_array_equal(a.observations.z, b.observations.z)
        np.testing.assert_array_equal(a.observations.has_right, b.observations.has_right)


@pytest.mark.parametrize("name", IMAGE_BASED)
def test_tracks_and_disparities_are_accurate(name: str, ran: Ran) -> None:
    outputs = ran(name)
    temporal, disparity, rows = [], [], []
    for k, pose in enumerate(POSES):
        seen = outputs[k].observations
        stereo = seen.take(seen.has_right)
        disparity.append(stereo.z[:, 2] - truth(SLANTED, pose, stereo.z[:, :2], pose)[:, 2])
        rows.append(stereo.z[:, 3] - stereo.z[:, 1])
        if k + 1 < len(POSES):
            later = outputs[k + 1].observations
            _, i, j = np.intersect1d(seen.ids, later.ids, return_indices=True)
            expected = truth(SLANTED, pose, seen.z[i, :2], POSES[k + 1])[:, :2]
            temporal.append(np.linalg.norm(later.z[j, :2] - expected, axis=1))
    assert len(np.concatenate(temporal)) > 100
    assert np.median(np.concatenate(temporal)) < 0.08
    assert np.mean(np.concatenate(temporal) > 1) < 0.01
    assert np.median(np.abs(np.concatenate(disparity))) < 0.05
    assert np.mean(np.abs(np.concatenate(disparity)) > 1) < 0.02
    assert np.median(np.abs(np.concatenate(rows))) < 0.05
    assert np.mean(np.abs(np.concatenate(rows)) > 1) < 0.02


@pytest.mark.parametrize("name", IMAGE_BASED)
@pytest.mark.parametrize("level", [0, 255])
def test_black_and_saturated_images_give_no_features(name: str, level: int, ran: Ran) -> None:
    """Afterwards there are features again; features with old ids are the same points."""
    flat = np.full((300, 480), level, dtype=np.uint8)
    no_contrast = StereoFrame(1, FRAMES[1].time_ns, flat, flat)
    outputs = run(name, [FRAMES[0], no_contrast, *FRAMES[2:4]])
    assert len(outputs[0].observations) > 50
    assert len(outputs[1].observations) == 0
    assert outputs[1].observations.z.shape == (0, 4)
    assert len(outputs[2].observations) > 50
    first, later = outputs[0].observations, outputs[2].observations
    _, a, b = np.intersect1d(first.ids, later.ids, return_indices=True)
    assert len(a) > 0.5 * len(first)
    expected = truth(SLANTED, POSES[0], first.z[a, :2], POSES[2])[:, :2]
    assert np.mean(np.linalg.norm(later.z[b, :2] - expected, axis=1) > 1) < 0.02


@pytest.mark.parametrize("name", IMAGE_BASED)
@pytest.mark.parametrize("side", ["left", "right"])
def test_frozen_camera_gives_few_stereo_matches(name: str, side: str, ran: Ran) -> None:
    """One camera repeats its first image while the image motion is at least 2 px per frame."""
    first = {side: getattr(FRAMES[0], side)}
    frozen = [FRAMES[0], *(replace(frame, **first) for frame in FRAMES[1:])]
    outputs = run(name, frozen)
    assert outputs[-1].matched < 0.35 * outputs[0].matched


@pytest.mark.parametrize("name", IMAGE_BASED)
def test_rejects_colour_and_16_bit_images(name: str) -> None:
    gray = np.zeros((300, 480), dtype=np.uint8)
    for image in (
        np.zeros((300, 480, 3), dtype=np.uint8),
        gray.astype(np.uint16),
        gray.astype(np.float32),
    ):
        with pytest.raises(DataError, match=r"frame 7: the left image .* needs 8-bit gray images"):
            make(name).process(StereoFrame(7, 0, image, gray))  # type: ignore[arg-type]


@pytest.mark.parametrize("name", IMAGE_BASED)
def test_rejects_frames_without_images_or_out_of_order(name: str) -> None:
    with pytest.raises(DataError, match=f"frame 3 has no images, but the {name} front end"):
        make(name).process(StereoFrame(3, 0, None, None))
    frontend = make(name)
    frontend.process(FRAMES[1])
    with pytest.raises(DataError, match="frame 0 is not later than frame 1"):
        frontend.process(FRAMES[0])


@pytest.mark.parametrize("name", IMAGE_BASED)
@pytest.mark.parametrize(("width", "height"), [(479, 299), (127, 95), (33, 21), (8, 5)])
def test_odd_and_tiny_sizes_work(name: str, width: int, height: int) -> None:
    camera = replace(CAMERA, cu=width / 2, cv=height / 2, width=width, height=height)
    frames = []
    for frame in FRAMES[:2]:
        u, v = (480 - width) // 2, (300 - height) // 2
        pair = [
            np.ascontiguousarray(image[v : v + height, u : u + width])
            for image in (frame.left, frame.right)
        ]
        frames.append(replace(frame, left=pair[0], right=pair[1]))
    outputs = run(name, frames, camera)
    if width > 400:
        assert outputs[1].tracked > 50
    for output in outputs:
        z = output.observations.z
        assert ((z[:, :2] >= 0) & (z[:, :2] <= [width - 1, height - 1])).all()


@pytest.mark.parametrize("name", ["precomputed"])
def test_empty_observations_pass_through(name: str) -> None:
    empty = observations(0, 0, [], np.zeros((0, 4)))
    output = PrecomputedFrontend(lambda index: empty).process(FRAMES[0])
    assert (output.tracked, output.matched, output.detected) == (0, 0, 0)
