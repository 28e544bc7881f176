"""The surface of a signed distance function as triangles: naive surface nets.

Gibson, Constrained elastic surface nets, MICCAI 1998: one vertex in each cell that the surface
crosses, at the mean of its crossings of the cell's edges, and one quadrilateral for each crossed
edge of the lattice.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from vio.dense.voxel_grid import SIDE, VoxelGrid, pack
from vio.geometry.lie import FloatArray
from vio.numerics.compiled import compiled
from vio.records import IntArray

_MIN_SEEN = 3  # images that must show a sample
_MIN_TRIANGLES = 100  # of a connected piece; smaller ones are noise


@dataclass(frozen=True, slots=True)
class Mesh:
    """A coloured surface."""

    vertices: npt.NDArray[np.float32]  # (V, 3) metres
    normals: npt.NDArray[np.float32]  # (V, 3) unit length, towards where it was seen from
    colours: npt.NDArray[np.uint8]  # (V, 3) red, green, blue
    triangles: npt.NDArray[np.uint32]  # (T, 3) vertices, counter-clockwise from where it was seen


def extract_surface(grid: VoxelGrid, *, least_seen: int = _MIN_SEEN) -> Mesh:
    """Return the surface between samples that at least so many images show, without small loose
    pieces.
    """
    keys = []
    points = []
    colours = []
    quads = []
    blocks = grid.keys()
    for first, block in grid.padded():
        if not (block["seen"] >= least_seen).any():
            continue
        cell = np.empty((SIDE**3, 3), dtype=np.int64)
        point = np.empty((SIDE**3, 3), dtype=np.float32)
        colour = np.empty((SIDE**3, 3), dtype=np.uint8)
        quad = np.empty((3 * SIDE**3, 4, 3), dtype=np.int64)
        vertices, faces = _surface_nets(
            _Block(block["distance"], block["seen"], block["colour"]),
            least_seen,
            first,
            _Pieces(cell, point, colour, quad),
        )
        keys.append(_cell_keys(blocks, cell[:vertices]))
        points.append(grid.voxel_m * point[:vertices])
        colours.append(colour[:vertices].copy())
        quads.append(_cell_keys(blocks, quad[:faces].reshape(-1, 3)).reshape(-1, 4))
    if not any(map(len, quads)):
        none = np.zeros((0, 3), dtype=np.float32)
        return Mesh(none, none, none.astype(np.uint8), none.astype(np.uint32))
    key = np.concatenate(keys)
    order = np.argsort(key)
    corners = order[np.searchsorted(key[order], np.concatenate(quads))]
    triangles = np.concatenate([corners[:, [0, 1, 2]], corners[:, [0, 2, 3]]])
    return _tidied(np.concatenate(points).astype(np.float32), np.concatenate(colours), triangles)


def _cell_keys(blocks: IntArray, cells: IntArray) -> IntArray:
    """Return one whole number (N,) for cells (N, 3) of blocks with sorted keys (B,): by the place of
    the block, as the cells of a long drive are too many for `pack`.
    """
    inner = cells % SIDE
    block = np.searchsorted(blocks, pack(cells // SIDE))
    out: IntArray = ((block * SIDE + inner[:, 0]) * SIDE + inner[:, 1]) * SIDE + inner[:, 2]
    return out


def _tidied(
    points: npt.NDArray[np.float32], colours: npt.NDArray[np.uint8], triangles: IntArray
) -> Mesh:
    """Return the mesh without loose pieces and vertices of no triangle, with normals."""
    count = len(points)
    edges = triangles[:, :2]
    edges = np.concatenate([edges, triangles[:, 1:]])
    graph = coo_matrix(
        (np.ones(len(edges), dtype=np.bool_), (edges[:, 0], edges[:, 1])), shape=(count, count)
    )
    _, piece = connected_components(graph, directed=False)
    sizes = np.bincount(piece[triangles[:, 0]], minlength=int(piece.max()) + 1)
    triangles = triangles[sizes[piece[triangles[:, 0]]] >= _MIN_TRIANGLES]
    used = np.unique(triangles)
    place = np.zeros(count, dtype=np.int64)
    place[used] = np.arange(len(used))
    points = points[used]
    colours = colours[used]
    triangles = place[triangles]
    normals = _normals(points.astype(np.float64), triangles)
    return Mesh(points, normals.astype(np.float32), colours, triangles.astype(np.uint32))


def _normals(points: FloatArray, triangles: IntArray) -> FloatArray:
    """Return unit normals (V, 3) of vertices, of the adjacent triangles by their areas."""
    a, b, c = (points[triangles[:, k]] for k in range(3))
    area = np.cross(b - a, c - a)
    total = np.stack(
        [
            np.bincount(triangles.ravel(), np.repeat(area[:, k], 3), minlength=len(points))
            for k in range(3)
        ],
        axis=1,
    )
    out: FloatArray = total / np.maximum(np.linalg.norm(total, axis=1, keepdims=True), 1e-30)
    return out


class _Block(NamedTuple):
    """The samples of a block with a margin of one, as of `VoxelGrid.padded`."""

    distance: npt.NDArray[np.float32]
    seen: npt.NDArray[np.uint8]
    colour: npt.NDArray[np.uint8]


class _Pieces(NamedTuple):
    """Room for vertices and quadrilaterals."""

    cell: IntArray  # (V, 3)
    point: npt.NDArray[np.float32]  # (V, 3) voxels
    colour: npt.NDArray[np.uint8]  # (V, 3)
    quad: IntArray  # (Q, 4, 3) cells


@compiled
def _mark_whole(seen: npt.NDArray[np.uint8], least: int, whole: npt.NDArray[np.uint8]) -> None:
    """Write 1 for cells whose eight samples were all seen often enough, else 0."""
    side = len(seen)
    for i in range(side - 1):
        for j in range(side - 1):
            for k in range(side - 1):
                all_seen = True
                for corner in range(8):
                    if seen[i + (corner >> 2), j + ((corner >> 1) & 1), k + (corner & 1)] < least:
                        all_seen = False
                        break
                whole[i, j, k] = 1 if all_seen else 0


@compiled
def _surface_nets(block: _Block, least: int, first: IntArray, out: _Pieces) -> tuple[int, int]:
    """Write vertices and quadrilaterals of one block with a margin of one sample; return how many
    of both.

    A sample (i, j, k) of the block is at [i + 1, j + 1, k + 1]; a cell has the coordinates of its
    first sample.
    """
    distance = block.distance
    colour = block.colour
    cell = out.cell
    point = out.point
    shade = out.colour
    quad = out.quad
    side = len(distance)
    vertices = 0
    faces = 0
    whole = np.zeros((side, side, side), dtype=np.uint8)  # cells of samples that were all seen
    _mark_whole(block.seen, least, whole)
    for i in range(1, side - 1):
        for j in range(1, side - 1):
            for k in range(1, side - 1):
                if whole[i, j, k]:
                    crossings = 0
                    x = 0.0
                    y = 0.0
                    z = 0.0
                    r = 0.0
                    g = 0.0
                    b = 0.0
                    for low in range(8):
                        for axis in range(3):
                            bit = 4 >> axis
                            if low & bit:
                                continue
                            high = low | bit
                            ai = i + (low >> 2)
                            aj = j + ((low >> 1) & 1)
                            ak = k + (low & 1)
                            bi = i + (high >> 2)
                            bj = j + ((high >> 1) & 1)
                            bk = k + (high & 1)
                            da = distance[ai, aj, ak]
                            db = distance[bi, bj, bk]
                            if (da < 0.0) == (db < 0.0):
                                continue
                            t = da / (da - db)
                            x += ai + t * (bi - ai)
                            y += aj + t * (bj - aj)
                            z += ak + t * (bk - ak)
                            r += colour[ai, aj, ak, 0] * (1 - t) + colour[bi, bj, bk, 0] * t
                            g += colour[ai, aj, ak, 1] * (1 - t) + colour[bi, bj, bk, 1] * t
                            b += colour[ai, aj, ak, 2] * (1 - t) + colour[bi, bj, bk, 2] * t
                            crossings += 1
                    if crossings:
                        cell[vertices, 0] = first[0] + i - 1  # fmt: skip
                        cell[vertices, 1] = first[1] + j - 1
                        cell[vertices, 2] = first[2] + k - 1
                        point[vertices, 0] = first[0] - 1 + x / crossings
                        point[vertices, 1] = first[1] - 1 + y / crossings
                        point[vertices, 2] = first[2] - 1 + z / crossings
                        shade[vertices, 0] = np.uint8(r / crossings + 0.5)
                        shade[vertices, 1] = np.uint8(g / crossings + 0.5)
                        shade[vertices, 2] = np.uint8(b / crossings + 0.5)
                        vertices += 1
                for axis in range(3):
                    ni = i + (axis == 0)
                    nj = j + (axis == 1)
                    nk = k + (axis == 2)
                    inside = distance[i, j, k] < 0.0
                    if inside == (distance[ni, nj, nk] < 0.0):
                        continue
                    # The two directions across the edge, so that (axis, one, two) is right-handed.
                    one = (axis + 1) % 3
                    two = (axis + 2) % 3
                    all_seen = True
                    for corner in range(4):
                        # Around the edge: (0, 0), (-1, 0), (-1, -1), (0, -1), seen along the axis.
                        back = corner if inside else 3 - corner
                        a = -(back == 1 or back == 2)
                        b2 = -(back >= 2)
                        ci = i
                        cj = j
                        ck = k
                        ci += a * (one == 0) + b2 * (two == 0)
                        cj += a * (one == 1) + b2 * (two == 1)
                        ck += a * (one == 2) + b2 * (two == 2)
                        if not whole[ci, cj, ck]:
                            all_seen = False
                            break
                        quad[faces, corner, 0] = first[0] + ci - 1
                        quad[faces, corner, 1] = first[1] + cj - 1
                        quad[faces, corner, 2] = first[2] + ck - 1
                    if all_seen:
                        faces += 1
    return vertices, faces
