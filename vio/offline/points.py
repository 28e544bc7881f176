"""Map points: tracks across keyframes, triangulated from all views."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from vio.errors import EstimationError
from vio.geometry.lie import FloatArray, se3_inverse
from vio.geometry.stereo import DEPTH_DISPARITY_PX, StereoCamera, project, triangulate, z_D_p_cam
from vio.numerics.kinds import Tolerance
from vio.offline.keyframes import TrackedPath
from vio.offline.loop_tracks import loop_rows
from vio.records import BoolArray, IntArray, Landmarks


class _PointRules(NamedTuple):
    """Which points are triangulated."""

    steps: Tolerance[int] = 8
    min_views: int = 2  # of a point


_POINTS = _PointRules()
MIN_DEPTH_M = 0.05


@dataclass(frozen=True, slots=True)
class PointTracks:
    """Map points and their observations in the keyframes."""

    ids: IntArray  # (M,) feature ids
    p_world: FloatArray  # (M, 3) metres
    point: IntArray  # (R,) index of the point that a row observes
    keyframe: IntArray  # (R,) index of the keyframe of a row; rows are ordered by keyframe
    z: FloatArray  # (R, 4) rectified pixels
    has_right: BoolArray  # (R,)
    # ids from here on are of points that loops join; None: there are none
    loops_from: int | None = None

    @property
    def by_loop(self) -> BoolArray:
        """Mask (R,) of the rows of points that loops join: their pixels are less exact than
        those of tracks.
        """
        if self.loops_from is None:
            return np.zeros(len(self.point), dtype=np.bool_)
        return np.asarray(self.ids[self.point] >= self.loops_from)


def build_tracks(
    run: TrackedPath, keyframes: IntArray, T_world_cam0: FloatArray, *, gate_px: float = 3.0
) -> PointTracks:
    """Turn a run's observations in keyframes into points, each seen in at least two of them.

    The features that agree with the run's loops are points of their own, with ids after those of
    the tracks.

    Args:
        run: the run.
        keyframes: (K,) rows of the trajectory.
        T_world_cam0: (K, 4, 4) poses of the keyframes.
        gate_px: a row with a larger reprojection error (in any coordinate) is an outlier.

    Raises:
        EstimationError: no track is consistent.
    """
    fresh = [run.fresh(int(k)) for k in keyframes]
    loops = loop_rows(run.loops, run.frames[keyframes])
    ids = np.concatenate([o.ids for o in fresh])
    loops_from = int(ids.max(initial=-1)) + 1
    ids = np.concatenate([ids, loops.point + loops_from])
    keyframe = np.concatenate(
        [np.repeat(np.arange(len(keyframes)), [len(o) for o in fresh]), loops.keyframe]
    )
    order = np.argsort(keyframe, kind="stable")
    ids = ids[order]
    keyframe = keyframe[order]
    z = np.concatenate([*(o.z for o in fresh), loops.z])[order]
    has_right = np.concatenate([*(o.has_right for o in fresh), loops.has_right])[order]
    names, point = np.unique(ids, return_inverse=True)
    tracks = PointTracks(
        names, np.zeros((len(names), 3)), point.astype(np.int64), keyframe, z, has_right, loops_from
    )
    tracks = keep_rows(tracks, np.ones(len(point), dtype=np.bool_))
    for _ in range(3):
        if not len(tracks.ids):
            break
        p_world, valid = triangulate_tracks(run.camera, T_world_cam0, tracks)
        tracks = replace(tracks, p_world=p_world)
        residual, ahead = reprojection(run.camera, T_world_cam0, tracks)
        good = ahead & valid[tracks.point] & (np.abs(residual).max(axis=1) < gate_px)
        tracks = keep_rows(tracks, good)
        if good.all():
            break
    if not len(tracks.ids):
        raise EstimationError(
            f"{run.where}: not observable because no feature is seen consistently in "
            f"{_POINTS.min_views} keyframes; the "
            "views do not overlap, the scene has no texture, or the run's poses are wrong"
        )
    return tracks


def keep_rows(tracks: PointTracks, rows: BoolArray) -> PointTracks:
    """Return the rows selected by a mask (R,), without points that then have too few views or no
    stereo row.
    """
    count = len(tracks.ids)
    views = np.bincount(tracks.point[rows], minlength=count)
    stereo = np.bincount(tracks.point[rows & tracks.has_right], minlength=count)
    points = (views >= _POINTS.min_views) & (stereo > 0)
    rows = rows & points[tracks.point]
    renumbered = np.cumsum(points) - 1
    return PointTracks(
        ids=tracks.ids[points],
        p_world=tracks.p_world[points],
        point=renumbered[tracks.point[rows]],
        keyframe=tracks.keyframe[rows],
        z=tracks.z[rows],
        has_right=tracks.has_right[rows],
        loops_from=tracks.loops_from,
    )


def reprojection(
    camera: StereoCamera, T_world_cam0: FloatArray, tracks: PointTracks
) -> tuple[FloatArray, BoolArray]:
    """Return residuals (R, 4) in pixels, zero for missing right pixels, and a mask (R,) of
    points ahead.
    """
    T_cam0_world = se3_inverse(T_world_cam0)
    q, ahead = _in_camera(T_cam0_world, tracks)
    residual = tracks.z - project(camera, q)
    residual[~tracks.has_right, 2:] = 0
    return residual, ahead


def _in_camera(T_cam0_world: FloatArray, tracks: PointTracks) -> tuple[FloatArray, BoolArray]:
    T = T_cam0_world[tracks.keyframe]
    p_world = tracks.p_world[tracks.point]
    q = np.einsum("nij,nj->ni", T[:, :3, :3], p_world) + T[:, :3, 3]
    ahead = q[:, 2] > MIN_DEPTH_M
    return np.where(ahead[:, None], q, [0.0, 0.0, 1.0]), ahead


def triangulate_tracks(
    camera: StereoCamera, T_world_cam0: FloatArray, tracks: PointTracks
) -> tuple[FloatArray, BoolArray]:
    """Triangulate points (M, 3) from all views by robust Gauss-Newton; also return a mask (M,) of
    those determined.

    Starts from the stereo pair with the largest disparity; a Geman-McClure weight of one pixel
    limits outliers.
    """
    count = len(tracks.ids)
    disparity = np.where(tracks.has_right, tracks.z[:, 0] - tracks.z[:, 2], -np.inf)
    order = np.lexsort((disparity, tracks.point))
    last = np.searchsorted(tracks.point[order], np.arange(count), side="right") - 1
    best = order[last]
    p_cam, valid = triangulate(camera, tracks.z[best], min_disparity_px=DEPTH_DISPARITY_PX)
    valid &= tracks.has_right[best]
    p_cam = np.where(valid[:, None], p_cam, [0.0, 0.0, 1.0])
    start = T_world_cam0[tracks.keyframe[best]]
    p_world = np.einsum("nij,nj->ni", start[:, :3, :3], p_cam) + start[:, :3, 3]
    T_cam0_world = se3_inverse(T_world_cam0)
    R = T_cam0_world[tracks.keyframe, :3, :3]
    by_point = np.argsort(tracks.point, kind="stable")
    begins = np.searchsorted(tracks.point[by_point], np.arange(count))
    for step in range(_POINTS.steps):
        q, ahead = _in_camera(T_cam0_world, replace(tracks, p_world=p_world))
        r = tracks.z - project(camera, q)
        H = z_D_p_cam(camera, q) @ R
        r[~tracks.has_right, 2:] = 0
        H[~tracks.has_right, 2:] = 0
        width = 2.0 ** max(3 - step, 0)
        weight = ahead / (1 + np.sum(r**2, axis=1) / width**2) ** 2
        weighted = H * weight[:, None, None]
        normal = np.add.reduceat((np.swapaxes(weighted, 1, 2) @ H)[by_point], begins)
        gradient = np.add.reduceat(np.einsum("nij,ni->nj", weighted, r)[by_point], begins)
        spread = np.linalg.eigvalsh(normal)
        solvable = spread[:, 0] > 1e-12 * np.maximum(spread[:, -1], 1e-12)
        normal[~solvable] = np.eye(3)
        gradient[~solvable] = 0
        valid &= solvable
        p_world = p_world + np.linalg.solve(normal, gradient[..., None])[..., 0]
    return p_world, valid & np.isfinite(p_world).all(axis=1)


def landmarks_of(
    camera: StereoCamera, T_world_cam0: FloatArray, tracks: PointTracks, sigma_px: float
) -> Landmarks:
    """Return the points as landmarks, with covariances for fixed poses and `sigma_px` per pixel
    coordinate.
    """
    T_cam0_world = se3_inverse(T_world_cam0)
    q, _ = _in_camera(T_cam0_world, tracks)
    H = z_D_p_cam(camera, q) @ T_cam0_world[tracks.keyframe, :3, :3]
    H[~tracks.has_right, 2:] = 0
    information = np.zeros((len(tracks.ids), 3, 3))
    np.add.at(information, tracks.point, np.swapaxes(H, 1, 2) @ H)
    covariance: FloatArray = sigma_px**2 * np.asarray(
        np.linalg.pinv(information, hermitian=True), dtype=np.float64
    )
    return Landmarks(tracks.ids, tracks.p_world, covariance)
