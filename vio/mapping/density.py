"""Which keyframes of a cubic metre are enough to find it again."""

from __future__ import annotations

import numpy as np

from vio.geometry.lie import FloatArray
from vio.records import BoolArray, IntArray

_M_PER_RAD = 2.0  # a turn of a radian shows as much that is new as a step of so many metres


def spread(T_map_cam: FloatArray, part: IntArray, loops: IntArray, density: int) -> BoolArray:
    """Mask (K,) of at most `density` keyframes a cubic metre.

    Of the two keyframes of a cell that show the most alike, that with fewer loops is left out, or
    the older one.

    Args:
        T_map_cam: (K, 4, 4) poses.
        part: (K,) of the map that each is in.
        loops: (K,) of each keyframe.
        density: keyframes a cubic metre.
    """
    kept = np.ones(len(T_map_cam), dtype=np.bool_)
    cells = np.concatenate([np.floor(T_map_cam[:, :3, 3]), part[:, None]], axis=1)
    for cell in np.unique(cells, axis=0):
        rows = np.flatnonzero((cells == cell).all(axis=1))
        position = T_map_cam[rows, :3, 3]
        axis = T_map_cam[rows, :3, 2]
        apart = np.linalg.norm(position[:, None] - position, axis=2) + _M_PER_RAD * np.arccos(
            np.clip(axis @ axis.T, -1.0, 1.0)
        )
        np.fill_diagonal(apart, np.inf)
        for _ in range(len(rows) - density):
            a, b = sorted(np.unravel_index(int(np.argmin(apart)), apart.shape))
            if loops[rows[b]] < loops[rows[a]]:
                gone = b
            else:
                gone = a
            kept[rows[gone]] = False
            apart[gone] = np.inf
            apart[:, gone] = np.inf
    return kept
