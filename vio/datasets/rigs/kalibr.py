"""Kalibr's results: `camchain.yaml`, `camchain-imucam.yaml`, and the `imu.yaml` beside them.

`T_cn_cnm1` maps coordinates of the camera before to this one, `T_cam_imu` those of the IMU to the
camera; times of the IMU are `t_imu = t_cam + timeshift_cam_imu`. OpenVINS reads the same file, as
`kalibr_imucam_chain.yaml`, and ships it with `T_imu_cam` as well, which maps coordinates of the
camera to the IMU.
Reference: the page "yaml formats" of Kalibr's documentation; OpenVINS's `config/*`.
"""

from __future__ import annotations

import contextlib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from vio.cameras.rig import Rig
from vio.datasets.common import image_size, naming
from vio.datasets.rigs.plausible import checked_rig
from vio.datasets.rigs.source import check_direction
from vio.datasets.sides import first_pair, pairs_of
from vio.datasets.yaml_files import (
    Entries,
    as_number,
    imu_densities,
    lens_model,
    matrix,
    numbers,
    read_yaml_file,
    section,
)
from vio.errors import CalibrationError, DataError
from vio.geometry.distortion import CameraModel, simplest_lens
from vio.geometry.lenses.registry import LENSES
from vio.geometry.lie import FloatArray, checked_transform, se3_inverse
from vio.records import ImuDensities

_SAME_M = 2e-3  # how far the two statements of the stereo pose may be apart before it is said
_SAME_RAD = 5e-3
# of an IMU's readings, as OpenVINS names them
_IMU_MATRICES = ("Tw", "Ta", "R_IMUtoGYRO", "R_IMUtoACC")
_IDENTITY = 1e-3  # by which such a matrix may differ from the identity
_ROLLING_S = 1e-3  # from the first row of an image to the last, below which it is read at once


def is_camchain(entries: Entries) -> bool:
    """Return whether entries are those of a camchain, of one camera or more."""
    cameras = [entries.get("cam0"), *([entries["cam1"]] if "cam1" in entries else [])]
    return all(isinstance(camera, dict) and "intrinsics" in camera for camera in cameras)


def read_camchain(path: Path, *, alone: bool = False) -> Rig:
    """Read a camchain of one camera or two and, beside it, the IMU's file.

    Of two cameras that were calibrated with the IMU one by one, each file has one (`cam0-imu.yaml`
    and `cam1-imu.yaml`): they are a pair, unless the camera is asked for alone.

    A depth camera's `depth_factor`, levels per metre, is no entry of Kalibr's and may be added to
    cam0.

    Raises:
        CalibrationError: an entry is missing or impossible, or a model is not known; the message
            names it.
    """
    entries = read_yaml_file(path, "Kalibr's calibration of the cameras")
    if not is_camchain(entries):
        raise CalibrationError(
            f"{path}: is no camchain of Kalibr; it must hold the block cam0 and, for stereo, cam1"
        )
    notes: list[str] = []
    if not alone and (files := _one_file_each(path)) is not None:
        path = files[0]
        entries = {
            name: _lone_camera(file) for name, file in zip(("cam0", "cam1"), files, strict=True)
        }
        notes.append(f"{files[0]} is the left camera, {files[1].name} the right one")
    names = [name for name in ("cam0", "cam1") if name in entries]
    blocks = [section(entries, name, str(path)) for name in names]
    where = [f"{path}, {name}" for name in names]
    cameras = [_camera(*of_one) for of_one in zip(blocks, where, strict=True)]
    cam1 = cameras[1] if "cam1" in names else None
    T_cam0_imu = _imu_pose(blocks[0], where[0])
    T_cam1_cam0 = _stereo_pose(blocks[1], T_cam0_imu, path, notes) if "cam1" in names else None
    notes += _further_cameras(entries, names, path)
    readout_s, shutter_notes = _rolling_shutter(blocks[0], cameras[0].height, path)
    notes += shutter_notes
    noise, imu_notes = _imu_beside(path)
    offset_s = _time_shift(blocks, where)
    residual_px = _residual(blocks[-1], where[-1])
    factor = None
    if "depth_factor" in blocks[0]:
        factor = numbers(blocks[0], "depth_factor", where[0], 1)[0]
    with naming(path):
        notes += imu_notes
        rig = Rig(
            cameras[0],
            cam1,
            T_cam1_cam0,
            T_cam0_imu,
            noise,
            offset_s,
            tuple(notes),
            residual_px,
            factor,
            readout_s,
        )
    return checked_rig(rig, path)


def _one_file_each(path: Path) -> tuple[Path, Path] | None:
    """Return the files of the left and the right camera where a file holds one camera on the IMU,
    and another one beside it, named as the other side, the other; None: it does not.
    """
    if _lone_camera(path) is None:
        return None
    beside = sorted(file.name for file in path.parent.glob(f"*{path.suffix}"))
    pairs = [pair for pair in pairs_of(beside) if path.name in pair]
    pair = first_pair(pairs)
    if pair is None:
        files = None
    else:
        files = (path.with_name(pair[0]), path.with_name(pair[1]))
    if files is None or any(_lone_camera(file) is None for file in files):
        return None
    return files


def _lone_camera(file: Path) -> object:
    """Return the block of a file's only camera, on an IMU; None: the file holds something else."""
    try:
        entries = read_yaml_file(file, "Kalibr's calibration of the cameras")
    except DataError:
        return None
    block = entries.get("cam0")
    if "cam1" in entries or not is_camchain(entries) or not isinstance(block, dict):
        return None
    return block if {"T_cam_imu", "T_imu_cam"} & block.keys() else None


def _rolling_shutter(block: Mapping[str, Any], height: int, path: Path) -> tuple[float, list[str]]:
    """Return the time between the exposures of the first and the last row, and a note on it where
    rows are exposed one after the other.
    """
    readout_s = as_number(block.get("line_delay", 0.0)) * height
    if not abs(readout_s) > _ROLLING_S:
        return 0.0, []
    note = (
        f"{path}: line_delay states a rolling shutter of {1e3 * readout_s:.1f} ms from the first "
        "row to the last; features are moved to the time of the middle row"
    )
    return readout_s, [note]


def _further_cameras(entries: Entries, names: Sequence[str], path: Path) -> list[str]:
    """Return a note on the cameras that are not used, where there are some."""
    further = sorted(name for name in entries if name.startswith("cam") and name not in names)
    if not further:
        return []
    return [f"{path}: {' and '.join(names)} are used, {', '.join(further)} not"]


def _stereo_pose(
    right: Mapping[str, Any], T_cam0_imu: FloatArray | None, path: Path, notes: list[str]
) -> FloatArray:
    """Return `T_cam1_cam0` (4, 4) as stated, or by way of the IMU; add a note where both are
    stated and disagree.
    """
    where = f"{path}, cam1"
    T_cam1_imu = _imu_pose(right, where)
    T_cam1_cam0 = _pose(right, "T_cn_cnm1", where)
    if T_cam0_imu is not None and T_cam1_imu is not None:
        through_imu = T_cam1_imu @ se3_inverse(T_cam0_imu)
        if T_cam1_cam0 is None:
            check_direction(through_imu, se3_inverse(T_cam1_imu) @ T_cam0_imu, where)
            return through_imu
        if _apart(T_cam1_cam0, through_imu):
            notes.append(
                f"{path}: T_cn_cnm1 of cam1 and the T_cam_imu of both cameras disagree; T_cn_cnm1 "
                "is used"
            )
    if T_cam1_cam0 is None:
        raise CalibrationError(
            f"{path}: states no pose of cam1; add T_cn_cnm1 to cam1, or T_cam_imu to both cameras"
        )
    return T_cam1_cam0


def _camera(block: Mapping[str, Any], where: str) -> CameraModel:
    kind = str(block.get("camera_model", "pinhole"))
    bend = str(block.get("distortion_model", "none"))
    # Of each camera_model: the lens by the model of the distortion, and the leading parameters.
    known: dict[str, dict[str, str]] = {}
    leading: dict[str, int] = {}
    for lens in LENSES.values():
        for form in lens.files.kalibr.values():
            known.setdefault(form.camera, {})[lens_model(form.distortion, where)] = lens.name
            leading[form.camera] = form.leading
    if kind not in known:
        raise CalibrationError(
            f"{where}: camera_model {kind!r} is not read; calibrate with {', '.join(known)}"
        )
    values = numbers(block, "intrinsics", where, leading[kind] + 4)
    fu, fv, cu, cv = values[leading[kind] :]
    stated = lens_model(bend, where)
    bends = () if stated == "pinhole" else numbers(block, "distortion_coeffs", where)
    stated, bends = simplest_lens(stated, bends)
    if stated not in known[kind] and not any(bends):
        stated = "pinhole"
        bends = ()
    model = known[kind].get(stated)
    if model is None:
        raise CalibrationError(
            f"{where}: {kind} with distortion {bend!r} is not read; calibrate {_forms(kind)}"
        )
    coefficients = (*values[: leading[kind]], *bends)
    width, height = image_size(numbers(block, "resolution", where, 2), f"{where}, resolution")
    with naming(where):
        return CameraModel(fu, fv, cu, cv, width, height, model, coefficients)


def _forms(kind: str) -> str:
    """Return Kalibr's names of the lens models with a camera_model, for a message."""
    forms = [form for lens in LENSES.values() for form in lens.files.kalibr.values()]
    names = [f"{form.camera}-{form.distortion}" for form in forms if form.camera == kind]
    return " or ".join(dict.fromkeys(names))


def _imu_pose(block: Mapping[str, Any], where: str) -> FloatArray | None:
    """Return `T_cam_imu` (4, 4) as stated, or as the inverse of a stated `T_imu_cam`.

    Raises:
        CalibrationError: both are stated, and differ.
    """
    stated = _pose(block, "T_cam_imu", where)
    other = _pose(block, "T_imu_cam", where)
    if other is None:
        return stated
    if stated is not None and _apart(stated, se3_inverse(other)):
        raise CalibrationError(
            f"{where}: T_cam_imu is not the inverse of T_imu_cam; remove the one that is wrong"
        )
    return se3_inverse(other) if stated is None else stated


def _pose(block: Mapping[str, Any], key: str, where: str) -> FloatArray | None:
    if key not in block:
        return None
    return checked_transform(matrix(block[key], (4, 4), f"{where}, {key}"), f"{where}, {key}")


def _apart(A: FloatArray, B: FloatArray) -> bool:
    difference = A @ se3_inverse(B)
    return bool(
        np.linalg.norm(difference[:3, 3]) > _SAME_M
        or np.abs(difference[:3, :3] - np.eye(3)).max() > _SAME_RAD
    )


def _time_shift(blocks: Sequence[Mapping[str, Any]], where: Sequence[str]) -> float:
    """Return the mean of the shifts of the cameras, which one exposure shares."""
    shifts = [
        numbers(block, "timeshift_cam_imu", name, 1)[0]
        for block, name in zip(blocks, where, strict=True)
        if "timeshift_cam_imu" in block
    ]
    return sum(shifts) / len(shifts) if shifts else 0.0


def _residual(right: Mapping[str, Any], where: str) -> float:
    """Return what a calibration by `vio run` could not express, pixels.

    Kalibr itself states nothing of the kind.
    """
    value = numbers(right, "residual_px", where, 1)[0] if "residual_px" in right else 0.0
    if not value >= 0:
        raise CalibrationError(f"{where}: residual_px is {value:g}; it must not be negative")
    return value


def _imu_beside(path: Path) -> tuple[ImuDensities | None, tuple[str, ...]]:
    """Find the IMU's file in the folder of a camchain: its noise, and a note where several fit, or
    one cannot be used.

    Files of other tools, which may be no YAML at all, are passed over.
    """
    found: list[tuple[Path, ImuDensities]] = []
    notes: list[str] = []
    for file in sorted([*path.parent.glob("*imu*.yaml"), *path.parent.glob("*imu*.yml")]):
        if "chain" in file.name.replace("imu_chain", "") or file == path or not file.is_file():
            continue
        sheet = _imu_sheet(file)
        noise = imu_densities(sheet, file)
        if noise is not None:
            notes += [] if found else _unapplied(sheet, file)
            found.append((file, noise))
    if not found:
        return None, ()
    names = ", ".join(file.name for file, _ in found)
    if len(found) > 1:
        notes.append(f"of {names} the first gives the IMU's noise")
    return found[0][1], tuple(notes)


def _imu_sheet(file: Path) -> Entries:
    """Return what a YAML file states of an IMU, plain or in the block of its first one."""
    try:
        entries = read_yaml_file(file, "Kalibr's IMU noise")
    except DataError:
        return {}
    block = entries.get("imu0")
    if isinstance(block, dict):
        return {str(k): v for k, v in block.items()}
    return entries


def _unapplied(sheet: Entries, file: Path) -> list[str]:
    """Return a note on the scale and the misalignment of an IMU, as OpenVINS's `Tw` and `Ta` or
    Kalibr's `gyroscopes: M` state them.
    """
    stated: dict[str, object] = {name: sheet.get(name) for name in _IMU_MATRICES}
    for sensor in ("gyroscopes", "accelerometers"):
        block = sheet.get(sensor)
        if isinstance(block, dict):
            stated[f"{sensor}: M"] = block.get("M")
    off = {}
    for name, value in stated.items():
        with contextlib.suppress(CalibrationError):
            if value is not None:
                off[name] = float(np.abs(matrix(value, (3, 3), name) - np.eye(3)).max())
    names = [name for name, size in off.items() if size > _IDENTITY]
    if not names:
        return []
    share = 100 * max(off[name] for name in names)
    return [
        f"{file}: {', '.join(names)} (up to {share:.2g} % off the identity) are not applied to the "
        "readings; correct them before, or let vio calibrate-rig measure them"
    ]


def kalibr_text(rig: Rig) -> str:
    """Return the camchain of a rig, with all digits, as `read_camchain` reads it."""
    chain: dict[str, Any] = {}
    T_cam_imu = rig.T_cam0_imu
    for name, camera in zip(("cam0", "cam1"), rig.cameras, strict=False):
        sheet: dict[str, Any] = {}
        if name == "cam1" and T_cam_imu is not None:
            T_cam_imu = rig.right[1] @ T_cam_imu
        if T_cam_imu is not None:
            sheet["T_cam_imu"] = T_cam_imu.tolist()
        if name == "cam1":
            sheet["T_cn_cnm1"] = rig.right[1].tolist()
            if rig.residual_px:
                sheet["residual_px"] = float(rig.residual_px)
        sheet |= _camera_sheet(camera)
        if T_cam_imu is not None:
            sheet["timeshift_cam_imu"] = float(rig.time_offset_s)
        if rig.readout_s:
            sheet["line_delay"] = float(rig.readout_s) / camera.height
        if name == "cam0" and rig.depth_factor is not None:
            sheet["depth_factor"] = float(rig.depth_factor)
        chain[name] = sheet
    return yaml.safe_dump(chain, sort_keys=False, default_flow_style=None)


def _camera_sheet(camera: CameraModel) -> dict[str, Any]:
    """Return a camera's entries.

    Raises:
        CalibrationError: Kalibr's file has no name for the lens model.
    """
    coefficients = [float(c) for c in camera.coefficients]
    form = camera.lens.files.kalibr.get(len(coefficients))
    if form is None:
        raise CalibrationError(
            f"Kalibr's camchain has no {camera.model} lens; rectify the images first (vio rectify)"
        )
    return {
        "camera_model": form.camera,
        "distortion_model": form.distortion,
        "distortion_coeffs": coefficients[form.leading :],
        "intrinsics": [*coefficients[: form.leading], camera.fu, camera.fv, camera.cu, camera.cv],
        "resolution": [camera.width, camera.height],
    }
