"""The points of tracks that have ended: kept for output, and not used by the filter."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from vio.filters.window import Window
from vio.geometry.lie import FloatArray
from vio.numerics.kinds import Capacity
from vio.records import IntArray, Landmarks, no_landmarks

_MIN_MERGE: Capacity[int] = 1000  # stored points up to which the map is not merged


class PointMap:
    """Collects points; one that came back under its id counts once, as it was seen last."""

    def __init__(self) -> None:
        self.parts: list[Landmarks] = []
        self._stored = 0  # points since they were merged

    def store(
        self, window: Window, ids: IntArray, p_world: FloatArray, covariance: FloatArray
    ) -> None:
        """Add points (K, 3) of a window with their covariances (K, 3, 3)."""
        if len(ids):
            self.parts.append(_reported(window, ids, p_world, covariance))
            self._stored += len(ids)
            # Features that stay in view are stored again and again.
            if self._stored > _MIN_MERGE + len(self.parts[0].ids):
                self.parts = [newest_points(self.parts)]
                self._stored = 0

    def take(self) -> Landmarks:
        """Return all points, and forget them."""
        taken = self.stored()
        self.parts = []
        self._stored = 0
        return taken

    def stored(self) -> Landmarks:
        """Return all points, without the landmarks that are states."""
        return newest_points(self.parts) if self.parts else no_landmarks()

    def with_landmarks(self, window: Window, covariances: FloatArray) -> Landmarks:
        """Return all points, and the landmarks that are states, with their covariances (M, 3,
        3).
        """
        return newest_points(
            [*self.parts, _reported(window, window.landmark_ids, window.landmarks, covariances)]
        )

    def turn(self, R: FloatArray) -> None:
        """Turn the world by R (3, 3)."""
        turned = []
        for part in self.parts:
            covariance = R @ part.covariance @ R.T
            turned.append(Landmarks(part.ids, part.p_world @ R.T, covariance))
        self.parts = turned

    def drop_broken(self) -> None:
        """Forget parts that are not made of numbers."""
        self.parts = [part for part in self.parts if np.isfinite(part.p_world).all()]


def _reported(
    window: Window, ids: IntArray, p_upright: FloatArray, covariance: FloatArray
) -> Landmarks:
    """Points of a window in the world that is reported, equation (N14)."""
    R = window.calibration.R_upright_world.T
    return Landmarks(ids, p_upright @ R.T, R @ covariance @ R.T)


def newest_points(parts: Sequence[Landmarks]) -> Landmarks:
    """Join parts of a map; of points that came back under their ids, the last ones."""
    ids = np.concatenate([part.ids for part in parts])[::-1]
    points = np.concatenate([part.p_world for part in parts])[::-1]
    covariances = np.concatenate([part.covariance for part in parts])[::-1]
    kept, last = np.unique(ids, return_index=True)
    return Landmarks(kept, points[last], covariances[last])
