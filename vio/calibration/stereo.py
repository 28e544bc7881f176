"""Relative pose of the two cameras from rays of matched points, and row residuals of rectified
images.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple, TypeAlias

import numpy as np

from vio.calibration.findings import NotObservable
from vio.dataclass import dataclass
from vio.geometry.lie import FloatArray, so3_exp, so3_log
from vio.numerics.kinds import Tolerance
from vio.numerics.robust import robust_sigma
from vio.records import BoolArray, IntArray


class _ResidualRules(NamedTuple):
    """From how much a calibration is judged."""

    blocks: Tolerance[int] = 10  # of a jackknife
    min_matches: int = 150
    cells: int = 5  # across the image, a side of the grid on which residuals show a distortion


_RESIDUALS = _ResidualRules()


@dataclass(frozen=True, slots=True)
class _FitRules:
    """How the rotation and direction of a pair are fitted."""

    widest_deg: float = 1.0  # gates on epipolar angles in successive fits
    narrower_deg: float = 0.3
    min_pairs: int = 3
    stereo_rotation_deg: float = 0.2  # with larger standard deviations the value is not observable
    stereo_direction_deg: float = 2.0


_FIT = _FitRules()


@dataclass(frozen=True, slots=True)
class _LensRules:
    """When residuals show that a lens model is off."""

    # What a lens model that is off by half a pixel in the corners does to the rotation from single
    # pairs: rows cannot tell a yaw from a tangential distortion of 1e-3, which calibrations leave.
    lens_deg: float = 0.15
    # quantile of the rays' angles off the axis at which a lens model is off by that
    edge: float = 0.95
    min_in_cell: int = 15  # matches that make a cell's median


_LENS = _LensRules()

# R_cam1_cam0 (3, 3), unit direction (3,) from cam0 to cam1 in cam0
_Pose: TypeAlias = tuple[FloatArray, FloatArray]


@dataclass(frozen=True, slots=True)
class RayMatches:
    """Points matched between the two cameras of a rig."""

    pair: IntArray  # (N,) number of the stereo pair
    ray0: FloatArray  # (N, 3) unit rays in cam0
    ray1: FloatArray  # (N, 3) unit rays in cam1

    def take(self, rows: BoolArray) -> RayMatches:
        """Return the rows named by a mask (N,)."""
        return RayMatches(self.pair[rows], self.ray0[rows], self.ray1[rows])


def join_matches(parts: Sequence[RayMatches]) -> RayMatches:
    """Return the matches of several pairs as one table."""
    none = np.zeros((0, 3))
    return RayMatches(
        np.concatenate([np.zeros(0, dtype=np.int64), *(m.pair for m in parts)]),
        np.concatenate([none, *(m.ray0 for m in parts)]),
        np.concatenate([none, *(m.ray1 for m in parts)]),
    )


@dataclass(frozen=True, slots=True)
class StereoEstimate:
    """Left-right extrinsics without scale."""

    R_cam1_cam0: FloatArray  # (3, 3)
    direction: FloatArray  # (3,) unit vector from cam0 to cam1, cam0 frame
    rotation_sigma_deg: float  # by which a verdict judges; a lens model may leave more of a yaw
    direction_sigma_deg: float
    matches: int  # inliers
    pairs: int
    residual_deg: float  # robust spread of the epipolar angle over single pairs
    # segments of video that the values come from; None: single pairs alone
    segments: int | None = None
    # (3,) standard deviations about the axes of cam1, with what a lens model may leave at these
    # matches; None: of the rotation as a whole alone
    rotation_sigmas_deg: FloatArray | None = None


def epipolar_angles(
    R_cam1_cam0: FloatArray, direction: FloatArray, matches: RayMatches
) -> FloatArray:
    """Return signed angles (N,) in radians between the rays of cam1 and the epipolar planes of
    those of cam0.
    """
    turned = matches.ray0 @ R_cam1_cam0.T
    normal = np.cross(R_cam1_cam0 @ direction, turned)
    length = np.linalg.norm(normal, axis=1)
    return np.sum(normal * matches.ray1, axis=1) / np.maximum(length, 1e-9)


def epipolar_spread(R_cam1_cam0: FloatArray, direction: FloatArray, matches: RayMatches) -> float:
    """Return the median magnitude of the epipolar angles, radians."""
    return float(np.median(np.abs(epipolar_angles(R_cam1_cam0, direction, matches))))


def _jackknife_sigmas(
    inliers: RayMatches, R: FloatArray, direction: FloatArray, width: float
) -> tuple[float, float]:
    """Return the standard deviations of rotation and baseline direction, by fits that leave out one
    block of pairs each.
    """
    refits = [
        _fit_stereo(inliers.take(~block), R, direction, width) for block in _blocks(inliers.pair)
    ]
    turns = np.array([so3_log(Rk @ R.T) for Rk, _ in refits])
    swings = np.array([np.cross(direction, dk) for _, dk in refits])
    return _jackknife_norm(turns), _jackknife_norm(swings)


def refine_stereo(
    matches: RayMatches, R_cam1_cam0: FloatArray, direction: FloatArray
) -> StereoEstimate | NotObservable:
    """Refine rotation and baseline direction on the epipolar angles, with standard deviations.

    Args:
        matches: candidate matches, outliers among them.
        R_cam1_cam0: (3, 3) where to start.
        direction: (3,) unit vector where to start, cam0 frame.
    """
    R = R_cam1_cam0
    d = direction
    inliers = matches
    for gate in (np.radians(_FIT.widest_deg), np.radians(_FIT.narrower_deg), None):
        angles = np.abs(epipolar_angles(R, d, matches))
        near = angles < np.radians(_FIT.widest_deg)
        spread = 1.0
        if near.any():
            spread = robust_sigma(angles[near])
        if gate is not None:
            limit = gate
        else:
            limit = max(4 * spread, 1e-5)
        inliers = matches.take(angles < limit)
        if few := too_few(inliers):
            return few
        R, d = _fit_stereo(inliers, R, d, max(spread, 1e-6))
    spread = robust_sigma(epipolar_angles(R, d, inliers))
    rotation_sigma, direction_sigma = _jackknife_sigmas(inliers, R, d, max(spread, 1e-6))
    turn, swing = _lens_pose(inliers, R, d, max(spread, 1e-6))
    sigmas = np.sqrt(rotation_sigma**2 / 3 + turn**2)
    if rotation_sigma > np.radians(_FIT.stereo_rotation_deg) or direction_sigma > np.radians(
        _FIT.stereo_direction_deg
    ):
        return NotObservable(
            "left-right extrinsics",
            f"the standard deviations are {np.degrees(rotation_sigma):.2f} deg of rotation and "
            f"{np.degrees(direction_sigma):.1f} deg of direction; all points may be far away or on "
            "one plane",
        )
    return StereoEstimate(
        R_cam1_cam0=R,
        direction=d,
        rotation_sigma_deg=float(np.hypot(np.degrees(rotation_sigma), _LENS.lens_deg)),
        direction_sigma_deg=float(np.degrees(np.hypot(direction_sigma, swing))),
        matches=len(inliers.pair),
        pairs=len(np.unique(inliers.pair)),
        residual_deg=float(np.degrees(spread)),
        rotation_sigmas_deg=np.degrees(sigmas),
    )


def _lens_pose(
    matches: RayMatches, R: FloatArray, d: FloatArray, spread: float
) -> tuple[FloatArray, float]:
    """Return how far, radians, a lens model that is off turns the rotation, about the axes of cam1
    (3,), and the baseline's direction.

    Rows of single pairs fit part of a distortion by a yaw and a direction of the baseline, however
    many matches there are. What they do not fit is left in the residuals over the image, so a bend that
    leaves more there than is seen is taken as that much smaller.
    """
    angles = epipolar_angles(R, d, matches)
    cells = _cells(_angles(matches.ray0))
    seen = _structure(angles, cells)
    swings = []
    turns = []
    for bend in _bends(matches.ray0):
        for sign in (1.0, -1.0):
            bent = replace(matches, ray0=_bent(matches.ray0, sign * bend))
            refit = _fit_stereo(bent, R, d, spread)
            left = _structure(epipolar_angles(*refit, bent) - angles, cells)
            share = min(1.0, seen / max(left, 1e-12))
            swings.append(share * np.linalg.norm(np.cross(d, refit[1])))
            turns.append(share * so3_log(refit[0] @ R.T))
    # the two signs are one distortion
    return np.sqrt(0.5 * np.sum(np.square(turns), axis=0)), float(
        np.sqrt(0.5 * np.sum(np.square(swings)))
    )


def _cells(angles: FloatArray) -> IntArray:
    """Return the cell (N,) of a grid over the image, equally filled along x and y, of angles (N,
    2) off the axis.
    """
    limits = np.quantile(angles, np.linspace(0, 1, _RESIDUALS.cells + 1)[1:-1], axis=0)
    column, row = (np.searchsorted(limits[:, k], angles[:, k]) for k in range(2))
    return column * _RESIDUALS.cells + row


def _structure(values: FloatArray, cells: IntArray) -> float:
    """Return the rms over the cells (N,) of the medians of values (N,)."""
    medians = [
        np.median(values[cells == k])
        for k, n in enumerate(np.bincount(cells))
        if n >= _LENS.min_in_cell
    ]
    if medians:
        return float(np.sqrt(np.mean(np.square(medians))))
    return float("inf")


def _bends(rays: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return by what radial and both tangential distortions move rays (N, 3), each (N, 2), radians,
    in `_angles`.

    Reference: Brown, Close-range camera calibration (1971), in the angles off the axis, as lenses
    may be wide.
    """
    angles = _angles(rays)
    edge = max(float(np.quantile(np.linalg.norm(angles, axis=1), _LENS.edge)), 1e-6)
    xy = angles / edge
    r2 = np.sum(xy**2, axis=1, keepdims=True)
    size = np.radians(_LENS.lens_deg)
    return size * xy * r2, *(
        size / 3 * (r2 * axis + 2 * xy * xy[:, k : k + 1]) for k, axis in enumerate(np.eye(2))
    )


def _angles(rays: FloatArray) -> FloatArray:
    """Return angles (N, 2) off the optical axis along x and y, radians, of unit rays (N, 3)."""
    radius = np.linalg.norm(rays[:, :2], axis=1, keepdims=True)
    return rays[:, :2] / np.maximum(radius, 1e-12) * np.arctan2(radius, rays[:, 2:])


def _bent(rays: FloatArray, bend: FloatArray) -> FloatArray:
    """Return unit rays (N, 3) whose angles off the axis are moved by (N, 2) radians."""
    angles = _angles(rays) + bend
    theta = np.linalg.norm(angles, axis=1, keepdims=True)
    return np.concatenate([angles * np.sinc(theta / np.pi), np.cos(theta)], axis=1)


def too_few(matches: RayMatches) -> NotObservable | None:
    """Return why left-right extrinsics are not observable with so few matches.

    None: there are enough.
    """
    pairs = len(np.unique(matches.pair))
    if len(matches.pair) >= _RESIDUALS.min_matches and pairs >= _FIT.min_pairs:
        return None
    return NotObservable(
        "left-right extrinsics",
        f"only {len(matches.pair)} consistent matches in {pairs} pairs were found "
        f"({_RESIDUALS.min_matches} in {_FIT.min_pairs} "
        "are needed); the images are too few, do not overlap, or have no texture",
    )


def _fit_stereo(matches: RayMatches, R: FloatArray, d: FloatArray, spread: float) -> _Pose:
    from scipy.optimize import least_squares  # every run imports this module, and few fit

    basis = _tangents(d)

    def moved(x: FloatArray) -> _Pose:
        out = d + basis @ x[3:]
        return so3_exp(x[:3]) @ R, out / np.linalg.norm(out)

    found = least_squares(
        lambda x: epipolar_angles(*moved(x), matches) / spread,
        np.zeros(5),
        loss="soft_l1",
        x_scale=1e-2,
    )
    return moved(found.x)


def _tangents(d: FloatArray) -> FloatArray:
    """Return two unit vectors (3, 2) perpendicular to a direction and to each other."""
    return np.linalg.svd(d[None, :])[2][1:].T


def _blocks(labels: IntArray) -> list[BoolArray]:
    """Return masks (N,) of the rows of each of up to ten blocks of labels."""
    names = np.unique(labels)
    parts = np.array_split(names, min(_RESIDUALS.blocks, len(names)))
    return [np.isin(labels, part) for part in parts]


def _jackknife_norm(values: FloatArray) -> float:
    """Return the standard error of a vector (its length) from its leave-one-block-out values (n,
    d).
    """
    return float(
        np.sqrt((len(values) - 1) * np.mean(np.sum((values - values.mean(axis=0)) ** 2, axis=1)))
    )


@dataclass(frozen=True, slots=True)
class RowResiduals:
    """Row differences of a rectified pair."""

    median_px: float  # of vl - vr
    spread_px: float  # robust standard deviation
    # (3, 3) medians over the image, rows from the top; NaN where there are too few matches
    grid_px: FloatArray
    positive_disparity: float  # share of matches with ul > ur
    matches: int
    rms_px: float  # root mean square over the matches of the median where each of them is
    disparity_px: float  # median


def row_residuals(z: FloatArray, width: float, height: float) -> RowResiduals | NotObservable:
    """Describe the row differences of matches (N, 4) `[ul vl ur vr]` in rectified pixels, over
    the image.
    """
    if len(z) < _RESIDUALS.min_matches:
        return NotObservable("row alignment", f"only {len(z)} matches were found")
    off = z[:, 1] - z[:, 3]
    median = float(np.median(off))
    grid = np.full((3, 3), np.nan)
    smooth = np.full(len(off), median)
    column = np.clip((3 * z[:, 0] / width).astype(int), 0, 2)
    row = np.clip((3 * z[:, 1] / height).astype(int), 0, 2)
    for i in range(3):
        for j in range(3):
            here = (row == i) & (column == j)
            if here.sum() >= _LENS.min_in_cell:
                grid[i, j] = smooth[here] = np.median(off[here])
    disparity = z[:, 0] - z[:, 2]
    return RowResiduals(
        median_px=median,
        spread_px=robust_sigma(off - median),
        grid_px=grid,
        positive_disparity=float(np.mean(disparity > 0)),
        matches=len(z),
        rms_px=float(np.sqrt(np.mean(smooth**2))),
        disparity_px=float(np.median(disparity)),
    )
