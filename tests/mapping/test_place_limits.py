"""Each limit of key points, pairs and motions of places, from both sides."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest.mock import MagicMock, patch

import cv2
import numpy as np
import pytest

from vio.errors import VioError
from vio.geometry.lie import FloatArray, se3_exp, so3_exp, transform_points
from vio.geometry.relative_pose import RelativePose
from vio.geometry.stereo import StereoCamera, project
from vio.mapping import features as key_points
from vio.mapping import guided_search, loop_geometry, place_finder
from vio.mapping.features import KeyframeFeatures, extract
from vio.mapping.guided_search import PlacePoints, PlaceView, place_points, shown
from vio.mapping.map_database import _arrays
from vio.mapping.map_store import MapStore
from vio.mapping.merging import _Merge
from vio.mapping.overlap import Overlaps
from vio.mapping.place_finder import PlaceFinder
from vio.mapping.place_index import PlaceIndex, words_of
from vio.records import IntArray

Says = Callable[[float], bool]
Pixels = np.ndarray[Any, np.dtype[np.uint8]]
CAMERA = StereoCamera(400.0, 400.0, 320.0, 180.0, 0.12, 640, 360)


def _texture(height: int, width: int, seed: int = 0) -> FloatArray:
    """Blobs of several sizes, with mean 0 and deviation 1."""
    rng = np.random.default_rng(seed)
    total = np.zeros((height, width))
    for size in (1, 2, 4, 8, 16):
        small = rng.normal(size=(height // size, width // size))
        total += cv2.resize(small, (width, height), interpolation=cv2.INTER_CUBIC)
    return np.asarray(total / total.std())


def _gray(texture: FloatArray) -> Pixels:
    return np.clip(np.round(128.0 + texture), 0, 255).astype(np.uint8)


def _moved(texture: FloatArray, across: float, down: float = 0.0) -> FloatArray:
    """The texture with each part so many pixels further to the right and down."""
    A = np.array([[1.0, 0.0, across], [0.0, 1.0, down]])
    size = texture.shape[::-1]
    return np.asarray(cv2.warpAffine(texture, A, size, flags=cv2.INTER_CUBIC))


# Key points


def _weak_share() -> float:
    """Of the key points that are kept of images whose right half has less contrast."""
    kept = []
    for seed in range(4):
        texture = _texture(360, 480, seed)
        texture[:, :240] *= 60.0
        texture[:, 240:] *= 45.0
        image = _gray(texture)
        kept.append(extract(image, image, most=300).z[:, 0] > 240)
    return float(np.mean(np.concatenate(kept)))


def _largest_sigma_px() -> float:
    """Of the key points of a large image of large blobs."""
    image = _gray(40.0 * cv2.resize(_texture(180, 240), (960, 720), interpolation=cv2.INTER_CUBIC))
    return float(extract(image, image).sigma_px.max())


def _share_a_cell(apart_px: int) -> bool:
    """Whether two strong key points so far apart in an image of 1000 px count as of one cell."""
    points = [cv2.KeyPoint(x, 0.0, 1.0, 0.0, strength) for x, strength in ((0, 9), (apart_px, 8))]
    points.append(cv2.KeyPoint(950.0, 0.0, 1.0, 0.0, 1))
    return sorted(key_points._spread(points, (500, 1000), 2).tolist()) == [0, 2]


def _look_alike(bits: int) -> bool:
    """Whether descriptors are of one point that differ in so many bits."""
    one = np.zeros((1, 256), np.uint8)
    one[0, :bits] = 1
    row = np.zeros(1, np.int64)
    packed = np.packbits(one, axis=1)
    return len(key_points._most_alike(row, row, np.zeros_like(packed), packed)[0]) == 1


def _right_of(
    left: FloatArray, right: FloatArray, found_down: float = 0.0, **rules: float
) -> FloatArray | None:
    """Where the right image shows the middle of the left one, given that a key point was found 10 px
    further left; None: nowhere.
    """
    height, width = left.shape
    uv = np.array([[width // 2, height // 2]], np.float64)
    orb = MagicMock()
    there = cv2.KeyPoint(float(uv[0, 0]) - 10.0, float(uv[0, 1]) + found_down, 1.0)
    bits = np.zeros((1, 32), np.uint8)
    orb.detectAndCompute.return_value = ([there], bits)
    extraction = replace(key_points._EXTRACTION, **rules)  # type: ignore[arg-type]
    with patch.object(key_points, "_EXTRACTION", extraction):
        out, valid = key_points._right_pixels(orb, _gray(left), _gray(right), uv, np.ones(1), bits)
    return out[0] - uv[0] if valid[0] else None


def _row_is_matched(down: float, **rules: float) -> bool:
    left = 40.0 * _texture(101, 201)
    return _right_of(left, _moved(left, -10.0, down), round(down), **rules) is not None


def _window_is_inside(radius_px: int) -> bool:
    """Whether the pixels that a match is refined by lie within a square of such a half side, outside
    of which the images move otherwise.
    """
    left = 40.0 * _texture(101, 201, 3)
    inside = np.zeros(left.shape, np.bool_)
    inside[50 - radius_px : 51 + radius_px, 90 - radius_px : 91 + radius_px] = True
    right = np.where(inside, _moved(left, -10.0), _moved(left, -8.0, 2.0))
    with patch.object(key_points, "_equal_contrast", lambda image: image):
        moved = _right_of(left, right)
    return moved is not None and bool(np.linalg.norm(moved - [-10.0, 0.0]) < 0.02)


# Pairs and motions


def _features(z: FloatArray, descriptors: Pixels | None = None) -> KeyframeFeatures:
    count = len(z)
    if descriptors is None:
        rng = np.random.default_rng(count)
        descriptors = rng.integers(0, 256, (count, 32), dtype=np.uint8)
    return KeyframeFeatures(z, np.ones(count, np.bool_), np.ones(count), descriptors)


def _pair(bits: int) -> bool:
    """Whether features pair whose descriptors differ in so many bits, beside others without any
    likeness.
    """
    one = np.zeros((2, 256), np.uint8)
    one[0, :bits] = 1
    one[1, 128:] = 1
    other = np.zeros((2, 256), np.uint8)
    other[1, 100:] = 1
    i, j = (_features(np.zeros((2, 4)), np.packbits(x, axis=1)) for x in (one, other))
    return [0, 0] in loop_geometry.match(i, j).tolist()


def _has_depth(disparity_px: float) -> bool:
    features = _features(np.array([[300.0, 180.0, 300.0 - disparity_px, 180.0]]))
    return bool(loop_geometry._points(CAMERA, features, np.array([0]))[1][0])


def _scene(count: int, seed: int = 0) -> FloatArray:
    rng = np.random.default_rng(seed)
    return rng.uniform([-3.0, -1.5, 4.0], [3.0, 1.5, 9.0], (count, 3))


def _agrees(off_px: float) -> bool:
    """Whether all points agree with a pose, of which a pair is off to both sides by so much."""
    p = _scene(30)
    p[1] = p[0]
    uv = project(CAMERA, p)[:, :2]
    uv[:2, 0] += [off_px, -off_px]
    return loop_geometry.pose_of_most(CAMERA, p, uv, 30) is not None


def _found_poses(right: int, scenes: int) -> float:
    """Share of scenes whose pose is found, with so many right ones of 100 pairs."""
    found = 0
    T = se3_exp([0.4, -0.1, 0.3, 0.05, -0.2, 0.03])
    for seed in range(scenes):
        rng = np.random.default_rng(seed)
        p = _scene(100, seed)
        uv = project(CAMERA, transform_points(T, p))[:, :2]
        wrong = rng.permutation(100)[right:]
        uv[wrong] = rng.uniform([0.0, 0.0], [640.0, 360.0], (len(wrong), 2))
        pose = loop_geometry.pose_of_most(CAMERA, p, uv, 10)
        found += pose is not None and bool(np.abs(pose - T).max() < 0.05)
    return found / scenes


def _directions_differ(by_m: float = 0.0, by_deg: float = 0.0, depth_m: float = 0.0) -> bool:
    """Whether a place is refused whose motions from the one to the other, and back, differ so
    much.
    """
    gap = np.eye(4)
    gap[0, 3] = by_m
    gap[:3, :3] = so3_exp([0.0, 0.0, np.radians(by_deg)])
    motions = iter([np.eye(4), gap])
    features = _features(np.zeros((50, 4)))
    fitted = RelativePose(np.eye(4), np.eye(6)), np.ones(50, np.bool_)
    with (
        patch.object(loop_geometry, "_pnp", lambda *_: next(motions)),
        patch.object(loop_geometry, "_median_depth", lambda *_: depth_m),
        patch.object(loop_geometry, "_fit", lambda *_: fitted),
    ):
        return loop_geometry.verify(CAMERA, features, CAMERA, features) is None


def _pixel_variance() -> float:
    """Of pixels that all fit without an error."""
    return loop_geometry._variance_factor(np.zeros(9), np.ones(9, np.bool_))


# Searches by geometry


def _view(p: FloatArray, descriptors: Pixels | None = None) -> PlaceView:
    """A keyframe at the origin that shows points."""
    features = _features(project(CAMERA, p), descriptors)
    return PlaceView(0, shown(CAMERA, features), RelativePose(np.eye(4), 1e-8 * np.eye(6)))


def _at(p: FloatArray) -> tuple[PlacePoints, guided_search._Target]:
    """The place of such points, and the keyframe as one that is looked through."""
    view = _view(p)
    return place_points([view]), guided_search._Target.of(CAMERA, view.shown.features)


def _window_px(sigma_m: float) -> float:
    """Half of the window's side of a point at 1 m, where the camera's position is known so well."""
    place, target = _at(np.array([[0.0, 0.0, 1.0], [0.1, 0.0, 1.0]]))
    covariance = np.diag([sigma_m**2, 0.0, 0.0, 0.0, 0.0, 0.0])
    return float(guided_search._pairs(place, target, np.eye(4), covariance).radius[0])


def _wide_window_is_searched(half_px: float) -> bool:
    place, target = _at(np.array([[0.0, 0.0, 1.0], [0.1, 0.0, 1.0]]))
    known, wide = (_window_px(sigma_m) for sigma_m in (0.0, 1e-3))
    sigma_m = 1e-3 * (half_px - known) / (wide - known)
    covariance = np.diag([sigma_m**2, 0.0, 0.0, 0.0, 0.0, 0.0])
    return len(guided_search._pairs(place, target, np.eye(4), covariance).radius) == 2


def _size_fits(ratio: float) -> bool:
    """Whether features are paired whose sizes differ by a factor from the predicted ones."""
    p = np.array([[0.0, 0.0, 2.0], [0.3, 0.0, 2.0]])
    view = _view(p)
    features = view.shown.features
    larger = replace(features, sigma_px=ratio * features.sigma_px)
    target = guided_search._Target.of(CAMERA, larger)
    return len(guided_search._pairs(place_points([view]), target, np.eye(4), None).point) == 2


def _guided_bits(bits: int) -> bool:
    """Whether a point is found whose descriptor differs in so many bits."""
    p = np.array([[0.0, 0.0, 2.0]])
    seen = np.zeros((1, 256), np.uint8)
    seen[0, :bits] = 1
    view = _view(p, np.zeros((1, 32), np.uint8))
    here = _features(project(CAMERA, p), np.packbits(seen, axis=1))
    target = guided_search._Target.of(CAMERA, here)
    return len(guided_search._pairs(place_points([view]), target, np.eye(4), None).point) == 1


def _grid(count: int) -> FloatArray:
    """Points whose pixels are far from one another, at several depths."""
    k = np.arange(count)
    depth = 2.0 + 0.5 * (k % 3)
    return np.column_stack([(k % 8 - 3.5) * 0.15 * depth, (k // 8 - 1.0) * 0.15 * depth, depth])


def _searched(count: int, chance: float = 0.0) -> tuple[bool, int, bool]:
    """Whether a place of so many points is found where so many are by chance, how often points are
    looked for, and whether a motion was fitted.
    """
    view = _view(_grid(count))
    start = RelativePose(np.eye(4), 1e-8 * np.eye(6))
    fit = MagicMock(wraps=guided_search.fit_terms)
    pairs = MagicMock(wraps=guided_search._pairs)
    with (
        patch.object(guided_search, "_chance", lambda *_: chance),
        patch.object(guided_search, "fit_terms", fit),
        patch.object(guided_search, "_pairs", pairs),
        patch.object(guided_search, "MIN_CORNERS", min(guided_search.MIN_CORNERS, count)),
    ):
        found = guided_search.search(
            place_points([view]), CAMERA, view.shown.features, start, start
        )
    return found is not None, pairs.call_count, bool(fit.called)


def _is_place(corners: int) -> bool:
    view = _view(_grid(corners))
    start = RelativePose(np.eye(4), 1e-8 * np.eye(6))
    with patch.object(guided_search, "_chance", lambda *_: 0.0):
        place = place_points([view])
        return guided_search.search(place, CAMERA, view.shown.features, start, None) is not None


def _chance_of_one_direction() -> float:
    """Mean number of corners by chance where one direction aside of a point has a feature."""
    view = _view(np.array([[0.0, 0.0, 2.0]]))
    place = place_points([view])
    features = view.shown.features
    target = guided_search._Target.of(CAMERA, features)
    pairs = guided_search._pairs(place, target, np.eye(4), None)
    z = features.z + np.array([25.0, 0.0, 25.0, 0.0])
    beside = guided_search._Target.of(CAMERA, replace(features, z=z))
    return guided_search._chance(pairs, beside)


def _aside_px(beside_px: float) -> bool:
    """Whether chance is told by pixels so far beside a point."""
    view = _view(np.array([[0.0, 0.0, 2.0]]))
    features = view.shown.features
    target = guided_search._Target.of(CAMERA, features)
    pairs = guided_search._pairs(place_points([view]), target, np.eye(4), None)
    z = features.z + np.array([beside_px, 0.0, beside_px, 0.0])
    beside = guided_search._Target.of(CAMERA, replace(features, z=z))
    return guided_search._chance(pairs, beside) > 0


def _priors_are_known(systematic_m: float) -> bool:
    """Whether a place is searched of which errors of the calibration may put the position so far
    off.
    """
    own = MagicMock()
    own._graph.part = np.zeros(3)
    own._graph.T_map_cam = np.tile(np.eye(4), (3, 1, 1))
    own.drift_since = lambda rows, k, systematic: np.diag(
        [(systematic * systematic_m) ** 2, 0, 0, 0, 0, 0]
    )[None]
    return bool(PlaceFinder._priors(own, np.array([1]), 2))


def _keyframes_searched(places: int) -> int:
    """How many keyframes a search of places looks for, each in the middle of many."""
    middle = [10, 30, 50][:places]
    own = MagicMock(_forgotten=set())
    own._index.__len__.return_value = 60
    own._graph.session = np.zeros(60)
    still = RelativePose(np.eye(4), np.zeros((6, 6)))
    own._graph.motions = lambda origin, rows: [still] * len(rows)
    own._expected_places.return_value = middle
    own._priors.return_value = {k: MagicMock() for k in middle}
    own._views = partial(PlaceFinder._views, own)
    with (
        patch.object(place_finder, "place_points") as taken,
        patch.object(place_finder, "search", lambda *_: None),
    ):
        PlaceFinder._search(own, 59, MagicMock(), np.ones(60, np.bool_))
    return len(taken.call_args.args[0])


# Words


def _best_of_rows(alone: int, beside: int) -> int:
    """The best candidate among a keyframe that shares `alone` features with a view, and five in a row
    that share `beside` each.
    """
    rng = np.random.default_rng(0)
    view = rng.integers(0, 256, (100, 32), dtype=np.uint8)
    index = PlaceIndex()
    shares = [0, 0, 0, alone, 0, 0, 0, 0, *[beside] * 5, 0, 0, 0]
    for share in shares:
        other = rng.integers(0, 256, (100, 32), dtype=np.uint8)
        other[:share] = view[:share]
        index.add(other)
    return int(index.candidates(view, np.ones(len(shares), np.bool_), 1)[0])


def _expected_each(points: int) -> bool:
    """Whether each of so many points of a keyframe counts where it is the only one in view."""
    for k in range(points):
        p = np.tile([0.0, 0.0, -5.0], (points, 1))
        p[k] = [0.0, 0.0, 5.0]
        overlaps = Overlaps()
        overlaps.add(p)
        T = np.eye(4)
        seen = overlaps.expected(np.array([0]), T[None], CAMERA, T)
        if abs(seen[0] - 1.0) > 1e-9:
            return False
    return True


# Files and merges


def _is_rotation(error: float) -> bool:
    """Whether a pose is read whose rotation's square differs by so much from the identity."""
    T = np.eye(4)
    T[0, 0] = np.sqrt(1.0 + error)
    return _arrays([T.tobytes()], (4, 4))[1] is None


def _version_is_read(version: int, folder: Path) -> bool:
    file = folder / f"{version}.map"
    MapStore(file, create=True).close()
    data = bytearray(file.read_bytes())
    data[60:64] = version.to_bytes(4, "big")  # of SQLite's header
    file.write_bytes(data)
    try:
        MapStore(file, read_only=True).close()
    except VioError as error:
        return "is a map of version" not in str(error)
    return True


def _rounds() -> int:
    """How often places are looked for if each search finds new ones."""
    own = MagicMock(_found=[], _rows=np.arange(9), _session=np.zeros(9))
    own._accepted = lambda found: [SimpleNamespace(second=len(own._found))]
    search = MagicMock(return_value=[])
    _Merge._look(own, search, map, 1)
    return search.call_count


LIMITS: dict[str, tuple[Says, float, float]] = {
    "points: weak ones": (lambda x: _weak_share() < x, 0.125, 0.195),
    "points: levels": (lambda x: _largest_sigma_px() < x, 3.5, 3.7),
    "points: cells": (lambda n: not _share_a_cell(int(n)), 95, 105),
    "points: alike": (lambda n: not _look_alike(int(n)), 64, 65),
    "points: rows of descriptors": (
        lambda n: not _row_is_matched(n, lk_rows_px=9.0),
        2.0,
        3.0,
    ),
    "points: rows": (lambda x: not _row_is_matched(x, rows_px=9.0), 1.8, 2.2),
    "points: window": (lambda n: _window_is_inside(int(n)), 4, 7),
    "pairs: alike": (lambda n: not _pair(int(n)), 64, 65),
    "pairs: depth": (_has_depth, 0.9, 1.1),
    "pose: agree": (lambda x: not _agrees(x), 3.8, 4.2),
    "pose: few right ones": (lambda x: _found_poses(18, 300) < x, 0.56, 0.715),
    "pose: directions, m": (lambda x: _directions_differ(by_m=x), 0.09, 0.11),
    "pose: directions, depth": (
        lambda x: _directions_differ(by_m=x, depth_m=10.0),
        0.57,
        0.63,
    ),
    "pose: directions, degrees": (lambda x: _directions_differ(by_deg=x), 2.8, 3.2),
    "pose: rounding": (lambda x: _pixel_variance() < x, 0.08, 0.087),
    "search: known": (lambda x: _window_px(0.0) < x, 2.8, 3.2),
    "search: sigmas": (lambda x: _window_px(0.005) < x, 8.5, 9.5),
    "search: window": (lambda x: not _wide_window_is_searched(x), 39.0, 41.0),
    "search: size": (lambda x: not _size_fits(x), 1.55, 1.65),
    "search: smaller size": (lambda x: _size_fits(x), 0.6, 0.65),
    "search: alike": (lambda n: not _guided_bits(int(n)), 64, 65),
    "search: again": (lambda n: _searched(20)[1] - 1 < n, 2, 3),
    "search: sample": (lambda n: _searched(int(n))[2], 7, 8),
    "search: corners": (lambda n: _is_place(int(n)), 11, 12),
    "search: chance, few": (lambda n: _searched(int(n), 2.5)[0], 14, 15),
    "search: chance, many": (lambda n: _searched(int(n), 6.0)[0], 29, 30),
    "search: directions aside": (lambda x: _chance_of_one_direction() < x, 0.11, 0.14),
    "search: aside": (_aside_px, 20.0, 24.0),
    "search: further aside": (lambda x: not _aside_px(x), 26.0, 30.0),
    "search: odometry": (lambda x: not _priors_are_known(x), 1.9, 2.1),
    "search: first place": (lambda n: _keyframes_searched(1) < n, 7, 8),
    "search: other places": (lambda n: _keyframes_searched(3) < n, 17, 18),
    "index: neighbours": (lambda n: _best_of_rows(30, int(n)) > 5, 10, 13),
    "overlap: points": (lambda n: not _expected_each(int(n)), 32, 33),
    "file: rotations": (lambda x: not _is_rotation(x), 0.9e-3, 1.1e-3),
    "merge: rounds": (lambda n: _rounds() < n, 2, 3),
}


@pytest.mark.parametrize(("says", "below", "above"), LIMITS.values(), ids=LIMITS)
def test_limits_of_places(says: Says, below: float, above: float) -> None:
    assert not says(below)
    assert says(above)


def test_versions_of_maps_that_are_read(tmp_path: Path) -> None:
    read = [version for version in range(8) if _version_is_read(version, tmp_path)]
    assert read == [1, 2, 3, 4, 5]


def test_maps_are_recognised_by_svmp_in_their_header(tmp_path: Path) -> None:
    MapStore(tmp_path / "a.map", create=True).close()
    assert (tmp_path / "a.map").read_bytes()[68:72] == b"SVMP"


def test_words_are_those_of_maps_that_were_written_before() -> None:
    bits: Pixels = np.random.default_rng(7).integers(0, 256, (2, 32), dtype=np.uint8)
    words: IntArray = words_of(bits).astype(np.int64)
    assert words.tolist() == [[12168, 6194], [13566, 7080], [12526, 7013], [7843, 8261]]


def test_an_image_without_key_points_has_descriptors_as_wide_as_others() -> None:
    gray = np.full((360, 480), 128, np.uint8)
    blobs = _gray(40.0 * _texture(360, 480))
    wide = extract(blobs, blobs).descriptors.shape[1]
    assert extract(gray, gray).descriptors.shape == (0, wide)
