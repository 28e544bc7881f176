"""What a calibration file does not state, and what its own numbers say of it.

A size or a unit that the file states is believed. Where it states none, a calibration that fits
another reading better is doubted: a note names both readings. What no reading makes sense of is an
error.
"""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np

from vio.cameras.rig import Rig
from vio.errors import CalibrationError
from vio.geometry.distortion import CameraModel
from vio.geometry.lie import FloatArray


class _ImageSizeRules(NamedTuple):
    """When a calibration is of images of another size."""

    # Ratio of twice the principal point to the image size, along both axes in one direction, beyond
    # which the images are of another size. One axis may be off by a tenth (KITTI's raw images). Of
    # twelve cameras with a recording none is off by more than 0.02 along both in one direction, but
    # of fourteen others in public reports four are, by 0.027 to 0.039: so between the two it is a
    # note and no doubt. A smaller scaling shows in the turns against a gyro
    # (`vio.monitor.rotation_comparison`).
    scaled_ratio: float = 1.05
    # Ratio of the two focal lengths beyond which images were stretched
    stretched_ratio: float = 1.1
    # Likewise along one axis, as of images that were cropped
    cropped_ratio: float = 1.3
    # tangent of half the field of view that no planar lens exceeds (170 degrees)
    max_half_view_tangent: float = 11.43


_IMAGE_SIZE = _ImageSizeRules()
_NOTED = 1.02
FAR_IMU_M = 10.0  # an IMU further from its camera is no length in metres
# Likewise beside a short baseline: on cars, 2.5 m and 21 baselines (a camera of 0.12 m, an IMU at the
# rear axle); a hand-held rig's lever arm in centimetres reads as 3 m and more.
_FAR_BESIDE_M = 3.0
_FAR_BASELINES = 40.0
# A board's square is 0.02 to 0.1 m and a rig's baseline 0.05 to 0.6 m, so that in squares a
# baseline is seldom below 1, and in metres seldom above.
_SQUARES_M = 1.0
_ROUNDED = 1e-5  # elements of a projection that are zero, in focal lengths


def check_projection(P: FloatArray, turned: FloatArray, where: str) -> None:
    """Refuse a projection that is no K' [I | t], so that P[0, 3] is no focal length times baseline.

    ROS's camera_calibration writes K R in the place of K' for pairs of fisheye cameras; the focal
    length that P[0, 3] was multiplied by is lost (findings/ros_fisheye_baseline.sh).

    Args:
        P: (3, 4), of a rectified image.
        turned: K R (3, 3) of the raw camera.
        where: the matrix, for messages.

    Raises:
        CalibrationError: it is none.
    """
    K = P[:, :3]
    # of single precision, or printed with few digits: a share of the baseline
    if np.allclose(K[[1, 2, 2, 2], [0, 0, 1, 2]] / [K[0, 0], 1, 1, 1], [0, 0, 0, 1], atol=_ROUNDED):
        return
    held = "a matrix that is none of a camera"
    if np.allclose(K, turned, rtol=1e-4, atol=1e-2):
        held = "K R, which camera_calibration writes for fisheye cameras,"
    raise CalibrationError(
        f"{where} holds {held} in the place of the rectified image's matrix, so its last column "
        "tells no baseline; give a calibration with the pair's R and T with --calibration FILE"
    )


def checked_rig(rig: Rig, where: Path | str, *, size_stated: bool = True) -> Rig:
    """Return a rig with a note where its calibration fits images of another size better.

    Args:
        rig: as read.
        where: the file or topic, for messages.
        size_stated: whether it states the size of its images, which is then believed, unless no
            camera has such a principal point.

    Raises:
        CalibrationError: a principal point lies outside the images.
    """
    for camera in rig.cameras:
        check_camera(camera, where)
    rig = noting_imu_place(rig, where)
    doubts: list[str | None] = []
    if not size_stated:
        doubts += [_size_doubt(rig.cam0, where), _aspect_doubt(rig.cam0, where)]
    else:
        doubts.append(_other_camera_doubt(rig.cam0, where))
    for doubt in doubts:
        rig = rig if doubt is None else rig.noting(doubt)
    return rig


def _check_focal_length(camera: CameraModel, where: Path | str) -> None:
    """Raise CalibrationError where a planar lens would see more than any does."""
    if not camera.lens.planar or camera.fu * _IMAGE_SIZE.max_half_view_tangent > camera.width / 2:
        return
    angle = np.degrees(2 * np.arctan2(camera.width / 2, camera.fu))
    raise CalibrationError(
        f"{where}: a focal length of {camera.fu:g} pixels makes a field of view of {angle:.0f} "
        f"degrees of images {camera.width} pixels wide; focal lengths and principal points must be "
        "pixels, not millimetres or shares of the width"
    )


def noting_imu_place(rig: Rig, where: Path | str) -> Rig:
    """Return a rig with a note where its IMU is farther from the camera than on any rig.

    `where`: the file that states its pose.
    """
    doubt = _distance_doubt(rig, where)
    return rig if doubt is None else rig.noting(doubt)


def _distance_doubt(rig: Rig, where: Path | str) -> str | None:
    """Return the doubt about an IMU that is farther from the camera than on any rig."""
    if rig.T_cam0_imu is None:
        return None
    distance_m = float(np.linalg.norm(rig.T_cam0_imu[:3, 3]))
    seen = (
        f"{where}: doubtful: the IMU is {distance_m:.4g} m from the left camera, if the unit is the "
        "metre; if it is the"
    )
    if distance_m > FAR_IMU_M:
        return (
            f"{seen} millimetre, it is {distance_m / 1000:.4g} m: divide the translation of its pose "
            "by 1000"
        )
    if rig.cam1 is None or distance_m <= _FAR_BESIDE_M:
        return None
    baseline_m = float(np.linalg.norm(rig.right[1][:3, 3]))
    if distance_m <= _FAR_BASELINES * baseline_m:
        return None
    return (
        f"{seen} centimetre, it is {distance_m / 100:.4g} m: divide the translation of its pose by "
        f"100 (the cameras are {baseline_m:.3g} m apart)"
    )


def _aspect_doubt(camera: CameraModel, where: Path | str) -> str | None:
    """Return the doubt about focal lengths that differ, as where fx cx fy cy are written for fx fy
    cx cy.
    """
    ratio = camera.fu / camera.fv
    if 1 / _IMAGE_SIZE.stretched_ratio <= ratio <= _IMAGE_SIZE.stretched_ratio:
        return None
    return (
        f"{where}: doubtful: its focal lengths {camera.fu:g} and {camera.fv:g} pixels differ, as of "
        "images that were stretched; if they were not, check the order of its numbers: fx fy cx cy"
    )


def check_camera(camera: CameraModel, where: Path | str) -> None:
    """Raise CalibrationError where the focal length of a camera is no number of pixels, or its
    principal point is outside its images.
    """
    _check_focal_length(camera, where)
    if 0 < camera.cu < camera.width and 0 < camera.cv < camera.height:
        return
    raise CalibrationError(
        f"{where}: the principal point {camera.cu:.0f}, {camera.cv:.0f} lies outside images of "
        f"{camera.width} x {camera.height} pixels; it is the calibration of images of another "
        "size: scale it, or calibrate with these"
    )


def _size_note(ratios: FloatArray, camera: CameraModel, where: Path | str) -> str | None:
    """Return what a principal point says that may be that of a camera or of images of another size;
    None: it is near the middle.

    Args:
        ratios: (2,) of twice the principal point to the size of the images.
        camera: as read.
        where: its file.
    """
    little = _NOTED < ratios.min() <= ratios.max() < _IMAGE_SIZE.stretched_ratio
    if not (little or 1 / _IMAGE_SIZE.stretched_ratio < ratios.min() <= ratios.max() < 1 / _NOTED):
        return None
    size = np.round(np.array([camera.width, camera.height]) * ratios.mean()).astype(int)
    return (
        f"{where}: it states no image size, and its principal point is {100 * (ratios.mean() - 1):+.1f} "
        "% off the middle of these images, as some cameras' are; if it was calibrated with images of "
        f"about {size[0]} x {size[1]} pixels, lengths are off by as much"
    )


def _size_doubt(camera: CameraModel, where: Path | str) -> str | None:
    """Return the doubt about a size that is not stated, or a note; None: the principal point is near
    its middle.
    """
    ratios = np.array([2 * camera.cu / camera.width, 2 * camera.cv / camera.height])
    scaled = ratios.min() > _IMAGE_SIZE.scaled_ratio or ratios.max() < 1 / _IMAGE_SIZE.scaled_ratio
    cropped = (
        ratios.max() > _IMAGE_SIZE.cropped_ratio or ratios.min() < 2 - _IMAGE_SIZE.cropped_ratio
    )
    if not (scaled or cropped):
        return _size_note(ratios, camera, where)
    remedy = (
        f"if they were scaled, divide its focal lengths and principal points by {_factors(ratios)}, "
        "or all depths are off by this factor"
        if scaled
        else "if they were cropped, subtract what was cut from its principal points, or directions "
        "are off"
    )
    if scaled and not camera.coefficients and not _is_even(ratios):
        remedy += (
            "; if it is that of rectified images and these are raw ones, of another size and form, "
            "give theirs, with the distortion"
        )
    return (
        f"{where}: doubtful: it states no image size, and its principal point {camera.cu:.0f}, "
        f"{camera.cv:.0f} is the middle of images of about {2 * camera.cu:.0f} x "
        f"{2 * camera.cv:.0f} pixels, not of {camera.width} x {camera.height}; it is read as that "
        f"of these images; {remedy}"
    )


def _other_camera_doubt(camera: CameraModel, where: Path | str) -> str | None:
    """Return the doubt about intrinsics that were kept where the size was changed; None: the
    principal point is near the middle of the stated images along one axis at least.
    """
    ratios = np.array([2 * camera.cu / camera.width, 2 * camera.cv / camera.height])
    if 1 / _IMAGE_SIZE.cropped_ratio <= ratios.max() and ratios.min() <= _IMAGE_SIZE.cropped_ratio:
        return None
    return (
        f"{where}: doubtful: it states images of {camera.width} x {camera.height} pixels, and its "
        f"principal point {camera.cu:.0f}, {camera.cv:.0f} is the middle of images of about "
        f"{2 * camera.cu:.0f} x {2 * camera.cv:.0f}; it is read as stated; if its size alone was "
        "changed, scale focal lengths and principal points with it, or all lengths are off"
    )


def _is_even(ratios: FloatArray) -> bool:
    """Tell whether one factor explains the ratios (2,) of both axes."""
    return bool(ratios.max() <= _IMAGE_SIZE.scaled_ratio * ratios.min())


def _factors(ratios: FloatArray) -> str:
    """Return the factor of both axes, or one for each where they differ, as of stretched images."""
    if _is_even(ratios):
        return f"{ratios.mean():.3g}"
    return f"{ratios[0]:.3g} along x and {ratios[1]:.3g} along y"


def baseline_doubt(baseline: float, where: Path | str) -> str | None:
    """Return the doubt about a baseline whose unit a file does not state.

    Args:
        baseline: as the file has it.
        where: the file.
    """
    if baseline <= _SQUARES_M:
        return None
    return (
        f"{where}: doubtful: the baseline is {baseline:g} m, if its unit is the metre; if it is the "
        "millimetre, name it baseline_mm, or all lengths of the run will be in that unit"
    )


def unit_doubt(baseline: float, where: Path | str) -> str | None:
    """Return the doubt about a stereo translation whose unit OpenCV's files do not state.

    OpenCV's sample `stereo_calib.cpp` writes T in squares of the board, as its `squareSize` is 1
    by default; other scripts in millimetres, centimetres or inches.

    Args:
        baseline: length of T, as the file has it.
        where: the file.
    """
    if baseline <= _SQUARES_M:
        return None
    return (
        f"{where}: doubtful: T puts the cameras {baseline:g} m apart, if its unit is the metre; "
        "where the board was measured in millimetres, T is too: divide it by 1000; where it was "
        "not measured, T is in squares of the board, as OpenCV's sample writes it: multiply it by "
        f"the side of a square, which makes {0.025 * baseline:.3g} m of squares of 25 mm; or all "
        "lengths of the run will be in that unit"
    )
