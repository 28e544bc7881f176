"""ROS CameraInfo, as messages of a bag or as the two YAML files of `camera_calibration` (`left.yaml`, `right.yaml`).

`K` and `D` are those of the raw image, `R` rotates the camera to the rectified one, `P = K' [I | t]` projects from the
rectified left camera; `P[0, 3]` of the right camera is -focal length times baseline.
Reference: the definition of sensor_msgs/CameraInfo.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from vio.cameras.camera_rig import CameraRig
from vio.cameras.rig import Rig, camera_from_matrix
from vio.datasets.common import checked_transform, image_size, naming
from vio.datasets.rigs.opencv import CoefficientsError, trimmed_coefficients
from vio.datasets.yaml_files import Entries, matrix, numbers, read_yaml, section
from vio.errors import CalibrationError
from vio.geometry.distortion import DistortionModel
from vio.geometry.lie import FloatArray, se3_from_parts

_MODELS: dict[str, DistortionModel] = {
    "": "radtan",
    "none": "pinhole",
    "plumb_bob": "radtan",
    "radtan": "radtan",
    "rational_polynomial": "radtan",
    "equidistant": "equidistant",
    "fisheye": "equidistant",
}
_PAIRS = (("left", "right"), ("LEFT", "RIGHT"), ("cam0", "cam1"), ("camera_0", "camera_1"), ("infra1", "infra2"))


@dataclass(frozen=True, slots=True)
class CameraInfo:
    """One camera as ROS states it."""

    where: str  # file or topic, for messages
    width: int  # pixels
    height: int
    model: str  # ROS's name of the distortion
    D: tuple[float, ...]
    K: FloatArray  # (3, 3) raw
    R: FloatArray  # (3, 3) from the raw to the rectified camera
    P: FloatArray  # (3, 4) of the rectified image


def is_camera_info(entries: Entries) -> bool:
    """Return whether entries are those of a CameraInfo file."""
    return "camera_matrix" in entries and "projection_matrix" in entries


def pair_of_files(path: Path) -> tuple[Path, Path] | None:
    """Return the left and right file of a pair, given a folder or one of the two; None: there is no pair."""
    for left, right in _PAIRS:
        for suffix in (".yaml", ".yml"):
            if path.is_dir():
                found = (path / f"{left}{suffix}", path / f"{right}{suffix}")
            elif left in path.name:
                found = (path, path.with_name(path.name.replace(left, right)))
            elif right in path.name:
                found = (path.with_name(path.name.replace(right, left)), path)
            else:
                continue
            if all(file.is_file() for file in found):
                return found
    return None


def read_camera_info(path: Path) -> CameraInfo:
    """Read the YAML file of one camera.

    Raises:
        CalibrationError: an entry is missing or malformed.
    """
    entries, where = read_yaml(path, "the camera's calibration"), str(path)
    size = [numbers(entries, key, where, 1)[0] for key in ("image_width", "image_height")]
    width, height = image_size(size, where)
    found = {
        key: section(entries, key, where) for key in ("camera_matrix", "rectification_matrix", "projection_matrix")
    }
    return CameraInfo(
        where,
        width,
        height,
        str(entries.get("distortion_model") or ""),
        tuple(np.ravel(matrix(entries.get("distortion_coefficients"), None, f"{where}, distortion_coefficients"))),
        matrix(found["camera_matrix"], (3, 3), f"{where}, camera_matrix"),
        matrix(found["rectification_matrix"], (3, 3), f"{where}, rectification_matrix"),
        matrix(found["projection_matrix"], (3, 4), f"{where}, projection_matrix"),
    )


def rig_from_camera_infos(left: CameraInfo, right: CameraInfo, *, rectified: bool = False) -> Rig:
    """Return the rig of two CameraInfos.

    Args:
        left: left camera.
        right: right camera.
        rectified: the images are those after ROS's rectification (`image_rect`), so that only P applies.

    Raises:
        CalibrationError: a camera is not calibrated (K or P of zeros), or the two are no stereo pair.
    """
    for info in (left, right):
        if not (info.K[0, 0] > 0 and info.P[0, 0] > 0):
            raise CalibrationError(f"{info.where}: not calibrated (K or P is zero); give a calibration file")
    offsets = [np.linalg.solve(info.P[:, :3], info.P[:, 3]) for info in (left, right)]
    shift = offsets[1] - offsets[0]  # rectified left to rectified right
    if not shift[0] < 0:
        raise CalibrationError(
            f"{right.where}: P gives a stereo baseline of {-shift[0]:g} m, not a positive one (P[0, 3] of the right "
            "camera is -focal * baseline); the cameras are swapped, or were not calibrated as a pair"
        )
    if rectified:
        K, size = left.P[:, :3], (left.width, left.height)
        with naming(left.where):
            cam = camera_from_matrix(K, *size, name="P")
            return Rig.rectified(cam.fu, cam.fv, cam.cu, cam.cv, float(-shift[0]), *size)
    R0, R1 = (checked_transform(np.column_stack([i.R, np.zeros(3)]), f"{i.where}, R")[:3, :3] for i in (left, right))
    cameras = []
    for info in (left, right):
        model, D = _lens(info)
        with naming(info.where):
            cameras.append(camera_from_matrix(info.K, info.width, info.height, model, D))
    return Rig(cameras[0], cameras[1], se3_from_parts(R1.T @ R0, R1.T @ shift))


def rig_from_camera_info(info: CameraInfo, *, rectified: bool = False) -> CameraRig:
    """Return the rig of the CameraInfo of one camera.

    Args:
        info: the camera.
        rectified: the images are those after ROS's rectification (`image_rect`), so that only P applies.

    Raises:
        CalibrationError: the camera is not calibrated (K, or P of rectified images, is zero), or its lens is not read.
    """
    K, name = (info.P[:, :3], "P") if rectified else (info.K, "K")
    if not K[0, 0] > 0:
        raise CalibrationError(f"{info.where}: not calibrated ({name} is zero); give a calibration file")
    model, D = ("pinhole", ()) if rectified else _lens(info)
    with naming(info.where):
        return CameraRig(camera_from_matrix(K, info.width, info.height, model, D, name))


def _lens(info: CameraInfo) -> tuple[DistortionModel, tuple[float, ...]]:
    if info.model not in _MODELS:
        raise CalibrationError(
            f"{info.where}: distortion_model {info.model!r} is not read; known: {', '.join(_MODELS)[2:]}"
        )
    model = _MODELS[info.model]
    if model == "pinhole" or not any(info.D):
        return "pinhole", ()
    if model == "equidistant":
        return model, info.D[:4]
    try:
        return model, trimmed_coefficients(info.D)
    except CoefficientsError as error:
        raise CalibrationError(f"{info.where}: {error}") from error
