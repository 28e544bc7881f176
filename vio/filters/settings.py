"""Settings of the back ends."""

from __future__ import annotations

from typing import ClassVar, Literal

from vio.dataclass import dataclass
from vio.setting import Section, setting


@dataclass(frozen=True, slots=True)
class VislamSettings(Section):
    """The paper's visual-inertial SLAM by EKF (docs/math.md, section 1)."""

    section: ClassVar[str] = "vislam"

    mode: Literal["slam", "mapping", "dead_reckoning"] = setting(
        "slam",
        "what runs: pose and landmark updates, landmark updates along the predicted pose, or "
        "prediction alone",
    )
    motion_model: Literal["twist", "input"] = setting(
        "twist",
        "twist: the body twist is a state that drifts and that velocities measure; input: the "
        "paper's, each measured velocity is the truth plus W",
    )
    noise: Literal["consistent", "literal"] = setting(
        "consistent",
        "model 'input': consistent adds (sigma * step)^2 per step, literal the paper's numbers as "
        "variances",
    )
    input_at: Literal["midpoint", "start", "end"] = setting(
        "midpoint",
        "model 'input': which input carries the pose from frame to frame; the paper's is start",
    )
    linear_velocity_sigma_mps: float = setting(
        0.5, "noise of the measured body velocity", unit="m/s", above=0
    )
    angular_rate_sigma_radps: float = setting(
        0.05, "noise of the measured angular rate", unit="rad/s", above=0
    )
    acceleration_density: float = setting(
        1.0,
        "model 'twist': spectral density of the body acceleration",
        unit="m/s^2/sqrt(Hz)",
        at_least=0,
    )
    angular_acceleration_density: float = setting(
        0.1,
        "model 'twist': spectral density of the angular acceleration",
        unit="rad/s^2/sqrt(Hz)",
        at_least=0,
    )
    pixel_sigma_px: float = setting(
        0.75, "noise of one pixel coordinate; V is its square, 15 in the paper", unit="px", above=0
    )
    gate_probability: float | None = setting(
        0.95,
        "observations outside this chi-square quantile are rejected; null keeps all, as the paper "
        "does",
        above=0,
        below=1,
    )
    landmark_uncertainty: bool = setting(
        True,
        "add the landmarks' covariance to the innovation covariance of the pose update; the paper "
        "takes them as known",
    )
    landmark_prior: Literal["stereo", "isotropic"] = setting(
        "stereo",
        "covariance of a new landmark: propagated from its first pixels and pose, or the same for "
        "all",
    )
    iterations: int = setting(
        3,
        "Gauss-Newton iterations of the pose update; 1 is the paper's filter, more help a start in "
        "motion",
        at_least=1,
        at_most=100,
    )
    use_stale: bool = setting(
        False, "take in observations flagged as stale; the paper knows no such flag"
    )


@dataclass(frozen=True, slots=True)
class MsckfSettings(Section):
    """The sliding-window filter (docs/math.md, section 3)."""

    section: ClassVar[str] = "msckf"

    clones: int = setting(11, "poses kept in the window", at_least=3, at_most=100)
    max_landmarks: int = setting(
        30, "long-lived landmarks kept in the state", at_least=0, at_most=1000
    )
    max_features: int = setting(
        150,
        "tracks without a landmark of their own that enter one update",
        at_least=1,
        at_most=5000,
    )
    pixel_sigma_px: float = setting(
        0.5, "noise of one pixel coordinate at the start; then estimated", unit="px", above=0
    )
    pixel_sigma_max_px: float = setting(
        2.0, "upper bound of the estimated noise of a pixel coordinate", unit="px", above=0
    )
    gate_probability: float = setting(
        0.99, "tracks outside this chi-square quantile are rejected", above=0, below=1
    )
    zero_velocity: bool = setting(
        True,
        "measure zero velocity where the motion over the window is indistinguishable from none",
    )
    linear_velocity_sigma_mps: float = setting(
        0.5, "noise of a measured body velocity", unit="m/s", above=0
    )
    angular_rate_sigma_radps: float = setting(
        0.05, "noise of a measured angular rate", unit="rad/s", above=0
    )
    acceleration_density: float = setting(
        1.0,
        "without IMU: spectral density of the body acceleration",
        unit="m/s^2/sqrt(Hz)",
        at_least=0,
    )
    angular_acceleration_density: float = setting(
        0.3,
        "without IMU: spectral density of the angular acceleration",
        unit="rad/s^2/sqrt(Hz)",
        at_least=0,
    )
    calibrate_camera_imu: Literal["auto", "none", "extrinsics", "time_offset", "both"] = setting(
        "auto",
        "what is estimated besides the motion: T_cam0_imu (extrinsics), the time offset, or both; "
        "auto: the time offset, where a stereo pair has an IMU",
    )
    calibrate_imu: Literal["auto", "off", "scale", "full"] = setting(
        "auto",
        "what is estimated of the IMU besides the biases: nothing; scales; or scales, misalignment "
        "and the gyro's rotation against the accelerometer; auto: full, where a stereo pair has an "
        "IMU, or scale, where extrinsics are estimated",
    )
    calibrate_stereo: Literal["on", "off"] = setting(
        "on",
        "estimate what the calibration of a stereo pair is off by",
    )
    stereo_yaw_sigma_deg: float = setting(
        0.05,
        "calibrate_stereo: initial standard deviation of the right camera's rotation about its "
        "vertical axis, which disparities alone show; where rows are off by more, that",
        unit="deg",
        above=0,
    )
    stereo_baseline_sigma: float = setting(
        0.005,
        "standard deviation of the baseline's length, over it, as calibrations leave it; it is "
        "part of the covariances",
        at_least=0,
    )
    stereo_focal_sigma: float = setting(
        0.003,
        "the same of the focal length; the principal point is taken for three times as well known",
        at_least=0,
    )
    calibrate_scale: Literal["off", "on"] = setting(
        "off",
        "estimate baseline and focal length by the scale of IMU or velocities; off: their "
        "uncertainty is considered, and they are not corrected",
    )
    extrinsic_rotation_sigma_deg: float = setting(
        0.5,
        "calibrate_camera_imu: initial standard deviation of T_cam0_imu's rotation",
        unit="deg",
        at_least=0,
    )
    extrinsic_translation_sigma_m: float = setting(
        0.01,
        "calibrate_camera_imu: initial standard deviation of T_cam0_imu's translation",
        unit="m",
        at_least=0,
    )
    time_offset_sigma_s: float = setting(
        5.0e-3,
        "calibrate_camera_imu: initial standard deviation of the time offset",
        unit="s",
        at_least=0,
    )
