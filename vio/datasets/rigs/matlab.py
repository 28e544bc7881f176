"""MATLAB's stereo calibrations: `stereoParameters` as a structure, in a `.mat` file or in JSON, and
the results of Bouguet's toolbox, `Calib_Results_stereo.mat`.

MATLAB multiplies rows from the left: `RotationOfCamera2` and `IntrinsicMatrix` are the transposes of
OpenCV's `R` and of a matrix of pixels, `PoseCamera2` and `K` are not. The first pixel of its images
is (1, 1), in Bouguet's toolbox (0, 0). Lengths are in `WorldUnits`, in the toolbox in millimetres.
Reference: the documentation of stereoParameters and of stereoParametersToOpenCV; J.-Y. Bouguet, Camera
Calibration Toolbox for Matlab.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from vio.cameras.rig import Rig
from vio.datasets.mat_files import SUFFIX, Shapes, read_variables
from vio.datasets.rigs.opencv import rig_from_opencv
from vio.datasets.rigs.source import Source
from vio.datasets.yaml_files import Entries, matrix, section
from vio.errors import CalibrationError
from vio.files.units import LENGTH_UNITS
from vio.geometry.lie import FloatArray

__all__ = ["SUFFIX", "matches", "read", "read_mat"]

_FIRST = "CameraParameters1"
_SECOND = "CameraParameters2"
_OF_BOUGUET = (
    *("fc_left", "cc_left", "kc_left", "alpha_c_left"),
    *("fc_right", "cc_right", "kc_right", "alpha_c_right"),
    *("R", "T", "nx", "ny"),
)
_MAX_BYTES = 50_000_000  # with the points of all views
_LARGEST = 100  # elements of a variable of a calibration, of which a structure is one
_DEPTH = 5  # of structures within one another, at which cameras are looked for
_SHORT_M = 0.005  # no stereo camera has a shorter baseline


def read_mat(path: Path) -> dict[str, object]:
    """Read what a MATLAB file holds of a stereo calibration; nothing where it is another file.

    Raises:
        DataError: it cannot be read, or holds objects, which MATLAB alone reads.
    """
    if path.stat().st_size > _MAX_BYTES:
        return {}
    _, found = read_variables(path, _of_calibration, plain=True)
    entries = {name: _plain(value) for name, value in found.items()}
    return {name: value for name, value in entries.items() if value is not None}


def _of_calibration(shapes: Shapes) -> Collection[str]:
    """Return the variables that may be those of a calibration: of MATLAB's, structures, whatever
    they hold, and no arrays of a recording.
    """
    if "fc_left" in shapes and "fc_right" in shapes:
        return _OF_BOUGUET
    return [name for name, shape in shapes.items() if math.prod(shape) <= _LARGEST]


def _plain(value: object) -> object:
    """Return numbers, text, and structures of these as JSON has them; None: it is another value."""
    if isinstance(value, Mapping):
        return {str(name): _plain(part) for name, part in value.items()}
    if isinstance(value, np.ndarray) and value.dtype.kind in "fiub":
        return value.tolist()
    return value if isinstance(value, (str, int, float)) else None


def matches(entries: Entries) -> bool:
    """Return whether entries are those of a stereo calibration of MATLAB's."""
    return _parameters(entries) is not None or _is_of_bouguet(entries)


def _is_of_bouguet(entries: Entries) -> bool:
    return all(f"{name}_{side}" in entries for name in ("fc", "cc") for side in ("left", "right"))


def _parameters(entries: Entries) -> Mapping[str, Any] | None:
    """Return the structure of both cameras, which may be one of the entries, or within one of them;
    None: there is none.
    """
    level: list[Mapping[str, Any]] = [entries]
    for _ in range(_DEPTH):
        found = next((item for item in level if _FIRST in item), None)
        if found is not None:
            return found
        level = [value for item in level for value in item.values() if isinstance(value, dict)]
    return None


def read(source: Source) -> Rig:
    """Read the pair.

    Raises:
        CalibrationError: an entry is missing or impossible, or its unit is not read.
    """
    where = source.where
    parameters = _parameters(source.entries)
    if parameters is None:
        entries = _of_bouguet(source.entries, where)
        unit = "mm"
    else:
        entries = _of_matlab(parameters, where)
        unit = str(_unit(parameters))
    factor = LENGTH_UNITS.get(unit.lower())
    if factor is None:
        raise CalibrationError(
            f"{where}: states lengths in {unit!r}, which is not read; calibrate with a board in metres "
            "or millimetres"
        )
    T = matrix(entries["T"], (3, 1), f"{where}, translation of camera 2")
    entries["T"] = (factor * T).tolist()
    rig = rig_from_opencv(entries, where, source.image_size)
    return rig.noting(*_notes(rig, unit, factor, where))


def _unit(parameters: Mapping[str, Any]) -> object:
    """Return the unit of lengths that is stated, else MATLAB's own."""
    return parameters.get("WorldUnits") or parameters[_FIRST].get("WorldUnits") or "mm"


def _notes(rig: Rig, unit: str, factor: float, where: str) -> tuple[str, ...]:
    """Return that lengths were converted, and whether that seems wrong."""
    baseline_m = float(np.linalg.norm(rig.right[1][:3, 3]))
    if factor == 1.0:
        return ()
    if baseline_m < _SHORT_M:
        return (
            f"{where}: doubtful: its lengths are in {unit}, which puts the cameras {baseline_m:.3g} m "
            "apart; where the board was measured in metres, state WorldUnits 'm' (MATLAB takes "
            "millimetres where none is given), or all lengths of the run will be too short",
        )
    return (f"{where}: lengths are in {unit}; the cameras are {baseline_m:.4g} m apart",)


def _of_matlab(parameters: Mapping[str, Any], where: str) -> dict[str, object]:
    """Return the entries of OpenCV's form of `stereoParameters`."""
    entries: dict[str, object] = {}
    for k, name in enumerate((_FIRST, _SECOND), start=1):
        camera = section(parameters, name, where)
        place = f"{where}, {name}"
        entries[f"K{k}"] = _pixels(camera, place).tolist()
        radial = matrix(camera.get("RadialDistortion"), None, f"{place}, RadialDistortion").ravel()
        tangential = camera.get("TangentialDistortion") or [0.0, 0.0]
        p1, p2 = matrix(tangential, (1, 2), f"{place}, TangentialDistortion")[0]
        k1, k2, k3 = [*radial, 0.0, 0.0, 0.0][:3]
        entries[f"D{k}"] = [k1, k2, p1, p2, k3]
        if camera.get("ImageSize"):
            height, width = matrix(camera["ImageSize"], (1, 2), f"{place}, ImageSize")[0]
            entries |= {"image_width": width, "image_height": height}
    pose = parameters.get("PoseCamera2")
    if isinstance(pose, dict):
        entries |= {"R": pose.get("R"), "T": pose.get("Translation")}
    else:
        R = matrix(parameters.get("RotationOfCamera2"), (3, 3), f"{where}, RotationOfCamera2")
        entries |= {"R": R.T.tolist(), "T": parameters.get("TranslationOfCamera2")}
    return entries


def _pixels(camera: Mapping[str, Any], where: str) -> FloatArray:
    """Return the matrix of pixels (3, 3) of which the first is (0, 0)."""
    if "K" in camera:
        K = matrix(camera["K"], (3, 3), f"{where}, K")
    else:
        K = matrix(camera.get("IntrinsicMatrix"), (3, 3), f"{where}, IntrinsicMatrix").T
    return K - [[0.0, 0.0, 1.0], [0.0, 0.0, 1.0], [0.0, 0.0, 0.0]]


def _of_bouguet(found: Entries, where: str) -> dict[str, object]:
    """Return the entries of OpenCV's form of the toolbox's results."""
    entries: dict[str, object] = {name: found.get(name) for name in ("R", "T")}
    for k, side in enumerate(("left", "right"), start=1):
        fc, cc = (
            matrix(found[f"{name}_{side}"], (1, 2), f"{where}, {name}_{side}")[0]
            for name in ("fc", "cc")
        )
        alpha = found.get(f"alpha_c_{side}", 0.0)
        skew = matrix([alpha], (1, 1), f"{where}, alpha_c_{side}")[0, 0] * fc[0]
        entries[f"K{k}"] = [[fc[0], skew, cc[0]], [0.0, fc[1], cc[1]], [0.0, 0.0, 1.0]]
        entries[f"D{k}"] = found.get(f"kc_{side}", [0.0] * 5)
    if "nx" in found and "ny" in found:
        entries |= {"image_width": found["nx"], "image_height": found["ny"]}
    return entries
