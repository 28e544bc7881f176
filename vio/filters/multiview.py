"""Many tracks over many clones at once: triangulation, residuals, and the information they hold
about the poses.

Shapes: F tracks, N clones. A track's landmark is a point of the world; its error is taken out of
the problem exactly (Schur complement, the same as projecting onto the left null space of its
Jacobian, a test shows), so tracks need no place in the state. All steps and eliminations of points
happen in inverse depth (M5), whose equations stay well conditioned however far the point is.
Equation numbers (M1) … are those of docs/math.md.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from vio.cameras.projection import camera_args
from vio.filters import track_loops as loops
from vio.filters.track_records import (
    Cameras,
    Damping,
    DepthLimits,
    InverseDepth,
    LandmarkResiduals,
    Residuals,
    TrackColumns,
    Views,
)
from vio.geometry.lie import FloatArray
from vio.geometry.stereo import StereoCamera
from vio.numerics.kinds import Tolerance
from vio.records import BoolArray, IntArray

MIN_DEPTH = 0.5  # baselines; nearer points are mismatches
CAUCHY = 3.0  # residuals beyond this many sigmas lose most of their weight


class _TriangulationRules(NamedTuple):
    """How points are triangulated, and how much a view and a point count."""

    # of chi-square with 3 degrees of freedom, those of a stereo view
    chi_square_median: float = 2.37
    # per px^2, information on the disparity: its standard deviation is 1000 px, half of what
    # MIN_DEPTH shows
    disparity_information: Tolerance[float] = 1e-6
    # px^2, of the disparity of one stereo view, for one pixel of noise
    stereo_variance_px2: float = 2.0
    # One camera, whose unit of length is arbitrary: standard deviation of an inverse depth over
    # itself, for one pixel of noise, at most. With a limit in the unit, slow flights have no track;
    # with one for the learned noise, standstills have too many (docs/notes/design_decisions.md,
    # depth of one camera's tracks).
    mono_depth_sigma: float = 0.15
    tiny: Tolerance[float] = 1e-12  # keeps what nothing was seen of invertible
    # Gauss-Newton steps on a new point without a stereo view, before any pose has moved; after two,
    # it is nearer to where many end than to the truth by a factor of 30
    parallax_steps: Tolerance[int] = 3


_TRIANGULATION = _TriangulationRules()
# of a point at infinity: ten baselines of motion move it by a hundredth of a pixel
MIN_DISPARITY_PX: Tolerance[float] = 1e-3


def residuals(
    camera: StereoCamera, T_cam0_world: FloatArray, p_world: FloatArray, views: Views
) -> Residuals:
    """Compare predicted with seen pixels, equation (M1).

    Args:
        camera: rectified pair.
        T_cam0_world: (N, 4, 4).
        p_world: (F, 3).
        views: what was seen.
    """
    at = _room(views)
    loops.compare_views(_cameras(camera, T_cam0_world), p_world, views, at)
    return at


def _cameras(camera: StereoCamera, T_cam0_world: FloatArray) -> Cameras:
    return Cameras(camera_args(camera), MIN_DEPTH * camera.baseline_m, T_cam0_world)


def _room(views: Views) -> Residuals:
    """Room for the residuals of views."""
    F, N = views.weight.shape[:2]
    ahead: BoolArray = np.empty(F, dtype=np.bool_)
    return Residuals(np.empty((F, N, 4)), np.empty((F, N, 4, 3)), ahead, views.weight)


def unweighted(z: FloatArray, r: FloatArray, weight: FloatArray) -> FloatArray:
    """Pixels (F, N, 4) that are expected where z was seen, of residuals times weights."""
    out: FloatArray = np.empty(z.shape)
    loops.expected_pixels(z, r, weight, out)
    return out


def squared_residuals(at: Residuals) -> tuple[FloatArray, IntArray]:
    """Squared residuals (F, N) of views, and how many pixel coordinates (F, N) of each were
    measured.
    """
    squares = np.empty(at.r.shape[:2])
    count = np.empty(at.r.shape[:2], dtype=np.int64)
    loops.square_views(at.r, at.z_D_p, squares, count)
    return squares, count


def first_points(
    camera: StereoCamera, T_cam0_world: FloatArray, views: Views
) -> tuple[FloatArray, BoolArray]:
    """Points (F, 3) in the world from each track's stereo view of largest disparity, or else from
    parallax.

    The mask (F,) is False where neither is there. The newest clone's view counts only where it is
    the only stereo view, and never for parallax, as its pose has yet to be corrected. A disparity
    not above zero is a point at infinity.
    """
    p = np.zeros((len(views.z), 3))
    known = np.empty(len(views.z), dtype=np.bool_)
    disparities = MIN_DISPARITY_PX, camera.fu / MIN_DEPTH
    loops.start_by_stereo(
        camera_args(camera), disparities, T_cam0_world, views.z, views.weight, p, known
    )
    if known.all():
        return p, known
    earlier = views.weight.copy()
    earlier[:, -1] = 0.0
    left_only: BoolArray = ~known & ((earlier[..., 0] > 0).sum(axis=1) >= 2)
    if left_only.any():
        left = Views(views.z[left_only], earlier[left_only])
        start: FloatArray = np.empty((len(left.z), 3))
        loops.start_by_parallax(
            camera_args(camera),
            disparities,
            _TRIANGULATION.tiny,
            T_cam0_world,
            left.z,
            left.weight,
            start,
        )
        p[left_only] = refine_points(
            camera, T_cam0_world, start, left, _TRIANGULATION.parallax_steps, CAUCHY
        )
    return p, known | left_only


def refine_points(
    camera: StereoCamera,
    T_cam0_world: FloatArray,
    p_world: FloatArray,
    views: Views,
    steps: int,
    scale_px: float,
) -> FloatArray:
    """Move points (F, 3) by Gauss-Newton steps on all their pixels, with Cauchy weights of a scale
    in pixels.

    Steps are taken in the coordinates (M5), damped by their prior, and end ahead of all cameras
    that saw the point.
    """
    p = p_world.copy()
    loops.refine(_cameras(camera, T_cam0_world), views, steps, _damping(scale_px), p)
    return p


def _damping(scale_px: float) -> Damping:
    """How steps on points are held back, with Cauchy weights of a scale in pixels."""
    information = _TRIANGULATION.disparity_information
    return Damping(scale_px**2, _TRIANGULATION.tiny, information, MIN_DISPARITY_PX)


def linearised_points(
    camera: StereoCamera,
    T_cam0_world: FloatArray,
    p_world: FloatArray,
    views: Views,
    steps: int,
    scale_px: float,
) -> tuple[FloatArray, Residuals, BoolArray]:
    """Move points (F, 3) as `refine_points` does; return them, their `residuals` there, and which
    of them (F,) are finite, ahead of all cameras that saw them, and have a depth by stereo or
    parallax.

    That is a right view, or a parallax that fixes the depth as well as one stereo view would. With
    less, the estimated depth follows the noise, and its Jacobian by the clones' translations with
    it: information that is not there, and a scale that shrinks. Of one camera, whose unit of length
    is arbitrary, the depth must be known relative to itself.
    """
    keep: BoolArray = np.empty(len(p_world), dtype=np.bool_)
    out = p_world.copy(), _room(views), keep
    cameras = _cameras(camera, T_cam0_world)
    loops.linearise(cameras, views, steps, _damping(scale_px), _depth_limits(camera), out)
    return out


def robust_weights(at: Residuals, sigma2: float) -> FloatArray:
    """Cauchy weights (F, N) of all views; the scale is each clone's own, as a predicted pose is off
    as a whole.

    Args:
        at: residuals and Jacobians.
        sigma2: the pixel noise's variance, the smallest scale.
    """
    weights = np.empty(at.r.shape[:2])
    loops.weigh_views(at.r, at.z_D_p, sigma2, _TRIANGULATION.chi_square_median, CAUCHY, weights)
    return weights


def landmark_residuals(
    camera: StereoCamera, T_cam0_world: FloatArray, p_world: FloatArray, views: Views, sigma2: float
) -> LandmarkResiduals:
    """Compare landmarks' predicted pixels in one camera with what was seen.

    Args:
        camera: rectified pair.
        T_cam0_world: (4, 4).
        p_world: (K, 3).
        views: what was seen, (K, 4) each.
        sigma2: the pixel noise's variance, for the robust weights.
    """
    one = Views(views.z[:, None], views.weight[:, None])
    at = residuals(camera, T_cam0_world[None], p_world, one)
    r = at.r.reshape(-1, 4)
    J = at.z_D_p.reshape(-1, 4, 3)
    return LandmarkResiduals(r, J, robust_weights(at, sigma2)[:, 0], views.weight)


class TrackInformation(TrackColumns):
    """What tracks say of the clones once their points are eliminated; pixel noise is one pixel
    here.
    """

    __slots__ = ()

    def take(self, rows: IntArray) -> TrackInformation:
        """Return what the tracks of rows (K,) say."""
        columns = self.G, self.C, self.q_D_clone, self.gradient, self.point_gradient
        return TrackInformation(self.q.take(rows), *(x[rows] for x in columns))

    def moved_points(self, clone_errors: FloatArray, other: FloatArray | float = 0.0) -> FloatArray:
        """Solve each point's own equations once the clones have moved: back-substitution.

        Args:
            clone_errors: (6N,).
            other: what else has moved, as a gradient of the points' equations (F, 3).

        Returns:
            Points (F, 3) in the world.
        """
        p = np.empty((len(self.C), 3))
        gradient = self.point_gradient - other
        loops.substitute_back(
            self, gradient, MIN_DISPARITY_PX, np.ascontiguousarray(clone_errors), p
        )
        return p

    def point_D_clones(self, chosen: IntArray) -> FloatArray:
        """How the estimated points of tracks (K,) follow errors of the clones (K, 3, 6N), world:
        `-C^-1 G'`.
        """
        out: FloatArray = np.empty((len(chosen), 3, self.G.shape[1]))
        loops.points_by_others(chosen, self.C, self.q.p_D_q, self.G, out)
        return out

    def point_covariance(self, chosen: IntArray) -> FloatArray:
        """Covariance (K, 3, 3) of the points of tracks (K,) given the clones, world, for one
        pixel of noise.
        """
        out: FloatArray = np.empty((len(chosen), 3, 3))
        loops.point_covariances(chosen, self.C, self.q.p_D_q, out)
        return out

    def relative_depth_sigma(self) -> FloatArray:
        """Standard deviation (F,) of the inverse depth given the clones over itself, for one
        pixel of noise.
        """
        out: FloatArray = np.empty(len(self.C))
        loops.depth_sigmas(self.C, self.q.disparity, out)
        return out


def track_information(
    camera: StereoCamera,
    T_cam0_world: FloatArray,
    at: Residuals,
    p_world: FloatArray,
    weight: FloatArray,
) -> TrackInformation:
    """Collect the normal equations of tracks, equations (M2), (M3), (M5) and (M6).

    With the right-invariant error of clone i, `dz_i = J_i B xi_i + J_i dp`, where `B = [-I, p^]` is
    the same for all clones: the error of the point is measured from the rotated estimate, so a
    common rotation of all clones about the world's axes leaves every residual alone, whatever the
    estimates.

    Args:
        camera: rectified pair.
        T_cam0_world: (N, 4, 4).
        at: residuals and Jacobians.
        p_world: points (F, 3).
        weight: (F, N) robust weight of each view.
    """
    F, N = at.r.shape[:2]
    of_clones = np.empty((F, 6 * N, 3))
    B = np.empty((F, 3, 6))
    C = np.empty((F, 3, 3))
    info = TrackInformation(
        InverseDepth.empty(F), of_clones, C, B, np.empty((F, 6 * N)), np.empty((F, 3))
    )
    loops.collect_tracks(
        _cameras(camera, T_cam0_world),
        at,
        weight,
        p_world,
        _TRIANGULATION.disparity_information,
        info,
    )
    return info


def relative_stereo_sigma(at: Residuals, q: InverseDepth, chosen: IntArray) -> FloatArray:
    """Standard deviation of the inverse depths of tracks (K,) by the right views alone, over
    itself.

    It is that for one pixel of noise; infinite without a right view.
    """
    out: FloatArray = np.empty(len(chosen))
    loops.stereo_sigmas(chosen, at.z_D_p, q.disparity, _TRIANGULATION.stereo_variance_px2, out)
    return out


def _depth_limits(camera: StereoCamera) -> DepthLimits:
    """When parallax fixes a depth of a camera's points."""
    variances = (
        (0.0, _TRIANGULATION.mono_depth_sigma**2)
        if camera.kind == "mono"
        else (_TRIANGULATION.stereo_variance_px2, 0.0)
    )
    return DepthLimits(*variances, _TRIANGULATION.tiny, _TRIANGULATION.disparity_information)
