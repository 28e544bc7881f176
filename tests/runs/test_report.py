"""`vio report`: a page about finished runs."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
from dataclasses import replace
from html import escape
from pathlib import Path

import numpy as np
import pytest

from tests.commands import refused
from vio.cli import main
from vio.evaluation.trajectories import evaluate
from vio.files.trajectories import read_trajectory
from vio.filters.navigation import ImuMotion, NavState, TwistMotion
from vio.filters.settings import MsckfSettings
from vio.geometry.lie import se3_from_parts, so3_exp
from vio.geometry.upright import attitude_deg, up_of, upright_axes
from vio.records import LoopEvent, MapKeyframes
from vio.report.compared import apart, compared_figures
from vio.report.figures import sections
from vio.report.page import page
from vio.report.words import run_figures, summary
from vio.runs.curves import COLOURS, curves_of
from vio.runs.finished import _read_frames, read_finished_run, with_distinct_names

BROWSER = (
    shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
)


@pytest.fixture(scope="module")
def runs(flight: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """The flight, processed with its IMU and from images alone."""
    out = tmp_path_factory.mktemp("runs")
    folders = out / "imu" / "run", out / "images" / "run"
    exact = "--set", "msckf.calibrate_stereo=off"  # the rig is
    for folder, motion in zip(folders, ("imu", "none"), strict=True):
        assert (
            main(["run", str(flight), "--motion", motion, "--quiet", "--out", str(folder), *exact])
            == 0
        )
    return folders


def test_the_folder_of_a_run_tells_its_errors_without_the_recording(
    runs: tuple[Path, Path],
) -> None:
    metrics = json.loads((runs[0] / "metrics.json").read_text())
    own, reference = (
        read_trajectory(runs[0] / f"{name}.tum") for name in ("trajectory", "reference")
    )
    again = evaluate(own, reference, T_cam0_imu=np.array(metrics["T_cam0_imu"]))
    assert again.ate_m.rmse == pytest.approx(metrics["ate_m"], rel=1e-6)
    run = read_finished_run(runs[0])
    assert run.evaluation.ate_m.rmse == pytest.approx(metrics["ate_m"], rel=1e-6)


def test_frame_logs_of_older_versions_are_read_by_the_names_of_today(tmp_path: Path) -> None:
    (tmp_path / "frames.csv").write_text("index,watch_ms\n0,0.5\n1,\n", encoding="utf-8")
    frames = _read_frames(tmp_path / "frames.csv", 2)
    np.testing.assert_array_equal(frames["monitor_ms"], [0.5, np.nan])


def test_the_words_and_the_table_hold_the_figures_of_the_run(runs: tuple[Path, Path]) -> None:
    run = read_finished_run(runs[0])
    text = " ".join(summary(run))
    assert "16 frames of flight (euroc)" in text
    assert "from an IMU by msckf" in text
    assert f"position error is {1e3 * run.metrics['ate_m']:.3g} mm" in text
    assert f"{1e3 * 0.05:.1f} ms" in text  # one frame every 50 ms
    figures = run_figures(run)
    assert figures["ATE"] == f"{1e3 * run.metrics['ate_m']:.3g} mm"
    assert figures["path"] == f"{run.metrics['path_length_m']:.2f} m of imu"
    assert figures["ms a frame, median"] == f"{run.metrics['ms_per_frame_median']:.1f}"
    assert figures["observations refused (%)"] == f"{100 * run.metrics['refused_share']:.1f}"


def test_a_page_needs_no_network_and_shows_every_part(runs: tuple[Path, Path]) -> None:
    run = read_finished_run(runs[0])
    text = page([run])
    assert not re.search(r"<(script|link|img)[^>]*(src|href)=(?!\"data:image)", text)
    assert text.count("plotly.js v") == 1
    drawn = (
        "Path",
        "Position and height",
        "Attitude",
        "Velocity",
        "Errors",
        "Features",
        "Innovations and residuals",
        "IMU biases",
    )
    for title in (
        "Summary",
        "Figures",
        "Features and disparities",
        *drawn,
        "Path in three dimensions",
        "Time",
    ):
        assert f"<h2>{title}</h2>" in text
    assert f"<code>{escape(run.metrics['command'])}</code>" in text
    assert (
        "IMU: corrections of its calibration: time offset"
        in text.partition("<h2>Calibration</h2>")[2].partition("</section>")[0]
    )
    assert "All settings have their defaults" not in text  # --motion is one
    assert "<h2>IMU biases</h2>" not in page([read_finished_run(runs[1])])


def test_more_runs_than_colours_are_all_drawn(runs: tuple[Path, Path]) -> None:
    run = read_finished_run(runs[0])
    many = [replace(run, name=f"run {k}") for k in range(len(COLOURS) + 1)]
    for section in sections(many, curves_of(many)):
        if section.title in ("Path", "Position and height", "IMU biases", "Features"):
            names = " ".join(str(trace.name) for trace in section.figure.data)
            assert all(each.name in names for each in many), section.title


def test_a_run_with_a_map_is_drawn_in_it_with_its_loops(runs: tuple[Path, Path]) -> None:
    """The map's own frame does not matter: the picture begins where the run does, or lies on the
    reference.
    """
    plain = read_finished_run(runs[0])
    moved = se3_from_parts(so3_exp([0.0, 0.0, 1.0]), [5.0, 6.0, 7.0])
    T_map = moved @ plain.trajectory.T_world_body
    frames = np.array(plain.estimates["index"])
    loop = LoopEvent(int(frames[-1]), 1, 0, 0, 50, 0.1, joined=False, keyframe_frame=int(frames[0]))
    run = replace(
        plain,
        mapped=replace(plain.trajectory, T_world_body=T_map),
        map_keyframes=MapKeyframes(
            *3 * (frames[:1],), np.array([True]), T_map[:1], np.zeros((1, 6, 6))
        ),
        loops=(loop, replace(loop, kept=False), replace(loop, keyframe_frame=None)),
    )
    for shown in (run, replace(run, evaluation=None)):
        (curve,) = curves_of([shown])
        np.testing.assert_allclose(curve.mapped.position, curve.position, atol=1e-9)
        np.testing.assert_allclose(curve.mapped.keyframes, curve.position[:1], atol=1e-9)
        np.testing.assert_allclose(curve.mapped.loops, curve.position[None, [-1, 0]], atol=1e-9)
    assert "<h2>Map</h2>" in page([run])
    assert "<h2>Map</h2>" not in page([plain])


def test_names_of_files_cannot_bring_script_into_a_page(
    runs: tuple[Path, Path], tmp_path: Path
) -> None:
    folder = tmp_path / "<script>alert(1)"
    shutil.copytree(runs[1], folder)
    text = page([read_finished_run(folder)])
    assert "<script>alert" not in text
    assert "&lt;script&gt;alert" in text


def test_curves_lie_on_the_truth_and_bands_hold_it(runs: tuple[Path, Path]) -> None:
    run = read_finished_run(runs[0])
    (curve,) = curves_of([run])
    assert np.array_equal(curve.truth.seconds, curve.seconds)
    distance = np.linalg.norm(curve.position - curve.truth.position, axis=1)
    # two alignments of nearly the same path
    assert np.abs(distance - curve.truth.error_m).max() < 2e-3
    # With OpenCV 5 the attitude of this small flight is off by 1.2 degrees.
    assert np.abs(curve.attitude - curve.truth.attitude).max() < 1.5
    assert curve.truth.position[0] == pytest.approx(np.zeros(3), abs=1e-12)
    rise = np.diff(curve.position[:, 2]) / np.diff(curve.seconds)
    assert np.abs(rise - (curve.velocity[1:, 2] + curve.velocity[:-1, 2]) / 2)[4:].max() < 0.05


def test_runs_of_one_recording_are_drawn_in_one_frame(runs: tuple[Path, Path]) -> None:
    curves = curves_of([read_finished_run(folder) for folder in runs])
    assert np.linalg.norm(curves[0].position - curves[1].position, axis=1).max() < 0.02
    assert [c.draws_truth for c in curves] == [True, False]
    assert [
        run.name for run in with_distinct_names([read_finished_run(folder) for folder in runs])
    ] == [
        "imu/run",
        "images/run",
    ]


def test_heading_pitch_and_roll_have_the_signs_that_they_say() -> None:
    # a level camera: x right, y down, z ahead; as columns
    ahead = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])
    down, right, back = np.eye(3)[2] * -1, np.eye(3)[0], np.eye(3)[1]
    turned = so3_exp(0.1 * down) @ ahead  # about down: to the right
    lifted = so3_exp(0.1 * right) @ ahead
    rolled = so3_exp(0.1 * back) @ ahead  # about ahead: the right side down
    found = np.radians(attitude_deg(np.stack([ahead, turned, lifted, rolled])))
    assert found == pytest.approx(
        np.array([[0, 0, 0], [0.1, 0, 0], [0, 0.1, 0], [0, 0, 0.1]]), abs=1e-12
    )


def test_up_is_that_of_gravity_else_that_of_the_first_image() -> None:
    level = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])
    pitched = so3_exp(np.array([-0.4, 0, 0])) @ level  # looks down
    T = se3_from_parts(pitched, np.zeros(3))[None]
    assert upright_axes(T, up_of("imu", None)) == pytest.approx(np.eye(3), abs=1e-12)
    assert upright_axes(T)[2] == pytest.approx(pitched @ [0, -1, 0])
    straight_down = se3_from_parts(so3_exp(np.array([-np.pi / 2, 0, 0])) @ level, np.zeros(3))[None]
    axes = upright_axes(straight_down, np.array([0.0, 0, 1]))
    assert axes @ axes.T == pytest.approx(np.eye(3), abs=1e-12)
    assert np.linalg.det(axes) == pytest.approx(1)
    assert up_of("imu", np.array([0.0, 9.81, 0])) == pytest.approx([0, -9.81, 0])


@pytest.mark.parametrize("model", [ImuMotion, TwistMotion])
def test_the_velocity_covariance_is_that_of_the_filters_error(
    model: type[ImuMotion | TwistMotion],
) -> None:
    rng = np.random.default_rng(0)
    motion = model(MsckfSettings(calibrate_imu="off"))
    T = se3_from_parts(so3_exp(rng.normal(size=3)), rng.normal(size=3))
    nav = NavState(T, rng.normal(size=3), rng.normal(size=3), np.zeros(3), np.zeros(3))
    root = 1e-4 * rng.normal(size=(15, 15))
    found = motion.uncertainty(nav, root @ root.T)
    steps = [
        motion.velocity_world(motion.corrected(nav, column)) - motion.velocity_world(nav)
        for column in root.T
    ]
    numeric = np.einsum("ka,kb->ab", steps, steps)
    assert found.velocity_covariance == pytest.approx(
        numeric, rel=1e-2, abs=1e-3 * np.trace(numeric)
    )


def test_the_command_writes_into_the_run_and_a_new_run_may_replace_it(
    runs: tuple[Path, Path], flight: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["report", str(runs[1])]) == 0
    out = runs[1] / "report.html"
    assert capsys.readouterr().out.strip() == str(out)
    assert out.stat().st_size < 8_000_000
    assert (
        main(
            [
                "run",
                str(flight),
                "--motion",
                "none",
                "--stop",
                "6",
                "--quiet",
                "--out",
                str(runs[1]),
            ]
        )
        == 0
    )
    assert not out.exists()


@pytest.mark.parametrize(
    ("name", "content", "says"),
    [
        ("estimates.npy", b"no table", "cannot be read"),
        ("frames.csv", b"index,time_ns\n0,0\n", "has 1 frames"),
        ("landmarks.ply", b"ply\nend_header\nxyz", "is damaged"),
        ("metrics.json", b"[]", "is damaged"),
    ],
)
def test_damaged_folders_are_named(
    runs: tuple[Path, Path],
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    name: str,
    content: bytes,
    says: str,
) -> None:
    folder = tmp_path / "run"
    shutil.copytree(runs[0], folder)
    (folder / name).write_bytes(content)
    message = refused(capsys, "report", folder)
    assert name in message
    assert says in message


@pytest.mark.skipif(BROWSER is None, reason="no Chromium here")
def test_a_browser_draws_all_figures(runs: tuple[Path, Path], tmp_path: Path) -> None:
    out = tmp_path / "report.html"
    assert main(["report", *map(str, runs), "--out", str(out)]) == 0
    figures = len(re.findall(r'id="figure-\d+"', out.read_text(encoding="utf-8")))
    assert BROWSER is not None
    arguments = [
        "--headless",
        "--no-sandbox",
        "--disable-gpu",
        "--enable-logging=stderr",
        "--virtual-time-budget=9000",
    ]
    shown = subprocess.run(
        [
            BROWSER,
            *arguments,
            f"--user-data-dir={tmp_path / 'browser'}",
            "--dump-dom",
            out.as_uri(),
        ],
        capture_output=True,
        text=True,
        timeout=300,
        check=True,
    )
    drawn = re.findall(r'id="figure-\d+" class="plotly-graph-div js-plotly-plot"', shown.stdout)
    assert figures >= 9
    assert len(drawn) == figures
    assert "Uncaught" not in shown.stderr


def test_runs_of_one_recording_are_compared(runs: tuple[Path, Path]) -> None:
    """Changes from the first run in per cent, the best in bold, and the distance between paths."""
    found = with_distinct_names([read_finished_run(folder) for folder in runs])
    cells = compared_figures(found)["ATE"]
    errors = [run.metrics["ate_m"] for run in found]
    assert cells[1][0].endswith(f"({100 * (errors[1] / errors[0] - 1):+.0f} %)")
    assert [best for _, best in cells] == [error == min(errors) for error in errors]
    text = page(found)
    assert f"<b>{escape(cells[int(np.argmin(errors))][0])}</b>" in text
    assert f"<h2>Distance from {found[0].name}</h2>" in text
    between = apart(*found)
    assert between is not None
    assert len(between.seconds) == min(len(run.estimates) for run in found)
    assert 0 < between.distance_m.max() < 2 * sum(run.evaluation.ate_m.max for run in found)
    same = apart(found[0], found[0])
    assert same is not None
    assert same.distance_m.max() < 1e-9


def test_runs_of_different_recordings_are_only_listed(runs: tuple[Path, Path]) -> None:
    run = read_finished_run(runs[0])
    other = replace(run, name="other", metrics={**run.metrics, "source": "euroc:/elsewhere"})
    assert apart(run, other) is None
    assert not any(best for cells in compared_figures([run, other]).values() for _, best in cells)
    assert "Distance from" not in page([run, other])
