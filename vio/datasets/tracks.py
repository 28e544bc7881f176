"""Feature tracks as files hold them: dense arrays in, one ragged table out, repeated pixels found and judged.

A tracker that repeats old pixels does one of two things. Either it went on from its true last image, and the repeated
row alone is wrong; or it took the old pixels for positions in the new image and went on from there, and then the
track has left its point for good: whatever lies at that pixel in the new image is what it shows from now on. The two
differ in how far the pixels jump after the repeat: two steps of ordinary motion, or one.

The ECE276A files do the second (0027.npz against ground truth, 91 stale frames t: repeated rows fit frames t and t + 1
as one point to 0.25 px in u and 0.32 px in v, as good as any, and miss the point of frame t - 1 by 6.2 px). A stale
frame thus has good features and no link to the past, and its tracks get new ids there.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from vio.datasets.settings import RepeatsMode
from vio.errors import DataError
from vio.geometry.lie import FloatArray
from vio.records import BoolArray, FeatureTracks, IntArray

_MISSING = -1.0  # the files' code for "not seen"; it ends here
_HALF_WINDOW = 5  # frames on each side over which a noisy velocity is averaged
_REST_MPS, _REST_RADPS = 0.05, 0.1  # slower than this counts as standing still
_SIGNIFICANCE = 4.0  # standard errors by which an averaged velocity must differ from zero
_JUMP_BETWEEN = 1.5  # steps: a jump below says that the track changed its point (1), above that it did not (2)
_MIN_JUMPS = 20  # rows needed to judge


def tracks_from_dense(features: FloatArray, path: Path) -> FeatureTracks:
    """Turn a dense array (4, M, T) into rows; a column of -1 means that the feature is not seen in that frame.

    A row with -1 in both right coordinates only is seen in the left image alone.

    Raises:
        DataError: a row is half missing or not finite, or left and right are swapped.
    """
    missing = features == _MISSING
    left, right = missing[0] & missing[1], missing[2] & missing[3]
    half = (missing[0] ^ missing[1]) | (missing[2] ^ missing[3]) | (left & ~right)
    unclear = (half & ~left) | (left & ~right) | (~np.isfinite(features)).any(axis=0)
    if unclear.any():
        j, t = (int(k) for k in np.argwhere(unclear)[0])
        raise DataError(
            f"{path}: feature {j} in frame {t} is {features[:, j, t].tolist()}, neither a pixel pair nor all -1; "
            "write -1 in all four rows where a feature is not seen"
        )
    frames, ids = np.nonzero(~left.T)
    offsets = np.searchsorted(frames, np.arange(features.shape[2] + 1)).astype(np.int64)
    z = np.ascontiguousarray(features[:, ids, frames].T)
    tracks = FeatureTracks(offsets, ids.astype(np.int64), z, ~right[ids, frames], np.zeros(len(ids), dtype=np.bool_))
    _refuse_swapped(tracks, path)
    return tracks


def _refuse_swapped(tracks: FeatureTracks, path: Path) -> None:
    z = tracks.z[tracks.has_right]
    negative = int(np.sum(z[:, 0] < z[:, 2]))
    if 2 * negative > len(z):
        raise DataError(
            f"{path}: left and right look swapped: {negative} of {len(z)} disparities ul - ur are negative; "
            "exchange the two cameras' rows (ul vl ur vr)"
        )


def moving_frames(linear: FloatArray, angular: FloatArray) -> BoolArray:
    """Say for each frame whether the vehicle moves, from noisy velocities (F, 3) m/s and rates (F, 3) rad/s.

    It does where the mean over a few frames stands out of its own scatter on any axis and is no mere creep.
    """
    return _stands_out(linear, _REST_MPS) | _stands_out(angular, _REST_RADPS)


def _stands_out(values: FloatArray, rest: float) -> BoolArray:
    count = len(values)
    k = np.arange(count)
    low, high = np.maximum(k - _HALF_WINDOW, 0), np.minimum(k + _HALF_WINDOW + 1, count)
    n = (high - low)[:, None]
    total, squares = (np.concatenate([np.zeros((1, 3)), np.cumsum(a, axis=0)]) for a in (values, values**2))
    mean = (total[high] - total[low]) / n
    scatter = np.maximum((squares[high] - squares[low]) / n - mean**2, 0.0)
    error = np.sqrt(scatter / n)
    out: BoolArray = (np.abs(mean) > np.maximum(rest, _SIGNIFICANCE * error)).any(axis=1)
    return out


@dataclass(frozen=True, slots=True)
class Repeats:
    """What was found about repeated pixels."""

    frames: BoolArray  # (F,) more than half of the tracks that go on repeat their pixels
    rows: int  # observations that do
    jump: float | None  # median motion after a repeat over the motion before it, in steps; None: too few to tell


def mark_repeats(tracks: FeatureTracks, moving: BoolArray) -> tuple[FeatureTracks, Repeats]:
    """Mark rows stale whose pixels are bit-identical to the last ones of the same id while the vehicle moves.

    Args:
        tracks: as the file has them.
        moving: (F,) frames in which the vehicle moves.
    """
    frames = tracks.frames
    previous = _previous_rows(tracks)
    known = previous >= 0
    same = tracks.z == tracks.z[previous]
    left, right = same[:, :2].all(axis=1), same[:, 2:].all(axis=1) & tracks.has_right[previous]
    stale = known & left & np.where(tracks.has_right, right, ~tracks.has_right[previous]) & moving[frames]
    carried = known & (frames[previous] == frames - 1)
    count = len(tracks.offsets) - 1
    share = np.bincount(frames[carried & stale], minlength=count) / np.maximum(
        np.bincount(frames[carried], minlength=count), 1
    )
    marked = replace(tracks, stale=stale)
    return marked, Repeats(share > 0.5, int(stale.sum()), _jump(marked, previous, carried))


def _previous_rows(tracks: FeatureTracks) -> IntArray:
    """For each row, the row (R,) in which the same id was last seen; -1: never."""
    order = np.lexsort((tracks.frames, tracks.ids))
    previous = np.full(len(order), -1, dtype=np.int64)
    same = tracks.ids[order][1:] == tracks.ids[order][:-1]
    previous[order[1:][same]] = order[:-1][same]
    return previous


def _jump(tracks: FeatureTracks, previous: IntArray, carried: BoolArray) -> float | None:
    """Median over repeated rows b of |z(c) - z(b)| / |z(a) - z(a')|, frames a' a b c in direct succession."""
    c = np.flatnonzero(carried & tracks.stale[previous] & ~tracks.stale)
    b = previous[c]
    a = previous[b]
    fits = carried[b] & (a >= 0)
    c, b, a = c[fits], b[fits], a[fits]
    fits = carried[a] & ~tracks.stale[a]
    c, b, a = c[fits], b[fits], a[fits]
    before = np.linalg.norm(tracks.z[a, :2] - tracks.z[previous[a], :2], axis=1)
    after = np.linalg.norm(tracks.z[c, :2] - tracks.z[b, :2], axis=1)
    clear = before >= 1.0
    if clear.sum() < _MIN_JUMPS:
        return None
    return float(np.median(after[clear] / before[clear]))


def settle_repeats(
    tracks: FeatureTracks, moving: BoolArray, mode: RepeatsMode
) -> tuple[FeatureTracks, BoolArray, tuple[str, ...]]:
    """Flag repeated rows, give tracks that changed their point a new id from there on, and say so.

    Returns:
        The tracks, the mask (F,) of stale frames, and notes for the user.
    """
    marked, found = mark_repeats(tracks, moving)
    if not found.rows:
        return marked, found.frames, ()
    count = int(found.frames.sum())
    note = (
        f"{count} of {len(found.frames)} feature frames are stale: {found.rows} observations repeat the pixels of the "
        "frame before while the vehicle moves"
    )
    if mode == "literal":
        return tracks, found.frames, (f"{note}; taken at their word as asked",)
    jump = "" if found.jump is None else f" (pixels move {found.jump:.2f} steps afterwards"
    changed = found.jump is not None and found.jump < _JUMP_BETWEEN
    if mode == "flag" or (mode == "auto" and not changed):
        return marked, found.frames, (f"{note}; they are flagged{jump and jump + ')'}",)
    why = jump and jump + (", not 2: they show other points of the scene)" if changed else ")")
    return split_ids(marked), found.frames, (f"{note}; they are flagged, and their tracks go on under new ids{why}",)


def split_ids(tracks: FeatureTracks) -> FeatureTracks:
    """Give every track a new id from each stale row on; first parts keep theirs, new ids count up in time order."""
    order = np.lexsort((tracks.frames, tracks.ids))
    ids, stale = tracks.ids[order], tracks.stale[order]
    begins = np.concatenate([[True], ids[1:] != ids[:-1]]) if len(ids) else np.zeros(0, dtype=np.bool_)
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
