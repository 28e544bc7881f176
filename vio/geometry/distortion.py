"""One camera with its lens, and the stereo rig of two cameras.

Pixels: u right, v down, the centre of the top-left pixel is (0, 0). Rays and points are in the
camera frame (x right, y down, z forward). The lens models are in `vio.geometry.lenses`, one file
each, with their sources.
"""

from __future__ import annotations

import math
from typing import NamedTuple, TypeAlias

import numpy as np
import numpy.typing as npt

from vio.dataclass import dataclass
from vio.errors import CalibrationError
from vio.geometry.lenses.model import Lens
from vio.geometry.lenses.registry import LENSES
from vio.geometry.lie import FloatArray, se3_inverse
from vio.geometry.stereo import StereoCamera, intrinsic_matrix

DistortionModel: TypeAlias = str  # a key of `vio.geometry.lenses.registry.LENSES`


class _SameRules(NamedTuple):
    """When two cameras are taken for rectified."""

    # Tolerances of a pair that is rectified up to the rounding of its calibration file: rows within
    # 0.01 px.
    aligned_rad: float = 2e-5
    aligned_share: float = 1e-4  # of the baseline
    intrinsics_share: float = 1e-6


_SAME = _SameRules()


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
    # double_sphere: xi alpha; eucm: alpha beta; fov: w; pinhole: none
    coefficients: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        if self.model not in LENSES:
            raise CalibrationError(
                f"unknown distortion model {self.model!r}; use one of {', '.join(LENSES)}"
            )
        values = (self.fu, self.fv, self.cu, self.cv, *self.coefficients)
        if not all(map(math.isfinite, values)):
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
        expected = self.lens.counts
        if len(self.coefficients) not in expected:
            raise CalibrationError(
                f"the {self.model} model takes {expected[0]} distortion coefficients"
                f"{''.join(f' or {n}' for n in expected[1:])}, got {len(self.coefficients)}"
            )
        if (fault := self.lens.fault(self.coefficients)) is not None:
            raise CalibrationError(fault)

    @property
    def lens(self) -> Lens:
        """The lens model."""
        return LENSES[self.model]

    @property
    def K(self) -> FloatArray:
        """Intrinsic matrix (3, 3), pixels."""
        return intrinsic_matrix(self.fu, self.fv, self.cu, self.cv)


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
        (a.fu, a.fv, a.cu, a.cv), (b.fu, b.fv, b.cu, b.cv), rtol=_SAME.intrinsics_share, atol=0
    )
    aligned = (
        np.abs(T_cam0_cam1[:3, :3] - np.eye(3)).max() <= _SAME.aligned_rad
        and np.hypot(y, z) <= _SAME.aligned_share * x
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


def simplest_lens(
    model: DistortionModel, coefficients: tuple[float, ...]
) -> tuple[DistortionModel, tuple[float, ...]]:
    """Return a pinhole for a lens that its coefficients, all zero, make one; others as they are."""
    lens = LENSES.get(model)
    if lens is not None and lens.zero_is_pinhole and not any(coefficients):
        return "pinhole", ()
    return model, coefficients


def holds_distortion(
    camera: CameraModel, radial: tuple[float, float], tangential: tuple[float, float]
) -> bool:
    """Return whether a camera's lens model holds more distortion of these kinds, k1 k2 and p1 p2;
    see `Lens.bent`.
    """
    bent = camera.lens.bent(camera.coefficients, radial, tangential)
    return bent != (camera.model, camera.coefficients)


def project_point(
    camera: CameraModel, p_cam: npt.ArrayLike
) -> tuple[FloatArray, npt.NDArray[np.bool_]]:
    """Pixels (..., 2) of points (..., 3) in the camera frame, and a mask (...) of those that the
    model can project.

    False in the mask: behind the camera, or beyond the angle where the model ends or folds back.
    The pixel is then finite but arbitrary. Whether a pixel is inside the image is not checked.
    """
    p = np.asarray(p_cam, dtype=np.float64)
    xy, valid = camera.lens.project(camera.coefficients, p)
    uv = np.empty(xy.shape)
    uv[..., 0] = xy[..., 0] * camera.fu + camera.cu
    uv[..., 1] = xy[..., 1] * camera.fv + camera.cv
    return uv, valid


def unproject_pixel(
    camera: CameraModel, uv: npt.ArrayLike
) -> tuple[FloatArray, npt.NDArray[np.bool_]]:
    """Unit rays (..., 3) in the camera frame of pixels (..., 2), and a mask (...) where the model
    has one (and Newton's method, where it is needed, converged).

    A pixel outside the model's range has False in the mask and an arbitrary finite ray.
    """
    uv = np.asarray(uv, dtype=np.float64)
    xy = (uv - (camera.cu, camera.cv)) / (camera.fu, camera.fv)
    return camera.lens.unproject(camera.coefficients, xy)


def uv_D_point(camera: CameraModel, p_cam: npt.ArrayLike) -> FloatArray:
    """Derivative (..., 2, 3) of pixels by their points (..., 3) in the camera frame, px/m, where
    the model can project.
    """
    p = np.asarray(p_cam, dtype=np.float64)
    by_p, _ = camera.lens.derivatives(camera.coefficients, p)
    return by_p * np.array([[camera.fu], [camera.fv]])


def uv_D_camera(camera: CameraModel, p_cam: npt.ArrayLike) -> FloatArray:
    """Derivative (..., 2, 4 + n) of the pixels of points (..., 3) by `fu fv cu cv` and the n
    coefficients, where the model can project.
    """
    p = np.asarray(p_cam, dtype=np.float64)
    xy, _ = camera.lens.project(camera.coefficients, p)
    _, by_coefficients = camera.lens.derivatives(camera.coefficients, p)
    out = np.zeros((*xy.shape, 4 + len(camera.coefficients)))
    out[..., 0, 0] = xy[..., 0]
    out[..., 1, 1] = xy[..., 1]
    out[..., 0, 2] = 1
    out[..., 1, 3] = 1
    out[..., 4:] = by_coefficients * np.array([[camera.fu], [camera.fv]])
    return out
