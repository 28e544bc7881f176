"""MRPT's calibration of a pair, an INI file, as kinect-stereo-calib writes it and the Malaga sets
have it.

`[CAMERA_PARAMS_LEFT]` and `[CAMERA_PARAMS_RIGHT]`: `resolution`, `cx cy fx fy` in pixels, `dist` of
OpenCV's model, k1 k2 p1 p2 k3. MRPT 2 states a `distortion_model` as well: `plumb_bob`, with or
without k4 k5 k6, `kannala_brandt`, OpenCV's fisheye, k1 to k4, or `none`.
`[CAMERA_PARAMS_LEFT2RIGHT_POSE]`: `pose_quaternion`, the pose of the right camera in the left one,
x y z in metres and a quaternion w x y z. The part before `LEFT` may differ.
Reference: MRPT's TStereoCamera and TCamera; Blanco et al., The Malaga Urban Dataset (2014).
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from vio.cameras.rig import Rig, camera_from_matrix
from vio.datasets.common import image_size, naming, numbers_in
from vio.datasets.rigs.opencv import trimmed_coefficients
from vio.datasets.rigs.plausible import checked_rig
from vio.datasets.rigs.source import Source
from vio.datasets.yaml_files import Entries, section
from vio.errors import CalibrationError
from vio.files.text import text_lines
from vio.geometry.distortion import CameraModel, DistortionModel
from vio.geometry.lie import FloatArray, rotation_from_quat_xyzw, se3_from_parts, se3_inverse
from vio.geometry.stereo import intrinsic_matrix

_POSE = "LEFT2RIGHT_POSE"
# ours, and how many coefficients there may be
_MODELS: dict[str, tuple[DistortionModel, tuple[int, ...]]] = {
    "plumb_bob": ("radtan", (5, 8)),
    "kannala_brandt": ("equidistant", (4,)),
    "none": ("radtan", (0,)),
}


def is_mrpt(path: Path) -> bool:
    """Return whether a text file has the section of MRPT's pose."""
    return any(line.strip().endswith(f"{_POSE}]") for _, line in text_lines(path))


def matches(entries: Entries) -> bool:
    """Return whether the sections of an INI file are those of MRPT's pair."""
    return _prefix(entries) is not None


def read(source: Source) -> Rig:
    """Read the pair.

    Raises:
        CalibrationError: an entry is missing, malformed or impossible.
    """
    where = source.where
    prefix = _prefix(source.entries)
    assert prefix is not None
    cam0, cam1 = (
        _camera(section(source.entries, name, where), f"{where}, {name}")
        for name in (f"{prefix}LEFT", f"{prefix}RIGHT")
    )
    name = f"{prefix}{_POSE}"
    pose = _values(section(source.entries, name, where), "pose_quaternion", 7, f"{where}, {name}")
    quat_wxyz = pose[3:] / max(float(np.linalg.norm(pose[3:])), 1e-9)
    R = rotation_from_quat_xyzw(quat_wxyz[[1, 2, 3, 0]])
    T_cam1_cam0 = se3_inverse(se3_from_parts(R, pose[:3]))
    with naming(where):
        return checked_rig(Rig(cam0, cam1, T_cam1_cam0), where)


def _prefix(entries: Entries) -> str | None:
    """Return what stands before LEFT in the names of the sections; None: no section is a pose."""
    names = [name for name in entries if name.endswith(_POSE)]
    return names[0].removesuffix(_POSE) if names else None


def _camera(block: Mapping[str, object], where: str) -> CameraModel:
    size = image_size(_values(block, "resolution", 2, where).tolist(), f"{where}, resolution")
    cx, cy, fx, fy = (float(_values(block, key, 1, where)[0]) for key in ("cx", "cy", "fx", "fy"))
    stated = _bare(block, "distortion_model") if "distortion_model" in block else "plumb_bob"
    if stated not in _MODELS:
        raise CalibrationError(
            f"{where}: distortion_model is {stated!r}; MRPT's are {', '.join(_MODELS)}"
        )
    model, counts = _MODELS[stated]
    count = len(_bare(block, "dist").split()) if "dist" in block else counts[0]
    dist = _values(block, "dist", count if count in counts else counts[0], where).tolist()
    with naming(where):
        K = intrinsic_matrix(fx, fy, cx, cy)
        bent = trimmed_coefficients(dist) if model == "radtan" else tuple(dist)
        return camera_from_matrix(K, *size, model, bent)


def _bare(block: Mapping[str, object], key: str) -> str:
    """Return an entry without the brackets of a list and the comment behind it."""
    return str(block[key]).split("//")[0].replace(",", " ").strip("[] \t")


def _values(block: Mapping[str, object], key: str, count: int, where: str) -> FloatArray:
    """Return the numbers of an entry, `[1 2 3]` or one, without the comment behind them."""
    if key not in block:
        raise CalibrationError(f"{where}: has no entry {key}; copy the calibration again")
    return numbers_in(_bare(block, key), count, f"{where}, {key}")
