"""`calibration.json` of Spectacular AI's SDK, which `vio convert --to spectacularai` writes as well.

`imuToCamera`, 4 x 4, maps coordinates of the IMU to a camera; metres. Lens models: `pinhole`,
`brown-conrady` (OpenCV's k1 k2 p1 p2 k3 k4 k5 k6) and `kannala-brandt4`.
Reference: the SDK's documentation, calibration.json.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from vio.cameras.rig import Rig
from vio.datasets.common import image_size, naming
from vio.datasets.rigs.plausible import checked_rig
from vio.datasets.rigs.source import ImuSheet, Source, first_cameras, no_image_size, rig_of_poses
from vio.datasets.yaml_files import Entries, matrix, numbers
from vio.errors import CalibrationError
from vio.geometry.distortion import CameraModel, DistortionModel, simplest_lens
from vio.geometry.lie import FloatArray, checked_transform, se3_inverse

_LENSES: dict[str, DistortionModel] = {
    "pinhole": "pinhole",
    "brown-conrady": "radtan",
    "kannala-brandt4": "equidistant",
}


def matches(entries: Entries) -> bool:
    """Return whether entries are those of the SDK's cameras."""
    cameras = entries.get("cameras")
    return isinstance(cameras, list) and any(
        isinstance(item, dict) and "focalLengthX" in item for item in cameras
    )


def read(source: Source) -> Rig:
    """Read the first two cameras, or the only one.

    Raises:
        CalibrationError: an entry is missing or impossible, or a lens model is not read.
    """
    where = source.where
    items: list[Any] = source.entries["cameras"]  # type: ignore[assignment]
    read_items = first_cameras(items, where)
    cameras = [_camera(item, source, f"{where}, camera {k}") for k, item in enumerate(read_items)]
    poses = [_pose(item, f"{where}, camera {k}") for k, item in enumerate(read_items)]
    rig = rig_of_poses(cameras, poses, where, ImuSheet(), count=len(items))
    return checked_rig(rig, where)


def _camera(item: Mapping[str, Any], source: Source, where: str) -> CameraModel:
    name = str(item.get("model", "pinhole")).lower()
    if name not in _LENSES:
        raise CalibrationError(
            f"{where}: the lens model {name!r} is not read; known: {', '.join(_LENSES)}"
        )
    model = _LENSES[name]
    given = item.get("distortionCoefficients") or []
    bend = numbers({"distortionCoefficients": given}, "distortionCoefficients", where)
    if model == "pinhole" and any(bend):
        raise CalibrationError(f"{where}: states coefficients, which a pinhole does not have")
    model, bend = simplest_lens(model, () if model == "pinhole" else bend)
    fu, fv, cu, cv = (
        numbers(item, key, where, 1)[0]
        for key in ("focalLengthX", "focalLengthY", "principalPointX", "principalPointY")
    )
    if "imageWidth" in item and "imageHeight" in item:
        size = [numbers(item, key, where, 1)[0] for key in ("imageWidth", "imageHeight")]
        width, height = image_size(size, where)
    elif source.image_size is not None:
        width, height = source.image_size
    else:
        raise no_image_size(source.path)
    with naming(where):
        return CameraModel(fu, fv, cu, cv, width, height, model, bend)


def _pose(item: Mapping[str, Any], where: str) -> FloatArray:
    """Return the transform (4, 4) from a camera to the IMU."""
    T = matrix(item.get("imuToCamera"), (4, 4), f"{where}, imuToCamera")
    return se3_inverse(checked_transform(T, f"{where}, imuToCamera"))
