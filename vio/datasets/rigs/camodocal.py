"""VINS-Fusion's and VINS-Mono's settings, and the camera files of camodocal that they name.

`cam0_calib` and `cam1_calib` name the cameras' files, beside the settings. `body_T_cam0` maps
coordinates of the camera to the IMU, as do `extrinsicRotation` and `extrinsicTranslation`
(VINS-Mono); `td` is added to the cameras' stamps to have the IMU's. Their `acc_n gyr_n acc_w gyr_w`
are of a sample, not of a root of a hertz, and inflated on purpose: they are not taken.
`rolling_shutter_tr` is the time from the first row to the last, where `rolling_shutter` is not 0.

camodocal's lens models: PINHOLE (k1 k2 p1 p2), PINHOLE_FULL (rational), MEI (unified, mirror
parameter xi), KANNALA_BRANDT (k2 to k5 on the powers 3 to 9 of the angle: OpenCV's fisheye).
Reference: VINS-Fusion's `parameters.cpp`, camodocal's camera models.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from vio.cameras.rig import Rig
from vio.datasets.common import image_size, naming
from vio.datasets.rigs.plausible import checked_rig
from vio.datasets.rigs.source import ImuSheet, Source, rig_of_poses
from vio.datasets.yaml_files import (
    Entries,
    as_number,
    matrix,
    numbers,
    read_yaml_file,
    section,
    tool_lens,
)
from vio.errors import CalibrationError
from vio.geometry.distortion import CameraModel, simplest_lens
from vio.geometry.lie import FloatArray, checked_transform

_NOISE = ("acc_n", "gyr_n")
_UNKNOWN_POSES = 2  # of estimate_extrinsic
# focal lengths and principal point of its models
_PROJECTIONS = (
    ("fx", "fy", "cx", "cy"),
    ("gamma1", "gamma2", "u0", "v0"),
    ("mu", "mv", "u0", "v0"),
)
_OPTIONAL = {"k3": 0.0, "k4": 0.0, "k5": 0.0, "k6": 0.0}  # of PINHOLE_FULL


def matches(entries: Entries) -> bool:
    """Return whether entries are VINS's settings, or camodocal's camera."""
    return "cam0_calib" in entries or "model_type" in entries


def read(source: Source) -> Rig:
    """Read settings with their cameras' files, or the file of one camera.

    Raises:
        CalibrationError: a file or an entry is missing or impossible.
    """
    if "cam0_calib" in source.entries:
        rig = _settings(source)
    else:
        rig = _alone(source)
    return checked_rig(_with_shutter(rig, source), source.where)


def _with_shutter(rig: Rig, source: Source) -> Rig:
    """Return a rig with the readout time of VINS-Mono's settings, whose stamps are of the middle
    row, too.
    """
    entries = source.entries
    if as_number(entries.get("rolling_shutter", 0)) == 0 or "rolling_shutter_tr" not in entries:
        return rig
    readout_s = numbers(entries, "rolling_shutter_tr", source.where, 1)[0]
    with naming(source.path):
        return replace(rig, readout_s=readout_s)


def _alone(source: Source) -> Rig:
    """Read a camera's file; VINS-Mono's settings are one, with the pose of the IMU."""
    camera = camodocal_camera(source.entries, source.where)
    if "extrinsicRotation" not in source.entries:
        return Rig(camera)
    parts = [
        matrix(source.entries.get(f"extrinsic{name}"), None, f"{source.where}, extrinsic{name}")
        for name in ("Rotation", "Translation")
    ]
    T = np.column_stack([parts[0].reshape(3, 3), parts[1].ravel()[:3]])
    where = f"{source.where}, extrinsicRotation"
    return rig_of_poses([camera], [checked_transform(T, where)], source.where, _imu(source))


def _settings(source: Source) -> Rig:
    entries = source.entries
    names = [f"cam{k}" for k in range(2) if f"cam{k}_calib" in entries]
    count = as_number(entries.get("num_of_cam", len(names)))
    names = names[: int(count)] if count >= 1 else names
    cameras = []
    for name in names:
        file = source.path.parent / Path(str(entries[f"{name}_calib"])).name
        if not file.is_file():
            raise CalibrationError(
                f"{source.where}: {name}_calib names {file.name}, which is not beside it; copy it "
                "there"
            )
        cameras.append(
            camodocal_camera(read_yaml_file(file, "the camera's calibration"), str(file))
        )
    has_imu = as_number(entries.get("imu", 1)) != 0
    poses = [_pose(entries, name, source.where) for name in names]
    return rig_of_poses(cameras, poses, source.where, _imu(source) if has_imu else None)


def _pose(entries: Entries, name: str, where: str) -> FloatArray:
    key = f"body_T_{name}"
    if key not in entries:
        raise CalibrationError(f"{where}: has no entry {key}, the pose of the camera on the IMU")
    return checked_transform(matrix(entries[key], None, f"{where}, {key}"), f"{where}, {key}")


def _imu(source: Source) -> ImuSheet:
    entries = source.entries
    offset_s = 0.0
    if "td" in entries:
        offset_s = numbers(entries, "td", source.where, 1)[0]
    notes: tuple[str, ...] = ()
    if any(name in entries for name in _NOISE):
        notes = (f"{source.where}: acc_n and gyr_n are of a sample and not used",)
    if as_number(entries.get("estimate_extrinsic", 0)) == _UNKNOWN_POSES:
        notes += (
            f"{source.where}: doubtful: estimate_extrinsic is 2, which says that the poses of the "
            "cameras on the IMU are not known; they are read as they stand",
        )
    return ImuSheet(time_offset_s=offset_s, notes=notes)


def camodocal_camera(entries: Entries, where: str) -> CameraModel:
    """Return the camera of a file of camodocal.

    Raises:
        CalibrationError: an entry is missing or impossible, or the lens model is not read.
    """
    model, coefficients = tool_lens("camodocal", entries.get("model_type"), f"{where}, model_type")
    size = [numbers(entries, f"image_{name}", where, 1)[0] for name in ("width", "height")]
    width, height = image_size(size, where)
    projection = section(entries, "projection_parameters", where)
    # the coefficients stand in blocks of their own, or beside the focal lengths
    blocks = [entries.get(name) for name in ("mirror_parameters", "distortion_parameters")]
    stated = {**_OPTIONAL, **projection}
    for block in blocks:
        stated |= block if isinstance(block, dict) else {}
    names = next((four for four in _PROJECTIONS if four[0] in projection), _PROJECTIONS[0])
    fu, fv, cu, cv = _values(projection, names, where)
    bend = _values(stated, coefficients, where)
    if model == "unified" and not any(bend[1:]):
        bend = bend[:1]
    model, bend = simplest_lens(model, bend)
    with naming(where):
        return CameraModel(fu, fv, cu, cv, width, height, model, bend)


def _values(block: Mapping[str, Any], names: Sequence[str], where: str) -> tuple[float, ...]:
    return tuple(numbers(block, name, where, 1)[0] for name in names)
