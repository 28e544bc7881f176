"""Settings of the back ends."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from vio.setting import setting


@dataclass(frozen=True, slots=True)
class VislamSettings:
    """The paper's visual-inertial SLAM by EKF (docs/math.md, section 1)."""

    mode: Literal["slam", "mapping", "dead_reckoning"] = setting(
        "slam", "what runs: pose and landmark updates, landmark updates along the predicted pose, or prediction alone"
    )
    motion_model: Literal["twist", "input"] = setting(
        "twist",
        "what carries the pose: 'twist' keeps the body twist as a state that drifts and that velocities, if any, "
        "measure; 'input' is the paper's, which takes each measured velocity as the truth plus W",
    )
    noise: Literal["consistent", "literal"] = setting(
        "consistent",
        "model 'input', how W is read: 'consistent' adds (sigma * step)^2 per step; 'literal' adds the paper's numbers "
        "as variances",
    )
    input_at: Literal["midpoint", "start", "end"] = setting(
        "midpoint",
        "model 'input': which input carries the pose from one frame to the next; the paper holds the one at the start",
    )
    linear_velocity_sigma_mps: float = setting(0.5, "noise of the measured body velocity", unit="m/s")
    angular_rate_sigma_radps: float = setting(0.05, "noise of the measured angular rate", unit="rad/s")
    acceleration_density: float = setting(
        1.0, "model 'twist': spectral density of the body acceleration", unit="m/s^2/sqrt(Hz)"
    )
    angular_acceleration_density: float = setting(
        0.1, "model 'twist': spectral density of the angular acceleration", unit="rad/s^2/sqrt(Hz)"
    )
    start_velocity_sigma_mps: float = setting(10.0, "model 'twist': unknown velocity at the start", unit="m/s")
    start_rate_sigma_radps: float = setting(1.0, "model 'twist': unknown rate at the start", unit="rad/s")
    pixel_sigma_px: float = setting(0.75, "noise of one pixel coordinate; V is its square, 15 in the paper", unit="px")
    gate_probability: float | None = setting(
        0.95, "observations outside this chi-square quantile are rejected; null keeps all, as the paper does"
    )
    landmark_uncertainty: bool = setting(
        True, "let the landmarks' covariance widen the innovation of the pose update; the paper takes them as known"
    )
    landmark_prior: Literal["stereo", "isotropic"] = setting(
        "stereo", "covariance of a new landmark: propagated from its first pixels and pose, or the same for all"
    )
    landmark_prior_sigma_m: float = setting(1.0, "the isotropic prior's standard deviation", unit="m")
    iterations: int = setting(
        3, "Gauss-Newton iterations of the pose update; 1 is the paper's filter, more help a start in motion"
    )
    use_stale: bool = setting(False, "take in observations flagged as stale; the paper knows no such flag")
    max_landmark_distance_m: float = setting(
        150.0, "observations farther away are neither initialised nor used", unit="m"
    )
