"""The stereo rig that recordings, calibration files and callers of the library describe, and its rectification."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt

from vio.errors import CalibrationError
from vio.geometry.distortion import CameraModel, DistortionModel, StereoRig, rectified_pair
from vio.geometry.lie import FloatArray, nearest_rotation, se3_from_parts, se3_inverse
from vio.geometry.rectify import (
    PINHOLE_REACH,
    Interpolation,
    MapArray,
    ProjectionMode,
    field_of_view,
    rectified_cameras,
    rectify,
)
from vio.geometry.stereo import StereoCamera
from vio.records import Image, ImuDensities

_ROTATION_TOLERANCE = 1e-3  # largest entry of R^T R - I accepted as rounding
_EXACT = 1e-12  # rotations this close to orthonormal keep their bits
_PARTS = 32  # of a pixel, in which OpenCV's remap counts
LookUp: TypeAlias = tuple[npt.NDArray[Any], npt.NDArray[Any]]  # maps for cv2.remap: u and v, or those of `fixed_point`


@dataclass(frozen=True, slots=True)
class Rectifier:
    """The rectification of a rig's raw images."""

    rig: StereoRig
    camera: StereoCamera  # rectified
    T_rect0_imu: FloatArray  # (4, 4)
    maps: tuple[LookUp, LookUp] | None  # left, right; None: nothing to do
    interpolation: Interpolation
    time_offset_s: float = 0.0  # of the calibration; readers take it out of the IMU's stamps

    @property
    def notes(self) -> tuple[str, ...]:
        """What rectifying keeps of a wide lens; nothing for a lens that a planar image can hold."""
        if self.maps is None:
            return ()
        seen, kept = (np.degrees(field_of_view(camera)) for camera in (self.rig.cam0, self.camera))
        if seen.max() <= 2 * np.degrees(PINHOLE_REACH):
            return ()
        form = "a cylinder about the baseline" if self.camera.is_cylinder else "a pinhole's image"
        return (
            f"the lens shows {seen[0]:.0f} x {seen[1]:.0f} deg; rectified to {form}, {kept[0]:.0f} x {kept[1]:.0f} deg "
            f"are kept, at {self.camera.fu:.0f} px per radian in the middle (the lens: {self.rig.cam0.fu:.0f})",
        )

    def __call__(self, left: Image, right: Image) -> tuple[Image, Image]:
        """Rectify one raw pair, each image (H, W) of its camera's size."""
        if self.maps is None:
            return left, right
        return self.left(left), remap(right, self.maps[1], self.interpolation)

    def left(self, image: Image) -> Image:
        """Rectify a raw left image (H, W) alone."""
        return image if self.maps is None else remap(image, self.maps[0], self.interpolation)


def rectifier_of(
    rig: StereoRig, interpolation: Interpolation = "linear", projection: ProjectionMode = "auto"
) -> Rectifier:
    """Prepare the rectification of two cameras; a pair that is rectified already passes images through unchanged.

    Raises:
        CalibrationError: the cameras coincide, diverge, are swapped, or share no field of view.
    """
    if (pair := rectified_pair(rig)) is not None:
        return Rectifier(rig, pair, se3_inverse(rig.T_imu_cam0), None, interpolation)
    done = rectify(rig, projection)
    maps = fixed_point(done.map0), fixed_point(done.map1)
    return Rectifier(rig, done.camera, done.T_rect0_imu, maps, interpolation)


def fixed_point(maps: tuple[MapArray, MapArray]) -> LookUp:
    """Return source u and v (H, W) as cv2.remap makes them of floats for each image, in three quarters of the memory.

    That is whole pixels (H, W, 2) int16, and the rest (H, W) uint16 in parts of a pixel, `32 v + u`.
    """
    u, v = (np.rint(m * np.float32(_PARTS)).astype(np.int32) for m in maps)
    whole = np.stack([u // _PARTS, v // _PARTS], axis=-1).astype(np.int16)
    return whole, (v % _PARTS * _PARTS + u % _PARTS).astype(np.uint16)


def remap(image: Image, maps: LookUp, interpolation: Interpolation) -> Image:
    """Return an image (H, W) looked up at the source pixels of a map."""
    import cv2

    codes = {"linear": cv2.INTER_LINEAR, "cubic": cv2.INTER_CUBIC, "lanczos4": cv2.INTER_LANCZOS4}
    # The maps stay inside the image, so only the outermost taps of the interpolation reach the border.
    out = cv2.remap(image, maps[0], maps[1], codes[interpolation], borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(out, dtype=np.uint8)


@dataclass(frozen=True, slots=True)
class Rig:
    """Two cameras and, where there is one, an inertial sensor, as calibrated.

    Build one with `Rig.rectified`, `Rig.raw` or `vio.load_rig`. Images of raw cameras are rectified by `rectifier`; the
    estimator works with `camera` and `T_rect0_imu`, those of the rectified images.
    """

    cam0: CameraModel  # left
    cam1: CameraModel  # right
    T_cam1_cam0: FloatArray  # (4, 4) maps points of the left camera to the right one, metres
    T_cam0_imu: FloatArray | None = None  # (4, 4) of the left camera as calibrated; None: no sensor, the body is cam0
    imu_noise: ImuDensities | None = None
    time_offset_s: float = 0.0  # a frame stamped t was exposed at t + offset of the IMU's clock
    notes: tuple[str, ...] = ()  # what a reader of calibration files found and assumed
    residual_px: float = 0.0  # by how much pixels are known to be off still (rms): what the lens models cannot hold

    def __post_init__(self) -> None:
        _check_rigid(self.T_cam1_cam0, "T_cam1_cam0")
        if self.T_cam0_imu is not None:
            _check_rigid(self.T_cam0_imu, "T_cam0_imu")
        if not np.isfinite(self.time_offset_s):
            raise CalibrationError(f"the time offset of camera and IMU is {self.time_offset_s}; give finite seconds")

    @classmethod
    def rectified(
        cls,
        fu: float,
        fv: float,
        cu: float,
        cv: float,
        baseline_m: float,
        width: int,
        height: int,
        T_cam0_imu: npt.ArrayLike | None = None,
        *,
        imu_noise: ImuDensities | None = None,
        time_offset_s: float = 0.0,
    ) -> Rig:
        """Return the rig of a pair whose images are rectified already.

        Args:
            fu: focal length along u, pixels, of both images.
            fv: focal length along v, pixels.
            cu: principal point, pixels, of both images.
            cv: principal point, pixels.
            baseline_m: distance from the left to the right camera, metres.
            width: image width, pixels.
            height: image height, pixels.
            T_cam0_imu: (4, 4) or (3, 4), maps IMU coordinates to the left camera; None: no inertial sensor.
            imu_noise: densities of the IMU, where known.
            time_offset_s: a frame stamped t was exposed at t + offset of the IMU's clock.

        Raises:
            CalibrationError: a focal length, the baseline, the size or the transform is impossible.
        """
        StereoCamera(fu, fv, cu, cv, baseline_m, width, height)  # checks baseline and focal lengths
        one = CameraModel(fu, fv, cu, cv, width, height)
        T_cam1_cam0 = se3_from_parts(np.eye(3), [-baseline_m, 0.0, 0.0])
        return cls(one, one, T_cam1_cam0, _rigid(T_cam0_imu, "T_cam0_imu"), imu_noise, time_offset_s)

    @classmethod
    def raw(
        cls,
        K0: npt.ArrayLike,
        K1: npt.ArrayLike,
        T_cam1_cam0: npt.ArrayLike,
        width: int,
        height: int,
        *,
        model: DistortionModel = "pinhole",
        distortion0: npt.ArrayLike = (),
        distortion1: npt.ArrayLike = (),
        T_cam0_imu: npt.ArrayLike | None = None,
        imu_noise: ImuDensities | None = None,
        time_offset_s: float = 0.0,
    ) -> Rig:
        """Return the rig of two cameras of one size and model, as calibrations state them.

        Args:
            K0: (3, 3) intrinsic matrix of the left camera, pixels.
            K1: (3, 3) of the right camera.
            T_cam1_cam0: (4, 4) or (3, 4), maps left-camera coordinates to the right camera, metres (OpenCV's R, T).
            width: image width, pixels, of both.
            height: image height, pixels.
            model: lens model of both.
            distortion0: coefficients of the left lens, in the order of `CameraModel.coefficients`.
            distortion1: coefficients of the right lens.
            T_cam0_imu: (4, 4) or (3, 4), maps IMU coordinates to the left camera; None: no inertial sensor.
            imu_noise: densities of the IMU, where known.
            time_offset_s: a frame stamped t was exposed at t + offset of the IMU's clock.

        Raises:
            CalibrationError: a matrix has a wrong form, or the model does not take these coefficients.
        """
        cam0, cam1 = (
            camera_from_matrix(K, width, height, model, distortion, name)
            for K, distortion, name in ((K0, distortion0, "K0"), (K1, distortion1, "K1"))
        )
        T = _rigid(T_cam1_cam0, "T_cam1_cam0")
        assert T is not None
        return cls(cam0, cam1, T, _rigid(T_cam0_imu, "T_cam0_imu"), imu_noise, time_offset_s)

    @property
    def stereo(self) -> StereoRig:
        """The cameras mounted on the body: on the IMU, or on cam0 where there is none."""
        T_imu_cam0 = np.eye(4) if self.T_cam0_imu is None else se3_inverse(self.T_cam0_imu)
        return StereoRig(self.cam0, self.cam1, T_imu_cam0, T_imu_cam0 @ se3_inverse(self.T_cam1_cam0))

    @property
    def is_rectified(self) -> bool:
        """Whether the images need no rectification: equal pinhole cameras, rows aligned to 0.01 px."""
        return rectified_pair(self.stereo) is not None

    @property
    def camera(self) -> StereoCamera:
        """The rectified pair: that of the images themselves, or of what `rectifier` makes of them.

        Raises:
            CalibrationError: the cameras coincide, diverge, are swapped, or share no field of view.
        """
        pair = rectified_pair(self.stereo)
        camera = rectified_cameras(self.stereo, "auto").camera if pair is None else self._exact(pair)
        return replace(camera, residual_px=self.residual_px)

    @property
    def T_rect0_imu(self) -> FloatArray | None:
        """Extrinsics (4, 4) of the rectified left camera, as the estimator takes them; None: no inertial sensor."""
        if self.T_cam0_imu is None or self.is_rectified:
            return self.T_cam0_imu
        return rectified_cameras(self.stereo).T_rect0_imu

    def rectifier(self, interpolation: Interpolation = "linear", projection: ProjectionMode = "auto") -> Rectifier:
        """Return the map of raw image pairs (H, W) to rectified ones; the identity for a rectified rig.

        `projection` is that of the rectified images: a cylinder about the baseline for wide lenses by default.

        Raises:
            CalibrationError: as `camera`.
        """
        made = rectifier_of(self.stereo, interpolation, projection)
        camera = replace(made.camera, residual_px=self.residual_px)
        made = replace(made, camera=camera, time_offset_s=self.time_offset_s)
        if made.maps is not None:
            return made
        T = made.T_rect0_imu if self.T_cam0_imu is None else self.T_cam0_imu
        return replace(made, camera=self._exact(camera), T_rect0_imu=T)

    def _exact(self, pair: StereoCamera) -> StereoCamera:
        """Return a rectified pair with the baseline as stated, which the way through the body would round."""
        x, y, z = self.T_cam1_cam0[:3, 3].tolist()
        stated = not np.any(self.T_cam1_cam0[:3, :3] != np.eye(3)) and y == z == 0
        return replace(pair, baseline_m=-x) if stated else pair

    def noting(self, *notes: str) -> Rig:
        """Return the rig with further notes."""
        return replace(self, notes=(*self.notes, *notes))


def camera_from_matrix(
    K: npt.ArrayLike,
    width: int,
    height: int,
    model: DistortionModel = "pinhole",
    coefficients: npt.ArrayLike = (),
    name: str = "K",
) -> CameraModel:
    """Return a camera from its intrinsic matrix (3, 3) in pixels.

    A radial-tangential lens without any distortion becomes a pinhole.

    Raises:
        CalibrationError: K is no intrinsic matrix, or the model does not take these coefficients.
    """
    M = np.asarray(K, dtype=np.float64)
    if M.shape != (3, 3) or not np.allclose(M[[1, 2, 2, 2], [0, 0, 1, 2]], [0, 0, 0, 1], atol=1e-8):
        raise CalibrationError(
            f"{name} is no intrinsic matrix [fu 0 cu; 0 fv cv; 0 0 1] but {M.tolist()}; check its order"
        )
    if abs(M[0, 1]) > 1e-8 * abs(M[0, 0]):
        raise CalibrationError(f"{name} has a skew of {M[0, 1]:g} px, which no lens model takes; calibrate without")
    values = tuple(float(c) for c in np.ravel(np.asarray(coefficients, dtype=np.float64)))
    if model == "radtan" and not any(values):
        model, values = "pinhole", ()
    fu, fv, cu, cv = M[[0, 1, 0, 1], [0, 1, 2, 2]].tolist()
    return CameraModel(fu, fv, cu, cv, int(width), int(height), model, values)


def _rigid(T: npt.ArrayLike | None, name: str) -> FloatArray | None:
    """Return a transform (4, 4) from (4, 4) or (3, 4), its rotation orthonormal."""
    if T is None:
        return None
    M = np.asarray(T, dtype=np.float64)
    if M.shape == (3, 4):
        M = np.vstack([M, [0.0, 0.0, 0.0, 1.0]])
    _check_rigid(M, name)
    R = M[:3, :3]
    exact = np.abs(R.T @ R - np.eye(3)).max() <= _EXACT
    return se3_from_parts(R if exact else nearest_rotation(R), M[:3, 3])


def _check_rigid(T: FloatArray, name: str) -> None:
    if T.shape != (4, 4) or not np.isfinite(T).all() or not np.allclose(T[3], [0, 0, 0, 1], atol=1e-9):
        raise CalibrationError(f"{name} is no finite 4x4 rigid transform (shape {T.shape}); check the calibration")
    R = T[:3, :3]
    if np.abs(R.T @ R - np.eye(3)).max() > _ROTATION_TOLERANCE or np.linalg.det(R) < 0:
        raise CalibrationError(f"{name}: its 3x3 part is no rotation; check the order of the numbers")


def rig_of_rectified(camera: StereoCamera, T_cam0_imu: FloatArray | None) -> Rig | None:
    """Return a rectified pair with the pose (4, 4) of its IMU as a rig of two pinholes.

    None: one camera, no known image size, or a cylinder, which no lens model holds.
    """
    if camera.width is None or camera.height is None or camera.kind != "stereo" or camera.is_cylinder:
        return None
    c = camera
    return Rig.rectified(c.fu, c.fv, c.cu, c.cv, c.baseline_m, camera.width, camera.height, T_cam0_imu)
