"""EDEX, the scene file of NVIDIA's cuVSLAM: a JSON list whose first item has the cameras.

`transform`, 3 x 4, maps coordinates of a camera to the rig, both with y up and z backwards as in
OpenGL; metres. Lens models: `pinhole`, `fisheye` (k1 to k4 of OpenCV), `brown` (k1 k2 k3 p1 p2) and
`polynomial` (OpenCV's k1 k2 p1 p2 k3 k4 k5 k6); `fisheye4` is another name of `fisheye`. The IMU's pose is not read.
Reference: cuVSLAM's documentation, EDEX File Format and Distortion Models.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from vio.cameras.rig import Rig
from vio.datasets.common import image_size, naming
from vio.datasets.rigs.plausible import checked_rig
from vio.datasets.rigs.source import Source, first_cameras, rig_of_poses
from vio.datasets.yaml_files import Entries, matrix, numbers, section
from vio.errors import CalibrationError
from vio.geometry.distortion import CameraModel, DistortionModel, simplest_lens
from vio.geometry.lie import FloatArray, checked_transform, se3_from_parts

SUFFIX = ".edex"
# model, and the places of its coefficients in the file
_LENSES: dict[str, tuple[DistortionModel, tuple[int, ...]]] = {
    "pinhole": ("pinhole", ()),
    "fisheye": ("equidistant", (0, 1, 2, 3)),
    "fisheye4": ("equidistant", (0, 1, 2, 3)),
    "equidistant": ("equidistant", (0, 1, 2, 3)),
    "brown": ("radtan", (0, 1, 3, 4, 2)),
    "brown5k": ("radtan", (0, 1, 3, 4, 2)),
    "polynomial": ("radtan", (0, 1, 2, 3, 4, 5, 6, 7)),
}
_FLIP = np.diag([1.0, -1.0, -1.0])  # OpenGL's axes to those of images


def matches(entries: Entries) -> bool:
    """Return whether entries are those of a scene's cameras."""
    cameras = entries.get("cameras")
    return isinstance(cameras, list) and any(
        isinstance(item, dict)
        and isinstance(item.get("intrinsics"), dict)
        and "principal" in item["intrinsics"]
        for item in cameras
    )


def read(source: Source) -> Rig:
    """Read the first two cameras, or the only one.

    Raises:
        CalibrationError: an entry is missing or impossible, or a lens model is not read.
    """
    where = source.where
    items: list[Any] = source.entries["cameras"]  # type: ignore[assignment]
    read_items = first_cameras(items, where)
    cameras = [_camera(item, f"{where}, camera {k}") for k, item in enumerate(read_items)]
    poses = [_pose(item, f"{where}, camera {k}") for k, item in enumerate(read_items)]
    rig = rig_of_poses(cameras, poses, where, count=len(items))
    if "imu" in source.entries:
        rig = rig.noting(
            f"{where}: the pose of its IMU is not read; give T_cam0_imu.txt to use the IMU"
        )
    return checked_rig(rig, where)


def _camera(item: Mapping[str, Any], where: str) -> CameraModel:
    lens = section(item, "intrinsics", where)
    name = str(lens.get("distortion_model", "pinhole")).lower()
    if name not in _LENSES:
        raise CalibrationError(
            f"{where}: the lens model {name!r} is not read; known: {', '.join(_LENSES)}"
        )
    model, places = _LENSES[name]
    stated = lens.get("distortion_params") or []
    given = numbers({"distortion_params": stated}, "distortion_params", where)
    if not places and any(given):
        raise CalibrationError(
            f"{where}: states distortion_params, which a pinhole does not have; name the "
            "distortion_model they are of"
        )
    if len(given) < len(places):
        raise CalibrationError(
            f"{where}: {name} has {len(places)} distortion_params, not {len(given)}"
        )
    model, bend = simplest_lens(model, tuple(given[k] for k in places))
    fu, fv = numbers(lens, "focal", where, 2)
    cu, cv = numbers(lens, "principal", where, 2)
    width, height = image_size(list(numbers(lens, "size", where, 2)), f"{where}, size")
    with naming(where):
        return CameraModel(fu, fv, cu, cv, width, height, model, bend)


def _pose(item: Mapping[str, Any], where: str) -> FloatArray:
    """Return the transform (4, 4) from a camera to the rig, both in the axes of images."""
    values = matrix(item.get("transform"), None, f"{where}, transform").ravel()
    if len(values) not in (12, 16):
        raise CalibrationError(f"{where}, transform: has {len(values)} numbers instead of 12")
    T = values[:12].reshape(3, 4)
    turned = se3_from_parts(_FLIP @ T[:, :3] @ _FLIP, _FLIP @ T[:, 3])
    return checked_transform(turned, f"{where}, transform")
