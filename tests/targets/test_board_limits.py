"""Each limit of how a board is described, read and looked for, from both sides."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest.mock import patch

import cv2
import numpy as np
import pytest

from tests.board_views import GRID, LEFT, Flaws, made_views
from tests.calibration.test_camera_imu import poses_by_known_lens
from tests.refused import is_refused
from vio.errors import DataError, VioError
from vio.geometry.lie import FloatArray
from vio.records import ImuDensities, ImuRecord
from vio.targets import corners, diagnosis, imu_checks, inertial, lenses, seeds, verdict
from vio.targets.bundle import BoardAdjustment, RigFit
from vio.targets.corners import CornerDetector, Corners
from vio.targets.description import Target
from vio.targets.homography import predict
from vio.targets.printing import page_of
from vio.targets.recording import RawRecording, film
from vio.targets.seeds import MarkerReader, Read
from vio.targets.start import poses_of
from vio.targets.views import Sightings, sightings

Says = Callable[[float], bool]
CHARUCO = Target("charuco", 6, 6, 0.08, 0.7, "DICT_5X5_1000")


# Growth from corner to corner


def _grown_tags(tags: int = 40) -> int:
    """How many tags of a row are found from the first one on."""
    board = Target("aprilgrid", 1, tags, 0.05, 0.3)
    detector: Any = CornerDetector(board)

    def refined(image: Any, ids: Any, uv: FloatArray, *_: Any) -> tuple[FloatArray, Any]:
        return uv, np.ones(len(uv), np.bool_)

    first = board.points_m[:4]
    with patch.object(detector, "_refined", refined):
        found = detector._grown(np.zeros((9, 9), np.uint8), first, 300.0 * first, 0.5)
    return int(np.isfinite(found[:, 0]).sum()) // 4


def _tries() -> int:
    """How often a corner is looked for that is not found."""
    detector: Any = CornerDetector(GRID)
    looked_for: list[int] = []

    def refined(image: Any, ids: Any, uv: FloatArray, *_: Any) -> tuple[FloatArray, Any]:
        looked_for.extend(ids.tolist())
        # one more each time, so that growth goes on
        good = np.zeros(len(ids), np.bool_)
        good[np.flatnonzero(ids != 5)[:1]] = True
        return uv, good

    with patch.object(detector, "_refined", refined):
        first = GRID.points_m[:4]
        detector._grown(np.zeros((9, 9), np.uint8), first, 300.0 * first, 0.5)
    return looked_for.count(5)


def _compared_along_tag() -> float:
    """Points along a tag's side at which the image is compared with the print."""
    at: list[FloatArray] = []

    def gray_at(image: Any, places: FloatArray) -> FloatArray:
        at.append(places)
        return np.zeros(places.shape[:2])

    detector: Any = CornerDetector(GRID)
    with patch.object(corners, "gray_at", gray_at):
        H = np.diag([300.0, 300.0, 1.0])[None]
        detector._templates.likeness(np.zeros((9, 9), np.uint8), np.array([3]), np.zeros((1, 2)), H)
    return float(np.sqrt(at[0].shape[1]))


def _counts_in_prediction(neighbour: int) -> bool:
    """Whether the n-th nearest corner takes part in predicting a place."""
    board = np.column_stack([np.cos(np.arange(20.0)), np.sin(np.arange(20.0))])
    board *= 0.1 * (1.0 + np.arange(20.0))[:, None]
    uv = 300.0 * board
    before = predict(np.zeros((1, 2)), board, uv)[0]
    uv[neighbour - 1] += 5.0
    return bool(np.abs(predict(np.zeros((1, 2)), board, uv)[0] - before).max() > 1e-3)


# Description


def _is_board(count: int = 6, size_m: float = 0.08) -> bool:
    return not is_refused(lambda: Target("aprilgrid", count, 2, size_m, 0.3))


def _border_modules(target: Target) -> int:
    """Modules from the edge of its markers on that are dark in all of them."""
    is_dark = np.prod([marker.is_dark for marker in target.markers()], axis=0)
    middle = len(is_dark) // 2
    return int(np.argmin(is_dark[middle]))


# Diagnosis


def _read_of(board: Target, count: int) -> list[Read]:
    at = board.marker_corners()[:count]
    return [Read(k, 50.0 + 900.0 * uv, 0.9) for k, uv in enumerate(at)]


def _named(true: Target, described: Target, count: int = 8) -> str:
    """What is said of markers that are arranged otherwise than described."""
    with patch.object(diagnosis, "_most_read", lambda *_: _read_of(true, count)):
        return diagnosis._other_arrangement([], described) or ""


def _named_spacing(ratio: float) -> str:
    return _named(Target("aprilgrid", 6, 3, 0.088, ratio), Target("aprilgrid", 6, 3, 0.088, 0.77))


def _named_share(ratio: float) -> str:
    true = Target("charuco", 6, 3, 0.08, ratio, "DICT_5X5_1000")
    return _named(true, Target("charuco", 6, 3, 0.08, 0.2, "DICT_5X5_1000"))


@pytest.mark.parametrize("ratio", [0.1, 0.3, 0.5])
def test_names_the_spacing_of_tags(ratio: float) -> None:
    assert f"is about {ratio:g} in" in _named_spacing(ratio)


@pytest.mark.parametrize("ratio", [0.5, 0.7, 0.8])
def test_names_the_share_of_a_square_that_is_a_marker(ratio: float) -> None:
    assert f"is about {ratio:g} in" in _named_share(ratio)


def _columns_are_named(cols: int) -> bool:
    true = Target("aprilgrid", 2, cols, 0.02, 0.3)
    reads = [_read_of(true, 2 * cols)[k] for k in (0, 1, 2, cols, cols + 1, cols + 2)]
    with patch.object(diagnosis, "_most_read", lambda *_: reads):
        said = diagnosis._other_arrangement([], Target("aprilgrid", 6, 6, 0.02, 0.3)) or ""
    return f"rows of {cols} tags" in said


def _is_mirrored(found: int) -> bool:
    """Whether images are said to be mirrored in which ten corners are found, and in their mirror
    images more.
    """
    image = np.zeros((4, 4), np.uint8)
    image[:, 0] = 255

    def detect(self: Any, image: Any) -> Corners:
        count = 10 if image[0, 0] == 255 and image[0, 1] == 0 else 0
        count = found if image[0, -1] == 255 and image[0, -2] == 0 else count
        return Corners(np.arange(count), np.zeros((count, 2)))

    with (
        patch.object(CornerDetector, "detect", detect),
        patch.object(diagnosis, "_darkness", lambda *_: None),
        patch.object(diagnosis, "shown_twice", lambda *_: None),
        patch.object(diagnosis, "_other_arrangement", lambda *_: None),
        patch.object(diagnosis, "_other_kind", lambda *_, **__: None),
    ):
        return "mirrored" in (diagnosis.diagnose([image], GRID) or "")


def _refining_half_px(side_px: float) -> int:
    halves: list[int] = []
    uv = 20.0 + side_px * np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])

    def subpixel(image: Any, uv: FloatArray, half: int) -> FloatArray:
        halves.append(half)
        return uv

    with patch.object(diagnosis, "subpixel", subpixel):
        diagnosis._refined(np.zeros((999, 999), np.uint8), [Read(0, uv, 0.9)])
    return halves[0]


# Markers


def _looks(target: Target) -> list[tuple[float, int]]:
    """Scales and growths of light in which markers are looked for where none is found."""
    reader: Any = MarkerReader(target)
    looks: list[tuple[float, int]] = []
    with patch.object(reader, "_quads", lambda image, *look: looks.append(look)):
        reader._prints = SimpleNamespace(read=lambda *_: [])
        reader.find(np.zeros((9, 9), np.uint8))
    return looks


def _sampled_squares(target: Target = GRID) -> FloatArray:
    """Where a candidate is sampled, in its sides."""
    reader: Any = MarkerReader(target)
    at: list[FloatArray] = []

    def gray_at(image: Any, places: FloatArray) -> FloatArray:
        at.append(places)
        return np.zeros(places.shape[:2])

    square = np.array([[[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]]])
    with patch.object(seeds, "gray_at", gray_at):
        reader._prints.read(np.zeros((9, 9), np.uint8), square)
    return at[0]


def _correlation(grown: float = 1.0, blur_modules: float = 0.3) -> float:
    """Of a marker with its print, whose candidate is smaller than it is."""
    marker = GRID.markers()[0]
    texels = 12
    light = np.kron(1.0 - marker.is_dark, np.ones((texels, texels)))
    light = np.pad(light, 3 * texels, constant_values=1.0)
    image = cv2.GaussianBlur(30.0 + 200.0 * light, (0, 0), blur_modules * texels).astype(np.uint8)
    square = np.array([[-0.5, -0.5], [0.5, -0.5], [0.5, 0.5], [-0.5, 0.5]])
    side_px = len(marker.is_dark) * texels
    quad = 0.5 * (len(light) - 1) + side_px * square / grown
    reader: Any = MarkerReader(GRID)
    found = reader._prints.read(image, quad[None])
    return found[0].correlation if found else 0.0


# IMU


def _first_offset_s(offset_s: float = 0.3, intervals: int = 40) -> float:
    """What is found of the clocks before an adjustment; 0 where that is left to it."""
    record = SimpleNamespace(begin=np.zeros(2), end=np.ones(2))
    size = SimpleNamespace(finding=None)
    imu = ImuRecord(np.arange(9), np.zeros((9, 3)), np.zeros((9, 3)))
    with (
        patch.object(imu_checks, "judge_clocks", lambda *_: []),
        patch.object(imu_checks, "judge_size", lambda *_: size),
        patch.object(imu_checks, "_intervals", lambda *_: [None] * intervals),
        patch.object(imu_checks, "record_of", lambda *_: record),
        patch.object(imu_checks, "fit_gyro", lambda *_: SimpleNamespace(offset_s=offset_s)),
        patch.object(imu_checks, "_judge", lambda *_: []),
    ):
        return imu_checks.check_imu(np.arange(9), np.zeros((9, 4, 4)), 0.1, imu)


def _problem(views: int = 30, step_s: float = 0.1) -> Any:
    """A board before a camera with an IMU, which stand."""
    times = np.round(1e9 * (1.0 + step_s * np.arange(views))).astype(np.int64)
    poses = poses_by_known_lens(
        times, np.tile(np.eye(4), (views, 1, 1)), np.tile(np.eye(6), (views, 1, 1))
    )
    at = np.arange(0, times[-1] + 10**9, 10**7)
    values = np.tile([0.0, 0.0, 9.8], (len(at), 1))
    imu = ImuRecord(at, np.zeros((len(at), 3)), values)
    densities = ImuDensities(1e-3, 1e-4, 1e-2, 1e-3)
    return inertial._Problem(poses, imu, densities, 9.81, np.zeros(0, np.int64))


def _rates(step_s: float) -> int:
    """Between how many views that are so far apart rates are taken for the start."""
    counts: list[int] = []

    def align_gyro(motion: Any, rates: Any) -> Any:
        counts.append(len(motion.frames))
        raise DataError("a")

    with patch.object(inertial, "align_gyro", align_gyro):
        is_refused(_problem(step_s=step_s).start)
    return counts[0]


def _contradictionis_refused(sigma_deg: float) -> bool:
    """Whether an IMU is refused that contradicts the poses, where its rotation is known so well."""
    problem = _problem()
    states = SimpleNamespace()
    covariance = np.diag([0.0] * 3 + [np.radians(sigma_deg) ** 2] * 3 + [0.0] * 3)
    zero = np.zeros((30, 6, 1))
    with (
        patch.object(problem, "_motions", lambda at: None),
        patch.object(problem, "_weights", lambda at: None),
        patch.object(problem, "_camera_by_scale", lambda at: zero),
        patch.object(problem, "_camera_by_drift", lambda at: zero),
        patch.object(problem, "_system", lambda *_: (None, None, 1e9)),
        patch.object(problem, "_pose_scale", lambda at: 1.0),
        patch.object(problem, "_shared_covariance", lambda *_: covariance),
        patch.object(problem, "_extra", lambda *_: 1 / 0),
    ):
        try:
            problem.result(states)
        except ZeroDivisionError:
            return False
        except VioError:
            return True
    raise AssertionError


# Views, and what is said of them


def _is_used(corners: int) -> bool:
    """Whether corners are used in an adjustment, of a view that has so many of them."""
    seen = sightings(made_views(0, 8, Flaws(0.01), (LEFT,)), GRID.points_m)
    poses = [pose for pose in poses_of(LEFT, seen) if pose is not None]
    start = RigFit((LEFT,), np.eye(4)[None], np.stack(poses), np.zeros(2))
    is_kept = (seen.view != 3) | (np.cumsum(seen.view == 3) <= corners)
    seen = seen.take(np.flatnonzero(is_kept))
    found = BoardAdjustment(seen, fixed_lenses=True).solve(start)
    return bool(found.used[seen.view == 3].all())


def _residual_behind_px() -> float:
    """Of a corner that is behind the camera."""
    zero = np.zeros(1, np.int64)
    seen = Sightings(GRID.points_m, 1, 1, zero, zero, zero, np.zeros((1, 2)))
    T = np.eye(4)[None].copy()
    T[0, 2, 3] = -1.0
    behind = RigFit((LEFT,), np.eye(4)[None], T, np.zeros(2))
    return float(BoardAdjustment(seen)._residuals(behind)[0, 0])


def _views_of_lens_choice(views: int) -> int:
    """By how many of so many views lens models are compared."""
    n = np.repeat(np.arange(views), 2)
    zero = np.zeros(2 * views, np.int64)
    seen = Sightings(GRID.points_m, views, 1, n, zero, zero, np.zeros((2 * views, 2)))
    counts: list[int] = []
    with patch.object(lenses, "_scores", lambda few, *_: counts.append(few.views)):
        is_refused(lambda: lenses.choose_lens(seen, (752, 480)))
    return counts[0]


def _frames_kept() -> int:
    """Of a recording in which a board is looked for."""
    image = np.zeros((4, 4), np.uint8)

    def load(chosen: Any) -> Any:
        return ((k, (image,)) for k in chosen)

    raw = RawRecording(Path("a"), range(36), load, lambda: None)
    nothing = Corners(np.zeros(0, np.int64), np.zeros((0, 2)))
    detector: Any = SimpleNamespace(detect=lambda image: nothing, target=GRID)
    return len(film(raw, detector).samples)


def _tag_mm() -> float:
    """Side of a printed tag of 88 mm: width of a board but for five tags and seven gaps."""
    page = page_of(GRID)
    left, _, right, _ = page.rectangles[: len(GRID.dark_rectangles())].T
    return float(right.max() - left.min() - (5 + 7 * 0.3) * 88.0)


def _map_pixels() -> FloatArray:
    """Along width and height of an image, where maps are made."""
    grid = verdict.pixel_grid(LEFT)
    return np.array([len(np.unique(grid[:, k])) for k in (0, 1)])


def _corners_of_compensation(count: int) -> int:
    """By how many of so many corners a motion is found that undoes a lens's error."""
    counts: list[int] = []

    def lens_and_motion(camera: Any, p: FloatArray) -> tuple[FloatArray, FloatArray]:
        counts.append(len(p))
        raise ZeroDivisionError

    fit = SimpleNamespace(
        cameras=(LEFT,),
        bow=np.zeros(2),
        T_cam_cam0=np.eye(4)[None],
        T_cam0_board=np.eye(4)[None],
    )
    zero = np.zeros(count, np.int64)
    seen = Sightings(GRID.points_m, 1, 1, zero, zero, zero, np.zeros((count, 2)))
    found: Any = SimpleNamespace(at=fit, used=np.ones(count, np.bool_))
    with (
        patch.object(verdict, "_lens_and_motion", lens_and_motion),
        pytest.raises(ZeroDivisionError),
    ):
        verdict.projection_sigma_from_views(found, seen, 0, 1.0)
    return counts[0]


LIMITS: dict[str, tuple[Says, float, float]] = {
    "growth: rounds": (lambda n: _grown_tags() < n, 17, 18),
    "growth: tries": (lambda n: _tries() < n, 5, 6),
    "likeness: samples": (lambda x: _compared_along_tag() < x, 15.0, 17.0),
    "neighbours": (lambda n: not _counts_in_prediction(int(n)), 12, 13),
    "board: size": (lambda x: not _is_board(size_m=x), 0.95, 1.05),
    "board: count": (lambda n: not _is_board(int(n)), 100, 101),
    "tag: border": (lambda n: _border_modules(GRID) < n, 2, 3),
    "ChArUco: border": (lambda n: _border_modules(CHARUCO) < n, 1, 2),
    "diagnosis: columns": (lambda n: not _columns_are_named(int(n)), 14, 15),
    "diagnosis: mirrored": (lambda n: _is_mirrored(int(n)), 40, 41),
    "diagnosis: window": (lambda x: _refining_half_px(x) > 11, 99.0, 101.0),
    "diagnosis: tags": (
        lambda n: len(diagnosis._with_more_markers(GRID).markers()) < n,
        100,
        101,
    ),
    "marker: looks": (lambda n: len(_looks(GRID)) < n, 7, 8),
    "marker: samples": (lambda n: _sampled_squares().shape[1] < n * n, 24, 25),
    "marker: paper": (lambda x: -10.0 * _sampled_squares()[0].min() < x, 0.65, 0.85),
    "marker: as it is": (lambda x: _correlation(x) > 0.985, 0.95, 1.0),
    "marker: grown": (lambda x: _correlation(x) > 0.985, 1.5, 1.4),
    "marker: sharp": (lambda x: _correlation(blur_modules=x) > 0.985, 0.4, 0.3),
    "marker: blurred": (lambda x: _correlation(blur_modules=x) > 0.999, 0.6, 0.7),
    "clocks: offset": (lambda x: _first_offset_s(x) > 0.0, 0.048, 0.052),
    "clocks: motions": (lambda n: _first_offset_s(intervals=int(n)) > 0.0, 19, 20),
    "IMU: views": (lambda n: not is_refused(lambda: _problem(int(n))), 19, 20),
    "IMU: rates": (lambda x: _rates(x) == 0, 0.95, 1.05),
    "IMU: hopeless": (_contradictionis_refused, 9.5, 10.5),
    "lens: views": (lambda n: _views_of_lens_choice(int(n)) < n, 16, 17),
    "adjusted: corners": (lambda n: _is_used(int(n)), 3, 4),
    "adjusted: behind": (lambda x: _residual_behind_px() < x, 90.0, 110.0),
    "frames: kept": (lambda n: _frames_kept() < n, 4, 5),
    "print: tag": (lambda x: _tag_mm() < x, 87.0, 89.0),
    "map: width": (lambda n: _map_pixels()[0] < n, 13, 14),
    "map: height": (lambda n: _map_pixels()[1] < n, 9, 10),
    "lens: corners": (lambda n: _corners_of_compensation(int(n)) < n, 500, 501),
}


@pytest.mark.parametrize(("says", "below", "above"), LIMITS.values(), ids=LIMITS)
def test_limits_of_boards(says: Says, below: float, above: float) -> None:
    assert not says(below)
    assert says(above)


@pytest.mark.parametrize("target", [GRID, CHARUCO], ids=["tags", "squares"])
def test_markers_are_looked_for_at_whole_halves_and_quarters_of_an_image(target: Target) -> None:
    """A smaller image has each of its pixels from whole ones, and light grows to all sides alike."""
    for scale, grown_px in _looks(target):
        assert scale in {1.0, 0.5, 0.25}
        assert grown_px % 2 == 1


def test_depths_are_stated_where_the_tutorial_says() -> None:
    root = Path(__file__).resolve().parents[2]
    page = (root / "docs" / "tutorials" / "target.md").read_text(encoding="utf-8")
    assert set(re.findall(r"\bat (\d+) m\b", page)) == {f"{verdict.DEPTH_M:g}"}
