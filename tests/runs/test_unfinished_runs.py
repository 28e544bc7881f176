"""Nothing computed is lost: runs that are interrupted, killed, out of disk, or diverge, and how
they go on.
"""

from __future__ import annotations

import errno
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import threading
import tracemalloc
import zlib
from collections import deque
from collections.abc import Callable
from dataclasses import fields, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.commands import refused, wait_for
from tests.filters.test_msckf import CAMERA, STEP_NS, T_CAM0_IMU, Flight
from tests.replaced_rules import replaced
from tests.runs.test_pipeline import FakeDrive
from vio.cli import main
from vio.config import Config, load_config
from vio.datasets import DatasetSettings, open_dataset
from vio.datasets.observation_log import write_observation_log
from vio.errors import DataError, EstimationError
from vio.files.tables import KeptRows, Table
from vio.files.trajectories import read_trajectory
from vio.filters.msckf import Msckf
from vio.findings import begun
from vio.geometry.lie import se3_exp
from vio.geometry.stereo import StereoCamera
from vio.monitor.integrity import IntegrityMonitor, Mark
from vio.protocols import Dataset
from vio.records import (
    NS_PER_S,
    Estimate,
    Recording,
    StereoFieldEstimate,
    StereoScaleEstimate,
)
from vio.runs.checkpoint import NotSavableError, load_checkpoint, save_checkpoint
from vio.runs.folder import growing_folder
from vio.runs.pipeline import RunControl, RunResult, run
from vio.runs.recorder import GrowingFolder, RunRecorder
from vio.runs.stated import RunRequest
from vio.runs.tables import ESTIMATE, FRAME, estimate_of, estimate_row
from vio.sim.effects import CLEAN
from vio.sim.imu import ImuNoise
from vio.sim.motion import hand_held
from vio.sim.rigs import small_rig
from vio.sim.sequence import SimulatedRecording, simulate
from vio.sim.world import room

FRAMES = 60
ROW = np.dtype([("a", "<i8"), ("b", "<f8", (2,))])


# Tables


def _rows(*values: int) -> np.ndarray:
    rows = np.zeros(len(values), dtype=ROW)
    rows["a"] = values
    return rows


def test_a_table_in_a_file_can_be_read_by_others_after_each_flush(tmp_path: Path) -> None:
    table = Table(ROW, tmp_path / "t.npy")
    for k in range(5):
        table.append(_rows(k, k))
        table.flush()
        np.testing.assert_array_equal(
            np.load(tmp_path / "t.npy")["a"], np.repeat(np.arange(k + 1), 2)
        )
    table.replace(3, _rows(77))
    table.append(_rows(9))
    assert table.rows()["a"].tolist() == [0, 0, 1, 77, 2, 2, 3, 3, 4, 4, 9]
    assert len(np.load(tmp_path / "t.npy")) == 10, "not flushed"
    table.close()


def test_a_table_goes_on_where_it_was_cut(tmp_path: Path) -> None:
    table = Table(ROW, tmp_path / "t.npy")
    table.append(_rows(*range(10)))
    table.flush()
    table.append(_rows(99))  # and the process dies
    table._file.close()  # type: ignore[union-attr]
    again = Table(ROW, tmp_path / "t.npy", keep=7)
    again.append(_rows(50))
    again.close()
    assert again.rows()["a"].tolist() == [*range(7), 50]
    with pytest.raises(DataError, match="fewer than 9"):
        Table(ROW, tmp_path / "t.npy", keep=9)


def test_a_table_in_memory_is_the_same() -> None:
    table = Table(ROW)
    for k in range(200):
        table.append(_rows(k))
    table.replace(3, _rows(77))
    assert table.rows(2, 5)["a"].tolist() == [2, 77, 4]
    assert len(table) == 200


# To the bit


class Stop:
    """Asks to stop after a number of frames."""

    def __init__(self, after: int) -> None:
        self.left = after

    def __call__(self) -> str | None:
        self.left -= 1
        return "interrupted" if self.left <= 0 else None


def _flight_log(
    path: Path, frames: int = FRAMES, imu_from_ns: int = 0, camera: StereoCamera = CAMERA
) -> Path:
    """An observation log of a flight with an IMU, which may begin late."""
    flight, noise = Flight(frames=frames), np.random.default_rng(0)
    times = np.arange(frames, dtype=np.int64) * STEP_NS
    recording = Recording(
        "flight", Path("flight"), camera, T_CAM0_IMU, times, False, frozenset({"imu"}), None
    )
    samples = [s for s in flight.imu(noise, np.zeros(6)) if s.time_ns >= imu_from_ns]
    seen = [flight.observe(k, 0.3, noise) for k in range(frames)]
    write_observation_log(path, recording, seen, samples, run_motion="imu")  # type: ignore[arg-type]
    return path


@pytest.fixture(scope="module")
def flight_log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return _flight_log(tmp_path_factory.mktemp("log") / "flight.npz")


@lru_cache(maxsize=1)
def _rendered() -> SimulatedRecording:
    """A flight whose images are rendered once, however often it is read."""
    motion = hand_held(duration_s=2.0)
    recording = SimulatedRecording(
        simulate(
            room(seed=1),
            small_rig(320, 200),
            motion,
            rate_hz=10.0,
            imu=ImuNoise(),
            effects=CLEAN,
            seed=1,
        )
    )
    recording.images = lru_cache(recording.images)  # type: ignore[method-assign]
    return recording


def _assert_same(a: RunResult, b: RunResult) -> None:
    for name in ("index", "time_ns", "T_world_imu", "covariance", "velocity_world", "gyro_bias"):
        np.testing.assert_array_equal(a.estimates.column(name), b.estimates.column(name))
    order = np.argsort(a.landmarks.ids), np.argsort(b.landmarks.ids)
    for name in ("ids", "p_world", "covariance"):
        np.testing.assert_array_equal(
            *(getattr(r.landmarks, name)[k] for r, k in zip((a, b), order, strict=True))
        )
    if a.dead_reckoning is not None:
        np.testing.assert_array_equal(a.dead_reckoning.T_world_body, b.dead_reckoning.T_world_body)
    assert a.warnings == b.warnings


@pytest.mark.parametrize(
    ("make", "config", "frames"),
    [
        (lambda log: open_dataset(log), Config(), 10),
        (lambda log: open_dataset(log), replace(Config(), lag_frames=4), 20),
        (
            lambda log: open_dataset(log),
            replace(Config(), dataset=DatasetSettings(max_frame_rate=10.0)),
            20,
        ),
        (lambda log: FakeDrive(), Config(), 14),
        (lambda log: _rendered(), Config(), 8),
        (lambda log: _rendered(), load_config(overrides=["frontend.readout_ms=20"]), 8),
    ],
    ids=["features and imu", "lag", "frame rate", "velocities", "images", "rolling shutter"],
)
def test_a_run_goes_on_to_the_same_bits(
    flight_log: Path, tmp_path: Path, make: Callable[[Path], Dataset], config: Config, frames: int
) -> None:
    whole = run(make(flight_log), config, keep_observations=True)
    folder = GrowingFolder(tmp_path / "run", {})
    first = run(
        make(flight_log),
        config,
        keep_observations=True,
        control=RunControl(folder, should_stop=Stop(frames)),
    )
    assert first.stopped == "interrupted"
    assert 5 < len(first.frames) < len(whole.frames)
    second = run(
        make(flight_log), config, keep_observations=True, control=RunControl(folder, resume=True)
    )
    assert second.stopped is None
    _assert_same(whole, second)
    for a, b in zip(whole.observations, second.observations, strict=True):
        assert a.frame_index == b.frame_index
        np.testing.assert_array_equal(a.z, b.z)
    assert [s.time_ns for s in whole.motion_samples] == [s.time_ns for s in second.motion_samples]


@pytest.mark.parametrize("name", ["orb", "sift"])
def test_a_run_with_opencv_s_features_goes_on_to_the_same_bits(name: str, tmp_path: Path) -> None:
    """OpenCV's extractors have no state that can be saved: they are built again."""
    config = replace(Config(), frontend=replace(Config().frontend, name=name))
    whole = run(_rendered(), config, keep_observations=True)
    folder = GrowingFolder(tmp_path / "run", {})
    stop = RunControl(folder, should_stop=Stop(7))
    first = run(_rendered(), config, keep_observations=True, control=stop)
    assert 5 < len(first.frames) < len(whole.frames)
    go_on = RunControl(folder, resume=True)
    second = run(_rendered(), config, keep_observations=True, control=go_on)
    _assert_same(whole, second)
    for a, b in zip(whole.observations, second.observations, strict=True):
        np.testing.assert_array_equal(a.z, b.z)


def test_points_put_away_while_running_stay_in_the_map(
    flight_log: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(
        "vio.runs.recorder._TIMES", replaced("vio.runs.recorder._TIMES", checkpoint_s=0.05)
    )
    whole = run(open_dataset(flight_log), Config())
    grown = run(
        open_dataset(flight_log), Config(), control=RunControl(GrowingFolder(tmp_path / "run", {}))
    )
    assert len(grown.landmarks.ids) > 50
    _assert_same(whole, grown)


@pytest.mark.parametrize("imu_from_s", [1, 100])
def test_a_checkpoint_does_not_wait_for_an_imu_that_begins_late(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, imu_from_s: int
) -> None:
    """The points put away are those of one world: that of the first frame, which knows no
    gravity.
    """
    monkeypatch.setattr(
        "vio.runs.recorder._TIMES", replaced("vio.runs.recorder._TIMES", checkpoint_s=0.05)
    )
    log = _flight_log(tmp_path / "late.npz", imu_from_ns=imu_from_s * 10**9)
    whole = run(open_dataset(log), Config())
    grown = run(
        open_dataset(log), Config(), control=RunControl(GrowingFolder(tmp_path / "run", {}))
    )
    assert grown.stopped is None
    assert len(grown.landmarks.ids) > 50
    _assert_same(whole, grown)


def test_a_run_in_memory_that_is_stopped_keeps_its_map(flight_log: Path) -> None:
    stopped = run(open_dataset(flight_log), Config(), control=RunControl(should_stop=Stop(19)))
    same = run(open_dataset(flight_log), Config(), stop=len(stopped.frames))
    np.testing.assert_array_equal(stopped.landmarks.ids, same.landmarks.ids)


def test_an_estimate_comes_back_from_its_row_with_all_that_it_holds() -> None:
    rng = np.random.default_rng(0)
    shapes = {
        "T_world_imu": (4, 4),
        "covariance": (6, 6),
        "T_cam0_imu": (4, 4),
        "T_cam0_imu_covariance": (6, 6),
    }
    shapes |= {"velocity_covariance": (3, 3), "imu_terms": (15,), "imu_terms_sigma": (15,)}
    # those have a table of their own
    apart = ("integrity", "findings")
    kept = [
        f.name for f in fields(Estimate) if not f.name.startswith("T_map") and f.name not in apart
    ]
    values: dict[str, Any] = {name: rng.normal(size=shapes.get(name, (3,))) for name in kept}
    rows, rows_P = rng.normal(size=7), rng.normal(size=(7, 7))
    field = StereoFieldEstimate(rng.normal(size=8), rng.normal(size=(8, 8)), 0.3, rows, rows_P)
    scale = StereoScaleEstimate(rng.normal(size=2), rng.normal(size=(2, 2)))
    values |= {
        "time_ns": 2**60 + 1,
        "time_offset_s": 0.1,
        "time_offset_sigma_s": 0.2,
        "scale_sigma": 0.02,
    }
    values |= {
        "integrity": "degraded",
        "tilt_sigma_rad": 0.01,
        "position_doubt_m": 0.3,
        "stereo_field": field,
        "stereo_scale": scale,
    }
    back = estimate_of(estimate_row(0, Estimate(**values))[0])
    for name, value in values.items():
        if name not in ("stereo_field", "stereo_scale"):
            np.testing.assert_array_equal(getattr(back, name), value)
    for given, read in ((field, back.stereo_field), (scale, back.stereo_scale)):
        for part in fields(given):
            np.testing.assert_array_equal(getattr(read, part.name), getattr(given, part.name))
    bare = estimate_of(estimate_row(0, Estimate(0, np.eye(4), np.eye(6)))[0])
    assert [f.name for f in fields(Estimate) if getattr(bare, f.name) is not None] == [
        *("time_ns", "T_world_imu", "covariance", "integrity", "findings", "position_doubt_m")
    ]


# Processes that end

PATCHED = (  # as is the picture in this process, see tests/conftest.py
    "import sys, vio.runs.recorder as r, vio.runs.picture as p, vio.cli; r._TIMES = "
    "r._TIMES._replace(flush_s=0.0, checkpoint_s=0.1); "
    "p.RunPicture.write = lambda picture, path: path.write_bytes(b'PNG'); "
    "sys.exit(vio.cli.main(sys.argv[1:]))"
)


@pytest.fixture(scope="module")
def undisturbed(flight_log: Path, tmp_path_factory: pytest.TempPathFactory) -> str:
    out = tmp_path_factory.mktemp("whole") / "run"
    assert main(["run", str(flight_log), "--out", str(out)]) == 0
    return (out / "trajectory.tum").read_text()


def _take_interrupts() -> None:
    """Undo what a shell does to its background jobs: they ignore Ctrl-C, and so do their
    children.
    """
    signal.signal(signal.SIGINT, signal.SIG_DFL)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGKILL])
def test_a_process_that_ends_loses_a_second_at_most(
    flight_log: Path, undisturbed: str, tmp_path: Path, number: signal.Signals
) -> None:
    out = tmp_path / "run"
    command = [sys.executable, "-c", PATCHED, "run", str(flight_log), "--out", str(out)]
    with subprocess.Popen(
        command,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        preexec_fn=_take_interrupts,
    ) as process:
        wait_for((out / "unfinished" / "checkpoint").is_file)
        process.send_signal(number)
        _, error = process.communicate(timeout=120)
    metrics = json.loads((out / "metrics.json").read_text())
    assert metrics["complete"] is False
    poses = read_trajectory(out / "trajectory.tum")
    assert 0 < len(poses) < FRAMES
    assert np.load(out / "unfinished" / "estimates.npy")["time_ns"][0] == 0
    if number != signal.SIGKILL:
        assert process.returncode == 128 + number
        assert f"the results of {len(poses)} of {FRAMES} frames are in {out}" in error
        assert f"vio run --resume {out}" in error
        assert (out / "trajectory.png").is_file()
    assert main(["run", "--resume", str(out)]) == 0
    assert (out / "trajectory.tum").read_text() == undisturbed
    assert json.loads((out / "metrics.json").read_text())["complete"] is True
    assert not (out / "unfinished").exists()


def test_two_runs_into_one_folder_are_refused(
    flight_log: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "run"
    command = [
        sys.executable,
        "-c",
        PATCHED,
        "run",
        str(flight_log),
        "--stop",
        "20",
        "--out",
        str(out),
    ]
    with subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL) as first:
        wait_for((out / "unfinished" / "run.json").is_file)
        first.send_signal(signal.SIGSTOP)
        try:
            for again in (
                ["run", str(flight_log), "--out", str(out)],
                ["run", "--resume", str(out)],
            ):
                assert "another process is writing into this folder" in refused(capsys, *again)
        finally:
            first.send_signal(signal.SIGCONT)
        assert first.wait(timeout=120) == 0
    assert len(read_trajectory(out / "trajectory.tum")) == 20


def test_an_earlier_run_stays_until_the_new_one_has_a_frame(
    flight_log: Path, tmp_path: Path
) -> None:
    out = tmp_path / "run"
    assert main(["run", str(flight_log), "--stop", "20", "--out", str(out)]) == 0
    assert main(["run", str(flight_log), "--start", "900", "--out", str(out)]) == 1
    assert len(read_trajectory(out / "trajectory.tum")) == 20
    assert main(["run", str(flight_log), "--stop", "10", "--out", str(out)]) == 0
    assert len(read_trajectory(out / "trajectory.tum")) == 10


def test_a_divergence_keeps_the_results_so_far(
    flight_log: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    update = Msckf.update

    def diverge(self: Msckf, seen: Any) -> Any:
        if seen.frame_index == 30:
            raise EstimationError("msckf diverged at frame 30")
        return update(self, seen)

    monkeypatch.setattr(Msckf, "update", diverge)
    monkeypatch.setattr(Msckf, "restart", None, raising=False)
    out = tmp_path / "run"
    assert main(["run", str(flight_log), "--out", str(out)]) == 1
    assert (
        f"msckf diverged at frame 30; the results of 30 of {FRAMES} frames are in {out}"
        in capsys.readouterr().err
    )
    metrics = json.loads((out / "metrics.json").read_text())
    assert metrics["stopped"] == "msckf diverged at frame 30"
    assert len(read_trajectory(out / "trajectory.tum")) == 30


def test_a_disk_that_fills_keeps_what_is_written(
    flight_log: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setattr(
        "vio.runs.recorder._TIMES", replaced("vio.runs.recorder._TIMES", flush_s=0.0)
    )
    append, room_left = Table.append, iter(range(100))

    def limited(self: Table, rows: Any) -> None:
        if next(room_left, None) is None:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        append(self, rows)

    monkeypatch.setattr(Table, "append", limited)
    out = tmp_path / "run"
    assert "No space left" in refused(capsys, "run", flight_log, "--out", out)
    assert len(read_trajectory(out / "trajectory.tum")) > 30


# What lies in the folder when a run goes on


@pytest.fixture(scope="module")
def interrupted(flight_log: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """A place with a recording and the folder of its run that was interrupted, and a copy of the
    place.
    """
    place, kept = (
        tmp_path_factory.mktemp("interrupted") / "place",
        tmp_path_factory.mktemp("kept") / "place",
    )
    place.mkdir()
    shutil.copy(flight_log, place / "flight.npz")
    dataset, config = open_dataset(place / "flight.npz"), Config()
    request = RunRequest(
        source=f"log:{place / 'flight.npz'}",
        reference=None,
        start=0,
        stop=None,
        lengths_m=None,
        save_observations=True,
    )
    folder = growing_folder(place / "run", dataset, config, request.values())
    run(dataset, config, keep_observations=True, control=RunControl(folder, should_stop=Stop(10)))
    shutil.copytree(place, kept)
    return place, kept


@pytest.fixture
def stopped(interrupted: tuple[Path, Path]) -> Path:
    """The folder of a run that was interrupted, with a recording of its own; each test gets it
    as it was.
    """
    place, kept = interrupted
    shutil.rmtree(place)
    shutil.copytree(kept, place)
    return place / "run"


def test_settings_that_name_files_are_kept_in_a_checkpoint(
    flight_log: Path, tmp_path: Path
) -> None:
    """A run with one of them ended at its first checkpoint, after some seconds."""
    dataset = open_dataset(flight_log)
    config = replace(Config(), frontend=replace(Config().frontend, features=flight_log))
    inputs = growing_folder(tmp_path / "run", dataset, config, {"source": "", "start": 0}).inputs
    save_checkpoint(tmp_path / "checkpoint", {"count": 1}, dataset, inputs)
    assert load_checkpoint(tmp_path / "checkpoint", dataset, inputs) == {"count": 1}


def _refused(folder: Path, capsys: pytest.CaptureFixture[str], pattern: str) -> None:
    """Go on with a run, which must be refused in one line and leave its tables as they are."""
    held = {path: path.read_bytes() for path in folder.rglob("*.npy")}
    error = refused(capsys, "run", "--resume", folder, "--quiet")
    assert re.search(pattern, error), error
    assert {path: path.read_bytes() for path in folder.rglob("*.npy")} == held


def _flip(path: Path, place: int = -200) -> None:
    data = bytearray(path.read_bytes())
    data[place] ^= 1
    path.write_bytes(data)


@pytest.mark.parametrize("name", ["estimates", "frames", "observations", "seen", "samples"])
@pytest.mark.parametrize(
    "spoil",
    [lambda p: p.write_bytes(p.read_bytes()[: p.stat().st_size // 2]), _flip, Path.unlink],
    ids=["halved", "flipped", "gone"],
)
def test_a_damaged_table_is_not_gone_on_with(
    name: str, spoil: Callable[[Path], Any], stopped: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    spoil(stopped / "unfinished" / f"{name}.npy")
    _refused(
        stopped, capsys, rf"{name}\.npy: .*(is damaged|No such file).*repeat the run from its start"
    )


@pytest.mark.parametrize(
    ("name", "before", "after", "pattern"),
    [
        ("config.yaml", "clones: 11", "clones: 12", r"msckf\.clones was 11, now 12"),
        ("unfinished/run.json", '"stop": null', '"stop": 50', "stop was None, now 50"),
    ],
)
def test_a_run_whose_settings_were_edited_names_them(
    name: str,
    before: str,
    after: str,
    pattern: str,
    stopped: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    text = (stopped / name).read_text()
    assert before in text
    (stopped / name).write_text(text.replace(before, after))
    _refused(stopped, capsys, f"what the run depends on has changed.*{pattern}")


def test_a_run_whose_recording_was_edited_names_what(
    stopped: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    _flight_log(stopped.parent / "flight.npz", frames=FRAMES - 1)
    _refused(stopped, capsys, f"number of frames was {FRAMES}, now {FRAMES - 1}")
    _flight_log(stopped.parent / "flight.npz", camera=replace(CAMERA, fu=CAMERA.fu + 1))
    _refused(stopped, capsys, rf"camera\.fu was {CAMERA.fu}, now {CAMERA.fu + 1}")


def test_a_run_that_dies_after_its_checkpoint_goes_on_with_estimates_that_were_smoothed_since(
    flight_log: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    config, folder = replace(Config(), lag_frames=4), GrowingFolder(tmp_path / "run", {})
    whole = run(open_dataset(flight_log), config)
    gravity = whole.estimates.column("gravity_world")[-4:]
    # as known at the end, as are the poses
    np.testing.assert_array_equal(gravity, gravity[-1:].repeat(4, axis=0))
    assert np.isfinite(gravity).all()
    stop = Stop(15)

    def died() -> str | None:
        if stop.left == 6:
            monkeypatch.setattr(
                "vio.runs.recorder._TIMES", replaced("vio.runs.recorder._TIMES", checkpoint_s=0.0)
            )
        if stop.left == 5:
            monkeypatch.setattr(
                "vio.runs.recorder._TIMES", replaced("vio.runs.recorder._TIMES", checkpoint_s=1e9)
            )
        if stop() is not None:
            raise RuntimeError("died")
        return None

    with pytest.raises(RuntimeError, match="died"):
        run(open_dataset(flight_log), config, control=RunControl(folder, should_stop=died))
    _assert_same(
        whole, run(open_dataset(flight_log), config, control=RunControl(folder, resume=True))
    )


def test_a_run_that_dies_while_it_marks_earlier_frames_goes_on_from_its_checkpoint(
    flight_log: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Rows that the checkpoint rests on are replaced in their file before there is another."""
    mark = RunRecorder.mark
    dies = False

    def marking(self: RunRecorder, marks: Any) -> None:
        at = len(self) == 13
        mark(self, (Mark(2, 8, "degraded", "frames-missing"),) if at else marks)
        if at and dies:
            raise RuntimeError("died")

    monkeypatch.setattr(RunRecorder, "mark", marking)
    monkeypatch.setattr(
        "vio.runs.recorder._TIMES", replaced("vio.runs.recorder._TIMES", checkpoint_s=0.0)
    )
    folder = GrowingFolder(tmp_path / "run", {})
    whole = run(open_dataset(flight_log), Config())
    assert whole.estimates.column("integrity")[:9].tolist() == [0, 0, *[1] * 6, 0]
    dies = True
    with pytest.raises(RuntimeError, match="died"):
        run(open_dataset(flight_log), Config(), control=RunControl(folder))
    dies = False
    again = run(open_dataset(flight_log), Config(), control=RunControl(folder, resume=True))
    _assert_same(whole, again)


@pytest.mark.parametrize("of_checkpoint", [True, False])
def test_rows_of_a_checkpoint_are_put_back(of_checkpoint: bool, tmp_path: Path) -> None:
    table = Table(ROW, tmp_path / "t.npy")
    table.append(_rows(*range(10)))
    kept = KeptRows(tmp_path / "kept.npy", ROW)
    for rows in ([2, 3], [3, 7]):  # the second time, 3 is no longer that of the checkpoint
        kept.keep(table, rows, 123)
        for k in rows:
            table.replace(k, _rows(90))
    table.close()
    checkpoint = 123 if of_checkpoint else 124
    KeptRows(tmp_path / "kept.npy", ROW).take_back(tmp_path / "t.npy", checkpoint)
    held = np.load(tmp_path / "t.npy")["a"].tolist()
    assert held == ([*range(10)] if of_checkpoint else [0, 1, 90, 90, 4, 5, 6, 90, 8, 9])


def test_kept_rows_that_are_damaged_are_named(tmp_path: Path) -> None:
    table = Table(ROW, tmp_path / "t.npy")
    table.append(_rows(*range(4)))
    kept = KeptRows(tmp_path / "kept.npy", ROW)
    kept.keep(table, [3], 5)
    table.close()
    shorter = Table(ROW, tmp_path / "short.npy")
    shorter.append(_rows(0))
    shorter.close()
    with pytest.raises(DataError, match=r"kept\.npy: is damaged \(it has rows that the table"):
        KeptRows(tmp_path / "kept.npy", ROW).take_back(tmp_path / "short.npy", 5)
    (tmp_path / "kept.npy").write_bytes(b"x")
    with pytest.raises(DataError, match=r"kept\.npy: is damaged"):
        KeptRows(tmp_path / "kept.npy", ROW).take_back(tmp_path / "t.npy", 5)


@pytest.mark.parametrize("kind", ["symbolic", "hard"])
@pytest.mark.parametrize(
    "name", ["trajectory.tum", "frames.csv", "unfinished/estimates.npy", "unfinished"]
)
def test_links_in_a_run_folder_are_not_followed(
    name: str, kind: str, stopped: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path, foreign = stopped / name, stopped.parent / "foreign"
    path.rename(foreign)
    if kind == "symbolic" or foreign.is_dir():
        path.symlink_to(foreign)
    else:
        path.hardlink_to(foreign)
    names = sorted(foreign.rglob("*")) if foreign.is_dir() else [foreign]
    before = [(part, part.read_bytes()) for part in names]
    assert re.search(
        f"{path.name}: is a link", refused(capsys, "run", "--resume", stopped, "--quiet")
    )
    assert [(part, part.read_bytes()) for part in names] == before


# Checkpoints


@pytest.fixture
def state(flight_log: Path, tmp_path: Path) -> tuple[Path, Dataset]:
    dataset = open_dataset(flight_log)
    save_checkpoint(tmp_path / "c", {"a": np.arange(3)}, dataset)
    return tmp_path / "c", dataset


def _forge(path: Path, tree: Any, blobs: bytes = b"") -> None:
    """Put another state into a checkpoint, with the checksum that belongs to it."""
    head = json.loads(path.read_bytes()[8:].split(b"\n")[0])
    text = json.dumps(tree).encode()
    body = json.dumps({**head, "tree_bytes": len(text)}).encode() + b"\n" + text + blobs
    path.write_bytes(b"%08x" % zlib.crc32(body) + body)


@pytest.mark.parametrize(
    "name",
    [
        "subprocess:Popen",
        "vio.frontend.align:np.f2py.subprocess.Popen",
        "vio.frontend.klt:Path",  # another module's
        "vio.live.odometry:Config",  # the same under a second name
        "vio.files.atomic:atomic_write_bytes",
        "vio.errors:DataError",  # of a base that is not ours
        "vio.__main__:main",
        "vio:load_rig",
    ],
)
def test_a_checkpoint_holds_objects_of_our_own_classes_only(
    name: str, state: tuple[Path, Dataset]
) -> None:
    path, dataset = state
    _forge(path, ["dict", "run", ["object", name, {"args": ["list", "touch", "owned"]}]])
    with pytest.raises(DataError, match=r"is damaged \(.*repeat the run from its start"):
        load_checkpoint(path, dataset)


@pytest.mark.parametrize(
    "tree",
    [
        ["array", "|O", [1], "C", 0, True],
        ["array", "<f8", [2**62], "C", 0, True],
        ["array", "<f8", [0], "C", -8, True],
        ["array", "<f8", [1], "C", 2**70, True],
        ["deque", 2**70],
        ["array", "<f8", [-1], "C", 0, True],
        ["generator", "MT19937", {}],
        ["ref", 9],
        ["ref", -1],
        ["tuple", ["ref", 1]],
        ["__class__", "x"],
        ["dict", "a"],
        ["object", "vio.records:ImuSample", {"other": 1}],
        {"a": 1},
        [],
        None,
    ],
    ids=str,
)
def test_a_forged_tree_is_one_line(tree: Any, state: tuple[Path, Dataset]) -> None:
    path, dataset = state
    _forge(path, ["list", tree] if tree is not None else json.loads("[" * 900 + "]" * 900))
    with pytest.raises(
        DataError, match=r"c: is damaged \(.*\); repeat the run from its start"
    ) as error:
        load_checkpoint(path, dataset)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("dtype", ["|O", [["a", "|O"]], [["a", [["b", "|O", [2]]]]]], ids=str)
def test_bytes_of_a_forged_checkpoint_do_not_become_references(
    dtype: Any, state: tuple[Path, Dataset]
) -> None:
    """NumPy takes the bytes of a buffer for addresses of objects where the type says so; zeros
    are None.
    """
    path, dataset = state
    _forge(path, ["list", ["array", dtype, [1], "C", 0, True]], blobs=bytes(16))
    with pytest.raises(DataError, match="is damaged"):
        load_checkpoint(path, dataset)


def test_what_a_checkpoint_holds_comes_back_with_its_types_layouts_and_references(
    state: tuple[Path, Dataset],
) -> None:
    path, dataset = state
    fixed = np.arange(6.0).reshape(2, 3)
    fixed.flags.writeable = False
    shared: list[Any] = [1, 2.5, None, "text", float("nan"), -0.0, 2**70]
    shared.append(shared)
    rows = np.zeros(2, dtype=[("a", "<i8"), ("T", "<f4", (2, 2))])
    generator = np.random.default_rng(3)
    generator.random(5)
    given = {
        "arrays": (
            np.asfortranarray(fixed),
            fixed.T[1:],
            np.zeros((0, 3)),
            rows,
            np.array([True, False]),
            np.float32(2),
        ),
        "shared": (shared, shared, deque([shared], maxlen=3)),
        (1, "key"): {3, 4},
        5: (frozenset((1,)), slice(None, 4, 2), 1 + 2j, b"bytes", True),
        "fixed": fixed,
        "scalar": rows[0],
        "record": Estimate(7, np.eye(4), np.eye(6)),
        "generator": generator,
        "data": (dataset, dataset.observations),
    }
    save_checkpoint(path, given, dataset)
    back = load_checkpoint(path, dataset)
    assert list(back) == list(given)
    for a, b in zip(given["arrays"], back["arrays"], strict=True):
        assert (a.dtype, a.shape, type(a)) == (b.dtype, b.shape, type(b))
        np.testing.assert_array_equal(a, b)
    assert back["arrays"][0].flags.f_contiguous
    assert [a.flags.writeable for a in (back["fixed"], back["arrays"][0])] == [False, True]
    again, twice, (inside,) = back["shared"]
    assert again is twice
    assert again is inside
    assert again is again[-1]
    assert repr(again[:-1]) == repr(shared[:-1])
    assert back["shared"][2].maxlen == 3
    assert (back[1, "key"], back[5]) == (given[1, "key"], given[5])
    assert back["scalar"] == rows[0]
    np.testing.assert_array_equal(back["record"].covariance, np.eye(6))
    assert back["generator"].random() == generator.random()
    assert back["data"] == (dataset, dataset.observations)


@pytest.mark.parametrize(
    "value",
    [Path("x"), print, lambda: 0, np.array([{}]), int, threading.Lock()],
    ids=["path", "function", "lambda", "objects", "class", "lock"],
)
def test_what_a_checkpoint_cannot_hold_is_named_when_it_is_saved(
    value: Any, state: tuple[Path, Dataset]
) -> None:
    with pytest.raises(NotSavableError, match="does not belong into a checkpoint"):
        save_checkpoint(state[0], [value], state[1])


@pytest.mark.parametrize(
    "spoil",
    [
        lambda b: b[:-5],
        lambda b: b"",
        lambda b: b"{}\n" + b.split(b"\n", 1)[1],
        lambda b: b[:-9] + b"\x07" + b[-8:],
    ],
)
def test_a_damaged_or_foreign_checkpoint_is_refused(
    state: tuple[Path, Dataset], spoil: Callable[[bytes], bytes]
) -> None:
    path, dataset = state
    path.write_bytes(spoil(path.read_bytes()))
    with pytest.raises(DataError, match="repeat the run from its start"):
        load_checkpoint(path, dataset)


def test_smoothing_leaves_in_doubt_what_findings_doubt() -> None:
    """Of the frame judged in doubt and of one marked later; smoothed, both were as exact as stated
    by a filter that follows a fault.
    """
    recorder = RunRecorder("imu", lag_frames=2, keep_observations=False)
    recorder._begin()
    own = Estimate(0, np.eye(4), 1e-4 * np.eye(6))
    monitor = IntegrityMonitor()
    for k in range(4):
        if k == 2:
            monitor.take(begun("imu-disagrees", k, "", figures={"doubted_share": 1.0}))
        at = replace(own, time_ns=k * NS_PER_S, T_world_imu=se3_exp([10.0 * k, 0, 0, 0, 0, 0]))
        recorder._tables["estimates"].append(estimate_row(k, monitor.judged(k, at)))
        recorder._tables["frames"].append(np.zeros(1, dtype=FRAME))
    recorder.mark([Mark(2, 3, "degraded", "imu-disagrees", scale=0.1)])
    before = recorder.estimates[2:]
    assert [e.position_doubt_m for e in before] == pytest.approx([2.0, 10.0])
    smoothed = replace(own, covariance=0.25e-4 * np.eye(6))
    recorder.revise(lambda _: smoothed)
    for was, now in zip(before, recorder.estimates[2:], strict=True):
        added = np.diag([was.position_doubt_m**2] * 3 + [0.0] * 3)
        np.testing.assert_allclose(now.covariance, smoothed.covariance + added)
        assert now.integrity == "degraded"


@pytest.mark.parametrize("effect", ["scale", "share"])
def test_marks_of_a_long_run_do_not_copy_it(tmp_path: Path, effect: str) -> None:
    count = 20_000
    recorder = RunRecorder(
        "imu", lag_frames=0, keep_observations=False, folder=GrowingFolder(tmp_path / "out", {})
    )
    recorder._begin()
    rows = np.zeros(count, dtype=ESTIMATE)
    rows["index"] = 10 + np.arange(count)
    rows["time_ns"] = np.arange(count) * 50_000_000
    rows["T_world_imu"] = np.eye(4)
    rows["T_world_imu"][:, 0, 3] = 0.1 * np.arange(count)
    rows["covariance"] = 1e-4 * np.eye(6)
    recorder._tables["estimates"].append(rows)
    frames = np.zeros(count, dtype=FRAME)
    frames["index"] = rows["index"]
    recorder._tables["frames"].append(frames)
    mark = Mark(count - 20, count - 10, "degraded", "imu-disagrees", **{effect: 0.1})
    tracemalloc.start()
    recorder.mark([mark])
    recorder.replace({count: recorder.estimates[count - 10]})
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak < rows.nbytes / 10
    sigma_m = np.sqrt(recorder._tables["estimates"].rows()["covariance"][:, 0, 0])
    for table in recorder._tables.values():
        table.close()
    changed = np.flatnonzero(sigma_m > 0.0101)
    first = count - 30 + (effect == "share")  # where the time since begins
    assert (changed[0], changed[-1]) == (first, count - 21)
    far_m = 0.1 * (count - 21) if effect == "scale" else 0.1 * 9
    assert sigma_m[count - 21] == pytest.approx(np.hypot(0.01, 0.1 * far_m))
