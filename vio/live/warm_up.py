"""Two seconds of images made up, so that everything is compiled, loaded and allocated before the first real frame."""

from __future__ import annotations

import contextlib
import logging
import threading
from collections.abc import Iterator

import numpy as np

from vio.config import Config
from vio.errors import DataError
from vio.geometry.lie import FloatArray
from vio.geometry.stereo import StereoCamera
from vio.live.odometry import Odometry
from vio.records import Image

_FRAMES, _STEP_NS, _SAMPLES = 40, 50_000_000, 10  # samples a frame
_FAR_PX, _NEAR_PX = 12.0, 24.0  # disparities of the upper and the lower half of the images
_SWAY_PX, _SWAY_S = 60.0, 2.0  # of the near half, and its period
_SMOOTH_PX = 1.5


def warm_up(camera: StereoCamera, T_cam0_imu: FloatArray | None, config: Config) -> None:
    """Run an odometry of its own over a camera that sways sideways in front of two walls.

    Args:
        camera: rectified, with its image size.
        T_cam0_imu: (4, 4); None: no IMU.
        config: every setting.

    Raises:
        DataError: the camera has no image size.
    """
    if camera.width is None or camera.height is None:
        raise DataError("warm_up needs the size of the images; give StereoCamera its width and height")
    with _without_warnings():
        odometry = Odometry(camera, config, T_cam0_imu=T_cam0_imu)
        sway(odometry, config)
        if odometry.estimate is not None:
            odometry.landmarks()


def sway(odometry: Odometry, config: Config) -> None:
    """Give an odometry the images and motion samples of two seconds."""
    walls = _Walls(odometry.camera)
    R_imu_cam = odometry.T_cam0_body[:3, :3].T
    for frame in range(_FRAMES):
        for k in range(1, _SAMPLES + 1):
            time_ns = _STEP_NS * (frame - 1) + _STEP_NS * k // _SAMPLES
            _, speed, acceleration = walls.motion(time_ns * 1e-9)
            if odometry.motion == "imu":
                # The camera looks at the horizon.
                force = np.array([acceleration, -config.msckf.gravity_mps2, 0.0])
                odometry.add_imu(time_ns, np.zeros(3), R_imu_cam @ force)
            elif odometry.motion == "velocity":
                odometry.add_velocity(time_ns, R_imu_cam @ [speed, 0.0, 0.0], np.zeros(3))
        _add_frame(odometry, walls, frame)
    odometry.finish()


def _add_frame(odometry: Odometry, walls: _Walls, frame: int) -> None:
    time_ns, camera = _STEP_NS * frame, odometry.camera
    x, *_ = walls.motion(time_ns * 1e-9)
    left = walls.image(x)
    if camera.kind == "stereo":
        odometry.add_stereo(time_ns, left, walls.image(x + camera.baseline_m))
    else:
        odometry.add_images(time_ns, left, depth_m=walls.depth_m if camera.kind == "rgbd" else None)


class _Walls:
    """Two walls of random texture across the optical axis, the lower one at half of the distance."""

    def __init__(self, camera: StereoCamera) -> None:
        import cv2

        assert camera.width is not None
        assert camera.height is not None
        self._size = camera.width, camera.height
        rows = camera.height // 2
        # A single camera's baseline is 1 m or made up: its walls are at some metres.
        far_m = camera.fu * camera.baseline_m / _FAR_PX if camera.kind == "stereo" else 4.0
        self._px_per_m = np.array([1.0, 2.0]) * camera.fu / far_m
        self._sway_m = _SWAY_PX / self._px_per_m[1]
        self.depth_m: FloatArray = np.full((camera.height, camera.width), far_m)
        self.depth_m[rows:] /= 2.0
        noise = np.random.default_rng(0).normal(size=(camera.height, camera.width + 4 * int(_SWAY_PX + _NEAR_PX)))
        smooth = cv2.GaussianBlur(noise, (0, 0), _SMOOTH_PX)
        self._texture = np.clip(128.0 + 40.0 * smooth / smooth.std(), 0, 255).astype(np.uint8)
        self._rows = slice(0, rows), slice(rows, camera.height)

    def motion(self, time_s: float) -> tuple[float, float, float]:
        """Return position, speed and acceleration along the camera's x axis, m and s; at rest before time 0."""
        if time_s < 0:
            return 0.0, 0.0, 0.0
        rate = 2.0 * np.pi / _SWAY_S
        phase, a = rate * time_s, 0.5 * self._sway_m
        return a * (1 - np.cos(phase)), a * rate * np.sin(phase), a * rate**2 * np.cos(phase)

    def image(self, x_m: float) -> Image:
        """Return the image (H, W) of a camera at a position along x."""
        import cv2

        out = np.empty(self._size[::-1], dtype=np.uint8)
        for rows, px_per_m in zip(self._rows, self._px_per_m.tolist(), strict=True):
            shift = np.array([[1.0, 0.0, -(px_per_m * x_m + _NEAR_PX)], [0.0, 1.0, 0.0]])
            size = self._size[0], rows.stop - rows.start
            out[rows] = cv2.warpAffine(self._texture[rows], shift, size, flags=cv2.INTER_LINEAR)
        return out


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
