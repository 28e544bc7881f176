"""KITTI odometry's `calib.txt` as a rig."""

from __future__ import annotations

from pathlib import Path

from vio.cameras.rig import Rig
from vio.datasets.common import naming
from vio.datasets.kitti import read_calibration, read_extrinsics
from vio.datasets.rigs.plausible import checked_rig
from vio.datasets.rigs.source import Size, no_image_size
from vio.files.text import text_lines
from vio.geometry.lie import FloatArray

# by which KITTI's right camera may be off the left one's x axis before it is noted
_OFF_AXIS_NOTE_M = 1e-3


def kitti_rig(
    path: Path, image_size: Size | None, cameras: tuple[int, int] | None = None
) -> tuple[Rig, FloatArray]:
    """Return KITTI's `calib.txt`, with `T_cam0_imu.txt` beside it, and `T_left_cam0` (4, 4) from
    KITTI's camera 0.

    Args:
        path: the file.
        image_size: width and height of the images, pixels.
        cameras: numbers of the left and the right one; None: the gray pair, else that in colour.

    Raises:
        CalibrationError: a file is invalid, or no image size is given.
    """
    if cameras is None:
        if any(line.startswith("P0:") for _, line in text_lines(path)):
            cameras = (0, 1)
        else:
            cameras = (2, 3)
    calibration = read_calibration(path, cameras)
    if image_size is None:
        raise no_image_size(path)
    c = calibration.camera
    T_cam0_imu = read_extrinsics(path.with_name("T_cam0_imu.txt"))
    T_left_imu = None if T_cam0_imu is None else calibration.T_left_cam0 @ T_cam0_imu
    with naming(path):
        rig = Rig.rectified(
            c.fu, c.fv, c.cu, c.cv, c.baseline_m, *image_size, T_cam0_imu=T_left_imu
        )
    if calibration.off_axis_m > _OFF_AXIS_NOTE_M:
        off_axis = (
            f"is {1e3 * calibration.off_axis_m:.1f} mm off the x axis of that of image_{cameras[0]}"
        )
        note = (
            f"the camera of image_{cameras[1]} {off_axis}; the pair is treated as rectified anyway"
        )
        rig = rig.noting(note)
    return checked_rig(rig, path, size_stated=False), calibration.T_left_cam0
