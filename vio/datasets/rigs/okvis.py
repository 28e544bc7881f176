"""OKVIS's and OKVIS2's settings, and the `ncamera` files of aslam_cv2, maplab and SVO.

OKVIS: `cameras` with `T_SC`, which maps coordinates of the camera to the IMU (the sensor S);
the `T_BS` of the IMU is its pose on a body and not needed. `image_delay` is subtracted from
the cameras' stamps to have the IMU's. `cam_model: eucm` has `eucm_parameters`, alpha beta.
Noise: `sigma_g_c sigma_gw_c sigma_a_c sigma_aw_c`, densities.

ncamera: `cameras` with a `camera` block each and `T_B_C`, which maps coordinates of the camera to the
body, which is the IMU (or `T_C_B`, its inverse); SVO's `imu_params.delay_imu_cam` is subtracted likewise. Noise:
`sigma_omega_c sigma_omega_bias_c sigma_acc_c sigma_acc_bias_c`. A `distortion` of type `fisheye` is the field-of-view
model with one parameter (aslam_cv2's `distortion-fisheye.cc`).
Reference: OKVIS2's settings ("timestamp_camera_correct = timestamp_camera - image_delay"); SVO Pro's
`imu_handler.cpp` (it integrates from `t - delay_imu_cam`); aslam_cv2's `camera-yaml-serialization`.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from vio.cameras.rig import Rig
from vio.datasets.common import image_size, naming
from vio.datasets.rigs.opencv import coefficients_of
from vio.datasets.rigs.plausible import checked_rig
from vio.datasets.rigs.source import ImuSheet, Source, rig_of_poses
from vio.datasets.yaml_files import (
    Entries,
    as_number,
    lens_model,
    matrix,
    numbers,
    section,
    tool_lens,
)
from vio.errors import CalibrationError
from vio.geometry.distortion import CameraModel
from vio.geometry.lie import FloatArray, checked_transform, se3_inverse
from vio.records import ImuDensities

_NOISE = (  # gyro, its walk, accelerometer, its walk
    ("sigma_g_c", "sigma_gw_c", "sigma_a_c", "sigma_aw_c"),
    ("sigma_omega_c", "sigma_omega_bias_c", "sigma_acc_c", "sigma_acc_bias_c"),
)
_OKVIS_TYPES = {"radialtangential8": 8, "plumb_bob8": 8}


def matches(entries: Entries) -> bool:
    """Return whether entries hold a list of cameras in one of these forms."""
    cameras = _items(entries)
    return bool(cameras) and all(
        isinstance(item, dict) and ("T_SC" in item or "camera" in item) for item in cameras
    )


def read(source: Source) -> Rig:
    """Read the first two cameras, or the only one.

    Raises:
        CalibrationError: an entry is missing or impossible, or a lens model is not read.
    """
    where = source.where
    items = _items(source.entries)
    cameras = []
    poses = []
    for k, item in enumerate(items[:2]):
        here = f"{where}, camera {k}"
        if "T_SC" in item:
            cameras.append(_okvis_camera(item, here))
            poses.append(_pose(item["T_SC"], f"{here}, T_SC"))
        else:
            cameras.append(_ncamera(section(item, "camera", here), here))
            poses.append(_body_pose(item, here))
    imu = _imu(source.entries, where)
    return checked_rig(rig_of_poses(cameras, poses, where, imu, count=len(items)), where)


def _items(entries: Entries) -> list[Any]:
    """Return the cameras, which maplab's `sensors.yaml` has within one of its sensors."""
    cameras = entries.get("cameras")
    sensors = entries.get("sensors")
    for sensor in sensors if isinstance(sensors, list) else []:
        if cameras is None and isinstance(sensor, dict):
            cameras = sensor.get("cameras")
    return cameras if isinstance(cameras, list) else []


def _body_pose(item: Mapping[str, Any], where: str) -> FloatArray:
    """Return `T_B_C` (4, 4) of a camera of an ncamera, which may have its inverse."""
    if "T_B_C" not in item and "T_C_B" in item:
        return se3_inverse(_pose(item["T_C_B"], f"{where}, T_C_B"))
    return _pose(item.get("T_B_C"), f"{where}, T_B_C")


def _pose(value: object, where: str) -> FloatArray:
    return checked_transform(matrix(value, (4, 4), where), where)


def _okvis_camera(item: Mapping[str, Any], where: str) -> CameraModel:
    kind = str(item.get("cam_model", "pinhole")).lower()
    size = image_size(numbers(item, "image_dimension", where, 2), f"{where}, image_dimension")
    focal = numbers(item, "focal_length", where, 2)
    centre = numbers(item, "principal_point", where, 2)
    if kind != "pinhole":
        model, names = tool_lens("okvis", kind, f"{where}, cam_model")
        bend = numbers(item, f"{kind}_parameters", where, len(names))
        return _camera((*focal, *centre), size, model, bend, where)
    name = str(item.get("distortion_type", "none")).lower()
    model = lens_model(name, where)
    bend = () if model == "pinhole" else numbers(item, "distortion_coefficients", where)
    if name in _OKVIS_TYPES and len(bend) != _OKVIS_TYPES[name]:
        raise CalibrationError(f"{where}: {len(bend)} distortion coefficients, {name} has 8")
    return _camera((*focal, *centre), size, str(model), bend, where)


def _ncamera(block: Mapping[str, Any], where: str) -> CameraModel:
    size = [numbers(block, f"image_{name}", where, 1)[0] for name in ("width", "height")]
    kind = str(block.get("type", "pinhole")).lower()
    values = matrix(block.get("intrinsics"), None, f"{where}, intrinsics").ravel().tolist()
    stated = block.get("distortion")
    stated = stated if isinstance(stated, dict) else {}
    name = str(stated.get("type", "none")).lower()
    # aslam_cv2's `FisheyeDistortion` is the field-of-view model, not OpenCV's fisheye.
    model = lens_model("fov" if name == "fisheye" else name, where)
    parameters = stated.get("parameters")
    bend = (
        ()
        if model == "pinhole"
        else tuple(matrix(parameters, None, f"{where}, distortion").ravel().tolist())
    )
    leading = 0
    if kind != "pinhole":
        if model not in ("pinhole", "radtan") and any(bend):
            raise CalibrationError(
                f"{where}: a camera of type {kind!r} with distortion {name!r} is not read"
            )
        model, names = tool_lens("ncamera", kind, f"{where}, type")
        leading = len(names)
        bend = (*values[:leading], *(bend if any(bend) else ()))
    if len(values) != leading + 4:
        raise CalibrationError(
            f"{where}: a camera of type {kind!r} with {len(values)} intrinsics is not read; "
            f"calibrate one with {leading + 4}"
        )
    return _camera(tuple(values[leading:]), image_size(size, where), str(model), bend, where)


def _camera(
    intrinsics: tuple[float, ...],
    size: tuple[int, int],
    model: Any,
    bend: tuple[float, ...],
    where: str,
) -> CameraModel:
    with naming(where):
        if model == "radtan":
            bend = coefficients_of("radtan", bend) if any(bend) else ()
            model = "radtan" if bend else "pinhole"
        fu, fv, cu, cv = intrinsics
        return CameraModel(fu, fv, cu, cv, *size, model, bend)


def _imu(entries: Entries, where: str) -> ImuSheet:
    delay_s = 0.0
    delays = (
        ("camera_params", "image_delay"),
        ("camera_parameters", "image_delay"),
        ("imu_params", "delay_imu_cam"),
    )
    for name, key in delays:
        block = entries.get(name)
        if isinstance(block, dict) and key in block:
            delay_s = numbers(block, key, where, 1)[0]
    block = entries.get("imu_params", entries.get("imu_parameters"))
    noise = None
    for names in _NOISE:
        if isinstance(block, dict) and all(name in block for name in names):
            values = [as_number(block[name]) for name in names]
            noise = ImuDensities(*values) if min(values) > 0 else None
    return ImuSheet(noise, -delay_s)
