"""Wide lenses: what they see above and below a pinhole's image reaches the filter, and other
programs get a pinhole.
"""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest

import vio
from tests.commands import render
from tests.filters import test_msckf
from tests.numpy_twins import residuals
from tests.same_events import frames_of
from vio.cameras.projection import camera_args
from vio.cameras.rectification_error import TERMS, ErrorColumns
from vio.cameras.rig import Rig
from vio.cli import main
from vio.cli.running import _opened
from vio.config import Config
from vio.datasets import DatasetSettings, open_dataset
from vio.datasets.observation_log import read_observation_log
from vio.errors import DataError
from vio.evaluation.consistency import nees, nees_bounds
from vio.filters import multiview
from vio.filters.settings import MsckfSettings
from vio.filters.stereo_calibration import StereoCorrection, VerticalDisparityModel
from vio.filters.track_loops import start_by_parallax
from vio.filters.track_records import Views
from vio.frontend.outliers import RansacProblem, bearing_consensus, epipolar_distance
from vio.geometry.lie import FloatArray, se3_exp, se3_inverse, so3_exp, transform_points
from vio.geometry.rectify import PINHOLE_REACH
from vio.geometry.stereo import StereoCamera, depth_of, left_rays, project
from vio.offline.saved_run import read_saved_run
from vio.offline.source import open_source
from vio.records import Observations, observations
from vio.sim.rigs import wide_rig

CYLINDER = StereoCamera(200.0, 200.0, 300.0, 314.0, 0.11, 600, 628, "cylinder")


# --- the recording of a wide pair, from the reader to other programs
# -------------------------------------------------


_EXACT = "--set", "msckf.calibrate_stereo=off"  # pixels stay as they were measured


@pytest.fixture(scope="module")
def flight(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A rendered flight as an EuRoC folder: 9 frames of 160 pixels over 0.9 s."""
    options = {"rig": "wide", "width": "160", "rate": "10", "duration": "0.9"}
    return render(tmp_path_factory.mktemp("flight") / "wide", **options)


@pytest.fixture(scope="module")
def wide_run(flight: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("wide") / "run"
    assert (
        main(
            [
                "run",
                str(flight),
                "--save-observations",
                "--out",
                str(out),
                "--json",
                "--quiet",
                *_EXACT,
            ]
        )
        == 0
    )
    return out


def test_a_run_uses_what_a_wide_lens_sees_above_and_below(wide_run: Path) -> None:
    """A pinhole ends 54 degrees above and below the axis; a third of what this lens shows lies
    beyond.
    """
    metrics = json.loads((wide_run / "metrics.json").read_text())
    assert metrics["camera"]["projection"] == "cylinder"
    log = read_observation_log(wide_run / "observations.npz")
    azimuth = np.abs(log.tracks.z[:, 1] - log.recording.camera.cv) / log.recording.camera.fv
    assert (azimuth > PINHOLE_REACH).mean() > 0.1
    assert azimuth.max() > np.radians(65)
    assert metrics["ate_m"] < 0.005
    (note,) = [note for note in log.recording.notes if "deg" in note]
    assert note.startswith(
        "the lens shows 153 x 153 deg; rectified to a cylinder about the baseline, 105 x 150 deg"
    )
    assert note.endswith("are kept, at 61 px per radian in the middle (the lens: 60)")


def test_saved_observations_of_a_cylinder_replay_to_the_same_bits(
    wide_run: Path, tmp_path: Path
) -> None:
    out = tmp_path / "again"
    assert (
        main(
            [
                "run",
                str(wide_run / "observations.npz"),
                "--out",
                str(out),
                "--json",
                "--quiet",
                *_EXACT,
            ]
        )
        == 0
    )
    for name in ("trajectory.tum", "landmarks.ply"):
        assert (out / name).read_bytes() == (wide_run / name).read_bytes()


def test_features_on_a_cylinder_have_no_calibration_to_save(
    wide_run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    source, out = str(wide_run / "observations.npz"), str(tmp_path / "again")
    assert main(["run", source, "--save-calibration", "--out", out, "--json", "--quiet"]) == 1
    assert (
        "holds features of images on a cylinder, which no lens model holds; run on the images"
        in capsys.readouterr().err
    )
    with pytest.raises(DataError, match="before the first frame"):
        vio.Odometry(CYLINDER).calibrated_rig()


def test_the_projection_is_a_setting(flight: Path) -> None:
    def read(**settings: str) -> StereoCamera:
        return open_dataset(str(flight), DatasetSettings(**settings)).recording.camera  # type: ignore[arg-type]

    assert [read(projection=name).projection for name in ("auto", "pinhole")] == [
        "cylinder",
        "pinhole",
    ]


def test_maps_and_rectified_folders_of_wide_lenses_are_those_of_pinholes(
    flight: Path, tmp_path: Path
) -> None:
    for_maps = _opened(str(flight), Config(), mapped=True).recording.camera
    assert for_maps.projection == "pinhole"
    assert (
        main(
            [
                "convert",
                str(flight),
                "--to",
                "euroc",
                "--out",
                str(tmp_path / "converted"),
                "--json",
            ]
        )
        == 0
    )
    assert open_dataset(str(tmp_path / "converted")).recording.camera.fu == pytest.approx(
        for_maps.fu
    )
    assert open_source(str(flight)).dataset.recording.camera == for_maps  # type: ignore[union-attr]
    rig = wide_rig(160)
    live = Rig(rig.cam0, rig.cam1, se3_inverse(rig.T_cam0_cam1), se3_inverse(rig.T_imu_cam0))
    assert vio.Odometry(live).camera.projection == "cylinder"
    assert vio.Odometry(live, map=tmp_path / "b.map").camera.projection == "pinhole"


def test_a_saved_run_shows_other_programs_a_pinhole(
    flight: Path, wide_run: Path, tmp_path: Path
) -> None:
    """Pixels are where that pinhole sees the points, and its images are those of the raw lens."""
    run = read_saved_run(wide_run)
    camera, tracks = run.tracked.camera, run.tracked.tracks
    assert camera.projection == "pinhole"
    log = run.dataset.tracks
    assert 0.3 < len(tracks.ids) / len(log.ids) < 0.95
    frame = 6
    ids, z = (t[tracks.offsets[frame] : tracks.offsets[frame + 1]] for t in (tracks.ids, tracks.z))
    seen = log.at(frame, 0)
    at = [seen.ids.tolist().index(name) for name in ids.tolist()]
    rays = left_rays(run.dataset.recording.camera, seen.z[at, :2])
    np.testing.assert_allclose(z[:, :2], project(camera, 5.0 * rays)[:, :2], atol=1e-9)
    (ours,) = run.images.frames(run.tracked.frames[np.array([frame])])
    other = open_dataset(str(flight), DatasetSettings(projection="pinhole"))
    (theirs,) = frames_of(other, frame, frame + 1)
    v, u = np.mgrid[10:150:3, 10:150:3].astype(np.float64)
    expected = project(other.recording.camera, left_rays(camera, np.stack([u, v], axis=-1)))[
        ..., :2
    ].astype(np.float32)
    image = cv2.remap(theirs.right, expected[..., 0], expected[..., 1], cv2.INTER_LINEAR).astype(
        np.float64
    )
    gap = ours.right[v.astype(int), u.astype(int)] - image
    assert np.sqrt(np.mean(gap[5:-5, 5:-5] ** 2)) < 0.2 * image.std()


def test_a_log_with_an_unknown_projection_is_refused(wide_run: Path, tmp_path: Path) -> None:
    arrays = dict(np.load(wide_run / "observations.npz"))
    np.savez(tmp_path / "other.npz", **{**arrays, "projection": np.array("fisheye")})
    with pytest.raises(DataError, match="projection is 'fisheye', none of pinhole, cylinder"):
        read_observation_log(tmp_path / "other.npz")
    shutil.copy(wide_run / "observations.npz", tmp_path / "same.npz")
    assert read_observation_log(tmp_path / "same.npz").recording.camera.projection == "cylinder"


# --- geometry all about the baseline
# ---------------------------------------------------------------------------------


def _around(n: int, seed: int = 0) -> tuple[FloatArray, FloatArray]:
    """Left pixels (N, 2) all over a cylinder's image, and points (N, 3) on their rays."""
    rng = np.random.default_rng(seed)
    pixels = rng.uniform([5, 5], [595, 623], (n, 2))
    return pixels, left_rays(CYLINDER, pixels) * rng.uniform(1.5, 6.0, (n, 1))


def test_consensus_without_depth_holds_beyond_ninety_degrees() -> None:
    pixels, p = _around(150)
    T = se3_exp([0.15, 0.05, -0.08, 0.05, 0.1, -0.06])
    now = project(CYLINDER, transform_points(T, p))[:, :2] + np.random.default_rng(1).normal(
        0, 0.2, (150, 2)
    )
    now[:30] += 40.0
    problem = RansacProblem(CYLINDER, 1.5, np.random.default_rng(2))
    kept = bearing_consensus(problem, pixels, now, np.eye(3), None)
    assert kept[30:].mean() > 0.95
    assert kept[:30].mean() < 0.2
    distance = epipolar_distance(CYLINDER, T, pixels, now, 0.3)
    assert np.median(distance[30:]) < 0.3
    assert np.median(distance[:30]) > 10


@pytest.mark.parametrize("left_only", [False, True])
def test_points_all_about_the_baseline_are_triangulated(left_only: bool) -> None:
    _, p = _around(120)
    T = se3_exp(np.cumsum(np.random.default_rng(3).normal(0, 0.08, (6, 6)), axis=0))
    z = np.stack([project(CYLINDER, transform_points(T_k, p)) for T_k in T], axis=1)
    weight = np.ones(z.shape)
    weight[..., 3] = 0.0
    if left_only:
        weight[..., 2] = 0.0
    exact = Views(z, weight)
    np.testing.assert_allclose(residuals(CYLINDER, T, p, exact).r, 0.0, atol=1e-9)
    if left_only:
        found = np.empty(p.shape)
        start_by_parallax(camera_args(CYLINDER), (1e-3, 1e3), 1e-12, T, z, weight, found)
        np.testing.assert_allclose(found, p, rtol=1e-6, atol=1e-6)
    start, known = multiview.first_points(CYLINDER, T, exact)
    assert known.all()
    np.testing.assert_allclose(start, p, rtol=1e-3, atol=1e-3)
    noisy = Views(z + np.random.default_rng(4).normal(0, 0.3, z.shape), weight)
    found = multiview.refine_points(
        CYLINDER, T, multiview.first_points(CYLINDER, T, noisy)[0], noisy, 5, 3.0
    )
    assert np.median(np.linalg.norm(found - p, axis=1) / depth_of(CYLINDER, p)) < 0.03


class WideFlight(test_msckf.Flight):
    """The flight of `test_msckf`, seen through a cylinder's image: points beside and behind the
    axis, too.
    """

    def __init__(self, frames: int) -> None:
        """Put the points all about the flight."""
        super().__init__(frames)
        self.points = np.random.default_rng(0).uniform(-5, 5, (400, 3))

    def observe(
        self, k: int, sigma: float, noise: np.random.Generator, limit: int = 60
    ) -> Observations:
        """Return noisy pixels of the first points that are seen."""
        p = transform_points(test_msckf.T_CAM0_IMU @ se3_inverse(self.T_world_imu(k)), self.points)
        depth = depth_of(CYLINDER, p)
        z = project(CYLINDER, np.where((depth > 0.5)[:, None], p, [0.0, 0.0, 1.0]))
        inside = (z[:, 2] > 5) & (z[:, 0] < 595) & (z[:, 1] > 5) & (z[:, 1] < 623)
        ids = np.flatnonzero(inside & (depth > 0.5) & (depth < self.farthest))[:limit]
        return observations(
            k, k * test_msckf.STEP_NS, ids, z[ids] + noise.normal(0, sigma, (len(ids), 4))
        )


def test_the_window_is_consistent_on_a_cylinder(monkeypatch: pytest.MonkeyPatch) -> None:
    """NEES of the pose over 6 seeded runs of 0.8 s with an IMU: inside its 95 % band in at least
    90 % of the steps.
    """
    monkeypatch.setattr(test_msckf, "CAMERA", CYLINDER)
    settings, runs, values = MsckfSettings(), 6, []
    for seed in range(runs):
        errors, covariances, _ = WideFlight(16).run(settings, "imu", seed, limit=30)
        values.append(nees(errors[1:], covariances[1:]))
    mean = np.mean(values, axis=0)
    low, high = nees_bounds(6, runs)
    assert np.mean(mean < high) >= 0.9, (
        f"overconfident: mean NEES {mean.mean():.2f} for 6 degrees of freedom"
    )
    assert mean.mean() > 0.6 * low
    seen = WideFlight(1).observe(0, 0.0, np.random.default_rng(0))
    beside = int((np.abs(seen.z[:, 1] - CYLINDER.cv) / CYLINDER.fv > np.radians(60)).sum())
    assert beside >= 10


# --- what the calibration of a wide pair is off by, equation (R6)
# ----------------------------------------------------


def _on_cylinder(rays: FloatArray) -> FloatArray:
    """Coordinates (N, 2) of rays (N, 3): tangent along the baseline, azimuth about it."""
    return np.stack(
        [rays[:, 0] / np.hypot(rays[:, 1], rays[:, 2]), np.arctan2(rays[:, 1], rays[:, 2])], axis=1
    )


def _through_lens(rays: FloatArray, shift: FloatArray) -> FloatArray:
    """Rays (N, 3) whose angles off the axis, along u and v, are shifted by (N, 2) or (2,)
    radians.
    """
    sine = np.hypot(rays[:, 0], rays[:, 1])
    angles = rays[:, :2] * (np.arctan2(sine, rays[:, 2]) / sine)[:, None] + shift
    theta = np.linalg.norm(angles, axis=1)
    return np.column_stack([angles * (np.sin(theta) / theta)[:, None], np.cos(theta)])


def _field(a: FloatArray, v: FloatArray, left: FloatArray, right: FloatArray) -> FloatArray:
    """Pixels (N, 4) without a field of states (8,), and the baseline's behind them, and rows
    (7,).
    """
    z = np.column_stack([left, right[:, 0], left[:, 1]])
    field = StereoCorrection(
        CYLINDER, v, np.concatenate([a, np.zeros(TERMS - len(a))]), np.arange(TERMS)
    )
    return field.corrected(Views(z, np.tile([1.0, 1.0, 1.0, 0.0], (len(z), 1)))).z


def test_the_field_takes_out_turns_and_lens_errors_of_the_right_camera() -> None:
    """Rows and states of (R6) are exact for a small turn, for a shifted principal point and for
    a radial error.
    """
    pixels, _ = _around(200)
    rays = left_rays(CYLINDER, pixels)
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    focal = np.array([CYLINDER.fu, CYLINDER.fv])
    wx, wy, wz, cx, cy = 1e-3, -8e-4, 7e-4, 6e-4, -9e-4
    turned = _through_lens(rays @ so3_exp([wx, wy, wz]).T, np.array([cx, cy]))
    moved = pixels + focal * (_on_cylinder(turned) - _on_cylinder(rays))
    a = np.array([cx / 4, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0])
    v = np.array([cy - wx, wz, 0.0, wy + 3 * cx / 4, cy / 3, 0.0, 0.0])
    assert np.abs(moved - pixels)[:, 0].max() > 0.5
    np.testing.assert_allclose(_field(a, v, pixels, moved)[:, 2], pixels[:, 0], atol=5e-3)
    theta = np.arctan2(np.hypot(rays[:, 0], rays[:, 1]), rays[:, 2])
    angles = rays[:, :2] / np.hypot(rays[:, 0], rays[:, 1])[:, None] * theta[:, None]
    for order, state, size in ((2, 4, 1e-3), (4, 5, 3e-4)):
        radial = size * theta[:, None] ** order * angles
        bent = pixels + focal * (_on_cylinder(_through_lens(rays, radial)) - _on_cylinder(rays))
        out = _field(size * np.eye(8)[state], np.zeros(7), bent, bent)
        np.testing.assert_allclose(out[:, :3], np.column_stack([pixels, pixels[:, 0]]), atol=2e-2)


def test_rows_show_a_turned_right_camera() -> None:
    _, p = _around(300)
    z = project(CYLINDER, p)
    turned = (p - [CYLINDER.baseline_m, 0, 0]) @ so3_exp([2e-3, 1e-3, -1.5e-3]).T
    z[:, 2:] = _on_cylinder(turned) * [CYLINDER.fu, CYLINDER.fv] + [CYLINDER.cu, CYLINDER.cv]
    rows = VerticalDisparityModel(CYLINDER)
    rng = np.random.default_rng(5)
    for k in range(20):
        rows.update(observations(k, k, np.arange(300), z + rng.normal(0, 0.1, z.shape)))
    assert rows.offset_px > 0.2
    np.testing.assert_allclose(rows.coefficients[[0, 1, 3]], [-2e-3, -1.5e-3, 1e-3], atol=1e-4)
    np.testing.assert_allclose(rows.coefficients[[2, 4, 5]], 0.0, atol=1e-4)


def test_the_field_takes_out_a_right_camera_below_the_left_one_s_row() -> None:
    """Near points move along the cylinder's rows and columns; rows show by how much."""
    _, p = _around(300)
    z, below = project(CYLINDER, p), 0.02
    moved = z.copy()
    shifted = p - CYLINDER.baseline_m * np.array([1.0, below, 0.0])
    moved[:, 2:] = _on_cylinder(shifted) * [CYLINDER.fu, CYLINDER.fv] + [CYLINDER.cu, CYLINDER.cv]
    rows = VerticalDisparityModel(CYLINDER)
    for k in range(20):
        rows.update(observations(k, k, np.arange(300), moved))
    np.testing.assert_allclose(rows.coefficients[6], -below, atol=1e-3)
    off = moved[:, 2] - z[:, 2]
    left = _field(np.zeros(8), rows.coefficients, z[:, :2], moved[:, 2:])[:, 2] - z[:, 2]
    assert np.abs(off).max() > 0.2
    assert np.abs(left).max() < 0.15 * np.abs(off).max()


def test_derivatives_by_the_field_are_those_of_the_correction() -> None:
    pixels, p = _around(50)
    z, step = project(CYLINDER, p), 1e-4
    H = ErrorColumns(CYLINDER).jacobian(z)
    for j in range(9):
        a = step * np.eye(9)[j]
        change = z[:, :3] - _field(a, np.zeros(7), pixels, z[:, 2:])[:, :3]
        # the baseline's is no line
        np.testing.assert_allclose(H[:, :3, j], change / step, rtol=1e-4, atol=1e-6)
    assert not H[:, 3].any()
    assert not H[:, :, 9:].any()
