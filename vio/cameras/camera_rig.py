"""One camera that recordings and calibration files describe, with depth images or without, and its undistortion."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from vio.cameras.rig import remap
from vio.errors import CalibrationError
from vio.geometry.distortion import CameraModel
from vio.geometry.lie import FloatArray, rigid_fault
from vio.geometry.rectify import Interpolation, MapArray, undistorted
from vio.geometry.stereo import StereoCamera, one_camera
from vio.records import Image, ImuDensities

# Standard deviation of a virtual disparity over that of the pixels of a track, which are those of two exposures.
_DISPARITY_SIGMAS = 2**0.5
_PIXEL_SIGMA_PX = 0.2  # of a tracked feature; what the filter learns on real images is 0.1 to 0.3


@dataclass(frozen=True, slots=True)
class CameraRig:
    """One camera and, where there is one, an inertial sensor, as calibrated. `vio.load_camera` reads one."""

    cam0: CameraModel
    T_cam0_imu: FloatArray | None = None  # (4, 4) maps the IMU's coordinates to the camera; None: no sensor
    imu_noise: ImuDensities | None = None
    time_offset_s: float = 0.0  # a frame stamped t was exposed at t + offset of the IMU's clock
    notes: tuple[str, ...] = ()  # what a reader of calibration files found and assumed
    depth_factor: float | None = None  # levels of its depth images in a metre; None: not stated, or there are none

    def __post_init__(self) -> None:
        fault = None if self.T_cam0_imu is None else rigid_fault(self.T_cam0_imu)
        if fault is not None:
            raise CalibrationError(f"T_cam0_imu {fault}; it maps the IMU's coordinates to the camera's")
        if self.depth_factor is not None and not self.depth_factor > 0:
            raise CalibrationError(f"the depth factor is {self.depth_factor:g}; give levels per metre, such as 1000")

    def undistorter(self, interpolation: Interpolation = "linear", *, depth_noise: float | None = None) -> Undistorter:
        """Return what takes the lens's distortion out of images; the camera keeps its direction.

        Args:
            interpolation: how gray values between pixels are found.
            depth_noise: `k` of a depth's standard deviation `k depth^2`, 1/m; None: there are no depth images.
        """
        c = self.cam0
        camera, maps = one_camera(c.fu, c.fv, c.cu, c.cv, c.width, c.height), None
        if c.model != "pinhole":
            camera, maps = undistorted(c)
        if depth_noise is not None:
            camera = with_virtual_baseline(camera, depth_noise)
        T = np.eye(4) if self.T_cam0_imu is None else self.T_cam0_imu
        return Undistorter(camera, T, maps, interpolation)


@dataclass(frozen=True, slots=True)
class Undistorter:
    """The undistortion of one camera's images."""

    camera: StereoCamera  # of the undistorted images, of kind "mono" or "rgbd"
    T_rect0_imu: FloatArray  # (4, 4); the identity without an IMU
    maps: tuple[MapArray, MapArray] | None  # None: nothing to do
    interpolation: Interpolation

    def __call__(self, image: Image) -> Image:
        """Undistort an image (H, W)."""
        return image if self.maps is None else remap(image, self.maps, self.interpolation)

    def depth(self, depth_m: FloatArray) -> FloatArray:
        """Undistort a depth image (H, W) in metres: each pixel takes the nearest depth, as means cross outlines."""
        if self.maps is None:
            return depth_m
        u, v = (np.rint(m).astype(np.int64) for m in self.maps)
        inside = (u >= 0) & (v >= 0) & (u < depth_m.shape[1]) & (v < depth_m.shape[0])
        out: FloatArray = np.where(inside, depth_m[np.where(inside, v, 0), np.where(inside, u, 0)], 0.0)
        return out


def with_virtual_baseline(camera: StereoCamera, depth_noise: float) -> StereoCamera:
    """Return a camera with depth images as a pair whose disparities are as uncertain as the depths.

    A depth's standard deviation `k z^2` makes one of `fu b k` of the disparity `fu b / z`, at every depth. The baseline
    b is chosen so that it is that of a stereo match, of which each pixel has the noise of a tracked feature.
    Reference: Khoshelham & Elberink, Accuracy and resolution of Kinect depth data, Sensors (2012), for `k z^2`.

    Args:
        camera: undistorted.
        depth_noise: k, 1/m; 0.0012 to 0.0019 for structured light.
    """
    baseline_m = _DISPARITY_SIGMAS * _PIXEL_SIGMA_PX / (camera.fu * depth_noise)
    return StereoCamera(
        camera.fu, camera.fv, camera.cu, camera.cv, baseline_m, camera.width, camera.height, kind="rgbd"
    )
