"""ROS CameraInfo, as messages of a bag or as YAML files of `camera_calibration` (a pair:
`left.yaml`, `right.yaml`).

`K` and `D` are those of the raw image, `R` rotates the camera to the rectified one,
`P = K' [I | t]` projects from the rectified left camera; `P[0, 3]` of the right camera is -focal
length times baseline.
Reference: the definition of sensor_msgs/CameraInfo.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from vio.cameras.rig import Rig, camera_from_matrix
from vio.datasets.common import image_size, naming
from vio.datasets.rigs.opencv import trimmed_coefficients
from vio.datasets.yaml_files import Entries, lens_model, matrix, numbers, read_yaml_file, section
from vio.errors import CalibrationError
from vio.geometry.distortion import CameraModel, DistortionModel
from vio.geometry.lie import FloatArray, checked_transform, se3_from_parts

_PAIRS = (
    ("left", "right"),
    ("LEFT", "RIGHT"),
    ("cam0", "cam1"),
    ("camera_0", "camera_1"),
    ("infra1", "infra2"),
)


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
    return "camera_matrix" in entries and (
        "projection_matrix" in entries or "image_width" in entries
    )


def pair_of_files(path: Path) -> tuple[Path, Path] | None:
    """Return the left and right file of a pair, given a folder or one of the two.

    None: there is no pair.
    """
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
    """Read the YAML file of one camera; that of a camera alone may lack the entries of a
    rectification.

    Raises:
        CalibrationError: an entry is missing or malformed.
    """
    entries = read_yaml_file(path, "the camera's calibration")
    where = str(path)
    size = [numbers(entries, key, where, 1)[0] for key in ("image_width", "image_height")]
    width, height = image_size(size, where)
    alone = "projection_matrix" not in entries
    wanted = (
        ("camera_matrix",)
        if alone
        else ("camera_matrix", "rectification_matrix", "projection_matrix")
    )
    found = {key: section(entries, key, where) for key in wanted}
    D = entries.get("distortion_coefficients", [] if alone else None)
    return CameraInfo(
        where,
        width,
        height,
        str(entries.get("distortion_model") or ""),
        tuple(np.ravel(matrix(D, None, f"{where}, distortion_coefficients")).tolist()),
        matrix(found["camera_matrix"], (3, 3), f"{where}, camera_matrix"),
        np.eye(3)
        if alone
        else matrix(found["rectification_matrix"], (3, 3), f"{where}, rectification_matrix"),
        np.zeros((3, 4))
        if alone
        else matrix(found["projection_matrix"], (3, 4), f"{where}, projection_matrix"),
    )


def rig_from_camera_infos(infos: Sequence[CameraInfo], *, rectified: bool = False) -> Rig:
    """Return the rig of the CameraInfo of one camera, or of those of a left and a right camera.

    Args:
        infos: one, or left and right.
        rectified: the images are those after ROS's rectification (`image_rect`), so that only P
            applies.

    Raises:
        CalibrationError: a camera is not calibrated (K or P of zeros; of one camera, the one that
            applies), its lens is not read, or the two are no stereo pair.
    """
    if len(infos) == 1:
        K, name = (infos[0].P[:, :3], "P") if rectified else (infos[0].K, "K")
        if not K[0, 0] > 0:
            raise CalibrationError(
                f"{infos[0].where}: not calibrated ({name} is zero); give a calibration file"
            )
        return Rig(_camera(infos[0], rectified=rectified))
    for info in infos:
        if not (info.K[0, 0] > 0 and info.P[0, 0] > 0):
            raise CalibrationError(
                f"{info.where}: not calibrated (K or P is zero); give a calibration file"
            )
    left, right = infos
    offsets = [np.linalg.solve(info.P[:, :3], info.P[:, 3]) for info in infos]
    shift = offsets[1] - offsets[0]  # rectified left to rectified right
    if not shift[0] < 0:
        raise CalibrationError(
            f"{right.where}: P gives a stereo baseline of {-shift[0]:g} m, not a positive one "
            "(P[0, 3] of the right "
            "camera is -focal * baseline); the cameras are swapped, or were not calibrated as a "
            "pair"
        )
    if rectified:
        cam = _camera(left, rectified=True)
        with naming(left.where):
            return Rig.rectified(
                cam.fu, cam.fv, cam.cu, cam.cv, float(-shift[0]), cam.width, cam.height
            )
    R0, R1 = (
        checked_transform(np.column_stack([i.R, np.zeros(3)]), f"{i.where}, R")[:3, :3]
        for i in infos
    )
    cam0, cam1 = (_camera(info, rectified=False) for info in infos)
    return Rig(cam0, cam1, se3_from_parts(R1.T @ R0, R1.T @ shift))


def _camera(info: CameraInfo, *, rectified: bool) -> CameraModel:
    model, D = ("pinhole", ()) if rectified else _lens(info)
    K, name = (info.P[:, :3], "P") if rectified else (info.K, "K")
    with naming(info.where):
        return camera_from_matrix(K, info.width, info.height, model, D, name)


def _lens(info: CameraInfo) -> tuple[DistortionModel, tuple[float, ...]]:
    model = lens_model(info.model or "plumb_bob", info.where)
    if model == "pinhole" or not any(info.D):
        return "pinhole", ()
    if model == "equidistant":
        return model, info.D[:4]
    with naming(info.where):
        return model, trimmed_coefficients(info.D)
