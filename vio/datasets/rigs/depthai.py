"""DepthAI's calibration of an OAK camera in JSON, as its EEPROM holds it and its tools write it.

Each camera's `extrinsics` map its coordinates to those of the camera `toCameraSocket`, translation
in centimetres. The pair may be linked through a third camera. Left and right are the sockets of
`stereoRectificationData`, else 1 and 2 (CAM_B, CAM_C). Where these links put the right camera on the
left one's left, they are read the other way round, and this is said. Distortion: OpenCV's rational
model, or its fisheye one (`cameraType` 1). `imuExtrinsics` map coordinates of the IMU to its
`toCameraSocket`; without a rotation there is none.

Images of the stated size's width and height times one factor are those that the device scales: the
intrinsics are scaled with them.
Reference: DepthAI's CalibrationHandler (`getCameraExtrinsics`, `getCameraIntrinsics`).
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, TypeAlias

import numpy as np

from vio.cameras.rig import Rig, camera_from_matrix
from vio.datasets.common import image_size, naming
from vio.datasets.rigs.opencv import coefficients_of
from vio.datasets.rigs.plausible import checked_rig
from vio.datasets.rigs.source import Size, Source
from vio.datasets.yaml_files import Entries, as_number, matrix, numbers, section, tool_lens
from vio.errors import CalibrationError
from vio.geometry.distortion import CameraModel
from vio.geometry.lie import FloatArray, checked_transform, se3_from_parts, se3_inverse

_CM = 0.01  # metres
_LEFT = 1  # sockets where none are stated
_RIGHT = 2
_NO_SOCKET = 255  # as a byte has -1
_IMU = "imu"  # in the place of its socket
# of `cameraType`, by its number
_TYPES = ("perspective", "fisheye", "equirectangular", "radial division", "cylindrical")
_SAME_SCALE = 0.01
Blocks = Mapping[int, Mapping[str, Any]]
Links: TypeAlias = dict[tuple[int | str, int | str], FloatArray]


def matches(entries: Entries) -> bool:
    """Return whether entries are those of a calibration by DepthAI."""
    return "cameraData" in entries


def read(source: Source) -> Rig:
    """Read the stereo pair.

    Raises:
        CalibrationError: an entry is missing or impossible, or nothing links the two cameras.
    """
    where = source.where
    blocks = _blocks(source.entries, where)
    stereo = source.entries.get("stereoRectificationData")
    stated = stereo if isinstance(stereo, dict) else {}
    left = _socket(stated.get("leftCameraSocket"), _LEFT)
    right = _socket(stated.get("rightCameraSocket"), _RIGHT)
    cameras = []
    for socket in (left, right):
        if socket not in blocks:
            raise CalibrationError(f"{where}: holds no camera of socket {socket}")
        cameras.append(_camera(blocks[socket], source.image_size, f"{where}, socket {socket}"))
    imu = source.entries.get("imuExtrinsics")
    links = _links(blocks, imu, where)
    T_right_left = _through(links, right, left)
    if T_right_left is None:
        raise CalibrationError(f"{where}: no extrinsics link the sockets {left} and {right}")
    notes: tuple[str, ...] = ()
    if T_right_left[0, 3] > 0:  # the right camera would be on the left
        links = {ends: se3_inverse(T) for ends, T in links.items()}
        T_right_left = _through(links, right, left)
        notes = (
            f"{where}: doubtful: its extrinsics put socket {right} on the left of socket {left}; "
            "they are read the other way round; if the sockets are exchanged instead, exchange the "
            "images",
        )
    T_left_imu = _through(links, left, _IMU)
    with naming(where):
        rig = Rig(cameras[0], cameras[1], T_right_left, T_left_imu, notes=notes)
    return checked_rig(rig, where)


def _blocks(entries: Entries, where: str) -> Blocks:
    """Return the cameras by socket; JSON has pairs of a socket and a camera, or an object."""
    data = entries["cameraData"]
    items = list(data.items()) if isinstance(data, dict) else data
    found = {}
    for item in items if isinstance(items, list) else []:
        if isinstance(item, (list, tuple)) and len(item) == 2 and isinstance(item[1], dict):
            found[_socket(item[0], -1)] = item[1]
    if not found:
        raise CalibrationError(
            f"{where}: cameraData holds no camera: this part of the device's memory was never "
            "written; take the factory's calibration (readFactoryCalibration), or calibrate the "
            "device"
        )
    return found


def _socket(value: object, default: int) -> int:
    """Return a socket by its number or name (CAM_B); -1 stands for none."""
    if isinstance(value, str) and value.upper().startswith("CAM_") and len(value) == 5:
        return ord(value[-1].upper()) - ord("A")
    number = as_number(value)
    return int(number) if 0 <= number < _NO_SOCKET else default


def _camera(block: Mapping[str, Any], size: Size | None, where: str) -> CameraModel:
    stated = image_size([as_number(block.get(name)) for name in ("width", "height")], where)
    K = matrix(block.get("intrinsicMatrix"), (3, 3), f"{where}, intrinsicMatrix")
    D = numbers(block, "distortionCoeff", where) if block.get("distortionCoeff") else ()
    kind = as_number(block.get("cameraType", 0))
    name: Any
    if kind in range(len(_TYPES)):
        name = _TYPES[int(kind)]
    else:
        name = block.get("cameraType")
    model, _ = tool_lens("depthai", name, f"{where}, cameraType")
    used = stated
    if size is not None and size != stated:
        scales = np.array(size) / stated
        if abs(scales[0] / scales[1] - 1) < _SAME_SCALE:
            K = np.diag([*scales, 1.0]) @ K
            used = size
    with naming(where):
        return camera_from_matrix(K, *used, model, coefficients_of(model, D))


def _links(blocks: Blocks, imu: object, where: str) -> Links:
    """Return `T_to_from` (4, 4) by the sockets (to, from); the IMU has one of its own."""
    links: Links = {}
    extrinsics: dict[int | str, object] = {
        socket: block.get("extrinsics") for socket, block in blocks.items()
    }
    for socket, stated in {**extrinsics, _IMU: imu}.items():
        if not isinstance(stated, dict):
            continue
        to = _socket(stated.get("toCameraSocket"), -1)
        if to < 0 or to == socket or not np.any(stated.get("rotationMatrix") or 0):
            continue
        T = _transform(stated, f"{where}, socket {socket}, extrinsics")
        links[to, socket] = T
        links[socket, to] = se3_inverse(T)
    return links


def _transform(stated: Mapping[str, Any], where: str) -> FloatArray:
    R = matrix(stated.get("rotationMatrix"), (3, 3), f"{where}, rotationMatrix")
    shift = section(stated, "translation", where)
    t = np.array([numbers(shift, axis, where, 1)[0] for axis in "xyz"])
    return checked_transform(se3_from_parts(R, _CM * t), where)


def _through(links: Links, to: int | str, start: int | str) -> FloatArray | None:
    """Return `T_to_start` (4, 4) along the links; None: there is no way."""
    reached: dict[int | str, FloatArray] = {start: np.eye(4)}
    waiting = [start]
    while waiting:
        here = waiting.pop(0)
        for (there, origin), T in links.items():
            if origin == here and there not in reached:
                reached[there] = T @ reached[here]
                waiting.append(there)
    return reached.get(to)
