"""How far a real stereo calibration is from the cameras: the true rig behind a calibrated one."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from vio.geometry.distortion import CameraModel, StereoRig
from vio.geometry.lie import se3_from_parts, so3_exp
from vio.setting import setting
from vio.sim.errors import SimulationError


@dataclass(frozen=True, slots=True)
class CalibrationErrors:
    """Sizes of a calibration's errors; their directions and signs follow from the seed."""

    scale: float = setting(0.0, "factor on all of them: 0 is an exact calibration, 1 one as after a real one")
    principal_point_px: float = setting(0.25, "principal point of each camera, in a random direction", unit="px")
    distortion: float = setting(1e-3, "first radial coefficient of each camera, either sign")
    rotation_deg: float = setting(0.03, "right camera about a random axis", unit="deg")
    baseline_mm: float = setting(0.5, "right camera along the baseline, either way", unit="mm")

    def __post_init__(self) -> None:
        values = (self.scale, self.principal_point_px, self.distortion, self.rotation_deg, self.baseline_mm)
        if not all(np.isfinite(v) and v >= 0 for v in values):
            raise SimulationError("calibration errors are sizes: finite and not negative")


def miscalibrated(calibrated: StereoRig, errors: CalibrationErrors, *, seed: int) -> StereoRig:
    """Return the true rig of which `calibrated` is the imperfect calibration; the left camera's pose is exact.

    Cameras that are calibrated as pinholes (rectified images) have a radial distortion that rectification left over.
    """
    if errors.scale == 0:
        return calibrated
    rng = np.random.default_rng([seed, 71])
    cam0, cam1 = (_true_camera(camera, errors, rng) for camera in (calibrated.cam0, calibrated.cam1))
    axis = rng.standard_normal(3)
    axis /= np.linalg.norm(axis)
    turn = so3_exp(np.deg2rad(errors.scale * errors.rotation_deg) * axis)
    T = calibrated.T_cam0_cam1
    longer = rng.choice([-1.0, 1.0]) * errors.scale * errors.baseline_mm * 1e-3
    t = T[:3, 3] * (1 + longer / np.linalg.norm(T[:3, 3]))
    return replace(
        calibrated,
        cam0=cam0,
        cam1=cam1,
        T_imu_cam1=calibrated.T_imu_cam0 @ se3_from_parts(T[:3, :3] @ turn, t),
    )


def _true_camera(camera: CameraModel, errors: CalibrationErrors, rng: np.random.Generator) -> CameraModel:
    angle, sign = rng.uniform(0, 2 * np.pi), rng.choice([-1.0, 1.0])
    shift = errors.scale * errors.principal_point_px * np.array([np.cos(angle), np.sin(angle)])
    first = sign * errors.scale * errors.distortion
    model, k = camera.model, camera.coefficients
    if model == "pinhole":
        model, k = "radtan", (0.0, 0.0, 0.0, 0.0)
    elif model not in ("radtan", "equidistant"):
        raise SimulationError(f"a {model} lens cannot be miscalibrated; use a pinhole, radtan or equidistant one")
    changed = (k[0] + first, *k[1:])
    return replace(
        camera, cu=camera.cu + float(shift[0]), cv=camera.cv + float(shift[1]), model=model, coefficients=changed
    )
