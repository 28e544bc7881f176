"""The floor plan of a surface: where a robot that drives may go."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.ndimage import binary_closing, minimum_filter

from vio.dense.surface import Mesh
from vio.files.meshes import FREE, OCCUPIED, UNKNOWN
from vio.geometry.lie import FloatArray
from vio.numerics.kinds import Capacity


@dataclass(frozen=True, slots=True)
class _GroundRules:
    """What is ground, and what an obstacle."""

    step_m: float = 0.2  # above the ground beside it, a surface is an obstacle …
    clearance_m: float = 2.0  # … below this height; what is higher is passed under
    ground_m: float = 1.5  # radius within which the lowest surface is the ground
    min_vertices: int = 2  # of a cell's ground or obstacle
    max_cells: Capacity[int] = 1 << 26


_GROUND = _GroundRules()


@dataclass(frozen=True, slots=True)
class OccupancyGrid:
    """Cells of the horizontal plane."""

    levels: npt.NDArray[np.uint8]  # (H, W) FREE, OCCUPIED or UNKNOWN, by y and x
    cell_m: float
    origin_m: FloatArray  # (2,) x and y of the corner of cell (0, 0)


def occupancy_grid(mesh: Mesh, R_upright_world: FloatArray, voxel_m: float) -> OccupancyGrid | None:
    """Return the floor plan of a mesh, in coordinates to the right and ahead; None: it is empty or
    too large.

    Ground is the lowest surface within 1.5 m; an obstacle is what stands 0.2 to 2 m above it.

    Args:
        mesh: the surface.
        R_upright_world: (3, 3) whose rows are right, ahead and up.
        voxel_m: of the mesh; a cell is twice as large, at least 5 cm.
    """
    p = mesh.vertices.astype(np.float64) @ R_upright_world.T
    cell_m = max(2 * voxel_m, 0.05)
    if not len(p):
        return None
    low = np.floor(p[:, :2].min(axis=0) / cell_m).astype(np.int64)
    at = np.floor(p[:, :2] / cell_m).astype(np.int64) - low
    width, height = (at.max(axis=0) + 1).tolist()
    if width * height > _GROUND.max_cells:
        return None
    cell = at[:, 1] * width + at[:, 0]
    lowest = np.full(width * height, np.inf)
    np.minimum.at(lowest, cell, p[:, 2])
    ground = minimum_filter(
        lowest.reshape(height, width),
        size=2 * int(np.ceil(_GROUND.ground_m / cell_m)) + 1,
        mode="nearest",
    )
    above = p[:, 2] - ground.ravel()[cell]
    standing = np.bincount(
        cell[(above > _GROUND.step_m) & (above < _GROUND.clearance_m)], minlength=width * height
    )
    flat = np.bincount(cell[above <= _GROUND.step_m], minlength=width * height).reshape(
        height, width
    )
    occupied = standing.reshape(height, width) >= _GROUND.min_vertices
    # a cell beside the rim, so that closing does not take free cells at the rim away
    closed = binary_closing(np.pad(flat >= _GROUND.min_vertices, 1))[1:-1, 1:-1]
    free = closed & ~occupied
    levels = np.where(occupied, OCCUPIED, np.where(free, FREE, UNKNOWN)).astype(np.uint8)
    return OccupancyGrid(levels, cell_m, low * cell_m)
