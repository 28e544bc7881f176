"""Which left and right images were exposed together, by their stamps."""

from __future__ import annotations

import numpy as np

from vio.records import IntArray

PAIRED_NS = 3_000_000  # stamps further apart belong to different exposures
_JITTER_NS = 1_000_000  # allowed deviation of the offset between paired stamps from its median


def pair_stamps(left_ns: IntArray, right_ns: IntArray) -> tuple[IntArray, IntArray]:
    """Indices (F,), (F,) of paired stamps: equal ones, or nearest ones at a small, constant offset."""
    _, equal_a, equal_b = np.intersect1d(left_ns, right_ns, assume_unique=True, return_indices=True)
    b = _nearest(left_ns, right_ns)
    a = np.arange(len(left_ns))
    offset = right_ns[b] - left_ns
    near = (np.abs(offset) < PAIRED_NS) & (_nearest(right_ns, left_ns)[b] == a)
    if 2 * len(equal_a) >= near.sum():
        return equal_a.astype(np.int64), equal_b.astype(np.int64)
    steady = near & (np.abs(offset - np.median(offset[near])) <= _JITTER_NS)
    return a[steady], b[steady]


def _nearest(of: IntArray, among: IntArray) -> IntArray:
    """Index (N,) of the nearest of sorted times (M,) for each of (N,) times."""
    after = np.clip(np.searchsorted(among, of), 1, max(len(among) - 1, 1))
    after = np.minimum(after, len(among) - 1)
    before = np.maximum(after - 1, 0)
    return np.where(np.abs(among[after] - of) < np.abs(of - among[before]), after, before)
