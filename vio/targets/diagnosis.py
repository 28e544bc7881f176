"""Why a board is not found in images: they are mirrored, inverted, too bright or too dark, or it is
another board than in the file.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from vio.geometry.lie import FloatArray
from vio.numerics.robust import median
from vio.records import Image
from vio.targets.corners import CornerDetector, subpixel
from vio.targets.description import APRILTAG, Target, marker_dictionary
from vio.targets.homography import homographies, mapped
from vio.targets.seeds import MarkerReader, Read, checkerboard_seeds


class _MarkerRules(NamedTuple):
    """How another board is recognised by its markers."""

    min_markers: int = 4  # of one image that show which board it is
    max_cols: int = 14
    # misfit over that of the file's board, below which another one is named
    better_ratio: float = 0.4
    max_misfit_share: float = 0.15  # of a marker's side, of the board that is named
    # of a marker's side: half the window in which its corners are refined
    window_share: float = 0.12
    compared_markers: int = 9  # markers by which boards are compared
    tried_markers: int = 100  # numbers that are read


_MARKERS = _MarkerRules()
_SPACINGS = (0.1, 0.15, 0.2, 0.25, 0.3, 0.35, 0.4, 0.5)
_MARKER_SHARES = (0.5, 0.6, 0.7, 0.75, 0.8)
# as many corners in mirrored or inverted images, from which on the images are called so
_MIRRORED_TIMES = 4
_WHITE = np.uint8(255)
_MAX_BRIGHT = 0.3  # of the pixels, with the largest value: paper and more
_TOP_PERCENT = 99
_MAX_GRID_MISFIT = 0.2  # of a square's side: corners of a board from one homography (median)
_MIN_TOP = 40.0  # of `_WHITE`: the contrast of a print below it is that of noise
# Dictionaries of which all smaller ones of a size are the beginning.
_DICTIONARIES = (
    "DICT_4X4_1000",
    "DICT_5X5_1000",
    "DICT_6X6_1000",
    "DICT_7X7_1000",
    "DICT_ARUCO_ORIGINAL",
    APRILTAG,
)


def diagnose(images: Sequence[Image], target: Target) -> str | None:
    """Return what is wrong with images of one camera or with the target file, in a clause that
    says what to do; None: it is not known.

    Args:
        images: some of a recording, (H, W) each.
        target: the board as described.
    """
    if not images:
        return None
    detector = CornerDetector(target)
    found = [len(detector.detect(image)) for image in images]
    seen = sum(found)
    if (dark := _darkness(images)) is not None:
        return dark
    if (twice := shown_twice(images, target)) is not None:
        return twice
    if target.kind != "checkerboard":
        # In mirrored images hardly a marker is read, which leaves nothing to arrange.
        if (other := _other_arrangement(images, target)) is not None:
            return other
        turned = [np.ascontiguousarray(image[:, ::-1]) for image in images]
        if sum(len(detector.detect(image)) for image in turned) > _MIRRORED_TIMES * seen:
            return (
                "the images are mirrored: the board is found in their mirror images alone; record "
                "them as the camera sees, without a flip"
            )
        inverted = [np.subtract(_WHITE, image) for image in images]
        if sum(len(detector.detect(image)) for image in inverted) > _MIRRORED_TIMES * seen:
            return (
                "the images are inverted, dark where the board is light: record them as the "
                "camera sees"
            )
    is_seen = 0 < len(found) <= 2 * int(np.count_nonzero(found))
    return _other_kind(images, target, is_seen=is_seen)


def shown_twice(images: Sequence[Image], target: Target) -> str | None:
    """Say whether an image shows two boards of the described kind."""
    if target.kind == "checkerboard":
        is_twice = any(_shows_two_checkerboards(image, target) for image in images)
    else:
        reader = MarkerReader(target)
        is_twice = any(reader.repeated(image) >= _MARKERS.min_markers for image in images)
    if not is_twice:
        return None
    return (
        "the images show the board twice, or two boards that are alike: cover one, and record again"
    )


def _shows_two_checkerboards(image: Image, target: Target) -> bool:
    """Return whether another board is found where the first one is covered.

    A larger board shows one with fewer squares at several places.
    """
    import cv2

    uv = _whole_checkerboard(image, target)
    if uv is None or _is_larger(_checkerboard_size(image), target):
        return False
    middle = uv.mean(axis=0)
    # The outer squares lie beyond the outermost corners.
    grown = 1 + 2 / (min(target.rows, target.cols) - 2)
    hull = cv2.convexHull((middle + grown * (uv - middle)).astype(np.float32))
    covered = image.copy()
    cv2.fillConvexPoly(covered, np.rint(hull).astype(np.int32), float(np.median(image)))
    return _whole_checkerboard(covered, target) is not None


def _whole_checkerboard(image: Image, target: Target) -> FloatArray | None:
    """Return the inner corners (N, 2) of a checkerboard where they lie in a plane; None: there is
    none. In a picture without a board, corners of anything make some grid of few.
    """
    board, uv = checkerboard_seeds(image, target)
    if not len(uv):
        return None
    H = homographies(board[None], uv[None])
    off = np.linalg.norm(mapped(H, board[None])[0] - uv, axis=1)
    grid = uv.reshape(target.rows - 1, target.cols - 1, 2)
    side = median(np.linalg.norm(np.diff(grid, axis=1), axis=2).ravel())
    return uv if median(off) < _MAX_GRID_MISFIT * side else None


def _is_larger(size: tuple[int, int] | None, target: Target) -> bool:
    """Return whether a checkerboard has more squares along one side than the target."""
    if size is None:
        return False
    short, long = sorted(size)
    return short > min(target.rows, target.cols) or long > max(target.rows, target.cols)


def _darkness(images: Sequence[Image]) -> str | None:
    """Say whether most images are too dark to show a board."""
    top = median(np.array([np.percentile(image, _TOP_PERCENT) for image in images]))
    if top > _MIN_TOP:
        return None
    return (
        f"the images are dark, {_TOP_PERCENT} % of their pixels are below {top + 1:.0f} of "
        f"{_WHITE}: record with more light, or a longer exposure"
    )


def _glare(images: Sequence[Image]) -> str | None:
    """Say whether most images are too bright to show a board."""
    bright = median(np.array([np.mean(image == _WHITE) for image in images]))
    if bright < _MAX_BRIGHT:
        return None
    return (
        f"the images are overexposed, {100 * bright:.0f} % of their pixels have the largest "
        "value: shorten the exposure, or lower the gain"
    )


def clearly_other_board(images: Sequence[Image], target: Target) -> str | None:
    """Return how the markers are arranged, where the described board cannot be that of the images.

    Corners alone do not show it: those in the first row agree with any number of columns.
    """
    if target.kind == "checkerboard":
        return None
    return _other_arrangement(images, target, _MARKERS.max_misfit_share)


def _other_arrangement(
    images: Sequence[Image], target: Target, min_misfit: float = 0.0
) -> str | None:
    """Say in which rows and at which distances the markers are, where not as described."""
    read = _close_together(_most_read(images, _with_more_markers(target)))
    if len(read) < _MARKERS.min_markers:
        return None
    best = min(_arrangements(target), key=lambda other: _misfit(read, other))
    misfit = _misfit(read, best)
    described = _misfit(read, target)
    if (
        described < min_misfit
        or misfit > _MARKERS.max_misfit_share
        or misfit > _MARKERS.better_ratio * described
    ):
        return None
    if best.cols != target.cols:
        one = "tags" if target.kind == "aprilgrid" else "squares"
        return (
            f"the board in the images has rows of {best.cols} {one}, and the target file says "
            f"{target.cols}; give the file of this board"
        )
    if best.legacy != target.legacy:
        return (
            "the board in the images is one of OpenCV "
            f"{'before' if best.legacy else 'since'} 4.6; write legacyPattern: "
            f"{str(best.legacy).lower()} into the target file"
        )
    name = "tagSpacing" if target.kind == "aprilgrid" else "markerSize / squareSize"
    return (
        f"{name} is about {best.ratio:g} in the images, and {target.ratio:g} in the target file; "
        "measure it on the print"
    )


def _with_more_markers(target: Target) -> Target:
    """Return a board with as many markers as are tried."""
    known = len(marker_dictionary(target.dictionary).bytesList) - target.first_id
    count = max(min(_MARKERS.tried_markers, known), 1)
    if target.kind == "aprilgrid":
        return replace(target, rows=1, cols=count)
    return replace(
        target, rows=max(2 * count // _MARKERS.max_cols, 3), cols=_MARKERS.max_cols, legacy=False
    )


def _most_read(images: Sequence[Image], target: Target) -> list[Read]:
    """Return the markers of the image that shows most of them."""
    reader = MarkerReader(target)
    return max((_refined(image, reader.find(image)) for image in images), key=len, default=[])


def _refined(image: Image, read: Sequence[Read]) -> list[Read]:
    """Return markers whose corners are where the image has theirs; none that it cuts."""
    limit = np.array(image.shape[::-1]) - 1
    read = [one for one in read if (one.uv >= 0).all() and (one.uv <= limit).all()]
    half_px = [max(_MARKERS.window_share * one.side_px, 2.0) for one in read]
    return [
        replace(one, uv=subpixel(image, one.uv, int(half)))
        for one, half in zip(read, half_px, strict=True)
    ]


def _close_together(read: Sequence[Read]) -> list[Read]:
    """Return markers next to each other, which one homography holds in spite of the lens."""
    if not read:
        return []
    centre = np.stack([one.uv.mean(axis=0) for one in read])
    middle = centre[np.argmin(np.linalg.norm(centre - centre.mean(axis=0), axis=1))]
    near = np.argsort(np.linalg.norm(centre - middle, axis=1))[: _MARKERS.compared_markers]
    return [read[k] for k in near.tolist()]


def _arrangements(target: Target) -> Iterator[Target]:
    """Yield boards of the same markers in other rows and at other distances."""
    is_grid = target.kind == "aprilgrid"
    ratios = _SPACINGS if is_grid else _MARKER_SHARES
    for cols in range(2 if is_grid else 3, _MARKERS.max_cols + 1):
        for ratio in (target.ratio, *ratios):
            yield replace(target, cols=cols, ratio=ratio)
            if not is_grid:
                yield replace(target, cols=cols, ratio=ratio, legacy=not target.legacy)


def _misfit(read: Sequence[Read], target: Target) -> float:
    """Median distance of markers' corners from one homography of a board, over their sides."""
    numbers = [one.id - target.first_id for one in read]
    board = _corners_of(target, numbers)
    uv = np.stack([one.uv for one in read])
    H = homographies(board.reshape(1, -1, 2), uv.reshape(1, -1, 2))
    off = np.linalg.norm(mapped(H, board.reshape(1, -1, 2))[0] - uv.reshape(-1, 2), axis=1)
    return median(off) / median(np.array([one.side_px for one in read]))


def _corners_of(target: Target, numbers: Sequence[int]) -> FloatArray:
    """Corners (M, 4, 2) of markers by their numbers, on a board with as many rows as they need."""
    if target.kind == "aprilgrid":
        rows = max(target.rows, max(numbers) // target.cols + 1)
    else:
        rows = max(target.rows, 2 * (max(numbers) + 1) // target.cols + 2)
        # Whether the first square is dark depends on the rows of an old board.
        rows += (rows - target.rows) % 2
    corners = replace(target, rows=rows).marker_corners()
    return np.stack([corners[number] for number in numbers])


def _other_kind(images: Sequence[Image], target: Target, *, is_seen: bool) -> str | None:
    """Say which board the images show, where it is another one."""
    shown: str | None = None
    if target.kind == "checkerboard":
        # Part of a larger board may have been taken for it.
        shown = _checkerboard_in(images, target)
    if shown is None and not is_seen:
        shown = _tags_in(images, target) or _markers_in(images, target)
        if shown is None and (glare := _glare(images)) is not None:
            return glare
        if shown is None and target.kind != "checkerboard":
            shown = _checkerboard_in(images, target)
    if shown is None:
        return None
    return (
        f"the images show {shown}, and the target file is of another board ({target}); give the "
        "file of the board that was recorded"
    )


def _checkerboard_in(images: Sequence[Image], target: Target) -> str | None:
    """Return a checkerboard in the images that is not the target."""
    for image in images:
        size = _checkerboard_size(image)
        if size is None:
            continue
        is_own = target.kind == "checkerboard" and sorted(size) == sorted(
            (target.cols, target.rows)
        )
        if is_own:
            return None
        corners = f"{size[0] - 1} x {size[1] - 1} inner corners"
        return f"a checkerboard of {size[0]} x {size[1]} squares ({corners})"
    return None


def _checkerboard_size(image: Image) -> tuple[int, int] | None:
    """Return the squares, columns and rows, of the largest checkerboard in an image."""
    import cv2

    flags = cv2.CALIB_CB_NORMALIZE_IMAGE | cv2.CALIB_CB_LARGER | cv2.CALIB_CB_EXHAUSTIVE
    done, _, meta = cv2.findChessboardCornersSBWithMeta(image, (4, 4), flags)
    if not done or meta is None:
        return None
    rows, cols = meta.shape[:2]
    return cols + 1, rows + 1


def _tags_in(images: Sequence[Image], target: Target) -> str | None:
    """Return tags of an AprilGrid in the images that are not those of the target."""
    read = _most_read(images, Target("aprilgrid", 1, _MARKERS.tried_markers, 0.1, 0.3))
    if len(read) < _MARKERS.min_markers:
        return None
    numbers = [one.id for one in read]
    if target.kind == "aprilgrid" and _are_own(numbers, target):
        return None
    return f"an AprilGrid with tags {min(numbers)} to {max(numbers)} among others"


def _are_own(numbers: Sequence[int], target: Target) -> bool:
    """Return whether markers of these numbers are on the target."""
    first = target.first_id
    return min(numbers) >= first and max(numbers) < first + len(target.marker_corners())


def _markers_in(images: Sequence[Image], target: Target) -> str | None:
    """Return markers of some dictionary in the images that are not those of the target."""
    import cv2

    most = _MARKERS.min_markers - 1
    found: str | None = None
    for name in _DICTIONARIES:
        detector = cv2.aruco.ArucoDetector(marker_dictionary(name), cv2.aruco.DetectorParameters())
        for image in images:
            ids = detector.detectMarkers(image)[1]
            if ids is None:
                numbers = []
            else:
                numbers = [int(number) for number in np.ravel(ids)]
            if len(numbers) > most:
                most = len(numbers)
                alike = _size_of(name) == _size_of(target.dictionary)
                found = None
                if alike and _are_own(numbers, target):
                    continue
                found = f"markers of {name}, {min(numbers)} to {max(numbers)} among others"
    return found


def _size_of(dictionary: str) -> str:
    """Return the name of a dictionary without the number of its markers."""
    return dictionary.rpartition("_")[0]
