"""What the cameras of a rig saw of a board, view by view."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from vio.geometry.lie import FloatArray
from vio.records import IntArray
from vio.targets.corners import Corners


@dataclass(frozen=True, slots=True)
class View:
    """Corners of the board in the images of one moment."""

    time_ns: int
    corners: tuple[Corners, ...]  # of each camera; empty where it does not see the board


@dataclass(frozen=True, slots=True)
class Sightings:
    """Corners of all views and cameras as rows."""

    points_m: FloatArray  # (N, 2) of the board
    views: int  # their number
    cameras: int
    view: IntArray  # (R,)
    camera: IntArray  # (R,)
    point: IntArray  # (R,) rows of `points_m`
    uv: FloatArray  # (R, 2) pixels

    def take(self, rows: IntArray) -> Sightings:
        """Return some rows."""
        return replace(
            self,
            view=self.view[rows],
            camera=self.camera[rows],
            point=self.point[rows],
            uv=self.uv[rows],
        )

    def of_camera(self, camera: int) -> Sightings:
        """Return the rows of one camera, which becomes the only one, and the views that it has."""
        found = self.take(np.flatnonzero(self.camera == camera))
        seen, view = np.unique(found.view, return_inverse=True)
        alone = np.zeros_like(found.camera)
        return replace(found, views=len(seen), cameras=1, view=view.ravel(), camera=alone)

    def of_views(self, chosen: IntArray) -> Sightings:
        """Return the rows of some views (C,), which are numbered anew."""
        number = np.full(self.views, -1)
        number[chosen] = np.arange(len(chosen))
        found = self.take(np.flatnonzero(number[self.view] >= 0))
        return replace(found, views=len(chosen), view=number[found.view])


def sightings(views: Sequence[View], points_m: FloatArray) -> Sightings:
    """Return the corners of views as rows."""
    cameras = len(views[0].corners) if views else 1
    cells = [
        (v, c)
        for v, one in enumerate(views)
        for c, corners in enumerate(one.corners)
        if len(corners)
    ]
    view, camera = np.array(cells, dtype=np.int64).reshape(-1, 2).T
    shown = [views[v].corners[c] for v, c in cells]
    counts = list(map(len, shown))
    return Sightings(
        points_m,
        len(views),
        cameras,
        np.repeat(view, counts),
        np.repeat(camera, counts),
        np.concatenate([corners.ids for corners in shown] or [np.zeros(0, dtype=np.int64)]),
        np.concatenate([corners.uv for corners in shown] or [np.zeros((0, 2))]),
    )
