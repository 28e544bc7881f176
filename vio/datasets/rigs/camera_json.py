"""One camera as JSON: Open3D's intrinsics and the Replica recordings' `cam_params.json`.

Open3D: `width`, `height` and `intrinsic_matrix`, the nine numbers column by column, in a block
`intrinsic` where the pose is beside it. Replica, as rendered for NICE-SLAM: a block `camera` with
`w h fx fy cx cy` in pixels and `scale`, the levels of a depth image per metre. Neither has a
distortion.
Reference: Open3D's PinholeCameraIntrinsic; Zhu et al., NICE-SLAM (2022), its data.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from vio.cameras.rig import Rig, camera_from_matrix
from vio.datasets.common import image_size, naming
from vio.datasets.rigs.plausible import checked_rig
from vio.datasets.rigs.source import Source
from vio.datasets.yaml_files import Entries, matrix, numbers
from vio.geometry.stereo import intrinsic_matrix

REPLICA = "cam_params.json"
_OF_REPLICA = {"w", "h", "fx", "fy", "cx", "cy"}
_OF_OPEN3D = {"width", "height", "intrinsic_matrix"}


def matches(entries: Entries) -> bool:
    """Return whether entries are those of one camera in either form."""
    return _block(entries, "camera", _OF_REPLICA) is not None or _open3d(entries) is not None


def read(source: Source) -> Rig:
    """Read the camera.

    Raises:
        CalibrationError: an entry is malformed or impossible.
    """
    where = source.where
    factor = None
    if (block := _open3d(source.entries)) is not None:
        K = matrix(block["intrinsic_matrix"], (3, 3), f"{where}, intrinsic_matrix").T
        names = ("width", "height")
    else:
        block = _block(source.entries, "camera", _OF_REPLICA)
        assert block is not None
        K = intrinsic_matrix(
            *(numbers(block, key, where, 1)[0] for key in ("fx", "fy", "cx", "cy"))
        )
        names = ("w", "h")
        if "scale" in block:
            factor = numbers(block, "scale", where, 1)[0]
    size = image_size([numbers(block, key, where, 1)[0] for key in names], where)
    with naming(where):
        return checked_rig(Rig(camera_from_matrix(K, *size), depth_factor=factor), where)


def _open3d(entries: Entries) -> Mapping[str, Any] | None:
    if entries.keys() >= _OF_OPEN3D:
        return entries
    return _block(entries, "intrinsic", _OF_OPEN3D)


def _block(entries: Entries, name: str, keys: set[str]) -> Mapping[str, Any] | None:
    block = entries.get(name)
    return block if isinstance(block, dict) and block.keys() >= keys else None
