"""Coloured meshes and points as PLY and binary glTF, and occupancy grids as ROS maps."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from vio.geometry.lie import FloatArray

R_GLTF_UPRIGHT = np.array(
    [
        [1.0, 0, 0],
        [0, 0, 1],
        [0, -1, 0],
    ]
)  # glTF's axes: right, up, back
_PLY_NAMES = {"<f4": "float", "u1": "uchar"}
_GLTF_KINDS = {"float32": 5126, "uint32": 5125, "uint8": 5121}  # componentType of the specification
_ARRAY = 34962  # bufferView.target
_INDICES = 34963
FREE = 254  # gray levels of ROS's map_server
OCCUPIED = 0
UNKNOWN = 205


def ply_points(
    points: npt.NDArray[Any],
    colours: npt.NDArray[np.uint8] | None,
    normals: npt.NDArray[Any] | None = None,
    triangles: npt.NDArray[np.uint32] | None = None,
) -> bytes:
    """Return points (N, 3) as a binary PLY: x y z in metres, normals where given, red green blue,
    and triangles (T, 3).

    Points without colours are black.
    """
    fields = [(name, "<f4") for name in (*"xyz", *(() if normals is None else ("nx", "ny", "nz")))]
    rows = np.zeros(
        len(points), dtype=[*fields, *((name, "u1") for name in ("red", "green", "blue"))]
    )
    if normals is None:
        columns = points
    else:
        columns = np.concatenate([points, normals], axis=1)
    for (name, _), column in zip(fields, columns.T, strict=True):
        rows[name] = column
    if colours is not None:
        rows["red"], rows["green"], rows["blue"] = colours.T
    header = [
        f"element vertex {len(rows)}",
        *(f"property {_PLY_NAMES[kind]} {name}" for name, kind in fields),
    ]
    header += [f"property uchar {name}" for name in ("red", "green", "blue")]
    faces = b""
    if triangles is not None:
        header += [f"element face {len(triangles)}", "property list uchar int vertex_indices"]
        listed = np.zeros(len(triangles), dtype=[("count", "u1"), ("corners", "<i4", 3)])
        listed["count"] = 3
        listed["corners"] = triangles
        faces = listed.tobytes()
    text = "\n".join(["ply", "format binary_little_endian 1.0", *header, "end_header"])
    return f"{text}\n".encode("ascii") + rows.tobytes() + faces


def glb_mesh(
    points: npt.NDArray[np.float32],
    normals: npt.NDArray[np.float32],
    colours: npt.NDArray[np.uint8],
    triangles: npt.NDArray[np.uint32],
    R_upright_world: FloatArray,
) -> bytes:
    """Return a mesh as binary glTF 2.0, turned so that y is up, with its colours as they are
    (unlit).

    Args:
        points: (V, 3) metres.
        normals: (V, 3).
        colours: (V, 3).
        triangles: (T, 3).
        R_upright_world: (3, 3) whose rows are right, ahead and up.
    """
    to_gltf = R_GLTF_UPRIGHT @ R_upright_world
    opaque = np.full((len(colours), 1), 255, dtype=np.uint8)
    shown = points @ to_gltf.T.astype(np.float32)
    low = shown.min(axis=0).tolist()
    high = shown.max(axis=0).tolist()
    turned = normals @ to_gltf.T.astype(np.float32)
    rgba = np.concatenate([colours, opaque], axis=1)
    arrays: list[tuple[npt.NDArray[Any], str, dict[str, Any]]] = [
        (shown, "VEC3", {"min": low, "max": high}),
        (turned, "VEC3", {}),
        (rgba, "VEC4", {"normalized": True}),
        (triangles.ravel(), "SCALAR", {}),
    ]
    views = []
    accessors = []
    data = b""
    for number, (array, kind, more) in enumerate(arrays):
        part = np.ascontiguousarray(array).tobytes()
        target = _INDICES if kind == "SCALAR" else _ARRAY
        views.append(
            {"buffer": 0, "byteOffset": len(data), "byteLength": len(part), "target": target}
        )
        component = _GLTF_KINDS[array.dtype.name]
        accessors.append(
            {
                "bufferView": number,
                "componentType": component,
                "count": len(array),
                "type": kind,
                **more,
            }
        )
        data += part + b"\0" * (-len(part) % 4)
    attributes = {"POSITION": 0, "NORMAL": 1, "COLOR_0": 2}
    document = {
        "asset": {"version": "2.0", "generator": "stereo-vio"},
        "extensionsUsed": ["KHR_materials_unlit"],
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "materials": [{"doubleSided": True, "extensions": {"KHR_materials_unlit": {}}}],
        "meshes": [{"primitives": [{"attributes": attributes, "indices": 3, "material": 0}]}],
        "accessors": accessors,
        "bufferViews": views,
        "buffers": [{"byteLength": len(data)}],
    }
    text = json.dumps(document).encode("ascii")
    text += b" " * (-len(text) % 4)
    chunks = b"".join(
        np.array([len(part), kind], dtype="<u4").tobytes() + part
        for part, kind in ((text, 0x4E4F534A), (data, 0x004E4942))  # "JSON", "BIN"
    )
    return b"glTF" + np.array([2, 12 + len(chunks)], dtype="<u4").tobytes() + chunks


def write_ros_map(
    folder: Path, name: str, levels: npt.NDArray[np.uint8], cell_m: float, origin_m: FloatArray
) -> None:
    """Write NAME.pgm and NAME.yaml of map_server and Nav2.

    Args:
        folder: exists.
        name: of both files, without suffix.
        levels: (H, W) FREE, OCCUPIED or UNKNOWN; row 0 has the smallest y.
        cell_m: edge of a cell.
        origin_m: (2,) x and y of the corner of cell (0, 0).
    """
    height, width = levels.shape
    header = f"P5\n{width} {height}\n255\n".encode("ascii")
    (folder / f"{name}.pgm").write_bytes(header + np.ascontiguousarray(levels[::-1]).tobytes())
    text = (
        f"image: {name}.pgm\nmode: trinary\nresolution: {cell_m:g}\n"
        f"origin: [{origin_m[0]:.6g}, {origin_m[1]:.6g}, 0.0]\n"
        "negate: 0\noccupied_thresh: 0.65\nfree_thresh: 0.196\n"
    )
    (folder / f"{name}.yaml").write_text(text, encoding="utf-8")
