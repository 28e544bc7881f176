"""How much larger the errors of tracks are together than the filter believes: learned while running.

The filter counts all pixels of a track as independent. Those of a front end are not: an error lasts along a track, and
comes back when the track begins again under its id. So the score of a feature, `sum H' R^-1 r` over its life with its
point eliminated, varies more than its information `sum H' R^-1 H` says. The ratio of the two, over all features, is the
factor by which information is counted too often (quasi-likelihood: Wedderburn 1974; clusters: Liang & Zeger,
Longitudinal data analysis using generalized linear models, 1986). Scores are taken by the rectification terms,
(R3) of docs/math.md, which stay the same while poses change.
"""

from __future__ import annotations

import numpy as np

from vio.geometry.lie import FloatArray
from vio.records import FIELD_TERMS, IntArray

_PRIOR_TRACKS = 30.0  # as many ended tracks count for a factor of one
_MOST_SCORES = 4096  # features whose scores are kept: far more than are seen at once
_NO_SCORE: FloatArray = np.zeros(FIELD_TERMS)


class Overdispersion:
    """The ratio of squared scores to information, clustered by feature."""

    def __init__(self) -> None:
        self._scores: dict[int, FloatArray] = {}  # of features, by id, in the order in which they ended last
        self._squares, self._information = np.zeros(FIELD_TERMS), np.zeros(FIELD_TERMS)
        self._tracks = 0
        self.factor = 1.0  # by how much too often the information of pixels is counted, at least one

    def add(self, ids: IntArray, scores: FloatArray, information: FloatArray) -> None:
        """Take in tracks that ended.

        Args:
            ids: of their features (K,).
            scores: (K, 8) by the terms of the field, in the noise that the filter believes.
            information: (K, 8) likewise, their expected squares.
        """
        features = ids.tolist()
        before = np.array([self._scores.pop(feature, _NO_SCORE) for feature in features])
        together = scores + before
        self._squares += np.sum(scores * (together + before), axis=0)
        self._scores.update(zip(features, together, strict=True))
        self._information += information.sum(axis=0)
        self._tracks += len(ids)
        while len(self._scores) > _MOST_SCORES:
            self._scores.pop(next(iter(self._scores)))
        known = self._information > 0
        if known.any():
            ratio = float(np.mean(self._squares[known] / self._information[known]))
            self.factor = max((_PRIOR_TRACKS + self._tracks * ratio) / (_PRIOR_TRACKS + self._tracks), 1.0)
