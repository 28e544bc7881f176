"""Every lens model is one that a calibration with a board can find and choose."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from tests.board_views import GRID, LEFT, made_views, poses_around, views_around
from vio.cli import main
from vio.datasets.rigs import load_rig
from vio.geometry.distortion import CameraModel, project_point, unproject_pixel
from vio.geometry.lenses.registry import LENSES as MODELS
from vio.geometry.rectify import field_of_view
from vio.targets.calibrate import CameraCalibration, calibrate_cameras, lens_finding
from vio.targets.corners import CornerDetector
from vio.targets.lenses import LENSES, Rival, choose_lens
from vio.targets.recording import Filmed
from vio.targets.rendering import BoardRenderer, Exposure
from vio.targets.results import write_rig
from vio.targets.views import View, sightings

EUCM = CameraModel(300, 300.4, 372.0, 241.5, 752, 480, "eucm", (0.63, 1.08))
FOV = CameraModel(340, 340.4, 372.0, 241.5, 752, 480, "fov", (1.25,))


def _largest_error(found: CameraModel, true: CameraModel, share: float) -> float:
    """Largest distance in pixels of the two over a share of the image's width and height."""
    part = np.linspace(0.5 - 0.5 * share, 0.5 + 0.5 * share, 13)
    grid = np.meshgrid(part * (true.width - 1), part * (true.height - 1))
    uv = np.stack(grid, axis=-1).reshape(-1, 2)
    ray, valid = unproject_pixel(true, uv)
    off = np.linalg.norm(project_point(found, ray)[0] - uv, axis=1)
    return float(off[valid].max())


def test_a_choice_has_a_name_and_a_rank_of_its_own() -> None:
    choices = [choice for lens in MODELS.values() for choice in lens.choices]
    assert len({choice.name for choice in choices}) == len(choices)
    assert len({choice.rank for choice in choices}) == len(choices)
    for lens in MODELS.values():
        for choice in lens.choices:
            assert choice.count in lens.counts
            assert len(lens.start(choice.count)) == choice.count
            assert lens.fault(lens.start(choice.count)) is None
    assert list(LENSES)[:3] == ["radtan", "equidistant", "double_sphere"]


@pytest.mark.parametrize(
    "true", [pytest.param(EUCM, marks=pytest.mark.slow), FOV], ids=lambda camera: camera.model
)
def test_explains_lenses_of_150_degrees_by_views_left_out(true: CameraModel) -> None:
    """A model that explains the lens as well as its own may be preferred."""
    assert np.degrees(field_of_view(true)[0]) > 140
    seen = sightings(views_around(true, 20, 1), GRID.points_m)
    choice = choose_lens(seen, (752, 480))
    rms_px = {score.name: score.rms_px for score in choice.scores}
    assert rms_px[true.model] < 0.055
    assert rms_px[choice.name] < 1.02 * min(rms_px.values())
    assert true.model in (choice.name, *choice.equal)
    assert rms_px["radtan"] > 0.5
    if true is FOV:  # no other model is as good
        assert choice.name == "fov"


def _calibrated(views: list[View]) -> CameraCalibration:
    return calibrate_cameras(Filmed(views, ((752, 480),), len(views), None, ()), GRID)


def test_names_where_models_differ_that_the_views_do_not_tell_apart() -> None:
    views = made_views(5, 10, cameras=(LEFT,))
    filmed = Filmed(views, ((752, 480),), len(views), None, ())
    found = calibrate_cameras(filmed, GRID, "radtan")
    stated_px = found.verdict.projection_sigma_px[0]
    within = Rival("eucm", 1.9 * stated_px)
    assert lens_finding("radtan", (within,), found.verdict) is None
    off_px = np.zeros_like(stated_px)
    off_px[-1] = 10 * stated_px.max() + 1
    finding = lens_finding("radtan", (within, Rival("fov", off_px)), found.verdict)
    assert finding is not None
    assert f"radtan and fov apart, which differ by {off_px[-1]:.2f} px at lower right" in finding


def test_the_chosen_lens_is_right_up_to_the_border() -> None:
    """Its errors are those that are stated."""
    found = _calibrated(views_around(EUCM, 24, 1))
    assert not any("do not tell" in text for text in found.verdict.findings)
    stated_px = float(np.nanmax(found.verdict.projection_sigma_px[0]))
    assert _largest_error(found.rig.cam0, EUCM, 0.96) < 3.5 * stated_px


@pytest.mark.slow
def test_calibrates_a_rendered_lens_of_150_degrees(tmp_path: Path) -> None:
    """From pixels of images on: detection, choice of the model, adjustment, files."""
    true = CameraModel(225.0, 225.3, 279.0, 181.0, 564, 360, "eucm", (0.63, 1.08))
    assert np.degrees(field_of_view(true)[0]) > 140
    renderer = BoardRenderer(GRID, true)
    detector = CornerDetector(GRID)
    views = []
    for k, T in enumerate(poses_around(true, 24, 2)):
        found = detector.detect(renderer.render(T, Exposure(seed=k)))
        views.append(View(k * 100_000_000, (found,)))
    filmed = Filmed(views, ((564, 360),), len(views), None, ())
    made = calibrate_cameras(filmed, GRID, "eucm")
    assert made.rig.cam0.model == "eucm"
    assert _largest_error(made.rig.cam0, true, 0.96) < 0.15
    assert {"camchain-imucam.yaml", "basalt.json"} <= set(write_rig(tmp_path, made.rig))
    assert load_rig(tmp_path / "camchain-imucam.yaml").cam0 == made.rig.cam0
    chosen = calibrate_cameras(filmed, GRID)
    assert _largest_error(chosen.rig.cam0, true, 0.96) < 0.15


def test_an_unknown_lens_is_an_error_of_usage(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        main(["calibrate-rig", "pairs", "--target", "board.yaml", "--lens", "ocam"])
    assert ended.value.code == 2
    message = capsys.readouterr().err
    assert f"'ocam' is none of auto, {', '.join(LENSES)}" in message
