"""The start with one camera and an IMU: at standstill, or by visual-inertial alignment once the
scale is observable.

Nothing is estimated before. At standstill (the IMU shows noise alone, and the tracks do not move)
the velocity is zero. In motion, a linear solution (`vio.filters.alignment`) starts Gauss-Newton
over some views of the last seconds, with the same motion model, errors and elimination of points as
the filter has; its covariance is that of the start. The frames that were used have no pose of their
own: the filter begins with the newest one and never sees their pixels again. Equations (V1) to (V6)
of docs/math.md.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from vio.filters.alignment import (
    Bearings,
    FreeMotion,
    VisualInertialAlignment,
    align_visual_inertial,
    gyro_bias,
)
from vio.filters.imu_start import imu_start
from vio.filters.navigation import (
    DIM,
    NO_STEP,
    START_VELOCITY_SIGMA_MPS,
    ZERO_VELOCITY_SIGMA_MPS,
    ImuMotion,
    NavState,
)
from vio.filters.online_calibration import Calibration
from vio.filters.prior import Fit, Prior
from vio.filters.settings import MsckfSettings
from vio.filters.stereo_calibration import eliminate_points
from vio.filters.window import Window
from vio.filters.window_posterior import WindowPosterior, scale_sigma
from vio.filters.window_tracks import LinearTracks, WindowTracks, chi_square_table
from vio.geometry.lie import FloatArray, se3_from_parts, se3_inverse
from vio.geometry.stereo import StereoCamera, left_rays
from vio.geometry.upright import rotation_to_up
from vio.imu.settings import ImuSettings
from vio.imu.standstill import STANDSTILL_S
from vio.numerics.kinds import Tolerance
from vio.numerics.robust import median
from vio.numerics.statistics import chi_square_quantile
from vio.records import ImuSample, Observations, shared_rows


@dataclass(frozen=True, slots=True)
class _StartRules:
    """When one camera and an IMU can start, and how the start is found."""

    # of views: what a gyro bias leaves of rotations is corrected to first order only
    span_s: float = 3.0
    # half of it shows less than the standard deviation of the accelerometer's bias
    min_span_s: float = 0.6
    views: int = 16
    every: int = 5  # frames between two attempts, whose time is that of a dozen updates
    min_tracks: int = 20
    max_tracks: int = 150
    steps: Tolerance[int] = (
        30  # of Gauss-Newton at most: where the scale is hardly known it takes twenty
    )
    converged: Tolerance[float] = 1e-3  # m, m/s and rad
    still_px: float = 0.5  # median motion of the tracks over half a second at standstill
    # chi-square probability of the fit's distance from the prior, which is that of the IMU
    agreement: float = 0.999
    min_px: float = 0.15  # pixel noise that fewer residuals than a filter's cannot prove


_START = _StartRules()


class _GravityRules(NamedTuple):
    """What a start in motion takes of gravity, and how long it waits."""

    tilt_sigma_rad: float = np.radians(15.0)  # of gravity by the linear solution
    # from the first contradiction, after which a start is taken with a covariance that allows for
    # it
    patience_s: float = 5.0


_GRAVITY = _GravityRules()
# of a start; the filter is linear in the scale to half the square of it, 0.5 %
MAX_SCALE_SIGMA = 0.1
_BIASES = slice(9, DIM)  # of gyro and accelerometer, among the errors
# On the densities of accelerometer and gyro, until the filter has learned its own: too small ones
# cost the scale, too large ones time (docs/notes/design_decisions.md, IMU noise at the start).
START_FACTORS = np.array([2.0, 8.0])


@dataclass(frozen=True, slots=True)
class MonoStart:
    """The state at the frame with which the filter begins."""

    nav: NavState  # the world's origin is the body's position there
    P: FloatArray  # (15, 15); zero for position and yaw, which define the world
    scale_sigma: float | None  # standard deviation of the scale over it; None: begun at standstill
    frames: int  # that have passed before


def is_still(
    frames: Sequence[Observations], samples: Sequence[ImuSample], imu: ImuSettings
) -> bool:
    """Whether IMU and tracks show a standstill over the last half second: noise alone, and no
    motion of the features.

    A steady flight looks the same to an IMU, and a distant scene does to a camera; few flights are
    both.

    Args:
        frames: in order of time, the newest last.
        samples: of the IMU, likewise.
        imu: noise densities and standard deviations of the biases.
    """
    now = frames[-1]
    before = [f for f in frames if now.time_ns - f.time_ns >= 0.9e9 * STANDSTILL_S]
    if not before:
        return False
    a, b = shared_rows(before[-1].ids, now.ids)
    if len(a) < _START.min_tracks:
        return False
    flow_px = before[-1].z[a, :2] - now.z[b, :2]
    moved = np.linalg.norm(flow_px, axis=1)
    return bool(median(moved) < _START.still_px) and imu_start(samples, now.time_ns, imu).still


class MonoStarter:
    """Collects frames until one of them can begin."""

    def __init__(
        self,
        camera: StereoCamera,
        T_cam0_imu: FloatArray,
        settings: MsckfSettings,
        imu: ImuSettings,
    ) -> None:
        self._camera = camera
        self._T_cam0_imu = T_cam0_imu
        self._settings = replace(settings, clones=_START.views, max_features=_START.max_tracks)
        self._imu = imu
        self._frames: deque[Observations] = deque()
        self._passed = 0
        # stamp of the first view at which features and IMU did
        self._contradicted_ns: int | None = None
        self.why = "no frame has come"  # the start is not possible yet

    def try_frame(self, seen: Observations, motion: ImuMotion) -> MonoStart | None:
        """Take a frame; return the state at it, or None while nothing can be said of it.

        Args:
            seen: what it shows.
            motion: with the samples up to it; those that are no longer needed are dropped.
        """
        self._passed += 1
        self._frames.append(seen)
        while seen.time_ns - self._frames[0].time_ns > _START.span_s * 1e9:
            self._frames.popleft()
        motion.forget_before(self._frames[0].time_ns - round(1.1 * STANDSTILL_S * 1e9))
        if not motion.ready:
            self.why = "no IMU sample has come"
            return None
        if is_still(self._frames, motion.samples, self._imu):
            return self._still_start(motion)
        span_s = (seen.time_ns - self._frames[0].time_ns) * 1e-9
        if span_s < _START.min_span_s:
            self.why = f"there are {span_s:.2f} s of frames, and a start in motion takes {_START.min_span_s:g} s"
        if span_s < _START.min_span_s or self._passed % _START.every:
            return None
        return self._moving_start(motion)

    def _still_start(self, motion: ImuMotion) -> MonoStart:
        nav, P = motion.start(self._frames[-1].time_ns)
        P[6:9, 6:9] = np.eye(3) * ZERO_VELOCITY_SIGMA_MPS**2
        return MonoStart(nav, P, None, self._passed - 1)

    def _moving_start(self, motion: ImuMotion) -> MonoStart | None:
        views = self._views()
        table = WindowTracks(self._camera, self._settings)
        for k, seen in enumerate(views):
            table.table.add_frame(k, seen)
        rows = table.choose(len(views))
        if len(rows) < _START.min_tracks:
            self.why = f"only {len(rows)} features are seen in several views"
            return None
        begin = self._aligned(motion, views, table)
        if begin is None:
            self.why = "features and IMU determine no velocity"
            return None
        found = self._fit(motion, views, begin, table)
        if found is None:
            return None
        nav, P, sigma = found
        if sigma > MAX_SCALE_SIGMA:
            self.why = (
                f"the scale is known to {100 * sigma:.0f} % only (more than "
                f"{100 * MAX_SCALE_SIGMA:.0f} %); move "
                "the camera sideways with changing speed"
            )
            return None
        return MonoStart(nav, P, sigma, self._passed - 1)

    def _contradiction_persists(self, now_ns: int) -> bool:
        """Note that features and IMU contradict each other; whether they did so long ago, too,
        as by a wrong clock.
        """
        if self._contradicted_ns is None:
            self._contradicted_ns = now_ns
        return now_ns - self._contradicted_ns > _GRAVITY.patience_s * 1e9

    def _views(self) -> list[Observations]:
        """Some of the frames, evenly spaced, with the first and the newest."""
        count = min(_START.views, len(self._frames))
        return [
            self._frames[k]
            for k in np.linspace(0, len(self._frames) - 1, count).round().astype(int)
        ]

    def _aligned(
        self, motion: ImuMotion, views: list[Observations], tracks: WindowTracks
    ) -> NavState | None:
        """The navigation state at the first view by the linear solution.

        None where there is none.
        """
        seen_of = tracks.table.views(tracks.choose(len(views)), len(views))
        T_imu_cam0 = se3_inverse(self._T_cam0_imu)
        rays = left_rays(self._camera, seen_of.z[..., :2]) @ T_imu_cam0[:3, :3].T
        rays = rays / np.linalg.norm(rays, axis=2, keepdims=True)
        bearings = Bearings(rays, seen_of.weight[..., 0] > 0, T_imu_cam0[:3, 3])
        zero = np.zeros(3)
        sigma = self._imu.gyro_bias_sigma_radps
        nav = NavState(np.eye(4), zero, zero, zero, zero)
        for _ in range(2):
            free = self._free_motion(motion, views, nav)
            nav = replace(nav, gyro_bias=nav.gyro_bias + gyro_bias(bearings, free, sigma))
        found = align_visual_inertial(
            bearings, self._free_motion(motion, views, nav), self._imu.gravity_mps2
        )
        return None if found is None else _upright(nav, found)

    def _free_motion(
        self, motion: ImuMotion, views: list[Observations], nav: NavState
    ) -> FreeMotion:
        """Integrate the IMU from a body at rest at the origin, and take its gravity out again."""
        begin_ns = views[0].time_ns
        now = nav
        growth = NO_STEP
        states = [nav]
        phi_D_bias = [np.zeros((3, 3))]
        for before, view in pairwise(views):
            step = motion.advance(now, before.time_ns, view.time_ns)
            now = step.nav
            growth = growth.then(step)
            states.append(now)
            phi_D_bias.append(growth.Phi[3:6, 9:12])
        t = np.array([view.time_ns - begin_ns for view in views]) * 1e-9
        T = np.array([s.T_world_imu for s in states])
        fallen = 0.5 * t[:, None] ** 2 * np.array([0.0, 0.0, -self._imu.gravity_mps2])
        return FreeMotion(t, T[:, :3, :3], T[:, :3, 3] - fallen, np.array(phi_D_bias))

    def _fit(
        self, motion: ImuMotion, views: list[Observations], begin: NavState, tracks: WindowTracks
    ) -> tuple[NavState, FloatArray, float] | None:
        """Gauss-Newton over the views.

        Returns:
            The state at the newest view, its covariance (15, 15) and the standard deviation of the
            scale, both inflated where features and IMU contradict each other.
        """
        for attempt in range(2):  # the second time linearised at the result of the first
            window = self._window(motion, views, begin)
            solved = self._solve(window, len(views), tracks)
            if solved is None:
                return None
            fitted, lin = solved
            if attempt == 0:
                passed, _, _ = tracks.gate(lin.at)
                tracks.table.remove(lin.rows[~passed])  # they are on what moves
                first = window.clones[0]
                begin = replace(
                    begin,
                    T_world_imu=first.T_world_imu,
                    velocity=first.velocity,
                    gyro_bias=window.nav.gyro_bias,
                )
        if tracks.variance >= self._settings.pixel_sigma_max_px**2:
            self.why = (
                f"features and IMU disagree by more than {self._settings.pixel_sigma_max_px:g} px"
            )
            return None
        excess = max(
            1.0, _disagreement(window.prior, slice(None)), _disagreement(window.prior, _BIASES)
        )
        if excess > 1.0 and not self._contradiction_persists(views[-1].time_ns):
            self.why = (
                "features and IMU contradict each other: their clocks may be apart, or most "
                "features belong to "
                "something that moves"
            )
            return None
        P = excess * fitted.covariance()
        sigma = scale_sigma(WindowPosterior.of(window, P))
        return *_at_origin(window.nav, P[:DIM, :DIM]), float("inf") if sigma is None else sigma

    def _solve(
        self, window: Window, views: int, tracks: WindowTracks
    ) -> tuple[Fit, LinearTracks] | None:
        """Gauss-Newton over a window of so many views; return the fit and the tracks that it was
        made from.
        """
        tracks.table.has_point[:] = False
        for _ in range(_START.steps):
            lin = tracks.linearise(window.T_cam0_world(), tracks.choose(views), 2)
            if len(lin.rows) < _START.min_tracks:
                self.why = f"only {len(lin.rows)} features show parallax"
                return None
            self._follow_noise(tracks, lin)
            A, b = eliminate_points(lin.information, np.ones(len(lin.rows), dtype=np.bool_))
            A, b, _ = window.state.information(A, b, tracks.variance)
            try:
                fitted, error = window.optimum(A, b, len(A))
            except np.linalg.LinAlgError:
                return None
            tracks.move_points(
                lin, lin.stereo, error[window.state.clones], error[window.state.stereo]
            )
            window.relinearise(error)
            if np.abs(error).max() < _START.converged:
                return fitted, lin
        self.why = "features and IMU do not agree on one motion"
        return None

    def _window(self, motion: ImuMotion, views: list[Observations], begin: NavState) -> Window:
        """The window of all views, predicted from a first state, under the prior alone."""
        s = self._imu
        sigmas = [0.0, START_VELOCITY_SIGMA_MPS, s.gyro_bias_sigma_radps, s.accel_bias_sigma_mps2]
        P = np.diag(
            np.concatenate(
                [[0.0] * 3, [_GRAVITY.tilt_sigma_rad] * 2, np.repeat(sigmas, [1, 3, 3, 3])]
            )
            ** 2
        )
        window = Window(motion, begin, P, Calibration(self._T_cam0_imu))
        for k, view in enumerate(views):
            if k:
                window.propagate(
                    motion.advance(window.nav, views[k - 1].time_ns, view.time_ns, START_FACTORS)
                )
            window.add_clone(view.frame_index, view.time_ns)
        return window

    def _follow_noise(self, tracks: WindowTracks, lin: LinearTracks) -> None:
        """Set the pixel noise to that of the median track, and to no less than few tracks can
        show.
        """
        _, squares, dof = tracks.gate(lin.at)
        ratio = median(squares / chi_square_table(0.5)[dof])
        tracks.variance = float(
            np.clip(tracks.variance * ratio, _START.min_px**2, self._settings.pixel_sigma_max_px**2)
        )


def _disagreement(prior: Prior, rows: slice) -> float:
    """Squared distance of the means of some errors from the prior, over the limit by chi-square."""
    squared, dimensions = prior.squared_distance(rows)
    return squared / float(chi_square_quantile(_START.agreement, dimensions))


def _upright(nav: NavState, found: VisualInertialAlignment) -> NavState:
    """The first state in an upright world, by the shortest turn that brings gravity down."""
    R = rotation_to_up(-found.gravity / np.linalg.norm(found.gravity))
    return replace(nav, T_world_imu=se3_from_parts(R, np.zeros(3)), velocity=R @ found.velocity)


def _at_origin(nav: NavState, P: FloatArray) -> tuple[NavState, FloatArray]:
    """Begin the world at the body: its position and its yaw are zero by definition, and known."""
    P = 0.5 * (P + P.T)
    P[[0, 1, 2, 5]] = 0.0
    P[:, [0, 1, 2, 5]] = 0.0
    T = se3_from_parts(nav.T_world_imu[:3, :3], np.zeros(3))
    return replace(nav, T_world_imu=T), P
