"""`vio render`: folders that read back, identical output from any number of processes, and clear
errors.
"""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from concurrent.futures.process import BrokenProcessPool
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tests.conftest import ROOT
from vio.cli import build_parser, main
from vio.cli.render import scenario_from
from vio.datasets import DatasetSettings, open_dataset
from vio.errors import SimulationError
from vio.files.trajectories import tum_text
from vio.geometry.lie import FloatArray
from vio.records import ImuSample, IntArray, StereoFrame, VelocitySample
from vio.sim.motion import hand_held, motion_at, rotate_body_axes
from vio.sim.rigs import R_FLU_EUROC_IMU
from vio.sim.scenarios import EFFECTS, ParallelRecording, Scenario, conditions_of, plan
from vio.sim.sequence import SimulatedRecording, Simulation
from vio.sim.world import corridor

SMALL = ["--width", "96", "--duration", "0.2", "--workers", "1"]
START_NS = 1_500_000_000_000_000_000


def write_tum(path: Path, times_ns: IntArray, positions: FloatArray) -> Path:
    """A trajectory that looks along x with the axes of the small rig."""
    rows = [
        f"{t // 10**9}.{t % 10**9:09d} {p[0]!r} {p[1]!r} {p[2]!r} 0 0 0 1"
        for t, p in zip(times_ns.tolist(), positions.tolist(), strict=True)
    ]
    path.write_text("\n".join(rows) + "\n", encoding="utf-8")
    return path


def straight(path: Path, start: FloatArray, end: FloatArray) -> Path:
    """A TUM file of a straight flight of one second."""
    times = START_NS + np.arange(101) * 10_000_000
    return write_tum(path, times, start + np.linspace(0, 1, 101)[:, None] * (end - start))


@pytest.fixture(scope="module")
def flight(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder like a recorded flight: ground truth, image times and IMU, all with irregular
    times.
    """
    folder = tmp_path_factory.mktemp("flight")
    motion = rotate_body_axes(hand_held(duration_s=2.0, start_ns=START_NS), R_FLU_EUROC_IMU)
    times = START_NS + np.arange(200) * 10_000_000
    T = motion_at(motion, times).T_world_imu
    (folder / "groundtruth_tum.txt").write_text(tum_text(times, T), encoding="utf-8")
    frames = START_NS + np.array([40, 91, 139, 190, 240]) * 1_000_000
    (folder / "image_timestamps_ns.txt").write_text(
        "\n".join(map(str, frames.tolist())) + "\n", encoding="utf-8"
    )
    imu = [f"{START_NS + 5_000_000 * k},0.25,{k}.5,-1,0.125,9.75,{-k}" for k in range(200)]
    (folder / "imu0.csv").write_text(
        "\n".join(["#timestamp,w,w,w,a,a,a", *imu]) + "\n", encoding="utf-8"
    )
    return folder


def render(out: Path, *arguments: str) -> int:
    return main(["render", "--out", str(out), *arguments])


# --- whole folders
# --------------------------------------------------------------------------------------------------


def test_the_summary_describes_the_folder_and_the_folder_reads_back(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "room"
    assert render(out, *SMALL, "--json", "--seed", "3") == 0
    summary = json.loads(capsys.readouterr().out)
    assert (summary["frames"], summary["width"], summary["height"]) == (4, 96, 61)
    assert (summary["format"], summary["rig"], summary["imu"]) == (
        "euroc",
        "euroc-rectified",
        "simulated",
    )
    assert summary["bytes"] == sum(path.stat().st_size for path in out.rglob("*") if path.is_file())
    dataset = open_dataset(str(out), DatasetSettings())
    assert len(dataset.recording.frame_times_ns) == 4
    events = list(dataset.events())
    frames = [event for event in events if isinstance(event, StereoFrame)]
    expected = SimulatedRecording(plan(Scenario(width=96, duration_s=0.2, seed=3)))
    for frame in frames:
        for read, made in zip((frame.left, frame.right), expected.images(frame.index), strict=True):
            np.testing.assert_array_equal(read, made)
    assert sum(isinstance(event, ImuSample) for event in events) >= 31
    assert dataset.recording.reference is not None


def test_a_kitti_folder_has_the_velocities_of_the_paper(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "kitti"
    assert render(out, *SMALL, "--format", "kitti", "--rate", "30", "--duration", "0.1") == 0
    printed = capsys.readouterr()
    assert f"{out} (kitti" in printed.out
    assert printed.err == ""
    dataset = open_dataset(str(out), DatasetSettings())
    events = list(dataset.events())
    frames = [event.time_ns for event in events if isinstance(event, StereoFrame)]
    assert len(frames) == 3
    assert [event.time_ns for event in events if isinstance(event, VelocitySample)] == frames
    assert dataset.recording.reference is not None


def test_car_trajectory_defaults_to_kitti_cameras_rate_and_format() -> None:
    argv = ["render", "--out", "x", "--scene", "street", "--trajectory", "car", "--duration", "20"]
    scenario, form = scenario_from(build_parser().parse_args(argv))
    assert (scenario.rig, scenario.rate_hz, scenario.velocity, form) == (
        "kitti",
        10.0,
        "paper",
        "kitti",
    )
    simulation = plan(scenario)
    assert len(simulation.taken_ns) == 200
    speed = np.linalg.norm([sample.linear for sample in simulation.velocity], axis=1)
    assert 3 < np.median(speed) < 12


def test_flight_folder_provides_ground_truth_image_times_and_imu(
    tmp_path: Path, flight: Path
) -> None:
    out = tmp_path / "flight"
    assert render(out, "--trajectory", str(flight), "--width", "96", "--workers", "1") == 0
    stamps = [int(line) for line in (flight / "image_timestamps_ns.txt").read_text().split()]
    assert sorted(int(path.stem) for path in (out / "mav0/cam1/data").iterdir()) == stamps
    written = np.loadtxt(out / "mav0/imu0/data.csv", delimiter=",")
    np.testing.assert_array_equal(written, np.loadtxt(flight / "imu0.csv", delimiter=","))
    truth = np.loadtxt(out / "mav0/state_groundtruth_estimate0/data.csv", delimiter=",")
    given = np.loadtxt(flight / "groundtruth_tum.txt")
    np.testing.assert_allclose(truth[::2, 1:4], given[: len(truth[::2]), 1:4], atol=2e-3)
    assert "radial-tangential" in (out / "mav0/cam0/sensor.yaml").read_text()


def test_rate_duration_and_imu_options_override_the_flight(tmp_path: Path, flight: Path) -> None:
    common = ["render", "--out", str(tmp_path / "x"), "--trajectory", str(flight)]
    default, _ = scenario_from(build_parser().parse_args(common))
    assert (default.frame_times, default.imu) == (
        flight / "image_timestamps_ns.txt",
        flight / "imu0.csv",
    )
    other, _ = scenario_from(
        build_parser().parse_args([*common, "--rate", "4", "--imu", "simulated"])
    )
    assert (other.frame_times, other.imu) == (None, "simulated")
    assert np.all(np.diff(plan(other).taken_ns) == 250_000_000)
    short, _ = scenario_from(build_parser().parse_args([*common, "--duration", "0.12"]))
    assert len(plan(short).taken_ns) == 3


def test_replaces_an_older_render_folder(tmp_path: Path) -> None:
    out = tmp_path / "room"
    assert render(out, *SMALL) == 0
    assert render(out, *SMALL, "--duration", "0.1") == 0
    assert len(list((out / "mav0/cam0/data").iterdir())) == 2
    assert [path.name for path in tmp_path.iterdir()] == ["room"]


def test_parallel_rendering_is_identical_and_reports_a_dead_process() -> None:
    scenario = Scenario(
        width=96, duration_s=0.3, conditions=conditions_of(["noise", "duplicated"]), seed=2
    )
    alone = SimulatedRecording(plan(scenario))
    with ParallelRecording(scenario, workers=2) as together:
        for index in range(len(alone)):
            for one, other in zip(alone.images(index), together.images(index), strict=True):
                np.testing.assert_array_equal(one, other)
        with pytest.raises(BrokenProcessPool):  # only then does the pool know
            together._pool.submit(os._exit, 1).result()
        with pytest.raises(SimulationError, match="ended unexpectedly"):
            together.images(0)


# --- scenes and effects
# ---------------------------------------------------------------------------------------------


def test_the_help_names_every_effect(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("COLUMNS", "1000")
    with pytest.raises(SystemExit):
        main(["render", "--help"])
    printed = capsys.readouterr().out.split()
    assert not set(EFFECTS) - {word.strip(",.") for word in printed}


@pytest.fixture(scope="module")
def plain() -> Simulation:
    """One frame without effects, far enough into the motion for exposure changes and blur to be
    visible.
    """
    simulation = plan(Scenario(width=96, duration_s=2.0, seed=1))
    return replace(
        simulation, taken_ns=simulation.taken_ns[-1:], stamps_ns=simulation.stamps_ns[-1:]
    )


@pytest.mark.parametrize(
    "effect", ["clean", "exposure", "gain", "gain-high", "blur", "noise", "dark"]
)
def test_sensor_effects_change_the_expected_images(plain: Simulation, effect: str) -> None:
    changed = replace(plain, effects=conditions_of([effect]).effects)
    before, after = SimulatedRecording(plain).images(0), SimulatedRecording(changed).images(0)
    left, right = (np.mean(a != b) for a, b in zip(before, after, strict=True))
    assert right > 0.05
    assert (left == 0) == (effect in ("gain", "gain-high"))


def test_bare_walls_have_no_texture_and_moving_boxes_are_seen() -> None:
    hard = plan(
        Scenario(
            width=96,
            duration_s=12.0,
            rate_hz=0.5,
            seed=1,
            conditions=conditions_of(["bare-wall", "moving"]),
        )
    )
    recording = SimulatedRecording(replace(hard, effects=conditions_of(["clean"]).effects))
    movers = hard.world.surfaces.mover
    flat, seen = 0, set[int]()
    for index, time_ns in enumerate(hard.taken_ns.tolist()):
        _, surface = recording.depth(0, time_ns)
        seen |= set(movers[surface].ravel().tolist())
        shown, count = np.unique(surface, return_counts=True)
        largest = surface == shown[count.argmax()]
        inner = (
            largest[1:-1, 1:-1]
            & largest[:-2, 1:-1]
            & largest[2:, 1:-1]
            & largest[1:-1, :-2]
            & largest[1:-1, 2:]
        )
        flat += float(recording.images(index)[0][1:-1, 1:-1][inner].std()) < 1.0
    assert flat >= 2
    assert len(seen - {0}) >= 2


def test_effects_on_frames_and_clocks() -> None:
    base = Scenario(width=96, duration_s=10.0, seed=1)
    plain = plan(base)
    dropped, duplicated, shifted = (
        plan(replace(base, conditions=conditions_of([name])))
        for name in ("dropped", "duplicated", "time-offset")
    )
    assert len(plain.taken_ns) == 200
    assert 165 < len(dropped.taken_ns) < 195
    assert 5 < np.sum(np.diff(duplicated.taken_ns) == 0) < 35
    assert np.all(shifted.stamps_ns - shifted.taken_ns == 20_000_000)


def test_set_options_override_named_effects(tmp_path: Path) -> None:
    argv = [
        "render",
        "--out",
        str(tmp_path),
        "--effects",
        "noise, dropped",
        "--set",
        "effects.read_noise=2",
    ]
    args = build_parser().parse_args([*argv, "--set", "faults.dropped=0.5", "--set", "moving=true"])
    conditions = scenario_from(args)[0].conditions
    assert (conditions.effects.read_noise, conditions.effects.full_well) == (2.0, 5000.0)
    assert conditions.faults.dropped == 0.5
    assert conditions.moving


@pytest.mark.parametrize(
    "scenario",
    [
        Scenario(scene="room", duration_s=60.0),
        Scenario(scene="corridor", duration_s=70.0),
        Scenario(scene="street", duration_s=60.0),
        Scenario(scene="street", trajectory="car", rig="kitti", duration_s=60.0),
    ],
    ids=["room", "corridor", "street", "car"],
)
@pytest.mark.parametrize("seed", [0, 5])
def test_predefined_motions_avoid_moving_boxes(scenario: Scenario, seed: int) -> None:
    simulation = plan(
        replace(scenario, seed=seed, rate_hz=1.0, conditions=conditions_of(["moving"]))
    )
    assert simulation.world.movers
    for time_ns in simulation.taken_ns.tolist():
        T = motion_at(simulation.motion, time_ns).T_world_imu[0]
        for camera in (simulation.rig.T_imu_cam0, simulation.rig.T_imu_cam1):
            for box in simulation.world.movers:
                local = np.linalg.inv(box.motion(time_ns)) @ (T @ camera)[:, 3]
                assert (np.abs(local[:3]) - box.size / 2).max() > 0.15


def test_boxes_move_in_a_room_around_a_flight_too(flight: Path) -> None:
    scenario = Scenario(trajectory=flight / "groundtruth_tum.txt", rig="euroc", width=96)
    moving = plan(replace(scenario, conditions=conditions_of(["moving", "bare-wall"])))
    assert len(moving.world.movers) == 4
    np.testing.assert_array_equal(moving.world.bounds, plan(scenario).world.bounds)


@pytest.mark.parametrize("rig", ["euroc", "euroc-rectified", "kitti", "fisheye", "small"])
def test_every_rig_looks_forward_at_any_width(rig: str) -> None:
    """Hand-held cameras look along the horizon, for all IMU axes; the field of view is
    unchanged.
    """
    wide, narrow = (plan(Scenario(rig=rig, width=width, duration_s=0.05)) for width in (None, 200))  # type: ignore[arg-type]
    T = motion_at(narrow.motion, narrow.taken_ns[0]).T_world_imu[0] @ narrow.rig.T_imu_cam0
    assert abs(T[2, 2]) < 0.5  # the optical axis is about level
    assert T[2, 1] < -0.8  # the camera's y axis points down
    assert narrow.rig.cam0.width == 200
    assert narrow.rig.cam0.fu / 200 == pytest.approx(wide.rig.cam0.fu / wide.rig.cam0.width)


# --- refusals
# --------------------------------------------------------------------------------------------------


def in_a_box(folder: Path) -> list[str]:
    box = corridor(0).solids[0].T_world_box[:3, 3]
    step = np.array([1.0, 0.0, 0.0])
    tum = straight(folder / "t.tum", box - step, box + step)
    return ["--scene", "corridor", "--trajectory", str(tum), "--rig", "small"]


def out_of_the_scene(folder: Path) -> list[str]:
    tum = straight(folder / "t.tum", np.array([28.0, 0, 1.5]), np.array([31.0, 0, 1.5]))
    return ["--scene", "corridor", "--trajectory", str(tum), "--rig", "small"]


def against_time(folder: Path) -> list[str]:
    times = START_NS + np.array([0, 10, 20, 15, 40]) * 1_000_000
    return ["--trajectory", str(write_tum(folder / "t.tum", times, np.zeros((5, 3)) + 1.0))]


def frames_against_time(folder: Path) -> list[str]:
    tum = straight(folder / "t.tum", np.zeros(3), np.ones(3))
    (folder / "frames.txt").write_text(f"{START_NS + 20}\n{START_NS + 10}\n", encoding="utf-8")
    return ["--trajectory", str(tum), "--frame-times", str(folder / "frames.txt")]


def imu_of_another_day(folder: Path) -> list[str]:
    tum = straight(folder / "t.tum", np.zeros(3), np.ones(3))
    (folder / "imu.csv").write_text("1000,0,0,0,0,0,9.8\n2000,0,0,0,0,0,9.8\n", encoding="utf-8")
    return ["--trajectory", str(tum), "--imu", str(folder / "imu.csv")]


def no_flight(folder: Path) -> list[str]:
    (folder / "empty").mkdir()
    return ["--trajectory", str(folder / "empty")]


def command_line(*arguments: str) -> Callable[[Path], list[str]]:
    return lambda folder: list(arguments)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (in_a_box, "inside box 0 of the corridor"),
        (out_of_the_scene, "leaves the corridor"),
        (command_line("--trajectory", "car"), "leaves the room"),
        (against_time, "t.tum, line 4: the clock runs backwards"),
        (frames_against_time, "frames.txt, line 2: the clock runs backwards"),
        (imu_of_another_day, "does not span the frames"),
        (no_flight, "holds no groundtruth_tum.txt"),
        (command_line("--trajectory", "nowhere.tum"), "there is no such file"),
        (command_line("--imu", "real.csv"), "needs its own recorded trajectory"),
        (command_line("--frame-times", "f.txt"), "need a recorded trajectory"),
        (command_line("--frame-times", "f.txt", "--rate", "5"), "exclude each other"),
        (command_line("--imu", "none"), "needs an IMU"),
        (command_line("--velocity", "paper"), "cannot contain body velocities"),
        (command_line("--format", "kitti", "--imu", "simulated"), "cannot contain an IMU"),
        (command_line("--format", "kitti", "--rig", "fisheye"), "needs a rectified rig"),
        (command_line("--effects", "noise,fog"), "no effect 'fog'"),
        (command_line("--set", "people=101"), "101 people cannot be placed"),
        (command_line("--set", "effects.read_nois=2"), "did you mean 'effects.read_noise'"),
        (command_line("--set", "effects.vignetting=2"), "between 0 and 1"),
        (command_line("--set", "faults.dropped=1"), "shares of the frames"),
        (command_line("--set", "effects.gamma"), "takes key=value"),
        (command_line("--set", "effects.gamma=[1"), "not valid YAML"),
        (command_line("--width", "3"), "choose a width"),
        (command_line("--rate", "0"), "choose a rate"),
        (command_line("--duration", "nan"), "cannot be rendered"),
        (command_line("--seed", "-1"), "must not be negative"),
        (command_line("--workers", "0"), "1 to 64"),
    ],
    ids=lambda value: value.__name__ if callable(value) and value.__name__ != "<lambda>" else None,
)
def test_rejects_bad_input_with_one_line_error_before_writing(
    arguments: Callable[[Path], list[str]],
    message: str,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    folder = tmp_path / "folder"
    folder.mkdir()
    given = arguments(tmp_path)
    assert render(folder / "out", *(() if "--width" in given else ("--width", "96")), *given) == 1
    error = capsys.readouterr().err
    assert message in error
    assert error.startswith("error: ")
    assert error.count("\n") == 1
    assert not list(folder.iterdir())


def _half_full(folder: Path) -> Path:
    (folder / "out").mkdir()
    (folder / "out" / "notes.txt").write_text("mine", encoding="utf-8")
    return folder / "out"


def _a_file(folder: Path) -> Path:
    (folder / "out").write_text("mine", encoding="utf-8")
    return folder / "out"


def _below_a_file(folder: Path) -> Path:
    return _a_file(folder) / "deeper"


@pytest.mark.parametrize(
    ("target", "message"),
    [
        (_half_full, "was not made by this program"),
        (_a_file, "not a folder"),
        (_below_a_file, "cannot write"),
    ],
)
def test_keeps_an_unusable_target_unchanged(
    target: Callable[[Path], Path], message: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = target(tmp_path)
    before = sorted(path.name for path in tmp_path.rglob("*"))
    assert render(out, *SMALL) == 1
    error = capsys.readouterr().err
    assert message in error
    assert error.count("\n") == 1
    assert sorted(path.name for path in tmp_path.rglob("*")) == before


COMMAND = [
    sys.executable,
    "-c",
    "import sys; from vio.cli import main; sys.exit(main())",
    "render",
    "--width",
    "200",
]


@pytest.mark.skipif(not hasattr(signal, "SIGXFSZ"), reason="needs POSIX file limits")
def test_full_disk_leaves_no_partial_output(tmp_path: Path) -> None:
    """Files are limited to 4 kB, which calibration and headers stay below and images do not."""
    import resource

    command = [
        *COMMAND,
        "--rig",
        "kitti",
        "--format",
        "kitti",
        "--duration",
        "0.2",
        "--out",
        str(tmp_path / "out"),
    ]
    done = subprocess.run(
        command,
        capture_output=True,
        text=True,
        cwd=ROOT,
        check=False,
        # Nor does the coverage of this command have room, where it is measured.
        env={name: value for name, value in os.environ.items() if not name.startswith("COVERAGE")},
        preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (4000, 4000)),
    )
    assert done.returncode == 1
    assert "choose a writable path with enough free space" in done.stderr
    said = [line for line in done.stderr.splitlines() if not line.startswith("NOTE")]
    assert len(said) == 1
    assert not list(tmp_path.iterdir())


@pytest.mark.skipif(os.name != "posix", reason="needs SIGKILL")
def test_a_killed_render_leaves_no_finished_folder(tmp_path: Path) -> None:
    out = tmp_path / "out"
    with subprocess.Popen(
        [*COMMAND, "--workers", "1", "--out", str(out)], cwd=ROOT, stderr=subprocess.DEVNULL
    ) as process:
        deadline = time.monotonic() + 300
        while not list(tmp_path.rglob("*.png")) and time.monotonic() < deadline:
            time.sleep(0.05)
        process.kill()
    assert list(tmp_path.rglob("*.png"))
    assert not out.exists()
    assert main(["run", str(out)]) == 1
