"""Each limit of consensus motions, of matches along rows and of what is tried again, from both sides."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest

from tests.frontend.test_frontend_scene import CAMERA
from tests.frontend.test_new_limits import _tracks
from vio.frontend import anchor_fit, flow, moving_object, outliers, right_alone, stereo_fit
from vio.frontend.anchor_fit import AnchorFit
from vio.frontend.columns import changed
from vio.frontend.descriptors import DescriptorFrontend, KeypointFlow, _near_guess
from vio.frontend.given_corners import given_corners
from vio.frontend.keypoints import Keypoints, MutualNearest
from vio.frontend.moving_object import TwoMotions, voters
from vio.frontend.one_camera import disparities
from vio.frontend.outliers import Consensus, RansacProblem, bearing_consensus, rigid_consensus
from vio.frontend.patches import ImageLevels
from vio.frontend.reappearance import motion_across
from vio.frontend.right_alone import RightAlone
from vio.frontend.right_match import RightMatcher
from vio.frontend.settings import DisparitySettings, FrontendSettings, GridSettings
from vio.frontend.stereo_fit import StereoFit
from vio.frontend.stereo_match import EpipolarRowModel
from vio.frontend.tracks import AnchorBank, Tracks, new_tracks
from vio.geometry.lie import FloatArray, se3_exp, so3_exp, transform_points
from vio.geometry.stereo import StereoCamera, project
from vio.records import Image, StereoFrame

Says = Callable[[float], bool]
WIDTH, HEIGHT = 480, 300
STILL = np.eye(4)
MOTION = se3_exp([0.1, 0.0, -0.2, 0.0, 0.02, 0.0])
OTHER = se3_exp([-0.4, 0.1, 0.1, 0.0, -0.03, 0.02])


def _problem(seed: int = 0, limit_px: float = 1.0) -> RansacProblem:
    return RansacProblem(CAMERA, limit_px, np.random.default_rng(seed))


def _points(count: int) -> FloatArray:
    return np.random.default_rng(1).uniform([-2.0, -1.5, 3.0], [2.0, 1.5, 8.0], (count, 3))


def _pixels(motion: FloatArray, p: FloatArray) -> FloatArray:
    return np.asarray(project(CAMERA, transform_points(motion, p))[:, :2])


def _seen(p: FloatArray, right: int) -> FloatArray:
    """Pixels of points of which the first ones move with the camera, the others at random."""
    z = _pixels(MOTION, p)
    rng = np.random.default_rng(2)
    z[right:] = rng.uniform([0.0, 0.0], [WIDTH, HEIGHT], (len(p) - right, 2))
    return z


# The consensus


def _overruled(share: float) -> bool:
    """Whether a prior motion replaces the consensus of 100 points where so many follow it."""
    second = round(100 * share)
    p = _points(100 + second)
    z = _pixels(MOTION, p)
    z[100:] = _pixels(OTHER, p[100:])
    found = rigid_consensus(_problem(), p, z, MOTION, None, OTHER)
    return found is not None and not found.inliers[:50].any()


def _consensus(right: int, count: int) -> bool:
    p = _points(count)
    return rigid_consensus(_problem(), p, _seen(p, right), MOTION, None, None) is not None


class _AskedError(Exception):
    """A random number was asked for."""


def _is_sure(share: float) -> bool:
    """Whether no random sets are tried of points of which a share follows the expected motion."""

    def asked(*_: object, **__: object) -> None:
        raise _AskedError

    p = _points(200)
    rng: Any = SimpleNamespace(integers=asked)
    try:
        rigid_consensus(
            RansacProblem(CAMERA, 1.0, rng), p, _seen(p, round(200 * share)), MOTION, None, None
        )
    except _AskedError:
        return False
    return True


def _fails(right: float) -> float:
    """Probability that no random set is of points alone that follow one motion, a share of all."""
    sets: list[int] = []

    def drawn(low: int, high: int, size: tuple[int, int]) -> Any:
        sets.append(size[0])
        raise _AskedError

    p = _points(50)
    rng: Any = SimpleNamespace(integers=drawn)
    with pytest.raises(_AskedError):
        rigid_consensus(RansacProblem(CAMERA, 1.0, rng), p, _seen(p, 20), STILL, None, None)
    return float((1.0 - right**3) ** sets[0])


def _tries_prior(deg: float) -> bool:
    p = _points(50)
    turned = so3_exp([0.0, np.radians(deg), 0.0])
    return bool(
        outliers._prior_candidates(_problem(), p, _pixels(STILL, p), STILL, STILL, turned, None)
    )


def _represents(count: int) -> bool:
    """Whether a motion fits that every other pixel of so many follows."""
    p = _points(count)
    z = _pixels(MOTION, p)
    z[1::2] += 40.0 * np.random.default_rng(0).choice([-1.0, 1.0], z[1::2].shape)
    return outliers.predicted_motion(CAMERA, p, z, MOTION) is MOTION


def _differ(px: float) -> bool:
    p = np.tile([0.0, 0.0, 5.0], (20, 1))
    moved = np.eye(4)
    moved[0, 3] = px * 5.0 / CAMERA.fu
    return not outliers._motions_agree(CAMERA, STILL, moved, p)


def _bearing(share: float, R: FloatArray | None = None) -> bool:
    p = _points(200)
    seen = _seen(p, round(200 * share))
    found = bearing_consensus(_problem(), _pixels(STILL, p), seen, MOTION[:3, :3], R)
    return found is not None


def _turns_only(share: float) -> bool:
    """Whether no other rotation than the prior is tried, which a share of the features follows."""

    def asked(*_: object) -> None:
        raise _AskedError

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(outliers, "_five_point", asked)
        try:
            return _bearing(share, MOTION[:3, :3])
        except _AskedError:
            return False


def _forward(cosine: float) -> bool:
    """Whether rays so far off the axis of a cylinder pass for a pinhole's."""
    camera = StereoCamera(300.0, 300.0, 240.0, 150.0, 0.2, 480, 300, projection="cylinder")
    pixels = np.array([[240.0, 150.0 + 300.0 * np.arccos(cosine)]])
    return len(outliers._pinhole_pixels(camera, pixels, pixels)[0]) > 0


CONSENSUS: dict[str, tuple[Says, float, float]] = {
    "overruled by a prior": (_overruled, 0.37, 0.43),
    "points": (lambda n: _consensus(int(n), int(n)), 7, 8),
    "share": (lambda x: _consensus(round(200 * x), 200), 0.17, 0.23),
    "sets": (lambda x: _fails(x) < 0.01, 0.34, 0.38),
    "sure": (_is_sure, 0.66, 0.74),
    "prior: rotation": (_tries_prior, 0.85, 1.15),
    "prior: pixels that are used": (lambda n: _represents(int(n)), 126, 128),
    "prior: pixels": (_differ, 1.7, 2.3),
    "bearings: share": (_bearing, 0.44, 0.56),
    "bearings: sure": (_turns_only, 0.86, 0.94),
    "bearings: forward": (_forward, 0.46, 0.54),
}


# Objects


def _told(ratio: float) -> bool:
    """Whether the nearer of two motions is taken where a sensor agrees with neither, and the other
    is further from it by a ratio.
    """
    case: Any = SimpleNamespace(
        found=Consensus(STILL, np.ones(9, np.bool_)),
        expected=SimpleNamespace(distance=lambda *_: 100.0 * ratio),
        prior=object(),
        measured=True,
        in_event=False,
        others=np.arange(0),
        p_prev=np.zeros((9, 3)),
    )
    second: Any = SimpleNamespace(
        exists=True, object_share=0.3, T=STILL, support=np.zeros(0, np.int64)
    )
    first = moving_object._First(100.0, contradicted=True)
    return moving_object._predicted_motion(case, first, second).decision == "predicted"


def _needed(inliers: int) -> float:
    """Points that a second motion needs beside so many of the first."""
    found = Consensus(STILL, np.ones(inliers, np.bool_))
    nothing: Any = None
    case = moving_object._Case(nothing, nothing, nothing, found, nothing, nothing, False)
    return case.min_support


def _follows_slow(ratio: float) -> bool:
    """Whether points are freed of others whose errors are so many times as large."""
    old = np.arange(140) < 100
    errors = np.where(old, 1.0, ratio)
    expected: Any = SimpleNamespace(
        distance=lambda *_: 0.0, prior=SimpleNamespace(T_curr_prev=STILL)
    )
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(moving_object, "best_motion", lambda *_: (STILL, old))
        patch.setattr(moving_object, "pixel_errors", lambda *_: errors)
        freed = moving_object._without_slow_object(
            _problem(limit_px=99.0),
            np.zeros((140, 3)),
            np.zeros((140, 2)),
            Consensus(STILL, np.ones(140, np.bool_)),
            expected,
            old,
        )
    return freed is not None


def _static(share: float) -> bool:
    """Whether a motion is kept of whose points a measured one explains a share."""
    explained = np.arange(100) < round(100 * share)
    kept = np.ones(100, np.bool_)
    nothing: Any = None
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(moving_object, "_agree_with", lambda *_: explained)
        found = moving_object.static_by_prediction(
            _problem(), np.zeros((100, 2)), np.zeros((100, 2)), kept, nothing, 0.1
        )
    return found is kept


def _is_object(off: float) -> bool:
    """Whether three of ten points are an object where a share of all fits no depth."""
    chosen = TwoMotions(Consensus(STILL, np.arange(100) < 70), 0.3, "voted")
    fits = np.arange(100) >= round(100 * off)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(moving_object, "bearing_consensus", lambda *_: fits)
        patch.setattr(moving_object, "_within_depths", lambda *_: np.ones(100, np.bool_))
        return not moving_object.one_motion_explains(
            _problem(), chosen, _points(100), np.zeros((100, 2)), 0.1
        )


OBJECTS: dict[str, tuple[Says, float, float]] = {
    "clearly nearer": (_told, 8.7, 11.3),
    "support": (lambda n: _needed(int(n)) > 12.0, 115, 125),
    "slow": (_follows_slow, 2.9, 3.5),
    "static": (_static, 0.75, 0.85),
    "seen": (_is_object, 0.13, 0.17),
    "voters": (lambda n: voters(np.arange(200)).sum() < n, 44, 56),
    "voters: frames": (lambda n: voters(np.full(20, int(n))).any(), 4, 5),
}


# Flow


def _attempts(lost: float, trusted: bool) -> int:
    """How often points are tracked of which a share is lost each time."""
    calls: list[int] = []

    def track(last: object, view: object, points: FloatArray, *_: object, **__: object) -> Any:
        calls.append(len(points))
        good = np.arange(len(points)) >= round(lost * len(points))
        return points.copy(), good

    points = np.zeros((100, 2))
    images = ImageLevels(np.zeros((2, 2), np.uint8), np.zeros((2, 2), np.uint8))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(flow, "_track_forward_backward", track)
        flow.track_with_retries(images.half, images, points, points, trusted, 3)
    return len(calls)


def _levels(given: int) -> int:
    """Pyramid levels of the first attempt where the guess is trusted."""
    used: list[int] = []

    def track(*arguments: Any, **_: object) -> Any:
        used.append(arguments[4])
        return np.zeros((4, 2)), np.ones(4, np.bool_)

    images = ImageLevels(np.zeros((2, 2), np.uint8), np.zeros((2, 2), np.uint8))
    points = np.zeros((4, 2))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(flow, "_track_forward_backward", track)
        flow.track_with_retries(images.half, images, points, points, True, given)
    return used[0]


def _gray(contrast: float, mean: float = 128.0) -> Image:
    """Two gray levels at random, of a contrast."""
    signs = np.sign(np.random.default_rng(0).normal(size=(200, 200)))
    return np.rint(mean + contrast * (signs - signs[::4, ::4].mean())).astype(np.uint8)


def _faint(contrast: float) -> Image:
    """Levels 127, 128 and 129, the outer ones as often as makes a contrast below one, or pairs of
    levels.
    """
    rng = np.random.default_rng(0)
    step = 1 if contrast < 1.0 else 2
    share = (contrast / step) ** 2
    return (128 + step * (rng.random((400, 400)) < share) * rng.choice([-1, 1], (400, 400))).astype(
        np.uint8
    )


def _gain_of_faint(contrast: float) -> float:
    """Gain of an image that is matched to one of contrast 40, where it is allowed to be large."""
    image = _faint(contrast)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(flow, "_FLOW", replace(flow._FLOW, max_gain=99.0))
        out = flow.match_brightness(image, _gray(40.0))
    return float(out.std()) / float(image.std())


def _is_adjusted(contrast: float = 40.0, mean: float = 128.0) -> bool:
    image = _gray(40.0)
    return flow.match_brightness(image, _gray(contrast, mean)) is not image


def _gained(ratio: float) -> float:
    return float(flow.match_brightness(_gray(10.0), _gray(10.0 * ratio)).std())


def _consistent(back_px: float) -> bool:
    """Whether a point is kept whose way back ends so far from where it began."""

    def one_way(source: object, target: object, points: FloatArray, *_: object) -> Any:
        there = points[0, 0] == 100.0
        return points + np.array([5.0 if there else -5.0 + back_px, 0.0]), np.ones(1, np.bool_)

    image = np.zeros((HEIGHT, WIDTH), np.uint8)
    points = np.array([[100.0, 100.0]])
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(flow, "_flow", one_way)
        found = flow._track_forward_backward(
            image, ImageLevels(image, image), points, points, 3, trusted=False
        )
    return bool(found[1][0])


def _is_found_beside(half_px: int) -> bool:
    """Whether a point is found beside which all structure is so far, pixels at half resolution."""
    texture = np.random.default_rng(0).integers(0, 255, (60, 80))
    images = []
    for shift in (0, 1):
        image = np.full((60, 80), 128)
        image[:, 40 + half_px + shift :] = texture[:, : 40 - half_px - shift]
        images.append(image.astype(np.uint8))
    point = np.array([[80.0, 60.0]])
    return bool(flow._flow(images[0], images[1], point, point, 0)[1][0])


FLOW: dict[str, tuple[Says, float, float]] = {
    "again": (lambda x: _attempts(x, True) > 1, 0.22, 0.28),
    "again: last": (lambda x: _attempts(x, False) > 1, 0.45, 0.55),
    "levels": (lambda n: _levels(int(n)) < n, 1, 2),
    "faint": (lambda x: _gain_of_faint(x) * x > 39.0, 0.8, 1.2),
    "contrast": (lambda x: _is_adjusted(40.0 * (1.0 + x)), 0.045, 0.08),
    "brightness": (lambda x: _is_adjusted(mean=128.0 + x), 5, 7),
    "gain": (lambda x: _gained(x) == _gained(9.0), 3.5, 4.5),
    "forth and back": (lambda x: not _consistent(x), 1.3, 1.7),
    "window": (lambda n: not _is_found_beside(int(n)), 5, 7),
}


# Key points


def _across(right: float = 1.0, count: int = 100, depths: float = 1.0, off_px: float = 0.0) -> bool:
    """Whether key points of two pairs show a motion: a share of them follows it, and of those a
    share has a disparity that is off by no more than `off_px`.
    """
    p = _points(count)
    before = project(CAMERA, p)
    now = project(CAMERA, transform_points(MOTION, p))
    wrong = np.arange(count) >= round(right * count)
    now[wrong, :2] = np.random.default_rng(3).uniform([0, 0], [WIDTH, HEIGHT], (wrong.sum(), 2))
    off = np.where(np.arange(count) < round(depths * count), off_px, 20.0)

    def search(left: object, other: object, pixels: FloatArray) -> Any:
        z = before if left == "before" else now
        rows = [int(np.argmin(np.abs(z[:, :2] - pixel).sum(axis=1))) for pixel in pixels]
        d = z[rows, 0] - z[rows, 2]
        return d + (0.0 if left == "before" else off[rows]), np.ones(len(rows), np.bool_)

    class Points:
        def __init__(self, pixels: FloatArray) -> None:
            self.pixels = pixels

        def __len__(self) -> int:
            return len(self.pixels)

    def matched(*_: object) -> Any:
        return np.column_stack([np.arange(count)] * 2)

    stereo: Any = SimpleNamespace(search=search)
    levels: Any = {
        name: SimpleNamespace(full=None, half=name) for name in ("before", "left", "right")
    }
    previous: Any = SimpleNamespace(left=levels["before"], right_half="other")
    with pytest.MonkeyPatch.context() as patch:
        found = [Points(before[:, :2]), Points(now[:, :2])]
        patch.setattr("vio.frontend.keypoints.sift_extractor", lambda *_: lambda *__: found)
        patch.setattr("vio.frontend.keypoints.MutualNearest", lambda: matched)
        motion = motion_across(
            _problem(), stereo, previous, levels["left"], levels["right"], np.stack([MOTION])
        )
    return motion is not None


def _searched(px: float) -> bool:
    """Whether a key point is near a feature in an image of 500 pixels."""
    corner = np.zeros((1, 2))
    return bool(_near_guess(corner, corner, np.array([[px, 0.0]]), 500)[0, 0])


def _blobs() -> FloatArray:
    noise = np.random.default_rng(0).normal(size=(HEIGHT, WIDTH))
    smooth = cv2.GaussianBlur(noise, (0, 0), 2.5)
    return np.asarray(128.0 + 40.0 * smooth / smooth.std())


def _follows(moved_px: float) -> bool:
    """Whether a key point of a resting camera is tracked, around which the images move by so much."""
    row = 100.0
    u, v = (
        a.ravel() for a in np.meshgrid(np.arange(40.0, 281.0, 30.0), np.arange(40.0, 201.0, 30.0))
    )
    pixels = np.vstack([[[160.0, row]], np.column_stack([u, v])])
    pixels = pixels[(np.abs(pixels - pixels[0]).max(axis=1) > 29.0) | (np.arange(len(pixels)) == 0)]
    bits = np.random.default_rng(1).integers(0, 256, (len(pixels), 32)).astype(np.uint8)
    points = [Keypoints(pixels, bits)]
    settings = FrontendSettings()
    engine = DescriptorFrontend(CAMERA, settings, "orb", lambda *images: points, MutualNearest())
    still = _blobs()
    near = np.abs(np.indices(still.shape) - np.array([row, 160.0])[:, None, None]).max(axis=0) < 25
    shifted = cv2.warpAffine(still, np.array([[1.0, 0, 0], [0, 1, moved_px]]), (WIDTH, HEIGHT))
    seen = []
    for k, left in enumerate((still, np.where(near, shifted, still))):
        pair = [
            np.rint(image).clip(0, 255).astype(np.uint8) for image in (left, np.roll(left, -10, 1))
        ]
        out = engine.process(StereoFrame(k, k * 10**8, *pair))
        seen.append(out.observations)
    first = seen[0].ids[np.abs(seen[0].z[:, :2] - pixels[0]).max(axis=1) < 1.0]
    return len(first) == 1 and bool(np.isin(first, seen[1].ids)[0])


def _is_used(row: float) -> bool:
    """Whether a key point in such a row is used."""
    points = [Keypoints(np.array([[160.0, row]]), np.zeros((1, 32), np.uint8))]
    flow = KeypointFlow(AnchorBank(1, 9), lambda *_: points, MutualNearest())
    image = _blobs().clip(0, 255).astype(np.uint8)
    flow.see(image)
    return len(flow.detect(image)) == 1


KEYPOINTS: dict[str, tuple[Says, float, float]] = {
    "across: points": (lambda n: _across(count=int(n)), 14, 15),
    "across: share": (lambda x: _across(right=x), 0.36, 0.44),
    "across: depths": (lambda x: _across(depths=x), 0.45, 0.55),
    "across: disparities": (lambda x: not _across(off_px=x), 1.7, 2.3),
    "search": (lambda x: not _searched(x), 26.0, 34.0),
    "follows": (lambda x: not _follows(x), 0.8, 1.2),
    "border": (_is_used, 7.7, 8.3),
}


# Corners, depth images, anchors


def _in_cell(count: int) -> int:
    """Corners of those in one cell that are taken."""
    grid = GridSettings(target_features=4)
    pixels = np.array([[60.0 + 70.0 * (k % 4), 60.0 + 70.0 * (k // 4)] for k in range(count)])
    detector: Any = SimpleNamespace(detect=lambda image: pixels)
    image = np.zeros((600, 960), np.uint8)
    return len(given_corners(detector, image, np.zeros((0, 2)), 99, grid))


def _has_disparity(step_px: float = 0.0, depth_m: float = 5.0) -> bool:
    """Whether a depth image knows a disparity where it has a step."""
    constant = CAMERA.fu * CAMERA.baseline_m
    depth = np.full((4, 4), depth_m)
    depth[:, 2:] = constant / (constant / depth_m + step_px)
    return bool(disparities(CAMERA, np.array([[1.5, 1.5]]), depth)[1][0])


def _anchored(scale: float = 1.0, score: float = 1.0) -> tuple[bool, bool]:
    """Whether features that look larger get new anchors, and whether those that fit badly are
    aligned anew.
    """
    image = np.random.default_rng(0).integers(0, 255, (HEIGHT, WIDTH)).astype(np.uint8)
    levels = ImageLevels(image, image[::2, ::2].copy())
    bank = AnchorBank(50, 9)
    centres = np.array([[100.0, 100.0], [200.0, 150.0]])
    old = new_tracks(centres, bank.add(image, centres))
    fit: Any = AnchorFit(CAMERA, GridSettings(target_features=50), bank)
    replaced: list[object] = []
    again: list[object] = []

    def align(store: object, slots: object, target: object, warp: FloatArray, *_: object) -> Any:
        out = warp.copy()
        out[:, :, :2] *= scale
        return out, np.full(len(warp), score)

    def realign(before: object, left: object, pixels: FloatArray, *_: object) -> Any:
        again.append(pixels)
        return np.zeros((len(pixels), 2, 3)), np.zeros(len(pixels), np.bool_)

    fit._realign = realign
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(anchor_fit, "align", align)
        patch.setattr(bank, "replace", lambda *arguments: replaced.append(arguments))
        fit.track(old, levels, levels, centres, np.ones(2, np.bool_), None, 0.1)
    return bool(replaced), bool(again)


OTHERS: dict[str, tuple[Says, float, float]] = {
    "corners in a cell": (lambda n: _in_cell(int(n)) < n, 8, 9),
    "depth image: step": (lambda x: not _has_disparity(x), 0.85, 1.15),
    "depth image: depth": (lambda x: _has_disparity(depth_m=x), 0.043, 0.057),
    "anchor: scale": (lambda x: _anchored(x)[0], 1.2, 1.3),
    "anchor: correlation": (lambda x: _anchored(score=x)[1], 0.45, 0.55),
}


# Right images


def _fit() -> Any:
    return StereoFit(CAMERA, DisparitySettings(), AnchorBank(9, 9), (WIDTH, HEIGHT))


def _is_unique(score: float, *, good: bool = False) -> bool:
    """Whether a match of a correlation counts, in a search or among those on the rows."""
    fit = _fit()

    def search(left: object, right: object, points: FloatArray, least: float) -> Any:
        return np.zeros(len(points)), np.full(len(points), score >= least)

    fit._search = search
    fit._reach_wait = 1
    point = np.zeros((1, 2))
    image = np.zeros((4, 4), np.uint8)
    if good:
        return bool(fit.count_on_rows(image, image, point))
    return bool(fit.search(image, image, point)[1][0])


def _has_margin(margin: float) -> bool:
    """Whether a match counts that leads the second-best one by so much."""

    def match(left: object, right: object, points: object, reach: float, *least: float) -> Any:
        return np.zeros(1), np.array([margin >= least[1]])

    nothing: Any = None
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(stereo_fit, "match_rows", match)
        return _fit().count_on_rows(nothing, nothing, np.zeros((1, 2))) > 0


def _is_deep(depth_m: float) -> bool:
    tracks = changed(_tracks(1), point=np.array([[0.0, 0.0, depth_m]]), has_point=np.ones(1, bool))
    return len(_fit()._expected(tracks)[0]) > 0


def _rows_are_tried(frames: int) -> bool:
    """Whether other rows are tried after so many frames with few matches."""
    fit = _fit()
    tried: list[int] = []
    fit._unmatched = frames
    fit._reach_wait = 1
    fit._search = lambda *_: (np.zeros(1), np.ones(1, np.bool_))
    fit._best_offset = lambda *_: tried.append(1) or 0
    image = np.zeros((4, 4), np.uint8)
    fit.search(image, image, np.zeros((1, 2)))
    return bool(tried)


def _reach_is_tried(frames: int) -> bool:
    """Whether a larger reach is tried again after so many frames."""
    fit = _fit()
    tried: list[int] = []
    fit._search = lambda *_: (np.zeros(1), np.zeros(1, np.bool_))
    fit._reaches_further = lambda *_: bool(tried.append(1))
    image = np.zeros((4, 4), np.uint8)
    fit.search(image, image, np.zeros((1, 2)))
    for _ in range(frames):
        fit.update_rows(_tracks(5, 5))
    fit.search(image, image, np.zeros((1, 2)))
    return len(tried) > 1


def _reach_px(far: float) -> float:
    """The reach where a share of the points beyond it is much further."""
    fit = _fit()
    fit.max_disparity_px = 40.0
    fit._beyond = lambda *_: np.where(np.arange(100) < round(100 * far), 250.0, 60.0)
    image = np.zeros((4, 4), np.uint8)
    fit._reaches_further(image, image, np.zeros((100, 2)))
    return float(fit.max_disparity_px)


def _largest_reach() -> float:
    fit = _fit()
    for _ in range(20):
        fit._double_reach()
    return float(fit.max_disparity_px) / WIDTH


def _agrees_by_motion(off_px: float) -> bool:
    """Whether a feature of disparity 20 px agrees with others, that is off by some pixels, where
    depths come from motion alone.
    """
    fit = _fit()
    tracks = _right_tracks(60)
    left = tracks.left
    disparity = CAMERA.fu * CAMERA.baseline_m / tracks.point[:, 2]
    pixels = left - np.column_stack([disparity, np.zeros(60)])
    pixels[0, 0] -= off_px
    fit.search = lambda *_: (disparity, np.ones(60, np.bool_))
    fit._fit = lambda *_: (pixels, np.zeros((60, 2, 2)), np.ones(60, np.bool_))
    fit._with_right_pixels = lambda tracks, rows, pixels, skew, agree: agree
    nothing: Any = SimpleNamespace(half=None)
    return bool(fit.track_off_right(tracks, nothing, nothing, by_motion=True)[0])


def _right_tracks(count: int) -> Tracks:
    tracks = _tracks(count, count)
    rng = np.random.default_rng(0)
    depth = rng.uniform(1.5, 6.0, count)
    depth[0] = CAMERA.fu * CAMERA.baseline_m / 20.0
    rays = (tracks.left - [CAMERA.cu, CAMERA.cv]) / CAMERA.fu
    point = np.column_stack([rays * depth[:, None], depth])
    return changed(tracks, point=point, has_point=np.ones(count, np.bool_))


def _is_static(off_px: float) -> bool:
    """Whether a right match is taken that is off by so much from its depth."""
    fit = _fit()
    tracks = _right_tracks(30)
    disparity = CAMERA.fu * CAMERA.baseline_m / tracks.point[:, 2]
    pixels = tracks.left - np.column_stack([disparity, np.zeros(30)])
    pixels[0, 0] -= off_px
    good: list[FloatArray] = []
    fit._fit = lambda *_: (pixels, np.zeros((30, 2, 2)), np.ones(30, np.bool_))
    fit._with_right_pixels = lambda tracks, rows, pixels, skew, valid: good.append(valid)
    nothing: Any = None
    fit.track_right(tracks, nothing, True)
    return bool(good[0][0])


def _slope(spread_px: float) -> float:
    """How much disparities that are off by a tenth of them change with them."""
    expected = np.linspace(20.0, 20.0 + 2.0 * spread_px, 101)
    return float(stereo_fit.common_offset(expected, 0.1 * expected)[1])


def _common(count: int) -> float | None:
    fit = _fit()
    tracks = _right_tracks(count)
    disparity = CAMERA.fu * CAMERA.baseline_m / tracks.point[:, 2]
    pixels = tracks.left - np.column_stack([disparity, np.zeros(count)])
    fit._fit = lambda *_: (pixels, np.zeros((count, 2, 2)), np.ones(count, np.bool_))
    fit._with_right_pixels = lambda *_: None
    nothing: Any = None
    fit.track_right(tracks, nothing, True)
    value: float | None = fit.common_px
    return value


def _has_many(share: float) -> bool:
    fit = _fit()
    fit.update_rows(_tracks(100, round(100 * share)))
    return not fit.has_few_matches


def _row_model(off_px: float) -> EpipolarRowModel:
    rows = EpipolarRowModel(WIDTH, HEIGHT)
    left = np.random.default_rng(0).uniform([20, 20], [460, 280], (400, 2))
    for _ in range(100):
        rows.update(left, left + np.array([0.0, off_px]))
    return rows


def _followed(count: int) -> bool:
    """Whether so many features are followed in right images alone."""
    p = _points(count)
    tracks = changed(
        new_tracks(_pixels(STILL, p), np.arange(count)), point=p, has_point=np.ones(count, np.bool_)
    )
    alone = RightAlone(0, np.zeros((4, 4), np.uint8), tracks, np.zeros(6))
    view: Any = SimpleNamespace(half=None, full=None)
    nothing: Any = SimpleNamespace(store=None)
    good = np.ones(count, np.bool_)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(right_alone, "track_with_retries", lambda *_: (tracks.left.copy(), good))
        patch.setattr(right_alone, "align", lambda s, slots, f, warp, n: (warp, np.ones(count)))
        patch.setattr(right_alone, "on_peak", lambda *_: good)
        found = alone.next(50_000_000, _problem(), nothing, view, None, 3)
    return found is not None


def _takes_offset(matches: int) -> bool:
    """Whether matches with an offset are taken in place of 100 without one."""
    matcher: Any = RightMatcher(CAMERA)
    matcher._right = SimpleNamespace(doubts=lambda _: False, usable=True)
    matcher._turn = SimpleNamespace(
        may_stay=True, is_offset=lambda _: True, frame=lambda *_: None, is_jump=lambda _: False
    )
    matched = _tracks(200, 100)
    off = _tracks(200, matches)
    stereo = SimpleNamespace(
        common_px=None,
        track_off_right=lambda *_, **__: off,
        offset_px=1.0,
        forget_offset=lambda: None,
    )
    images: Any = SimpleNamespace(frame=SimpleNamespace(index=0), stereo=stereo, left=None)
    testable = np.ones(200, np.bool_)
    taken = matcher._take_turn(images, None, matched, matched, testable, tested=True)
    return taken is off


def _tried_pairings(count: int) -> int:
    matcher = RightMatcher(CAMERA)
    image = np.zeros((40, 40), np.uint8)
    levels = ImageLevels(image, image)
    tracks = _tracks(count)
    previous: Any = SimpleNamespace(right_half=image, tracks=tracks, left=levels)
    stereo: Any = SimpleNamespace(count_on_rows=lambda left, right, points: len(points))
    return matcher._count_pairings(previous, levels, tracks, levels, stereo).points


RIGHT: dict[str, tuple[Says, float, float]] = {
    "search: correlation": (_is_unique, 0.56, 0.64),
    "rows: correlation": (lambda x: _is_unique(x, good=True), 0.86, 0.94),
    "rows: margin": (_has_margin, 0.026, 0.034),
    "depth": (_is_deep, 0.043, 0.057),
    "rows are tried": (lambda n: _rows_are_tried(int(n)), 10, 11),
    "reach is tried": (lambda n: _reach_is_tried(int(n)), 9, 10),
    "beyond: points": (lambda n: stereo_fit._are_enough(int(n), 20), 9, 10),
    "beyond: share": (lambda n: stereo_fit._are_enough(int(n), 1000), 95, 105),
    "within the reach": (lambda x: _reach_px(x) > 100.0, 0.07, 0.13),
    "largest reach": (lambda x: _largest_reach() < x, 0.56, 0.72),
    "depths by motion": (lambda x: not _agrees_by_motion(x), 2.6, 3.4),
    "spread": (lambda x: _slope(x) != 0.0, 1.7, 2.3),
    "match: depth": (lambda x: not _is_static(x), 0.87, 1.13),
    "common: matches": (lambda n: _common(int(n)) is not None, 19, 20),
    "few matches": (_has_many, 0.17, 0.23),
    "rows are off": (lambda x: _row_model(x).are_off, 0.17, 0.23),
    "third angle": (lambda x: _row_model(1.0).disparity_error_px(300.0) < x, 6.0, 8.0),
    "followed alone": (lambda n: _followed(int(n)), 19, 20),
    "offset: nearly all": (lambda n: _takes_offset(int(n)), 88, 92),
    "pairings: points": (lambda n: _tried_pairings(int(n)) < n, 150, 151),
}
TABLES = {
    f"{what}: {name}": row
    for what, table in (
        ("consensus", CONSENSUS),
        ("objects", OBJECTS),
        ("flow", FLOW),
        ("key points", KEYPOINTS),
        ("others", OTHERS),
        ("right", RIGHT),
    )
    for name, row in table.items()
}


@pytest.mark.parametrize(("says", "below", "above"), TABLES.values(), ids=TABLES)
def test_limits_of_motions_and_matches(says: Says, below: float, above: float) -> None:
    assert not says(below)
    assert says(above)
