"""`vio rectify` and `vio run` on unrectified folders."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tests.commands import json_of, refused
from tests.dataset_makers import make_kitti
from tests.euroc_maker import RECTIFIED_RIG, camera_stamps, make_euroc, make_kitti_raw
from tests.same_events import frames_of
from vio.cli import main
from vio.cli.rectify import MARKER
from vio.datasets import open_dataset
from vio.geometry.distortion import StereoRig, rig_from_rectified
from vio.geometry.rectify import rectified_cameras
from vio.protocols import Dataset
from vio.sim.export import export_euroc
from vio.sim.imu import ImuNoise
from vio.sim.motion import hand_held
from vio.sim.render import camera_rays, render
from vio.sim.rigs import small_rig
from vio.sim.sequence import SimulatedRecording, simulate, views
from vio.sim.world import room


@pytest.mark.parametrize("truth", ["state", "tum"])
def test_an_euroc_folder_becomes_a_rectified_one(
    truth: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    source, out = make_euroc(tmp_path / "raw", truth=truth), tmp_path / "rect"
    facts = json_of(capsys, "rectify", source, "--out", out)
    raw, done = open_dataset(source), open_dataset(out)
    assert done.rectifier.maps is None, "the new folder needs no rectifying"
    camera = raw.recording.camera
    assert facts == {
        "out": str(out),
        "kind": "euroc",
        "source": "raw",
        "interpolation": "linear",
        "width": 64,
        "height": 48,
        "focal_px": camera.fu,
        "baseline_m": camera.baseline_m,
        "frames": 4,
    }
    assert done.recording.camera == replace(camera, baseline_m=done.recording.camera.baseline_m)
    assert done.recording.camera.baseline_m == pytest.approx(camera.baseline_m, abs=1e-12)
    np.testing.assert_allclose(done.recording.T_cam0_imu, raw.recording.T_cam0_imu, atol=1e-12)
    _same_frames(raw, done)
    copied = ["imu0/data.csv", "imu0/sensor.yaml"]
    copied += (
        ["state_groundtruth_estimate0/data.csv"] if truth == "state" else ["../groundtruth_tum.txt"]
    )
    for name in copied:
        assert (out / "mav0" / name).read_bytes() == (source / "mav0" / name).read_bytes()
    np.testing.assert_array_equal(
        done.recording.reference.T_world_body, raw.recording.reference.T_world_body
    )


def _same_frames(raw: Dataset, done: Dataset) -> None:
    """Reading the raw folder and reading the written one give the same bits."""
    ours, written = frames_of(raw), frames_of(done)
    assert len(ours) == len(written) > 0
    for a, b in zip(ours, written, strict=True):
        np.testing.assert_array_equal(a.left, b.left)
        np.testing.assert_array_equal(a.right, b.right)


@pytest.mark.parametrize("imu_known", [True, False])
def test_a_kitti_raw_drive_becomes_an_odometry_folder(
    imu_known: bool, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    source, out = make_kitti_raw(tmp_path / "raw", [100, 101, 103]), tmp_path / "rect"
    if not imu_known:
        (source / "calib_imu_to_velo.txt").unlink()
    facts = json_of(capsys, "rectify", source, "--out", out, "--interpolation", "linear")
    raw, done = open_dataset(source), open_dataset(out)
    assert facts["kind"] == "kitti_raw"
    assert facts["frames"] == 3
    assert done.recording.kind == "kitti"
    a, b = raw.recording.camera, done.recording.camera
    assert (a.fu, a.fv, a.cu, a.cv, a.width, a.height) == (
        b.fu,
        b.fv,
        b.cu,
        b.cv,
        b.width,
        b.height,
    )
    assert a.baseline_m == pytest.approx(b.baseline_m, rel=1e-12)
    if imu_known:
        np.testing.assert_allclose(done.recording.T_cam0_imu, raw.recording.T_cam0_imu, atol=1e-12)
    else:
        assert done.recording.T_cam0_imu is None
    assert np.diff(done.recording.frame_times_ns).tolist() == [100_000_000, 200_000_000]
    _same_frames(raw, done)


def test_the_table_names_what_was_written(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "rect"
    assert (
        main(
            [
                "rectify",
                str(make_euroc(tmp_path / "raw")),
                "--out",
                str(out),
                "--interpolation",
                "cubic",
            ]
        )
        == 0
    )
    captured = capsys.readouterr()
    rows = dict(line.split(maxsplit=1) for line in captured.out.splitlines())
    assert list(rows) == ["folder", "frames", "size", "focal", "baseline"]
    assert (rows["folder"], rows["frames"], rows["size"]) == (str(out), "4", "64 x 48")
    assert captured.err == "", "no progress bar where stderr is no terminal"
    assert json.loads((out / MARKER).read_text())["interpolation"] == "cubic"


def test_replaces_only_an_older_result(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    source, out = make_euroc(tmp_path / "raw", 3), tmp_path / "rect"
    for _ in range(2):
        assert json_of(capsys, "rectify", source, "--out", out)["frames"] == 3
    other = tmp_path / "precious"
    other.mkdir()
    (other / "thesis.txt").write_text("mine")
    assert "will not be replaced" in refused(capsys, "rectify", source, "--out", other)
    assert "will not be replaced" in refused(capsys, "rectify", source, "--out", source)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["precious", "raw", "rect"]
    assert (other / "thesis.txt").read_text() == "mine"


def test_rejects_a_recording_that_is_rectified_already(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    sources = (
        make_euroc(tmp_path / "euroc", rig=RECTIFIED_RIG),
        make_kitti_raw(tmp_path / "sync", rectified=True),
        make_kitti(tmp_path / "kitti"),
    )
    for source in sources:
        out = tmp_path / "out"
        assert "rectified already" in (message := refused(capsys, "rectify", source, "--out", out))
        assert "there is nothing to do" in message
        assert not out.exists()


def test_skips_a_corrupt_image_and_none_left_leaves_no_folder(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], caplog: pytest.LogCaptureFixture
) -> None:
    source, out = make_euroc(tmp_path / "raw", 8), tmp_path / "rect"
    stamps = camera_stamps(8)
    data = source / "mav0" / "cam0" / "data"
    (data / f"{stamps[2]}.png").write_bytes(b"")
    assert json_of(capsys, "rectify", source, "--out", out)["frames"] == 7
    assert "frame 2 is skipped" in caplog.text
    assert open_dataset(out).recording.frame_times_ns.tolist() == [
        t for k, t in enumerate(stamps) if k != 2
    ]
    for stamp in stamps:
        (data / f"{stamp}.png").write_bytes(b"")
    again = tmp_path / "again"
    assert "none of 8 frames can be used" in refused(capsys, "rectify", source, "--out", again)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["raw", "rect"], "nothing half-written"


# --- rendered folders, end to end
# -----------------------------------------------------------------------------------


def _bent(rig: StereoRig) -> StereoRig:
    """A rig with lens distortion and misaligned cameras."""
    bend = (-0.28, 0.07, 0.0004, -0.0003)
    T_cam0_cam1 = rig.T_cam0_cam1.copy()
    T_cam0_cam1[:3, :3] = [[1, -0.004, 0.006], [0.004, 1, -0.003], [-0.006, 0.003, 1]]
    u, _, vt = np.linalg.svd(T_cam0_cam1[:3, :3])
    T_cam0_cam1[:3, :3] = u @ vt
    return replace(
        rig,
        cam0=replace(rig.cam0, model="radtan", coefficients=bend),
        cam1=replace(rig.cam1, model="radtan", coefficients=bend),
        T_imu_cam1=rig.T_imu_cam0 @ T_cam0_cam1,
    )


@pytest.fixture(scope="module")
def flight() -> SimulatedRecording:
    """Eight frames through a rendered room, seen by unrectified cameras."""
    rig = _bent(small_rig(320, 200))
    motion = hand_held(seed=2, duration_s=4.0, still_s=0.0)
    times = 2_000_000_000 + 50_000_000 * np.arange(8)
    return SimulatedRecording(
        simulate(room(1, texel_m=0.005), rig, motion, frame_times_ns=times, imu=ImuNoise(), seed=1)
    )


@pytest.fixture(scope="module")
def folder(flight: SimulatedRecording, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("flight") / "euroc"
    export_euroc(flight, out)
    return out


def test_a_rendered_folder_reads_as_the_rectified_cameras_would_see_it(
    flight: SimulatedRecording, folder: Path
) -> None:
    """The whole chain (renderer, yaml, maps, resampling) against images rendered by the
    rectified cameras.
    """
    dataset = open_dataset(folder)
    simulation = flight.simulation
    done = rectified_cameras(simulation.rig)
    assert dataset.recording.camera.fu == pytest.approx(done.camera.fu, rel=1e-9)
    assert dataset.recording.motion == {"imu"}
    ideal = replace(simulation, rig=rig_from_rectified(done.camera, done.T_rect0_imu))
    frame = frames_of(dataset)[3]
    for image, view in zip((frame.left, frame.right), views(ideal, frame.time_ns), strict=True):
        expected = render(
            simulation.world, camera_rays(view.camera), view.T_world_cam, frame.time_ns
        )
        difference = (image - expected)[4:-4, 4:-4]
        assert np.sqrt(np.mean(difference**2)) < 0.15 * expected.std()
        shifted = (np.roll(image, 1, axis=1) - expected)[4:-4, 4:-4]
        assert np.mean(shifted**2) > 3 * np.mean(difference**2)


def test_run_takes_an_unrectified_folder_like_a_rectified_one(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    metrics = json_of(capsys, "run", folder, "--out", tmp_path / "run", "--backend", "vislam")
    assert metrics["frames"] == 8
    assert metrics["ate_m"] < 0.02, "the ground truth of the IMU is found and honoured"
    assert metrics["motion"] == "none", (
        "the paper's filter has no IMU model and uses the images alone"
    )
    assert json_of(capsys, "rectify", folder, "--out", tmp_path / "rect")["frames"] == 8
    again = json_of(
        capsys, "run", tmp_path / "rect", "--out", tmp_path / "run2", "--backend", "vislam"
    )
    assert again["ate_m"] == pytest.approx(metrics["ate_m"], rel=1e-6)
