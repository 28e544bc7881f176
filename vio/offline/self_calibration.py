"""Bundle adjustment of segments of video with the calibration of the stereo pair free: what motion
determines of it.

All segments share the calibration; each has its own poses and points, which are eliminated. A prior
decides where neither matches nor motion do. Standard deviations come from the scatter of what
regions of the image say (a sandwich estimate clustered by region and segment), as errors of a lens
model, of features that wander along edges and of moving objects are shared by all rows of a region.
References: Triggs et al., Bundle adjustment: a modern synthesis (2000) for the elimination; Liang &
Zeger, Longitudinal data analysis using generalized linear models, Biometrika (1986) for the
covariance; Bell & McCaffrey, Bias reduction in standard errors for linear regression with multi-stage
samples, Survey Methodology (2002) for the share of an error that a fit takes.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from vio.calibration.findings import NotObservable
from vio.calibration.intrinsics import Intrinsics, judged_observable
from vio.calibration.stereo_field import PARAMETERS
from vio.errors import EstimationError
from vio.geometry.lie import FloatArray, se3_exp, se3_inverse, so3_exp, so3_hat, so3_left_jacobian
from vio.geometry.stereo import StereoCamera
from vio.numerics.kinds import Tolerance
from vio.numerics.least_squares import Damping
from vio.numerics.robust import robust_sigma
from vio.offline.points import MIN_DEPTH_M, PointTracks, keep_rows
from vio.records import BoolArray, IntArray

# Of both cameras: focal length and its ratio along v to along u (relative), principal point (focal
# lengths), radial and tangential distortion. Of the right camera against the left one: rotation
# (rad, its points p are seen as `exp(w) p`), direction of the baseline (over its length), principal
# point, focal lengths, tangential distortion.
NAMES = (
    *("focal", "aspect", "cu", "cv", "k", "q1", "q2"),
    *("wx", "wy", "wz", "ty", "tz", "right_cu", "right_cv", "right_fu", "right_fv", "p1", "p2"),
)
# Widths of a Cauchy prior: intrinsics of a good calibration are right to a few per cent, and the
# right camera agrees with the left one as in vio.calibration.stereo_field.
_PRIOR = np.array(
    [
        *[0.05, 0.005, 0.02, 0.02, 1e-2, 2e-3, 2e-3],
        *[np.radians(0.5)] * 3,
        *[5e-3] * 2,
        *[2e-3] * 4,
        *[2e-3] * 2,
    ]
)
# in `stereo_field.PARAMETERS`
_OF_RIGHT = {"cu": "right_cu", "cv": "right_cv", "fu": "right_fu", "fv": "right_fv"}
# those estimated here
_FREE = tuple(name for name in PARAMETERS if _OF_RIGHT.get(name, name) in NAMES)
# of the right camera, as of both
_LIKE_BOTH = (("right_cu", "cu"), ("right_cv", "cv"), ("p1", "q1"), ("p2", "q2"))
INTRINSICS = ("focal", "aspect", "cu", "cv")


@dataclass(frozen=True, slots=True)
class _RefinementRules:
    """How a calibration is refined by its own images."""

    # What lens models leave, beside the scatter: this and the sliding window differ by so much on
    # the same drives. Over a shorter path it turns depths more.
    lens_deg: float = 0.01
    lens_direction_deg: float = 0.3
    lens_frames: int = 36  # of pieces of which that was found
    held: Tolerance[float] = 1e-9  # standard deviation of what is not free
    max_steps: Tolerance[int] = 30  # of Levenberg-Marquardt
    min_damping: Tolerance[float] = 1e-10
    max_damping: Tolerance[float] = 1e4
    converged_share: Tolerance[float] = 1e-6  # relative change of the cost
    # robust standard deviation above which the tracks are not of one rigid scene and rig
    max_residual_px: float = 1.5
    cauchy_sigmas: float = 2.0  # residuals of so many standard deviations count half
    gate_sigmas: float = 5.0  # rows with larger residuals, in standard deviations, are left out
    # of a point's information, against rounding; more of it passes for knowledge of depths
    rounding: Tolerance[float] = 1e-12
    cells: tuple[int, int] = (8, 4)  # regions of the image, along u and v
    # of a region's error in any direction by the parameters, so that it can be told from what is left
    most_taken: float = 0.95
    min_residual_px: Tolerance[float] = 0.02  # of exact tracks, so that weights stay finite


_REFINEMENT = _RefinementRules()


@dataclass(frozen=True, slots=True)
class Segment:
    """Keyframes of a piece of video, with points and their rows."""

    T_world_cam0: FloatArray  # (K, 4, 4)
    tracks: PointTracks
    frames: int  # of the piece


@dataclass(frozen=True, slots=True)
class SelfCalibration:
    """What the calibration is off by."""

    values: FloatArray  # (18,) in the order and units of `NAMES`
    # (18,) standard deviations; those of the prior where the motion determines nothing
    sigmas: FloatArray
    covariance: FloatArray  # (18, 18)
    segments: int
    points: int
    residual_px: float  # robust standard deviation of a pixel coordinate
    frames: int  # of the longest segment

    @property
    def lens_deg(self) -> float:
        """What lens models leave of a rotation, as a standard deviation."""
        return _REFINEMENT.lens_deg * max(_REFINEMENT.lens_frames / self.frames, 1.0)

    def right_camera(self) -> tuple[FloatArray, FloatArray, float, float]:
        """Return how the right camera lies as far as the image's centre determines it, with
        standard deviations.

        A turn about the vertical or horizontal axis, a principal point and a tangential distortion
        move pixels almost alike; the turn that moves the image's centre as all of them do together
        is well determined, and is returned.

        Returns:
            `R_cam1_cam0` (3, 3) and the unit direction (3,) from cam0 to cam1 in cam0, rectified;
            standard deviations of both in degrees.
        """
        combine = np.zeros((5, len(NAMES)))
        for row, name, sign in (
            *((0, "wx", 1), (0, "right_cv", -1), (1, "wy", 1), (1, "right_cu", 1), (2, "wz", 1)),
            *((3, "ty", 1), (4, "tz", 1)),
        ):
            combine[row, NAMES.index(name)] = sign
        off = combine @ self.values
        variances = np.diag(combine @ self.covariance @ combine.T)
        direction = np.array([1.0, off[3], off[4]])
        rotation, swing = (
            float(np.degrees(np.sqrt(v.sum()))) for v in (variances[:3], variances[3:])
        )
        return (
            so3_exp(off[:3]),
            direction / np.linalg.norm(direction),
            float(np.hypot(rotation, self.lens_deg)),
            float(np.hypot(swing, _REFINEMENT.lens_direction_deg)),
        )

    def after(self, parameters: FloatArray) -> SelfCalibration:
        """Return the calibration of pixels as they were before a field of parameters (14,) was
        taken out of them.
        """
        values = self.values.copy()
        for name, value in zip(PARAMETERS, parameters, strict=True):
            if name in _FREE:
                values[NAMES.index(_OF_RIGHT.get(name, name))] += value
        return replace(self, values=values)

    def disparity_off(self, camera: StereoCamera, disparity_px: float) -> tuple[float, float]:
        """Return by which disparities of that size are too large in the middle of the image, with
        standard deviation.

        The focal length, which scales disparities and everything else, is not counted.
        """
        depth_m = camera.fu * camera.baseline_m / disparity_px
        x = np.where(np.isin(NAMES, INTRINSICS), 0.0, self.values)
        _, J = _derivatives(camera, x, np.array([[0.0, 0.0, depth_m]]))
        gradient = np.where(np.isin(NAMES, INTRINSICS), 0.0, J[0, 0] - J[0, 2])
        z = project_off(camera, x, np.array([[0.0, 0.0, depth_m]]))[0]
        sigma = np.hypot(
            np.sqrt(gradient @ self.covariance @ gradient),
            camera.fu * np.radians(self.lens_deg),
        )
        return float(z[0] - z[2] - disparity_px), float(sigma)

    def rig_parameters(self) -> FloatArray:
        """Return what the right camera and both lenses are off by (14,), as
        `stereo_field.PARAMETERS` names it.
        """
        values = [
            self.values[NAMES.index(_OF_RIGHT.get(name, name))] if name in _FREE else 0.0
            for name in PARAMETERS
        ]
        return np.array(values)


def intrinsics_of(camera: StereoCamera, found: SelfCalibration) -> Intrinsics | NotObservable:
    """Return focal length and principal point of a calibration with free intrinsics.

    Args:
        camera: the pair as calibrated.
        found: by `self_calibrate` with `intrinsics`.
    """
    focal, _, cu, cv = (float(found.values[NAMES.index(name)]) for name in INTRINSICS)
    sigmas = [float(found.sigmas[NAMES.index(name)]) for name in INTRINSICS]
    return judged_observable(camera, focal, sigmas[0], (cu, cv), (sigmas[2], sigmas[3]))


def project_off(camera: StereoCamera, x: FloatArray, p: FloatArray) -> FloatArray:
    """Pixels (N, 4) `[ul vl ur vr]` of points (N, 3) in the left camera by a pair that is off by
    parameters (18,).
    """
    focal, aspect, cu, cv, k, q1, q2 = x[:7]
    ty, tz, right_cu, right_cv, right_fu, right_fv, p1, p2 = x[10:]
    moved = (p - camera.baseline_m * np.array([1.0, ty, tz])) @ so3_exp(x[7:10]).T
    out = np.empty((len(p), 4))
    lenses = (
        (p, q1, q2, focal, focal + aspect, cu, cv),
        (
            moved,
            q1 + p1,
            q2 + p2,
            focal + right_fu,
            focal + aspect + right_fv,
            cu + right_cu,
            cv + right_cv,
        ),
    )
    for side, (points, t1, t2, fu, fv, u0, v0) in enumerate(lenses):
        a = points[:, 0] / points[:, 2]
        b = points[:, 1] / points[:, 2]
        r2 = a * a + b * b
        bent_a = a * (1 + k * r2) + 2 * t1 * a * b + t2 * (r2 + 2 * a * a)
        bent_b = b * (1 + k * r2) + t1 * (r2 + 2 * b * b) + 2 * t2 * a * b
        out[:, 2 * side] = camera.fu * ((1 + fu) * bent_a + u0) + camera.cu
        out[:, 2 * side + 1] = camera.fv * ((1 + fv) * bent_b + v0) + camera.cv
    return out


def self_calibrate(
    camera: StereoCamera, segments: Sequence[Segment], *, intrinsics: bool
) -> SelfCalibration:
    """Estimate what a rectified pair's calibration is off by, from segments of video.

    The length of the baseline is held: it is the scale.

    Args:
        camera: the pair as calibrated, with image size.
        segments: at least one; rows with gross outliers are weighted down and left out.
        intrinsics: whether focal length, its ratio and the principal point are free, too; else they
            are as given.

    Raises:
        EstimationError: no segment has a consistent track.
    """
    x = np.zeros(len(NAMES))
    pieces = [s for s in segments if len(s.tracks.ids)]
    if not pieces:
        raise EstimationError("not observable because no track is consistent over the keyframes")
    width = np.where(np.isin(NAMES, INTRINSICS) & (not intrinsics), _REFINEMENT.held, _PRIOR)
    x, pieces = _optimum(camera, x, pieces, width)
    sigma = _spread(camera, x, pieces)
    if sigma > _REFINEMENT.max_residual_px:
        raise EstimationError(
            f"not observable because tracks and motion disagree by {sigma:.1f} px"
        )
    x, pieces = _optimum(
        camera, x, [_without_outliers(camera, x, piece, sigma) for piece in pieces], width
    )
    return _with_covariance(camera, x, pieces, width)


def _optimum(
    camera: StereoCamera, x: FloatArray, pieces: list[Segment], width: FloatArray
) -> tuple[FloatArray, list[Segment]]:
    """Return parameters (18,) and segments at the least robust cost, by Levenberg-Marquardt."""
    damping = Damping(_REFINEMENT.max_damping, _REFINEMENT.min_damping)
    for _ in range(_REFINEMENT.max_steps):
        sigma = _spread(camera, x, pieces)
        before = _cost(camera, sigma, width, (x, pieces))
        new = damping.step(
            partial(_after_step, camera, x, pieces, sigma, width),
            partial(_cost, camera, sigma, width),
            before,
        )
        if new is None:
            break
        (x, pieces), after = new
        if before - after < _REFINEMENT.converged_share * before:
            break
    return x, pieces


def _after_step(
    camera: StereoCamera,
    x: FloatArray,
    pieces: Sequence[Segment],
    sigma: float,
    width: FloatArray,
    damping: float,
) -> tuple[FloatArray, list[Segment]]:
    """Return parameters (18,) and segments after a step with so much damping."""
    prior = np.diag(1 / (width**2 + x**2))
    solved = [_normal_equations(camera, x, piece, sigma, damping) for piece in pieces]
    A = np.sum([n.A for n in solved], axis=0) + prior
    dx = np.linalg.solve(
        A + damping * np.diag(np.diag(A)), np.sum([n.b for n in solved], axis=0) - prior @ x
    )
    return x + dx, [n.moved(piece, dx) for n, piece in zip(solved, pieces, strict=True)]


def _with_covariance(
    camera: StereoCamera, x: FloatArray, pieces: Sequence[Segment], width: FloatArray
) -> SelfCalibration:
    """Return parameters (18,) at the optimum with their sandwich covariance; the prior has a
    `width` (18,).
    """
    sigma = _spread(camera, x, pieces)
    prior = np.diag(1 / (width**2 + x**2))
    solved = [_normal_equations(camera, x, piece, sigma, 0.0) for piece in pieces]
    A = np.sum([n.A for n in solved], axis=0) + prior
    scores = _as_before_the_fit(
        np.concatenate([n.scores for n in solved]),
        np.concatenate([n.information for n in solved]),
        A,
    )
    meat = _larger(scores.T @ scores + prior, A)
    inverse = np.linalg.inv(A)
    covariance = np.asarray(inverse @ meat @ inverse, dtype=np.float64)
    allowed = width**2 + x**2
    sigmas = np.sqrt(np.minimum(np.diag(covariance), allowed))
    points = int(sum(len(piece.tracks.ids) for piece in pieces))
    frames = max(piece.frames for piece in pieces)
    return SelfCalibration(x, sigmas, covariance, len(pieces), points, sigma, frames)


def _as_before_the_fit(scores: FloatArray, information: FloatArray, A: FloatArray) -> FloatArray:
    """Return scores (G, n) of regions, enlarged by what the parameters take of them.

    A region that alone determines a parameter leaves no residual, whatever its error. The share
    that is left of its scores is one less its information (G, n, n) over all of it, A (n, n).
    """
    L = np.linalg.cholesky(A)
    whitened = np.linalg.solve(L, scores.T).T
    half = np.linalg.solve(L, information)
    taken = np.linalg.solve(L, np.swapaxes(half, 1, 2))
    values, vectors = np.linalg.eigh(0.5 * (taken + np.swapaxes(taken, 1, 2)))
    left = 1 - np.clip(values, 0.0, _REFINEMENT.most_taken)
    parts = np.einsum("gji,gj->gi", vectors, whitened) / left
    return np.einsum("gij,gj->gi", vectors, parts) @ L.T


def _spread(camera: StereoCamera, x: FloatArray, pieces: Sequence[Segment]) -> float:
    """Return the robust standard deviation of a pixel coordinate."""
    return max(
        robust_sigma(np.concatenate([_residuals(camera, x, s)[1] for s in pieces])),
        _REFINEMENT.min_residual_px,
    )


def _cost(
    camera: StereoCamera,
    sigma: float,
    width: FloatArray,
    moved: tuple[FloatArray, Sequence[Segment]],
) -> float:
    """Return what the steps decrease: Cauchy losses of rows and parameters (18,)."""
    x, pieces = moved
    squares = [np.sum(_residuals(camera, x, piece)[0] ** 2, axis=1) / sigma**2 for piece in pieces]
    width_squared = _REFINEMENT.cauchy_sigmas**2
    rows = sum(
        float(np.sum(2 * width_squared * np.log1p(q / (4 * width_squared)))) for q in squares
    )
    return rows + 0.5 * float(np.sum(np.log1p(x**2 / width**2)))


def _larger(A: FloatArray, B: FloatArray) -> FloatArray:
    """Return a matrix that is not smaller than A and B (n, n) in any direction, by their joint
    diagonalisation.
    """
    L = np.linalg.cholesky(B)
    values, vectors = np.linalg.eigh(np.linalg.solve(L, np.linalg.solve(L, A).T))
    W = L @ vectors
    return (W * np.maximum(values, 1.0)) @ W.T


def _residuals(
    camera: StereoCamera, x: FloatArray, piece: Segment
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return residuals (R, 4), zero where not measured; those measured (n,); and points in the
    camera (R, 3).
    """
    tracks = piece.tracks
    T = se3_inverse(piece.T_world_cam0)[piece.tracks.keyframe]
    p_world = tracks.p_world[tracks.point]
    q = np.einsum("nij,nj->ni", T[:, :3, :3], p_world) + T[:, :3, 3]
    q = np.where((q[:, 2] > MIN_DEPTH_M)[:, None], q, [0.0, 0.0, 1e3])
    r = tracks.z - project_off(camera, x, q)
    measured = np.repeat(tracks.has_right[:, None], 4, axis=1)
    measured[:, :2] = True
    r[~measured] = 0
    return r, r[measured], q


def _without_outliers(camera: StereoCamera, x: FloatArray, piece: Segment, sigma: float) -> Segment:
    r, _, _ = _residuals(camera, x, piece)
    kept = keep_rows(piece.tracks, np.abs(r).max(axis=1) < _REFINEMENT.gate_sigmas * sigma)
    if len(kept.ids):
        return replace(piece, tracks=kept)
    return piece


@dataclass(frozen=True, slots=True)
class _Normal:
    """Normal equations of a segment, with its poses and points eliminated."""

    A: FloatArray  # (18, 18)
    b: FloatArray  # (18,)
    scores: FloatArray  # (G, 18) contributions of regions of the image to b
    information: FloatArray  # (G, 18, 18) and to A
    dp: tuple[FloatArray, FloatArray]  # steps of the points (3M,), by poses and parameters (3M, C)
    # steps of the poses (6(K-1),), by the parameters (6(K-1), 18)
    dpose: tuple[FloatArray, FloatArray]

    def moved(self, piece: Segment, dx: FloatArray) -> Segment:
        """Return the segment at the optimum after a step (18,) of the parameters."""
        first, by_x = self.dpose
        dpose = first - by_x @ dx
        own, by_all = self.dp
        dp = own - by_all @ np.concatenate([dpose, dx])
        T_cam0_world = se3_inverse(piece.T_world_cam0)
        T_cam0_world[1:] = se3_exp(dpose.reshape(-1, 6)) @ T_cam0_world[1:]
        p = piece.tracks.p_world + dp.reshape(-1, 3)
        tracks = replace(piece.tracks, p_world=p)
        return replace(piece, T_world_cam0=se3_inverse(T_cam0_world), tracks=tracks)


def _normal_equations(
    camera: StereoCamera, x: FloatArray, piece: Segment, sigma: float, damping: float
) -> _Normal:
    tracks = piece.tracks
    K = len(piece.T_world_cam0)
    M = len(piece.tracks.ids)
    X = len(NAMES)
    r, _, q = _residuals(camera, x, piece)
    J_q, J_x = _derivatives(camera, x, q)
    J_q[~tracks.has_right, 2:] = 0
    J_x[~tracks.has_right, 2:] = 0
    root = (
        1
        / (
            sigma
            * np.sqrt(1 + np.sum(r**2, axis=1) / (4 * _REFINEMENT.cauchy_sigmas**2 * sigma**2))
        )[:, None, None]
    )
    r = r * root[:, 0]
    J_q = J_q * root
    J_x = J_x * root
    R = se3_inverse(piece.T_world_cam0)[tracks.keyframe, :3, :3]
    J_p = J_q @ R
    J_pose = np.concatenate([J_q, -J_q @ so3_hat(q)], axis=2)
    # Dense rows of each point: by its own coordinates (3), and by poses and parameters (C). A
    # keyframe has it once.
    C = 6 * K + X
    H_pc = np.zeros((M, 3, C))
    g_c = np.zeros((M, C))
    Jt = np.swapaxes(J_p, 1, 2)
    H_pp = _sums(Jt @ J_p, tracks.point, M)
    g_p = _sums((Jt @ r[..., None])[..., 0], tracks.point, M)
    blocks = np.zeros((M, K, 3, 6))
    blocks[tracks.point, tracks.keyframe] = Jt @ J_pose
    H_pc[:, :, : 6 * K] = blocks.transpose(0, 2, 1, 3).reshape(M, 3, 6 * K)
    H_pc[:, :, 6 * K :] = _sums(Jt @ J_x, tracks.point, M)
    H_cc = _reduced_blocks(J_pose, J_x, tracks.keyframe, K)
    gradient = np.zeros((M, K, 6))
    gradient[tracks.point, tracks.keyframe] = (r[:, None] @ J_pose)[:, 0]
    g_c[:, : 6 * K] = gradient.reshape(M, 6 * K)
    g_x = (r[:, None] @ J_x)[:, 0]
    g_c[:, 6 * K :] = _sums(g_x, tracks.point, M)
    H_pp += _REFINEMENT.rounding * np.trace(H_pp, axis1=1, axis2=2)[:, None, None] * np.eye(3)
    H_pp[:, range(3), range(3)] *= 1 + damping
    H_cc[range(6 * K), range(6 * K)] *= 1 + damping
    rows = _Rows(J_pose, J_x, J_p, tracks.point, tracks.keyframe)
    return _eliminated(H_pp, H_pc, g_p, g_c, H_cc, _regions(camera, tracks), rows)


def _sums(values: FloatArray, group: IntArray, groups: int) -> FloatArray:
    """Return the sums (G, ...) over each group of values (N, ...)."""
    order = np.argsort(group, kind="stable")
    first = np.searchsorted(group[order], np.arange(groups))
    out = np.zeros((groups, *values.shape[1:]))
    filled = np.bincount(group, minlength=groups) > 0
    out[filled] = np.add.reduceat(values[order], first[filled], axis=0)
    return out


def _derivatives(
    camera: StereoCamera, x: FloatArray, q: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return derivatives of `project_off` by points (R, 4, 3), in metres, and by parameters (R,
    4, 18).
    """
    named = dict(zip(NAMES, x.tolist(), strict=True))
    R = so3_exp(x[7:10])
    moved = (q - camera.baseline_m * np.array([1.0, named["ty"], named["tz"]])) @ R.T
    moved_D_x = np.zeros((len(q), 3, len(x)))
    moved_D_x[:, :, 7:10] = -so3_hat(moved) @ so3_left_jacobian(x[7:10])
    moved_D_x[:, :, 10:12] = -camera.baseline_m * R[:, 1:]
    J_q = np.empty((len(q), 4, 3))
    J_x = np.zeros((len(q), 4, len(x)))
    tangential = (named["q1"], named["q2"])
    focal = (named["focal"], named["focal"] + named["aspect"])
    J_q[:, :2], J_x[:, :2] = _lens_derivatives(camera, named["k"], tangential, focal, q)
    tangential = tangential[0] + named["p1"], tangential[1] + named["p2"]
    focal = focal[0] + named["right_fu"], focal[1] + named["right_fv"]
    by_moved, J_x[:, 2:] = _lens_derivatives(camera, named["k"], tangential, focal, moved)
    J_q[:, 2:] = by_moved @ R
    for name, common in (*_LIKE_BOTH, ("right_fu", "focal"), ("right_fv", "focal")):
        J_x[:, 2:, NAMES.index(name)] = J_x[:, 2:, NAMES.index(common)]
    J_x[:, 3, NAMES.index("right_fu")] = J_x[:, 2, NAMES.index("right_fv")] = 0
    J_x[:, 2:] += by_moved @ moved_D_x
    return J_q, J_x


def _lens_derivatives(
    camera: StereoCamera,
    k: float,
    tangential: tuple[float, float],
    focal: tuple[float, float],
    p: FloatArray,
) -> tuple[FloatArray, FloatArray]:
    """Return derivatives of one camera's pixels by points in it (R, 2, 3), and by parameters of
    both (R, 2, 18).
    """
    t1, t2 = tangential
    a = p[:, 0] / p[:, 2]
    b = p[:, 1] / p[:, 2]
    ab = a * b
    r2 = a * a + b * b
    of_t1 = np.stack([2 * ab, r2 + 2 * b * b])
    of_t2 = np.stack([r2 + 2 * a * a, 2 * ab])
    bent = np.stack([a, b]) * (1 + k * r2) + t1 * of_t1 + t2 * of_t2
    mixed = 2 * (k * ab + t1 * a + t2 * b)
    radial_a = 1 + k * (r2 + 2 * a * a)
    radial_b = 1 + k * (r2 + 2 * b * b)
    a_D_a = radial_a + 2 * t1 * b + 6 * t2 * a
    b_D_b = radial_b + 6 * t1 * b + 2 * t2 * a
    by_a = np.stack([a_D_a, mixed])
    by_b = np.stack([mixed, b_D_b])
    by_z = -a * by_a - b * by_b
    by_p = np.stack([by_a, by_b, by_z], axis=-1) / p[:, 2:]  # (2, R, 3)
    given = np.array([camera.fu, camera.fv])
    scale = (given * (1 + np.array(focal)))[:, None]
    J = np.zeros((len(p), 2, len(NAMES)))
    for name, columns in (
        ("k", np.stack([a, b]) * r2),
        ("q1", of_t1),
        ("q2", of_t2),
    ):
        J[:, :, NAMES.index(name)] = (scale * columns).T
    J[:, :, NAMES.index("focal")] = (given[:, None] * bent).T
    J[:, 1, NAMES.index("aspect")] = given[1] * bent[1]
    J[:, 0, NAMES.index("cu")], J[:, 1, NAMES.index("cv")] = given
    return (scale[..., None] * by_p).transpose(1, 0, 2), J


def _reduced_blocks(J_pose: FloatArray, J_x: FloatArray, keyframe: IntArray, K: int) -> FloatArray:
    """Return the information (C, C) of poses and parameters for given points."""
    X = J_x.shape[2]
    out = np.zeros((6 * K + X, 6 * K + X))
    for k in range(K):
        own, by_x = (J[keyframe == k].reshape(-1, J.shape[2]) for J in (J_pose, J_x))
        rows = slice(6 * k, 6 * k + 6)
        out[rows, rows] = own.T @ own
        out[rows, 6 * K :] = own.T @ by_x
        out[6 * K :, rows] = out[rows, 6 * K :].T
    flat = J_x.reshape(-1, X)
    out[6 * K :, 6 * K :] = flat.T @ flat
    return out


def _regions(camera: StereoCamera, tracks: PointTracks) -> IntArray:
    """Return the region of the image (M,) in which each point lies on average."""
    count = np.bincount(tracks.point, minlength=len(tracks.ids))
    points = len(tracks.ids)
    u, v = (np.bincount(tracks.point, tracks.z[:, k], points) / count for k in (0, 1))
    width = camera.width or float(u.max()) + 1
    height = camera.height or float(v.max()) + 1
    columns = _REFINEMENT.cells[0]
    column = np.clip(columns * u / width, 0, columns - 1).astype(np.int64)
    rows = _REFINEMENT.cells[1]
    row = np.clip(rows * v / height, 0, rows - 1).astype(np.int64)
    return np.asarray(_REFINEMENT.cells[0] * row + column, dtype=np.int64)


@dataclass(frozen=True, slots=True)
class _Rows:
    """Weighted derivatives of the residuals of R rows."""

    pose: FloatArray  # (R, 4, 6)
    x: FloatArray  # (R, 4, 18)
    p: FloatArray  # (R, 4, 3)
    point: IntArray  # (R,)
    keyframe: IntArray  # (R,)

    def information(self, H_pp: FloatArray, gain: FloatArray) -> FloatArray:
        """Return what each of M points tells of the parameters (M, 18, 18), with the points (M, 3, 3)
        and the poses but the first eliminated, whose steps by the parameters are `-gain`.
        """
        by_pose = np.concatenate(
            [np.zeros((1, 6, gain.shape[1])), gain.reshape(-1, 6, gain.shape[1])]
        )
        J = self.x - self.pose @ by_pose[self.keyframe]
        Jt = np.swapaxes(J, 1, 2)
        H_xx = _sums(Jt @ J, self.point, len(H_pp))
        H_xp = _sums(Jt @ self.p, self.point, len(H_pp))
        return np.asarray(H_xx - H_xp @ np.linalg.solve(H_pp, np.swapaxes(H_xp, 1, 2)))


def _eliminated(
    H_pp: FloatArray,
    H_pc: FloatArray,
    g_p: FloatArray,
    g_c: FloatArray,
    H_cc: FloatArray,
    region: IntArray,
    rows: _Rows,
) -> _Normal:
    """Eliminate points, then poses; the first pose is held."""
    M, _, C = H_pc.shape
    X = len(NAMES)
    by_c = np.linalg.solve(H_pp, H_pc)
    own = np.linalg.solve(H_pp, g_p[..., None])[..., 0]
    S = H_cc - H_pc.reshape(-1, C).T @ by_c.reshape(-1, C)
    scores = g_c - np.einsum("mic,mi->mc", H_pc, own)
    regions = _sums(scores, region, int(region.max()) + 1)
    poses = np.arange(6, C - X)
    params = np.arange(C - X, C)
    S_poses = S[np.ix_(poses, poses)]
    damping = 1e-9 * np.eye(len(poses)) * np.trace(S_poses) / max(len(poses), 1)
    S_pp = S_poses + damping
    gain = np.linalg.solve(S_pp, S[np.ix_(poses, params)])
    g = scores.sum(axis=0)
    kept: BoolArray = np.bincount(region, minlength=len(regions)) > 0
    S_cp = S[np.ix_(params, poses)]
    of_regions = regions[:, params] - regions[:, poses] @ gain
    information = _sums(rows.information(H_pp, gain), region, len(regions))
    return _Normal(
        A=S[np.ix_(params, params)] - S_cp @ gain,
        b=g[params] - gain.T @ g[poses],
        scores=of_regions[kept],
        information=information[kept],
        dp=(
            np.asarray(own.ravel(), dtype=np.float64),
            np.asarray(by_c.reshape(3 * M, C)[:, 6:], dtype=np.float64),
        ),
        dpose=(np.linalg.solve(S_pp, g[poses]), np.asarray(gain, dtype=np.float64)),
    )
