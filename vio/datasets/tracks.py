"""Feature tracks of files: dense arrays converted to one ragged table, with repeated pixels
detected and classified.

A tracker that repeats old pixels does one of two things. Either it continues from its true last
image, and only the repeated row is wrong. Or it uses the old pixels as positions in the new image
and continues from there: the track has then switched permanently to whatever scene point is at that
pixel. The two differ in the pixel motion after the repeat: two steps of ordinary motion, or one.

The ECE276A files show the second case. In 0027.npz, over 91 stale frames t and against ground
truth, repeated rows fit frames t and t + 1 as one point to 0.25 px in u and 0.32 px in v, as other
rows do, and miss the point of frame t - 1 by
6.2 px. A stale frame thus has good features and no link to the past, and its tracks get new ids
there.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from vio.datasets.settings import RepeatsMode
from vio.errors import DataError
from vio.geometry.lie import FloatArray
from vio.records import BoolArray, FeatureTracks, IntArray

_MISSING = -1.0  # the files' code for "not seen"


class _StationaryRules(NamedTuple):
    """When the body stands, by its measured velocities."""

    half_window_frames: int = 5  # frames on each side of the moving average of velocities
    max_mps: float = 0.05  # speeds below are stationary
    max_radps: float = 0.1
    # standard errors by which a mean velocity must differ from zero
    significance_sigmas: float = 4.0


_STATIONARY = _StationaryRules()


class _RepeatRules(NamedTuple):
    """What pixels that repeat mean for a track."""

    jump_steps: float = 1.5  # steps: below, the track switched its point (1); above, it did not (2)
    min_jumps: int = 20  # rows needed to decide


_REPEATS = _RepeatRules()


def tracks_from_dense(features: FloatArray, path: Path) -> FeatureTracks:
    """Convert a dense array (4, M, T) to rows; a column of -1 means that the feature is not seen in
    that frame.

    A row with -1 in both right coordinates only is visible in the left image only.

    Raises:
        DataError: a row is half missing or not finite, or left and right are swapped.
    """
    missing = features == _MISSING
    left = missing[0] & missing[1]
    right = missing[2] & missing[3]
    half = (missing[0] ^ missing[1]) | (missing[2] ^ missing[3]) | (left & ~right)
    unclear = (half & ~left) | (left & ~right) | (~np.isfinite(features)).any(axis=0)
    if unclear.any():
        j, t = (int(k) for k in np.argwhere(unclear)[0])
        raise DataError(
            f"{path}: feature {j} in frame {t} is {features[:, j, t].tolist()}, neither a pixel "
            "pair nor all -1; "
            "write -1 in all four rows where a feature is not seen"
        )
    frames, ids = np.nonzero(~left.T)
    offsets = np.searchsorted(frames, np.arange(features.shape[2] + 1)).astype(np.int64)
    z = np.ascontiguousarray(features[:, ids, frames].T)
    tracks = FeatureTracks(
        offsets, ids.astype(np.int64), z, ~right[ids, frames], np.zeros(len(ids), dtype=np.bool_)
    )
    refuse_swapped(tracks, path)
    return tracks


def refuse_swapped(tracks: FeatureTracks, path: Path) -> None:
    """Raise DataError where most disparities `ul - ur` of a file are negative."""
    z = tracks.z[tracks.has_right]
    negative = int(np.sum(z[:, 0] < z[:, 2]))
    if 2 * negative > len(z):
        raise DataError(
            f"{path}: left and right look swapped: {negative} of {len(z)} disparities ul - ur are "
            "negative; "
            "exchange the two cameras' rows (ul vl ur vr)"
        )


def moving_frames(linear: FloatArray, angular: FloatArray) -> BoolArray:
    """Return for each frame whether the vehicle moves, from noisy velocities (F, 3) m/s and rates
    (F, 3) rad/s.

    It moves where, on any axis, the mean over a few frames is significant and exceeds a minimum
    speed.
    """
    return _differs_from_zero(linear, _STATIONARY.max_mps) | _differs_from_zero(
        angular, _STATIONARY.max_radps
    )


def _differs_from_zero(values: FloatArray, min_speed: float) -> BoolArray:
    count = len(values)
    k = np.arange(count)
    low = np.maximum(k - _STATIONARY.half_window_frames, 0)
    high = np.minimum(k + _STATIONARY.half_window_frames + 1, count)
    n = (high - low)[:, None]
    total, squares = (
        np.concatenate([np.zeros((1, 3)), np.cumsum(a, axis=0)]) for a in (values, values**2)
    )
    mean = (total[high] - total[low]) / n
    scatter = np.maximum((squares[high] - squares[low]) / n - mean**2, 0.0)
    error = np.sqrt(scatter / n)
    return (np.abs(mean) > np.maximum(min_speed, _STATIONARY.significance_sigmas * error)).any(
        axis=1
    )


@dataclass(frozen=True, slots=True)
class Repeats:
    """Statistics of repeated pixels."""

    frames: BoolArray  # (F,) more than half of the continued tracks repeat their pixels
    rows: int  # number of repeated observations
    # median motion after a repeat over the motion before it, in steps; None: too few samples
    jump: float | None


def mark_repeats(tracks: FeatureTracks, moving: BoolArray) -> tuple[FeatureTracks, Repeats]:
    """Mark rows stale whose pixels are bit-identical to the last ones of the same id while the
    vehicle moves.

    Args:
        tracks: as in the file.
        moving: (F,) frames in which the vehicle moves.
    """
    frames = tracks.frames
    previous = _previous_rows(tracks)
    known = previous >= 0
    same = tracks.z == tracks.z[previous]
    left = same[:, :2].all(axis=1)
    right = same[:, 2:].all(axis=1) & tracks.has_right[previous]
    stale = (
        known
        & left
        & np.where(tracks.has_right, right, ~tracks.has_right[previous])
        & moving[frames]
    )
    carried = known & (frames[previous] == frames - 1)
    count = len(tracks.offsets) - 1
    share = np.bincount(frames[carried & stale], minlength=count) / np.maximum(
        np.bincount(frames[carried], minlength=count), 1
    )
    marked = replace(tracks, stale=stale)
    return marked, Repeats(share > 0.5, int(stale.sum()), _jump(marked, previous, carried))


def _previous_rows(tracks: FeatureTracks) -> IntArray:
    """Return for each row the previous row (R,) of the same id; -1: none."""
    order = np.lexsort((tracks.frames, tracks.ids))
    previous = np.full(len(order), -1, dtype=np.int64)
    same = tracks.ids[order][1:] == tracks.ids[order][:-1]
    previous[order[1:][same]] = order[:-1][same]
    return previous


def _jump(tracks: FeatureTracks, previous: IntArray, carried: BoolArray) -> float | None:
    """Median over repeated rows b of |z(c) - z(b)| / |z(a) - z(a')|, consecutive frames a' a b
    c.
    """
    c = np.flatnonzero(carried & tracks.stale[previous] & ~tracks.stale)
    b = previous[c]
    a = previous[b]
    fits = carried[b] & (a >= 0)
    c = c[fits]
    b = b[fits]
    a = a[fits]
    fits = carried[a] & ~tracks.stale[a]
    c = c[fits]
    b = b[fits]
    a = a[fits]
    flow_px = tracks.z[a, :2] - tracks.z[previous[a], :2]
    before = np.linalg.norm(flow_px, axis=1)
    after = np.linalg.norm(tracks.z[c, :2] - tracks.z[b, :2], axis=1)
    clear = before >= 1.0
    if clear.sum() < _REPEATS.min_jumps:
        return None
    return float(np.median(after[clear] / before[clear]))


def resolve_repeats(
    tracks: FeatureTracks, moving: BoolArray, mode: RepeatsMode
) -> tuple[FeatureTracks, tuple[str, ...]]:
    """Return tracks with repeated rows flagged and, where they switched their point, a new id;
    and notes.
    """
    marked, found = mark_repeats(tracks, moving)
    if not found.rows:
        return marked, ()
    count = int(found.frames.sum())
    note = (
        f"{count} of {len(found.frames)} feature frames are stale: {found.rows} observations "
        "repeat the pixels of the "
        "frame before while the vehicle moves"
    )
    if mode == "literal":
        return tracks, (f"{note}; used as they are, as requested",)
    if found.jump is None:
        jump = ""
    else:
        jump = f" (pixels move {found.jump:.2f} steps afterwards"
    changed = found.jump is not None and found.jump < _REPEATS.jump_steps
    if mode == "flag" or (mode == "auto" and not changed):
        return marked, (f"{note}; they are flagged{jump and jump + ')'}",)
    why = jump and jump + (", not 2: they show other points of the scene)" if changed else ")")
    return split_ids(marked), (
        f"{note}; they are flagged, and their tracks continue under new ids{why}",
    )


def split_ids(tracks: FeatureTracks) -> FeatureTracks:
    """Give every track a new id from each stale row on; first parts keep theirs, new ids are
    numbered in time order.
    """
    order = np.lexsort((tracks.frames, tracks.ids))
    ids = tracks.ids[order]
    stale = tracks.stale[order]
    begins = (
        np.concatenate([[True], ids[1:] != ids[:-1]]) if len(ids) else np.zeros(0, dtype=np.bool_)
    )
    part = np.cumsum(begins | stale) - 1  # one number per part, in the order of (id, time)
    first_row = order[begins | stale]
    renewed = ~begins[begins | stale]
    names = ids[begins | stale].copy()
    by_time = np.argsort(first_row[renewed], kind="stable")
    fresh = np.empty(int(renewed.sum()), dtype=np.int64)
    fresh[by_time] = np.arange(len(fresh)) + (int(tracks.ids.max()) + 1 if len(ids) else 0)
    names[renewed] = fresh
    out = np.empty_like(tracks.ids)
    out[order] = names[part]
    return replace(tracks, ids=out)
