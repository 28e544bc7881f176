"""BoofCV's stereo calibration in XML or YAML (`stereo.xml`, `stereo.yaml`): pinhole with radial and
tangential distortion; `rightToLeft` maps coordinates of the right camera to the left one, in the unit
of the target, which the file does not state.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from vio.cameras.rig import Rig, camera_from_matrix
from vio.datasets.common import image_size, naming
from vio.datasets.rigs.opencv import read_xml
from vio.datasets.rigs.plausible import checked_rig, unit_doubt
from vio.datasets.rigs.source import Source
from vio.datasets.yaml_files import Entries, as_number, matrix, numbers, section
from vio.errors import CalibrationError
from vio.geometry.distortion import CameraModel
from vio.geometry.lie import FloatArray, checked_transform, se3_inverse

if TYPE_CHECKING:
    from xml.etree import ElementTree

_ROOT = "StereoParameters"


def is_boofcv(path: Path) -> bool:
    """Return whether an XML file is BoofCV's."""
    return read_xml(path).tag.endswith(_ROOT)


def read_boofcv(path: Path) -> Rig:
    """Read BoofCV's XML; `rightToLeft` maps coordinates of the right camera to the left one.

    Raises:
        CalibrationError: an entry is missing or impossible.
    """
    root = read_xml(path)
    cam0, cam1 = (
        _camera(_child(root, name, path), f"{path}, {name}") for name in ("left", "right")
    )
    pose = _child(root, "rightToLeft", path)
    turn = _child(_either(pose, "R", "r", path), "data", path)
    # elements, or one text of numbers
    texts = [d.text for d in turn] or list[str | None]((turn.text or "").replace(",", " ").split())
    R = _numbers(texts, 9, f"{path}, R").reshape(3, 3)
    shift = _either(pose, "T", "t", path)
    t = _numbers([shift.findtext(axis) for axis in "xyz"], 3, f"{path}, T")
    T_cam0_cam1 = checked_transform(np.column_stack([R, t]), f"{path}, rightToLeft")
    with naming(path):
        rig = checked_rig(Rig(cam0, cam1, se3_inverse(T_cam0_cam1)), path)
    doubt = unit_doubt(float(np.linalg.norm(t)), path)
    return rig if doubt is None else rig.noting(doubt)


def _camera(block: ElementTree.Element, where: str) -> CameraModel:
    fx, fy, cx, cy, skew, width, height = _numbers(
        [block.findtext(name) for name in ("fx", "fy", "cx", "cy", "skew", "width", "height")],
        7,
        where,
    )
    radial = [d.text for d in block.findall("radial/double")]
    k = [*_numbers(radial, len(radial), f"{where}, radial"), 0.0, 0.0, 0.0][:3]
    t1, t2 = (as_number(block.findtext(name) or 0.0) for name in ("t1", "t2"))
    coefficients = _coefficients(k, t1, t2)
    with naming(where):
        K = np.array([[fx, skew, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
        return camera_from_matrix(K, *image_size([width, height], where), "radtan", coefficients)


def _coefficients(radial: Sequence[float], t1: float, t2: float) -> tuple[float, ...]:
    """Return OpenCV's k1, k2, p1, p2 and, where it is not zero, k3.

    BoofCV's tangential terms are x += 2 t1 x y + t2 (r^2 + 2 x^2), as OpenCV's p1, p2.
    """
    k1, k2, k3 = radial
    if k3:
        return (k1, k2, t1, t2, k3)
    return (k1, k2, t1, t2)


def _child(parent: ElementTree.Element, name: str, path: Path) -> ElementTree.Element:
    found = parent.find(name)
    if found is None:
        raise CalibrationError(
            f"{path}: has no entry <{name}> in <{parent.tag}>; copy the calibration again"
        )
    return found


def _either(parent: ElementTree.Element, name: str, older: str, path: Path) -> ElementTree.Element:
    """Return a child of a name that BoofCV's versions write in capitals and in small letters."""
    return _child(parent, name if parent.find(name) is not None else older, path)


def _numbers(texts: list[str | None], count: int, where: str) -> FloatArray:
    values = np.array([as_number(text) for text in texts])
    if len(values) != count or not np.isfinite(values).all():
        raise CalibrationError(
            f"{where}: expected {count} finite numbers; copy the calibration again"
        )
    return values


# --- YAML, of BoofCV since 0.26
# ------------------------------------------------------------------------------------------------


def matches(entries: Entries) -> bool:
    """Return whether entries are those of BoofCV's stereo calibration in YAML."""
    return "rightToLeft" in entries and "left" in entries and "right" in entries


def read(source: Source) -> Rig:
    """Read BoofCV's YAML, whose lengths are in the unit that the target was described in.

    Raises:
        CalibrationError: an entry is missing or impossible.
    """
    where = source.where
    cam0, cam1 = (_camera_of_yaml(source, side) for side in ("left", "right"))
    pose = section(source.entries, "rightToLeft", where)
    R = matrix(pose.get("rotation"), (3, 3), f"{where}, rotation")
    t = np.array([numbers(pose, axis, where, 1)[0] for axis in "xyz"])
    T_cam0_cam1 = checked_transform(np.column_stack([R, t]), f"{where}, rightToLeft")
    with naming(where):
        rig = checked_rig(Rig(cam0, cam1, se3_inverse(T_cam0_cam1)), where)
    doubt = unit_doubt(float(np.linalg.norm(t)), where)
    return rig if doubt is None else rig.noting(doubt)


def _camera_of_yaml(source: Source, side: str) -> CameraModel:
    where = f"{source.where}, {side}"
    block = section(source.entries, side, source.where)
    pinhole = section(block, "pinhole", where)
    names = ("fx", "fy", "cx", "cy", "skew", "width", "height")
    fx, fy, cx, cy, skew, *size = (numbers(pinhole, name, where, 1)[0] for name in names)
    bend = block.get("radial_tangential")
    bend = bend if isinstance(bend, dict) else {}
    if bend.get("radial"):
        k = [*numbers(bend, "radial", where), 0.0, 0.0, 0.0][:3]
    else:
        k = [0.0] * 3
    t1, t2 = (as_number(bend.get(name) or 0.0) for name in ("t1", "t2"))
    with naming(where):
        K = np.array([[fx, skew, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
        D = _coefficients(k, t1, t2)
        return camera_from_matrix(K, *image_size(size, where), "radtan", D)
