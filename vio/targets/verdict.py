"""How good a calibration is: uncertainty over the image and in metres, halves of the views against
each other, and what the views do not show.

A lens's uncertainty is that of where it projects a fixed point, after the motion of the camera that
compensates most of it: a shift of the centre that a rotation undoes costs nothing.
Reference: Kogan, mrcal, a camera-calibration toolkit (2021), sections "projection uncertainty" and
"differencing".
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from vio.geometry.distortion import (
    CameraModel,
    project_point,
    unproject_pixel,
    uv_D_camera,
    uv_D_point,
)
from vio.geometry.lie import (
    FloatArray,
    se3_exp,
    se3_inverse,
    se3_log,
    so3_exp,
    so3_hat,
    transform_points,
)
from vio.numerics.kinds import Tolerance
from vio.numerics.statistics import chi_square_quantile
from vio.targets.bundle import (
    MEDIAN_TO_SIGMA,
    Adjusted,
    BoardAdjustment,
    BoolArray,
    RigFit,
    bow_shape,
    layout_of,
    lens_moved,
)
from vio.targets.views import Sightings

DEPTH_M = 5.0  # where a pair's uncertainty is stated
_GRID = (13, 9)  # pixels along width and height at which maps are made


class _CheckRules(NamedTuple):
    """When calibrations disagree."""

    compensated_corners: int = 500  # corners by which a motion of the camera is determined
    step_sigmas: Tolerance[float] = 0.1  # of numerical differences
    # at most by these: focal lengths and baseline, of themselves; coefficients, radians
    max_step: Tolerance[float] = 1e-3
    # of halves that agree as stated; further apart, they inflate the sigmas
    chance_probability: float = 0.99
    unsynchronised_ratio: float = 1.5  # residual of the pair over that of the cameras alone
    # views in which most corners of a camera are refused, before the pair is taken for moved
    contradicting_views: int = 3
    contradicting_share: float = 0.1  # of all views
    min_cell_share: float = 0.01  # of all corners, in a cell of the image


_CHECKS = _CheckRules()
_UNEQUAL = 2.0  # residual of one camera over the other's, each adjusted alone
MIN_TILT_DEG = 15.0
CELLS = 3  # along each side of the image, which must hold corners
_ROWS = ("upper", "middle", "lower")
_COLS = ("left", "centre", "right")
MIN_VIEWS = 8
MIN_CORNERS = 12  # of a view that is used


@dataclass(frozen=True, slots=True)
class Halves:
    """Calibrations by every other view, against each other."""

    off_px: tuple[FloatArray, ...]  # (G,) difference of each camera's projection over the image
    depth_m: float  # of the pair at `DEPTH_M`: rms over the image of half the difference; 0: one
    ratio: float  # rms of the whitened difference of all shared unknowns; 1 expected
    unknowns: int
    map_ratio: float  # largest, over the maps of projection and depth, of difference over expected

    @property
    def rms_px(self) -> tuple[float, ...]:
        """Root mean square of each camera's difference over the image."""
        return tuple(float(np.sqrt(np.nanmean(off**2))) for off in self.off_px)

    @property
    def max_px(self) -> tuple[float, ...]:
        """Largest difference of each camera over the image."""
        return tuple(float(np.nanmax(off)) for off in self.off_px)


@dataclass(frozen=True, slots=True)
class Verdict:
    """What is known of a calibration's quality."""

    grid: tuple[FloatArray, ...]  # pixels (G, 2) of each camera at which maps are made
    projection_sigma_px: tuple[FloatArray, ...]  # (G,) of each camera, at infinity
    depth_sigma_m: FloatArray  # (G,) of the pair at `DEPTH_M`; NaN: not seen by both
    halves: Halves
    inflation: float  # factor by which stated sigmas were multiplied
    findings: tuple[str, ...]  # what is wrong or missing, each with what to record

    @property
    def depth_m(self) -> float:
        """Standard deviation of depth at `DEPTH_M`, rms over the image, inflated."""
        sigma = self.depth_sigma_m[np.isfinite(self.depth_sigma_m)]
        if len(sigma):
            return self.inflation * float(np.sqrt(np.mean(sigma**2)))
        return float("nan")


def pixel_grid(camera: CameraModel) -> FloatArray:
    """Return pixels (G, 2) spread over the image."""
    u = np.linspace(0, camera.width - 1, _GRID[0])
    v = np.linspace(0, camera.height - 1, _GRID[1])
    return np.stack(np.meshgrid(u, v), axis=-1).reshape(-1, 2)


def projection_sigma(
    camera: CameraModel, covariance: FloatArray, distance_m: float | None = None
) -> FloatArray:
    """Standard deviation (G,) in pixels of the projection, in its worst direction.

    Args:
        camera: as calibrated.
        covariance: (4 + n, 4 + n) of `fu fv cu cv` and the coefficients.
        distance_m: of the points; None: at infinity, where a translation compensates nothing.
    """
    uv = pixel_grid(camera)
    rays, valid = unproject_pixel(camera, uv)
    p = rays * (1.0 if distance_m is None else distance_m)
    D = uv_D_camera(camera, p)
    by_p = uv_D_point(camera, p)
    motion = -by_p @ so3_hat(p)
    if distance_m is not None:
        motion = np.concatenate([by_p, motion], axis=2)
    rows = D[valid].reshape(-1, D.shape[2])
    M = motion[valid].reshape(-1, motion.shape[2])
    left = rows - M @ np.linalg.lstsq(M, rows, rcond=None)[0]
    J = left.reshape(-1, 2, D.shape[2])
    P = J @ covariance @ np.swapaxes(J, 1, 2)
    out = np.full(len(uv), np.nan)
    out[valid] = np.sqrt(np.maximum(np.linalg.eigvalsh(P)[:, 1], 0))
    return out


def projection_sigma_from_views(
    found: Adjusted, seen: Sightings, camera: int, distance_m: float
) -> FloatArray:
    """Standard deviation (G,) in pixels of the projection of points at a distance, in its worst
    direction, after the motion of the camera that undoes most of it at the corners in its views.

    It is least at the distances at which the board was shown.
    """
    fit = found.at
    model = fit.cameras[camera]
    lens = layout_of(fit.cameras).lenses[camera]
    rows = np.flatnonzero((seen.camera == camera) & found.used)
    rows = rows[:: -(-len(rows) // _CHECKS.compensated_corners)]
    board = np.column_stack([seen.points_m, bow_shape(seen.points_m) @ fit.bow])
    T = fit.T_cam_cam0[camera] @ fit.T_cam0_board[seen.view[rows]]
    on_board = board[seen.point[rows]]
    corners = np.einsum("rij,rj->ri", T[:, :3, :3], on_board) + T[:, :3, 3]
    D, motion = _lens_and_motion(model, corners)
    undone = np.linalg.lstsq(
        motion.reshape(-1, motion.shape[2]), D.reshape(-1, D.shape[2]), rcond=None
    )[0]
    uv = pixel_grid(model)
    rays, valid = unproject_pixel(model, uv)
    D, motion = _lens_and_motion(model, distance_m * rays)
    J = D - motion @ undone
    P = J @ found.covariance[lens, lens] @ np.swapaxes(J, 1, 2)
    sigma = np.sqrt(np.maximum(np.linalg.eigvalsh(P)[:, 1], 0))
    return np.where(valid, sigma, np.nan)


def _lens_and_motion(camera: CameraModel, p: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Derivatives of pixels (N, 2) of points (N, 3) by the lens, (N, 2, 4 + n), and by a motion of
    the camera, (N, 2, 6).
    """
    by_p = uv_D_point(camera, p)
    motion = np.concatenate([by_p, -by_p @ so3_hat(p)], axis=2)
    return uv_D_camera(camera, p), motion


def projection_difference(a: CameraModel, b: CameraModel) -> FloatArray:
    """Distance (G,) in pixels between two calibrations of one camera, at infinity, after the
    rotation that brings them together best.
    """
    uv = pixel_grid(a)
    rays, valid = unproject_pixel(a, uv)
    R = np.eye(3)
    off = np.full((len(uv), 2), np.nan)
    for _ in range(5):
        turned = rays @ R.T
        there, seen = project_point(b, turned)
        both = valid & seen
        off = np.where(both[:, None], uv - there, np.nan)
        D = (-uv_D_point(b, turned) @ so3_hat(turned))[both].reshape(-1, 3)
        R = so3_exp(np.linalg.lstsq(D, off[both].ravel(), rcond=None)[0]) @ R
    return np.asarray(np.linalg.norm(off, axis=1))


def depths(fit: RigFit, uv0: FloatArray, uv1: FloatArray) -> FloatArray:
    """Depths (G,) in the first camera of points by their pixels (G, 2) in both."""
    rays0, _ = unproject_pixel(fit.cameras[0], uv0)
    rays1, _ = unproject_pixel(fit.cameras[1], uv1)
    T_cam0_cam1 = se3_inverse(fit.T_cam_cam0[1])
    turned = rays1 @ T_cam0_cam1[:3, :3].T
    origin = T_cam0_cam1[:3, 3]
    cosine = np.sum(rays0 * turned, axis=1)
    along = rays0 @ origin - cosine * (turned @ origin)
    return np.asarray(rays0[:, 2] * along / np.maximum(1 - cosine**2, 1e-15))


def _pixels_at_depth(fit: RigFit, depth_m: float) -> tuple[FloatArray, FloatArray, BoolArray]:
    """Pixels (G, 2) of both cameras of points at a depth, and which (G,) both images show."""
    uv0 = pixel_grid(fit.cameras[0])
    rays, valid = unproject_pixel(fit.cameras[0], uv0)
    valid = valid & (rays[:, 2] > 0.2)
    p = rays * (depth_m / np.where(valid, rays[:, 2], 1.0))[:, None]
    uv1, seen = project_point(fit.cameras[1], transform_points(fit.T_cam_cam0[1], p))
    c = fit.cameras[1]
    below_end = (uv1[:, 0] <= c.width - 1) & (uv1[:, 1] <= c.height - 1)
    inside = (uv1 >= 0).all(axis=1) & below_end
    return uv0, uv1, valid & seen & inside


def _shifted(fit: RigFit, step: FloatArray) -> RigFit:
    layout = layout_of(fit.cameras)
    cameras = tuple(
        lens_moved(camera, step[lens])
        for camera, lens in zip(fit.cameras, layout.lenses, strict=True)
    )
    T = fit.T_cam_cam0.copy()
    for c, pose in enumerate(layout.poses):
        T[c + 1] = se3_exp(step[pose]) @ T[c + 1]
    return replace(fit, cameras=cameras, T_cam_cam0=T)


def depth_sigma(found: Adjusted, depth_m: float = DEPTH_M) -> FloatArray:
    """Standard deviation (G,) of depth at a depth, over the first image; NaN: not seen by both."""
    fit = found.at
    uv0, uv1, both = _pixels_at_depth(fit, depth_m)
    out = np.full(len(uv0), np.nan)
    if not both.any():
        return out
    values, vectors = np.linalg.eigh(found.covariance)
    total = np.zeros(int(both.sum()))
    for value, vector in zip(values, vectors.T, strict=True):
        step = np.sqrt(max(value, 0.0)) * vector
        share = min(_CHECKS.step_sigmas, _largest_share(fit, step))
        ahead = depths(_shifted(fit, share * step), uv0[both], uv1[both])
        behind = depths(_shifted(fit, -share * step), uv0[both], uv1[both])
        total += ((ahead - behind) / (2 * share)) ** 2
    out[both] = np.sqrt(total)
    return out


def _largest_share(fit: RigFit, step: FloatArray) -> float:
    """Return by which factor a step of the unknowns (S,) is a small one of each; few views leave a
    focal length free by more than itself, and depths are linear in small steps alone.
    """
    layout = layout_of(fit.cameras)
    parts: list[FloatArray] = []
    for camera, lens in zip(fit.cameras, layout.lenses, strict=True):
        parts += [step[lens][:4] / camera.fu, step[lens][4:]]
    for c, pose in enumerate(layout.poses):
        shift = step[pose][:3] / np.linalg.norm(fit.T_cam_cam0[c + 1][:3, 3])
        parts += [shift, step[pose][3:]]
    return _CHECKS.max_step / max(float(np.abs(np.concatenate(parts)).max()), 1e-12)


def compare_halves(found: Adjusted, seen: Sightings) -> Halves:
    """Calibrate by every other view and return how far apart the results are.

    They alternate among views that the same cameras have, so that neither half lacks a camera.
    """
    has_image = np.zeros((seen.views, seen.cameras), dtype=bool)
    has_image[seen.view, seen.camera] = True
    by_cameras = np.lexsort(has_image.T)
    fits: list[Adjusted] = []
    for part in (0, 1):
        chosen = np.sort(by_cameras[part::2])
        start = replace(found.at, T_cam0_board=found.at.T_cam0_board[chosen])
        fits.append(BoardAdjustment(seen.of_views(chosen)).solve(start))
    one = fits[0].at
    other = fits[1].at
    off = [projection_difference(a, b) for a, b in zip(one.cameras, other.cameras, strict=True)]
    depth_m = 0.0
    if seen.cameras > 1:
        uv0, uv1, both = _pixels_at_depth(found.at, DEPTH_M)
        if both.any():
            apart = depths(one, uv0[both], uv1[both]) - depths(other, uv0[both], uv1[both])
            depth_m = 0.5 * float(np.sqrt(np.mean(apart**2)))
    d = shared_difference(one, other)
    covariance = fits[0].covariance + fits[1].covariance
    nees = float(d @ np.linalg.solve(covariance, d))
    ratio = float(np.sqrt(nees / len(d)))
    map_ratio = _map_ratio(replace(found, covariance=covariance), off, depth_m)
    return Halves(tuple(off), depth_m, ratio, len(d), map_ratio)


def _map_ratio(difference: Adjusted, off_px: Sequence[FloatArray], depth_m: float) -> float:
    """Return the largest ratio of what halves differ by to what is expected of it.

    `difference`: with the covariance of the difference of both halves.
    """
    cameras = difference.at.cameras
    lenses = layout_of(cameras).lenses
    ratios: list[float] = []
    for camera, lens, off in zip(cameras, lenses, off_px, strict=True):
        sigma = projection_sigma(camera, difference.covariance[lens, lens])
        ratios.append(float(np.nanmedian(off / (MEDIAN_TO_SIGMA * np.maximum(sigma, 1e-9)))))
    if len(cameras) > 1:
        depth = 0.5 * depth_sigma(difference)
        depth = depth[np.isfinite(depth)]
        if len(depth):
            ratios.append(depth_m / max(float(np.sqrt(np.mean(depth**2))), 1e-9))
    return max(ratios)


def shared_difference(a: RigFit, b: RigFit) -> FloatArray:
    """Return by how much the shared unknowns (S,) of one fit differ from another's, see `Layout`."""
    layout = layout_of(a.cameras)
    out = np.zeros(layout.size)
    for lens, mine, its in zip(layout.lenses, a.cameras, b.cameras, strict=True):
        out[lens] = _intrinsics(mine) - _intrinsics(its)
    for c, pose in enumerate(layout.poses):
        out[pose] = se3_log(a.T_cam_cam0[c + 1] @ se3_inverse(b.T_cam_cam0[c + 1]))
    out[layout.bow] = a.bow - b.bow
    return out


def _intrinsics(camera: CameraModel) -> FloatArray:
    return np.array([camera.fu, camera.fv, camera.cu, camera.cv, *camera.coefficients])


def judge(found: Adjusted, seen: Sightings, alone_sigma_px: Sequence[float]) -> Verdict:
    """Return the verdict on a calibration.

    Args:
        found: the adjustment.
        seen: what it was made of.
        alone_sigma_px: residuals of each camera when adjusted without the other.
    """
    layout = layout_of(found.at.cameras)
    cameras = found.at.cameras
    sigma = tuple(
        projection_sigma(camera, found.covariance[lens, lens])
        for camera, lens in zip(cameras, layout.lenses, strict=True)
    )
    if seen.cameras > 1:
        depth = depth_sigma(found)
    else:
        depth = np.full(1, np.nan)
    halves = compare_halves(found, seen)
    inflation = _inflation(halves)
    findings = [
        *_unsynchronised(found, alone_sigma_px),
        *_unequal(alone_sigma_px),
        *_contradicting_views(found, seen),
        *coverage_findings(seen, cameras),
        *tilt_findings(found.at),
    ]
    if inflation > 1:
        findings.append(
            f"halves of the views disagree {inflation:.1f} times more than the residuals explain "
            "(a lens that the model does not hold, a board that bends, blurred corners, or a "
            "rolling shutter in motion): "
            "standard deviations are multiplied by that"
        )
    grid = tuple(pixel_grid(camera) for camera in cameras)
    return Verdict(grid, sigma, depth, halves, inflation, tuple(findings))


def _inflation(halves: Halves) -> float:
    """Return the factor by which stated sigmas are too small, as halves show it; 1: they are not.

    All unknowns together say whether chance explains the difference; where it does not, the factor
    is the largest of the ratios. A map alone would not do: few unknowns rule it, and it exceeds 1.5
    in one healthy recording of five.
    Reference: Birge, The calculation of errors by the method of least squares (1932).
    """
    by_chance = np.sqrt(
        chi_square_quantile(_CHECKS.chance_probability, halves.unknowns) / halves.unknowns
    )
    if halves.ratio > by_chance:
        return max(halves.ratio, halves.map_ratio)
    return 1.0


def _unsynchronised(found: Adjusted, alone_sigma_px: Sequence[float]) -> list[str]:
    pairs = zip(found.sigma_px.tolist(), alone_sigma_px, strict=True)
    worst = max(together / alone for together, alone in pairs)
    if len(alone_sigma_px) < 2 or worst < _CHECKS.unsynchronised_ratio:
        return []
    return [
        f"corners fit each camera alone {worst:.1f} times better than the pair: left and right "
        "images were not exposed at the same moment, or the cameras moved against each other; "
        "record with a hardware trigger, or hold the board still for each pair"
    ]


def _unequal(alone_sigma_px: Sequence[float]) -> list[str]:
    """Return whether one camera of a pair sees the corners much less accurately."""
    worst = int(np.argmax(alone_sigma_px))
    ratio = alone_sigma_px[worst] / min(alone_sigma_px)
    if ratio < _UNEQUAL:
        return []
    return [
        f"the {('left', 'right')[worst]} camera's corners are {ratio:.1f} times less accurate than "
        "the other one's: focus it, clean its lens, or shorten its exposure"
    ]


def _contradicting_views(found: Adjusted, seen: Sightings) -> list[str]:
    """Return the camera of a pair most of whose corners are refused in several views, which the
    robust fit leaves out like single wrong corners.
    """
    if seen.cameras < 2:
        return []
    out: list[str] = []
    for c, name in enumerate(("left", "right")):
        rows = seen.camera == c
        shown = np.bincount(seen.view[rows], minlength=seen.views)
        refused = np.bincount(seen.view[rows & ~found.used], minlength=seen.views)
        views = np.flatnonzero(2 * refused > shown)
        if len(views) >= max(_CHECKS.contradicting_views, _CHECKS.contradicting_share * seen.views):
            out.append(
                f"most corners of the {name} camera contradict the others in {len(views)} of "
                f"{seen.views} views (from view {views[0] + 1} to {views[-1] + 1}) and are left out: "
                "the cameras were moved against each other, or refocused, between these views and the "
                "others; fasten them and record again, or calibrate either part alone"
            )
    return out


def corners_by_part(uv: FloatArray, width: int, height: int) -> FloatArray:
    """Return how many pixels (K, 2) lie in each of the image's parts (CELLS^2,), row by row."""
    cell = np.clip(uv * CELLS / [width, height], 0, CELLS - 0.01).astype(int)
    counts = np.bincount(CELLS * cell[:, 1] + cell[:, 0], minlength=CELLS**2)
    return counts.astype(np.float64)


def part_name(number: int) -> str:
    """Return the name of one of the image's parts."""
    return f"{_ROWS[number // CELLS]} {_COLS[number % CELLS]}"


def coverage_findings(seen: Sightings, cameras: Sequence[CameraModel]) -> list[str]:
    """Return which parts of the images hold no corners, one line for each camera."""
    out: list[str] = []
    names: tuple[str, ...] = ("",)
    if len(cameras) > 1:
        names = ("left", "right")
    for c, camera in enumerate(cameras):
        uv = seen.uv[seen.camera == c]
        counts = corners_by_part(uv, camera.width, camera.height)
        few = np.flatnonzero(counts < _CHECKS.min_cell_share * len(uv)).tolist()
        empty = [part_name(k) for k in few]
        if empty:
            image = "image"
            if names[c]:
                image = f"{names[c]} image"
            out.append(f"the {image} is empty at {', '.join(empty)}: show the board there")
    return out


def board_tilts_deg(fit: RigFit) -> FloatArray:
    """Return by how much the board was tilted in each view (V, 2): forwards and backwards, and to
    the left and right.
    """
    normal = fit.T_cam0_board[:, :3, 2]
    about_x = np.arctan2(normal[:, 1], normal[:, 2])
    about_y = np.arctan2(normal[:, 0], normal[:, 2])
    return np.degrees(np.column_stack([about_x, about_y]))


def tilt_findings(fit: RigFit) -> list[str]:
    """Return the axes about which the board was not tilted."""
    about_x, about_y = board_tilts_deg(fit).T
    out: list[str] = []
    for tilt, words in ((about_x, "forwards and backwards"), (about_y, "to the left and right")):
        if float(np.percentile(np.abs(tilt), 90)) < MIN_TILT_DEG:
            out.append(
                f"the board is tilted {words} by less than {MIN_TILT_DEG:.0f} degrees: tilt it "
                "more, up to 40 degrees"
            )
    return out
