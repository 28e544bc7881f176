"""How much larger the errors of tracks are together than the filter believes: learned while
running.

The filter counts all pixels as independent. Those of a front end are not: an error lasts along a
track, comes back when the track begins again under its id, and neighbours share it. So the score of
a cluster of features, the sum of `H' R^-1 r` over their lives with their points eliminated, varies
more than its information, the sum of `H' R^-1 H`, says. Over all clusters, the ratio of the two is
the factor by which information is counted too often (quasi-likelihood: Wedderburn 1974; clusters:
Liang & Zeger, Longitudinal data analysis using generalized linear models, 1986). Scores are taken
by a drift of the poses, (R7) of docs/math.md: what lasts along a track moves the poses as a drift
does.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from vio.filters import track_loops as loops
from vio.geometry.lie import FloatArray
from vio.numerics.kinds import Capacity
from vio.records import IntArray

# before any track has ended: white noise has 1, front ends on real images 2 to 7
PRIOR_FACTOR = 2.5


class _ClusterRules(NamedTuple):
    """How errors that neighbours have in common are learned."""

    prior_tracks: float = 30.0  # as many ended tracks count for it
    max_features: Capacity[int] = 4096  # whose clusters are kept: far more than are seen at once
    frames: int = 10  # of those in which tracks end, in which neighbours' are one cluster


_CLUSTERS = _ClusterRules()
CELL_RAD = 0.2  # side of the cells of directions in which features are neighbours


class Overdispersion:
    """The ratio of squared scores to information, clustered by feature, direction and time."""

    def __init__(self) -> None:
        # of features, by id, in the order in which they ended last
        self._cluster: dict[int, tuple[int, int, int]] = {}
        # of clusters in `_scores`, in the order of their last change
        self._row: dict[tuple[int, int, int], int] = {}
        self._free: list[int] = []  # rows without a cluster
        self._scores: FloatArray = np.zeros((0, 6))
        self._squares = np.zeros(6)
        self._information = np.zeros(6)
        self._tracks = 0
        self._calls = 0
        # by how much too often the information of pixels is counted, at least one
        self.factor = PRIOR_FACTOR

    @property
    def outlasting(self) -> float:
        """Factor on the reported variances of what pixels say: errors also outlast tracks and
        clusters, which no score shows. One where they are white.
        """
        return min(self.factor, PRIOR_FACTOR)

    def add(
        self, ids: IntArray, directions: FloatArray, scores: FloatArray, information: FloatArray
    ) -> None:
        """Take in tracks that ended in a frame.

        Args:
            ids: of their features (K,).
            directions: (K, 2) in which the camera sees them, azimuth and elevation, rad.
            scores: (K, 6) by a drift of the poses, in the noise that the filter believes.
            information: (K, 6) likewise, their expected squares.
        """
        cells = np.floor(directions / CELL_RAD).astype(np.int64).tolist()
        rows: IntArray = np.empty(len(ids), dtype=np.int64)
        if len(self._free) < len(ids):
            self._free += range(len(self._scores), len(self._scores) + _CLUSTERS.max_features)
            self._scores = np.concatenate([self._scores, np.zeros((_CLUSTERS.max_features, 6))])
        for k, (feature, (x, y)) in enumerate(zip(ids.tolist(), cells, strict=True)):
            cluster = x, y, self._calls // _CLUSTERS.frames
            if feature in self._cluster:  # a feature that began again stays in its cluster
                cluster = self._cluster[feature]
                del self._cluster[feature]
            self._cluster[feature] = cluster
            if cluster in self._row:
                row = self._row[cluster]
                del self._row[cluster]
            else:
                row = self._free.pop()
            rows[k] = self._row[cluster] = row
        loops.add_scores(rows, scores, self._scores, self._squares)
        self._calls += 1
        self._information += information.sum(axis=0)
        self._tracks += len(ids)
        while len(self._cluster) > _CLUSTERS.max_features:
            del self._cluster[next(iter(self._cluster))]
        while len(self._row) > _CLUSTERS.max_features:
            self._free.append(row := self._row.pop(next(iter(self._row))))
            self._scores[row] = 0.0
        known = self._information > 0
        if known.any():
            ratios = self._squares[known] / self._information[known]
            ratio = float(ratios.sum() / len(ratios))
            learned = (_CLUSTERS.prior_tracks * PRIOR_FACTOR + self._tracks * ratio) / (
                _CLUSTERS.prior_tracks + self._tracks
            )
            self.factor = max(learned, 1.0)
