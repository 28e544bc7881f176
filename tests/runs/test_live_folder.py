"""The run folder of a live odometry: equal to that of the file's run, and whole after a kill."""

from __future__ import annotations

import csv
import json
import shutil
import time
from collections import deque
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast
from unittest.mock import MagicMock, patch

import numpy as np
import pytest

import vio
from tests.commands import refused
from tests.replaced_rules import replaced
from vio.cli import main
from vio.config import Config
from vio.datasets.rigs import load_rig
from vio.errors import NOTE, DataError
from vio.files.trajectories import read_trajectory
from vio.findings import Finding
from vio.live.live_odometry import LiveOdometry
from vio.records import ImuSample, StereoFrame
from vio.runs.finished import read_finished_run
from vio.runs.folder import write_run_folder
from vio.runs.live_folder import LiveFolder, LiveRunSettings, _times_ns

FRAMES = 16


def _feed(odometry: LiveOdometry, flight: Path, shift_ns: int = 0) -> None:
    for event in vio.open_dataset(flight).events():
        if isinstance(event, ImuSample):
            odometry.add_imu(event.time_ns + shift_ns, event.gyro, event.accel)
        elif isinstance(event, StereoFrame):
            assert event.left is not None
            assert event.right is not None
            odometry.add_stereo(event.time_ns + shift_ns, event.left, event.right)


def _live(flight: Path, folder: LiveFolder, config: Config) -> LiveOdometry:
    return LiveOdometry(load_rig(flight), config, drop="block", sink=folder, copy_images=False)


def _folder(flight: Path, out: Path, config: Config, **more: Any) -> LiveFolder:
    settings = LiveRunSettings(out, "/cam0/image_raw", waits=True, **more)
    return LiveFolder(settings, config, load_rig(flight))


@pytest.mark.parametrize("lag", [0, 3])
def test_the_folder_is_that_of_the_file_s_run(flight: Path, tmp_path: Path, lag: int) -> None:
    config = replace(Config(), lag_frames=lag)
    result = vio.run(vio.open_dataset(flight), config, keep_observations=True)
    write_run_folder(tmp_path / "file", result, None, save_observations=True)
    folder = _folder(flight, tmp_path / "live", config, save_observations=True)
    with _live(flight, folder, config) as odometry:
        _feed(odometry, flight)
    folder.close()
    live = read_finished_run(tmp_path / "live")
    file = read_finished_run(tmp_path / "file")
    assert live.estimates.tobytes() == file.estimates.tobytes()
    np.testing.assert_array_equal(live.points, file.points)
    counted = [name for name in file.frames if not name.endswith("_ms")]
    for name in counted:
        np.testing.assert_array_equal(live.frames[name], file.frames[name])
    assert live.metrics["complete"]
    assert live.metrics["source"] == "/cam0/image_raw"
    same = ("body", "motion", "frames", "landmarks", "integrity", "camera", "T_cam0_imu")
    assert [live.metrics[name] for name in same] == [file.metrics[name] for name in same]
    assert not (tmp_path / "live" / "unfinished").exists()
    assert vio.load_rig(tmp_path / "live" / "camchain-imucam.yaml").T_cam0_imu is not None
    logs = [np.load(tmp_path / name / "observations.npz") for name in ("live", "file")]
    for name in ("frame_times_ns", "frame_indices", "ids", "z", "motion_times_ns", "motion_values"):
        np.testing.assert_array_equal(logs[0][name], logs[1][name])
    assert main(["report", str(tmp_path / "live")]) == 0


def test_a_reset_ends_a_folder_and_begins_another(flight: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    folder = _folder(flight, out, Config())
    with _live(flight, folder, Config()) as odometry:
        _feed(odometry, flight)
        odometry.reset()
        _feed(odometry, flight, 10**10)
    folder.close()
    names = ("out", "out-2")
    runs = [read_finished_run(tmp_path / name) for name in names]
    assert [run.metrics["complete"] for run in runs] == [True, True]
    # the last frame waits for a sample after it, which the reset forgets
    assert len(runs[0].trajectory) in (FRAMES - 1, FRAMES)
    assert len(runs[1].trajectory) == FRAMES
    n = len(runs[0].trajectory)
    np.testing.assert_array_equal(
        runs[0].estimates["T_world_imu"], runs[1].estimates["T_world_imu"][:n]
    )
    assert [(tmp_path / name / "trajectory.png").is_file() for name in names] == [False, True]
    assert not list(tmp_path.glob("*/unfinished"))


def test_an_earlier_folder_is_kept_and_the_new_one_is_named(
    flight: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(NOTE)
    out = tmp_path / "out"
    out.mkdir()
    (out / "notes.txt").write_text("mine")
    folder = _folder(flight, out, Config())
    with _live(flight, folder, Config()) as odometry:
        _feed(odometry, flight)
    folder.close()
    assert [path.name for path in out.iterdir()] == ["notes.txt"]
    assert f"the results are in {tmp_path / 'out-2'}" in caplog.messages
    assert len(read_finished_run(tmp_path / "out-2").trajectory) == FRAMES
    file = tmp_path / "file"
    file.touch()
    with pytest.raises(DataError, match="is a file"):
        _folder(flight, file, Config())


@pytest.fixture
def killed(flight: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The folder of a live run as it was after its last frame, before its end."""
    monkeypatch.setattr(
        "vio.runs.recorder._TIMES", replaced("vio.runs.recorder._TIMES", checkpoint_s=-1.0)
    )
    monkeypatch.setattr(
        "vio.runs.recorder._TIMES", replaced("vio.runs.recorder._TIMES", flush_s=-1.0)
    )
    folder = _folder(flight, tmp_path / "out", Config(), save_observations=True)
    with _live(flight, folder, Config()) as odometry:
        _feed(odometry, flight)
        odometry._worker.ask(lambda: None)
        folder._calls.join()
        shutil.copytree(tmp_path / "out", tmp_path / "killed")
    folder.close()
    return tmp_path / "killed"


def test_a_killed_run_has_its_poses_and_is_finished_by_resume(
    killed: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    caplog: pytest.LogCaptureFixture,
) -> None:
    poses = read_trajectory(killed / "trajectory.tum")
    assert poses.body == "imu"
    assert len(poses) in (FRAMES - 1, FRAMES)
    with (killed / "frames.csv").open() as stream:
        assert len(list(csv.DictReader(stream))) == len(poses)
    assert not json.loads((killed / "metrics.json").read_text())["complete"]
    assert "vio run --resume" in refused(capsys, "report", killed)
    assert main(["run", "--resume", str(killed)]) == 0
    assert "a live run cannot go on" in caplog.text
    whole = read_finished_run(tmp_path / "out")
    run = read_finished_run(killed)
    n = len(run.trajectory)
    assert n == len(poses)
    assert run.estimates.tobytes() == whole.estimates[:n].tobytes()
    assert run.metrics["stopped"] == "the program was ended"
    assert (killed / "observations.npz").is_file()
    assert main(["report", str(killed)]) == 0


def test_a_run_killed_before_its_first_checkpoint_says_what_is_known(
    killed: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (killed / "unfinished" / "checkpoint").unlink()
    error = refused(capsys, "run", "--resume", killed)
    assert "trajectory.tum and frames.csv are all that is known" in error.splitlines()[-1]


def test_a_disk_that_fails_ends_the_writing_alone(
    flight: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
) -> None:
    def full(*_: Any) -> None:
        raise DataError("cannot write: no space left on device")

    monkeypatch.setattr("vio.runs.recorder.RunRecorder.frame", full)
    folder = _folder(flight, tmp_path / "out", Config())
    with _live(flight, folder, Config()) as odometry:
        _feed(odometry, flight)
    assert odometry.figures.results == FRAMES
    with pytest.raises(DataError, match="no space left"):
        folder.close()
    assert caplog.text.count("the odometry goes on") == 1


def test_a_disk_that_stalls_does_not_stall_the_odometry(
    flight: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("vio.runs.live_folder._MAX_WAITING", 4)
    monkeypatch.setattr("vio.runs.recorder.RunRecorder.frame", lambda *_: time.sleep(0.3))
    settings = LiveRunSettings(tmp_path / "out", "camera")
    folder = LiveFolder(settings, Config(), load_rig(flight))
    with _live(flight, folder, Config()) as odometry:
        _feed(odometry, flight)
    assert odometry.figures.results == FRAMES
    with pytest.raises(DataError, match="the disk is too slow"):
        folder.close()


def test_a_failed_odometry_leaves_its_results(flight: Path, tmp_path: Path) -> None:
    folder = _folder(flight, tmp_path / "out", Config())
    seen: list[Any] = []

    def fail(result: Any) -> None:
        seen.append(result)
        if len(seen) == 9:
            raise RuntimeError("a callback of the robot")

    odometry = LiveOdometry(load_rig(flight), Config(), drop="block", sink=folder, on_frame=fail)

    def run_to_the_failure() -> None:
        with odometry:
            _feed(odometry, flight)

    with pytest.raises(RuntimeError, match="of the robot"):
        run_to_the_failure()
    folder.close()
    run = read_finished_run(tmp_path / "out")
    assert len(run.trajectory) == 9
    assert run.metrics["stopped"] == "a callback of the robot"


def test_times_of_frames_that_are_not_known_lie_between_the_others() -> None:
    ns = 1_700_000_000_123_456_789
    known = {0: ns, 1: ns + 50_000_001, 4: ns + 200_000_003, 9: ns + 10**9}
    times_ns = _times_ns(known, 4)
    assert times_ns.tolist()[:2] == [ns, ns + 50_000_001]
    assert times_ns.tolist()[4] == ns + 200_000_003
    assert (np.diff(times_ns) > 0).all()


def test_findings_of_the_live_run_are_kept(
    flight: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = _folder(flight, tmp_path / "out", Config())
    with _live(flight, folder, Config()) as odometry:
        odometry._odometry._processor.pipeline.monitor.say("said by a test", "frames-unread")
        _feed(odometry, flight)
    folder.close()
    findings: list[Finding] = list(odometry.findings)
    kept = read_finished_run(tmp_path / "out").metrics["findings"]
    assert kept == [finding.to_json() for finding in findings]
    assert kept


def test_frames_given_before_a_reset_have_their_times_in_the_trajectory_after_it() -> None:
    """Frames that wait in the queue at a reset are those of the next trajectory."""
    folder = MagicMock()
    folder._recent = deque(maxlen=0)
    folder._trajectory.times_ns = {}
    log = SimpleNamespace(index=7, time_ns=123)
    frame = SimpleNamespace(left=None, right=None, depth=None)
    with patch("vio.runs.live_folder.replace", lambda record, **_: record):
        LiveFolder.frame(folder, cast(Any, SimpleNamespace(log=log, frame=frame)), MagicMock())
    assert _times_ns(folder._trajectory.times_ns, 7)[7] == 123
