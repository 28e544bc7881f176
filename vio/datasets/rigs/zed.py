"""Stereolabs' factory calibration of a ZED, `SN12345.conf`: an INI file for all resolutions.

`[LEFT_CAM_HD]`, `[RIGHT_CAM_HD]`: fx fy cx cy k1 k2 p1 p2 k3 of OpenCV's model (k4 and more of its
rational one) at 1280 x 720; likewise 2K, FHD, VGA and others. Files of the ZED X have the distortion in
`[LEFT_DISTO]` and `[RIGHT_DISTO]`, k1 to k4 alone where the lens is a fisheye. `[STEREO]`: `Baseline`, `TY`, `TZ` in
millimetres, and rotations `RX CV RZ` in radians about x, y, z for each resolution, a rotation vector
that maps coordinates of the left camera to the right one. Baseline is positive, so that T of
OpenCV's `X_right = R X_left + T` has -Baseline along x, as in Stereolabs' Python sample; its C++
sample passes +Baseline, which rectifies alike and has no meaning as a pose. TY and TZ are taken as
components of T, as both samples do; they are fractions of a millimetre.
Reference: Stereolabs' zed-open-capture (`calibration.hpp`) and zed-opencv-native (Python).
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from vio.cameras.rig import Rig, camera_from_matrix
from vio.datasets.common import naming
from vio.datasets.rigs.opencv import trimmed_coefficients
from vio.datasets.rigs.plausible import checked_rig
from vio.datasets.rigs.source import Size, Source
from vio.datasets.yaml_files import Entries, as_number
from vio.errors import CalibrationError
from vio.files.text import text_lines
from vio.geometry.distortion import CameraModel
from vio.geometry.lie import se3_from_parts, so3_exp
from vio.geometry.stereo import intrinsic_matrix

_MM = 1e-3  # metres
SIZES: dict[str, Size] = {
    "2K": (2208, 1242), "FHD": (1920, 1080), "FHD1200": (1920, 1200), "HD": (1280, 720), "HD1200": (1920, 1200),
    "SVGA": (960, 600), "VGA": (672, 376), "QHDPLUS": (3200, 1800), "QHD": (2560, 1440), "4K": (3856, 2180),
}  # fmt: skip
_FISHEYE = ["k1", "k2", "k3", "k4"]
_COEFFICIENTS = ["k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"]


def read_conf(path: Path) -> dict[str, object]:
    """Read the sections of an INI file, names in capitals, as blocks of text by lower-case keys.

    Raises:
        DataError: the file is missing or is no text.
    """
    sections: dict[str, object] = {}
    block: dict[str, str] = {}
    for _, line in text_lines(path):
        bare = line.split(";")[0].split("#")[0].strip()
        if bare.startswith("[") and bare.endswith("]"):
            block = {}
            sections[bare[1:-1].strip().upper()] = block
        elif "=" in bare:
            key, value = bare.split("=", 1)
            block[key.strip().lower()] = value.strip()
    return sections


def matches(entries: Entries) -> bool:
    """Return whether entries are the sections of a ZED's calibration."""
    return "STEREO" in entries and any(name.startswith("LEFT_CAM_") for name in entries)


def read(source: Source) -> Rig:
    """Read the calibration of the resolution of the images.

    Raises:
        CalibrationError: it is not among those of the file, or an entry is missing.
    """
    where = source.where
    names = [n.removeprefix("LEFT_CAM_") for n in source.entries if n.startswith("LEFT_CAM_")]
    name = _resolution(names, source.image_size, where)
    size = SIZES[name]
    cameras = [_camera(source, f"{side}_CAM_{name}", size) for side in ("LEFT", "RIGHT")]
    stereo = _block(source.entries, "STEREO", where)
    angles = [_number(stereo, (f"{axis}_{name}", axis), where, 0.0) for axis in ("RX", "CV", "RZ")]
    across = abs(_number(stereo, ("Baseline",), where))
    down = _number(stereo, (f"TY_{name}", "TY"), where, 0.0)
    ahead = _number(stereo, (f"TZ_{name}", "TZ"), where, 0.0)
    # files of the first cameras have metres
    unit = _MM if across > 1 else 1.0
    T_cam1_cam0 = se3_from_parts(so3_exp(angles), unit * np.array([-across, down, ahead]))
    with naming(where):
        rig = Rig(cameras[0], cameras[1], T_cam1_cam0)
    return checked_rig(rig, where)


def _resolution(names: list[str], size: Size | None, where: str) -> str:
    known = {name: SIZES[name] for name in names if name in SIZES}
    if size is None:
        listed = ", ".join(f"{w} x {h}" for w, h in dict.fromkeys(known.values()))
        raise CalibrationError(
            f"{where}: holds calibrations of several image sizes ({listed}); pass "
            "image_size=(W, H), or name the file by --calibration with the images"
        )
    found = [name for name, of in known.items() if of == size]
    if not found:
        listed = ", ".join(f"{w} x {h}" for w, h in dict.fromkeys(known.values()))
        raise CalibrationError(
            f"{where}: is for images of {listed} pixels, not of {size[0]} x {size[1]}; give images "
            "as the camera sends them"
        )
    return found[0]


def _camera(source: Source, name: str, size: Size) -> CameraModel:
    where = f"{source.where}, {name}"
    block = _block(source.entries, name, source.where)
    fx, fy, cx, cy = (_number(block, (key,), where) for key in ("fx", "fy", "cx", "cy"))
    K = intrinsic_matrix(fx, fy, cx, cy)
    side = name.split("_")[0]
    stated = source.entries.get(f"{side}_DISTO", block)
    bend = stated if isinstance(stated, dict) else block
    with naming(where):
        if "k4" in bend and "p1" not in bend:
            D = [_number(bend, (key,), where, 0.0) for key in _FISHEYE]
            return camera_from_matrix(K, *size, "equidistant", D)
        D = [_number(bend, (key,), where, 0.0) for key in _COEFFICIENTS]
        return camera_from_matrix(K, *size, "radtan", trimmed_coefficients(D))


def _block(entries: Entries, name: str, where: str) -> Mapping[str, str]:
    block = entries.get(name)
    if not isinstance(block, dict):
        raise CalibrationError(f"{where}: has no section [{name}]; copy the calibration again")
    return block


def _number(
    block: Mapping[str, str], keys: tuple[str, ...], where: str, default: float | None = None
) -> float:
    """Return the first of the entries that is there."""
    for key in keys:
        value = as_number(block.get(key.lower()))
        if np.isfinite(value):
            return value
    if default is None:
        raise CalibrationError(f"{where}: has no number {keys[0]}; copy the calibration again")
    return default
