"""Two seconds of images made up, so that everything is compiled, loaded and allocated before the
first real frame.
"""

from __future__ import annotations

import contextlib
import logging
import threading
from collections.abc import Iterator
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from vio.config import Config
from vio.errors import DataError
from vio.geometry.lie import FloatArray
from vio.geometry.stereo import StereoCamera
from vio.live.odometry import Odometry
from vio.numerics.kinds import Capacity
from vio.records import Image


class _MadeUpRun(NamedTuple):
    """The images and samples that are made up."""

    frames: Capacity[int] = 40  # samples a frame
    samples_per_frame: Capacity[int] = 10
    far_px: Capacity[float] = 12.0  # disparities of the upper and the lower half of the images
    near_px: Capacity[float] = 24.0
    sway_px: Capacity[float] = 60.0  # of the near half, and its period
    sway_s: Capacity[float] = 2.0
    smooth_px: Capacity[float] = 1.5


_RUN = _MadeUpRun()
STEP_NS: Capacity[int] = 50_000_000  # from frame to frame


def warm_up(
    camera: StereoCamera, T_cam0_imu: FloatArray | None, config: Config, *, with_map: bool
) -> None:
    """Run an odometry of its own over a camera that sways sideways in front of two walls.

    `T_cam0_imu` is (4, 4), None without an IMU; `with_map` extracts features of keyframes, too.

    Raises:
        DataError: the camera has no image size.
    """
    if camera.width is None or camera.height is None:
        raise DataError(
            "warm_up needs the size of the images; give StereoCamera its width and height"
        )
    with _without_warnings():
        for made in _configs(config):
            odometry = Odometry(camera, made, T_cam0_imu=T_cam0_imu)
            sway(odometry, made)
            if odometry.estimate is not None:
                odometry.landmarks()
    if with_map:
        from vio.mapping.features import extract

        left, right, _ = SwayingCamera(
            camera, odometry.T_cam0_body, config.imu.gravity_mps2
        ).images(0)
        assert right is not None  # of other cameras there is no map
        extract(left, right)


def _configs(config: Config) -> list[Config]:
    """Return the configuration, and one with which landmarks begin at once, not when the
    rectification is known.
    """
    at_once = replace(config, msckf=replace(config.msckf, calibrate_stereo="off"))
    return [config] if at_once == config else [config, at_once]


def sway(odometry: Odometry, config: Config) -> None:
    """Give an odometry the images and motion samples of two seconds."""
    source = SwayingCamera(odometry.camera, odometry.T_cam0_body, config.imu.gravity_mps2)
    for frame in range(_RUN.frames):
        time_ns = frame * STEP_NS
        source.add_samples(odometry, time_ns)
        left, right, depth_m = source.images(time_ns)
        odometry.add_images(time_ns, left, right, depth_m=depth_m)
    odometry.finish()


class SwayingCamera:
    """A camera that sways sideways, without an end, in front of two walls of random texture across
    its optical axis.

    The lower wall is at half of the upper one's distance. Images, IMU and velocities agree.
    """

    def __init__(self, camera: StereoCamera, T_cam0_body: FloatArray, gravity_mps2: float) -> None:
        """Make the walls of a rectified camera, which has an image size and looks at the
        horizon; extrinsics (4, 4).
        """
        import cv2

        assert camera.width is not None
        assert camera.height is not None
        self._camera = camera
        self._R_body_cam = T_cam0_body[:3, :3].T
        self._gravity_mps2 = gravity_mps2
        self._size = camera.width, camera.height
        rows = camera.height // 2
        # A single camera's baseline is 1 m or made up: its walls are at some metres.
        far_m = 4.0
        if camera.kind == "stereo":
            far_m = camera.fu * camera.baseline_m / _RUN.far_px
        self._px_per_m = np.array([1.0, 2.0]) * camera.fu / far_m
        self._sway_m = _RUN.sway_px / self._px_per_m[1]
        self._depth_m: FloatArray = np.full((camera.height, camera.width), far_m)
        self._depth_m[rows:] /= 2.0
        noise = np.random.default_rng(0).normal(
            size=(camera.height, camera.width + 4 * int(_RUN.sway_px + _RUN.near_px))
        )
        smooth = cv2.GaussianBlur(noise, (0, 0), _RUN.smooth_px)
        self._texture = np.clip(128.0 + 40.0 * smooth / smooth.std(), 0, 255).astype(np.uint8)
        self._rows = slice(0, rows), slice(rows, camera.height)

    def add_samples(self, odometry: Odometry, time_ns: int) -> None:
        """Give an odometry the motion samples of the time since the frame before."""
        for k in range(1 - _RUN.samples_per_frame, 1):
            sample_ns = time_ns + k * STEP_NS // _RUN.samples_per_frame
            if odometry.motion == "imu":
                odometry.add_imu(sample_ns, *self.imu(sample_ns))
            elif odometry.motion == "velocity":
                odometry.add_velocity(sample_ns, *self.velocity(sample_ns))

    def imu(self, time_ns: int) -> tuple[FloatArray, FloatArray]:
        """Return angular rate (3,) rad/s and specific force (3,) m/s^2."""
        *_, acceleration = self.motion(time_ns * 1e-9)
        return np.zeros(3), self._R_body_cam @ np.array([acceleration, -self._gravity_mps2, 0.0])

    def velocity(self, time_ns: int) -> tuple[FloatArray, FloatArray]:
        """Return linear (3,) m/s and angular velocity (3,) rad/s of the body."""
        _, speed, _ = self.motion(time_ns * 1e-9)
        return self._R_body_cam @ np.array([speed, 0.0, 0.0]), np.zeros(3)

    def images(self, time_ns: int) -> tuple[Image, Image | None, FloatArray | None]:
        """Return the left image (H, W), the right one of a pair, and the depths (H, W) where the
        camera has them.
        """
        x, *_ = self.motion(time_ns * 1e-9)
        # without noise, what it sways back to would be the same exposure again
        rng = np.random.default_rng(abs(time_ns))
        right = None
        if self._camera.kind == "stereo":
            right = _with_noise(self._image(x + self._camera.baseline_m), rng)
        return (
            _with_noise(self._image(x), rng),
            right,
            self._depth_m if self._camera.kind == "rgbd" else None,
        )

    def motion(self, time_s: float) -> tuple[float, float, float]:
        """Return position, speed and acceleration along the camera's x axis, m and s; at rest
        before time 0.
        """
        if time_s < 0:
            return 0.0, 0.0, 0.0
        rate = 2.0 * np.pi / _RUN.sway_s
        phase = rate * time_s
        a = 0.5 * self._sway_m
        position = a * (1 - np.cos(phase))
        velocity = a * rate * np.sin(phase)
        acceleration = a * rate**2 * np.cos(phase)
        return position, velocity, acceleration

    def _image(self, x_m: float) -> Image:
        """Return the image (H, W) of a camera at a position along x."""
        import cv2

        out = np.empty(self._size[::-1], dtype=np.uint8)
        for rows, px_per_m in zip(self._rows, self._px_per_m.tolist(), strict=True):
            shift = np.array(
                [
                    [1.0, 0.0, -(px_per_m * x_m + _RUN.near_px)],
                    [0.0, 1.0, 0.0],
                ]
            )
            size = self._size[0], rows.stop - rows.start
            out[rows] = cv2.warpAffine(self._texture[rows], shift, size, flags=cv2.INTER_LINEAR)
        return out


def _with_noise(image: Image, rng: np.random.Generator) -> Image:
    """Return an image (H, W) with noise of a gray level."""
    import cv2

    return np.asarray(cv2.add(image, rng.integers(0, 3, image.shape, dtype=np.uint8)), np.uint8)


@contextlib.contextmanager
def _without_warnings() -> Iterator[None]:
    """Keep what the checks find in made-up images of this thread out of the log."""
    thread = threading.get_ident()

    def passes(record: logging.LogRecord) -> bool:
        return record.thread != thread

    loggers = [logging.getLogger(name) for name in ("vio.monitor.run", "vio.live.odometry")]
    for logger in loggers:
        logger.addFilter(passes)
    try:
        yield
    finally:
        for logger in loggers:
            logger.removeFilter(passes)
