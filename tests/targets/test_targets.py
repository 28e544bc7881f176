"""Calibration with a printed board: descriptions, corners, cameras, verdict, files, command."""

from __future__ import annotations

import json
import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import cast

import cv2
import numpy as np
import pytest

from tests.board_views import (
    GRID,
    LEFT,
    RIGHT,
    SMALL,
    SMALL_LEFT,
    T_RIGHT_LEFT,
    Flaws,
    made_views,
    render_twice,
)
from vio import load_rig
from vio.cli import main
from vio.datasets import DatasetSettings, open_dataset
from vio.datasets.images import load_gray, write_png
from vio.errors import CalibrationError, DataError
from vio.geometry.distortion import CameraModel, project_point
from vio.geometry.lie import (
    FloatArray,
    se3_from_parts,
    se3_inverse,
    se3_log,
    so3_exp,
    transform_points,
)
from vio.numerics.statistics import chi_square_quantile
from vio.records import Image, IntArray
from vio.targets.blurred import PrintAligner
from vio.targets.bundle import (
    Adjusted,
    BoardAdjustment,
    RigFit,
    layout_of,
    lens_moved,
)
from vio.targets.calibrate import calibrate_cameras
from vio.targets.corners import NO_CORNERS, BoolArray, CornerDetector, Corners, subpixel
from vio.targets.description import Target, marker_dictionary, read_target, target_text
from vio.targets.homography import predict
from vio.targets.lenses import LENSES, choose_lens
from vio.targets.printing import page_of, svg_text
from vio.targets.recording import Filmed, RawRecording, film, open_raw
from vio.targets.rendering import BoardRenderer, Exposure, board_points
from vio.targets.results import basalt_text
from vio.targets.start import one_camera, pair_start, poses_of
from vio.targets.verdict import (
    depth_sigma,
    depths,
    judge,
    projection_sigma,
    projection_sigma_from_views,
    shared_difference,
)
from vio.targets.views import View, sightings

ROOT = Path(__file__).resolve().parents[2]
DATA = Path(os.environ.get("VIO_DATA") or ROOT.parent / "shared" / "data") / "targets"
needs_data = pytest.mark.skipif(not DATA.is_dir(), reason="needs the real boards of VIO_DATA")

DESCRIPTIONS = {
    "kalibr": (
        "target_type: 'aprilgrid'\ntagCols: 6\ntagRows: 4\ntagSize: 0.088\ntagSpacing: 0.3\n",
        Target("aprilgrid", 4, 6, 0.088, 0.3),
    ),
    "kalibr checkerboard": (
        "target_type: 'checkerboard'\ntargetCols: 6\ntargetRows: 7\nrowSpacingMeters: 0.06\n"
        "colSpacingMeters: 0.06\n",
        Target("checkerboard", 8, 7, 0.06),
    ),
    "opencv": (
        "%YAML:1.0\n---\nBoardSize_Width: 9\nBoardSize_Height: 6\nSquare_Size: 0.05\n"
        "Calibrate_Pattern: CHESSBOARD\n",
        Target("checkerboard", 7, 10, 0.05),
    ),
    "boofcv": (
        "boofcv.alg.fiducial.calib.ConfigCalibrationTarget:\n  grid:\n    numRows: 7\n"
        "    shapeSize: 0.03\n    numCols: 5\n",
        Target("checkerboard", 7, 5, 0.03),
    ),
}


@pytest.mark.parametrize("name", DESCRIPTIONS)
def test_reads_descriptions_of_other_tools(name: str, tmp_path: Path) -> None:
    text, expected = DESCRIPTIONS[name]
    file = tmp_path / "target.yaml"
    file.write_text(text)
    assert read_target(file) == expected


@pytest.mark.parametrize(
    "target",
    [GRID, Target("charuco", 5, 7, 0.04, 0.7, "DICT_4X4_50"), Target("checkerboard", 7, 10, 0.02)],
    ids=lambda target: target.kind,
)
def test_reads_what_it_writes(target: Target, tmp_path: Path) -> None:
    file = tmp_path / "target.yaml"
    file.write_text(target_text(target))
    assert read_target(file) == target
    assert read_target(file, size_m=0.05).size_m == 0.05


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (("tagSize: 0.088", "tagSize: 88"), "in metres"),
        (("tagSpacing: 0.3", "tagSpacing: 26.4"), "tagSpacing"),
        (("tagCols: 6", ""), "tagCols"),
        (("'aprilgrid'", "'circlegrid'"), "circlegrid"),
    ],
)
def test_names_what_is_wrong_with_a_description(
    change: tuple[str, str], words: str, tmp_path: Path
) -> None:
    file = tmp_path / "target.yaml"
    file.write_text(DESCRIPTIONS["kalibr"][0].replace(*change))
    with pytest.raises(CalibrationError, match=words) as caught:
        read_target(file)
    assert str(file) in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_side_in_no_unit_is_asked_for(tmp_path: Path) -> None:
    """BoofCV's own examples have 1, which made a pair's baseline 33 times as long."""
    file = tmp_path / "target.yaml"
    text, expected = DESCRIPTIONS["boofcv"]
    file.write_text(text.replace("0.03", "1.0"))
    with pytest.raises(CalibrationError, match=r"shapeSize is 1, .* measure a square .*--size"):
        read_target(file)
    assert read_target(file, size_m=0.03) == expected


def test_the_page_has_the_size_of_the_board_and_a_ruler() -> None:
    page = page_of(GRID)
    width = 1e3 * (6 * GRID.pitch_m + GRID.pitch_m - GRID.size_m)
    board = page.rectangles[: len(GRID.dark_rectangles())]
    assert np.ptp(board[:, [0, 2]]) == pytest.approx(width, abs=0.01)
    assert f'width="{page.width:.4f}mm"' in svg_text(page)
    assert any("ruler" in text for _, _, text in page.words)


def _detected(
    target: Target, camera: CameraModel, T: FloatArray, exposure: Exposure
) -> tuple[Corners, FloatArray, BoolArray]:
    renderer = BoardRenderer(target, camera)
    found = CornerDetector(target).detect(renderer.render(T, exposure))
    uv, seen = renderer.corners(T)
    inside = seen & (uv > 4).all(axis=1)
    inside &= (uv < np.array([camera.width, camera.height]) - 5).all(axis=1)
    return found, uv, inside


@pytest.mark.parametrize(
    ("exposure", "share", "error_px"),
    [(Exposure(0.7, 3.0), 0.95, 0.09), (Exposure(0.7, 10.0), 0.85, 0.2)],
    ids=["sharp", "noisy"],
)
def test_finds_corners_of_a_grid(exposure: Exposure, share: float, error_px: float) -> None:
    T = se3_from_parts(so3_exp([0.3, -0.2, 0.1]), [-0.3, -0.25, 0.5])
    found, uv, inside = _detected(GRID, SMALL_LEFT, T, exposure)
    off = np.linalg.norm(found.uv - uv[found.ids], axis=1)
    assert len(found) > share * inside.sum()
    assert np.median(off) < error_px
    error = found.uv - uv[found.ids]
    # No half pixel: the mean is zero within four of its standard deviations.
    assert (np.abs(error.mean(axis=0)) < 4 * error.std(axis=0) / np.sqrt(len(error))).all()


def test_a_far_tag_is_found_in_its_size() -> None:
    """The detector of OpenCV that these corners begin with finds tags 2 % too small."""
    scales = []
    for turn in (0.1, 0.4, 0.7):
        T = se3_from_parts(so3_exp([0.05, -0.1, turn]), [-0.3, -0.25, 0.8])
        found, uv, _ = _detected(GRID, SMALL_LEFT, T, Exposure(0.7, 3.0))
        for tag in np.unique(found.ids // 4):
            own = found.ids // 4 == tag
            if own.sum() < 4:
                continue
            true = uv[found.ids[own]] - uv[found.ids[own]].mean(axis=0)
            scales.append((found.uv[own] * true).sum() / (true * true).sum())
    assert len(scales) > 80
    assert np.mean(scales) == pytest.approx(1, abs=1e-3)


@pytest.mark.parametrize("blur_px", [2.0, 4.0])
def test_finds_corners_of_a_blurred_grid(blur_px: float) -> None:
    T = se3_from_parts(so3_exp([0.3, -0.2, 0.1]), [-0.2, -0.17, 0.32])
    found, uv, inside = _detected(SMALL, SMALL_LEFT, T, Exposure(blur_px, 3.0))
    off = np.linalg.norm(found.uv - uv[found.ids], axis=1)
    assert len(found) > 0.8 * inside.sum()
    assert np.median(off) < 0.1
    assert np.abs(np.median(found.uv - uv[found.ids], axis=0)).max() < 0.03


def test_measures_the_blur_of_an_image() -> None:
    T = se3_from_parts(so3_exp([0.3, -0.2, 0.1]), [-0.2, -0.17, 0.32])
    renderer = BoardRenderer(SMALL, SMALL_LEFT)
    uv, _ = renderer.corners(T)
    ids = np.arange(len(uv))
    _, H = predict(SMALL.points_m, SMALL.points_m, uv)
    found = [
        PrintAligner(SMALL).blur_px(renderer.render(T, Exposure(blur, 3.0)), ids, uv, H)
        for blur in (0.7, 2.0, 4.0)
    ]
    assert found == [0.7, 2.0, 4.0]


def test_finds_a_distant_sharp_grid() -> None:
    """Its tags touch the dark squares at their corners, which makes them one blob."""
    camera = CameraModel(345, 346, 280, 180, 564, 360)
    T = se3_from_parts(so3_exp([0.3, -0.2, 0.1]), [-0.3, -0.3, 1.2])
    found, _, inside = _detected(GRID, camera, T, Exposure(0.6, 1.0))
    assert len(found) > 0.9 * inside.sum()


def test_finds_corners_through_a_lens_of_150_degrees() -> None:
    camera = CameraModel(213, 213, 281.5, 179.5, 564, 360, "equidistant", (0.0,) * 4)
    T = se3_from_parts(so3_exp([0.1, -0.1, 0.1]), [-0.3, -0.3, 0.42])
    found, uv, inside = _detected(GRID, camera, T, Exposure())
    assert len(found) > 0.75 * inside.sum()
    assert np.median(np.linalg.norm(found.uv - uv[found.ids], axis=1)) < 0.08


@pytest.mark.parametrize(
    "target",
    [
        Target("charuco", 6, 8, 0.05, 0.7, "DICT_4X4_50"),
        Target("charuco", 6, 8, 0.05, 0.7, "DICT_4X4_50", legacy=True),
        Target("checkerboard", 6, 9, 0.05),
        Target("checkerboard", 6, 8, 0.05),
        Target("checkerboard", 6, 6, 0.05),
        Target("checkerboard", 7, 7, 0.05),
    ],
    ids=["charuco", "legacy charuco", "checkerboard", "even", "even square", "odd square"],
)
@pytest.mark.parametrize("turn", [0.1, 1.9, 3.0], ids=["upright", "on its side", "turned"])
def test_finds_corners_of_other_boards(target: Target, turn: float) -> None:
    R = so3_exp([0, 0, turn]) @ so3_exp([0.3, -0.2, 0])
    centre = np.array([*(0.5 * np.array(target.extent_m)), 0.0])
    T = se3_from_parts(R, [0.0, 0.0, 0.6] - R @ centre)
    found, uv, inside = _detected(target, SMALL_LEFT, T, Exposure(0.6, 2.0))
    # Of the orders that nobody can tell apart, the one whose first corners are upper left.
    last = 0 if target.kind == "charuco" else target.cols - 2  # of the first row
    orders = [uv[order] for order in target.symmetries()]
    truth = max(orders, key=lambda one: (one[last] - one[0])[0] + (one[-1] - one[last])[1])
    truth = truth[found.ids]
    assert len(found) > 0.9 * inside.sum()
    assert np.median(np.linalg.norm(found.uv - truth, axis=1)) < 0.15
    assert np.abs(np.mean(found.uv - truth, axis=0)).max() < 0.05


@dataclass
class TurnedNumbers:
    """Stands in for the detector: an image's number says which corners, numbered in any order in
    which the board looks the same.
    """

    target: Target
    uv: dict[int, FloatArray]

    def detect(self, image: Image) -> Corners:
        number = int(image[0, 0])
        orders = self.target.symmetries()
        return Corners(self.target_ids, self.uv[number][orders[number % 7 % len(orders)]])

    @property
    def target_ids(self) -> IntArray:
        return np.arange(len(self.target.points_m))


@pytest.mark.parametrize(
    "target",
    [Target("checkerboard", 7, 7, 0.05), Target("checkerboard", 6, 8, 0.05)],
    ids=["square", "even"],
)
def test_numbers_a_board_that_looks_the_same_turned_alike_in_all_images(target: Target) -> None:
    points = board_points(target)
    uv: dict[int, FloatArray] = {}
    for k, roll in enumerate(np.linspace(0, 2 * np.pi, 24)):
        R = so3_exp([0.3, -0.2, 0]) @ so3_exp([0, 0, roll])
        T = se3_from_parts(R, [0.0, 0.0, 1.0] - R @ points.mean(axis=0))
        uv[k] = project_point(LEFT, transform_points(T, points))[0]
        uv[k + 100] = project_point(RIGHT, transform_points(T_RIGHT_LEFT @ T, points))[0]

    def load(chosen: Sequence[int]) -> Iterator[tuple[int, tuple[Image, ...]]]:
        for k in chosen:
            yield k, tuple(np.full((8, 8), n, dtype=np.uint8) for n in (k, k + 100))

    raw = RawRecording(Path("board"), list(range(24)), load, lambda: None)
    filmed = film(raw, cast("CornerDetector", TurnedNumbers(target, uv)))
    assert len(filmed.views) == 24
    first = filmed.views[0].corners[0].uv
    order = next(o for o in target.symmetries() if np.allclose(uv[0][o], first))
    for view in filmed.views:
        for corners, number in zip(view.corners, (view.time_ns, view.time_ns + 100), strict=True):
            assert np.allclose(corners.uv, uv[number][order][corners.ids])


def test_opencv_agrees_on_the_charuco_board() -> None:
    target = Target("charuco", 5, 7, 0.04, 0.7, "DICT_4X4_50")
    board = cv2.aruco.CharucoBoard((7, 5), 0.04, 0.028, marker_dictionary("DICT_4X4_50"))
    assert np.allclose(np.array(board.getChessboardCorners())[:, :2], target.points_m)
    ours = np.stack([marker.corners_m for marker in target.markers()])
    assert np.allclose(np.array(board.getObjPoints())[:, :, :2], ours, atol=1e-6)


def test_the_border_of_kalibrs_tags_has_two_bits() -> None:
    marker = GRID.markers()[0]
    assert marker.is_dark.shape == (10, 10)
    assert marker.is_dark[:2].all()
    assert marker.is_dark[:, -2:].all()
    assert not marker.is_dark[2:-2, 2:-2].all()


def test_a_tag_is_printed_as_its_family_defines_it() -> None:
    """OpenCV's dictionary has the family's tags turned by 180 degrees."""
    first = 0xD5D628584  # of tag36h11, row by row from the top left; Olson, AprilTag (2011)
    light = np.array([first >> (35 - k) & 1 for k in range(36)], dtype=bool).reshape(6, 6)
    assert (~GRID.markers()[0].is_dark[2:-2, 2:-2] == light).all()


def test_reads_refined_corners_of_either_shape(monkeypatch: pytest.MonkeyPatch) -> None:
    """OpenCV 5 returns (N, 2) where OpenCV 4 returns (N, 1, 2)."""
    image = np.zeros((40, 60), dtype=np.uint8)
    image[:20, :30] = 200
    image[20:, 30:] = 200
    near = np.array([[30.0, 20.0], [29.0, 19.0]])
    as_usual = subpixel(image, near, 4)
    assert np.allclose(as_usual, [29.5, 19.5], atol=0.05)
    refine = cv2.cornerSubPix
    for shape in ((-1, 2), (-1, 1, 2)):
        monkeypatch.setattr(
            cv2, "cornerSubPix", lambda *args, shape=shape: refine(*args).reshape(shape)
        )
        assert (subpixel(image, near, 4) == as_usual).all()


@needs_data
@pytest.mark.parametrize(("name", "least"), [("001", 140), ("004", 80)])
def test_real_photographs_have_the_numbering_and_corner_order_of_the_description(
    name: str, least: int
) -> None:
    image = load_gray(DATA / "aprilgrid_6x6" / f"{name}.jpg")[0]
    found = CornerDetector(GRID).detect(image)
    assert len(found) >= least
    # One homography for the whole board: a wrong corner order is off by a tag, 70 px.
    H, _ = cv2.findHomography(GRID.points_m[found.ids], found.uv)
    expected = cv2.perspectiveTransform(GRID.points_m[found.ids][:, None], H)[:, 0]
    assert np.median(np.linalg.norm(expected - found.uv, axis=1)) < 6


def _pair(seed: int, flaws: Flaws | None = None, count: int = 20) -> tuple[Adjusted, RigFit]:
    """Adjust a pair from lenses that are off."""
    seen = sightings(made_views(seed, count, flaws), GRID.points_m)
    step = np.array([4.0, -3, 2, 2, 0.02, -0.01, 0, 0])
    cameras = (lens_moved(LEFT, step), lens_moved(RIGHT, step))
    poses = np.stack([T for T in poses_of(cameras[0], seen.of_camera(0)) if T is not None])
    T_cam_cam0 = np.stack([np.eye(4), se3_from_parts(np.eye(3), [-0.1, 0.0, 0.0])])
    found = BoardAdjustment(seen).solve(RigFit(cameras, T_cam_cam0, poses, np.zeros(2)))
    return found, found.at


def test_starts_without_a_guess() -> None:
    seen = sightings(made_views(4, 10), GRID.points_m)
    alone = [one_camera(seen.of_camera(c), (752, 480), "radtan", 4) for c in (0, 1)]
    fit = pair_start(seen, (alone[0], alone[1]))
    assert fit.cameras[0].fu == pytest.approx(LEFT.fu, rel=2e-3)
    xi = se3_log(fit.T_cam_cam0[1] @ se3_inverse(T_RIGHT_LEFT))
    assert np.linalg.norm(xi[:3]) < 3e-3


def _depth_error(fit: RigFit) -> float:
    p = np.array([[0.0, 0.0, 5.0]])
    uv0, _ = project_point(LEFT, p)
    uv1, _ = project_point(RIGHT, p @ T_RIGHT_LEFT[:3, :3].T + T_RIGHT_LEFT[:3, 3])
    return float(depths(fit, uv0, uv1)[0] / 5 - 1)


@pytest.mark.parametrize(
    "flaws",
    [Flaws(), Flaws(bow_m=(0.001, -0.0005)), Flaws(wrong_share=0.01)],
    ids=["good", "bowed board", "wrong corners"],
)
def test_calibrates_a_pair_within_the_stated_sigmas(flaws: Flaws) -> None:
    found, fit = _pair(5, flaws)
    layout = layout_of(fit.cameras)
    sigma = np.sqrt(np.diag(found.covariance))
    a = fit.cameras[0]
    assert abs(a.fu - LEFT.fu) < 0.15
    assert abs(a.cu - LEFT.cu) < 0.15
    xi = se3_log(fit.T_cam_cam0[1] @ se3_inverse(T_RIGHT_LEFT))
    assert np.linalg.norm(xi[:3]) < 1e-4
    assert np.degrees(np.linalg.norm(xi[3:])) < 0.02
    assert np.abs(xi / sigma[layout.poses[0]]).max() < 4
    assert abs(_depth_error(fit)) < 0.002
    assert np.abs(fit.bow - flaws.bow_m).max() < 1e-4
    assert found.sigma_px == pytest.approx([0.05, 0.05], rel=0.1)


def test_weighs_images_by_how_accurate_their_corners_are() -> None:
    """Blurred views beside sharp ones leave what the sharp ones show."""
    views = made_views(6, 24)
    rng = np.random.default_rng(6)
    blurred = [
        replace(view, corners=tuple(_with_noise(one, 0.4, rng) for one in view.corners))
        for view in views[::2]
    ]
    start = RigFit(
        (LEFT, RIGHT), np.stack([np.eye(4), T_RIGHT_LEFT]), np.zeros((0, 4, 4)), np.zeros(2)
    )
    alone = _adjusted_from(start, views[1::2])
    both = _adjusted_from(start, [*blurred, *views[1::2]])
    assert np.percentile(both.corner_sigma_px, [25, 75]) == pytest.approx([0.05, 0.4], rel=0.15)
    sigma = np.sqrt(np.diag(both.covariance))
    assert (sigma < 1.15 * np.sqrt(np.diag(alone.covariance))).all()
    error = shared_difference(both.at, _truth(both.at, Flaws()))
    assert float(error @ np.linalg.solve(both.covariance, error)) < chi_square_quantile(0.999, 24)


def _with_noise(corners: Corners, sigma_px: float, rng: np.random.Generator) -> Corners:
    return replace(corners, uv=corners.uv + sigma_px * rng.normal(size=corners.uv.shape))


def _adjusted_from(start: RigFit, views: list[View]) -> Adjusted:
    seen = sightings(views, GRID.points_m)
    poses = np.stack([T for T in poses_of(LEFT, seen.of_camera(0)) if T is not None])
    return BoardAdjustment(seen).solve(replace(start, T_cam0_board=poses))


def _truth(fit: RigFit, flaws: Flaws) -> RigFit:
    T_cam_cam0 = np.stack([np.eye(4), T_RIGHT_LEFT])
    return RigFit((LEFT, RIGHT), T_cam_cam0, fit.T_cam0_board, np.array(flaws.bow_m))


def _whitened(seeds: range, count: int, flaws: Flaws) -> tuple[FloatArray, FloatArray]:
    """Errors over stated sigmas (D, S) of the shared unknowns, and the NEES (D,)."""
    errors: list[FloatArray] = []
    nees: list[float] = []
    for seed in seeds:
        found, fit = _pair(seed, flaws, count)
        error = shared_difference(fit, _truth(fit, flaws))
        errors.append(error / np.sqrt(np.diag(found.covariance)))
        nees.append(float(error @ np.linalg.solve(found.covariance, error)))
    return np.array(errors), np.array(nees)


def _band(probability: float, dof: int) -> tuple[float, float]:
    """Bounds of the mean of `dof` squared standard normal variables, at both ends."""
    low, high = (chi_square_quantile(p, dof) / dof for p in (1 - probability, probability))
    return float(low), float(high)


def test_stated_sigmas_are_those_of_the_errors() -> None:
    errors, nees = _whitened(range(20, 24), 12, Flaws())
    low, high = _band(0.999, errors.size)
    assert low < nees.sum() / errors.size < high


@pytest.mark.slow
@pytest.mark.parametrize("flaws", [Flaws(), Flaws(bow_m=(0.001, -0.0005))], ids=["flat", "bowed"])
def test_sigmas_of_thirty_views_hold_for_each_unknown(flaws: Flaws) -> None:
    errors, nees = _whitened(range(100, 124), 30, flaws)
    low, high = _band(0.9999, len(errors))  # 24 unknowns are looked at
    each = np.mean(errors**2, axis=0)
    assert (each > low).all()
    assert (each < high).all()
    low, high = _band(0.999, errors.size)
    assert low < nees.sum() / errors.size < high


def test_halves_that_agree_inflate_nothing() -> None:
    """A map of the difference alone exceeds 1.5 in healthy recordings, as few unknowns rule it."""
    ratios = []
    for seed in range(40, 46):
        found, _ = _pair(seed, count=12)
        seen = sightings(made_views(seed, 12), GRID.points_m)
        verdict = judge(found, seen, found.sigma_px.tolist())
        assert verdict.inflation == 1
        ratios.append(verdict.halves.ratio)
    assert np.sqrt(np.mean(np.square(ratios))) == pytest.approx(1, abs=0.2)


def test_halves_have_all_cameras_where_every_other_view_lacks_one() -> None:
    views = [
        replace(view, corners=(view.corners[0], NO_CORNERS)) if number % 2 else view
        for number, view in enumerate(made_views(3, 24))
    ]
    verdict = calibrate_cameras(_filmed(views), GRID, "radtan").verdict
    assert verdict.inflation == 1
    assert verdict.findings == ()


def test_depth_has_a_sigma_where_views_leave_a_focal_length_free() -> None:
    """It is that of the linear problem, whose steps must not pass a focal length of zero."""
    found, _ = _pair(40, count=12)
    known = depth_sigma(found)
    free = depth_sigma(replace(found, covariance=1e10 * found.covariance))
    np.testing.assert_allclose(free, 1e5 * known, rtol=0.01)


def test_chooses_the_lens_by_views_left_out(monkeypatch: pytest.MonkeyPatch) -> None:
    two = {name: LENSES[name] for name in ("radtan", "equidistant")}
    monkeypatch.setattr("vio.targets.lenses.LENSES", two)  # the order of the others stays
    wide = CameraModel(285, 285, 370, 242, 752, 480, "equidistant", (0.02, -0.01, 0.004, -0.001))
    seen = sightings(made_views(1, 10, cameras=(wide,)), GRID.points_m)
    choice = choose_lens(seen, (752, 480))
    assert choice.name == "equidistant"
    assert next(s for s in choice.scores if s.name == choice.name).rms_px < 0.06


def _filmed(views: list[View], frames: int = 40) -> Filmed:
    return Filmed(views, ((752, 480), (752, 480)), frames, None, ())


@pytest.mark.parametrize(
    ("degrees", "first", "named"), [(0.5, 6, True), (1.2, 9, True), (0.0, 6, False)]
)
def test_names_a_pair_that_was_moved_between_views(
    degrees: float, first: int, named: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The robust fit leaves the moved part out, and its halves agree."""
    views = made_views(1, first)
    turned = se3_from_parts(so3_exp([0, np.radians(degrees), 0]), np.zeros(3)) @ T_RIGHT_LEFT
    monkeypatch.setattr("tests.board_views.T_RIGHT_LEFT", turned)
    views += [replace(view, time_ns=10**10 + view.time_ns) for view in made_views(2, 12 - first)]
    found = calibrate_cameras(_filmed(views), GRID, "radtan").verdict.findings
    assert (
        any("the cameras were moved against each other, or refocused" in text for text in found)
        == named
    )
    if not named:
        assert found == ()


def test_names_pairs_that_are_not_of_one_moment() -> None:
    good = calibrate_cameras(_filmed(made_views(2, 12)), GRID, "radtan")
    assert good.verdict.findings == ()
    assert good.verdict.inflation == 1
    filmed = _filmed(made_views(2, 12, Flaws(moved_m=0.002)))
    twice = render_twice(GRID, LEFT, 1.3)
    late = calibrate_cameras(replace(filmed, samples=((twice, twice),)), GRID, "radtan")
    assert any("not exposed at the same moment" in finding for finding in late.verdict.findings)
    assert "the images show the board twice" in late.verdict.findings[0]


def test_refuses_images_of_other_moments() -> None:
    views = made_views(2, 12)
    mixed = [
        View(one.time_ns, (one.corners[0], other.corners[1]))
        for one, other in zip(views, [*views[1:], views[0]], strict=True)
    ]
    with pytest.raises(DataError, match="not of the same moments") as caught:
        calibrate_cameras(_filmed(mixed), GRID, "radtan")
    assert "\n" not in str(caught.value)


def test_refuses_exchanged_cameras() -> None:
    exchanged = [View(one.time_ns, one.corners[::-1]) for one in made_views(2, 12)]
    with pytest.raises(DataError, match="exchange left and right images"):
        calibrate_cameras(_filmed(exchanged), GRID, "radtan")


@pytest.mark.parametrize("sign", [1, -1])
def test_refuses_a_pair_that_no_rectification_holds(sign: int) -> None:
    turned = []
    for view in made_views(2, 12):
        left, right = view.corners
        u, v = right.uv.T
        uv = np.column_stack([479 - v, u] if sign > 0 else [v, 751 - u])
        turned.append(replace(view, corners=(left, replace(right, uv=uv))))
    filmed = replace(_filmed(turned), sizes=((752, 480), (480, 752)))
    with pytest.raises(DataError, match=r"right camera is turned by (89|90|91) degrees"):
        calibrate_cameras(filmed, GRID, "radtan")


def _fill(folder: Path, shapes: dict[str, list[tuple[int, int]]]) -> Path:
    for side, sizes in shapes.items():
        (folder / side).mkdir(parents=True)
        for k, shape in enumerate(sizes):
            write_png(folder / side / f"{k:04d}.png", np.zeros(shape, dtype=np.uint8))
    return folder


def test_reads_images_of_the_size_that_most_have(tmp_path: Path) -> None:
    shapes = [(120, 188), *[(240, 376)] * 5]
    raw = open_raw(str(_fill(tmp_path / "mixed", {"left": shapes, "right": shapes})))
    read = list(raw.load(range(6)))
    assert len(read) == 5
    assert all(image.shape == (240, 376) for _, images in read for image in images)


def test_names_a_camera_whose_images_are_turned(tmp_path: Path) -> None:
    folder = _fill(tmp_path / "turned", {"left": [(240, 376)] * 3, "right": [(376, 240)] * 3})
    with pytest.raises(DataError, match="turn those of one camera") as caught:
        open_raw(str(folder))
    assert "left images have 376 x 240 pixels, and right ones 240 x 376" in str(caught.value)


def test_names_what_the_views_do_not_show() -> None:
    views = []
    for view in made_views(2, 40):
        left, right = view.corners
        if (left.uv[:, 0] > 260).all():
            views.append(View(view.time_ns, (left, right)))
    assert len(views) >= 8
    found = calibrate_cameras(_filmed(views), GRID, "radtan")
    assert any("left image is empty at upper left" in text for text in found.verdict.findings)


def test_uncertainty_grows_where_there_are_no_corners() -> None:
    found, fit = _pair(7)
    lens = layout_of(fit.cameras).lenses[0]
    sigma = projection_sigma(fit.cameras[0], found.covariance[lens, lens]).reshape(9, 13)
    corners = sigma[[0, 0, -1, -1], [0, -1, 0, -1]]
    assert corners.min() > 2 * sigma[4, 6]


def test_uncertainty_is_least_at_the_distances_of_the_board() -> None:
    seen = sightings(made_views(7, 20), GRID.points_m)
    found, _ = _pair(7)
    middle = [
        projection_sigma_from_views(found, seen, 1, distance)[9 * 13 // 2]
        for distance in (0.1, 0.8, 100.0)
    ]
    assert middle[1] < 0.5 * middle[0]
    assert middle[1] < middle[2]


def test_says_what_to_record_where_views_are_missing() -> None:
    views = made_views(3, 12)
    with pytest.raises(DataError, match="sees the board in 3 of 40 frames"):
        calibrate_cameras(_filmed(views[:3]), GRID)
    none = type(views[0].corners[0])(np.zeros(0, dtype=np.int64), np.zeros((0, 2)))
    apart = [
        View(view.time_ns, (view.corners[0], none) if k % 2 else (none, view.corners[1]))
        for k, view in enumerate(made_views(3, 20))
    ]
    with pytest.raises(DataError, match="see the board together in 0 frames"):
        calibrate_cameras(_filmed(apart), GRID)


def test_the_command_calibrates_a_folder_of_pairs(
    board_pairs: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    target = tmp_path / "target.yaml"
    target.write_text(target_text(SMALL))
    out = tmp_path / "rig"
    command = ["calibrate-rig", str(board_pairs), "--target", str(target), "--lens", "radtan"]
    assert main([*command, "--out", str(out)]) == 0
    assert "vio run" in capsys.readouterr().out
    facts = json.loads((out / "calibration.json").read_text())
    assert facts["cameras"][0]["fu_fv_cu_cv"][0] == pytest.approx(SMALL_LEFT.fu, rel=5e-3)
    assert (out / "calibration.png").stat().st_size > 10_000
    page = (out / "report.html").read_text(encoding="utf-8")
    assert page.count("<img") == 5
    assert "A point 5 m away is placed within" in page
    assert "http" not in page  # it holds all it shows
    kalibr = load_rig(out / "camchain-imucam.yaml")
    assert np.linalg.norm(kalibr.right[1][:3, 3]) == pytest.approx(0.11, abs=1e-3)
    for name in ("stereo.yml", "left.yaml"):
        other = load_rig(out / name, image_size=(376, 240))
        assert np.allclose(other.right[1], kalibr.right[1], atol=1e-6)
        assert np.allclose(other.cam0.K, kalibr.cam0.K)
    settings = DatasetSettings(calibration=out / "camchain-imucam.yaml")
    dataset = open_dataset(board_pairs, settings)  # as vio run --calibration does
    assert dataset.recording.camera.baseline_m == pytest.approx(0.11, abs=1e-3)
    basalt = json.loads((out / "basalt.json").read_text())["value0"]
    assert basalt["intrinsics"][0]["camera_type"] == "pinhole-radtan8"
    assert basalt_text(kalibr) is not None


def test_another_board_is_refused_in_one_line(
    board_pairs: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    target = tmp_path / "target.yaml"
    target.write_text(target_text(Target("charuco", 5, 7, 0.04, 0.7, "DICT_4X4_50")))
    assert main(["calibrate-rig", str(board_pairs), "--target", str(target)]) == 1
    message = capsys.readouterr().err
    assert "the images show an AprilGrid with tags 0 to 11" in message
    assert "give the file of the board that was recorded" in message
    assert message.count("\n") == 1


@pytest.mark.parametrize(
    ("side_m", "paper"), [("0.022", "A4"), ("0.03", "A3"), ("0.2", "paper larger than A0")]
)
def test_names_the_paper_that_holds_a_board(
    side_m: str, paper: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["target", str(tmp_path / "board.svg"), "--size", side_m]) == 0
    assert f"print on {paper} without scaling" in capsys.readouterr().out


@pytest.mark.parametrize("suffix", ["svg", "pdf"])
def test_the_command_writes_a_board_and_its_description(suffix: str, tmp_path: Path) -> None:
    page = tmp_path / f"board.{suffix}"
    assert main(["target", str(page), "--kind", "charuco", "--size", "0.03"]) == 0
    assert page.stat().st_size > 1000
    assert read_target(page.with_suffix(".yaml")).size_m == 0.03


@pytest.mark.parametrize(("off_px", "kept"), [(0.27, True), (0.34, False)])
def test_a_corner_of_an_exact_view_may_be_off_by_a_third_of_a_pixel(
    off_px: float, kept: bool
) -> None:
    detector = CornerDetector(GRID)
    uv = 100.0 + 2000.0 * detector.points_m[:, :2]
    middle = len(uv) // 2
    uv[middle, 0] += off_px
    assert detector._agree(np.arange(len(uv)), uv)[middle] == kept
