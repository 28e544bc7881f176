"""Basalt's `calibration.json`, which Monado's recordings have too.

`T_imu_cam` maps coordinates of a camera to the IMU (position px py pz in metres, quaternion
qx qy qz qw); `cam_time_offset_ns` is added to the cameras' stamps to have the IMU's; noise: densities
in SI units, of each axis. Lens models: `pinhole`, `kb4`, `ds`, `ucm` (the double sphere with one
centre), `eucm`, `fov` and `pinhole-radtan8` (OpenCV's rational model). The file's corrections of the IMU's readings
(`calib_accel_bias`, `calib_gyro_bias`) are not applied: biases are estimated.
Reference: Usenko et al., The double sphere camera model (2018); basalt-headers' `calibration.hpp`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from vio.cameras.rig import Rig
from vio.datasets.common import image_size, naming
from vio.datasets.rigs.plausible import checked_rig
from vio.datasets.rigs.source import ImuSheet, Source, first_cameras, rig_of_poses
from vio.datasets.yaml_files import Entries, as_number, numbers, section, tool_lens
from vio.errors import CalibrationError
from vio.geometry.distortion import CameraModel, simplest_lens
from vio.geometry.lenses.registry import LENSES
from vio.geometry.lie import FloatArray, checked_transform, rotation_from_quat_xyzw, se3_from_parts
from vio.records import NS_PER_S, ImuDensities

_NOISE = ("gyro_noise_std", "gyro_bias_std", "accel_noise_std", "accel_bias_std")
_BIAS_ENTRIES = ("calib_accel_bias", "calib_gyro_bias")


def matches(entries: Entries) -> bool:
    """Return whether entries are those of Basalt's calibration."""
    block = entries.get("value0")
    return isinstance(block, dict) and "T_imu_cam" in block and "intrinsics" in block


def read(source: Source) -> Rig:
    """Read the first two cameras, or the only one.

    Raises:
        CalibrationError: an entry is missing or impossible, or a lens model is not read.
    """
    where = source.where
    block = section(source.entries, "value0", where)
    placed = _list(block, "T_imu_cam", where)
    poses = [_pose(item, where) for item in first_cameras(placed, where)]
    lenses = _list(block, "intrinsics", where)
    sizes = _list(block, "resolution", where)
    if not len(placed) == len(lenses) == len(sizes):
        raise CalibrationError(f"{where}: T_imu_cam, intrinsics and resolution differ in length")
    cameras = [
        _camera(lens, size, f"{where}, camera {k}")
        for k, (lens, size) in enumerate(zip(first_cameras(lenses, where), sizes, strict=False))
    ]
    return checked_rig(
        rig_of_poses(cameras, poses, where, _imu(block, where), count=len(placed)), where
    )


def _camera(lens: Mapping[str, Any], size: Sequence[float], where: str) -> CameraModel:
    kind = str(lens.get("camera_type"))
    known = {
        one.files.basalt: (one.name, one.parameters)
        for one in LENSES.values()
        if one.files.basalt is not None
    }
    model, names = tool_lens("basalt", kind, f"{where}, camera_type", known)
    values = section(lens, "intrinsics", where)
    fu, fv, cu, cv = (numbers(values, name, where, 1)[0] for name in ("fx", "fy", "cx", "cy"))
    bend = tuple(numbers(values, name, where, 1)[0] if name else 0.0 for name in names)
    model, bend = simplest_lens(model, bend)
    width, height = image_size([as_number(x) for x in size][:2], f"{where}, resolution")
    with naming(where):
        return CameraModel(fu, fv, cu, cv, width, height, model, bend)


def _pose(item: Mapping[str, Any], where: str) -> FloatArray:
    p = np.array([numbers(item, f"p{axis}", where, 1)[0] for axis in "xyz"])
    q = np.array([numbers(item, f"q{axis}", where, 1)[0] for axis in "xyzw"])
    norm = float(np.linalg.norm(q))
    if not 0.9 < norm < 1.1:
        raise CalibrationError(f"{where}, T_imu_cam: a quaternion of norm {norm:g}; it must be 1")
    T = se3_from_parts(rotation_from_quat_xyzw(q / norm), p)
    return checked_transform(T, f"{where}, T_imu_cam")


def _imu(block: Mapping[str, Any], where: str) -> ImuSheet:
    offset_ns = (
        numbers(block, "cam_time_offset_ns", where, 1)[0] if "cam_time_offset_ns" in block else 0.0
    )
    noise = None
    if all(name in block for name in _NOISE):
        values = [max(_axes(block, name, where)) for name in _NOISE]
        noise = ImuDensities(*values) if min(values) > 0 else None
    biased = [name for name in _BIAS_ENTRIES if name in block and any(_axes(block, name, where))]
    notes = tuple(f"{where}: {name} is not applied to the readings" for name in biased)
    return ImuSheet(noise, offset_ns / NS_PER_S, notes)


def _axes(block: Mapping[str, Any], name: str, where: str) -> list[float]:
    """Return the numbers of an entry: one, a list, or a block x y z."""
    value = block[name]
    if isinstance(value, dict):
        return [numbers(value, axis, f"{where}, {name}", 1)[0] for axis in value]
    return list(numbers(block, name, where))


def _list(block: Mapping[str, Any], name: str, where: str) -> list[Any]:
    value = block.get(name)
    if not isinstance(value, list) or not value:
        raise CalibrationError(f"{where}: has no list {name}; copy the calibration again")
    return value
