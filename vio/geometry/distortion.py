"""Camera models: pinhole, radial-tangential, equidistant, unified, double sphere, and the stereo
rig of two cameras.

Pixels: u right, v down, the centre of the top-left pixel is (0, 0). Rays and points are in the
camera frame (x right, y down, z forward).
References: Brown, Close-range camera calibration (1971), as written by OpenCV, EuRoC and KITTI with
`k1 k2 p1 p2 [k3]`, or with OpenCV's rational `k4 k5 k6` as well; Kannala & Brandt, A generic camera
model (2006), with `k1 k2 k3 k4` on the angle, as OpenCV's fisheye model. Unified and double sphere:
`vio.geometry.sphere_models`.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Literal, TypeAlias

import numpy as np
import numpy.typing as npt

from vio.errors import CalibrationError
from vio.geometry import sphere_models
from vio.geometry.lie import FloatArray, se3_inverse
from vio.geometry.stereo import StereoCamera

DistortionModel: TypeAlias = Literal["pinhole", "radtan", "equidistant", "unified", "double_sphere"]

_COEFFICIENTS: dict[DistortionModel, tuple[int, ...]] = {
    "pinhole": (0,),
    "radtan": (4, 5, 8),
    "equidistant": (4,),
    "unified": (1, 5),
    "double_sphere": (2,),
}
_NEWTON_STEPS = 30
_NEWTON_TOLERANCE = 1e-11  # on the normalised image plane: about 1e-8 px
# Tolerances of a pair that is rectified up to the rounding of its calibration file: rows within
# 0.01 px.
_ALIGNED_RAD = 2e-5
_ALIGNED_SHARE = 1e-4  # of the baseline
_SAME_INTRINSICS = 1e-6


@dataclass(frozen=True, slots=True)
class CameraModel:
    """Intrinsics and lens distortion of one camera."""

    fu: float  # focal length, pixels, along u
    fv: float  # focal length, pixels, along v
    cu: float  # principal point, pixels
    cv: float  # principal point, pixels
    width: int  # pixels
    height: int  # pixels
    model: DistortionModel = "pinhole"
    # radtan: k1 k2 p1 p2 [k3 [k4 k5 k6]]; equidistant: k1 k2 k3 k4; unified: xi [k1 k2 p1 p2];
    # double_sphere: xi alpha; pinhole: none
    coefficients: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        if self.model not in _COEFFICIENTS:
            raise CalibrationError(
                f"unknown distortion model {self.model!r}; use one of {', '.join(_COEFFICIENTS)}"
            )
        values = (self.fu, self.fv, self.cu, self.cv, *self.coefficients)
        if not np.all(np.isfinite(values)):
            raise CalibrationError(
                f"camera intrinsics are not finite: {values}; check the calibration file"
            )
        if self.fu <= 0 or self.fv <= 0 or self.width <= 0 or self.height <= 0:
            raise CalibrationError(
                f"focal lengths and image size must be positive, got fu={self.fu:g}, "
                f"fv={self.fv:g}, "
                f"{self.width}x{self.height}"
            )
        # a list is no key of a cache
        object.__setattr__(self, "coefficients", tuple(self.coefficients))
        expected = _COEFFICIENTS[self.model]
        if len(self.coefficients) not in expected:
            raise CalibrationError(
                f"the {self.model} model takes {expected[0]} distortion coefficients"
                f"{''.join(f' or {n}' for n in expected[1:])}, got {len(self.coefficients)}"
            )
        if self.model == "unified" and self.coefficients[0] < 0:
            raise CalibrationError(
                f"the unified model's xi must not be negative, got {self.coefficients[0]:g}"
            )
        if self.model == "double_sphere":
            xi, alpha = self.coefficients
            if not (-1 < xi <= 1 and 0 <= alpha < 1):
                raise CalibrationError(
                    "the double sphere model needs -1 < xi <= 1 and 0 <= alpha < 1, got "
                    f"xi={xi:g}, alpha={alpha:g}; "
                    "check their order"
                )

    @property
    def K(self) -> FloatArray:
        """Intrinsic matrix (3, 3), pixels."""
        return np.array([[self.fu, 0, self.cu], [0, self.fv, self.cv], [0, 0, 1]], dtype=np.float64)


@dataclass(frozen=True, slots=True)
class StereoRig:
    """Two real cameras rigidly mounted on a body."""

    cam0: CameraModel  # left
    cam1: CameraModel  # right
    T_imu_cam0: FloatArray  # (4, 4) metres
    T_imu_cam1: FloatArray  # (4, 4) metres

    @property
    def T_cam0_cam1(self) -> FloatArray:
        """Pose (4, 4) of the right camera in the left one; its translation is the baseline."""
        return se3_inverse(self.T_imu_cam0) @ self.T_imu_cam1


def rectified_pair(rig: StereoRig) -> StereoCamera | None:
    """Return the rectified pair equal to a rig up to rounding; None: the rig needs rectifying."""
    a = rig.cam0
    b = rig.cam1
    T_cam0_cam1 = rig.T_cam0_cam1
    x, y, z = T_cam0_cam1[:3, 3]
    same_size = (a.width, a.height) == (b.width, b.height)
    same = np.allclose(
        (a.fu, a.fv, a.cu, a.cv), (b.fu, b.fv, b.cu, b.cv), rtol=_SAME_INTRINSICS, atol=0
    )
    aligned = (
        np.abs(T_cam0_cam1[:3, :3] - np.eye(3)).max() <= _ALIGNED_RAD
        and np.hypot(y, z) <= _ALIGNED_SHARE * x
    )
    if not (a.model == b.model == "pinhole" and same_size and same and aligned and x > 0):
        return None
    return StereoCamera(a.fu, a.fv, a.cu, a.cv, float(x), a.width, a.height)


def rectified_camera(rig: StereoRig) -> StereoCamera:
    """Return the rectified pair equal to the rig.

    Raises:
        CalibrationError: the rig is not rectified (distortion, different intrinsics, or rows not
            aligned).
    """
    if (pair := rectified_pair(rig)) is None:
        raise CalibrationError("the stereo rig is not rectified; rectify its images first")
    return pair


def rig_from_rectified(camera: StereoCamera, T_cam0_imu: npt.ArrayLike) -> StereoRig:
    """Return a rectified pair as a rig of two equal pinhole cameras.

    Raises:
        CalibrationError: the image size is unknown.
    """
    if camera.width is None or camera.height is None:
        raise CalibrationError("a rig needs the image size; this rectified camera has none")
    one = CameraModel(camera.fu, camera.fv, camera.cu, camera.cv, camera.width, camera.height)
    T_imu_cam0 = se3_inverse(T_cam0_imu)
    T_cam0_cam1 = np.eye(4)
    T_cam0_cam1[0, 3] = camera.baseline_m
    return StereoRig(one, one, T_imu_cam0, T_imu_cam0 @ T_cam0_cam1)


def project_point(
    camera: CameraModel, p_cam: npt.ArrayLike
) -> tuple[FloatArray, npt.NDArray[np.bool_]]:
    """Pixels (..., 2) of points (..., 3) in the camera frame, and a mask (...) of those that the
    model can project.

    False in the mask: behind the camera, or beyond the angle where the distortion polynomial folds
    back. The pixel is then finite but arbitrary. Whether a pixel is inside the image is not
    checked.
    """
    p = np.asarray(p_cam, dtype=np.float64)
    if camera.model == "equidistant":
        xy, valid = _equidistant(camera.coefficients, p)
    elif camera.model == "double_sphere":
        xy, valid = sphere_models.double_sphere(camera.coefficients, p)
    elif camera.model == "unified":
        xy, valid = sphere_models.unified(camera.coefficients[0], p)
        if len(bend := camera.coefficients[1:]):
            valid = valid & (np.linalg.norm(xy, axis=-1) < _radtan_max_radius(bend))
            xy = _radtan(bend, np.where(valid[..., None], xy, 0.0))
    else:
        valid = np.greater(p[..., 2], 1e-9)
        xy = p[..., :2] / np.where(valid, p[..., 2], 1.0)[..., None]
        if camera.model == "radtan":
            valid = valid & (np.linalg.norm(xy, axis=-1) < _radtan_max_radius(camera.coefficients))
            xy = np.where(valid[..., None], xy, 0.0)
            xy = _radtan(camera.coefficients, xy)
    return xy * (camera.fu, camera.fv) + (camera.cu, camera.cv), valid


def unproject_pixel(
    camera: CameraModel, uv: npt.ArrayLike
) -> tuple[FloatArray, npt.NDArray[np.bool_]]:
    """Unit rays (..., 3) in the camera frame of pixels (..., 2), and a mask (...) where Newton's
    method converged.

    A pixel outside the model's range has False in the mask and an arbitrary finite ray.
    """
    uv = np.asarray(uv, dtype=np.float64)
    xy = (uv - (camera.cu, camera.cv)) / (camera.fu, camera.fv)
    if camera.model == "equidistant":
        return _unproject_equidistant(camera.coefficients, xy)
    if camera.model == "double_sphere":
        return sphere_models.unproject_double_sphere(camera.coefficients, xy)
    valid: npt.NDArray[np.bool_] = np.asarray(np.isfinite(xy).all(axis=-1))
    if camera.model == "unified":
        if len(bend := camera.coefficients[1:]):
            xy, valid = _undistort_radtan(bend, xy)
        ray, inside = sphere_models.unproject_unified(camera.coefficients[0], xy)
        return ray, valid & inside
    if camera.model == "radtan":
        xy, valid = _undistort_radtan(camera.coefficients, xy)
    ray = np.concatenate([xy, np.ones((*xy.shape[:-1], 1))], axis=-1)
    return ray / np.linalg.norm(ray, axis=-1, keepdims=True), valid


def _five(coefficients: tuple[float, ...]) -> tuple[float, float, float, float, float]:
    """Return the radial-tangential coefficients k1 k2 p1 p2 k3; an absent k3 is zero."""
    k1, k2, p1, p2 = coefficients[:4]
    return k1, k2, p1, p2, coefficients[4] if len(coefficients) > 4 else 0.0


def _divisor(
    coefficients: tuple[float, ...], r2: FloatArray
) -> tuple[FloatArray, FloatArray] | None:
    """Divisor of the rational model's radial factor and its derivative with respect to `r2`.

    None: not rational.
    """
    if len(coefficients) < 8:
        return None
    k4, k5, k6 = coefficients[5:]
    return 1 + r2 * (k4 + r2 * (k5 + r2 * k6)), k4 + r2 * (2 * k5 + r2 * 3 * k6)


def _radtan(coefficients: tuple[float, ...], xy: FloatArray) -> FloatArray:
    k1, k2, p1, p2, k3 = _five(coefficients)
    x = xy[..., 0]
    y = xy[..., 1]
    r2 = x * x + y * y
    radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
    if (divisor := _divisor(coefficients, r2)) is not None:
        radial = radial / divisor[0]
    return np.stack(
        [
            x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x),
            y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y,
        ],
        axis=-1,
    )


def _radtan_D_xy(coefficients: tuple[float, ...], xy: FloatArray) -> FloatArray:
    k1, k2, p1, p2, k3 = _five(coefficients)
    x = xy[..., 0]
    y = xy[..., 1]
    r2 = x * x + y * y
    radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
    slope = 2 * k1 + r2 * (4 * k2 + r2 * 6 * k3)
    if (divisor := _divisor(coefficients, r2)) is not None:
        below, below_D_r2 = divisor
        radial, slope = radial / below, (slope - 2 * radial * below_D_r2 / below) / below
    out = np.empty((*xy.shape[:-1], 2, 2))
    out[..., 0, 0] = radial + slope * x * x + 2 * p1 * y + 6 * p2 * x
    out[..., 1, 1] = radial + slope * y * y + 6 * p1 * y + 2 * p2 * x
    out[..., 0, 1] = out[..., 1, 0] = slope * x * y + 2 * p1 * x + 2 * p2 * y
    return out


@lru_cache(maxsize=256)
def _radtan_max_radius(coefficients: tuple[float, ...]) -> float:
    """Radius on the undistorted plane where the radial polynomial stops growing: the model folds
    back beyond it.
    """
    k1, k2, _, _, k3 = _five(coefficients)
    if len(coefficients) == 8:
        return _rational_max_radius((1.0, k1, k2, k3), (1.0, *coefficients[5:]))
    # In 1/r^2 the polynomial is monic, which avoids dividing by a small coefficient.
    roots = np.roots([1.0, 3 * k1, 5 * k2, 7 * k3])
    inverse = [float(root.real) for root in roots if abs(root.imag) < 1e-12 and root.real > 1e-12]
    return float(1 / np.sqrt(max(inverse))) if inverse else np.inf


def _rational_max_radius(above: tuple[float, ...], below: tuple[float, ...]) -> float:
    """Radius where `r above(r^2) / below(r^2)` stops growing, or the divisor vanishes; ascending
    powers of r^2.
    """
    n = np.polynomial.Polynomial(above)
    d = np.polynomial.Polynomial(below)
    s = np.polynomial.Polynomial([0.0, 1.0])
    roots = [*(n * d + 2 * s * (n.deriv() * d - n * d.deriv())).roots(), *d.roots()]
    positive = [float(root.real) for root in roots if abs(root.imag) < 1e-9 and root.real > 1e-12]
    return float(np.sqrt(min(positive))) if positive else np.inf


def _undistort_radtan(
    coefficients: tuple[float, ...], target: FloatArray
) -> tuple[FloatArray, npt.NDArray[np.bool_]]:
    xy = np.where(np.isfinite(target), target, 0.0)
    goal = xy
    for _ in range(_NEWTON_STEPS):
        residual = _radtan(coefficients, xy) - goal
        if np.abs(residual).max(initial=0.0) < _NEWTON_TOLERANCE:
            break
        J = _radtan_D_xy(coefficients, xy)
        det = J[..., 0, 0] * J[..., 1, 1] - J[..., 0, 1] * J[..., 1, 0]
        det = np.where(np.abs(det) < 1e-6, 1e-6, det)
        step = np.stack(
            [
                J[..., 1, 1] * residual[..., 0] - J[..., 0, 1] * residual[..., 1],
                J[..., 0, 0] * residual[..., 1] - J[..., 1, 0] * residual[..., 0],
            ],
            axis=-1,
        )
        xy = xy - np.clip(step / det[..., None], -0.5, 0.5)
    found = np.linalg.norm(_radtan(coefficients, xy) - target, axis=-1) < 1e-8
    radius = np.linalg.norm(xy, axis=-1)
    return xy, np.logical_and(found, radius < _radtan_max_radius(coefficients))


def _theta_polynomial(
    coefficients: tuple[float, ...], theta: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return the distorted angle and its derivative."""
    k1, k2, k3, k4 = coefficients
    t2 = theta * theta
    value = theta * (1 + t2 * (k1 + t2 * (k2 + t2 * (k3 + t2 * k4))))
    slope = 1 + t2 * (3 * k1 + t2 * (5 * k2 + t2 * (7 * k3 + t2 * 9 * k4)))
    return value, slope


@lru_cache(maxsize=256)
def _max_theta(coefficients: tuple[float, ...]) -> float:
    """Angle in radians where the distorted angle stops growing, at most pi."""
    k1, k2, k3, k4 = coefficients
    roots = np.roots([9 * k4, 7 * k3, 5 * k2, 3 * k1, 1.0])
    positive = [float(root.real) for root in roots if abs(root.imag) < 1e-9 and root.real > 0]
    return float(min([np.pi, *np.sqrt(positive)]))


def _equidistant(
    coefficients: tuple[float, ...], p: FloatArray
) -> tuple[FloatArray, npt.NDArray[np.bool_]]:
    radius = np.linalg.norm(p[..., :2], axis=-1)
    theta = np.arctan2(radius, p[..., 2])
    valid = (theta < _max_theta(coefficients)) & (np.linalg.norm(p, axis=-1) > 1e-12)
    theta_d, _ = _theta_polynomial(coefficients, theta)
    near_axis = radius < 1e-12
    scale = np.where(near_axis, 0.0, theta_d / np.where(near_axis, 1.0, radius))
    return p[..., :2] * scale[..., None], valid


def _unproject_equidistant(
    coefficients: tuple[float, ...], xy: FloatArray
) -> tuple[FloatArray, npt.NDArray[np.bool_]]:
    finite: npt.NDArray[np.bool_] = np.asarray(np.isfinite(xy).all(axis=-1))
    xy = np.where(finite[..., None], xy, 0.0)
    theta_d = np.linalg.norm(xy, axis=-1)
    limit = _max_theta(coefficients)
    theta = np.minimum(theta_d, 0.9 * limit)
    for _ in range(_NEWTON_STEPS):
        value, slope = _theta_polynomial(coefficients, theta)
        if np.abs(value - theta_d).max(initial=0.0) < _NEWTON_TOLERANCE:
            break
        theta = np.clip(
            theta - (value - theta_d) / np.where(np.abs(slope) < 1e-3, 1e-3, slope), 0.0, limit
        )
    value, _ = _theta_polynomial(coefficients, theta)
    valid = finite & (np.abs(value - theta_d) < 1e-8)
    near_axis = theta_d < 1e-12
    direction = xy / np.where(near_axis, 1.0, theta_d)[..., None]
    ray = np.concatenate([np.sin(theta)[..., None] * direction, np.cos(theta)[..., None]], axis=-1)
    return ray, valid
