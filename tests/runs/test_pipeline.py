"""The pipeline with fakes in its boxes: what flows where, in which order, and what a run leaves
behind.
"""

from __future__ import annotations

import csv
import json
from collections.abc import Iterator
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from typing import ClassVar, Literal

import numpy as np
import pytest
from threadpoolctl import threadpool_info, threadpool_limits

from vio.config import Config, load_config
from vio.errors import ConfigError, DataError, VioError
from vio.files.trajectories import read_trajectory
from vio.filters.msckf import Msckf
from vio.geometry.lie import se3_exp, se3_from_parts, se3_inverse, transform_points
from vio.geometry.stereo import StereoCamera, project
from vio.live.build import Parts, resolve_motion
from vio.records import (
    Event,
    FrameResult,
    FrontendOutput,
    Landmarks,
    Observations,
    Recording,
    RunMotion,
    StereoFrame,
    Trajectory,
    UpdateReport,
    VelocitySample,
    observations,
)
from vio.runs.folder import start_s, write_run_folder
from vio.runs.pipeline import run
from vio.runs.stated import read_run
from vio.runs.tables import ESTIMATE, FRAME

CAMERA = StereoCamera(700.0, 700.0, 600.0, 180.0, 0.54, 1242, 375)
T_CAM0_IMU = se3_from_parts(
    np.array([[0.0, -1, 0], [0, 0, -1], [1, 0, 0]]), np.array([0.1, 0.7, -1.1])
)
STEP_NS = 100_000_000


class FakeDrive:
    """A short drive with perfect features and velocities, without images."""

    def __init__(self, frames: int = 30, *, velocity: bool = True) -> None:
        self.u = np.array([6.0, 0, 0, 0, 0, 0.25])
        poses = np.array([se3_exp(0.1 * k * self.u) for k in range(frames)])
        times = np.arange(frames, dtype=np.int64) * STEP_NS
        rng = np.random.default_rng(0)
        self.points = np.column_stack(
            [rng.uniform(0, 50, 500), rng.uniform(-20, 30, 500), rng.uniform(-1, 6, 500)]
        )
        self.poses = poses
        self._recording = Recording(
            kind="fake",
            path=Path("somewhere/drive"),
            camera=CAMERA,
            T_cam0_imu=T_CAM0_IMU,
            frame_times_ns=times,
            has_images=False,
            motion=frozenset({"velocity"}) if velocity else frozenset(),
            reference=Trajectory(poses, times, "imu", np.arange(frames)),
        )

    @property
    def recording(self) -> Recording:
        return self._recording

    def events(
        self, start: int = 0, stop: int | None = None, *, images: bool = True
    ) -> Iterator[Event]:
        for k in range(start, min(stop or len(self.poses), len(self.poses))):
            if self._recording.motion:
                yield VelocitySample(k * STEP_NS, self.u[:3], self.u[3:])
            yield StereoFrame(k, k * STEP_NS, None, None)

    def observations(self, index: int) -> Observations | None:
        p = transform_points(T_CAM0_IMU @ se3_inverse(self.poses[index]), self.points)
        near = (p[:, 2] > 2) & (p[:, 2] < 40)
        z = project(CAMERA, np.where(near[:, None], p, [0.0, 0.0, 10.0]))
        ids = np.flatnonzero(
            near & (z[:, 2] > 0) & (z[:, 0] < 1242) & (z[:, 1] > 0) & (z[:, 1] < 375)
        )
        return observations(index, index * STEP_NS, ids, z[ids])


def test_perfect_features_give_a_perfect_trajectory() -> None:
    drive = FakeDrive()
    result = run(drive, Config())
    # The velocity at the start is measured to 0.5 m/s only; three Gauss-Newton steps leave a tenth
    # of a millimetre.
    np.testing.assert_allclose(result.trajectory.positions, drive.poses[:, :3, 3], atol=1e-3)
    np.testing.assert_allclose(result.dead_reckoning.positions, drive.poses[:, :3, 3], atol=1e-9)
    assert result.trajectory.frame_indices.tolist() == list(range(30))


@pytest.mark.parametrize("span", [{"stop": 3.0}, {"start": [1]}, {"start": "2"}])
def test_ends_of_a_range_are_whole_numbers(span: dict[str, int]) -> None:
    with pytest.raises(ConfigError, match="start and stop are numbers of frames, not"):
        run(FakeDrive(), Config(), **span)
    assert len(run(FakeDrive(), Config(), start=np.int64(1), stop=np.int64(4)).frames) == 3


def test_part_of_a_recording_keeps_its_frame_numbers() -> None:
    result = run(FakeDrive(), Config(), start=5, stop=12)
    assert [f.index for f in result.frames] == list(range(5, 12))


def test_images_alone_run_on_features_too() -> None:
    drive = FakeDrive(velocity=False)
    result = run(drive, Config())
    assert result.motion is None
    assert result.dead_reckoning is None
    assert np.linalg.norm(result.trajectory.positions[-1] - drive.poses[-1, :3, 3]) < 0.05


def test_two_runs_give_the_same_bits() -> None:
    a, b = run(FakeDrive(), Config()), run(FakeDrive(), Config())
    np.testing.assert_array_equal(a.trajectory.T_world_body, b.trajectory.T_world_body)


def test_the_stated_scale_holds_what_the_sensor_says_against_it(tmp_path: Path) -> None:
    """Not only in the covariances: a summary of 0.58 % would contradict them."""
    right = run(FakeDrive(), Config())
    drive = FakeDrive()
    camera = replace(CAMERA, baseline_m=1.05 * CAMERA.baseline_m)
    drive._recording = replace(drive.recording, camera=camera)
    wrong = run(drive, Config())
    stated = [
        write_run_folder(tmp_path / name, result, None)["rig_scale_sigma"]
        for name, result in (("right", right), ("wrong", wrong))
    ]
    assert stated[0] == pytest.approx(np.hypot(0.005, 0.003), rel=0.2)
    assert stated[1] > 0.02


def test_a_lag_gives_each_pose_what_later_frames_know() -> None:
    drive = FakeDrive(velocity=False)
    exact = load_config(
        overrides=["msckf.stereo_baseline_sigma=0", "msckf.stereo_focal_sigma=0"]
    )  # which no later frame makes better
    causal = run(drive, exact)
    late = run(FakeDrive(velocity=False), replace(exact, lag_frames=3))
    np.testing.assert_allclose(
        late.trajectory.T_world_body[-1], causal.trajectory.T_world_body[-1], atol=1e-9
    )
    revised = np.any(late.trajectory.T_world_body != causal.trajectory.T_world_body, axis=(1, 2))
    assert revised[1:-1].all()
    shift = np.linalg.norm(late.trajectory.positions - causal.trajectory.positions, axis=1)
    assert shift.max() < 0.05
    # Everything is the smoothed estimate's, the covariance and the velocity too. The pixel noise
    # falls as it is learned from perfect features, and jumps as landmarks begin, so single
    # covariances may be larger.
    ratios = []
    for k in range(2, len(late.estimates) - 1):
        was, now = causal.estimates[k], late.estimates[k]
        assert now.time_ns == was.time_ns
        ratios.append(np.trace(now.covariance) / np.trace(was.covariance))
        assert was.velocity_world is not None
        assert now.velocity_world is not None
        assert np.any(now.velocity_world != was.velocity_world)
    assert np.median(ratios) < 0.97
    with pytest.raises(ConfigError, match="lag_frames=11"):
        run(drive, replace(Config(), lag_frames=11))
    with pytest.raises(ConfigError, match="needs backend msckf"):
        run(drive, replace(Config(), lag_frames=1, backend="vislam"))


@pytest.mark.parametrize("backend", ["msckf", "vislam"])
def test_only_selected_rows_reach_the_filter(backend: Literal["msckf", "vislam"]) -> None:
    """Left views are enough for the sliding window, whose motion gives them a depth, but not for
    the paper's filter.
    """

    class Half:
        def select(self, rows: Observations, motion=None):  # type: ignore[no-untyped-def]
            from vio.records import Selection

            return Selection(rows.ids % 2 == 0, np.zeros(len(rows)), "even ids")

    class LeftOnlyForThrees:
        def __init__(self, drive: FakeDrive) -> None:
            self.drive = drive

        def process(self, frame: StereoFrame, prior: object = None) -> FrontendOutput:
            seen = self.drive.observations(frame.index)
            return FrontendOutput(replace(seen, has_right=seen.ids % 3 != 0), 0, 0, 0)

    drive = FakeDrive()
    result = run(drive, Config(backend=backend), parts=Parts(LeftOnlyForThrees(drive), Half()))
    assert len(result.landmarks.ids) > 0
    assert not np.any(result.landmarks.ids % 2)
    assert np.any(result.landmarks.ids % 3 == 0) == (backend == "msckf")


def test_the_viewer_sees_each_frame_and_is_closed_even_after_an_error() -> None:
    class Counting:
        frames = 0
        closed = False

        def frame(self, result: FrameResult) -> None:
            self.frames += 1
            if self.frames == 7:
                raise DataError("enough")

        def close(self) -> None:
            self.closed = True

    viewer = Counting()
    with pytest.raises(DataError, match="enough"):
        run(FakeDrive(), Config(), viewer=viewer)
    assert viewer.frames == 7
    assert viewer.closed


def test_memory_does_not_grow_with_frames_beyond_the_map() -> None:
    """Standing still, the map is complete after the first frame; only poses and log rows may be
    added.
    """
    import tracemalloc

    class Standing(FakeDrive):
        def observations(self, index: int) -> Observations | None:
            seen = super().observations(0)
            return (
                None if seen is None else replace(seen, frame_index=index, time_ns=index * STEP_NS)
            )

    class Watch:
        sizes: ClassVar[list[int]] = []

        def frame(self, result: FrameResult) -> None:
            self.sizes.append(tracemalloc.get_traced_memory()[0])

        def close(self) -> None:
            pass

    tracemalloc.start()
    try:
        run(Standing(frames=200), load_config(None, ["motion=none"]), viewer=Watch())
    finally:
        tracemalloc.stop()
    growth = (Watch.sizes[199] - Watch.sizes[99]) / 100
    rows = 1.28 * (ESTIMATE.itemsize + FRAME.itemsize)  # tables double, here at row 128
    assert growth < rows + 1024, f"{growth:.0f} bytes a frame, {rows:.0f} of them rows"


def _blas_threads() -> set[int]:
    libraries = [library for library in threadpool_info() if library["user_api"] == "blas"]
    # 4.10 has its own
    return {library["num_threads"] for library in libraries if "opencv" not in library["filepath"]}


@pytest.mark.parametrize("fails", [False, True])
def test_run_uses_one_blas_thread_and_restores_the_callers_number(fails: bool) -> None:
    inside: list[set[int]] = []

    class Watched(Msckf):
        def update(self, seen: Observations) -> UpdateReport:
            inside.append(_blas_threads())
            if fails:
                raise DataError("enough")
            return super().update(seen)

    drive = FakeDrive(frames=3)
    backend = Watched(CAMERA, T_CAM0_IMU, Config().msckf, motion="velocity")
    with threadpool_limits(limits=2, user_api="blas"):
        assert _blas_threads() == {2}
        with pytest.raises(DataError, match="enough") if fails else nullcontext():
            run(drive, Config(), parts=Parts(backend=backend))
        assert _blas_threads() == {2}
    assert inside == [{1}] * (1 if fails else 3)


def test_a_divergence_is_an_event_and_not_the_end_of_the_run() -> None:
    """The filter's state is no number in frame 8: the run goes on from the pose of frame 7, and
    says so once.
    """

    class Fragile(Msckf):
        def update(self, seen: Observations) -> UpdateReport:
            if seen.frame_index == 8 and self._frame.smoothed is not None:
                self._window.prior.P[0, 0] = np.nan
            return super().update(seen)

    drive = FakeDrive(frames=20)
    backend = Fragile(CAMERA, T_CAM0_IMU, Config().msckf, motion="velocity")
    result = run(drive, Config(), parts=Parts(backend=backend))
    (line,) = [line for line in result.warnings if "started again" in line]
    assert line.startswith("frame 8: msckf diverged at frame 8")
    np.testing.assert_allclose(result.trajectory.positions, drive.poses[:, :3, 3], atol=0.3)
    assert len(result.frames) == 20


@pytest.mark.parametrize(
    ("overrides", "velocity", "message"),
    [
        (["motion=velocity"], False, "the recording holds no motion sensor"),
        (["motion=imu"], True, "the recording holds velocity"),
        (["motion=imu", "backend=vislam"], True, "no model for --motion imu"),
    ],
)
def test_motion_that_cannot_be_had_is_an_error(
    overrides: list[str], velocity: bool, message: str
) -> None:
    with pytest.raises(ConfigError, match=message):
        resolve_motion(FakeDrive(velocity=velocity).recording, load_config(None, overrides))


@pytest.mark.parametrize(
    ("run_motion", "backend", "expected"),
    [
        ("none", "msckf", None),
        ("velocity", "msckf", "velocity"),
        ("imu", "msckf", "imu"),
        ("imu", "vislam", "velocity"),
    ],
)
def test_motion_auto_takes_that_of_the_logged_run(
    run_motion: RunMotion, backend: str, expected: str | None
) -> None:
    both = replace(
        FakeDrive().recording,
        kind="log",
        motion=frozenset({"imu", "velocity"}),
        run_motion=run_motion,
    )
    assert resolve_motion(both, load_config(None, [f"backend={backend}"])) == expected


@pytest.mark.parametrize(("start", "stop"), [(-1, None), (5, 5), (30, None)])
def test_frame_ranges_that_hold_nothing_are_errors(start: int, stop: int | None) -> None:
    with pytest.raises(ConfigError, match="frame"):
        run(FakeDrive(), Config(), start=start, stop=stop)


def test_run_folder_holds_what_it_promises(tmp_path: Path) -> None:
    drive = FakeDrive()
    result = run(drive, Config())
    metrics = write_run_folder(
        tmp_path / "out", result, drive.recording.reference, lengths_m=(5.0,)
    )
    names = {f.name for f in (tmp_path / "out").iterdir()}
    assert names == {
        "config.yaml",
        "trajectory.tum",
        "trajectory.kitti",
        "estimates.npy",
        "reference.tum",
        "dead_reckoning.tum",
        "landmarks.ply",
        "frames.csv",
        "metrics.json",
        "trajectory.png",
    }
    assert load_config(tmp_path / "out" / "config.yaml") == result.config
    assert json.loads((tmp_path / "out" / "metrics.json").read_text()) == metrics
    assert metrics["ate_m"] < 1e-3
    assert metrics["t_err_percent"] < 1e-3
    rows = list(csv.DictReader((tmp_path / "out" / "frames.csv").read_text().splitlines()))
    assert len(rows) == 30
    assert {
        "index",
        "read_ms",
        "tracked",
        "matched",
        "selected",
        "gated",
        "innovation_median_px",
    } <= set(rows[0])
    read, T_cam0_imu = read_run(tmp_path / "out")
    np.testing.assert_allclose(read.T_world_body, result.trajectory.T_world_body, atol=1e-9)
    np.testing.assert_allclose(T_cam0_imu, T_CAM0_IMU)
    kitti = read_trajectory(tmp_path / "out" / "trajectory.kitti")
    np.testing.assert_allclose(kitti.T_world_body[0], np.eye(4), atol=1e-12)
    cam0 = result.trajectory.T_world_body @ se3_inverse(T_CAM0_IMU)
    np.testing.assert_allclose(kitti.positions, (se3_inverse(cam0[0]) @ cam0)[:, :3, 3], atol=1e-9)


@pytest.mark.parametrize(
    "text", ["", "[]", "{}", '{"T_cam0_imu": "x"}', '{"T_cam0_imu": [[1], [2, 3]]}']
)
def test_damaged_metrics_of_a_run_are_named(text: str, tmp_path: Path) -> None:
    (tmp_path / "metrics.json").write_text(text)
    with pytest.raises(DataError, match=r"metrics\.json: is damaged .*; repeat the run"):
        read_run(tmp_path)


def test_landmarks_in_the_ply_are_the_true_points(tmp_path: Path) -> None:
    drive = FakeDrive()
    result = run(drive, Config())
    write_run_folder(tmp_path / "out", result, None)
    blob = (tmp_path / "out" / "landmarks.ply").read_bytes()
    header, _, body = blob.partition(b"end_header\n")
    points = np.frombuffer(body, dtype="<f4").reshape(-1, 4)
    assert f"element vertex {len(points)}".encode() in header
    np.testing.assert_allclose(points[:, :3], drive.points[result.landmarks.ids], atol=0.05)


def test_surveyed_landmarks_are_compared_after_the_alignment_of_the_trajectory(
    tmp_path: Path,
) -> None:
    drive = FakeDrive()
    moved = se3_exp([4.0, -3.0, 1.0, 0.1, 0.2, -0.5])
    known = np.arange(0, 500, 2)
    truth = Landmarks(
        known, transform_points(moved, drive.points[known]), np.zeros((len(known), 3, 3))
    )
    result = run(drive, Config())
    result = replace(result, recording=replace(result.recording, landmarks_reference=truth))
    reference = replace(drive.recording.reference, T_world_body=moved @ drive.poses)
    score = write_run_folder(tmp_path / "out", result, reference)["landmark_error"]
    assert score["matched"] == np.isin(result.landmarks.ids, known).sum()
    assert score["rmse_m"] < 0.05
    assert score["median_m"] <= score["max_m"]


def test_velocities_that_begin_after_the_images_end_no_run(tmp_path: Path) -> None:
    """Nothing is reckoned before the first one; from it on, as the velocities say."""

    class Late(FakeDrive):
        def events(
            self, start: int = 0, stop: int | None = None, *, images: bool = True
        ) -> Iterator[Event]:
            for event in super().events(start, stop, images=images):
                if isinstance(event, StereoFrame) or event.time_ns >= 10 * STEP_NS:
                    yield event

    drive = Late()
    result = run(drive, Config())
    assert result.stopped is None
    reckoned = result.dead_reckoning.T_world_body
    assert len(reckoned) == len(result.estimates) == 30
    np.testing.assert_array_equal(reckoned[:10], np.tile(np.eye(4), (10, 1, 1)))
    np.testing.assert_allclose(
        se3_inverse(reckoned[12]) @ reckoned[29],
        se3_inverse(drive.poses[12]) @ drive.poses[29],
        atol=1e-6,
    )
    assert write_run_folder(tmp_path / "out", result, drive.recording.reference)["ate_m"] < 0.05


def test_a_second_run_replaces_the_first_but_never_something_else(tmp_path: Path) -> None:
    result = run(FakeDrive(frames=5), Config())
    write_run_folder(tmp_path / "out", result, None)
    write_run_folder(tmp_path / "out", result, None)
    mine = tmp_path / "thesis"
    mine.mkdir()
    (mine / "chapter.txt").write_text("years of work")
    with pytest.raises(VioError, match="thesis"):
        write_run_folder(mine, result, None)
    assert (mine / "chapter.txt").read_text() == "years of work"


def test_a_reference_that_does_not_fit_is_a_warning_not_a_lost_run(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    drive = FakeDrive(frames=5)
    late = Trajectory(drive.poses, np.arange(5, dtype=np.int64) + 10**15, "imu")
    metrics = write_run_folder(tmp_path / "out", run(drive, Config()), late)
    assert metrics["ate_m"] is None
    assert "reference was not used" in caplog.text


def test_a_recording_that_shows_nothing_is_said_so() -> None:
    class Dark(FakeDrive):
        def observations(self, index: int) -> Observations | None:
            return observations(index, index * STEP_NS, [], np.zeros((0, 4)))

    result = run(Dark(frames=4, velocity=False), Config())
    assert (
        result.warnings[-1]
        == "no feature in any of 4 frames: the trajectory contains no information on the motion"
    )
    assert not any(
        "no feature in any" in line for line in run(FakeDrive(frames=4), Config()).warnings
    )


def test_an_error_of_refused_frames_gives_their_reason_and_not_the_last_warning() -> None:
    class Hollow(FakeDrive):
        """Most frames have no features, and the last ones do not come."""

        def events(
            self, start: int = 0, stop: int | None = None, *, images: bool = True
        ) -> Iterator[Event]:
            yield from super().events(start, 20, images=images)

        def observations(self, index: int) -> Observations | None:
            return super().observations(index) if index < 5 else None

    with pytest.raises(
        DataError, match=r"^most frames were refused: frame \d+ has no precomputed observations"
    ):
        run(Hollow(), Config())


@pytest.mark.parametrize(("slowest_ms", "start"), [(90.0, 0.0), (110.0, 0.1)])
def test_frames_that_take_ten_times_as_long_are_the_start(slowest_ms: float, start: float) -> None:
    assert start_s(np.array([slowest_ms, *[10.0] * 20])) == pytest.approx(start)
