"""BoofCV's stereo calibration in XML (`stereo.xml`): pinhole with radial distortion,
`rightToLeft` in metres.
"""

from __future__ import annotations

from pathlib import Path
from xml.etree import ElementTree

import numpy as np

from vio.cameras.rig import Rig, camera_from_matrix
from vio.datasets.common import image_size, naming
from vio.datasets.rigs.opencv import read_xml
from vio.datasets.yaml_files import as_number
from vio.errors import CalibrationError
from vio.geometry.distortion import CameraModel
from vio.geometry.lie import FloatArray, checked_transform, se3_inverse

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
    R = _numbers(
        [d.text for d in _child(_child(pose, "r", path), "data", path)], 9, f"{path}, r"
    ).reshape(3, 3)
    t = _numbers([_child(pose, "t", path).findtext(axis) for axis in "xyz"], 3, f"{path}, t")
    T_cam0_cam1 = checked_transform(np.column_stack([R, t]), f"{path}, rightToLeft")
    with naming(path):
        return Rig(cam0, cam1, se3_inverse(T_cam0_cam1))


def _camera(block: ElementTree.Element, where: str) -> CameraModel:
    fx, fy, cx, cy, skew, width, height = _numbers(
        [block.findtext(name) for name in ("fx", "fy", "cx", "cy", "skew", "width", "height")],
        7,
        where,
    )
    radial = [d.text for d in block.findall("radial/double")]
    k = [*_numbers(radial, len(radial), f"{where}, radial"), 0.0, 0.0, 0.0][:3]
    t1, t2 = (as_number(block.findtext(name) or 0.0) for name in ("t1", "t2"))
    # BoofCV's tangential terms are x += 2 t1 x y + t2 (r^2 + 2 x^2), as OpenCV's p1, p2.
    coefficients = (k[0], k[1], t1, t2, k[2]) if k[2] else (k[0], k[1], t1, t2)
    with naming(where):
        K = np.array([[fx, skew, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
        return camera_from_matrix(K, *image_size([width, height], where), "radtan", coefficients)


def _child(parent: ElementTree.Element, name: str, path: Path) -> ElementTree.Element:
    found = parent.find(name)
    if found is None:
        raise CalibrationError(
            f"{path}: has no entry <{name}> in <{parent.tag}>; copy the calibration again"
        )
    return found


def _numbers(texts: list[str | None], count: int, where: str) -> FloatArray:
    values = np.array([as_number(text) for text in texts])
    if len(values) != count or not np.isfinite(values).all():
        raise CalibrationError(
            f"{where}: expected {count} finite numbers; copy the calibration again"
        )
    return values
