"""The paper's visual-inertial SLAM: EKF prediction on SE(3), landmark mapping, pose update.

Equation numbers (P1) … (P9) are those of docs/math.md. In the paper's letters `U_t` is
`T_imu_world`, `oT_i` is `T_cam0_imu`, `u = [v; omega]` the body velocity and angular rate, `tau`
the time step, `m_j` a landmark.
"""

from __future__ import annotations

import math
from typing import ClassVar, NamedTuple

import numpy as np

from vio.errors import ConfigError, EstimationError
from vio.filters.inputs import InputOrder, check_parts, checked_extrinsics
from vio.filters.settings import VislamSettings
from vio.filters.vislam_motion import DriftingTwist, HeldInput
from vio.geometry.lie import FloatArray, circledot, se3_inverse, se3_log, transform_points
from vio.geometry.stereo import StereoCamera, depth_of, p_cam_D_z, project, triangulate, z_D_p_cam
from vio.imu.settings import ImuSettings
from vio.numerics.robust import median
from vio.numerics.statistics import chi_square_quantile
from vio.protocols import Backend
from vio.records import (
    BoolArray,
    Estimate,
    IntArray,
    Landmarks,
    MotionSample,
    MotionSource,
    Observations,
    UpdateReport,
    VelocitySample,
)


class _LandmarkRules(NamedTuple):
    """Which observations become landmarks."""

    min_depth_m: float = 0.3
    max_distance_m: float = 150.0  # observations farther away are neither initialised nor used
    prior_sigma_m: float = 1.0  # standard deviation of the isotropic prior
    # fewer points leave a pose undetermined, and a single wrong one would steer it
    min_features: int = 3


_LANDMARKS = _LandmarkRules()


def z_D_landmark(
    camera: StereoCamera, T_cam0_imu: FloatArray, U: FloatArray, m: FloatArray
) -> FloatArray:
    """Jacobian (N, 4, 3) of the stereo pixels with respect to the landmarks (N, 3) in the world
    frame, (P4).
    """
    T_cam0_world = T_cam0_imu @ U
    return z_D_p_cam(camera, transform_points(T_cam0_world, m)) @ T_cam0_world[:3, :3]


def z_D_xi(
    camera: StereoCamera, T_cam0_imu: FloatArray, U: FloatArray, m: FloatArray
) -> FloatArray:
    """Jacobian (N, 4, 6) of the stereo pixels with respect to xi in `U <- exp(xi) U`, (P7)."""
    p_imu = transform_points(U, m)
    p_cam = transform_points(T_cam0_imu, p_imu)
    return z_D_p_cam(camera, p_cam) @ (T_cam0_imu[:3, :] @ circledot(p_imu))


def update_landmarks(
    m: FloatArray, P: FloatArray, H: FloatArray, residual: FloatArray, pixel_variance: float
) -> tuple[FloatArray, FloatArray]:
    """Update landmarks (N, 3) with covariance blocks (N, 3, 3), equations (P5) and (P6).

    With a known pose each landmark meets only its own pixels, so the 3M x 3M covariance of the
    paper stays block diagonal and the blocks are all there is.
    """
    Ht = np.swapaxes(H, -1, -2)
    S = H @ P @ Ht + pixel_variance * np.eye(4)
    K = np.swapaxes(np.linalg.solve(S, H @ P), -1, -2)
    IKH = np.eye(3) - K @ H
    # Joseph's form: symmetric and positive whatever the rounding of K.
    by_pixels = pixel_variance * K @ np.swapaxes(K, -1, -2)
    P_new = IKH @ P @ np.swapaxes(IKH, -1, -2) + by_pixels
    return m + (K @ residual[..., None])[..., 0], P_new


def update_pose(
    Sigma: FloatArray, H: FloatArray, residual: FloatArray, R: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return the correction K r (d,) and the updated covariance (d, d), equations (P8) and (P9).

    Args:
        Sigma: prior covariance (d, d), d >= 6; its first six rows are the pose, the only ones that
            pixels depend on.
        H: Jacobian blocks (N, 4, 6) with respect to the pose.
        residual: pixel residuals (N, 4).
        R: covariance of each residual block (N, 4, 4), independent of one another.

    The gain is formed in the information form, `(Sigma^-1 + H' R^-1 H)^-1 H' R^-1`, which equals
    the paper's `Sigma H' (H Sigma H' + R)^-1` by the matrix inversion lemma and costs O(N) instead
    of O(N^3).
    """
    RiH = np.linalg.solve(R, H)
    d = len(Sigma)
    information = np.zeros((d, d))
    information[:6, :6] = np.einsum("nij,nik->jk", H, RiH)
    gradient = np.einsum("nij,ni->j", RiH, residual)
    # (I + Sigma A)^-1 Sigma needs no inverse of Sigma, which is singular at the start.
    Sigma_new = np.linalg.solve(np.eye(d) + Sigma @ information, Sigma)
    Sigma_new = 0.5 * (Sigma_new + Sigma_new.T)
    return Sigma_new[:, :6] @ gradient, Sigma_new


class _Map:
    """Landmarks in arrays that grow by doubling; a landmark keeps its slot."""

    def __init__(self) -> None:
        self.slot_of: dict[int, int] = {}
        self.m = np.zeros((256, 3))
        self.P = np.zeros((256, 3, 3))

    def __len__(self) -> int:
        return len(self.slot_of)

    def slots(self, ids: IntArray) -> IntArray:
        """Slots (N,) of landmarks; those unknown give a slot past the end."""
        unknown = len(self)
        return np.array([self.slot_of.get(i, unknown) for i in ids.tolist()], dtype=np.int64)

    def add(self, ids: IntArray, m: FloatArray, P: FloatArray) -> None:
        first = len(self)
        last = len(self) + len(ids)
        while last > len(self.m):
            self.m = np.concatenate([self.m, np.zeros_like(self.m)])
            self.P = np.concatenate([self.P, np.zeros_like(self.P)])
        self.m[first:last] = m
        self.P[first:last] = P
        self.slot_of.update(zip(ids.tolist(), range(first, last), strict=True))


class Vislam(Backend):
    """The paper's filter as a back end: `propagate` takes velocities, `update` takes stereo
    observations.
    """

    motion_sources: ClassVar[tuple[MotionSource, ...]] = ("velocity",)
    stereo_only = True

    def __init__(
        self,
        camera: StereoCamera,
        T_cam0_imu: FloatArray,
        settings: VislamSettings,
        *,
        motion_sensor: bool,
        T_world_imu: FloatArray | None = None,
    ) -> None:
        """Start without a map.

        Args:
            camera: the rectified stereo camera.
            T_cam0_imu: extrinsics (4, 4).
            settings: the filter's section of the configuration.
            motion_sensor: whether velocity samples will come.
            T_world_imu: start pose (4, 4); identity if None.

        Raises:
            ConfigError: the settings need a motion sensor and there is none, or an argument is of
                another kind.
            CalibrationError: the extrinsics are no rigid transform.
        """
        check_parts("vislam", camera, settings, VislamSettings)
        if not motion_sensor and (
            settings.motion_model == "input" or settings.mode == "dead_reckoning"
        ):
            raise ConfigError(
                "the paper's motion model needs velocities, and there are none: use "
                "vislam.motion_model=twist, "
                "and a mode other than dead_reckoning"
            )
        self._camera = camera
        self._T_cam0_imu = checked_extrinsics(T_cam0_imu)
        self._settings = settings
        self._order = InputOrder("vislam")
        dead_reckoning = settings.mode == "dead_reckoning"
        self._motion: HeldInput | DriftingTwist = (
            HeldInput(settings)
            if dead_reckoning or settings.motion_model == "input"
            else DriftingTwist(settings)
        )
        self._state = self._motion.start(
            np.eye(4) if T_world_imu is None else se3_inverse(T_world_imu)
        )
        self._time_ns: int | None = None  # of the state
        self._frame_time_ns: int | None = None  # of the last frame
        self._map = _Map()
        probability = settings.gate_probability
        if probability is None:
            self._gate = np.inf
        else:
            self._gate = float(chi_square_quantile(probability, 4))

    @classmethod
    def build(
        cls,
        camera: StereoCamera,
        T_cam0_body: FloatArray,
        settings: VislamSettings,
        motion: MotionSource | None,
        imu: ImuSettings,
    ) -> Vislam:
        """Build the filter of a run, see `Backend`.

        Raises:
            ConfigError: one camera has no depths, or the settings need a motion sensor and there is
                none.
        """
        if camera.kind == "mono":
            raise ConfigError(
                "backend vislam needs a stereo pair, and this is one camera; take msckf"
            )
        return cls(camera, T_cam0_body, settings, motion_sensor=motion is not None)

    def propagate(self, sample: MotionSample) -> None:
        """Take a velocity sample.

        Raises:
            ConfigError: the sample is raw IMU, which this filter has no model for.
            DataError: it is out of order or not finite; the filter is unchanged.
        """
        if not isinstance(sample, VelocitySample):
            raise ConfigError(
                "backend vislam takes body velocities, not raw IMU; use --backend msckf or "
                "--motion none"
            )
        self._order.sample(sample)
        if self._motion.measures_at_once:
            self.advance(sample.time_ns)
        self._state = self._motion.take(self._state, sample)

    def advance(self, time_ns: int) -> None:
        """Predict the pose to a later time without observations."""
        if self._time_ns is not None:
            self._state = self._motion.predict(self._state, self._time_ns, time_ns)
        self._time_ns = time_ns

    def update(self, observations: Observations) -> UpdateReport:
        """Predict to the time of the frame, then update pose and landmarks with its observations.

        Raises:
            EstimationError: no velocity covers the step, or the pose is not finite any more.
            DataError: the frame is out of order, or its observations are impossible; the filter is
                unchanged.
        """
        self._order.frame(observations, self._time_ns)
        step_s = (
            0.0
            if self._frame_time_ns is None
            else (observations.time_ns - self._frame_time_ns) * 1e-9
        )
        self._frame_time_ns = observations.time_ns
        self.advance(observations.time_ns)
        if self._settings.mode == "dead_reckoning":
            return UpdateReport(0, 0, 0, 0, None, None)

        usable = observations.has_right & (observations.z[:, 0] > observations.z[:, 2])
        if not self._settings.use_stale:
            usable &= ~observations.stale
        observations = observations.take(usable)
        slots = self._map.slots(observations.ids)
        known = slots < len(self._map)
        try:
            used, gated, innovation, nis_per_dof = self._update_known(
                observations.z[known], slots[known], step_s
            )
        except np.linalg.LinAlgError as error:
            raise EstimationError(self._lost(observations.frame_index)) from error
        fresh = observations.take(~known)
        initialised = self._initialise(fresh.ids, fresh.z)
        if not np.isfinite(self._state.U).all() or not np.isfinite(self._state.Sigma).all():
            raise EstimationError(self._lost(observations.frame_index))
        innovation_ratio = None
        if nis_per_dof is not None:
            innovation_ratio = math.sqrt(nis_per_dof)
        return UpdateReport(
            used=used,
            gated=gated,
            initialised=initialised,
            landmarks=len(self._map),
            innovation_median_px=innovation,
            nis_per_dof=nis_per_dof,
            innovation_ratio=innovation_ratio,
        )

    def _lost(self, frame_index: int) -> str:
        remedy = (
            ""
            if self._settings.motion_model == "input"
            else "; give it velocities, or stop before that frame"
        )
        return f"vislam diverged at frame {frame_index}: too few features for too long, or too many wrong ones{remedy}"

    def estimate(self) -> Estimate:
        """Return the pose at the time of the last frame."""
        U = self._state.U
        twist = self._state.twist
        T_world_imu = se3_inverse(U)
        if twist is None:
            velocity = None
        else:
            velocity = T_world_imu[:3, :3] @ twist[:3]
        return Estimate(self._time_ns or 0, T_world_imu, self._state.Sigma[:6, :6].copy(), velocity)

    def landmarks(self) -> Landmarks:
        """Return every landmark ever initialised."""
        n = len(self._map)
        ids = np.fromiter(self._map.slot_of, dtype=np.int64, count=n)
        return Landmarks(ids, self._map.m[:n].copy(), self._map.P[:n].copy())

    def _update_known(
        self, z: FloatArray, slots: IntArray, step_s: float
    ) -> tuple[int, int, float | None, float | None]:
        """Update pose and landmarks with known landmarks; return used, gated, median innovation,
        NIS per degree.
        """
        camera = self._camera
        T_cam0_imu = self._T_cam0_imu
        visible = self._in_front(self._map.m[slots])
        z = z[visible]
        slots = slots[visible]
        unseen = int((~visible).sum())
        if len(z) == 0:
            return 0, unseen, None, None
        m = self._map.m[slots]
        P = self._map.P[slots]
        residual, nis = self._innovation(z, m, P)
        accepted: BoolArray = nis <= self._gate
        outvoted = len(z) >= _LANDMARKS.min_features and 2 * accepted.sum() < len(z)
        if outvoted and isinstance(self._motion, DriftingTwist):
            # When most features contradict the motion model, it is the model that is wrong.
            self._state = self._motion.with_inflated_covariance(self._state, step_s)
            residual, nis = self._innovation(z, m, P)
            accepted = nis <= self._gate
        gated = unseen + int((~accepted).sum())
        if not accepted.any():
            return 0, gated, None, None
        innovation = median(np.abs(residual[accepted]))
        nis_per_dof = float(nis[accepted].mean() / 4)
        m = m[accepted]
        P = P[accepted]
        z = z[accepted]
        slots = slots[accepted]

        if self._settings.mode == "slam" and len(z) >= _LANDMARKS.min_features:
            self._pose_update(z, m, P)
        H_m = z_D_landmark(camera, T_cam0_imu, self._state.U, m)
        residual = z - project(camera, transform_points(T_cam0_imu @ self._state.U, m))
        V = self._settings.pixel_sigma_px**2
        self._map.m[slots], self._map.P[slots] = update_landmarks(m, P, H_m, residual, V)
        return int(accepted.sum()), gated, innovation, nis_per_dof

    def _innovation(
        self, z: FloatArray, m: FloatArray, P: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Residuals (N, 4) of known landmarks and their squared Mahalanobis lengths (N,)."""
        U = self._state.U
        H = z_D_xi(self._camera, self._T_cam0_imu, U, m)
        residual = z - project(self._camera, transform_points(self._T_cam0_imu @ U, m))
        by_pose = H @ self._state.Sigma[:6, :6] @ np.swapaxes(H, -1, -2)
        S = by_pose + self._residual_covariance(m, P)
        return residual, np.einsum(
            "ni,ni->n", residual, np.linalg.solve(S, residual[..., None])[..., 0]
        )

    def _pose_update(self, z: FloatArray, m: FloatArray, P: FloatArray) -> None:
        """Update the pose, relinearising at each iteration (iterated EKF, Bell and Cathey 1993)."""
        camera = self._camera
        T_cam0_imu = self._T_cam0_imu
        prior = self._state
        for _ in range(self._settings.iterations):
            U = self._state.U
            H = z_D_xi(camera, T_cam0_imu, U, m)
            residual = z - project(camera, transform_points(T_cam0_imu @ U, m))
            moved = se3_log(U @ se3_inverse(prior.U))
            correction, Sigma = update_pose(
                prior.Sigma, H, residual + H @ moved, self._residual_covariance(m, P)
            )
            self._state = prior.corrected(correction, Sigma)

    def _residual_covariance(self, m: FloatArray, P: FloatArray) -> FloatArray:
        """Covariance (N, 4, 4) of the residuals but for the pose: pixels, and the landmarks
        where asked for.
        """
        V = self._settings.pixel_sigma_px**2 * np.eye(4)
        if not self._settings.landmark_uncertainty:
            return np.broadcast_to(V, (len(m), 4, 4))
        H_m = z_D_landmark(self._camera, self._T_cam0_imu, self._state.U, m)
        return H_m @ P @ np.swapaxes(H_m, -1, -2) + V

    def _in_front(self, m: FloatArray) -> BoolArray:
        depth = depth_of(self._camera, transform_points(self._T_cam0_imu @ self._state.U, m))
        return (depth > _LANDMARKS.min_depth_m) & (depth < _LANDMARKS.max_distance_m)

    def _initialise(self, ids: IntArray, z: FloatArray) -> int:
        """Create landmarks from their first stereo observation, equation (P3); return how many."""
        s = self._settings
        p_cam, valid = triangulate(self._camera, z)
        depth = depth_of(self._camera, p_cam)
        valid &= (depth > _LANDMARKS.min_depth_m) & (depth < _LANDMARKS.max_distance_m)
        ids = ids[valid]
        z = z[valid]
        p_cam = p_cam[valid]
        T_world_cam0 = se3_inverse(self._T_cam0_imu @ self._state.U)
        if s.landmark_prior == "stereo":
            J = T_world_cam0[:3, :3] @ p_cam_D_z(self._camera, z)
            P = s.pixel_sigma_px**2 * J @ np.swapaxes(J, -1, -2)
        else:
            P = np.broadcast_to(_LANDMARKS.prior_sigma_m**2 * np.eye(3), (len(ids), 3, 3))
        self._map.add(ids, transform_points(T_world_cam0, p_cam), P)
        return len(ids)
