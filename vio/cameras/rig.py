"""The one or two cameras that recordings, calibration files and callers describe, and their
rectification.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt

from vio.dataclass import dataclass
from vio.errors import CalibrationError
from vio.geometry.distortion import (
    CameraModel,
    DistortionModel,
    StereoRig,
    rectified_pair,
    simplest_lens,
)
from vio.geometry.lie import FloatArray, checked_transform, rigid_fault, se3_from_parts, se3_inverse
from vio.geometry.rectify import (
    PINHOLE_REACH,
    Interpolation,
    MapArray,
    ProjectionMode,
    field_of_view,
    lookup,
    rectified_cameras,
    undistorted,
)
from vio.geometry.stereo import StereoCamera, one_camera
from vio.records import Image, ImuDensities, IntArray, StereoFrame

_BITS = 5  # of the parts of a pixel, 32, in which OpenCV's remap counts
# Standard deviation of a virtual disparity over that of the pixels of a track, which are those of
# two exposures.
_DISPARITY_SIGMAS = 2**0.5
_PIXEL_SIGMA_PX = 0.2  # of a tracked feature; what the filter learns on real images is 0.1 to 0.3
MAX_READOUT_S = 0.1  # of a rolling shutter: an image at 10 Hz
# maps for cv2.remap: u and v, or those of `fixed_point`
LookUp: TypeAlias = tuple[npt.NDArray[Any], npt.NDArray[Any]]


@dataclass(frozen=True, slots=True)
class Rectifier:
    """The rectification of a rig's raw images; of one camera, its undistortion, which keeps its
    direction.
    """

    lenses: StereoRig | CameraModel  # the raw cameras, or the only one
    camera: StereoCamera  # rectified; of kind "mono" or "rgbd" for one camera
    T_rect0_imu: FloatArray  # (4, 4)
    maps: tuple[LookUp, ...] | None  # left, and right where there is one; None: nothing to do
    interpolation: Interpolation
    time_offset_s: float = 0.0  # of the calibration; readers take it out of the IMU's stamps

    @property
    def rig(self) -> StereoRig:
        """The raw cameras.

        Raises:
            CalibrationError: there is one camera.
        """
        if isinstance(self.lenses, CameraModel):
            raise CalibrationError("this calibration has one camera, where a stereo pair is needed")
        return self.lenses

    @property
    def cameras(self) -> tuple[CameraModel, ...]:
        """The raw cameras: left and right, or the only one."""
        return (
            (self.lenses,)
            if isinstance(self.lenses, CameraModel)
            else (self.lenses.cam0, self.lenses.cam1)
        )

    @property
    def notes(self) -> tuple[str, ...]:
        """What rectifying keeps of a wide lens; nothing for a lens that a planar image can hold."""
        if self.maps is None:
            return ()
        lens = self.cameras[0]
        seen, kept = (np.degrees(field_of_view(camera)) for camera in (lens, self.camera))
        if seen.max() <= 2 * np.degrees(PINHOLE_REACH):
            return ()
        form = "a cylinder about the baseline" if self.camera.is_cylinder else "a pinhole's image"
        return (
            f"the lens shows {seen[0]:.0f} x {seen[1]:.0f} deg; rectified to {form}, {kept[0]:.0f} "
            f"x {kept[1]:.0f} deg "
            f"are kept, at {self.camera.fu:.0f} px per radian in the middle (the lens: "
            f"{lens.fu:.0f})",
        )

    def __call__(self, left: Image, right: Image) -> tuple[Image, Image]:
        """Rectify one raw pair, each image (H, W) of its camera's size."""
        if self.maps is None:
            return left, right
        return self.left(left), remap(right, self.maps[1], self.interpolation)

    def left(self, image: Image) -> Image:
        """Rectify a raw left image (H, W) alone, or the image of one camera."""
        if self.maps is None:
            return image
        return remap(image, self.maps[0], self.interpolation)

    def depth(self, depth_m: FloatArray) -> FloatArray:
        """Undistort a depth image (H, W) in metres: each pixel takes the nearest depth, as means
        cross outlines.
        """
        if self.maps is None:
            return depth_m
        u, v = (np.rint(m).astype(np.int64) for m in self.maps[0])
        height, width = depth_m.shape
        inside = (u >= 0) & (v >= 0) & (u < width) & (v < height)
        row = np.where(inside, v, 0)
        column = np.where(inside, u, 0)
        return np.where(inside, depth_m[row, column], 0.0)

    def rows(self, camera: int) -> IntArray | None:
        """Rows (H, W) of a camera's raw image, to a pixel, that the pixels of its rectified one
        come from; camera 0 is the left one. None: nothing is rectified.
        """
        if self.maps is None:
            return None
        first, second = self.maps[camera]
        if first.ndim == second.ndim:  # u and v, of one camera
            return np.asarray(np.rint(second), dtype=np.int64)
        rows: IntArray = first[..., 1]
        return rows

    def frame(
        self,
        index: int,
        time_ns: int,
        left: Image,
        right: Image | None = None,
        *,
        depth_m: FloatArray | None = None,
    ) -> StereoFrame:
        """Return the rectified frame of raw images (H, W) and, where there is one, a depth image
        (H, W) in metres.
        """
        left_image, right_image = (self.left(left), None) if right is None else self(left, right)
        return StereoFrame(
            index,
            time_ns,
            left_image,
            right_image,
            None if depth_m is None else self.depth(depth_m),
        )


def rectifier_of(
    rig: StereoRig, interpolation: Interpolation = "linear", projection: ProjectionMode = "auto"
) -> Rectifier:
    """Prepare the rectification of two cameras; a pair that is rectified already passes images
    through unchanged.

    Raises:
        CalibrationError: the cameras coincide, diverge, are swapped, or share no field of view.
    """
    if (pair := rectified_pair(rig)) is not None:
        return Rectifier(rig, pair, se3_inverse(rig.T_imu_cam0), None, interpolation)
    done = rectified_cameras(rig, projection)
    turned = ((rig.cam0, done.R_rect_cam0), (rig.cam1, done.R_rect_cam1))
    maps = tuple(fixed_point(lookup(done.camera, lens, R_rect_cam)) for lens, R_rect_cam in turned)
    return Rectifier(rig, done.camera, done.T_rect0_imu, maps, interpolation)


def fixed_point(maps: tuple[MapArray, MapArray]) -> LookUp:
    """Return source u and v (H, W) as cv2.remap makes them of floats for each image, in three
    quarters of the memory.

    That is whole pixels (H, W, 2) int16, and the rest (H, W) uint16 in parts of a pixel,
    `32 v + u`.
    """
    u, v = (np.rint(m * np.float32(1 << _BITS)).astype(np.int32) for m in maps)
    whole = np.empty((*u.shape, 2), dtype=np.int16)
    whole[..., 0] = u >> _BITS
    whole[..., 1] = v >> _BITS
    part = (1 << _BITS) - 1
    return whole, ((v & part) << _BITS | u & part).astype(np.uint16)


def remap(image: Image, maps: LookUp, interpolation: Interpolation) -> Image:
    """Return an image (H, W) or (H, W, 3) looked up at the source pixels of a map."""
    import cv2

    codes = {"linear": cv2.INTER_LINEAR, "cubic": cv2.INTER_CUBIC, "lanczos4": cv2.INTER_LANCZOS4}
    # The maps stay inside the image, so only the outermost taps of the interpolation reach the
    # border.
    out = cv2.remap(image, maps[0], maps[1], codes[interpolation], borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(out, dtype=np.uint8)


def with_virtual_baseline(camera: StereoCamera, depth_noise: float) -> StereoCamera:
    """Return a camera with depth images as a pair whose disparities are as uncertain as the depths.

    A depth's standard deviation `k z^2` makes one of `fu b k` of the disparity `fu b / z`, at every
    depth. The baseline b is chosen so that it is that of a stereo match, of which each pixel has
    the noise of a tracked feature.
    Reference: Khoshelham & Elberink, Accuracy and resolution of Kinect depth data, Sensors (2012),
    for `k z^2`.

    Args:
        camera: undistorted.
        depth_noise: k, 1/m; 0.0012 to 0.0019 for structured light.
    """
    baseline_m = _DISPARITY_SIGMAS * _PIXEL_SIGMA_PX / (camera.fu * depth_noise)
    return replace(camera, baseline_m=baseline_m, kind="rgbd")


@dataclass(frozen=True, slots=True)
class Rig:
    """One camera or two and, where there is one, an inertial sensor, as calibrated.

    Build a pair with `Rig.rectified` or `Rig.raw`, one camera as `Rig(camera_model, T_cam0_imu=T)`,
    any with `vio.load_rig`. Raw images are rectified by `rectifier`; the estimator works with
    `camera` and `T_rect0_imu`, those of the rectified images.
    """

    cam0: CameraModel  # left, or the only one
    cam1: CameraModel | None = None  # right; None: there is one camera
    # (4, 4) maps points of the left camera to the right one, metres
    T_cam1_cam0: FloatArray | None = None
    # (4, 4) of the left camera as calibrated; None: no sensor, the body is cam0
    T_cam0_imu: FloatArray | None = None
    imu_noise: ImuDensities | None = None
    time_offset_s: float = 0.0  # a frame stamped t was exposed at t + offset of the IMU's clock
    notes: tuple[str, ...] = ()  # what a reader of calibration files found and assumed
    # by how much pixels are known to be off still (rms): what the lens models cannot hold
    residual_px: float = 0.0
    # levels of its depth images in a metre; None: not stated, or there are none
    depth_factor: float | None = None
    # of a rolling shutter, from the exposure of the first row to that of the last
    readout_s: float = 0.0

    def __post_init__(self) -> None:
        if (self.cam1 is None) != (self.T_cam1_cam0 is None):
            raise CalibrationError("give both cam1 and T_cam1_cam0 or, for one camera, neither")
        for name, T in (("T_cam1_cam0", self.T_cam1_cam0), ("T_cam0_imu", self.T_cam0_imu)):
            if T is not None and (fault := "not 4x4" if np.shape(T) != (4, 4) else rigid_fault(T)):
                raise CalibrationError(f"{name}: {fault}")
        if self.depth_factor is not None and not self.depth_factor > 0:
            raise CalibrationError(
                f"the depth factor is {self.depth_factor:g}; give levels per metre, such as 1000"
            )
        if not np.isfinite(self.time_offset_s):
            raise CalibrationError(
                f"the time offset of camera and IMU is {self.time_offset_s}; give finite seconds"
            )
        if not abs(self.readout_s) <= MAX_READOUT_S:
            raise CalibrationError(
                f"the readout time of the shutter is {self.readout_s:g} s; give seconds from the "
                "first row to the last, such as 0.02"
            )

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
            T_cam0_imu: (4, 4) or (3, 4), maps IMU coordinates to the left camera; None: no inertial
                sensor.
            imu_noise: densities of the IMU, where known.
            time_offset_s: a frame stamped t was exposed at t + offset of the IMU's clock.

        Raises:
            CalibrationError: a focal length, the baseline, the size or the transform is impossible,
                or `cu` and `cv` are exchanged.
        """
        StereoCamera(fu, fv, cu, cv, baseline_m, width, height)  # checks baseline and focal lengths
        one = CameraModel(fu, fv, cu, cv, width, height)
        _check_principal_point(one)
        T_cam1_cam0 = se3_from_parts(np.eye(3), [-baseline_m, 0.0, 0.0])
        T = None if T_cam0_imu is None else checked_transform(T_cam0_imu, "T_cam0_imu")
        return cls(one, one, T_cam1_cam0, T, imu_noise, time_offset_s)

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
            T_cam1_cam0: (4, 4) or (3, 4), maps left-camera coordinates to the right camera, metres
                (OpenCV's R, T).
            width: image width, pixels, of both.
            height: image height, pixels.
            model: lens model of both.
            distortion0: coefficients of the left lens, in the order of `CameraModel.coefficients`.
            distortion1: coefficients of the right lens.
            T_cam0_imu: (4, 4) or (3, 4), maps IMU coordinates to the left camera; None: no inertial
                sensor.
            imu_noise: densities of the IMU, where known.
            time_offset_s: a frame stamped t was exposed at t + offset of the IMU's clock.

        Raises:
            CalibrationError: a matrix has a wrong form, the model does not take these coefficients,
                or a principal point is that of an image as high as this one is wide.
        """
        cam0, cam1 = (
            camera_from_matrix(K, width, height, model, distortion, name)
            for K, distortion, name in ((K0, distortion0, "K0"), (K1, distortion1, "K1"))
        )
        for camera in (cam0, cam1):
            _check_principal_point(camera)
        T_imu = None if T_cam0_imu is None else checked_transform(T_cam0_imu, "T_cam0_imu")
        return cls(
            cam0,
            cam1,
            checked_transform(T_cam1_cam0, "T_cam1_cam0"),
            T_imu,
            imu_noise,
            time_offset_s,
        )

    @property
    def cameras(self) -> tuple[CameraModel, ...]:
        """The cameras: left and right, or the only one."""
        if self.cam1 is None:
            return (self.cam0,)
        return (self.cam0, self.cam1)

    @property
    def right(self) -> tuple[CameraModel, FloatArray]:
        """The right camera and `T_cam1_cam0` (4, 4).

        Raises:
            CalibrationError: there is one camera.
        """
        if self.cam1 is None or self.T_cam1_cam0 is None:
            raise CalibrationError("this rig has one camera, where a stereo pair is needed")
        return self.cam1, self.T_cam1_cam0

    @property
    def stereo(self) -> StereoRig:
        """The cameras mounted on the body: on the IMU, or on cam0 where there is none.

        Raises:
            CalibrationError: there is one camera.
        """
        cam1, T_cam1_cam0 = self.right
        if self.T_cam0_imu is None:
            T_imu_cam0 = np.eye(4)
        else:
            T_imu_cam0 = se3_inverse(self.T_cam0_imu)
        return StereoRig(self.cam0, cam1, T_imu_cam0, T_imu_cam0 @ se3_inverse(T_cam1_cam0))

    @property
    def is_rectified(self) -> bool:
        """Whether images need no rectification: a pinhole, or equal pinholes with rows aligned
        to 0.01 px.
        """
        return (
            self.cam0.model == "pinhole"
            if self.cam1 is None
            else rectified_pair(self.stereo) is not None
        )

    @property
    def camera(self) -> StereoCamera:
        """The rectified pair, or one undistorted camera: of the images, or of what `rectifier`
        makes of them.

        Raises:
            CalibrationError: the cameras coincide, diverge, are swapped, or share no field of view.
        """
        if self.cam1 is None:
            return replace(_undistorted(self.cam0)[0], readout_s=self.readout_s)
        pair = rectified_pair(self.stereo)
        camera = (
            rectified_cameras(self.stereo, "auto").camera if pair is None else self._exact(pair)
        )
        return replace(camera, residual_px=self.residual_px, readout_s=self.readout_s)

    @property
    def T_rect0_imu(self) -> FloatArray | None:
        """Extrinsics (4, 4) of the rectified left camera, as the estimator takes them.

        None: no inertial sensor.
        """
        if self.T_cam0_imu is None or self.cam1 is None or self.is_rectified:
            return self.T_cam0_imu
        return rectified_cameras(self.stereo).T_rect0_imu

    def rectifier(
        self,
        interpolation: Interpolation = "linear",
        projection: ProjectionMode = "auto",
        *,
        depth_noise: float | None = None,
    ) -> Rectifier:
        """Return what rectifies raw images (H, W), or undistorts those of one camera; the identity
        where none is raw.

        Args:
            interpolation: how gray values between pixels are found.
            projection: of rectified pairs: a cylinder about the baseline for wide lenses by
                default.
            depth_noise: of one camera, `k` of a depth's standard deviation `k depth^2`, 1/m; None:
                no depth images.

        Raises:
            CalibrationError: as `camera`.
        """
        if self.cam1 is None:
            camera, maps = _undistorted(self.cam0)
            camera = replace(camera, readout_s=self.readout_s)
            camera = camera if depth_noise is None else with_virtual_baseline(camera, depth_noise)
            if self.T_cam0_imu is None:
                T = np.eye(4)
            else:
                T = self.T_cam0_imu
            return Rectifier(self.cam0, camera, T, maps, interpolation, self.time_offset_s)
        made = rectifier_of(self.stereo, interpolation, projection)
        camera = replace(made.camera, residual_px=self.residual_px, readout_s=self.readout_s)
        made = replace(made, camera=camera, time_offset_s=self.time_offset_s)
        if made.maps is not None:
            return made
        if self.T_cam0_imu is None:
            T = made.T_rect0_imu
        else:
            T = self.T_cam0_imu
        return replace(made, camera=self._exact(camera), T_rect0_imu=T)

    def _exact(self, pair: StereoCamera) -> StereoCamera:
        """Return a rectified pair with the baseline as stated, which the way through the body
        would round.
        """
        _, T = self.right
        x, y, z = T[:3, 3].tolist()
        is_turned = np.any(T[:3, :3] != np.eye(3))
        stated = not is_turned and y == z == 0
        return replace(pair, baseline_m=-x) if stated else pair

    def noting(self, *notes: str) -> Rig:
        """Return the rig with further notes."""
        return replace(self, notes=(*self.notes, *notes))

    def left_alone(self) -> Rig:
        """Return the left camera, with its inertial sensor, as a rig of one camera."""
        return replace(self, cam1=None, T_cam1_cam0=None, residual_px=0.0)


def _undistorted(lens: CameraModel) -> tuple[StereoCamera, tuple[LookUp] | None]:
    """Return one camera without its distortion, and the map of its images; None: it has none."""
    if lens.model == "pinhole":
        return one_camera(lens.fu, lens.fv, lens.cu, lens.cv, lens.width, lens.height), None
    camera, maps = undistorted(lens)
    return camera, (maps,)


def camera_from_matrix(
    K: npt.ArrayLike,
    width: int,
    height: int,
    model: DistortionModel = "pinhole",
    coefficients: npt.ArrayLike = (),
    name: str = "K",
) -> CameraModel:
    """Return a camera from its intrinsic matrix (3, 3) in pixels.

    A lens whose coefficients, all zero, make it a pinhole becomes one.

    Raises:
        CalibrationError: K is no intrinsic matrix, or the model does not take these coefficients.
    """
    M = np.asarray(K, dtype=np.float64)
    if M.shape != (3, 3) or not np.allclose(M[[1, 2, 2, 2], [0, 0, 1, 2]], [0, 0, 0, 1], atol=1e-8):
        mirrored = M.shape == (3, 3) and np.allclose(M[:2, 2], 0) and M[2, 0] > 0 and M[2, 1] > 0
        remedy = (
            "it is transposed, as MATLAB has it: transpose it, and the rotation between the cameras"
            if mirrored
            else "check its order"
        )
        raise CalibrationError(
            f"{name} is no intrinsic matrix [fu 0 cu; 0 fv cv; 0 0 1] but {M.tolist()}; {remedy}"
        )
    if abs(M[0, 1]) > 1e-8 * abs(M[0, 0]):
        raise CalibrationError(
            f"{name} has a skew of {M[0, 1]:g} px, which no lens model takes; calibrate without"
        )
    values = tuple(float(c) for c in np.ravel(np.asarray(coefficients, dtype=np.float64)))
    model, values = simplest_lens(model, values)
    fu, fv, cu, cv = M[[0, 1, 0, 1], [0, 1, 2, 2]].tolist()
    return CameraModel(fu, fv, cu, cv, int(width), int(height), model, values)


def rig_of_rectified(camera: StereoCamera, T_cam0_imu: FloatArray | None) -> Rig | None:
    """Return a rectified pair with the pose (4, 4) of its IMU as a rig of two pinholes.

    None: one camera, no known image size, or a cylinder, which no lens model holds.
    """
    if (
        camera.width is None
        or camera.height is None
        or camera.kind != "stereo"
        or camera.is_cylinder
    ):
        return None
    c = camera
    return Rig.rectified(
        c.fu, c.fv, c.cu, c.cv, c.baseline_m, camera.width, camera.height, T_cam0_imu
    )


def _check_principal_point(camera: CameraModel) -> None:
    """Raise CalibrationError where a principal point is outside of the image, and would be in the
    middle half of it with its two numbers, or with width and height, in each other's place.

    It may be outside of a part that was cut out of an image, mostly far from there then.
    """
    inside = 0 < camera.cu < camera.width and 0 < camera.cv < camera.height
    shares = camera.cv / camera.width, camera.cu / camera.height
    if not inside and all(0.25 < share < 0.75 for share in shares):
        raise CalibrationError(
            f"the principal point {camera.cu:g}, {camera.cv:g} lies outside images of "
            f"{camera.width} x {camera.height} pixels: cu and cv, or width and height, are "
            "exchanged"
        )
