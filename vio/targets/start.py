"""A start for the adjustment of a board without any guess: focal lengths, poses, the pair.

A few focal lengths are tried. By each, the pixels become rays, the rays of a view give the board's
pose by a homography, which works for rays of any direction, and the reprojection says which fits.
Reference: Zhang, A flexible new technique for camera calibration (2000), for the pose of a plane.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from vio.errors import CalibrationError
from vio.geometry.distortion import CameraModel, DistortionModel, project_point, unproject_pixel
from vio.geometry.lenses.registry import LENSES
from vio.geometry.lie import FloatArray, nearest_rotation, se3_inverse, se3_log
from vio.numerics.kinds import Tolerance
from vio.numerics.robust import median
from vio.records import IntArray
from vio.targets.bundle import Adjusted, BoardAdjustment, RigFit
from vio.targets.views import Sightings

# focal lengths over the image's width that are tried
_FOCAL_SHARES = (0.18, 0.25, 0.35, 0.5, 0.7, 1.0, 1.4, 2.0, 3.0)


class _StartRules(NamedTuple):
    """How a start is found."""

    adjusted_starts: int = 2  # of them that are adjusted
    views: int = 8
    steps: Tolerance[int] = 12
    min_rows: int = 6  # corners of a view that give a pose


_START = _StartRules()


def new_camera(
    model: DistortionModel, count: int, focal_px: float, size: tuple[int, int]
) -> CameraModel:
    """Return a camera of a model at its start, with the centre in the middle of the image.

    Args:
        model: of the lens.
        count: number of its coefficients.
        focal_px: pixels per radian in the middle of the image.
        size: width and height, pixels.
    """
    lens = LENSES[model]
    coefficients = lens.start(count)
    focal = focal_px * lens.focal_factor(coefficients)
    width, height = size
    return CameraModel(
        focal, focal, 0.5 * (width - 1), 0.5 * (height - 1), width, height, model, coefficients
    )


def board_pose(camera: CameraModel, board_m: FloatArray, uv: FloatArray) -> FloatArray | None:
    """Return the pose `T_cam_board` (4, 4) of a plane by corners (K, 2) and their pixels (K, 2).

    None: it is not determined.
    """
    rays, valid = unproject_pixel(camera, uv)
    if valid.sum() < _START.min_rows:
        return None
    x = rays[valid]
    plane = board_m[valid]
    centre = plane.mean(axis=0)
    scale = float(np.abs(plane - centre).max())
    p = np.column_stack([(plane - centre) / scale, np.ones(len(plane))])
    zero = np.zeros_like(p)
    by_x = x[:, :1] * p
    by_y = x[:, 1:2] * p
    by_z = x[:, 2:] * p
    A = np.concatenate(
        [
            np.hstack([zero, -by_z, by_y]),
            np.hstack([by_z, zero, -by_x]),
            np.hstack([-by_y, by_x, zero]),
        ]
    )
    _, vectors = np.linalg.eigh(A.T @ A)
    H = vectors[:, 0].reshape(3, 3)
    length = 0.5 * (np.linalg.norm(H[:, 0]) + np.linalg.norm(H[:, 1]))
    if not length > 1e-12:
        return None
    H = H / length
    if np.sum((p @ H.T) * x) < 0:
        H = -H
    normal = np.cross(H[:, 0], H[:, 1])
    R = nearest_rotation(np.column_stack([H[:, 0], H[:, 1], normal]))
    T = np.eye(4)
    T[:3, :3] = R
    T[:3, 3] = H[:, 2] * scale - R[:, :2] @ centre
    return T


def poses_of(camera: CameraModel, seen: Sightings) -> list[FloatArray | None]:
    """Return the board's pose in each view of one camera; None where it is not determined."""
    out: list[FloatArray | None] = []
    for v in range(seen.views):
        rows = seen.view == v
        out.append(board_pose(camera, seen.points_m[seen.point[rows]], seen.uv[rows]))
    return out


def _misfit(camera: CameraModel, seen: Sightings) -> float:
    """Median distance in pixels of corners from where their views' poses expect them."""
    off: list[FloatArray] = []
    for v, T in enumerate(poses_of(camera, seen)):
        rows = seen.view == v
        if T is None:
            off.append(np.full(int(rows.sum()), np.inf))
            continue
        board = seen.points_m[seen.point[rows]]
        uv, valid = project_point(camera, board @ T[:3, :2].T + T[:3, 3])
        off.append(np.where(valid, np.linalg.norm(uv - seen.uv[rows], axis=1), np.inf))
    return median(np.concatenate(off))


def spread_views(count: int, wanted: int) -> IntArray:
    """Return the numbers of `wanted` views spread over all of them."""
    return np.unique(np.linspace(0, count - 1, min(wanted, count)).round().astype(np.int64))


def one_camera(
    seen: Sightings, size: tuple[int, int], model: DistortionModel, count: int
) -> Adjusted:
    """Adjust one camera's lens without a guess.

    Args:
        seen: corners in its images.
        size: width and height, pixels.
        model: of the lens.
        count: number of its coefficients.

    Raises:
        CalibrationError: no focal length fits the views.
    """
    few = seen.of_views(_fullest(seen, _START.views))
    rated: list[tuple[float, float]] = []
    for share in _FOCAL_SHARES:
        focal = share * size[0]
        rated.append((_misfit(new_camera(model, count, focal, size), few), focal))
    best: Adjusted | None = None
    least = np.inf
    for misfit, focal in sorted(rated)[: _START.adjusted_starts]:
        if not np.isfinite(misfit):
            continue
        camera = new_camera(model, count, focal, size)
        found = _adjusted(camera, few, _START.steps)
        if found is None:
            continue
        cost = median(np.linalg.norm(found.residuals_px, axis=1))
        if cost < least:
            least = cost
            best = found
    if best is None:
        whole = None
    else:
        whole = _adjusted(best.at.cameras[0], seen, 60)
    if whole is None:
        raise CalibrationError(
            "no focal length explains the corners of the board; check that the target file is "
            "that of the board in the images"
        )
    return whole


def _fullest(seen: Sightings, wanted: int) -> IntArray:
    """Return views with many corners, spread over the record."""
    counts = np.bincount(seen.view, minlength=seen.views)
    chosen: list[int] = []
    for part in np.array_split(np.arange(seen.views), min(wanted, seen.views)):
        chosen.append(int(part[np.argmax(counts[part])]))
    return np.array(chosen, dtype=np.int64)


def _adjusted(camera: CameraModel, seen: Sightings, steps: int) -> Adjusted | None:
    poses = poses_of(camera, seen)
    known = [v for v, T in enumerate(poses) if T is not None]
    if not known:
        return None
    fallback = poses[known[0]]
    stack = np.stack([fallback if T is None else T for T in poses])  # type: ignore[misc]
    start = RigFit((camera,), np.eye(4)[None], stack, np.zeros(2))
    return BoardAdjustment(seen).solve(start, steps)


def pair_start(seen: Sightings, alone: tuple[Adjusted, Adjusted]) -> RigFit:
    """Return a start of two cameras that were adjusted alone.

    Raises:
        CalibrationError: no view shows the board to both.
    """
    of_view: list[dict[int, FloatArray]] = []
    for c in (0, 1):
        numbers = np.unique(seen.view[seen.camera == c]).tolist()
        of_view.append(dict(zip(numbers, alone[c].at.T_cam0_board, strict=True)))
    both = sorted(set(of_view[0]) & set(of_view[1]))
    if not both:
        raise CalibrationError(
            "the cameras never see the board at the same time; record it where both images show it"
        )
    between = np.stack([of_view[1][v] @ se3_inverse(of_view[0][v]) for v in both])
    T_cam1_cam0 = between[_most_central(between)]
    poses = [
        of_view[0][v] if v in of_view[0] else se3_inverse(T_cam1_cam0) @ of_view[1][v]
        for v in range(seen.views)
    ]
    return RigFit(
        (alone[0].at.cameras[0], alone[1].at.cameras[0]),
        np.stack([np.eye(4), T_cam1_cam0]),
        np.stack(poses),
        np.zeros(2),
    )


def _most_central(T: FloatArray) -> int:
    """Row of the transform (N, 4, 4) whose median distance from the others is least."""
    middle = [median(np.linalg.norm(se3_log(se3_inverse(one) @ T), axis=1)) for one in T]
    return int(np.argmin(middle))


def pose_only(fit: RigFit, seen: Sightings) -> tuple[BoardAdjustment, Adjusted]:
    """Adjust the poses of views alone, with lenses and pair as another adjustment found them.

    Raises:
        CalibrationError: no view has a pose.
    """
    poses = poses_of(fit.cameras[0], seen.take(np.flatnonzero(seen.camera == 0)))
    known = [T for T in poses if T is not None]
    if not known:
        raise CalibrationError("no view determines the pose of the board")
    stack = np.stack([known[0] if T is None else T for T in poses])
    problem = BoardAdjustment(seen, fixed_lenses=True)
    return problem, problem.solve(replace(fit, T_cam0_board=stack))
