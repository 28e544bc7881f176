"""Runs in the rerun viewer: what is sent to it."""

from __future__ import annotations

import sys
from collections import defaultdict
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.commands import refused
from vio.cli import main
from vio.config import load_config
from vio.datasets import open_dataset
from vio.geometry.stereo import StereoCamera
from vio.records import Estimate, LoopEvent, UpdateReport, observations
from vio.runs.pipeline import RunResult, run
from vio.view.live import RerunViewer, ViewedRig, age_colours, states_of

rr = pytest.importorskip("rerun", reason="needs the extra view")


class Recorder:
    """In place of a stream: keeps what is sent, by entity."""

    def __init__(self) -> None:
        self.sent: dict[str, list[tuple[int | None, Any]]] = defaultdict(list)
        self.flushed = 0
        self._frame: int | None = None

    def set_time(
        self, timeline: str, *, sequence: int | None = None, duration: float | None = None
    ) -> None:
        if timeline == "frame":
            self._frame = sequence

    def log(self, entity: str, *archetypes: Any, static: bool = False) -> None:
        for archetype in archetypes:
            self.sent[entity].append((None if static else self._frame, archetype))

    def send_blueprint(self, blueprint: Any) -> None:
        self.sent["blueprint"].append((None, blueprint))

    def flush(self) -> None:
        self.flushed += 1


def _shown(flight: Path, share: float) -> tuple[Recorder, RunResult, RunResult]:
    """The flight, run with and without a viewer."""
    dataset, config = open_dataset(flight), load_config()
    recording, stream = dataset.recording, Recorder()
    assert recording.T_cam0_imu is not None
    rig = ViewedRig(recording.camera, recording.T_cam0_imu, "imu", recording.reference)
    viewer = RerunViewer(stream, rig, share=share)  # type: ignore[arg-type]
    return stream, run(dataset, config, viewer=viewer), run(dataset, config)


@pytest.fixture(scope="module")
def shown(flight: Path) -> tuple[Recorder, RunResult, RunResult]:
    return _shown(flight, 1.0)


def test_a_viewer_changes_nothing(shown: tuple[Recorder, RunResult, RunResult]) -> None:
    _, seen, plain = shown
    assert np.array_equal(seen.trajectory.T_world_body, plain.trajectory.T_world_body)


def test_every_frame_shows_pose_path_image_features_and_curves(
    shown: tuple[Recorder, RunResult, RunResult],
) -> None:
    stream, result, _ = shown
    frames = [log.index for log in result.frames]
    moved = [k for k, what in stream.sent["world/run/camera"] if isinstance(what, rr.Transform3D)]
    assert moved == frames
    for entity in (
        "world/run/camera/image",
        "world/run/camera/features",
        "world/run/camera/tracks_by_age",
    ):
        assert [k for k, _ in stream.sent[entity]] == frames, entity
    path = stream.sent["world/run/path/00000"][-1][1].strips.as_arrow_array().to_pylist()[0]
    assert np.array(path) == pytest.approx(result.trajectory.positions, abs=1e-5)
    scalars = {
        name: len(stream.sent[f"plots/{name}"])
        for name in ("features", "velocity", "gyro_bias", "accel_bias")
    }
    assert scalars == dict.fromkeys(scalars, len(frames) + 1)  # and the names of the curves
    assert stream.flushed == 1
    assert stream.sent["world/run/reference"][0][0] is None  # drawn once


def test_marks_lie_on_the_pixels_of_the_shown_image(
    shown: tuple[Recorder, RunResult, RunResult], flight: Path
) -> None:
    """The centre of our first pixel is (0, 0), of rerun's (0.5, 0.5); so is the principal point."""
    stream, _, _ = shown
    camera = open_dataset(flight).recording.camera
    (pinhole,) = [
        what for _, what in stream.sent["world/run/camera"] if isinstance(what, rr.Pinhole)
    ]
    matrix = np.array(pinhole.image_from_camera.as_arrow_array().to_pylist()).reshape(3, 3).T
    assert matrix[:2, 2] == pytest.approx([camera.cu + 0.5, camera.cv + 0.5], abs=1e-4)
    seen = RerunViewer._pixels
    assert seen(_Half(), np.array([10.0, 20.0])) == pytest.approx([5.25, 10.25])  # type: ignore[arg-type]


def test_a_cylinder_is_outlined_as_a_cylinder(flight: Path) -> None:
    """Rows of 200 degrees, which no pinhole has: the border lies about the baseline, behind the
    camera as well.
    """
    stream = Recorder()
    camera = StereoCamera(100.0, 100.0, 100.0, 174.5, 0.2, 200, 350, "cylinder")
    RerunViewer(stream, ViewedRig(camera, np.eye(4), None, None))  # type: ignore[arg-type]
    assert not any(isinstance(what, rr.Pinhole) for _, what in stream.sent["world/run/camera"])
    ((_, lines),) = stream.sent["world/run/camera/outline"]
    border, *edges = (np.array(strip) for strip in lines.strips.as_arrow_array().to_pylist())
    # five baselines
    np.testing.assert_allclose(np.hypot(border[:, 1], border[:, 2]), 1.0, rtol=1e-6)
    azimuth = np.degrees(np.arctan2(border[:, 1], border[:, 2]))
    assert (azimuth.min(), azimuth.max()) == pytest.approx((-100.3, 100.3), abs=0.1)
    assert len(edges) == 4
    assert all(np.array_equal(edge[0], np.zeros(3)) for edge in edges)


class _Half:
    _scale = 0.5  # of a viewer that shows images at half their width


def test_keyframes_and_loops_of_a_map_are_drawn(flight: Path) -> None:
    recording, stream = open_dataset(flight).recording, Recorder()
    viewer = RerunViewer(stream, ViewedRig(recording.camera, np.eye(4), None, None))  # type: ignore[arg-type]
    again = LoopEvent(
        frame=20, time_ns=2, keyframe=0, keyframe_time_ns=0, inliers=40, gap_m=0.1, joined=False
    )
    for index, loops in ((0, ()), (20, ()), (21, (replace(again, keyframe_frame=0), again))):
        T = np.eye(4)
        T[0, 3] = index
        estimate = Estimate(index, T, np.eye(6))
        viewer.places(index, estimate, is_keyframe=index < 21, loops=loops)
    marks = stream.sent["world/run/keyframes"][-1][1].positions.as_arrow_array().to_pylist()
    assert [p[0] for p in marks] == [0.0, 20.0]
    (line,) = stream.sent["world/run/loops"][-1][1].strips.as_arrow_array().to_pylist()
    assert [p[0] for p in line] == [20.0, 0.0]
    texts = [what.text.as_arrow_array().to_pylist()[0] for _, what in stream.sent["loops"]]
    assert "the place of frame 0 again" in texts[0]
    assert "the place of an earlier session again" in texts[1]


def test_the_world_is_upright(shown: tuple[Recorder, RunResult, RunResult]) -> None:
    stream, _, _ = shown
    (_, transform), *_ = stream.sent["world/run"]
    R = np.array(transform.mat3x3.as_arrow_array().to_pylist()).reshape(3, 3).T
    assert pytest.approx([0, 0, 1], abs=1e-6) == R[2]  # with an IMU the run's own world already is


def test_without_time_for_it_images_are_left_out(flight: Path) -> None:
    stream, result, _ = _shown(flight, 0.0)
    assert len(stream.sent["world/run/camera/image"]) <= 1
    assert len(
        [1 for _, what in stream.sent["world/run/camera"] if isinstance(what, rr.Transform3D)]
    ) == len(result.frames)


def test_the_state_of_a_feature_is_what_the_filter_made_of_it() -> None:
    seen = observations(
        0, 0, [1, 2, 3, 4, 5], np.ones((5, 4)), has_right=[True, True, True, False, True]
    )
    report = UpdateReport(
        2, 1, 0, 1, None, None, gated_ids=np.array([2]), landmark_ids=np.array([5])
    )
    states = states_of(seen, np.array([True, True, False, False, True]), report)
    # used, gated, stereo but not used, left only, landmark
    assert states.tolist() == [0, 2, 3, 4, 1]


def test_colours_of_tracks_go_from_new_to_old() -> None:
    colours = age_colours(np.array([0, 20, 40, 400]))
    assert colours.tolist() == [[255, 214, 10], [138, 137, 105], [20, 60, 200], [20, 60, 200]]


def test_runs_go_into_files_while_they_run_and_afterwards(
    flight: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    live, out, again = tmp_path / "live.rrd", tmp_path / "run", tmp_path / "again.rrd"
    options = ["--quiet", "--save-observations", "--view", str(live), "--out", str(out)]
    assert main(["run", str(flight), *options]) == 0
    assert live.read_bytes()[:4] == b"RRF2"
    capsys.readouterr()
    assert main(["view", str(out), str(again)]) == 0
    assert capsys.readouterr().out.strip() == str(again)
    assert again.read_bytes()[:4] == b"RRF2"
    assert again.stat().st_size > 20_000


@pytest.mark.parametrize(
    ("where", "says"),
    [
        ("somewhere", "takes nothing (a window), web, or a file"),
        ("missing/run.rrd", "its folder does not exist"),
        (".rrd/", "takes nothing"),
    ],
)
def test_a_wrong_place_is_named_before_the_run(
    flight: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    where: str,
    says: str,
) -> None:
    monkeypatch.chdir(tmp_path)
    message = refused(capsys, "run", flight, "--quiet", "--out", "run", "--view", where)
    assert says in message
    assert not (tmp_path / "run").exists()


@pytest.mark.skipif(
    not sys.platform.startswith("linux"), reason="other systems always have a screen"
)
def test_without_a_screen_a_window_is_refused(
    flight: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    assert "--view web" in refused(
        capsys, "run", flight, "--quiet", "--out", tmp_path / "run", "--view"
    )


def test_without_rerun_the_extra_is_named(
    flight: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setitem(sys.modules, "rerun", None)
    assert "install the extra view" in refused(
        capsys, "run", flight, "--quiet", "--out", tmp_path / "run", "--view", "web"
    )
