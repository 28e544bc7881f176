"""A picture of a coloured surface, without a graphics card."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from vio.dense.surface import Mesh
from vio.geometry.lie import FloatArray
from vio.records import Image


@dataclass(frozen=True, slots=True)
class _View:
    """The picture of a mesh, and where it is seen from."""

    width: int = 1280
    height: int = 720
    focal: float = 1.1  # widths
    pitch_deg: float = 40.0  # that the view looks down, and to the left of the path
    aside_deg: float = 60.0
    background: int = 245
    away: float = 0.1  # surfaces that face away by more than this are culled
    share_seen: float = 0.98  # of the vertices that are to be in the picture


_VIEW = _View()


def preview(mesh: Mesh, path_m: FloatArray, R_upright_world: FloatArray, voxel_m: float) -> Image:
    """Return a picture (720, 1280, 3) from above and behind, with the path (N, 3) in red.

    Args:
        mesh: the surface.
        path_m: (N, 3) of the camera.
        R_upright_world: (3, 3) whose rows are right, ahead and up.
        voxel_m: size of the squares that stand for the vertices.
    """
    p, n = (x.astype(np.float64) @ R_upright_world.T for x in (mesh.vertices, mesh.normals))
    path = path_m @ R_upright_world.T
    axes = _view(path[-1, :2] - path[0, :2])
    facing = (
        n @ axes[2] < _VIEW.away
    )  # so that neither a ceiling nor the nearest wall hides the rest
    line = _along(path, voxel_m)
    light = 0.65 + 0.35 * np.abs(n @ np.array([-0.3, -0.5, 0.81]))
    points = np.concatenate([p[facing], line])
    colours = np.concatenate(
        [(mesh.colours * light[:, None])[facing], np.tile([220.0, 30.0, 30.0], (len(line), 1))]
    )
    size_m = voxel_m * np.repeat([1.6, 2.0], [int(facing.sum()), len(line)])
    return _splat(points @ axes.T, colours, size_m, len(line))


def _view(course: FloatArray) -> FloatArray:
    """Return right, down and ahead (3, 3) of a view down on a path that leads along (2,)."""
    heading = np.arctan2(course[0], course[1]) - np.radians(_VIEW.aside_deg)
    pitch = np.radians(_VIEW.pitch_deg)
    right = np.array([np.cos(heading), -np.sin(heading), 0.0])
    ahead = np.array(
        [np.cos(pitch) * np.sin(heading), np.cos(pitch) * np.cos(heading), -np.sin(pitch)]
    )
    return np.stack([right, np.cross(ahead, right), ahead])


def _along(path: FloatArray, step_m: float) -> FloatArray:
    """Return points at most a step apart along a path (N, 3)."""
    steps_m = np.linalg.norm(np.diff(path, axis=0), axis=1)
    lengths = np.concatenate([[0.0], np.cumsum(steps_m)])
    count = min(int(lengths[-1] / step_m) + 2, 200_000)
    at = np.linspace(0.0, lengths[-1], count)
    return np.stack([np.interp(at, lengths, path[:, k]) for k in range(3)], axis=1)


def _splat(q: FloatArray, colours: FloatArray, size_m: FloatArray, inside: int) -> Image:
    """Draw squares (N) at (N, 3) right, down and ahead, far ones first; the last `inside` are in
    the picture.
    """
    image = np.full((_VIEW.height, _VIEW.width, 3), _VIEW.background, dtype=np.uint8)
    low, high = np.quantile(q, (0.02, 0.98), axis=0)
    q = q - (low + high) / 2
    focal = _VIEW.focal * _VIEW.width
    # As near as leaves most of the points in the picture.
    near = (
        np.maximum(
            np.abs(q[:, 0]) * 2 * focal / _VIEW.width, np.abs(q[:, 1]) * 2 * focal / _VIEW.height
        )
        - q[:, 2]
    )
    q[:, 2] += max(
        float(np.quantile(near, _VIEW.share_seen)), float(near[len(near) - inside :].max())
    )
    order = np.argsort(-q[:, 2])
    q = q[order]
    colours = colours[order]
    size_m = size_m[order]
    ahead_of = q[:, 2] > 1e-3
    q = q[ahead_of]
    colours = colours[ahead_of]
    size_m = size_m[ahead_of]
    depth = q[:, 2]
    u = np.rint(focal * q[:, 0] / depth + _VIEW.width / 2).astype(int)
    v = np.rint(focal * q[:, 1] / depth + _VIEW.height / 2).astype(int)
    half_px = 0.5 * focal * size_m / depth
    reach = np.clip(np.ceil(half_px).astype(int), 0, 12)
    in_columns = (u >= 0) & (u < _VIEW.width)
    in_rows = (v >= 0) & (v < _VIEW.height)
    shown = in_columns & in_rows
    for row in np.flatnonzero(shown).tolist():
        r = reach[row]
        rows = slice(max(v[row] - r, 0), v[row] + r + 1)
        columns = slice(max(u[row] - r, 0), u[row] + r + 1)
        image[rows, columns] = colours[row]
    return image
