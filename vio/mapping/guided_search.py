"""Where a keyframe stands, by looking for the points of a place where they should be seen.

Where the motion to a place is roughly known, each of its points needs to be told from the few features around its
predicted pixel alone, in place of all features of the image (search by projection, as in Mur-Artal et al. 2015). Points
come from several keyframes, so that one of them shows each from a similar view.

A window always holds some feature that looks alike. What agrees by chance is counted with the same search at poses that
are turned away from the one found, and a place needs several times as many.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np
import numpy.typing as npt

from vio.compiled import compiled
from vio.geometry.lie import FloatArray, se3_exp, se3_inverse, so3_exp, so3_hat, transform_points
from vio.geometry.relative_pose import RelativePose
from vio.geometry.stereo import StereoCamera, project, z_D_p_cam
from vio.mapping.features import KeyframeFeatures
from vio.mapping.loop_geometry import StereoPoints, Terms, fit_terms, points_of
from vio.mapping.overlap import is_visible
from vio.records import IntArray

_MOST_BITS = 64  # in which the descriptors of one point differ: a quarter
_LEVELS = 1.6  # by which the size of a feature differs from the predicted one: two and a half levels
_SIGMAS = 3.0
_WINDOW_PX = 3.0  # half of a window's side at the scale of its feature, where the pose is known
_MOST_WINDOW_PX = 40.0  # half of a window's side: in larger ones, the best of all descriptors is seldom the point's
_RANSAC_PX, _RANSAC_STEPS, _RANSAC_SURE = 4.0, 300, 0.999
_SEARCHES = 2  # with the pose found
_LEAST_SAMPLE = 8  # pairs that agree before the next search
_CELL_PX = 8.0  # features closer together are of one corner, on several levels of the pyramid, and count once
_TURNS_PX = 25.0  # by which the poses are turned whose pairs are those of chance: beyond all windows of the last search
_TURNS = 8
LEAST_CORNERS = 12
_OVER_CHANCE = 6.0  # times the mean number of pairs at turned poses


class View(NamedTuple):
    """A keyframe of a place."""

    keyframe: int
    camera: StereoCamera
    features: KeyframeFeatures
    place: RelativePose  # in the frame of the place's first keyframe


@dataclass(frozen=True, slots=True)
class PlacePoints:
    """The stereo points of a place, once for each keyframe that shows them."""

    points: StereoPoints  # (N,) in the frame of the place's first keyframe
    eye: FloatArray  # (N, 3) position of the camera that saw it, likewise
    size_px: FloatArray  # (N,) of the feature
    descriptors: npt.NDArray[np.uint8]  # (N, 32)
    view: IntArray  # (N,) index of the keyframe in the place
    row: IntArray  # (N,) feature of that keyframe

    def take(self, rows: IntArray) -> PlacePoints:
        """Return some of the points."""
        p = self.points
        points = StereoPoints(p.p[rows], p.covariance[rows], p.valid[rows])
        a = self.eye[rows], self.size_px[rows], self.descriptors[rows]
        return PlacePoints(points, *a, self.view[rows], self.row[rows])


@dataclass(frozen=True, slots=True)
class Guided:
    """A place found by search."""

    pose: RelativePose  # of the camera in the frame of the place's first keyframe
    inliers: int  # distinct corners
    chance: float  # mean number of those at turned poses
    view: IntArray  # (P,) keyframe of the place that shows each pair
    row: IntArray  # (P,) feature of that keyframe
    row_here: IntArray  # (P,) feature of this keyframe


def place_points(views: Sequence[View]) -> PlacePoints:
    """Return the points that the keyframes of a place show; errors of their poses count as those of the points."""
    parts = []
    for n, (_, camera, f, place) in enumerate(views):
        rows = np.flatnonzero(f.has_right)
        seen = points_of(camera, f, rows)
        rows, p, P = rows[seen.valid], seen.p[seen.valid], seen.covariance[seen.valid]
        T, R = place.T_i_j, place.T_i_j[:3, :3]
        D = np.concatenate([np.broadcast_to(np.eye(3), (len(p), 3, 3)), -so3_hat(p)], axis=2)
        P = R @ (P + D @ place.covariance @ np.swapaxes(D, 1, 2)) @ R.T
        eye = np.broadcast_to(T[:3, 3], p.shape)
        view = np.full(len(rows), n, dtype=np.int64)
        parts.append((transform_points(T, p), P, eye, f.sigma_px[rows], f.descriptors[rows], view, rows))
    p, P, *rest = (np.concatenate(column) for column in zip(*parts, strict=True))
    return PlacePoints(StereoPoints(p, P, np.ones(len(p), dtype=np.bool_)), *rest)


def search(
    place: PlacePoints,
    camera: StereoCamera,
    here: KeyframeFeatures,
    start: RelativePose,
    prior: RelativePose | None,
) -> Guided | None:
    """Return where a keyframe stands in the frame of a place; None: not enough of the place is seen.

    Args:
        place: the place's points.
        camera: of the keyframe.
        here: its features.
        start: about where it stands; the covariance gives the windows of the first search.
        prior: where it stands by the odometry: it decides what the pixels leave open, and the covariance of the result
            is that of the pixels alone; None: not known.
    """
    if len(here) < LEAST_CORNERS:
        return None
    order = np.argsort(here.z[:, 0], kind="stable")
    place = place.take(_in_reach(place, camera, start.T_i_j))
    points, rows = _pairs(place, camera, here, order, start.T_i_j, start.covariance)
    T = _ransac(place, camera, here, points, rows)
    fitted = None
    for _ in range(_SEARCHES):
        if T is None:
            return None
        points, rows = _pairs(place, camera, here, order, T, None)
        terms = Terms(place.take(points).points, camera, here, rows, inverse=True)
        fitted = fit_terms([terms], T, prior=prior, least=LEAST_CORNERS)
        T = None if fitted is None else fitted.T_i_j
    if fitted is None:
        return None
    points, rows = points[fitted.fits], rows[fitted.fits]
    inliers, found = _corners(here, rows), place.take(points)
    if inliers < LEAST_CORNERS:
        return None
    chance = _chance(place, camera, here, order, fitted.T_i_j)
    if inliers < _OVER_CHANCE * chance:
        return None
    depth = float(np.median(transform_points(se3_inverse(fitted.T_i_j), found.points.p)[:, 2]))
    return Guided(fitted.motion(depth), inliers, chance, found.view, found.row, rows)


def _in_reach(place: PlacePoints, camera: StereoCamera, T_i_k: FloatArray) -> IntArray:
    """Return the points (K,) that may be seen from about a pose (4, 4)."""
    q = transform_points(se3_inverse(T_i_k), place.points.p)
    ahead = np.flatnonzero(q[:, 2] > 0)
    uv = project(camera, q[ahead])[:, :2]
    margin = _MOST_WINDOW_PX + _TURNS_PX
    w, h = camera.width or np.inf, camera.height or np.inf
    return ahead[(uv > -margin).all(axis=1) & (uv < [w + margin, h + margin]).all(axis=1)]


def _pairs(
    place: PlacePoints,
    camera: StereoCamera,
    here: KeyframeFeatures,
    order: IntArray,
    T_i_k: FloatArray,
    covariance: FloatArray | None,
) -> tuple[IntArray, IntArray]:
    """Pair points with features (P,) each: for each feature the point that looks most alike and should be there.

    Args:
        place: points.
        camera: of the keyframe.
        here: features.
        order: (M,) features by their column.
        T_i_k: (4, 4) pose of the keyframe.
        covariance: (6, 6) of xi in T_i_k = T_hat exp(xi); None: the pose is known.
    """
    q = transform_points(se3_inverse(T_i_k), place.points.p)
    seen = np.flatnonzero(is_visible(place.points.p, place.eye, q, T_i_k[:3, 3]))
    q = q[seen]
    uv = project(camera, q)[:, :2]
    away = np.linalg.norm(q, axis=1)
    size = place.size_px[seen] * np.linalg.norm(place.points.p[seen] - place.eye[seen], axis=1) / away
    radius = _WINDOW_PX * np.maximum(size, 1.0)
    if covariance is not None:
        D = z_D_p_cam(camera, q)[:, :2] @ np.concatenate(
            [-np.broadcast_to(np.eye(3), (len(q), 3, 3)), so3_hat(q)], axis=2
        )
        radius = radius + _SIGMAS * np.sqrt(np.einsum("nij,jk,nik->ni", D, covariance, D).max(axis=1))
    w, h = camera.width or np.inf, camera.height or np.inf
    good = (uv > -radius[:, None]).all(axis=1) & (uv < [w, h] + radius[:, None]).all(axis=1)
    good &= radius <= _MOST_WINDOW_PX
    seen, uv, size, radius = seen[good], uv[good], size[good], radius[good]
    best, bits = np.full(len(seen), -1, dtype=np.int64), np.zeros(len(seen), dtype=np.int64)
    a, b = (np.ascontiguousarray(d).view(np.uint64) for d in (place.descriptors[seen], here.descriptors[order]))
    z = np.ascontiguousarray(here.z[order, :2])
    _best_in_windows(uv, radius, size, a, z, here.sigma_px[order], b, best, bits)
    found = np.flatnonzero(best >= 0)
    found = found[np.argsort(bits[found], kind="stable")]
    feature, first = np.unique(best[found], return_index=True)
    return seen[found[first]], order[feature]


@compiled
def _best_in_windows(
    uv: FloatArray,
    radius: FloatArray,
    size: FloatArray,
    a: npt.NDArray[np.uint64],
    z: FloatArray,
    sizes: FloatArray,
    b: npt.NDArray[np.uint64],
    best: IntArray,
    bits: IntArray,
) -> None:
    """Find for each point the feature around its pixel (N, 2) whose descriptor differs least; -1: none does well.

    Features z (M, 2) are in the order of their columns. Bits are counted by sums over pairs, fours and bytes.
    """
    pairs, fours = np.uint64(0x5555555555555555), np.uint64(0x3333333333333333)
    bytes_, ones = np.uint64(0x0F0F0F0F0F0F0F0F), np.uint64(0x0101010101010101)
    for i in range(len(uv)):
        least = np.uint64(_MOST_BITS + 1)
        j = np.searchsorted(z[:, 0], uv[i, 0] - radius[i])
        while j < len(z) and z[j, 0] <= uv[i, 0] + radius[i]:
            ratio = sizes[j] / size[i]
            if abs(z[j, 1] - uv[i, 1]) <= radius[i] and ratio < _LEVELS and ratio * _LEVELS > 1.0:
                total = np.uint64(0)
                for w in range(a.shape[1]):
                    x = a[i, w] ^ b[j, w]
                    x = x - ((x >> np.uint64(1)) & pairs)
                    x = (x & fours) + ((x >> np.uint64(2)) & fours)
                    x = (x + (x >> np.uint64(4))) & bytes_
                    total += (x * ones) >> np.uint64(56)
                if total < least:
                    least, best[i] = total, j
            j += 1
        bits[i] = least


def _ransac(
    place: PlacePoints, camera: StereoCamera, here: KeyframeFeatures, points: IntArray, rows: IntArray
) -> FloatArray | None:
    """Return the pose (4, 4) with which most pairs agree; None: too few."""
    if len(rows) < _LEAST_SAMPLE:
        return None
    K = np.array([[camera.fu, 0, camera.cu], [0, camera.fv, camera.cv], [0, 0, 1.0]])
    done, rotation, translation, inliers = cv2.solvePnPRansac(
        place.points.p[points],
        here.z[rows, :2],
        K,
        None,
        iterationsCount=_RANSAC_STEPS,
        reprojectionError=_RANSAC_PX,
        confidence=_RANSAC_SURE,
        flags=cv2.SOLVEPNP_P3P,
    )
    if not done or inliers is None or len(inliers) < _LEAST_SAMPLE:
        return None
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = so3_exp(rotation[:, 0]), translation[:, 0]
    return se3_inverse(T)


def _corners(here: KeyframeFeatures, rows: IntArray) -> int:
    """Count the parts of the image that features are in."""
    return len(np.unique((here.z[rows, :2] // _CELL_PX).astype(np.int64), axis=0))


def _chance(
    place: PlacePoints, camera: StereoCamera, here: KeyframeFeatures, order: IntArray, T_i_k: FloatArray
) -> float:
    """Return the mean number of corners that pair where the pose is turned so that no point is where it should be."""
    angle = np.linspace(0, 2 * np.pi, _TURNS, endpoint=False)
    counts = []
    for x, y in _TURNS_PX / camera.fu * np.stack([np.cos(angle), np.sin(angle)], axis=1):
        turned = T_i_k @ se3_exp([0.0, 0.0, 0.0, x, y, 0.0])
        counts.append(_corners(here, _pairs(place, camera, here, order, turned, None)[1]))
    return float(np.mean(counts))
