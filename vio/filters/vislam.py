"""The paper's visual-inertial SLAM: EKF prediction on SE(3), landmark mapping, pose update.

Equation numbers (P1) … (P9) are those of docs/math.md. In the paper's letters `U_t` is `T_imu_world`, `oT_i` is
`T_cam0_imu`, `u = [v; omega]` the body velocity and angular rate, `tau` the time step, `m_j` a landmark.
"""

from __future__ import annotations

import logging

import numpy as np
from scipy.stats import chi2

from vio.errors import ConfigError, EstimationError
from vio.filters.settings import VislamSettings
from vio.geometry.lie import (
    FloatArray,
    circledot,
    se3_adjoint,
    se3_exp,
    se3_inverse,
    se3_log,
    transform_points,
)
from vio.geometry.stereo import StereoCamera, p_cam_D_z, project, triangulate, z_D_p_cam
from vio.records import (
    BoolArray,
    Estimate,
    IntArray,
    Landmarks,
    MotionSample,
    Observations,
    UpdateReport,
    VelocitySample,
)

log = logging.getLogger(__name__)

_MIN_DEPTH_M = 0.3


def predict(
    U: FloatArray, Sigma: FloatArray, u: FloatArray, tau_s: float, W: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Carry the pose over one time step, equations (P1) and (P2).

    Args:
        U: `T_imu_world` (4, 4).
        Sigma: covariance (6, 6) of xi in `U = exp(xi) U_hat`.
        u: body velocity and angular rate (6,), m/s and rad/s.
        tau_s: time step, seconds.
        W: noise covariance (6, 6) added over the step.
    """
    step = se3_exp(-tau_s * u)
    F = se3_adjoint(step)  # exp(-tau curly_hat(u))
    return step @ U, F @ Sigma @ F.T + W


def z_D_landmark(camera: StereoCamera, T_cam0_imu: FloatArray, U: FloatArray, m: FloatArray) -> FloatArray:
    """Jacobian (N, 4, 3) of the stereo pixels with respect to the landmarks (N, 3) in the world frame, (P4)."""
    T_cam0_world = T_cam0_imu @ U
    return z_D_p_cam(camera, transform_points(T_cam0_world, m)) @ T_cam0_world[:3, :3]


def z_D_xi(camera: StereoCamera, T_cam0_imu: FloatArray, U: FloatArray, m: FloatArray) -> FloatArray:
    """Jacobian (N, 4, 6) of the stereo pixels with respect to xi in `U <- exp(xi) U`, (P7)."""
    p_imu = transform_points(U, m)
    p_cam = transform_points(T_cam0_imu, p_imu)
    return z_D_p_cam(camera, p_cam) @ (T_cam0_imu[:3, :] @ circledot(p_imu))


def update_landmarks(
    m: FloatArray, P: FloatArray, H: FloatArray, residual: FloatArray, pixel_variance: float
) -> tuple[FloatArray, FloatArray]:
    """Update landmarks (N, 3) with covariance blocks (N, 3, 3), equations (P5) and (P6).

    With a known pose each landmark meets only its own pixels, so the 3M x 3M covariance of the paper stays block
    diagonal and the blocks are all there is.
    """
    Ht = np.swapaxes(H, -1, -2)
    S = H @ P @ Ht + pixel_variance * np.eye(4)
    K = np.swapaxes(np.linalg.solve(S, H @ P), -1, -2)
    IKH = np.eye(3) - K @ H
    # Joseph's form: symmetric and positive whatever the rounding of K.
    P_new = IKH @ P @ np.swapaxes(IKH, -1, -2) + pixel_variance * K @ np.swapaxes(K, -1, -2)
    return m + (K @ residual[..., None])[..., 0], P_new


def update_pose(Sigma: FloatArray, H: FloatArray, residual: FloatArray, R: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return xi = K r (6,) and the updated covariance (6, 6), equations (P8) and (P9).

    Args:
        Sigma: prior covariance (6, 6).
        H: Jacobian blocks (N, 4, 6).
        residual: pixel residuals (N, 4).
        R: covariance of each residual block (N, 4, 4), independent of one another.

    The gain is formed in the 6 x 6 information form, `(Sigma^-1 + H' R^-1 H)^-1 H' R^-1`, which equals the paper's
    `Sigma H' (H Sigma H' + R)^-1` by the matrix inversion lemma and costs O(N) instead of O(N^3).
    """
    RiH = np.linalg.solve(R, H)
    information = np.einsum("nij,nik->jk", H, RiH)
    gradient = np.einsum("nij,ni->j", RiH, residual)
    # (I + Sigma A)^-1 Sigma needs no inverse of Sigma, which is singular at the start.
    Sigma_new = np.linalg.solve(np.eye(6) + Sigma @ information, Sigma)
    Sigma_new = 0.5 * (Sigma_new + Sigma_new.T)
    return Sigma_new @ gradient, Sigma_new


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
        first, last = len(self), len(self) + len(ids)
        while last > len(self.m):
            self.m = np.concatenate([self.m, np.zeros_like(self.m)])
            self.P = np.concatenate([self.P, np.zeros_like(self.P)])
        self.m[first:last], self.P[first:last] = m, P
        self.slot_of.update(zip(ids.tolist(), range(first, last), strict=True))


class Vislam:
    """The paper's filter as a back end: `propagate` takes velocities, `update` takes stereo observations."""

    def __init__(
        self,
        camera: StereoCamera,
        T_cam0_imu: FloatArray,
        settings: VislamSettings,
        *,
        motion_sensor: bool,
        T_world_imu: FloatArray | None = None,
    ) -> None:
        """Start at rest in the map.

        Args:
            camera: the rectified stereo camera.
            T_cam0_imu: extrinsics (4, 4).
            settings: the filter's section of the configuration.
            motion_sensor: True: velocity samples will come. False: the twist of the last step is held.
            T_world_imu: start pose (4, 4); identity if None.
        """
        if settings.mode == "dead_reckoning" and not motion_sensor:
            raise ConfigError("vislam.mode dead_reckoning needs velocities; use --motion velocity or another mode")
        self._camera, self._T_cam0_imu, self._settings = camera, np.asarray(T_cam0_imu, dtype=np.float64), settings
        self._motion_sensor = motion_sensor
        self._U = np.eye(4) if T_world_imu is None else se3_inverse(T_world_imu)
        self._Sigma = np.zeros((6, 6))
        self._time_ns: int | None = None
        self._samples: list[VelocitySample] = []
        self._twist: FloatArray | None = None  # without a motion sensor: the twist of the last step
        self._map = _Map()
        probability = settings.gate_probability
        self._gate = np.inf if probability is None else float(chi2.ppf(probability, 4))

    def propagate(self, sample: MotionSample) -> None:
        """Keep a velocity sample until the frame that needs it.

        Raises:
            ConfigError: the sample is raw IMU, which this filter has no model for.
        """
        if not isinstance(sample, VelocitySample):
            raise ConfigError("backend vislam takes body velocities, not raw IMU; use --backend msckf or --motion none")
        if self._motion_sensor:
            self._samples.append(sample)

    def update(self, observations: Observations) -> UpdateReport:
        """Predict to the time of the frame, then update pose and landmarks with its observations."""
        U_before = self._U
        tau_s = self.advance(observations.time_ns)
        if self._settings.mode == "dead_reckoning":
            return UpdateReport(0, 0, 0, 0, None, None)

        usable = observations.has_right & (observations.z[:, 0] > observations.z[:, 2])
        if not self._settings.use_stale:
            usable &= ~observations.stale
        observations = observations.take(usable)
        slots = self._map.slots(observations.ids)
        known = slots < len(self._map)
        report = self._update_known(observations.z[known], slots[known])
        fresh = observations.take(~known)
        initialised = self._initialise(fresh.ids, fresh.z)
        if not self._motion_sensor and tau_s > 0:
            # U_k = exp(-tau u) U_{k-1}
            self._twist = -se3_log(self._U @ se3_inverse(U_before)) / tau_s
        if not np.isfinite(self._U).all() or not np.isfinite(self._Sigma).all():
            raise EstimationError(
                f"vislam diverged at frame {observations.frame_index}: the pose is not finite any more"
            )
        return UpdateReport(
            used=report[0],
            gated=report[1],
            initialised=initialised,
            landmarks=len(self._map),
            innovation_median_px=report[2],
            nis_per_dof=report[3],
        )

    def estimate(self) -> Estimate:
        """Return the pose at the time of the last frame."""
        return Estimate(self._time_ns or 0, se3_inverse(self._U), self._Sigma.copy())

    def landmarks(self) -> Landmarks:
        """Return every landmark ever initialised."""
        n = len(self._map)
        ids = np.fromiter(self._map.slot_of, dtype=np.int64, count=n)
        return Landmarks(ids, self._map.m[:n].copy(), self._map.P[:n].copy())

    def advance(self, time_ns: int) -> float:
        """Predict the pose to a frame's time without observations; return the seconds that passed."""
        previous_ns, self._time_ns = self._time_ns, time_ns
        if previous_ns is None:
            # Input before the first frame is of no use, save the last one, which may still hold at the frame.
            self._samples = self._samples[-1:]
            return 0.0
        tau_s = (time_ns - previous_ns) * 1e-9
        if not self._motion_sensor:
            self._U, self._Sigma = predict(
                self._U,
                self._Sigma,
                np.zeros(6) if self._twist is None else self._twist,
                tau_s,
                self._drift_noise(tau_s),
            )
            return tau_s
        for u, part_s in self._inputs_between(previous_ns, time_ns):
            W = self._sensor_noise(part_s, part_s / tau_s)
            self._U, self._Sigma = predict(self._U, self._Sigma, u, part_s, W)
        return tau_s

    def _inputs_between(self, start_ns: int, end_ns: int) -> list[tuple[FloatArray, float]]:
        """Split an interval at the samples within it: pairs of input (6,) and duration in seconds.

        Raises:
            EstimationError: there is no sample at or before the interval.
        """
        samples = self._samples
        if not samples:
            raise EstimationError("no velocity sample before the second frame; use --motion none or check the clocks")
        times = [s.time_ns for s in samples]
        inputs = np.array([np.concatenate([s.linear, s.angular]) for s in samples])
        cuts = [start_ns, *(t for t in times if start_ns < t < end_ns), end_ns]
        # Linear interpolation at the cuts, held constant outside the samples.
        at_cuts = np.stack([np.interp(cuts, times, column) for column in inputs.T], axis=1)
        kept = [i for i, t in enumerate(times) if t <= end_ns][-1:]
        self._samples = samples[kept[0] if kept else 0 :]
        weights = {"midpoint": (0.5, 0.5), "start": (1.0, 0.0), "end": (0.0, 1.0)}[self._settings.input_at]
        return [
            (weights[0] * at_cuts[k] + weights[1] * at_cuts[k + 1], (cuts[k + 1] - cuts[k]) * 1e-9)
            for k in range(len(cuts) - 1)
        ]

    def _sensor_noise(self, part_s: float, share_of_step: float) -> FloatArray:
        """Noise (6, 6) of a part of the step from one frame to the next."""
        s = self._settings
        sigmas = np.repeat([s.linear_velocity_sigma_mps, s.angular_rate_sigma_radps], 3)
        # The paper states standard deviations and adds them as variances once per frame, whatever the step.
        return np.diag(sigmas * share_of_step if s.noise == "literal" else (sigmas * part_s) ** 2)

    def _drift_noise(self, tau_s: float) -> FloatArray:
        s = self._settings
        if self._twist is None:
            sigmas = np.repeat([s.start_velocity_sigma_mps, s.start_rate_sigma_radps], 3) * tau_s
        else:
            sigmas = np.repeat([s.acceleration_sigma_mps2, s.angular_acceleration_sigma_radps2], 3) * tau_s**2
        return np.diag(sigmas**2)

    def _update_known(self, z: FloatArray, slots: IntArray) -> tuple[int, int, float | None, float | None]:
        """Update pose and landmarks with known landmarks; return used, gated, median innovation, NIS per degree."""
        s, camera, T_cam0_imu = self._settings, self._camera, self._T_cam0_imu
        V = s.pixel_sigma_px**2
        m, P = self._map.m[slots], self._map.P[slots]
        visible = self._in_front(m)
        m, P, z, slots = m[visible], P[visible], z[visible], slots[visible]
        if len(z) == 0:
            return 0, int((~visible).sum()), None, None

        H = z_D_xi(camera, T_cam0_imu, self._U, m)
        residual = z - project(camera, transform_points(T_cam0_imu @ self._U, m))
        R = self._residual_covariance(m, P)
        S = H @ self._Sigma @ np.swapaxes(H, -1, -2) + R
        nis = np.einsum("ni,ni->n", residual, np.linalg.solve(S, residual[..., None])[..., 0])
        accepted: BoolArray = nis <= self._gate
        gated = int((~visible).sum() + (~accepted).sum())
        if not accepted.any():
            return 0, gated, None, None
        innovation = float(np.median(np.abs(residual[accepted])))
        nis_per_dof = float(nis[accepted].mean() / 4)
        m, P, z, slots, R = m[accepted], P[accepted], z[accepted], slots[accepted], R[accepted]

        if s.mode == "slam":
            self._pose_update(z, m, P)
        H_m = z_D_landmark(camera, T_cam0_imu, self._U, m)
        residual = z - project(camera, transform_points(T_cam0_imu @ self._U, m))
        self._map.m[slots], self._map.P[slots] = update_landmarks(m, P, H_m, residual, V)
        return int(accepted.sum()), gated, innovation, nis_per_dof

    def _pose_update(self, z: FloatArray, m: FloatArray, P: FloatArray) -> None:
        """Update the pose, relinearising at each iteration (iterated EKF, Bell and Cathey 1993)."""
        camera, T_cam0_imu = self._camera, self._T_cam0_imu
        U_prior, Sigma_prior = self._U, self._Sigma
        for _ in range(self._settings.iterations):
            H = z_D_xi(camera, T_cam0_imu, self._U, m)
            residual = z - project(camera, transform_points(T_cam0_imu @ self._U, m))
            offset = se3_log(self._U @ se3_inverse(U_prior))
            xi, self._Sigma = update_pose(Sigma_prior, H, residual + H @ offset, self._residual_covariance(m, P))
            self._U = se3_exp(xi) @ U_prior

    def _residual_covariance(self, m: FloatArray, P: FloatArray) -> FloatArray:
        """Covariance (N, 4, 4) of the residuals but for the pose: pixels, and the landmarks where asked for."""
        V = self._settings.pixel_sigma_px**2 * np.eye(4)
        if not self._settings.landmark_uncertainty:
            return np.broadcast_to(V, (len(m), 4, 4))
        H_m = z_D_landmark(self._camera, self._T_cam0_imu, self._U, m)
        return H_m @ P @ np.swapaxes(H_m, -1, -2) + V

    def _in_front(self, m: FloatArray) -> BoolArray:
        depth = transform_points(self._T_cam0_imu @ self._U, m)[:, 2]
        return (depth > _MIN_DEPTH_M) & (depth < self._settings.max_landmark_distance_m)

    def _initialise(self, ids: IntArray, z: FloatArray) -> int:
        """Create landmarks from their first stereo observation, equation (P3); return how many."""
        s = self._settings
        p_cam, valid = triangulate(self._camera, z)
        valid &= (p_cam[:, 2] > _MIN_DEPTH_M) & (p_cam[:, 2] < s.max_landmark_distance_m)
        ids, z, p_cam = ids[valid], z[valid], p_cam[valid]
        T_world_cam0 = se3_inverse(self._T_cam0_imu @ self._U)
        if s.landmark_prior == "stereo":
            J = T_world_cam0[:3, :3] @ p_cam_D_z(self._camera, z)
            P = s.pixel_sigma_px**2 * J @ np.swapaxes(J, -1, -2)
        else:
            P = np.broadcast_to(s.landmark_prior_sigma_m**2 * np.eye(3), (len(ids), 3, 3))
        self._map.add(ids, transform_points(T_world_cam0, p_cam), P)
        return len(ids)
