"""Images that are scaled, stretched or cropped otherwise from a frame on."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from vio.findings import Finding
from vio.geometry.lie import FloatArray, se3_exp, se3_inverse, transform_points
from vio.geometry.stereo import StereoCamera, project
from vio.monitor.image_geometry import ImageGeometry, _between
from vio.records import Observations, observations

CAMERA = StereoCamera(400, 400, 320, 240, 0.1, width=640, height=480)
STEP_NS = 50_000_000
COUNT = 150
TURN = np.array([0.03, 0.01, 0.05, 0.01, 0.03, 0.02])  # of the camera, a frame: m and rad
NONE = (1.0, 1.0, 0.0, 0.0)  # factors of columns and rows, shifts


def _points(seed: int, near_m: float, far_m: float, count: int = COUNT) -> FloatArray:
    rng = np.random.default_rng(seed)
    rays = rng.uniform([-0.5, -0.4], [0.5, 0.4], (count, 2))
    depth = rng.uniform(near_m, far_m, (count, 1))
    return np.concatenate([rays * depth, depth], axis=1)


def _frame(
    k: int,
    p: FloatArray,
    geometry: tuple[float, ...] = NONE,
    step: FloatArray = TURN,
    sigma_px: float = 0.15,
    disparity_off_px: float = 0.0,
    kept: float = 1.0,
) -> Observations:
    """Frame k of a camera that moves among points (N, 3), in images of some geometry."""
    rng = np.random.default_rng(k)
    z = project(CAMERA, transform_points(se3_inverse(se3_exp(k * step)), p))
    columns, rows, right_px, down_px = geometry
    z[:, ::2] = CAMERA.cu + columns * (z[:, ::2] - CAMERA.cu) + right_px
    z[:, 1::2] = CAMERA.cv + rows * (z[:, 1::2] - CAMERA.cv) + down_px
    z += rng.normal(0.0, sigma_px, z.shape)
    z[:, 2] -= disparity_off_px
    ids = np.arange(round(kept * len(p)))
    return observations(k, k * STEP_NS, ids, z[ids])


def _found(
    frames: list[Observations], ratio: float | None = 3.0, camera: StereoCamera = CAMERA
) -> list[Finding]:
    check = ImageGeometry(camera)
    return [finding for seen in frames for finding in check.frame(seen, ratio)]


SCENE = _points(1, 2.0, 8.0)
CHANGES = (
    (0.97, 0.97, 0.0, 0.0),
    (1.02, 1.02, 0.0, 0.0),
    (1.0, 0.97, 0.0, 0.0),
    (0.97, 1.0, 0.0, 0.0),
    (1.0, 1.0, 8.0, 0.0),
    (1.0, 1.0, 0.0, -8.0),
    (0.95, 0.95, 12.0, 9.0),
)


@pytest.mark.parametrize("change", CHANGES)
def test_another_geometry_is_found_with_its_figures(change: tuple[float, ...]) -> None:
    found = _found([_frame(k, SCENE, change if k >= 4 else NONE) for k in range(8)])
    assert [(f.code, f.frame, f.lasts) for f in found] == [("image-geometry-changed", 4, True)]
    figures = found[0].figures
    factors = [figures["columns_factor"], figures["rows_factor"]]
    shifts = [figures["right_px"], figures["down_px"]]
    np.testing.assert_allclose(factors, change[:2], atol=0.003)
    np.testing.assert_allclose(shifts, change[2:], atol=1.5)


@pytest.mark.parametrize("change", CHANGES)
def test_images_that_are_as_before_again_end_it(change: tuple[float, ...]) -> None:
    found = _found([_frame(k, SCENE, change if 3 <= k < 6 else NONE) for k in range(9)])
    assert [(f.frame, f.ended) for f in found] == [(3, False), (6, True)]


@pytest.mark.parametrize("change", CHANGES)
def test_a_change_of_one_frame_ends_in_the_next(change: tuple[float, ...]) -> None:
    """Which is found also where the filter has left its features out."""
    frames = [_frame(k, SCENE, change if k == 4 else NONE) for k in range(9)]
    check = ImageGeometry(CAMERA)
    found = [f for k, seen in enumerate(frames) for f in check.frame(seen, 3.0 if k < 5 else 1.0)]
    assert [(f.frame, f.ended) for f in found] == [(4, False), (5, True)]


def test_a_zoom_of_several_frames_has_not_ended_before_it_is_back() -> None:
    there = [1.0, 1.0, 1.0, 1.02, 1.04, 1.06]
    factors = [*there, 1.06, 1.06, *reversed(there)]
    found = _found([_frame(k, SCENE, (s, s, 0.0, 0.0)) for k, s in enumerate(factors)])
    assert [(f.frame, f.ended) for f in found] == [(3, False), (11, True)]


@pytest.mark.parametrize(("factor", "named"), [(0.9, True), (0.975, False)])
def test_a_large_change_is_known_well_enough_where_pixels_are_bad(
    factor: float, named: bool
) -> None:
    frames = [
        _frame(k, SCENE[:60], (factor, factor, 0.0, 0.0) if k >= 4 else NONE, sigma_px=0.7)
        for k in range(8)
    ]
    assert bool(_found(frames)) == named


def test_a_second_change_is_the_same_event() -> None:
    factors = (1.0, 1.0, 0.97, 0.97, 0.9, 0.9)
    frames = [_frame(k, SCENE, (s, s, 0.0, 0.0)) for k, s in enumerate(factors)]
    assert [f.frame for f in _found(frames)] == [2]


# (growth, shift) that a healthy rig's noise may come to are below the limits
@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize(
    ("step", "far_m", "disparity_off_px"),
    [
        (TURN, 8.0, 0.0),
        (4.0 * TURN, 8.0, 0.0),
        (np.array([0.0, 0.0, 0.4, 0.0, 0.0, 0.0]), 30.0, 0.7),  # ahead, disparities off
        (np.zeros(6), 8.0, 0.0),
    ],
)
def test_the_motion_of_a_rig_is_none(
    seed: int, step: FloatArray, far_m: float, disparity_off_px: float
) -> None:
    p = _points(seed, 2.5, far_m)
    frames = [
        _frame(k, p, step=step, sigma_px=0.3, disparity_off_px=disparity_off_px) for k in range(5)
    ]
    assert _found(frames) == []


def test_what_a_wrong_calibration_shows_in_each_pair_of_frames_is_none() -> None:
    ahead = np.array([0.0, 0.0, 0.4, 0.0, 0.0, 0.0])
    p = _points(1, 3.0, 12.0)
    frames = [_frame(k, p, step=ahead, disparity_off_px=2.5) for k in range(6)]
    for k in (1, 2):
        change = _between(CAMERA, *frames[k : k + 2])
        assert change is not None
        assert change.is_clear  # control: by itself, each pair shows a change
    assert _found(frames[1:]) == []
    changed = [_frame(5, p, CHANGES[0], step=ahead, disparity_off_px=2.5)]
    assert [f.frame for f in _found(frames[:5] + changed)] == [5]


@pytest.mark.parametrize("share", [0.2, 0.4])
def test_an_object_that_moves_is_none(share: float) -> None:
    count = round(share * COUNT)
    scene = SCENE[count:]
    frames = []
    for k in range(6):
        carried = transform_points(se3_exp(k * np.array([0.1, 0, 0, 0, 0, 0])), SCENE[:count])
        frames.append(_frame(k, np.concatenate([scene, carried])))
    assert _found(frames) == []


def test_it_is_looked_for_where_features_are_off_or_lost() -> None:
    change = CHANGES[0]
    few = [
        _frame(k, SCENE, change if k == 4 else NONE, kept=0.6 if k == 4 else 1) for k in range(5)
    ]
    many = [_frame(k, SCENE, change if k == 4 else NONE) for k in range(5)]
    assert [f.frame for f in _found(many, 2.0)] == [4]
    assert _found(many, 1.9) == []
    assert _found(many, None) == []
    assert [f.frame for f in _found(few, 1.0)] == [4]


@pytest.mark.parametrize("change", [(1.0, 1.0, 24.0, 0.0), (1.0, 1.0, 0.0, -24.0)])
def test_a_shift_is_known_where_depths_are_alike_and_a_scale_would_do_as_well(
    change: tuple[float, ...],
) -> None:
    p = _points(2, 1.9, 2.3, 60)
    frames = [_frame(k, p, change if k >= 4 else NONE) for k in range(6)]
    free = _between(CAMERA, *frames[3:5])
    assert free is not None
    assert not free.known.all()  # control: not by all that may have changed
    found = _found(frames)
    assert [f.frame for f in found] == [4]
    shifts = [found[0].figures["right_px"], found[0].figures["down_px"]]
    np.testing.assert_allclose(shifts, change[2:], atol=3.0)


def test_too_few_features_and_one_camera_do_not_tell() -> None:
    change = CHANGES[0]
    for count, found in ((30, 1), (29, 0)):
        p = _points(3, 2.0, 8.0, count)
        frames = [_frame(k, p, change if k == 4 else NONE) for k in range(5)]
        assert len(_found(frames)) == found
    frames = [_frame(k, SCENE, change if k == 4 else NONE) for k in range(5)]
    assert _found(frames, camera=replace(CAMERA, kind="mono")) == []


@pytest.mark.parametrize(
    ("change", "named"),
    [
        ((0.997, 0.997, 0.0, 0.0), False),
        ((0.991, 0.991, 0.0, 0.0), True),
        ((1.0, 1.0, 2.5, 0.0), False),
        ((1.0, 1.0, 5.0, 0.0), True),
        ((1.0, 1.0, 0.0, 2.5), False),
        ((1.0, 1.0, 0.0, 5.0), True),
    ],
)
def test_small_changes_are_left_to_the_noise(change: tuple[float, ...], named: bool) -> None:
    frames = [_frame(k, SCENE, change if k >= 3 else NONE, sigma_px=0.05) for k in range(6)]
    assert bool(_found(frames)) == named


def test_few_features_that_scatter_show_nothing() -> None:
    """As of a lens that fogs, or water that ripples."""
    for seed in range(20):
        p = _points(seed, 2.0, 8.0, 30)
        assert _found([_frame(k, p, sigma_px=1.0) for k in range(4)]) == []


@pytest.mark.parametrize(("sigma_px", "named"), [(0.15, True), (1.5, False)])
def test_a_change_that_is_not_known_well_is_not_named(sigma_px: float, named: bool) -> None:
    """As of features among which wrong ones were left."""
    p = _points(1, 2.0, 8.0, 60)
    change = (0.9, 0.9, 0.0, 0.0)
    frames = [_frame(k, p, change if k >= 3 else NONE, sigma_px=sigma_px) for k in range(4)]
    assert bool(_found(frames)) == named


def _turned_past_an_object(seed: int, shift_px: float) -> list[Observations]:
    """Two frames at rest, and one after a fast turn in which an object has moved, and the images
    are shifted.
    """
    rng = np.random.default_rng(seed)
    p = _points(seed, 2.0, 8.0, 300)
    step = np.concatenate([0.1 * rng.normal(size=3), 0.3 * rng.normal(size=3) / np.sqrt(3.0)])
    turned = _frame(1, p, step=step)
    z = turned.z.copy()
    moved = np.abs(z[:, 0] - rng.uniform(0.0, 640.0)) < 100.0
    z[moved, :3] += np.array([8.0, 1.0, 10.0])
    z[:, ::2] += shift_px
    seen = np.all((z[:, :2] > 0.0) & (z[:, :2] < [640.0, 480.0]), axis=1)
    still = [_frame(k, p, step=np.zeros(6)) for k in range(2)]
    return [*still, observations(2, 2 * STEP_NS, turned.ids[seen], z[seen])]


@pytest.mark.parametrize("seed", [6, 19, 20, 24, 58, 60])
def test_a_change_that_explains_pixels_no_better_than_none_is_none(seed: int) -> None:
    assert _found(_turned_past_an_object(seed, 0.0)) == []
    assert len(_found(_turned_past_an_object(seed, 24.0))) == 1  # control
