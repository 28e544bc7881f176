"""What the features of another program show of how they were written: which columns hold what,
where pixels count from, and whether an id is a point.

A tracker's own numbers tell more than their types. Left and right rows agree in a rectified pair,
so an order of columns in which they do is known from the others; a point moves with those around
it, so an id that does not is none. What cannot be meant otherwise is refused with what to write;
right pixels that are placeholders are taken as not measured.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from vio.geometry.lie import FloatArray
from vio.geometry.stereo import StereoCamera
from vio.records import DOUBT, BoolArray, FeatureTracks, shared_rows


class _Rules(NamedTuple):
    """From where on features are not those of a rectified pair in pixels."""

    fewest: int = 20  # rows that tell
    most: float = 0.8  # share of rows that are "most"
    few: float = 0.1  # share of rows that may lie outside of the image …
    very_few: float = 0.01  # … where disparities are whole numbers, as a matcher computes them
    near_px: float = 2.0  # rows of left and right that agree; how far outside of an image is in it
    unrelated: float = 0.5  # correlation below which left and right pixels are not of one point
    normalised_max: float = 10.0  # no image has all its pixels nearer to its corner …
    least_focal: float = 100.0  # … where the focal length is this long, in pixels
    unlike: float = 0.05  # share by which the focal lengths of a rectified pair never differ
    again: float = 0.01  # share of the features whose ids the next frame has …
    pairs: int = 4  # … of so many pairs of frames or more: a tracker may begin anew
    scatter: float = 0.6  # of a point's motion beside that of two of any ids
    beyond: float = 3.0  # times the principal point, where no image of one size ends
    parts: int = 32  # of a pixel, in which pixels may be measured
    filled: float = 0.8  # share of the upper left quarter that features of half the size reach
    steps: float = 16.0  # of a pixel, in which matchers write disparities as whole numbers
    same_px: float = 1e-3  # disparities that are one number, but for rounding
    least_capped: int = 20  # rows that share the largest disparity …
    points_capped: int = 8  # … of so many points, not of a few at rest …
    capped: float = 0.01  # … a share of all …
    of_a_plane: float = 0.5  # share above which they may be those of one plane, without noise
    crowded: float = 3.0  # … times the rows within a pixel below it


_RULES = _Rules()
_COLUMNS = ("ul", "vl", "ur", "vr")
# Other orders of the columns of z, by which of them the four are.
_ORDERS: dict[str, tuple[int, int, int, int]] = {
    "ul ur vl vr": (0, 2, 1, 3),
    "vl ul vr ur": (1, 0, 3, 2),
    "vr ur vl ul": (3, 2, 1, 0),
    "ur vr ul vl": (2, 3, 0, 1),
}
_NEGATIVE = "ur vr ul vl"  # what also explains negative disparities: u that counts from the right


def without_placeholders(tracks: FeatureTracks) -> tuple[FeatureTracks, str | None]:
    """Return tracks whose right pixels that stand for "not found" have no `has_right`, and what was
    taken so.

    These are pixels that are no numbers, pairs at or below zero that several rows share to the
    last bit, as -1 -1, and the left pixel itself, to the last bit, in several rows: not where it is
    a whole one, or a part of it, and so is the right one of a far point. Where a matcher searches
    no farther than a whole number of pixels, and gives what is nearer that disparity, these are
    none.
    """
    right = tracks.z[:, 2:]
    empty = np.isnan(right).any(axis=1)
    low = tracks.has_right & (right <= 0).all(axis=1)
    values, place, counts = np.unique(right[low], axis=0, return_inverse=True, return_counts=True)
    shared = np.zeros(len(right), dtype=np.bool_)
    shared[low] = (counts > 1)[place.reshape(-1)]
    own = tracks.has_right & (right == tracks.z[:, :2]).all(axis=1)
    parts = tracks.z[:, :2] * _RULES.parts
    own &= (parts != np.rint(parts)).any(axis=1)
    own &= own.sum() > 1
    capped, largest, share = _capped(tracks)
    capped &= share <= _RULES.of_a_plane
    held = tracks.has_right & (empty | shared | own | capped)
    if not held.any():
        return tracks, None
    kinds = ["no numbers"] if (tracks.has_right & empty).any() else []
    kinds += ["ul vl"] if own.any() else []
    kinds += [f"{u:g} {v:g}" for u, v in values[counts > 1].tolist()]
    if capped.any():
        kinds.insert(0, f"at the largest disparity, {largest:g} px,")
    note = (
        f"ur vr are {' or '.join(kinds[:3])} in {int(held.sum())} rows that has_right marks as "
        "measured; these are taken as seen by the left camera alone"
    )
    return replace(tracks, has_right=tracks.has_right & ~held), note


def _capped(tracks: FeatureTracks) -> tuple[BoolArray, float, float]:
    """Return which rows (R,) have the largest disparity of all, a whole number of pixels, where it
    is that of many more than are just below it; that disparity, px, and their share.
    """
    disparity = tracks.z[:, 0] - tracks.z[:, 2]
    known = disparity[tracks.has_right & np.isfinite(disparity)]
    none = np.zeros(len(disparity), dtype=np.bool_)
    if len(known) < _RULES.least_capped:
        return none, 0.0, 0.0
    top = float(np.rint(known.max()))
    is_top = tracks.has_right & (np.abs(disparity - top) <= _RULES.same_px)
    at_top = int(is_top.sum())
    below = int(((known < top - _RULES.same_px) & (known > top - 1 - _RULES.same_px)).sum())
    share = at_top / len(known)
    points = len(np.unique(tracks.ids[is_top]))
    is_cap = at_top >= _RULES.least_capped and points >= _RULES.points_capped
    is_cap &= share >= _RULES.capped
    if not is_cap or top < known.max() - _RULES.same_px or at_top < _RULES.crowded * below:
        return none, 0.0, 0.0
    return is_top, top, share


def features_fault(camera: StereoCamera, tracks: FeatureTracks) -> str | None:
    """Return why features are not rectified pixels `[ul vl ur vr]` of points with ids, and what to
    write instead; None: they may be.
    """
    needed = tracks.z.copy()
    needed[~tracks.has_right, 2:] = 0.0
    lost = np.flatnonzero(~np.isfinite(needed).all(axis=1))
    if len(lost):
        row = int(lost[0])
        frame = int(np.searchsorted(tracks.offsets, row, side="right")) - 1
        return (
            f"row {row} (processed frame {frame}, id {int(tracks.ids[row])}) is at the pixels "
            f"{tracks.z[row].tolist()}; leave it out"
        )
    if len(tracks.ids) < _RULES.fewest:
        return None
    checks: tuple[Callable[[StereoCamera, FeatureTracks], str | None], ...] = (
        _of_intrinsics,
        _of_units,
        _of_columns,
        _of_places,
        _of_right_places,
        _of_ids,
    )
    return next((fault for check in checks if (fault := check(camera, tracks)) is not None), None)


def features_doubt(camera: StereoCamera, tracks: FeatureTracks) -> str | None:
    """Return a note where pixels and principal point look like those of images of two sizes
    (features go far beyond an image of no stated size), or most disparities like those at the end
    of a matcher's search.
    """
    capped, largest, share = _capped(tracks)
    if capped.any() and share > _RULES.of_a_plane:
        return (
            f"{DOUBT}{100 * share:.0f} % of the disparities are {largest:g} px, the largest: if a matcher "
            "searches no farther, mark these as not found"
        )
    if len(tracks.ids) < _RULES.fewest or camera.projection != "pinhole":
        return None
    half = _half_size(camera)
    farthest = tracks.z[:, :2].max(axis=0)
    reached = f"({farthest[0]:.0f}, {farthest[1]:.0f})"
    if (farthest > _RULES.beyond * half).all():
        return (
            f"{DOUBT}features lie up to {reached}, and the principal point is ({half[0]:.0f}, "
            f"{half[1]:.0f}); intrinsics and pixels must be of images of one size"
        )
    return None


def _half_size(camera: StereoCamera) -> FloatArray:
    """Half the size (2,) of an image, which is the principal point where none is stated, px."""
    if camera.width is None or camera.height is None:
        return np.array([camera.cu, camera.cv])
    return 0.5 * np.array([camera.width, camera.height])


def _of_intrinsics(camera: StereoCamera, tracks: FeatureTracks) -> str | None:
    del tracks
    if camera.projection != "pinhole" or not _differs(camera.fu, camera.fv):
        return None
    if _differs(camera.fu, camera.cu):
        return None
    return (
        f"intrinsics have the focal lengths {camera.fu:g} and {camera.fv:g}, and the principal point "
        f"({camera.cu:g}, {camera.cv:g}), as if their order were fu cu fv cv; write fu fv cu cv and "
        "the baseline"
    )


def _differs(a: float, b: float) -> bool:
    return abs(a / b - 1) > _RULES.unlike if b else True


def _of_units(camera: StereoCamera, tracks: FeatureTracks) -> str | None:
    left = tracks.z[:, :2]
    largest = float(np.abs(left).max())
    if largest >= _RULES.normalised_max or camera.fu < _RULES.least_focal:
        return None
    return (
        f"all left pixels are within {largest:.3g} of zero, so they are normalised coordinates or "
        "shares of the image; multiply by the focal lengths and add the principal point (or multiply "
        "by the image's size)"
    )


def _of_columns(camera: StereoCamera, tracks: FeatureTracks) -> str | None:
    """Of the rows with a right pixel: whether columns are in another order, or hold something
    else.
    """
    z = tracks.z[tracks.has_right]
    if camera.kind != "stereo" or len(z) < _RULES.fewest:
        return None
    for name, column in zip(_COLUMNS, z.T, strict=True):
        if column.min() == column.max():
            return (
                f"{name} is {column[0]:g} in all {len(z)} rows with a right pixel; write what was "
                "measured (of a rectified pair without own rows, vr = vl)"
            )
    if _is_pair(z):
        return None
    if fault := _of_right_columns(z):
        return fault
    for name, order in _ORDERS.items():
        if _is_pair(z[:, order]):
            return _other_order(name, z)
    if _correlation(z[:, 1], z[:, 3]) < _RULES.unrelated:
        apart = float(np.median(np.abs(z[:, 1] - z[:, 3])))
        return (
            f"the rows vl and vr of one id differ by {apart:.0f} px (median) and do not follow each "
            "other: ur vr may be in another order than ids, or the columns are not ul vl ur vr"
        )
    return None


def _of_right_columns(z: FloatArray) -> str | None:
    """Whether ur is a disparity, or counts from the edge of an image of both cameras."""
    disparities = z.copy()
    disparities[:, 2] = z[:, 0] - z[:, 2]
    is_apart = _correlation(z[:, 0], z[:, 2]) < _RULES.unrelated
    if is_apart and float(np.mean(z[:, 2] > 0)) >= _RULES.most and _is_pair(disparities):
        return (
            "the third column does not follow ul, and is what ul - ur would be: a disparity; write "
            "ur = ul - disparity"
        )
    if float(np.mean(z[:, 2] > z[:, 0].max())) >= _RULES.most:
        return (
            f"ur goes from {z[:, 2].min():.0f} to {z[:, 2].max():.0f}, right of all ul (up to "
            f"{z[:, 0].max():.0f}): it counts from the left edge of an image of both cameras; "
            "subtract the width of one"
        )
    return None


def _other_order(name: str, z: FloatArray) -> str:
    if name == _NEGATIVE:
        share = float(np.mean(z[:, 0] < z[:, 2]))
        return (
            f"disparities ul - ur are negative in {100 * share:.0f} % of the rows: the right camera's "
            "pixels come first, left and right cameras are exchanged, or u counts from the right "
            "edge; write ul vl ur vr"
        )
    return f"the columns of z are in the order {name}, in which rows agree; write ul vl ur vr"


def _is_pair(z: FloatArray) -> bool:
    """Whether pixels (N, 4) are those of a rectified pair: rows agree, disparities are positive and
    short beside the image, and pixels of left and right follow each other.
    """
    disparity = z[:, 0] - z[:, 2]
    widest = np.ptp(z[:, 0])
    rows = np.abs(z[:, 1] - z[:, 3]) <= _RULES.near_px
    columns = (disparity > -_RULES.near_px) & (disparity < 0.5 * widest)
    if min(float(rows.mean()), float(columns.mean())) < _RULES.most:
        return False
    return _correlation(z[:, 0], z[:, 2]) >= _RULES.unrelated


def _correlation(a: FloatArray, b: FloatArray) -> float:
    """Return the correlation of two series; 1 where one is constant."""
    a = a - a.mean()
    b = b - b.mean()
    size = float(np.sqrt((a @ a) * (b @ b)))
    return float(a @ b) / size if size else 1.0


def _of_places(camera: StereoCamera, tracks: FeatureTracks) -> str | None:
    """Whether the left pixels lie in the image."""
    left = tracks.z[:, :2]
    if _outside(left, camera) <= _RULES.few:
        return _of_quarter(tracks, camera)
    centre = np.array([camera.cu, camera.cv])
    if (left < -_RULES.near_px).any() and _outside(left + centre, camera) <= _RULES.few:
        return (
            f"{100 * _outside(left, camera):.0f} % of the left pixels lie outside of the image, and "
            "inside once the principal point is added, from which they count; add cu and cv to them"
        )
    low = left.min(axis=0)
    high = left.max(axis=0)
    size = "" if camera.width is None else f" of {camera.width} x {camera.height}"
    return (
        f"{100 * _outside(left, camera):.0f} % of the left pixels lie outside of the image{size} "
        f"(u {low[0]:.0f} to {high[0]:.0f}, v {low[1]:.0f} to {high[1]:.0f}): they are those of images "
        "of another size, or u and v are exchanged; intrinsics, image_size and pixels must be of one "
        "image"
    )


def _of_right_places(camera: StereoCamera, tracks: FeatureTracks) -> str | None:
    """Whether right pixels lie left of the image, where no camera measures any."""
    z = tracks.z[tracks.has_right]
    if camera.kind != "stereo" or len(z) < _RULES.fewest:
        return None
    outside = float(np.mean(z[:, 2] < -_RULES.near_px))
    disparity = z[:, 0] - z[:, 2]
    is_whole = bool((np.abs(disparity - np.rint(disparity)) <= _RULES.same_px).all())
    if outside <= (_RULES.very_few if is_whole else _RULES.few):
        return None
    inside = float(np.mean(z[:, 0] - disparity / _RULES.steps >= -_RULES.near_px))
    where = f"{100 * outside:.0f} % of the right pixels lie left of the image (ur from {z[:, 2].min():.0f})"
    if inside < 1 - _RULES.few or not is_whole:
        return f"{where}; write ur vr in pixels of the right image, and mark those not found"
    return (
        f"{where}: disparities are in sixteenths of a pixel, as OpenCV's StereoBM and StereoSGBM "
        "compute them; divide these by 16 before ur = ul - disparity"
    )


def _of_quarter(tracks: FeatureTracks, camera: StereoCamera) -> str | None:
    """Whether left pixels fill the upper left quarter of the image from corner to corner, and no
    more. Few points may be those of one thing.
    """
    if camera.projection != "pinhole" or len(np.unique(tracks.ids)) < _RULES.fewest:
        return None
    half = _half_size(camera)
    nearest = tracks.z[:, :2].min(axis=0)
    farthest = tracks.z[:, :2].max(axis=0)
    fills = (farthest <= (1 + _RULES.unlike) * half) & (farthest >= _RULES.filled * half)
    fills &= nearest <= (1 - _RULES.filled) * half
    if not fills.all():
        return None
    return (
        "all features lie in the upper left quarter of the image, up to "
        f"({farthest[0]:.0f}, {farthest[1]:.0f}): they are pixels of images of half the size; halve "
        "fu fv cu cv, too, or double the pixels; if no others were looked for, state the size of "
        "that quarter as image_size"
    )


def _outside(pixels: FloatArray, camera: StereoCamera) -> float:
    """Return the share of pixels (N, 2) outside of the image."""
    out = (pixels < -_RULES.near_px).any(axis=1)
    if camera.width is not None and camera.height is not None:
        size = np.array([camera.width, camera.height])
        out |= (pixels > size + _RULES.near_px).any(axis=1)
    return float(out.mean())


def _of_ids(camera: StereoCamera, tracks: FeatureTracks) -> str | None:
    """Whether an id is one point: what one shows in two frames is nearer than what any two do."""
    del camera
    shares = []
    seen = again = pairs = 0
    ends = tracks.offsets.tolist()
    for first, second, last in zip(ends, ends[1:], ends[2:], strict=False):
        if min(second - first, last - second) < _RULES.fewest:
            continue
        before = slice(first, second)
        after = slice(second, last)
        rows, others = shared_rows(tracks.ids[before], tracks.ids[after])
        pairs += 1
        seen += second - first
        again += len(rows)
        if len(rows) >= _RULES.fewest:
            in_order = rows.argsort()  # of the rows, so that those half of them apart are apart
            from_px = tracks.z[before, :2][rows[in_order]]
            shares.append(_scatter(from_px, tracks.z[after, :2][others[in_order]]))
    if pairs >= _RULES.pairs and again < _RULES.again * seen:
        return (
            f"of {seen} features {again} have an id that the next frame has, too; give a point one id "
            "in all frames that show it"
        )
    if not shares or np.median(shares) < _RULES.scatter:
        return None
    return (
        "what an id shows moves from frame to frame as far as any other feature is, so ids are not "
        "those of points (numbers of rows, or of matches between two frames); give a point one id in "
        "all frames that show it"
    )


def _scatter(from_px: FloatArray, to_px: FloatArray) -> float:
    """Return how far pixels (N, 2) of the same ids spread about their median motion, over how far
    those of other ids do.
    """
    others = np.roll(to_px, len(to_px) // 2, axis=0)
    return _spread(to_px - from_px) / max(_spread(others - from_px), 1e-9)


def _spread(motions: FloatArray) -> float:
    from_median = motions - np.median(motions, axis=0)
    return float(np.median(np.hypot(from_median[:, 0], from_median[:, 1])))
