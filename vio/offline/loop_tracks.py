"""Points that loops add to a run's tracks: features of two keyframes, far apart in time, that
show the same point.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from vio.geometry.lie import FloatArray
from vio.records import BoolArray, IntArray, LoopEvent


@dataclass(frozen=True, slots=True)
class LoopRows:
    """What keyframes show of points that loops join."""

    point: IntArray  # (R,) number of the point, from 0
    keyframe: IntArray  # (R,) index of the keyframe
    z: FloatArray  # (R, 4) rectified pixels [ul vl ur vr]
    has_right: BoolArray  # (R,)


def loop_pairs(loops: Sequence[LoopEvent], frames: IntArray) -> IntArray:
    """Return the places (L, 2) in `frames` (K,), increasing, of the two frames of each loop that
    has both there.
    """
    ends = np.array(
        [(o.keyframe_frame, o.frame) for o in loops if o.keyframe_frame is not None], dtype=np.int64
    )
    ends = ends.reshape(-1, 2)
    place = np.clip(np.searchsorted(frames, ends), 0, len(frames) - 1)
    return np.asarray(place[(frames[place] == ends).all(axis=1)], dtype=np.int64)


def _ends_of(
    loops: Sequence[LoopEvent], frames: IntArray
) -> list[tuple[int, FloatArray, BoolArray]]:
    """Return row of the keyframe, pixels and which of them have a right one, for both ends of each
    loop, one after the other.
    """
    ends: list[tuple[int, FloatArray, BoolArray]] = []
    for o in loops:
        pair = loop_pairs([o], frames)
        if len(pair) and o.matches is not None:
            ends.append((int(pair[0, 0]), o.matches.z_keyframe, o.matches.has_right_keyframe))
            ends.append((int(pair[0, 1]), o.matches.z_frame, o.matches.has_right_frame))
    return ends


def loop_rows(loops: Sequence[LoopEvent], frames: IntArray) -> LoopRows:
    """Return the points that loops join and what keyframes show of them.

    A feature that several loops match is one point. One that they match to two features of a
    keyframe is none.

    Args:
        loops: with their matches; those of other runs' keyframes, or without matches, add nothing.
        frames: (K,) frame numbers of the keyframes, increasing.
    """
    ends = _ends_of(loops, frames)
    if not ends:
        return LoopRows(
            np.zeros(0, dtype=np.int64),
            np.zeros(0, dtype=np.int64),
            np.zeros((0, 4)),
            np.zeros(0, dtype=np.bool_),
        )
    keyframe = np.concatenate([np.full(len(z), k) for k, z, _ in ends])
    z = np.concatenate([z for _, z, _ in ends])
    has_right = np.concatenate([right for _, _, right in ends])
    # A keyframe's feature is known by its left pixel.
    key = np.concatenate([keyframe[:, None], z[:, :2]], axis=1)
    _, first, feature = np.unique(key, axis=0, return_index=True, return_inverse=True)
    at = np.cumsum([0, *(len(z) for _, z, _ in ends)])
    rows = [np.arange(begin, end) for begin, end in pairwise(at.tolist())]
    feature = feature.ravel()
    a = feature[np.concatenate(rows[::2])]
    b = feature[np.concatenate(rows[1::2])]
    graph = coo_matrix((np.ones(len(a)), (a, b)), shape=(len(first), len(first)))
    point = connected_components(graph, directed=False)[1].astype(np.int64)
    keyframe = keyframe[first]
    z = z[first]
    has_right = has_right[first]
    _, of_keyframe, count = np.unique(
        np.stack([point, keyframe]), axis=1, return_inverse=True, return_counts=True
    )
    wrong = np.unique(point[count[of_keyframe.ravel()] > 1])
    good = ~np.isin(point, wrong)
    return LoopRows(
        np.unique(point[good], return_inverse=True)[1], keyframe[good], z[good], has_right[good]
    )
