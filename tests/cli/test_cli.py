"""The command line: the contract of its output, and its error messages."""

from __future__ import annotations

import argparse
import json
import os
import re
import shlex
import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.commands import json_of, refused
from tests.dataset_makers import T_CAM0_IMU, ece276a_arrays, make_drive, make_kitti, make_npz
from vio.cli import build_parser, main, waiting
from vio.config import BASIC, Config, describe
from vio.errors import NOTE, DataError
from vio.files.trajectories import read_trajectory, write_tum
from vio.geometry.lie import se3_inverse
from vio.mapping.map_database import APPLICATION_ID, BEGIN
from vio.mavlink.link import open_link

FRAMES = 24
CONTRACT = (
    "out",
    "frames",
    "path_length_m",
    "ms_per_frame",
    "ate_m",
    "rpe",
    "t_err_percent",
    "r_err_deg_per_100m",
)


@pytest.fixture
def recording(tmp_path: Path) -> Path:
    return make_npz(tmp_path / "drive.npz", ece276a_arrays(make_drive(FRAMES)))


@pytest.fixture(scope="module")
def truth(tmp_path_factory: pytest.TempPathFactory) -> Path:
    cam0 = make_drive(FRAMES).T_world_imu @ se3_inverse(T_CAM0_IMU)
    path = tmp_path_factory.mktemp("truth") / "truth.txt"
    np.savetxt(path, (se3_inverse(cam0[0]) @ cam0)[:, :3].reshape(-1, 12))
    return path


@pytest.fixture(scope="module")
def finished(truth: Path, tmp_path_factory: pytest.TempPathFactory) -> str:
    """The folder of a run with its observations, compared with the truth; tests only read it."""
    folder = tmp_path_factory.mktemp("finished")
    recording, out = (
        make_npz(folder / "drive.npz", ece276a_arrays(make_drive(FRAMES))),
        str(folder / "out"),
    )
    assert (
        main(
            [
                "run",
                str(recording),
                "--save-observations",
                "--reference",
                str(truth),
                "--out",
                out,
                "--quiet",
            ]
        )
        == 0
    )
    return out


def test_run_prints_the_contract(
    recording: Path, truth: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    metrics = json_of(capsys, "run", recording, "--out", tmp_path / "out", "--reference", truth)
    assert set(CONTRACT) <= set(metrics)
    assert metrics["frames"] == FRAMES
    assert metrics["ate_m"] < 0.05
    assert metrics["rpe"]["trans_rmse_m"] < 0.05
    assert metrics["drift_lengths_m"] == [10]  # a drive of 14 m has no segment of 100 m
    assert 0 < metrics["t_err_percent"] < 5
    assert metrics["motion"] == "velocity"
    assert Path(metrics["out"], "trajectory.png").is_file()


def test_run_without_reference_prints_null(
    recording: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    metrics = json_of(capsys, "run", recording, "--out", tmp_path / "out", "--motion", "none")
    assert [metrics[key] for key in ("ate_m", "rpe", "t_err_percent", "r_err_deg_per_100m")] == [
        None
    ] * 4
    assert metrics["motion"] == "none"
    assert metrics["path_length_m"] > 10


def test_reference_of_cam0_is_compared_with_the_lever_arm(
    finished: str, truth: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The filter estimates the IMU, a KITTI reference describes cam0, a metre away: rotation
    would show it.
    """
    metrics = json.loads(Path(finished, "metrics.json").read_text())
    assert metrics["evaluation"]["body"] == "cam0"
    assert metrics["evaluation"]["ate_deg"] < 0.5
    same = json_of(capsys, "eval", finished, truth)
    assert same["ate_m"] == pytest.approx(metrics["ate_m"], rel=1e-6)
    plain = json_of(capsys, "eval", f"{finished}/trajectory.kitti", truth)
    assert plain["ate_m"] == pytest.approx(metrics["ate_m"], rel=1e-4)


def test_a_range_of_frames_is_compared_with_its_own_reference(
    recording: Path, truth: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    args = ("run", str(recording), "--reference", str(truth), "--out", str(tmp_path / "out"))
    metrics = json_of(capsys, *args, "--start", "6", "--stop", "22", "--save-observations")
    assert metrics["frames"] == 16
    assert (metrics["first_frame"], metrics["last_frame"]) == (6, 21)
    assert metrics["ate_m"] < 0.05
    replayed = json_of(
        capsys, "run", tmp_path / "out" / "observations.npz", "--out", tmp_path / "replayed"
    )
    assert replayed["frames"] == 16
    assert not [line for line in replayed["warnings"] if "could not be read" in line]


def test_slow_frames_count_as_compiling_only_where_loops_were_compiled(
    recording: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("vio.runs.folder._SLOW", 1.0)
    for compiled in (True, False):
        monkeypatch.setattr("vio.runs.folder.has_compiled", lambda compiled=compiled: compiled)
        assert (
            json_of(capsys, "run", recording, "--out", tmp_path / "out")["start_s"] > 0
        ) == compiled


def test_a_shorter_reference_evaluates_the_frames_it_covers(
    recording: Path, truth: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    short = tmp_path / "short.txt"
    short.write_text("".join(truth.read_text().splitlines(keepends=True)[:15]))
    metrics = json_of(capsys, "run", recording, "--reference", short, "--out", tmp_path / "out")
    assert metrics["evaluation"]["matched"] == 15


def test_saved_observations_replay_bit_identically(
    finished: str, recording: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    first, second, third = Path(finished), tmp_path / "second", tmp_path / "third"
    json_of(capsys, "run", first / "observations.npz", "--out", second)
    assert (first / "trajectory.tum").read_bytes() == (second / "trajectory.tum").read_bytes()
    json_of(
        capsys,
        *("run", str(recording), "--frontend", "precomputed", "--out", str(third)),
        *("--set", f"frontend.features={first / 'observations.npz'}"),
    )
    assert (first / "trajectory.tum").read_bytes() == (third / "trajectory.tum").read_bytes()


def test_run_and_its_kitti_file_are_compared_in_one_world(
    finished: str, truth: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The run describes the IMU in a world of its own, poses.txt and trajectory.kitti the first
    cam0.
    """
    kitti = json_of(capsys, "eval", f"{finished}/trajectory.kitti", truth, "--align", "none")
    first = json_of(capsys, "eval", finished, truth, "--align", "first")
    assert first["ate_m"] == pytest.approx(kitti["ate_m"], abs=1e-6)
    assert main(["eval", finished, str(truth), "--align", "none"]) == 1
    assert (
        "describes imu and the reference cam0, whose world frames differ; take align first"
        in capsys.readouterr().err
    )


def test_a_reference_of_other_lengths_is_noted(
    recording: Path,
    truth: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    caplog: pytest.LogCaptureFixture,
) -> None:
    poses = np.loadtxt(truth)
    poses[:, 3::4] *= 3
    np.savetxt(tmp_path / "other.txt", poses)
    out = str(tmp_path / "out")
    metrics = json_of(capsys, "run", recording, "--reference", tmp_path / "other.txt", "--out", out)
    assert "its lengths have no scale" in metrics["evaluation"]["notes"][0]
    json_of(capsys, "eval", out, tmp_path / "other.txt")
    assert caplog.text.count("scaled by 3") == 2


def test_log_replays_the_motion_of_its_run(
    recording: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A log holds the velocities even of a run on images alone."""
    first, again, other = (tmp_path / name for name in ("first", "again", "other"))
    json_of(capsys, "run", recording, "--motion", "none", "--save-observations", "--out", first)
    log = str(first / "observations.npz")
    assert json_of(capsys, "run", log, "--out", again)["motion"] == "none"
    assert (first / "trajectory.tum").read_bytes() == (again / "trajectory.tum").read_bytes()
    assert (
        json_of(capsys, "run", log, "--motion", "velocity", "--out", other)["motion"] == "velocity"
    )


def test_log_of_unknown_motion_takes_its_sensor_and_says_so(
    recording: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    caplog: pytest.LogCaptureFixture,
) -> None:
    """As logs of version 1 are."""
    json_of(
        capsys,
        "run",
        recording,
        "--motion",
        "none",
        "--save-observations",
        "--out",
        tmp_path / "first",
    )
    arrays = dict(np.load(tmp_path / "first" / "observations.npz"))
    del arrays["run_motion"]
    np.savez(tmp_path / "old.npz", **(arrays | {"version": np.array(1)}))
    assert (
        json_of(capsys, "run", tmp_path / "old.npz", "--out", tmp_path / "again")["motion"]
        == "velocity"
    )
    assert (
        caplog.text.count(
            "the log does not say which motion its run used; motion auto takes its velocity"
        )
        == 1
    )


def test_effective_configuration_reproduces_the_run(
    recording: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    first, second = tmp_path / "first", tmp_path / "second"
    json_of(
        capsys,
        "run",
        recording,
        "--set",
        "selector.name=visibility",
        "--motion",
        "none",
        "--out",
        first,
    )
    json_of(capsys, "run", recording, "--config", first / "config.yaml", "--out", second)
    assert (first / "trajectory.tum").read_bytes() == (second / "trajectory.tum").read_bytes()


def test_runs_without_out_are_numbered(
    recording: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    outs = [json_of(capsys, "run", recording)["out"] for _ in range(2)]
    assert outs == [str(Path("runs/drive")), str(Path("runs/drive-2"))]


def test_replaces_an_earlier_run_but_no_other_files(
    recording: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    run = ["run", str(recording), "--out", str(out)]
    assert main(run) == main(run) == 0
    (out / "notes.md").write_text("what I thought")
    (out / "check").mkdir()
    before = (out / "metrics.json").read_bytes()
    error = refused(capsys, *run)
    assert "holds check, notes.md beside an earlier result" in error
    assert (out / "notes.md").read_text() == "what I thought"
    assert (out / "metrics.json").read_bytes() == before


def test_rejects_features_of_another_recording(
    finished: str, recording: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    arrays = ece276a_arrays(make_drive(9))
    other = make_npz(
        tmp_path / "other.npz", {**arrays, "time_stamps": arrays["time_stamps"] + 77.7}
    )
    features = f"frontend.features={finished}/observations.npz"
    assert main(["run", str(recording), "--set", features, "--out", str(tmp_path / "again")]) == 0
    assert main(["run", str(other), "--set", features, "--out", str(tmp_path / "mixed")]) == 1
    assert "its frames are not those of" in capsys.readouterr().err
    assert not (tmp_path / "mixed").exists()


def test_output_on_a_terminal_without_unicode() -> None:
    env = {
        **os.environ,
        "LC_ALL": "C",
        "PYTHONUTF8": "0",
        "PYTHONCOERCECLOCALE": "0",
        "PYTHONIOENCODING": "ascii",
    }
    for words in (["run", "--help"], ["config", "--show"]):
        done = subprocess.run(
            [sys.executable, "-m", "vio", *words], capture_output=True, env=env, check=False
        )
        assert done.returncode == 0, done.stderr.decode()
        assert done.stderr == b""


@pytest.mark.skipif(sys.platform == "win32", reason="no limit of the address space")
@pytest.mark.parametrize("kib", [400_000, 800_000])
def test_a_limit_of_the_address_space_ends_in_one_line(kib: int, tmp_path: Path) -> None:
    words = f"ulimit -v {kib}; exec '{sys.executable}' -m vio run '{tmp_path}'"
    done = subprocess.run(["bash", "-c", words], capture_output=True, text=True, check=False)
    assert done.returncode == 1
    assert re.fullmatch(r"error: the address space is limited to \d+ MB .*\n", done.stderr)


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="no device that is always full")
def test_reports_unwritable_output_in_one_line() -> None:
    with Path("/dev/full").open("w") as full:
        words = [sys.executable, "-m", "vio", "config", "--show"]
        done = subprocess.run(words, stdout=full, stderr=subprocess.PIPE, check=False, text=True)
    assert done.returncode == 1
    assert done.stderr == "error: cannot write the output: No space left on device\n"


def test_prints_a_table_with_the_path_of_the_plot(
    recording: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["run", str(recording), "--out", str(tmp_path / "out")]) == 0
    out = capsys.readouterr().out
    assert str(tmp_path / "out" / "trajectory.png") in out
    assert "ms a frame" in out


@pytest.mark.parametrize(
    ("argv", "message"),
    [
        (["run", "{tmp}/nothing"], "does not exist"),
        (["run", "{tmp}/empty"], "is empty"),
        (["run", "kity:{rec}"], "did you mean 'kitti'"),
        (["run", "{rec}", "--reference", "{tmp}/none.txt"], "none.txt"),
        (["run", "{rec}", "--config", "{tmp}/none.yaml"], "none.yaml"),
        (["run", "{rec}", "--set", "vislam.pixel_sigma=1"], "did you mean 'vislam.pixel_sigma_px'"),
        (["run", "{rec}", "--motion", "magic"], "motion is one of"),
        (["run", "{rec}", "--backend", "magic"], "backend is one of"),
        (["run", "{rec}", "--frontend", "klt"], "no images"),
        (["run", "{rec}", "--frontend", "magic"], "frontend.name is one of"),
        (["run", "{rec}", "--start", "400"], "past the last frame"),
        (["run", "{rec}", "--start", "5", "--stop", "5"], "no range"),
        (["run", "{rec}", "--start", "-5"], "frames -5 to the last one are no range"),
        (["run", "{rec}", "--set", "vislam.iterations=0"], "at least 1"),
        (["run", "{rec}", "--out", "{tmp}/thesis"], "was not made by this program"),
        (["run", "{rec}", "--out", "{rec}"], "is a file"),
        (["eval", "{tmp}/none.tum", "{tmp}/none.txt"], "none.tum"),
        (["eval", "{tmp}/empty", "{tmp}/none.txt"], "no run folder"),
        (["reproduce", "{tmp}/none.npz"], "does not exist"),
        (["check", "{tmp}/empty", "--keyframes", "1"], "--keyframes at least 2"),
        (["check", "{tmp}/empty", "--threads", "0"], "--threads must be at least 1"),
        (["refine", "{tmp}/empty", "--keyframes", "1"], "--keyframes at least 2"),
        (["refine", "{tmp}/empty", "--threads", "0"], "--threads must be at least 1"),
        (["export", "colmap", "{tmp}/empty", "--keyframes", "1"], "--keyframes must be at least 2"),
    ],
)
def test_errors_are_one_line_and_write_nothing(
    argv: list[str],
    message: str,
    recording: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    (tmp_path / "empty").mkdir()
    (tmp_path / "thesis").mkdir()
    (tmp_path / "thesis" / "chapter.txt").write_text("years of work")
    argv = [part.format(tmp=tmp_path, rec=recording) for part in argv]
    if argv[0] == "run" and "--out" not in argv:
        argv += ["--out", str(tmp_path / "out")]
    before = sorted(tmp_path.rglob("*"))
    assert message in refused(capsys, *argv)
    assert sorted(tmp_path.rglob("*")) == before


@pytest.mark.parametrize("command", [("export", "colmap"), ("mesh",), ("report",)])
def test_a_map_in_the_place_of_a_run_is_called_so(
    command: tuple[str, ...], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "yard.map"
    file.write_bytes(BEGIN.ljust(68, b"\0") + APPLICATION_ID.to_bytes(4, "big"))
    assert "is a map, not a run; give the folder" in refused(capsys, *command, file)


def test_reports_and_skips_truncated_images_up_to_a_limit(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], caplog: pytest.LogCaptureFixture
) -> None:
    folder = make_kitti(tmp_path / "kitti", frames=6)
    image = folder / "image_1" / "000003.png"
    image.write_bytes(image.read_bytes()[:-20])
    run = ("run", str(folder), "--out", str(tmp_path / "out"))
    metrics = json_of(capsys, *run)
    assert metrics["frames"] == 5
    assert "1 of 6 frames could not be read and were skipped: 3" in metrics["warnings"]
    assert "000003.png" in caplog.text
    assert main(["report", str(tmp_path / "out")]) == 0
    assert "5 of 6 frames" in (tmp_path / "out" / "report.html").read_text()
    assert "000003.png" in refused(capsys, *run, "--set", "dataset.max_bad_frames=0")
    assert not waiting._WORK, "a run that failed has closed its bar"


def test_an_interrupt_while_the_picture_is_drawn_costs_the_picture_alone(
    recording: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    caplog: pytest.LogCaptureFixture,
) -> None:
    def stop(*args: object, **kwargs: object) -> None:
        raise KeyboardInterrupt

    out = tmp_path / "deep" / "out"
    monkeypatch.setattr("vio.runs.picture.RunPicture.write", stop)
    assert main(["run", str(recording), "--out", str(out)]) == 0
    assert f"vio report {out} --open" in capsys.readouterr().out
    assert "trajectory.png was not drawn: interrupted" in caplog.text
    assert len(read_trajectory(out / "trajectory.tum")) > 0
    assert not (out / "unfinished").exists()
    assert "is complete" in refused(capsys, "run", "--resume", out)


def test_the_picture_is_drawn_after_the_results_are_printed_or_not_at_all(
    recording: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    printed: list[str] = []
    monkeypatch.setattr(
        "vio.runs.picture.RunPicture.write",
        lambda picture, path: printed.append(capsys.readouterr().out),
    )
    assert main(["run", str(recording), "--out", str(tmp_path / "a")]) == 0
    assert [text.count("results ") for text in printed] == [1]
    assert main(["run", str(recording), "--out", str(tmp_path / "b"), "--no-plot"]) == 0
    assert len(printed) == 1
    assert "plot" not in capsys.readouterr().out


def test_a_report_is_written_and_opened_with_the_run(
    recording: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    opened: list[str] = []
    monkeypatch.setattr("webbrowser.open", lambda uri: opened.append(uri) or True)
    argv = ["run", str(recording), "--out", str(tmp_path / "a"), "--no-plot"]
    assert main([*argv, "--report", "--open"]) == 0
    assert opened == [(tmp_path / "a" / "report.html").resolve().as_uri()]
    last = capsys.readouterr().out.splitlines()[-1]
    assert last.split() == ["report", str(tmp_path / "a" / "report.html")]
    page = (tmp_path / "a" / "report.html").read_text(encoding="utf-8")
    assert f"vio run {recording} --out {tmp_path / 'a'} --no-plot --report --open" in page
    assert "--open shows the page of --report" in refused(capsys, *argv, "--open")


def test_several_trajectories_are_compared_and_drawn(
    recording: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    runs = [str(tmp_path / name) for name in "ab"]
    for out, motion in zip(runs, ("none", "velocity"), strict=True):
        assert (
            main(["run", str(recording), "--out", out, "--motion", motion, "--no-plot", "--quiet"])
            == 0
        )
    capsys.readouterr()
    picture = tmp_path / "eval.png"
    truth = f"{runs[0]}/trajectory.tum"
    assert main(["eval", *runs, truth, "--plot", str(picture)]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert [line.split()[0][-2:] for line in lines[1:3]] == ["/a", "/b"]
    assert all(re.search(r"\d m+ +\d", line) for line in lines[1:3])
    assert picture.stat().st_size > 10_000
    both = json_of(capsys, "eval", *runs, truth)
    alone = [json_of(capsys, "eval", out, truth) for out in runs]
    assert [both[out]["ate_m"] for out in runs] == [one["ate_m"] for one in alone]


def test_debug_raises_the_expectedrefused(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="does not exist"):
        main(["--debug", "run", str(tmp_path / "nothing")])


def test_eval_reads_the_extrinsics_from_a_file(
    finished: str, truth: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A trajectory of the IMU can be compared with one of cam0 only with the extrinsics between
    them.
    """
    files = [f"{finished}/trajectory.tum", str(truth)]
    assert "give the extrinsic T_cam0_imu" in refused(capsys, "eval", *files)
    given = tmp_path / "T_cam0_imu.txt"
    np.savetxt(given, T_CAM0_IMU[:3])
    assert json_of(capsys, "eval", *files, "--extrinsics", given)["ate_m"] < 0.05
    given.unlink()
    assert "give a file with T_cam0_imu, 3 or 4 rows of 4 numbers" in refused(
        capsys, "eval", *files, "--extrinsics", given
    )


def test_an_unknown_option_shows_the_usage_of_its_command(
    capsys: pytest.CaptureFixture[str],
) -> None:
    with pytest.raises(SystemExit) as ended:
        main(["eval", "a", "b", "--alignment", "se3"])
    assert ended.value.code == 2
    message = capsys.readouterr().err
    assert message.startswith("usage: vio eval")
    assert "unrecognized arguments: --alignment" in message


@pytest.mark.parametrize(
    ("argv", "hint"),
    [
        (["run", "a", "results"], "results; if results go there, write --out results"),
        (["run", "a", "--set", "msckf.clones", "5"], "5; write --set msckf.clones=5"),
        (["run", "a", "lag_frames=1"], "lag_frames=1; write --set lag_frames=1\n"),
        (
            ["run", "a", "--set", "lag_frames=1", "motion=none"],
            "motion=none; write --set motion=none\n",
        ),
        (["run", "a", "--set", "b=c", "--set", "lag_frames", "1"], "1; write --set lag_frames=1\n"),
        (["calibrate", "a", "--stop", "5"], "--stop 5\n"),  # no other option is like it
    ],
)
def test_what_is_too_much_is_told_where_it_goes(
    argv: list[str], hint: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit):
        main(argv)
    assert f"unrecognized arguments: {hint}" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ("runs/streeet", "does not exist; did you mean {tmp}/runs/street?"),
        ("runs/other", "does not exist; give a folder that `vio run` wrote"),
        (
            "runs/street/trajectory.tum",
            "is a file of a run; give the folder of the run, {tmp}/runs/street",
        ),
        ("runs", "holds the results of runs; give one of them, such as {tmp}/runs/street"),
        ("images", "no run folder"),
    ],
)
@pytest.mark.parametrize("command", ["check", "report"])
def test_what_is_no_run_is_told_which_run_may_be_meant(
    command: str, given: str, said: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "images").mkdir()
    (tmp_path / "runs" / "street").mkdir(parents=True)
    for name in ("metrics.json", "trajectory.tum"):
        (tmp_path / "runs" / "street" / name).write_text("{}")
    assert main([command, str(tmp_path / given)]) == 1
    assert said.format(tmp=tmp_path) in capsys.readouterr().err


@pytest.mark.parametrize("argv", [["eval", "a", "--gt", "b"], ["inspect", "a", "--loops"]])
def test_a_word_of_another_command_is_not_taken_for_one_spelt_alike(
    argv: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit):
        main(argv)
    message = capsys.readouterr().err
    assert "unrecognized arguments" in message
    assert "did you mean" not in message


@pytest.mark.parametrize(
    ("argv", "hint"),
    [
        (["inspct", "x"], "there is no command 'inspct'; did you mean inspect?"),
        (["compare", "a", "b"], "there is no command 'compare'; did you mean eval?"),
        (["run", "a", "--left", "/cam0"], "did you mean --topics left=/TOPIC?"),
        (["run", "a", "--gt", "b"], "did you mean --reference?"),
        (["zzz"], "there is no command 'zzz'; vio --help lists them"),
        (["run", "x", "--refrence", "y"], "arguments: --refrence y; did you mean --reference?"),
        (["run", "x", "--frontnd=orb"], "arguments: --frontnd=orb; did you mean --frontend?"),
    ],
)
def test_a_misspelt_command_or_option_gets_the_nearest_one(
    argv: list[str], hint: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as ended:
        main(argv)
    assert ended.value.code == 2
    assert hint in capsys.readouterr().err.splitlines()[-1]


def test_where_there_is_no_browser_the_page_to_open_is_named(
    finished: str, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr("webbrowser.open", lambda uri: False)
    with caplog.at_level(NOTE):
        assert main(["report", finished, "--open"]) == 0
    page = (Path(finished) / "report.html").resolve()
    assert f"no browser was found here; open {page} in one" in caplog.messages


def test_a_run_is_compared_with_the_truth_of_its_recording(
    flight: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["run", str(flight), "--quiet", "--json", "--out", str(tmp_path / "run")]) == 0
    ate_m = json.loads(capsys.readouterr().out)["ate_m"]
    assert json_of(capsys, "eval", tmp_path / "run", flight)["ate_m"] == pytest.approx(
        ate_m, rel=1e-6
    )


def test_wrong_usage_exits_with_status_2() -> None:
    for argv in (
        [],
        ["fly"],
        ["run"],
        ["run", "x", "--start", "one"],
        ["run", "x", "--lengths", "a,b"],
        ["run", "x", "--lengths", "25,0"],
        ["eval", "x"],
    ):
        with pytest.raises(SystemExit) as stop:
            main(argv)
        assert stop.value.code == 2


def test_config_shows_every_setting_with_unit_and_default(
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert main(["config", "--all"]) == 0
    out = capsys.readouterr().out
    assert "vislam.pixel_sigma_px = 0.75 px" in out
    assert "frontend.klt.pyramid_levels" in out
    assert "one of: consistent, literal" in out


def test_config_shows_the_basic_settings_in_groups(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["config", "--show", "--set", "msckf.clones=9"]) == 0
    lines = capsys.readouterr().out.splitlines()
    keys = [line.partition(" = ")[0] for line in lines if line[0] not in " #"]
    assert keys == list(BASIC)
    assert "msckf.clones = 9" in lines
    assert "# The sliding-window filter (docs/math.md, section 3)" in lines
    assert lines[-1] == f"# {len(list(describe(Config()))) - len(BASIC)} more: vio config --all"


def test_config_prints_the_effective_configuration(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["config", "--set", "vislam.iterations=7"]) == 0
    path = tmp_path / "all.yaml"
    path.write_text(capsys.readouterr().out)
    assert main(["config", "--config", str(path)]) == 0
    assert "iterations: 7" in capsys.readouterr().out


def test_eval_aligns_as_requested(
    finished: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    estimate = Path(finished, "trajectory.tum")
    trajectory = read_trajectory(estimate)
    poses = trajectory.T_world_body.copy()
    poses[:, :3, 3] *= 1.1
    larger = tmp_path / "larger.tum"
    write_tum(larger, replace(trajectory, T_world_body=poses))
    scores = {
        mode: json_of(capsys, "eval", estimate, larger, "--align", mode)
        for mode in ("se3", "sim3", "none")
    }
    assert scores["sim3"]["ate_m"] < 1e-6
    assert scores["sim3"]["scale"] == pytest.approx(1.1)
    assert scores["se3"]["ate_m"] < scores["none"]["ate_m"]
    assert scores["se3"]["ate_m"] > 0.1
    assert main(["eval", str(estimate), str(larger), "--lengths", "5,10"]) == 0
    printed = capsys.readouterr().out.splitlines()
    assert [line[:10].strip() for line in printed] == [
        *(
            "compared",
            "path",
            "alignment",
            "ATE",
            "scale",
            "attitude",
            "RPE",
            "drift",
            "5 m",
            "10 m",
        ),
    ]
    with pytest.raises(SystemExit):
        main(["eval", str(estimate), str(larger), "--lengths", "far"])
    assert (
        "'far' is no list of path lengths; give metres above 0, as in 25,50"
        in capsys.readouterr().err
    )
    assert printed[7].endswith("over 5 to 10 m")
    assert {len(line) - len(line.lstrip()) for line in (row[11:] for row in printed[8:])} <= {
        2,
        3,
    }, "aligned"


def test_eval_refuses_two_poses(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    short = tmp_path / "short.tum"
    short.write_text("1 0 0 0 0 0 0 1\n2 1 0 0 0 0 0 1\n")
    assert "only 2 poses match; a comparison needs at least 3" in refused(
        capsys, "eval", short, short
    )


def test_evo_reads_every_trajectory_file(finished: str) -> None:
    from evo.tools import file_interface

    for name in ("trajectory.tum", "dead_reckoning.tum"):
        assert file_interface.read_tum_trajectory_file(f"{finished}/{name}").num_poses == FRAMES
    assert file_interface.read_kitti_poses_file(f"{finished}/trajectory.kitti").num_poses == FRAMES


def test_reproduce_writes_a_table_and_figures(
    recording: Path, truth: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    tables = json_of(capsys, "reproduce", f"{recording}={truth}", "--out", tmp_path / "table")
    rows = {row["name"]: row for row in tables[0]["rows"]}
    assert rows["dead reckoning"]["ate_m"] == pytest.approx(rows["mapping only"]["ate_m"])
    assert rows["recommended"]["ate_m"] < 0.05
    assert {f.name for f in (tmp_path / "table" / "drive").iterdir()} == {
        "table.md",
        "table.json",
        "trajectories.png",
        "dead_reckoning.png",
        "landmarks.png",
        "selection.png",
    }
    assert "| recommended |" in (tmp_path / "table" / "drive" / "table.md").read_text()


def test_the_module_runs_as_a_process(recording: Path, tmp_path: Path) -> None:
    """Logs go to stderr, so that stdout is JSON alone."""
    argv = [
        sys.executable,
        "-m",
        "vio",
        "run",
        str(recording),
        "--out",
        str(tmp_path / "out"),
        "--no-plot",
        "--json",
    ]
    done = subprocess.run(argv, capture_output=True, text=True, check=True)
    assert json.loads(done.stdout)["frames"] == FRAMES


def test_without_pycolmap_only_its_commands_fail(
    recording: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    code = "import sys; sys.modules['pycolmap'] = None; from vio.cli import main; sys.exit(main(sys.argv[1:]))"
    out = tmp_path / "out"
    argv = [
        sys.executable,
        "-c",
        code,
        "run",
        str(recording),
        "--out",
        str(out),
        "--save-observations",
        "--no-plot",
    ]
    assert subprocess.run(argv, capture_output=True, check=False).returncode == 0
    monkeypatch.setitem(sys.modules, "pycolmap", None)
    for name in [name for name in sys.modules if name.startswith("vio.offline.colmap")]:
        monkeypatch.delitem(sys.modules, name)
    assert main(["eval", str(out), str(out / "trajectory.tum")]) == 0
    capsys.readouterr()
    for argv in (
        ["check", str(out)],
        ["refine", str(out)],
        ["export", "colmap", str(out)],
        ["calibrate", str(recording)],
    ):
        assert main(argv) == 1, argv
        printed = capsys.readouterr()
        assert printed.out == "", argv
        assert printed.err.startswith("error: this command needs pycolmap"), argv
        assert printed.err.count("\n") == 1, argv


def test_each_finding_of_the_stereo_calibration_has_a_line_of_its_own(
    capsys: pytest.CaptureFixture[str],
) -> None:
    """Three at most, all in one column."""
    from vio.cli.output import print_result
    from vio.cli.running import metric_rows

    found = [f"right camera turned by +0.{k} deg about axis {k}" for k in range(5)]
    field = {"text": "worth calibrating: rows off by 0.4 px", "rig": {"lines": found}}
    absent = ("stereo_scale", "camera_imu", "ate_m", "t_err_percent", "landmark_error")
    metrics: dict[str, Any] = {
        "frames": 30,
        "first_frame": 0,
        "last_frame": 29,
        "path_length_m": 9.0,
        "stages_ms": {},
        "ms_per_frame_median": 20.0,
        "ms_per_frame_95": 30.0,
        "start_s": 0.0,
        "refused_share": None,
    }
    metrics |= {
        "backend": "msckf",
        "motion": None,
        "camera": {},
        "stereo_field": field,
        "out": "runs/drive",
    }
    print_result({}, metric_rows(metrics | dict.fromkeys(absent)), as_json=False)
    lines = capsys.readouterr().out.splitlines()
    first = next(k for k, line in enumerate(lines) if line.startswith("stereo "))
    assert lines[first + 1 : first + 4] == [f"{'':<11}{text}" for text in found[:3]]
    assert not any(text in line for line in lines[first + 4 :] for text in found)


@pytest.mark.skipif(shutil.which("head") is None, reason="needs head")
def test_a_closed_pipe_is_norefused() -> None:
    done = subprocess.run(
        f"{sys.executable} -m vio config --show | head -n 1",
        shell=True,
        capture_output=True,
        text=True,
        check=True,
    )
    assert done.stderr == ""


def test_the_plot_of_a_comparison_takes_axes_and_columns(
    finished: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    truth = f"{finished}/trajectory.tum"
    pictures = []
    for more in ([], ["--axes", "xz"], ["--columns", "position,attitude,z"], ["--over", "time"]):
        picture = tmp_path / f"{len(pictures)}.png"
        assert main(["eval", finished, truth, "--plot", str(picture), *more]) == 0
        pictures.append(picture.read_bytes())
    assert len(set(pictures)) == len(pictures)
    assert "give --plot too" in refused(capsys, "eval", finished, truth, "--axes", "xz")
    without_times = tmp_path / "a.kitti"
    shutil.copy(f"{finished}/trajectory.kitti", without_times)
    kitti = ["eval", without_times, without_times, "--plot", tmp_path / "a.png"]
    assert "use --over distance" in refused(capsys, *kitti, "--over", "time")


@pytest.mark.parametrize(
    ("flag", "value"), [("--axes", "xx"), ("--axes", "xyz"), ("--columns", "a")]
)
def test_axes_and_columns_that_do_not_exist_are_usage_errors(flag: str, value: str) -> None:
    with pytest.raises(SystemExit) as stop:
        main(["eval", "a", "b", "--plot", flag, value])
    assert stop.value.code == 2


def test_the_names_of_columns_are_those_that_can_be_drawn() -> None:
    from vio.cli.evaluate import _COLUMNS
    from vio.runs.picture import COMPARED_COLUMNS

    assert tuple(COMPARED_COLUMNS) == _COLUMNS


@pytest.mark.parametrize("name", ["inspect", "run", "live", "report", "eval"])
def test_the_help_of_a_main_command_ends_with_three_examples(name: str) -> None:
    parser = build_parser([name])
    (commands,) = (a for a in parser._actions if isinstance(a, argparse._SubParsersAction))
    text = commands.choices[name].format_help().partition("\nexamples:\n")[2]
    found = re.findall(rf"^  (vio {name} .*)\n      \S", text, re.MULTILINE)
    assert len(found) == 3
    for line in found:
        parsed = parser.parse_args(shlex.split(line)[1:])
        assert parsed.command == name
        if getattr(parsed, "mavlink", None) is not None:
            open_link(parsed.mavlink).close()


def test_the_help_of_run_names_every_kind_of_recording() -> None:
    from vio.datasets import readers

    (commands,) = (
        a for a in build_parser(["run"])._actions if isinstance(a, argparse._SubParsersAction)
    )
    named = re.search(r"sets it \(([\w\s,]+)\)", commands.choices["run"].format_help())
    assert named is not None
    assert {word.strip() for word in named[1].split(",")} == set(readers())


def test_a_start_searches_no_cycles_of_objects() -> None:
    code = """
import atexit, gc
searches = lambda: sum(kind["collections"] for kind in gc.get_stats())
from vio.cli import main
before = searches()
atexit.register(lambda: print(searches() == before, gc.get_freeze_count() > 0))
main(["run", "--help"])
"""
    ended = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert ended.stdout.splitlines()[-1] == "True True"
