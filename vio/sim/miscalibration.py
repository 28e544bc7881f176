"""How far a real stereo calibration is from the cameras: the true rig behind a calibrated one."""

from __future__ import annotations

from dataclasses import astuple, dataclass, replace

import numpy as np

from vio.errors import SimulationError
from vio.geometry.distortion import CameraModel, StereoRig, holds_distortion
from vio.geometry.lie import FloatArray, se3_from_parts, so3_exp
from vio.setting import setting

_NONE = (0.0, 0.0)  # tangential distortion


@dataclass(frozen=True, slots=True)
class CalibrationErrors:
    """Sizes of a calibration's errors; their directions and signs follow from the seed."""

    scale: float = setting(
        0.0, "factor on all of them: 0 is an exact calibration, 1 one as after a real one"
    )
    principal_point_px: float = setting(
        0.25, "principal point of each camera, in a random direction", unit="px"
    )
    distortion: float = setting(1e-3, "first radial coefficient of each camera, either sign")
    rotation_deg: float = setting(0.03, "right camera about a random axis", unit="deg")
    baseline_mm: float = setting(0.5, "right camera along the baseline, either way", unit="mm")

    def __post_init__(self) -> None:
        values = (
            self.scale,
            self.principal_point_px,
            self.distortion,
            self.rotation_deg,
            self.baseline_mm,
        )
        if not all(np.isfinite(v) and v >= 0 for v in values):
            raise SimulationError("calibration errors are sizes: finite and not negative")


@dataclass(frozen=True, slots=True)
class CalibrationSigmas:
    """Standard deviations of a calibration's errors, from which the seed draws a rig, normally and
    independently.

    The right camera's terms that move rows of left and right against each other (its pitch and
    roll, and what its height of the principal point, focal length and lens differ from the left
    one's) are scaled by `rows`. With 0 the rows agree, as after a rectification that was adjusted
    by rows, and disparities are off all the same.
    """

    scale: float = setting(
        0.0, "factor on all of them: 0 draws nothing, 1 a rig as after a careful calibration"
    )
    rows: float = setting(
        1.0, "factor on what moves rows of left and right against each other; 0: rows agree"
    )
    baseline: float = setting(0.003, "length of the baseline, over it")
    focal_length: float = setting(0.002, "focal length of both cameras alike, over it")
    focal_difference: float = setting(
        0.0005, "focal length of the right camera against the left one, over it"
    )
    yaw_deg: float = setting(0.02, "right camera about its vertical axis", unit="deg")
    pitch_deg: float = setting(0.02, "right camera about its horizontal axis", unit="deg")
    roll_deg: float = setting(0.02, "right camera about its optical axis", unit="deg")
    cx_px: float = setting(0.2, "column of each camera's principal point", unit="px")
    cy_px: float = setting(0.2, "row of each camera's principal point", unit="px")
    k1: float = setting(1e-3, "first radial coefficient of each camera")
    k2: float = setting(1e-3, "second radial coefficient of each camera")
    seed: int | None = setting(
        None, "draws the rig in place of the render's seed, so that renders share it", at_least=0
    )

    def __post_init__(self) -> None:
        if not all(np.isfinite(v) and v >= 0 for v in astuple(self) if v is not None):
            raise SimulationError("calibration sigmas are finite and not negative")


def drawn_rig(calibrated: StereoRig, sigmas: CalibrationSigmas, *, seed: int) -> StereoRig:
    """Return a true rig drawn about `calibrated`; the left camera's pose is exact.

    Raises:
        SimulationError: the lens is of a model that holds no more radial distortion.
    """
    if sigmas.scale == 0:
        return calibrated
    s = sigmas
    rng = np.random.default_rng([seed if s.seed is None else s.seed, 72])
    baseline, focal, difference, *turn_deg = s.scale * rng.standard_normal(6)
    lens = s.scale * rng.standard_normal((2, 4)) * [s.cx_px, s.cy_px, s.k1, s.k2]  # left, right
    lens[1, 1:] = lens[0, 1:] + s.rows * (lens[1, 1:] - lens[0, 1:])
    sigma_deg = [s.rows * s.pitch_deg, s.yaw_deg, s.rows * s.roll_deg]
    turn = np.deg2rad(turn_deg) * sigma_deg
    of_right = s.rows * difference * s.focal_difference
    zoom = 1 + focal * s.focal_length + np.array([0.0, of_right])
    T = calibrated.T_cam0_cam1
    longer = 1 + baseline * s.baseline
    T_true = se3_from_parts(T[:3, :3] @ so3_exp(turn), T[:3, 3] * longer)
    pairs = zip((calibrated.cam0, calibrated.cam1), lens, zoom.tolist(), strict=True)
    cam0, cam1 = (_changed(camera, off[:2], off[2:], factor) for camera, off, factor in pairs)
    return replace(calibrated, cam0=cam0, cam1=cam1, T_imu_cam1=calibrated.T_imu_cam0 @ T_true)


def miscalibrated(calibrated: StereoRig, errors: CalibrationErrors, *, seed: int) -> StereoRig:
    """Return the true rig of which `calibrated` is the imperfect calibration; the left camera's
    pose is exact.

    Cameras that are calibrated as pinholes (rectified images) have a radial distortion that
    rectification left over.
    """
    if errors.scale == 0:
        return calibrated
    rng = np.random.default_rng([seed, 71])
    cam0, cam1 = (
        _true_camera(camera, errors, rng) for camera in (calibrated.cam0, calibrated.cam1)
    )
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


def _true_camera(
    camera: CameraModel, errors: CalibrationErrors, rng: np.random.Generator
) -> CameraModel:
    angle = rng.uniform(0, 2 * np.pi)
    sign = rng.choice([-1.0, 1.0])
    shift = errors.scale * errors.principal_point_px * np.array([np.cos(angle), np.sin(angle)])
    return _changed(camera, shift, np.array([sign * errors.scale * errors.distortion]))


def _changed(
    camera: CameraModel, shift_px: FloatArray, radial: FloatArray, zoom: float = 1.0
) -> CameraModel:
    """Return the camera with its principal point (2,) and first radial terms moved, and zoomed."""
    k1, k2 = [*radial.tolist(), 0.0][:2]
    if not holds_distortion(camera, (1.0, 0.0), _NONE):
        raise SimulationError(
            f"a {camera.model} lens cannot be miscalibrated; use a pinhole, radtan, equidistant or "
            "unified one"
        )
    cu = camera.cu + float(shift_px[0])
    cv = camera.cv + float(shift_px[1])
    model, coefficients = camera.lens.bent(camera.coefficients, (k1, k2), _NONE)
    return replace(
        camera,
        fu=camera.fu * zoom,
        fv=camera.fv * zoom,
        cu=cu,
        cv=cv,
        model=model,
        coefficients=coefficients,
    )
