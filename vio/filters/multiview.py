"""Many tracks over many clones at once: triangulation, residuals, and the information they hold
about the poses.

Shapes: F tracks, N clones. A track's landmark is a point of the world; its error is taken out of
the problem exactly (Schur complement, the same as projecting onto the left null space of its
Jacobian, a test shows), so tracks need no place in the state. All steps and eliminations of points
happen in inverse depth (M5), whose equations stay well conditioned however far the point is.
Equation numbers (M1) … are those of docs/math.md.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from vio.cameras.projection import camera_args
from vio.filters import track_loops as loops
from vio.geometry.lie import FloatArray
from vio.geometry.stereo import StereoCamera
from vio.records import BoolArray, IntArray

MIN_DEPTH = 0.5  # baselines; nearer points are mismatches
CAUCHY = 3.0  # residuals beyond this many sigmas lose most of their weight
_MEDIAN = 2.37  # of chi-square with 3 degrees of freedom, those of a stereo view
# of a point at infinity: ten baselines of motion move it by a hundredth of a pixel
MIN_DISPARITY_PX = 1e-3
# per px^2, information on the disparity: its standard deviation is 1000 px, half of what MIN_DEPTH
# shows
_PRIOR = 1e-6
_STEREO_VARIANCE = 2.0  # px^2, of the disparity of one stereo view, for one pixel of noise
# One camera, whose unit of length is arbitrary: standard deviation of an inverse depth over itself,
# for one pixel of noise, at most. With a limit in the unit, slow flights have no track; with one
# for the learned noise, standstills have too many (docs/notes/design_decisions.md, depth of one
# camera's tracks).
_MONO_DEPTH_SIGMA = 0.15
_TINY = 1e-12  # keeps what nothing was seen of invertible
# Gauss-Newton steps on a new point without a stereo view, before any pose has moved
_PARALLAX_STEPS = 3


@dataclass(frozen=True, slots=True)
class Views:
    """What F tracks showed in N clones."""

    z: FloatArray  # (F, N, 4) pixels [ul vl ur vr]; arbitrary where unseen
    # (F, N, 4) one over a coordinate's relative standard deviation; 0: not measured
    weight: FloatArray

    def take(self, index: BoolArray) -> Views:
        """Return the tracks of a mask (F,)."""
        return self if index.all() else Views(self.z[index], self.weight[index])


@dataclass(frozen=True, slots=True)
class Residuals:
    """Residuals of tracks at given poses and points, and their Jacobians, times the weights of
    the views.
    """

    r: FloatArray  # (F, N, 4) pixels, zero where unseen
    # (F, N, 4, 3) with respect to the point in the world frame, zero where unseen
    z_D_p: FloatArray
    ahead: BoolArray  # (F,) the point lies in front of every camera that saw it
    weight: FloatArray  # (F, N, 4) as in `Views`

    def take(self, index: BoolArray | IntArray) -> Residuals:
        """Return the tracks of a mask (F,) or of rows (K,)."""
        if index.dtype == np.bool_ and index.all():
            return self
        return Residuals(self.r[index], self.z_D_p[index], self.ahead[index], self.weight[index])

    def predicted(self, z: FloatArray) -> FloatArray:
        """Pixels (F, N, 4) that are expected where z (F, N, 4) were seen."""
        return unweighted(z, self.r, self.weight)


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
    F = len(p_world)
    N = len(T_cam0_world)
    at = Residuals(
        np.empty((F, N, 4)), np.empty((F, N, 4, 3)), np.empty(F, dtype=np.bool_), views.weight
    )
    least = MIN_DEPTH * camera.baseline_m
    loops.compare_views(
        camera_args(camera),
        least,
        T_cam0_world,
        p_world,
        views.z,
        views.weight,
        at.r,
        at.z_D_p,
        at.ahead,
    )
    return at


def unweighted(z: FloatArray, r: FloatArray, weight: FloatArray) -> FloatArray:
    """Pixels (..., 4) that are expected where z was seen, of residuals times weights."""
    out: FloatArray = np.empty(z.shape)
    loops.expected_pixels(
        z.reshape(-1, 4), r.reshape(-1, 4), weight.reshape(-1, 4), out.reshape(-1, 4)
    )
    return out


def squared_residuals(at: Residuals) -> tuple[FloatArray, IntArray]:
    """Squared residuals (F, N) of views, and how many pixel coordinates (F, N) of each were
    measured.
    """
    squares = np.empty(at.r.shape[:2])
    count = np.empty(at.r.shape[:2], dtype=np.int64)
    loops.square_views(at.r, at.z_D_p, squares, count)
    return squares, count


@dataclass(frozen=True, slots=True)
class InverseDepth:
    """Coordinates of F points as one of their cameras sees them, equation (M5).

    `q = fu [x/z, y/z, b/z]`, pixels: the place in the left image, and the disparity, measured or
    not.
    """

    anchor: IntArray  # (F,) the clone whose camera it is: the first that saw the point
    centre: FloatArray  # (F, 3) of that camera, world
    disparity: FloatArray  # (F,) the third coordinate
    # (F, 3, 3) metres in the world per pixel; the third column points from the point to the camera
    p_D_q: FloatArray
    q_D_p: FloatArray  # (F, 3, 3) its inverse

    def take(self, rows: IntArray) -> InverseDepth:
        """Return the points of rows (K,)."""
        q = self
        return InverseDepth(
            q.anchor[rows], q.centre[rows], q.disparity[rows], q.p_D_q[rows], q.q_D_p[rows]
        )


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
    left_only: BoolArray = ~known & (np.sum(earlier[..., 0] > 0, axis=1) >= 2)
    if left_only.any():
        left = Views(views.z[left_only], earlier[left_only])
        start: FloatArray = np.empty((len(left.z), 3))
        loops.start_by_parallax(
            camera_args(camera), disparities, _TINY, T_cam0_world, left.z, left.weight, start
        )
        p[left_only] = refine_points(camera, T_cam0_world, start, left, _PARALLAX_STEPS, CAUCHY)
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
    lens = camera_args(camera)
    least = MIN_DEPTH * camera.baseline_m
    views_of = T_cam0_world, views.z, views.weight
    loops.refine(lens, least, MIN_DISPARITY_PX, *views_of, steps, scale_px**2, _TINY, _PRIOR, p)
    return p


def robust_weights(at: Residuals, sigma2: float) -> FloatArray:
    """Cauchy weights (F, N) of all views; the scale is each clone's own, as a predicted pose is off
    as a whole.

    Args:
        at: residuals and Jacobians.
        sigma2: the pixel noise's variance, the smallest scale.
    """
    weights = np.empty(at.r.shape[:2])
    loops.weigh_views(at.r, at.z_D_p, sigma2, _MEDIAN, CAUCHY, weights)
    return weights


@dataclass(frozen=True, slots=True)
class LandmarkResiduals:
    """Residuals of landmarks in one camera, their Jacobians `dz = J dp`, and the weights that
    they enter a fit with.
    """

    r: FloatArray  # (K, 4) pixels, zero where not measured, times the precision
    J: FloatArray  # (K, 4, 3) with respect to the point in the world frame, likewise
    weight: FloatArray  # (K,) robust weights
    precision: FloatArray  # (K, 4) the weight of `Views`


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


@dataclass(frozen=True, slots=True)
class TrackInformation:
    """What tracks say of the clones once their points are eliminated; pixel noise is one pixel
    here.
    """

    q: InverseDepth  # the points' coordinates, pixels
    G: FloatArray  # (F, 6N, 3) cross information of clones and point
    C: FloatArray  # (F, 3, 3) information of the point
    # (F, 3, 6) how a clone's error moves a point as that clone sees it: S^-1 B
    q_D_clone: FloatArray
    gradient: FloatArray  # (F, 6N) before the point is eliminated
    point_gradient: FloatArray  # (F, 3)

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
        q = self.q
        p = np.empty((len(self.C), 3))
        gradient = self.point_gradient - other
        point = q.centre, q.p_D_q, q.disparity, MIN_DISPARITY_PX
        loops.substitute_back(
            self.G, self.C, gradient, *point, np.ascontiguousarray(clone_errors), p
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
    q = InverseDepth(
        np.empty(F, np.int64),
        np.empty((F, 3)),
        np.empty(F),
        np.empty((F, 3, 3)),
        np.empty((F, 3, 3)),
    )
    of_clones = np.empty((F, 6 * N, 3))
    B = np.empty((F, 3, 6))
    C = np.empty((F, 3, 3))
    info = TrackInformation(q, of_clones, C, B, np.empty((F, 6 * N)), np.empty((F, 3)))
    place = q.anchor, q.centre, q.disparity, q.p_D_q, q.q_D_p
    out = *place, info.G, info.C, info.q_D_clone, info.gradient, info.point_gradient
    least = MIN_DEPTH * camera.baseline_m
    loops.collect_tracks(
        camera_args(camera), least, T_cam0_world, at.r, at.z_D_p, weight, p_world, _PRIOR, *out
    )
    return info


def relative_stereo_sigma(at: Residuals, q: InverseDepth, chosen: IntArray) -> FloatArray:
    """Standard deviation of the inverse depths of tracks (K,) by the right views alone, over
    itself.

    It is that for one pixel of noise; infinite without a right view.
    """
    out: FloatArray = np.empty(len(chosen))
    loops.stereo_sigmas(chosen, at.z_D_p, q.disparity, _STEREO_VARIANCE, out)
    return out


def usable_points(
    camera: StereoCamera, T_cam0_world: FloatArray, p_world: FloatArray, views: Views, at: Residuals
) -> BoolArray:
    """Which tracks (F,) have a finite point ahead of all cameras that saw it, and its depth by
    stereo or parallax.

    That is a right view, or a parallax that fixes the depth as well as one stereo view would. With
    less, the estimated depth follows the noise, and its Jacobian by the clones' translations with
    it: information that is not there, and a scale that shrinks. Of one camera, whose unit of length
    is arbitrary, the depth must be known relative to itself.
    """
    keep: BoolArray = np.empty(len(p_world), dtype=np.bool_)
    limits = (0.0, _MONO_DEPTH_SIGMA**2) if camera.kind == "mono" else (_STEREO_VARIANCE, 0.0)
    seen = T_cam0_world, p_world, views.weight, at.z_D_p, at.ahead
    loops.mark_usable(
        camera_args(camera), MIN_DEPTH * camera.baseline_m, *seen, _TINY, _PRIOR, limits, keep
    )
    return keep
