"""Models read back by pycolmap, refinement of simulated runs, and the commands `check`, `refine`
and `export`.
"""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pycolmap
import pytest

from tests.commands import json_of, refused
from tests.dataset_makers import make_kitti
from vio.cli import main
from vio.config import Config
from vio.datasets import open_dataset
from vio.errors import DataError, EstimationError
from vio.evaluation.errors_along_path import rotation_angle_deg
from vio.files.trajectories import write_tum
from vio.geometry.lie import (
    FloatArray,
    se3_exp,
    se3_from_parts,
    se3_inverse,
    so3_exp,
    transform_points,
)
from vio.geometry.stereo import project
from vio.live.build import Parts
from vio.offline.colmap.model import (
    ModelImages,
    build_model,
    keyframe_images,
    mean_reprojection_error_px,
)
from vio.offline.colmap.reconstruction import linked_steps, pairs_to_match
from vio.offline.colmap.trajectory import read_colmap_trajectory
from vio.offline.comparison import (
    GroundTruth,
    KeyframeComparison,
    _longest_piece,
    compare_keyframes,
)
from vio.offline.keyframes import TrackedPath, choose_keyframes
from vio.offline.loop_tracks import loop_rows
from vio.offline.points import build_tracks, landmarks_of, reprojection, triangulate_tracks
from vio.offline.refine import align_to_points, position_covariances, refine_run
from vio.offline.saved_run import read_saved_run, with_poses
from vio.records import Estimate, LoopEvent, LoopMatches
from vio.runs.folder import write_run_folder
from vio.runs.mapped import corrected, write_loops
from vio.runs.pipeline import run as process
from vio.sim.effects import CLEAN
from vio.sim.export import export_kitti
from vio.sim.imu import ImuNoise
from vio.sim.motion import hand_held, look_rotation, spline_from_waypoints
from vio.sim.oracle import OracleFrontend, OracleSettings
from vio.sim.rigs import small_rig
from vio.sim.sequence import SimulatedRecording, Simulation, simulate
from vio.sim.world import room

SIGMA_PX = 0.3


@pytest.fixture(scope="module")
def simulation() -> Simulation:
    motion = hand_held(duration_s=6.0, seed=2)
    return simulate(
        room(1), small_rig(320, 200), motion, rate_hz=10.0, imu=ImuNoise(), effects=CLEAN, seed=1
    )


def _make_run(
    simulation: Simulation, folder: Path, *, stop: int | None = None, lost_after: int | None = None
) -> Path:
    """Make a run's folder from exact geometry with noise, without rendering."""
    settings = OracleSettings(
        max_features=120, sigma_px=SIGMA_PX, outlier_fraction=0.02, max_track_length=lost_after
    )
    dataset = SimulatedRecording(simulation)
    config = replace(Config(), backend="vislam", motion="none")
    front = OracleFrontend(simulation, settings, seed=4)
    result = process(
        dataset, config, parts=Parts(frontend=front), stop=stop, keep_observations=True
    )
    write_run_folder(folder, result, dataset.recording.reference, save_observations=True)
    return folder


@pytest.fixture(scope="module")
def whole_run(simulation: Simulation, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return _make_run(simulation, tmp_path_factory.mktemp("runs") / "whole")


LOOP = (1, 31)  # frames of `round_trip` that show one place


def round_trip() -> Simulation:
    """Once around in the room, looking ahead, in 33 frames."""
    yaw = np.linspace(-0.3, 2 * np.pi + 0.3, 42)
    R = look_rotation(np.stack([np.cos(yaw), np.sin(yaw), 0 * yaw], axis=1))
    p = np.stack([0.8 * np.sin(yaw), -0.8 * np.cos(yaw), 1.4 + 0.05 * yaw], axis=1)
    motion = spline_from_waypoints(se3_from_parts(R, p), 0.25)
    return simulate(room(1), small_rig(320, 200), motion, rate_hz=3.2, effects=CLEAN, seed=1)


def _add_loop(run: Path, ends: tuple[int, int], *, points: int = 120) -> None:
    """Write a loop between two frames as a run with a map does, with exact geometry and noise,
    and poses in the map.
    """
    saved, rng = read_saved_run(run), np.random.default_rng(6)
    truth = saved.truth.trajectory.in_cam0(saved.T_cam0_imu)
    rows = [int(np.flatnonzero(saved.tracked.frames == k)[0]) for k in ends]
    times = saved.tracked.trajectory.times_ns
    T = [truth.T_world_body[k] for k in rows]
    camera, p = saved.tracked.camera, rng.uniform([-0.9, -0.6, 1.5], [0.9, 0.6, 5.0], (points, 3))
    z = [project(camera, transform_points(se3_inverse(T_k) @ T[0], p)) for T_k in T]
    z = [one + SIGMA_PX * rng.standard_normal((points, 4)) for one in z]
    every = np.ones(points, dtype=np.bool_)
    ns = times[rows].tolist()
    loop = LoopEvent(
        ends[1], ns[1], 7, ns[0], points, 0.0, False, ends[0], True, LoopMatches(*z, every, every)
    )
    write_loops(run, [loop])
    odometry = saved.tracked.trajectory.T_world_body
    closed = np.stack([odometry[rows[0]], odometry[rows[0]] @ se3_inverse(T[0]) @ T[1]])
    poses = corrected(odometry, saved.tracked.frames, np.array(ends), closed, odometry[rows])
    write_tum(run / "map_trajectory.tum", replace(saved.tracked.trajectory, T_world_body=poses))


@pytest.fixture
def folder(whole_run: Path, tmp_path: Path) -> Path:
    out = tmp_path / "run"
    shutil.copytree(whole_run, out)
    return out


@pytest.fixture(scope="module")
def saved(whole_run: Path) -> TrackedPath:
    return read_saved_run(whole_run).tracked


def _contents(folder: Path) -> dict[str, bytes]:
    return {
        str(p.relative_to(folder)): p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file()
    }


# --- keyframes, points, poses
# ---------------------------------------------------------------------------------------


def test_keyframes_span_the_run_and_respect_their_limit(saved: TrackedPath) -> None:
    every = choose_keyframes(saved)
    few = choose_keyframes(saved, most=8)
    assert 2 < len(few) <= 8 < len(every)
    for chosen in (every, few):
        assert (chosen[0], chosen[-1]) == (0, len(saved.frames) - 1)
        assert (np.diff(chosen) > 0).all()


def test_points_of_exact_pixels_are_exact(saved: TrackedPath) -> None:
    keyframes = choose_keyframes(saved, most=8)
    T = saved.trajectory.T_world_body[keyframes]
    tracks = build_tracks(saved, keyframes, T)
    T_cam0_world = se3_inverse(T)[tracks.keyframe]
    p = (
        np.einsum("nij,nj->ni", T_cam0_world[:, :3, :3], tracks.p_world[tracks.point])
        + T_cam0_world[:, :3, 3]
    )
    exact = replace(tracks, z=project(saved.camera, p), p_world=tracks.p_world + 1.0)
    again, valid = triangulate_tracks(saved.camera, T, exact)
    assert valid.all()
    np.testing.assert_allclose(again, tracks.p_world, atol=1e-6)
    residual, ahead = reprojection(saved.camera, T, replace(exact, p_world=again))
    assert ahead.all()
    assert np.abs(residual).max() < 1e-5


def test_recovers_a_pose_from_points(saved: TrackedPath) -> None:
    rng = np.random.default_rng(0)
    p_world = rng.uniform([-3, -2, 3], [3, 2, 9], (60, 3))
    T_world_cam0 = se3_exp([0.2, -0.1, 0.3, 0.05, -0.1, 0.02])
    z = project(saved.camera, transform_points(se3_inverse(T_world_cam0), p_world))
    z[:9] += 40  # outliers
    has_right = rng.random(60) < 0.8
    start = T_world_cam0 @ se3_exp([0.05, 0.05, -0.05, 0.02, 0.01, -0.02])
    found = align_to_points(saved.camera, start, p_world, z, has_right)
    np.testing.assert_allclose(found, T_world_cam0, atol=1e-4)
    assert align_to_points(saved.camera, start, p_world[:4], z[:4], has_right[:4]) is None


def test_covariances_of_positions_and_points_match_sampling(saved: TrackedPath) -> None:
    rng = np.random.default_rng(1)
    T_cam0_imu = se3_exp([0.3, -0.2, 0.1, 0.4, 0.2, -0.3])
    T_world_imu = se3_exp([1.0, 2.0, 3.0, 0.3, -0.4, 0.5])
    A = rng.standard_normal((6, 6))
    P = 1e-6 * (A @ A.T)
    xi = rng.multivariate_normal(np.zeros(6), P, size=20000)
    moved = se3_inverse(se3_exp(xi) @ se3_inverse(T_world_imu)) @ se3_inverse(T_cam0_imu)
    cloud = np.cov(moved[:, :3, 3].T)
    own = position_covariances([Estimate(0, T_world_imu, P)], T_cam0_imu)[0] - 1e-8 * np.eye(3)
    np.testing.assert_allclose(own, cloud, atol=0.05 * np.abs(cloud).max())
    keyframes = choose_keyframes(saved, most=6)
    T = saved.trajectory.T_world_body[keyframes]
    tracks = build_tracks(saved, keyframes, T)
    covariance = landmarks_of(saved.camera, T, tracks, SIGMA_PX).covariance
    assert (np.linalg.eigvalsh(covariance) > 0).all()


# --- models
# --------------------------------------------------------------------------------------------------


def test_a_model_projects_as_our_camera_with_an_offset_of_half_a_pixel(
    saved: TrackedPath, tmp_path: Path
) -> None:
    keyframes = choose_keyframes(saved, most=8)
    T = saved.trajectory.T_world_body[keyframes]
    tracks = build_tracks(saved, keyframes, T)
    names = keyframe_images(keyframes)
    colours = np.arange(3 * len(tracks.ids), dtype=np.int64).astype(np.uint8).reshape(-1, 3)
    build_model(saved.camera, T, tracks, names, colours).write_binary(tmp_path)
    model = pycolmap.Reconstruction(tmp_path)
    assert (model.num_cameras(), model.num_rigs(), model.num_frames()) == (2, 1, len(keyframes))
    assert model.num_points3D() == len(tracks.ids)
    b = saved.camera.baseline_m
    offsets = {"left": np.zeros(3), "right": np.array([b, 0, 0])}
    for image in model.images.values():
        side, _, name = image.name.partition("/")
        k = int(np.flatnonzero(keyframes == int(Path(name).stem))[0])
        centre = transform_points(T[k], offsets[side])
        np.testing.assert_allclose(image.projection_center(), centre, atol=1e-9)
        rows = tracks.keyframe == k
        rows &= tracks.has_right | (side == "left")
        column = slice(0, 2) if side == "left" else slice(2, 4)
        ours = project(
            saved.camera, transform_points(se3_inverse(T[k]), tracks.p_world[tracks.point[rows]])
        )
        np.testing.assert_allclose([p.xy for p in image.points2D], tracks.z[rows][:, column] + 0.5)
        for point, uv in zip(image.points2D, ours[:, column], strict=True):
            p_world = model.point3D(point.point3D_id).xyz
            seen = model.camera(image.camera_id).img_from_cam(image.cam_from_world() * p_world)
            np.testing.assert_allclose(seen, uv + 0.5, atol=1e-9)
    np.testing.assert_array_equal(model.point3D(5).color, colours[4])
    residual, _ = reprojection(saved.camera, T, tracks)
    left, right = np.linalg.norm(residual[:, :2], axis=1), np.linalg.norm(residual[:, 2:], axis=1)
    total = np.bincount(tracks.point, left + right) / np.bincount(
        tracks.point, 1.0 + tracks.has_right
    )
    assert mean_reprojection_error_px(model) == pytest.approx(total.mean(), rel=1e-9)


@pytest.mark.parametrize("stamped", [False, True])
def test_reads_a_model_as_a_trajectory(saved: TrackedPath, tmp_path: Path, stamped: bool) -> None:
    keyframes = choose_keyframes(saved, most=6)
    T = saved.trajectory.T_world_body[keyframes]
    tracks = build_tracks(saved, keyframes, T)
    numbers = 1403715273262142976 + 10**8 * keyframes if stamped else keyframes
    names = ModelImages(
        tuple(f"cam0/{k}.png" for k in numbers), tuple(f"cam1/{k}.png" for k in numbers)
    )
    place = tmp_path / "sparse" / "0"
    place.mkdir(parents=True)
    build_model(saved.camera, T, tracks, names).write_binary(place)
    found = read_colmap_trajectory(tmp_path)
    assert found.body == "cam0"
    np.testing.assert_allclose(found.T_world_body, T, atol=1e-12)
    assert (found.times_ns is not None) == stamped
    assert ((found.times_ns if stamped else found.frame_indices) == numbers).all()
    with pytest.raises(DataError, match="no COLMAP model"):
        read_colmap_trajectory(place.parent.parent / "nothing")
    (place / "points3D.bin").write_bytes(b"broken")
    (place / "images.bin").write_bytes(b"broken")
    with pytest.raises(DataError, match="cannot read the model"):
        read_colmap_trajectory(tmp_path)


# --- refinement
# --------------------------------------------------------------------------------------------------


def test_refine_lowers_the_error_and_does_not_change_the_run(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    before = _contents(folder)
    first = json_of(capsys, "refine", folder)
    after = _contents(folder)
    assert {name: data for name, data in after.items() if not name.startswith("refined")} == before
    assert isinstance(first["ate_m"], float)
    assert isinstance(first["ate_before_m"], float)
    assert first["ate_m"] < 0.9 * first["ate_before_m"]
    assert first["sigma_px"] == pytest.approx(SIGMA_PX, rel=0.2)
    again = json_of(capsys, "refine", folder)
    assert again["ate_m"] == first["ate_m"], "one thread is bit-identical"
    assert _contents(folder)["refined/trajectory.tum"] == after["refined/trajectory.tum"]
    scores = json_of(capsys, "eval", folder / "refined", folder)
    assert 0 < float(str(scores["ate_m"])) < 2 * first["ate_before_m"]


def test_refine_warns_where_it_is_further_off_than_the_run_says(
    folder: Path, caplog: pytest.LogCaptureFixture
) -> None:
    run = read_saved_run(folder)
    for sigma_m in (1.0, 1e-6):
        caplog.clear()
        sure = replace(
            run, tracked=replace(run.tracked, sigmas=np.full((len(run.tracked.frames), 2), sigma_m))
        )
        refine_run(sure, most=5, priors=False, threads=1, progress=lambda done: None)
        assert ("times its standard deviation" in caplog.text) == (sigma_m < 1e-3)


def test_refine_uses_the_matches_of_loops(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Tracks of three frames drift; a loop says where the camera has come back to."""
    run = _make_run(round_trip(), tmp_path / "run", lost_after=3)
    truth = read_saved_run(run).truth
    true = truth.trajectory.in_cam0(truth.T_cam0_imu).T_world_body[list(LOOP)]
    errors, facts = [], []
    for with_loop in (False, True):
        if with_loop:
            _add_loop(run, LOOP)
        facts.append(json_of(capsys, "refine", run))
        refined = with_poses(read_saved_run(run), run / "refined").tracked.trajectory.T_world_body[
            list(LOOP)
        ]
        gap = se3_inverse(se3_inverse(true[0]) @ true[1]) @ se3_inverse(refined[0]) @ refined[1]
        errors.append(float(np.linalg.norm(gap[:3, 3])))
    assert [f["loops"] for f in facts] == [0, 1]
    assert errors[1] < 0.5 * errors[0], errors
    assert "its loops moved the poses away" in refused(capsys, "refine", run, "--priors", "filter")
    exported = json_of(
        capsys, "export", "colmap", run, "--no-images", "--refined", "--keyframes", "12"
    )
    assert exported["loops"] == 1
    model = pycolmap.Reconstruction(run / "colmap" / "sparse" / "0")
    images = [model.find_image_with_name(f"left/{k:06d}.png") for k in LOOP]
    seen = [{p.point3D_id for p in image.points2D if p.has_point3D()} for image in images]
    assert len(seen[0] & seen[1]) >= 100, "of the loop's 120 points"


def test_a_feature_of_several_loops_is_one_point() -> None:
    z = np.arange(24.0).reshape(6, 4)
    both = np.ones(2, dtype=np.bool_)

    def loop(first: int, second: int, one: list[int], other: list[int]) -> LoopEvent:
        return LoopEvent(
            second, 0, 0, 0, 2, 0.0, False, first, True, LoopMatches(z[one], z[other], both, both)
        )

    loops = [loop(10, 30, [0, 1], [2, 3]), loop(10, 31, [0, 1], [4, 5])]
    found = loop_rows(loops, np.array([10, 20, 30, 31]))
    assert len(found.point) == 6
    assert {tuple(sorted(found.keyframe[found.point == k].tolist())) for k in (0, 1)} == {(0, 2, 3)}
    contradicting = [*loops, loop(30, 31, [2, 3], [5, 4])]  # the points 0 and 1 were exchanged
    assert len(loop_rows(contradicting, np.array([10, 20, 30, 31])).point) == 0
    assert len(loop_rows(loops, np.array([10, 20])).point) == 0, "without the loop's other keyframe"


def test_priors_need_a_filter_that_reproduces_the_run(
    folder: Path, capsys: pytest.CaptureFixture[str], caplog: pytest.LogCaptureFixture
) -> None:
    assert "--imu takes a run with an IMU" in refused(capsys, "refine", folder, "--imu")
    held = json_of(capsys, "refine", folder, "--priors", "filter", "--keyframes", "12")
    assert held["priors"] == "filter"
    free = json_of(capsys, "refine", folder, "--keyframes", "12")
    assert float(str(held["moved_rms_m"])) < float(str(free["moved_rms_m"])), (
        "priors keep the poses near the filter's"
    )
    config = (folder / "config.yaml").read_text()
    assert "pixel_sigma_px: 0.75" in config
    (folder / "config.yaml").write_text(
        config.replace("pixel_sigma_px: 0.75", "pixel_sigma_px: 2.5")
    )
    other = json_of(capsys, "refine", folder, "--priors", "filter", "--keyframes", "12")
    assert other["priors"] == "none"
    assert "does not reproduce" in caplog.text


def test_an_interrupted_refinement_leaves_nothing(
    folder: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    before = _contents(folder)

    def interrupted(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("vio.runs.folder.write_landmarks_ply", interrupted)  # while writing
    assert main(["refine", str(folder)]) == 130
    capsys.readouterr()
    assert _contents(folder) == before
    assert sorted(p.name for p in folder.parent.iterdir()) == ["run"]


def test_refine_reports_unusable_runs(
    simulation: Simulation, folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert "holds the results of runs" in refused(capsys, "refine", tmp_path)
    short = _make_run(simulation, tmp_path / "short", stop=1)
    assert "a run of 1 frames has fewer than two views" in refused(capsys, "refine", short)
    blink = _make_run(simulation, tmp_path / "blink", stop=20, lost_after=1)
    message = refused(capsys, "refine", blink)
    assert "not observable because no feature is seen consistently in 2 keyframes" in message
    assert "do not overlap" in message
    assert not (blink / "refined").exists()
    (folder / "observations.npz").unlink()
    assert "repeat its run with --save-observations" in refused(capsys, "refine", folder)


# --- export
# --------------------------------------------------------------------------------------------------


def test_export_without_images_is_a_reference_for_eval(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    facts = json_of(capsys, "export", "colmap", folder, "--no-images")
    assert float(str(facts["mean_reprojection_error_px"])) < 2 * SIGMA_PX
    scores = json_of(capsys, "eval", folder, folder / "colmap")
    assert scores["association"] == "frame"
    assert float(str(scores["ate_m"])) < 1e-9
    document = json.loads((folder / "colmap" / "transforms.json").read_text())
    model = pycolmap.Reconstruction(folder / "colmap" / "sparse" / "0")
    assert len(document["frames"]) == model.num_images()
    for entry in document["frames"]:
        image = model.find_image_with_name(entry["file_path"].removeprefix("images/"))
        c2w = np.array(entry["transform_matrix"])
        np.testing.assert_allclose(c2w[:3, 3], image.projection_center(), atol=1e-9)
        np.testing.assert_allclose(-c2w[:3, 2], image.viewing_direction(), atol=1e-9)
    camera = model.camera(1)
    assert [document[k] for k in ("fl_x", "fl_y", "cx", "cy")] == pytest.approx(list(camera.params))
    json_of(capsys, "refine", folder)
    refined = json_of(capsys, "export", "colmap", folder, "--no-images", "--refined")
    assert float(str(refined["mean_reprojection_error_px"])) < float(
        str(facts["mean_reprojection_error_px"])
    )


def test_export_reports_missing_images(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert "name the recording with --source" in refused(capsys, "export", "colmap", folder)
    assert not (folder / "colmap").exists()
    assert "create it with `vio refine" in refused(capsys, "export", "colmap", folder, "--refined")


# --- rendered images
# ------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def rendered(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """Make a KITTI folder of 14 rendered frames, and a run on it with exact tracks."""
    place = tmp_path_factory.mktemp("rendered")
    motion = hand_held(duration_s=5.0, seed=2)
    plan = simulate(
        room(1, texel_m=0.006), small_rig(320, 200), motion, rate_hz=3.0, effects=CLEAN, seed=1
    )
    export_kitti(SimulatedRecording(plan), place / "kitti")
    dataset = open_dataset(place / "kitti")
    front = OracleFrontend(plan, OracleSettings(max_features=80, sigma_px=0.1), seed=1)
    config = replace(Config(), backend="vislam", motion="none")
    result = process(dataset, config, parts=Parts(frontend=front), keep_observations=True)
    write_run_folder(place / "run", result, dataset.recording.reference, save_observations=True)
    _add_loop(place / "run", (3, 7))
    return place / "kitti", place / "run"


def test_export_writes_images_and_colours(
    rendered: tuple[Path, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "model"
    facts = json_of(capsys, "export", "colmap", rendered[1], "--out", out, "--keyframes", "6")
    model = pycolmap.Reconstruction(out / "sparse" / "0")
    assert facts["images"] == model.num_images()
    assert all((out / "images" / image.name).is_file() for image in model.images.values())
    gray = np.array([point.color for point in model.points3D.values()])
    assert gray.std() > 10, "colours come from the images"
    ours = {m: c.copy() for m, c in zip(model.points3D, gray, strict=True)}
    for point in model.points3D.values():
        point.color = np.zeros(3, dtype=np.uint8)
    model.extract_colors_for_all_images(out / "images", num_threads=1)
    theirs = np.array([point.color for point in model.points3D.values()], dtype=float)
    mine = np.array([ours[m] for m in model.points3D], dtype=float)
    assert np.corrcoef(mine[:, 0], theirs[:, 0])[0, 1] > 0.9, (
        "COLMAP finds the same colours at the same places"
    )


def test_check_agrees_with_a_correct_run_and_estimates_the_scale(
    rendered: tuple[Path, Path], capsys: pytest.CaptureFixture[str]
) -> None:
    report = json_of(capsys, "check", rendered[1], "--mapper", "incremental", "--keyframes", "9")
    facts = report["mappers"]["incremental"]  # type: ignore[index]
    assert facts["registered"] == report["keyframes"]
    assert facts["ate_m"] < 0.02
    assert facts["scale"] == pytest.approx(1.0, abs=0.02)
    assert facts["loops_in_model"] == facts["loops"] == 1
    assert (rendered[1] / "check" / "check.png").stat().st_size > 10_000
    assert sorted(p.name for p in (rendered[1] / "check").iterdir()) == [
        "check.json",
        "check.png",
        "incremental",
    ]


def test_keyframes_at_both_ends_of_a_loop_are_matched() -> None:
    names = keyframe_images(np.arange(70))
    without = pairs_to_match(names, np.zeros((0, 2), dtype=np.int64))
    pairs = pairs_to_match(names, np.array([[2, 33], [3, 33], [0, 69]]))
    assert len(set(pairs)) == len(pairs), "each once"
    added = {(names.left.index(a), names.left.index(b)) for a, b in set(pairs) - set(without)}
    assert {(2, 33), (1, 32), (3, 34), (4, 33), (0, 69), (1, 68)} <= added
    assert all(b - a > 25 for a, b in added)


def test_all_keyframes_of_a_short_run_are_matched_with_one_another() -> None:
    names = keyframe_images(np.arange(40))
    pairs = set(pairs_to_match(names, np.zeros((0, 2), dtype=np.int64)))
    assert {(names.left[a], names.left[b]) for b in range(40) for a in range(b)} <= pairs


def test_a_step_that_only_a_loop_joins_is_a_gap() -> None:
    points = np.zeros((8, 8), dtype=np.int64)
    for a, b in [(0, 1), (1, 2), (2, 3), (4, 5), (5, 6), (6, 7), (0, 7)]:
        points[a, b] = points[b, a] = 20
    assert linked_steps(points, np.arange(8)).tolist() == [
        True,
        True,
        True,
        False,
        True,
        True,
        True,
    ]
    points[3, 4] = points[4, 3] = 20
    assert linked_steps(points, np.arange(8)).all()
    assert not linked_steps(points, np.array([0, 1, 2, 3, 30, 31, 32, 33]))[3], "far apart in time"


def test_images_without_texture_are_not_observable(
    rendered: tuple[Path, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    blank = tmp_path / "blank"
    shutil.copytree(rendered[0], blank)
    for path in blank.glob("image_*/*.png"):
        import cv2

        cv2.imwrite(str(path), np.full((200, 320), 120, dtype=np.uint8))
    report = json_of(capsys, "check", rendered[1], "--source", blank, "--keyframes", "5")
    for facts in report["mappers"].values():  # type: ignore[attr-defined]
        assert facts["verdict"].startswith("not observable because")
        assert facts["registered"] == 0
    facts = json_of(
        capsys, "calibrate", blank, "--out", tmp_path / "cal", "--pairs", "3", "--frames", "6"
    )
    assert "have no texture" in facts["stereo"]["verdict"]  # type: ignore[index]
    assert facts["findings"] == []


def test_calibrate_measures_rectified_images_and_reports_swapped_ones(
    rendered: tuple[Path, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "cal"
    facts = json_of(capsys, "calibrate", rendered[0], "--out", out, "--pairs", "5", "--frames", "8")
    assert facts["findings"] == []
    R = np.array(facts["stereo"]["R_cam1_cam0"])  # type: ignore[index]
    assert float(rotation_angle_deg(R)) < 0.3
    assert (out / "camchain-imucam.yaml").is_file()
    assert (out / "cam1" / "sensor.yaml").is_file()
    swapped = tmp_path / "swapped"
    shutil.copytree(rendered[0], swapped)
    (swapped / "image_0").rename(swapped / "aside")
    (swapped / "image_1").rename(swapped / "image_0")
    (swapped / "aside").rename(swapped / "image_1")
    facts = json_of(capsys, "calibrate", swapped, "--out", out, "--pairs", "5", "--frames", "8")
    assert [f["fault"] for f in facts["findings"]] == ["cameras swapped"]  # type: ignore[attr-defined]


# --- comparison
# --------------------------------------------------------------------------------------------------


def test_comparison_estimates_the_scale_and_locates_a_jump(saved: TrackedPath) -> None:
    rows = choose_keyframes(saved, most=30)
    rng = np.random.default_rng(2)
    T = saved.trajectory.T_world_body[rows].copy()
    T[:, :3, 3] += 1e-4 * rng.standard_normal((len(rows), 3))
    T[:, :3, 3] *= 1.01
    jump = len(rows) // 2
    T[jump:, :3, 3] += [0.05, 0, 0]
    found: KeyframeComparison = compare_keyframes(
        saved, rows, se3_exp([1, 2, 3, 0.1, 0.2, 0.3]) @ T
    )
    assert found.scale == pytest.approx(1.01, abs=0.03)
    assert len(found.segments) == 1
    assert (found.segments[0].first_frame, found.segments[0].last_frame) == (
        int(saved.frames[rows[jump - 1]]),
        int(saved.frames[rows[jump]]),
    )
    assert found.segments[0].difference_m == pytest.approx(0.05, rel=0.2)


def test_comparison_evaluates_both_against_ground_truth(saved: TrackedPath) -> None:
    rows = choose_keyframes(saved, most=30)
    longer = saved.trajectory.T_world_body[rows].copy()
    longer[:, :3, 3] *= 1.02
    found = compare_keyframes(saved, rows, longer, GroundTruth(saved.trajectory, np.eye(4)))
    assert found.run_reference_ate_m == pytest.approx(0.0, abs=1e-9)
    assert found.reference_scale == pytest.approx(1.02, rel=1e-6)
    assert found.reference_ate_m == pytest.approx(found.ate_m, rel=1e-6)
    assert compare_keyframes(saved, rows, longer).reference_ate_m is None


def test_pure_rotation_has_no_scale(saved: TrackedPath) -> None:
    rows = np.arange(10)
    still = np.repeat(np.eye(4)[None], len(saved.frames), axis=0)
    still[:, :3, :3] = so3_exp(np.linspace(0, 1, len(saved.frames))[:, None] * [0.0, 1.0, 0.0])
    turning = replace(saved, trajectory=replace(saved.trajectory, T_world_body=still))
    noisy: FloatArray = still[rows].copy()
    noisy[:, :3, 3] = 1e-3 * np.random.default_rng(0).standard_normal((10, 3))
    found = compare_keyframes(turning, rows, noisy)
    assert found.scale is None
    assert "does not move" in found.why_no_scale


def test_rejects_a_run_without_right_matches(saved: TrackedPath) -> None:
    without_right = replace(
        saved, tracks=replace(saved.tracks, has_right=np.zeros_like(saved.tracks.has_right))
    )
    with pytest.raises(
        EstimationError, match="not observable because no feature has a right match"
    ):
        choose_keyframes(without_right)


def test_noise_images_are_not_calibrated(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    source = make_kitti(tmp_path / "kitti")
    facts = json_of(
        capsys, "calibrate", source, "--out", tmp_path / "cal", "--pairs", "3", "--frames", "4"
    )
    assert "not observable because" in facts["stereo"]["verdict"]  # type: ignore[index]


@pytest.mark.parametrize(("off_m", "kept"), [(0.9, 20), (1.1, 12)])
def test_a_path_is_broken_where_a_motion_is_off_by_more_than_its_length(
    off_m: float, kept: int
) -> None:
    own = np.tile(np.eye(4), (20, 1, 1))
    own[:, 0, 3] = np.arange(20)
    other = own.copy()
    other[12:, 0, 3] += off_m
    piece, pieces = _longest_piece(own, other, np.ones(19, dtype=np.bool_))
    assert (int(piece.sum()), pieces) == (kept, 1)


def test_importing_colmap_leaves_the_handlers_of_signals() -> None:
    """The package's own import takes SIGTERM, and a command would leave unfinished files."""
    code = (
        "import os, signal, sys\n"
        "signal.signal(signal.SIGTERM, lambda *_: sys.exit(3))\n"
        "import vio.offline.colmap\n"
        "os.kill(os.getpid(), signal.SIGTERM)\n"
    )
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 3
