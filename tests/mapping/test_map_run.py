"""Runs with a map: the odometry stays as it is, resumed runs keep their map, localised ones
leave it alone.
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

import vio
from tests.commands import refused, render
from tests.filters.test_msckf import CAMERA, T_CAM0_IMU, Flight
from tests.runs.test_unfinished_runs import Stop
from vio.bench.maps import map_figures
from vio.cli import main
from vio.config import Config
from vio.datasets import open_dataset
from vio.errors import ConfigError, DataError
from vio.evaluation.trajectories import evaluate
from vio.files.trajectories import read_trajectory
from vio.filters.msckf import Msckf
from vio.geometry.lie import FloatArray, se3_exp, se3_inverse, se3_log
from vio.geometry.relative_pose import RelativePose
from vio.live.build import MapUse
from vio.mapping.builder import Keyframe, MapBuilder, MapUpdate
from vio.mapping.features import KeyframeFeatures
from vio.mapping.map_graph import MapGraph
from vio.mapping.map_store import LoopRow, MapStore
from vio.mapping.session import HANDOVER_FRAMES, MapSession
from vio.offline import inertial_adjustment
from vio.offline.map_adjustment import _sigmas_moved, adjust_map
from vio.records import (
    Estimate,
    FrameResult,
    LoopEvent,
    LoopMatches,
    MapKeyframes,
    Observations,
    StereoFrame,
    observations,
)
from vio.runs.finished import read_finished_run
from vio.runs.mapped import corrected, read_loops, write_loops
from vio.runs.pipeline import RunControl, RunResult, run
from vio.runs.recorder import GrowingFolder


@pytest.fixture(scope="module")
def flight(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A rendered flight as an EuRoC folder: 20 frames of 320 pixels with an IMU, over 2 s."""
    options = {"rig": "small", "width": "320", "rate": "10", "duration": "2", "format": "euroc"}
    return render(tmp_path_factory.mktemp("flight") / "flight", **options)


@pytest.fixture(scope="module")
def mapped(flight: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a run with a map, `yard.map` beside it."""
    folder = tmp_path_factory.mktemp("mapped")
    arguments = [
        "--map",
        str(folder / "yard.map"),
        "--out",
        str(folder / "run"),
        "--json",
        "--quiet",
    ]
    assert main(["run", str(flight), *arguments]) == 0
    return folder / "run"


def test_the_odometry_of_a_run_with_a_map_is_that_of_one_without(
    flight: Path, mapped: Path, tmp_path: Path
) -> None:
    assert main(["run", str(flight), "--out", str(tmp_path / "run"), "--json", "--quiet"]) == 0
    for name in ("trajectory.tum", "trajectory.kitti"):
        assert (mapped / name).read_bytes() == (tmp_path / "run" / name).read_bytes()
    assert (
        np.load(mapped / "estimates.npy").tobytes()
        == np.load(tmp_path / "run" / "estimates.npy").tobytes()
    )
    assert not list((tmp_path / "run").glob("map*"))


def test_a_run_with_a_map_writes_its_poses_and_its_metrics(mapped: Path) -> None:
    metrics = json.loads((mapped / "metrics.json").read_text())["map"]
    assert metrics["joined"]
    assert metrics["placed"] == 1.0
    assert metrics["keyframes"] >= 2
    odometry, final = (
        read_trajectory(mapped / f"{name}.tum") for name in ("trajectory", "map_trajectory")
    )
    assert len(final) == len(odometry)
    # there is no loop
    np.testing.assert_allclose(final.T_world_body, odometry.T_world_body, atol=1e-7)
    causal = read_trajectory(mapped / "map_causal.tum")
    covariance = np.load(mapped / "map_covariance.npy")
    assert len(causal) == len(covariance) == len(odometry)
    assert (np.linalg.eigvalsh(covariance)[1:] > 0).all()
    assert (mapped / "loops.csv").read_text().startswith("frame,time_ns,keyframe")
    finished = read_finished_run(mapped)
    assert finished.loops == ()
    keyframes = finished.map_keyframes
    assert len(keyframes.frame) == metrics["keyframes"]
    assert keyframes.own.all()
    place = np.searchsorted(finished.estimates["index"], keyframes.frame)
    np.testing.assert_allclose(keyframes.T_map_body, finished.mapped.T_world_body[place], atol=1e-9)


def test_loops_are_read_as_they_were_written(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    z, has_right = rng.uniform(0, 300, (2, 25, 4)), rng.random((2, 25)) < 0.5
    loops = (
        LoopEvent(
            90, 9 * 10**18 + 1, 3, 10**18, 25, 0.125, False, 12, True, LoopMatches(*z, *has_right)
        ),
        LoopEvent(95, 9 * 10**18 + 9, 4, 10**17, 0, 1e-3, True, None, False, None),
    )
    write_loops(tmp_path, loops)
    found = read_loops(tmp_path)
    assert found == loops
    np.testing.assert_array_equal(found[0].matches.z_frame, z[1])
    np.testing.assert_array_equal(found[0].matches.has_right_keyframe, has_right[0])
    (tmp_path / "loops.csv").write_text("frame,time_ns\n1,2\n")
    with pytest.raises(DataError, match="is damaged"):
        read_loops(tmp_path)


def test_a_run_goes_on_to_the_same_map(flight: Path, mapped: Path, tmp_path: Path) -> None:
    folder, path = GrowingFolder(tmp_path / "run", {}), tmp_path / "yard.map"
    first = run(
        open_dataset(flight),
        Config(),
        map=MapUse(path),
        control=RunControl(folder, should_stop=Stop(10)),
    )
    assert 5 < len(first.frames) < 20
    second = run(
        open_dataset(flight), Config(), map=MapUse(path), control=RunControl(folder, resume=True)
    )
    final = read_trajectory(mapped / "map_trajectory.tum")
    np.testing.assert_allclose(second.mapped.T_map_body, final.T_world_body, atol=1e-8)
    rows = [
        [(r.frame, r.T_map_cam.tobytes()) for r in MapStore(p, read_only=True).keyframes()]
        for p in (path, mapped.parent / "yard.map")
    ]
    assert rows[0] == rows[1]


def test_localising_finds_the_place_and_leaves_the_map(
    flight: Path, mapped: Path, tmp_path: Path
) -> None:
    path = mapped.parent / "yard.map"
    before = path.read_bytes()
    arguments = [
        "--map",
        str(path),
        "--out",
        str(tmp_path / "run"),
        "--json",
        "--quiet",
        "--start",
        "2",
    ]
    assert main(["localise", str(flight), *arguments]) == 0
    assert path.read_bytes() == before
    metrics = json.loads((tmp_path / "run" / "metrics.json").read_text())["map"]
    assert metrics["joined"]
    # The world of this run begins at frame 2, the map's at frame 0.
    expected = read_trajectory(mapped / "trajectory.tum").T_world_body[2:]
    found = read_trajectory(tmp_path / "run" / "map_trajectory.tum").T_world_body
    assert np.abs(se3_log(se3_inverse(expected) @ found)[:, :3]).max() < 0.05


def test_maps_are_shown_and_merged(
    flight: Path, mapped: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path, out, darker = mapped.parent / "yard.map", tmp_path / "both.map", tmp_path / "darker"
    shutil.copytree(flight, darker)
    for image in darker.rglob("*.png"):  # another recording of the place, not the same one twice
        cv2.imwrite(
            str(image), (0.8 * cv2.imread(str(image), cv2.IMREAD_GRAYSCALE)).astype(np.uint8)
        )
    arguments = [
        "--map",
        str(tmp_path / "other.map"),
        "--out",
        str(tmp_path / "other"),
        "--json",
        "--quiet",
    ]
    assert main(["run", str(darker), *arguments]) == 0
    capsys.readouterr()
    assert (
        main(["map", "merge", str(path), str(tmp_path / "other.map"), "--out", str(out), "--json"])
        == 0
    )
    merged = json.loads(capsys.readouterr().out)
    swapped = tmp_path / "swapped.map"
    swap = [
        "map",
        "merge",
        str(tmp_path / "other.map"),
        str(path),
        "--out",
        str(swapped),
        "--workers",
    ]
    assert main([*swap, "0"]) == 1
    assert "--workers takes 1 to 64 processes, got 0" in capsys.readouterr().err
    assert main([*swap, "3"]) == 0
    capsys.readouterr()
    with (
        closing(MapStore(out, read_only=True)) as one,
        closing(MapStore(swapped, read_only=True)) as other,
    ):
        for rows in ("sessions", "keyframes", "odometry", "loops"):
            assert repr(getattr(one, rows)()) == repr(getattr(other, rows)())
    assert main(["map", "show", str(path), "--json"]) == 0
    single = json.loads(capsys.readouterr().out)
    assert merged["keyframes"] > single["keyframes"] > 0
    assert [s["joined"] for s in merged["sessions"]] == [True, True]
    assert main(["map", "show", str(out)]) == 0
    assert "session 1" in capsys.readouterr().out
    assert main(["map", "merge", str(path), str(path), "--out", str(out)]) == 1
    assert "exists; give another name" in capsys.readouterr().err
    assert main(["map", "merge", str(path), str(path), "--out", str(tmp_path / "twice.map")]) == 1
    assert "is the same map as" in capsys.readouterr().err
    lost = tmp_path / "nowhere" / "both.map"
    assert main(["map", "merge", str(path), str(tmp_path / "other.map"), "--out", str(lost)]) == 1
    assert f"{lost}: its folder {lost.parent} does not exist" in capsys.readouterr().err
    assert main(["map", "show", str(tmp_path)]) == 1
    assert "is a folder; a map is one file" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["localise", "{flight}", "--map", "{none}"], "there is no such map; vio run --map"),
        (
            ["run", "{flight}", "--map", "{none}", "--backend", "vislam"],
            "a map needs the back end msckf",
        ),
        (
            ["run", "{log}", "--map", "{none}"],
            "a map is made of images, and this recording has features only",
        ),
    ],
)
def test_what_no_map_can_be_made_of_is_refused_in_a_line(
    arguments: list[str],
    message: str,
    flight: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    log = tmp_path / "run" / "observations.npz"
    if "{log}" in arguments:
        assert (
            main(
                [
                    "run",
                    str(flight),
                    "--out",
                    str(log.parent),
                    "--save-observations",
                    "--stop",
                    "3",
                    "--json",
                ]
            )
            == 0
        )
    names = {"{flight}": str(flight), "{none}": str(tmp_path / "none.map"), "{log}": str(log)}
    out = str(tmp_path / "refused")
    error = refused(
        capsys, *([names.get(a, a) for a in arguments] + ["--out", out, "--quiet", "--json"])
    )
    assert message in error
    assert not (tmp_path / "none.map").exists()


def test_live_estimates_have_their_pose_in_the_map(
    flight: Path, mapped: Path, tmp_path: Path
) -> None:
    dataset = open_dataset(flight)
    recording = dataset.recording
    config = replace(Config(), motion="none")
    path = tmp_path / "live.map"
    results: list[FrameResult] = []
    options = {"T_cam0_imu": recording.T_cam0_imu, "map": path, "on_frame": results.append}
    with vio.Odometry(recording.camera, config, **options) as odometry:
        for event in dataset.events(0, 6):
            if isinstance(event, StereoFrame):
                estimate = odometry.add_stereo(event.time_ns, event.left, event.right)
                np.testing.assert_allclose(estimate.T_map_body, estimate.T_world_imu, atol=1e-12)
        assert odometry.loops == ()
        assert [r.is_keyframe for r in results][:2] == [True, False]
        odometry.reset()  # a new session of the map
    assert len(MapStore(path, read_only=True).keyframes()) >= 1
    with pytest.raises(ConfigError, match="a map needs the back end msckf"):
        vio.Odometry(recording.camera, replace(config, backend="vislam"), map=path)


def _motions(seed: int) -> tuple[FloatArray, FloatArray]:
    """Normalised squared errors of motions over the filter's window, and of two joined motions."""
    flight, rng = Flight(frames=16), np.random.default_rng(seed)
    filter_ = Msckf(CAMERA, T_CAM0_IMU, Config().msckf, motion=None)
    for k in range(16):
        filter_.update(flight.observe(k, 0.5, rng))
    whole = filter_.relative(6, 15)
    truth = se3_inverse(flight.T_world_imu(6)) @ flight.T_world_imu(15)
    r = se3_log(se3_inverse(whole.T_i_j) @ truth)
    parts = [filter_.relative(6, 10), filter_.relative(10, 15)]
    joined = parts[0].then(parts[1]).T_i_j
    return np.array(r @ np.linalg.solve(whole.covariance, r)), se3_log(
        se3_inverse(whole.T_i_j) @ joined
    )


def test_motions_between_frames_of_the_window_are_consistent() -> None:
    squared, gaps = zip(*(_motions(seed) for seed in range(6)), strict=True)
    assert np.abs(gaps).max() < 1e-9
    assert 2.0 < np.mean(squared) < 12.0  # of 6 degrees of freedom, 6 runs


def test_motions_beyond_the_window_are_not_known() -> None:
    flight, rng = Flight(frames=16), np.random.default_rng(0)
    filter_ = Msckf(CAMERA, T_CAM0_IMU, Config().msckf, motion=None)
    assert filter_.relative(0, 0) is None
    for k in range(16):
        filter_.update(flight.observe(k, 0.5, rng))
    assert filter_.relative(0, 15) is None
    assert filter_.relative(15, 16) is None


def test_motions_are_joined_where_the_window_moves_on(tmp_path: Path) -> None:
    """Eight frames between two keyframes, and a filter that knows the motion over three only."""
    steps = se3_exp(np.random.default_rng(0).normal(0, 0.1, (9, 6)))
    poses = [np.eye(4)]
    for step in steps[:-1]:
        poses.append(poses[-1] @ step)

    def relative(older: int, newer: int) -> RelativePose | None:
        if newer - older > 3:
            return None
        return RelativePose(
            se3_inverse(poses[older]) @ poses[newer], max(newer - older, 0) * np.eye(6)
        )

    session = MapSession(
        tmp_path / "a.map", CAMERA, np.eye(4), source="made up", imu=False, localise=False
    )
    gray = np.zeros((64, 64), dtype=np.uint8)
    for k in range(9):
        ids = np.arange(40) + 1000 * (k == 8)
        seen = observations(k, k, ids, np.tile([9.0, 9, 5, 9], (40, 1)))
        session.frame(
            StereoFrame(k, k, gray, gray), seen, Estimate(k, poses[k], np.eye(6)), relative
        )
    session.finish()
    session.close()
    ((first, second, motion),) = MapStore(tmp_path / "a.map", read_only=True).odometry()
    assert (first, second) == (0, 1)
    np.testing.assert_allclose(motion.T_i_j, poses[8], atol=1e-12)
    assert np.linalg.eigvalsh(motion.covariance)[0] > 7.0, "of eight steps of unit variance each"


@pytest.mark.parametrize("wrong", [8, 10])
def test_a_motion_does_not_follow_a_frame_that_the_filter_takes_back(
    wrong: int, tmp_path: Path
) -> None:
    """Its window is half a metre off as of one frame, the keyframe itself or one after it, and
    right again.
    """
    session = MapSession(
        tmp_path / "a.map", CAMERA, np.eye(4), source="made up", imu=False, localise=False
    )
    step, gray = se3_exp([0.0, 0.0, 0.05, 0.0, 0.01, 0.0]), np.zeros((64, 64), dtype=np.uint8)
    for k in range(16):
        off = [0.5 * (k == wrong), 0.0, 0.0, 0.0, 0.0, 0.0]

        def relative(older: int, newer: int, off: list[float] = off) -> RelativePose:
            n = newer - older
            return RelativePose(
                np.linalg.matrix_power(step, n) @ se3_exp(np.multiply(off, n > 0)), 1e-6 * np.eye(6)
            )

        ids = np.arange(40) + 1000 * (k >= 8)
        seen = observations(k, 10**8 * k, ids, np.tile([9.0, 9, 5, 9], (40, 1)))
        estimate = Estimate(k, np.linalg.matrix_power(step, k) @ se3_exp(off), 1e-4 * np.eye(6))
        session.frame(StereoFrame(k, 10**8 * k, gray, gray), seen, estimate, relative)
    session.finish()
    session.close()
    ((_, _, motion),) = MapStore(tmp_path / "a.map", read_only=True).odometry()
    np.testing.assert_allclose(motion.T_i_j, np.linalg.matrix_power(step, 8), atol=1e-9)


@pytest.mark.parametrize("alone", [False, True])
def test_what_a_covered_camera_does_to_the_place(alone: bool, tmp_path: Path) -> None:
    """Ten dark frames of 0.1 s, which the filter's window does not hold: the covariance grows as
    the filter's own.

    Without a motion sensor the motion is not known after them.
    """

    def relative(older: int, newer: int) -> RelativePose | None:
        return (
            None
            if 12 <= newer < 22
            else RelativePose(np.eye(4), 1e-4 * (newer - older) * np.eye(6))
        )

    session = MapSession(
        tmp_path / "a.map",
        CAMERA,
        np.eye(4),
        source="made up",
        imu=False,
        localise=False,
        alone=alone,
    )
    gray, sigmas = np.zeros((64, 64), dtype=np.uint8), []
    for k in range(24):
        count = 0 if 12 <= k < 22 else 40
        ids = np.arange(count) + 1000 * (k == 23)
        seen = observations(k, 10**8 * k, ids, np.tile([9.0, 9, 5, 9], (count, 1)))
        estimate = Estimate(k, np.eye(4), (1e-6 + 1e-2 * np.clip(k - 11, 0, 10)) * np.eye(6))
        session.frame(StereoFrame(k, 10**8 * k, gray, gray), seen, estimate, relative)
        covariance = session.covariance
        sigmas.append(np.nan if covariance is None else float(np.sqrt(covariance[0, 0])))
    session.finish()
    session.close()
    np.testing.assert_allclose(sigmas[15] ** 2 - sigmas[11] ** 2, 0.04, rtol=1e-3)
    np.testing.assert_allclose(
        sigmas[21] ** 2 - sigmas[11] ** 2, 30.0**2 if alone else 0.1, rtol=1e-3
    )
    ((_, _, motion),) = MapStore(tmp_path / "a.map", read_only=True).odometry()
    assert (np.sqrt(motion.covariance[0, 0]) >= 30.0) is np.bool_(alone)


@pytest.mark.parametrize("waits", [False, True])
def test_a_place_that_waits_for_a_second_keyframe_gets_one_soon(
    waits: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A session without a place, which moves so slowly that one keyframe would do."""
    session = MapSession(
        tmp_path / "a.map", CAMERA, np.eye(4), source="made up", imu=False, localise=False
    )
    made = list[int]()

    def add(self: MapBuilder, keyframe: Keyframe, features: KeyframeFeatures) -> MapUpdate:
        made.append(keyframe.frame)
        return MapUpdate(None, None, None, (), unconfirmed=waits and len(made) == 1)

    monkeypatch.setattr(MapBuilder, "add", add)
    monkeypatch.setattr(MapBuilder, "finish", lambda self, field: MapUpdate(None, None, None, ()))
    for k in range(40):
        _stand(session, observations(k, 10**8 * k, np.arange(40), np.tile([9.0, 9, 5, 9], (40, 1))))
    session.finish()
    session.close()
    assert made == ([0, 10, 13, 16, 19] if waits else [0])


def test_a_place_does_not_follow_a_jump_of_the_filter(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A filter that learns what it was off by moves its newest pose by half a metre, and no
    motion of its window.
    """
    session = MapSession(
        tmp_path / "a.map", CAMERA, T_CAM0_IMU, source="made up", imu=False, localise=False
    )
    T_map_cam, covariance = se3_exp([3.0, 0.0, 1.0, 0.0, 0.2, 0.0]), 1e-4 * np.eye(6)
    update = MapUpdate(np.eye(4), T_map_cam, covariance, ())
    monkeypatch.setattr(MapBuilder, "add", lambda self, keyframe, features: update)
    step, gray = se3_exp([0.0, 0.0, 0.05, 0.0, 0.01, 0.0]), np.zeros((64, 64), dtype=np.uint8)
    for k in range(16):
        motion = np.linalg.matrix_power(step, k)
        jump = se3_exp([0.5, 0.0, 0.0, 0.0, 0.1, 0.0]) if k > 12 else np.eye(4)
        estimate = Estimate(k, jump @ motion @ se3_exp([0.1, 0, 0, 0, 0, 0]), 1e-4 * np.eye(6))
        seen = observations(k, 10**8 * k, np.arange(40), np.tile([9.0, 9, 5, 9], (40, 1)))

        def relative(older: int, newer: int) -> RelativePose:
            return RelativePose(
                np.linalg.matrix_power(step, newer - older), 1e-6 * (newer - older) * np.eye(6)
            )

        session.frame(StereoFrame(k, 10**8 * k, gray, gray), seen, estimate, relative)
        if k >= HANDOVER_FRAMES:
            expected = T_map_cam @ T_CAM0_IMU @ motion
            np.testing.assert_allclose(
                session.T_map_odom @ estimate.T_world_imu, expected, atol=1e-9
            )
    session.close()


def _stand(session: MapSession, seen: Observations) -> None:
    """Give a session a frame of a rig that stands."""
    gray, k = np.zeros((64, 64), dtype=np.uint8), seen.frame_index
    session.frame(
        StereoFrame(k, seen.time_ns, gray, gray),
        seen,
        Estimate(k, np.eye(4), np.eye(6)),
        lambda older, newer: RelativePose(np.eye(4), 1e-4 * (newer - older) * np.eye(6)),
    )


def test_few_features_are_no_darkness(tmp_path: Path) -> None:
    """Ten features for a second are too few for a keyframe, and enough for images alone to
    follow.
    """
    session = MapSession(
        tmp_path / "a.map",
        CAMERA,
        np.eye(4),
        source="made up",
        imu=False,
        localise=False,
        alone=True,
    )
    for k in range(24):
        count = 10 if 12 <= k < 22 else 40
        seen = observations(
            k, 10**8 * k, np.arange(count) + 1000 * (k == 23), np.tile([9.0, 9, 5, 9], (count, 1))
        )
        _stand(session, seen)
    session.finish()
    session.close()
    ((_, _, motion),) = MapStore(tmp_path / "a.map", read_only=True).odometry()
    assert np.sqrt(motion.covariance[0, 0]) < 1.0


def test_an_odometry_of_few_features_has_keyframes_too(tmp_path: Path) -> None:
    """Where the front end is set to 24 features, no frame has thirty."""
    session = MapSession(
        tmp_path / "a.map", CAMERA, np.eye(4), source="made up", imu=False, localise=False
    )
    for k in range(6):
        seen = observations(k, 10**8 * k, np.arange(24) + 12 * k, np.tile([9.0, 9, 5, 9], (24, 1)))
        _stand(session, seen)
    session.finish()
    session.close()
    store = MapStore(tmp_path / "a.map", read_only=True)
    assert len(store.keyframes()) == 6
    store.close()


def test_a_map_begins_where_the_images_show_something(tmp_path: Path) -> None:
    """A lens cap that stays on for half a second."""
    session = MapSession(
        tmp_path / "a.map", CAMERA, np.eye(4), source="made up", imu=False, localise=False
    )
    for k in range(12):
        count = 40 if k >= 5 else 0
        ids = np.arange(count) + 30 * k
        _stand(session, observations(k, 10**8 * k, ids, np.tile([9.0, 9, 5, 9], (count, 1))))
    session.finish()
    session.close()
    with closing(MapStore(tmp_path / "a.map", read_only=True)) as store:
        assert [row.frame for row in store.keyframes()] == list(range(5, 12))


def test_a_session_without_a_keyframe_leaves_the_map_to_the_next_one(tmp_path: Path) -> None:
    path = tmp_path / "a.map"
    for frames in (0, 1):
        session = MapSession(path, CAMERA, np.eye(4), source="dark", imu=False, localise=False)
        for k in range(frames):
            _stand(session, observations(k, k, np.zeros(0, dtype=np.int64), np.zeros((0, 4))))
        session.finish()
        assert len(session.map_keyframes().frame) == 0
        np.testing.assert_array_equal(session.T_map_odom, np.eye(4))
        session.close()
    session = MapSession(path, CAMERA, np.eye(4), source="light", imu=False, localise=False)
    for k in range(12):
        seen = observations(k, k, np.arange(40) + 30 * k, np.tile([9.0, 9, 5, 9], (40, 1)))
        _stand(session, seen)
    session.finish()
    assert session.is_joined
    np.testing.assert_allclose(session.T_map_odom, np.eye(4), atol=1e-9)
    session.close()
    with closing(MapStore(path, read_only=True)) as store:
        assert [row.source for row in store.sessions()] == ["light"]


def test_motions_have_errors_that_tracks_do_not_average_out(tmp_path: Path) -> None:
    """A filter that is sure to a micrometre of a metre: the calibration is not."""
    steps = [np.eye(4), se3_exp([0.0, 0, 1.0, 0, 0.5, 0])]

    def relative(older: int, newer: int) -> RelativePose | None:
        return RelativePose(se3_inverse(steps[older]) @ steps[newer], 1e-12 * np.eye(6))

    session = MapSession(
        tmp_path / "a.map", CAMERA, np.eye(4), source="made up", imu=False, localise=False
    )
    gray = np.zeros((64, 64), dtype=np.uint8)
    for k in range(2):
        seen = observations(k, k, np.arange(40) + 1000 * k, np.tile([9.0, 9, 5, 9], (40, 1)))
        session.frame(
            StereoFrame(k, k, gray, gray), seen, Estimate(k, steps[k], np.eye(6)), relative
        )
    session.finish()
    session.close()
    ((_, _, motion),) = MapStore(tmp_path / "a.map", read_only=True).odometry()
    sigma = np.sqrt(np.diag(motion.covariance))
    np.testing.assert_allclose(sigma, np.repeat([5e-4, 1e-4], 3), rtol=0.05)


def test_where_the_filter_began_anew_the_motion_is_not_known(tmp_path: Path) -> None:
    def relative(older: int, newer: int) -> RelativePose | None:
        return None if older < 5 <= newer else RelativePose(np.eye(4), 1e-6 * np.eye(6))

    session = MapSession(
        tmp_path / "a.map", CAMERA, np.eye(4), source="made up", imu=False, localise=False
    )
    gray = np.zeros((64, 64), dtype=np.uint8)
    for k in range(9):
        seen = observations(k, k, np.arange(40) + 1000 * (k == 8), np.tile([9.0, 9, 5, 9], (40, 1)))
        session.frame(
            StereoFrame(k, k, gray, gray), seen, Estimate(k, np.eye(4), np.eye(6)), relative
        )
    session.finish()
    session.close()
    ((_, _, motion),) = MapStore(tmp_path / "a.map", read_only=True).odometry()
    assert np.sqrt(motion.covariance[0, 0]) >= 30.0


def test_corrections_are_spread_between_keyframes() -> None:
    T_odom = se3_exp(np.random.default_rng(1).normal(0, 0.5, (11, 6)))
    frames = np.array([2, 6])
    T_map = se3_exp([[1.0, 0, 0, 0, 0, 0.1], [1.2, 0.1, 0, 0, 0, 0.2]]) @ T_odom[frames]
    out = corrected(T_odom, np.arange(11), frames, T_map, T_odom[frames])
    np.testing.assert_allclose(out[frames], T_map, atol=1e-12)
    for k, keyframe in ((0, 2), (10, 6)):  # outside, they move with the nearest keyframe
        np.testing.assert_allclose(
            se3_inverse(out[keyframe]) @ out[k],
            se3_inverse(T_odom[keyframe]) @ T_odom[k],
            atol=1e-12,
        )
    jumps = [
        se3_log(se3_inverse(T_odom[k]) @ T_odom[k + 1] @ se3_inverse(out[k + 1]) @ out[k])
        for k in range(2, 6)
    ]
    assert np.linalg.norm(jumps, axis=1).max() < 0.4, "no frame takes the whole correction"


# --- adjustment with the IMU
# ------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def looped(flight: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[RunResult, Path]:
    """A run with an IMU, whose first and last keyframe a loop joins, and its map."""
    path = tmp_path_factory.mktemp("looped") / "yard.map"
    result = run(open_dataset(flight), Config(), map=MapUse(path), keep_observations=True)
    assert result.mapped.adjustment is None
    frames = result.mapped.in_map.frame.tolist()
    first, last = (result.observations[k] for k in (frames[0], frames[-1]))
    shared = np.intersect1d(first.ids[first.has_right], last.ids[last.has_right])
    assert len(shared) > 20
    a, b = (o.take(np.isin(o.ids, shared)) for o in (first, last))
    matches = LoopMatches(a.z, b.z, a.has_right, b.has_right)
    loop = LoopEvent(
        frames[-1],
        last.time_ns,
        0,
        first.time_ns,
        len(shared),
        0.01,
        False,
        frames[0],
        True,
        matches,
    )
    with closing(MapStore(path)) as store:
        T = result.mapped.in_map.T_map_body @ se3_inverse(result.T_cam0_body)
        pose = RelativePose(se3_inverse(T[0]) @ T[-1], 1e-4 * np.eye(6))
        store.add_loop(LoopRow(0, len(frames) - 1, pose, len(shared), kept=True))
        store.commit()
    return replace(result, mapped=replace(result.mapped, loops=(loop,))), path


def _copied(looped: tuple[RunResult, Path], tmp_path: Path) -> tuple[RunResult, Path]:
    return looped[0], Path(shutil.copy(looped[1], tmp_path / "yard.map"))


def _poses(path: Path) -> FloatArray:
    with closing(MapStore(path, read_only=True)) as store:
        return np.array([row.T_map_cam for row in store.keyframes()])


def test_a_map_with_loops_is_adjusted_with_the_imu(
    looped: tuple[RunResult, Path], tmp_path: Path
) -> None:
    result, path = _copied(looped, tmp_path)
    before = _poses(path)
    done = adjust_map(result, path).mapped
    assert done.adjustment.startswith("with the IMU at ")
    in_map = done.in_map
    np.testing.assert_allclose(_poses(path) @ result.T_cam0_body, in_map.T_map_body, atol=1e-12)
    assert np.abs(_poses(path) - before).max() > 1e-5
    np.testing.assert_allclose(done.T_map_body[np.searchsorted(result.estimates.column("index"), in_map.frame)],
                               in_map.T_map_body, atol=1e-12)  # fmt: skip
    sigma = np.sqrt(np.trace(in_map.covariance[:, :3, :3], axis1=1, axis2=2))
    assert (sigma[1:] > 1e-5).all()
    assert sigma.max() < 0.1
    truth = result.recording.reference
    errors = [evaluate(replace(result.trajectory, T_world_body=T), truth, T_cam0_imu=result.T_cam0_body).ate_m.rmse
              for T in (result.mapped.T_map_body, done.T_map_body)]  # type: ignore[union-attr]  # fmt: skip
    assert errors[1] < max(1.5 * errors[0], 0.003)
    # A later session that optimises the map leaves it where it is.
    with closing(MapStore(path, read_only=True)) as store:
        graph = MapGraph(store)
    graph.optimise_part(0)
    np.testing.assert_allclose(graph.T_map_cam.rows, _poses(path), atol=1e-6)


def test_the_errors_of_a_map_are_normalised_relative_to_its_first_keyframe(
    looped: tuple[RunResult, Path],
) -> None:
    result, path = looped
    truth = result.recording.reference
    score = evaluate(result.trajectory, truth, T_cam0_imu=result.T_cam0_body)
    found = map_figures(result, score, truth, store=path, T_ref_map=None, covered=())
    assert found["map_nees_95"] < 60, (
        "the first poses known at the time have covariances of next to nothing"
    )
    assert "map_nees" not in map_figures(
        replace(result, mapped=replace(result.mapped, loops=())),  # type: ignore[type-var]
        score, truth, store=path, T_ref_map=None, covered=(),
    )  # fmt: skip


def test_a_map_that_turns_as_a_whole_has_not_moved() -> None:
    """Its covariance is relative to the first keyframe's position and yaw: a centimetre is a
    standard deviation.

    How the first keyframe is inclined is no matter of choice: that it alone tilts has not moved the
    others.
    """
    T = se3_exp(np.random.default_rng(0).normal(0, 1, (5, 6)))
    P = np.broadcast_to(1e-4 / 6 * np.eye(6), (5, 6, 6))
    in_map = MapKeyframes(*3 * (np.arange(5),), np.ones(5, dtype=np.bool_), T, P)
    turned = se3_exp([1.0, 2.0, 3.0, 0.0, 0.0, 0.3]) @ T
    assert _sigmas_moved(in_map, turned) < 1e-9
    tilted = turned.copy()
    # about a horizontal axis of the world
    tilted[0] = tilted[0] @ se3_exp([0, 0, 0, *tilted[0][0, :3] * 0.05])
    assert _sigmas_moved(in_map, tilted) < 1e-3
    turned[1:] = turned[1:] @ se3_exp([0.01, 0, 0, 0, 0, 0])
    np.testing.assert_allclose(_sigmas_moved(in_map, turned), 1.0)


@pytest.mark.parametrize(
    ("what", "words"),
    [
        ("interrupted", "not with the IMU: interrupted"),
        ("keyframes", "it would need 10 keyframes, 3 at most"),
        ("others", "the map has keyframes of other sessions"),
        ("certain", "of the map's standard deviations: one of them is wrong"),
        ("unobserved", "the run has not kept what it observed"),
        ("no optimum", "it did not converge"),
    ],
)
def test_a_map_that_is_not_adjusted_stays_as_it_is(
    what: str,
    words: str,
    looped: tuple[RunResult, Path],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    result, path = _copied(looped, tmp_path)
    mapped = result.mapped
    before = _poses(path)
    asked = iter([None] * 3)
    reason = {"interrupted": lambda: next(asked, "interrupted")}.get(what, lambda: None)
    in_map = mapped.in_map
    if what == "others":
        mapped = replace(mapped, in_map=replace(in_map, own=np.arange(len(in_map.own)) > 0))
    if what == "certain":
        mapped = replace(mapped, in_map=replace(in_map, covariance=1e-6 * in_map.covariance))
    if what == "keyframes":
        monkeypatch.setattr("vio.offline.map_adjustment.MAX_KEYFRAMES", 3)
    if what == "no optimum":
        few = replace(inertial_adjustment._ADJUSTMENT, max_steps=3)
        monkeypatch.setattr(inertial_adjustment, "_ADJUSTMENT", few)
    result = replace(
        result, mapped=mapped, observations=None if what == "unobserved" else result.observations
    )
    done = adjust_map(result, path, reason).mapped
    assert words in (done.adjustment or "")
    assert done.T_map_body is mapped.T_map_body
    np.testing.assert_array_equal(_poses(path), before)


@pytest.mark.parametrize("change", ["no loop", "images alone", "ended early"])
def test_without_loops_or_imu_there_is_nothing_to_adjust(
    change: str, looped: tuple[RunResult, Path], tmp_path: Path
) -> None:
    result, path = _copied(looped, tmp_path)
    before = path.read_bytes()
    changed = {
        "no loop": replace(result, mapped=replace(result.mapped, loops=())),
        "images alone": replace(result, motion=None),
        "ended early": replace(result, stopped="interrupted"),
    }[change]
    assert adjust_map(changed, path) is changed
    assert path.read_bytes() == before


def test_a_run_says_in_its_summary_what_became_of_the_adjustment(
    flight: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    def adjusted(result: RunResult, path: Path, should_stop: Callable[[], str | None]) -> RunResult:
        assert result.observations is not None
        assert should_stop() is None
        assert path == tmp_path / "yard.map"
        return replace(result, mapped=replace(result.mapped, adjustment="in jest"))

    monkeypatch.setattr("vio.offline.map_adjustment.adjust_map", adjusted)
    arguments = [
        "--map",
        str(tmp_path / "yard.map"),
        "--out",
        str(tmp_path / "run"),
        "--quiet",
        "--no-plot",
    ]
    assert main(["run", str(flight), "--stop", "8", *arguments]) == 0
    assert "adjusted in jest" in capsys.readouterr().out
    assert (
        json.loads((tmp_path / "run" / "metrics.json").read_text())["map"]["adjustment"]
        == "in jest"
    )
    assert not (tmp_path / "run" / "observations.npz").exists()


def test_the_covariance_of_a_map_has_the_scale_that_its_rig_leaves_open(mapped: Path) -> None:
    keyframes = read_finished_run(mapped).map_keyframes
    T = keyframes.T_map_body
    away = np.linalg.norm(T[:, :3, 3] - T[0, :3, 3], axis=1)
    sigma = np.sqrt(np.linalg.eigvalsh(keyframes.covariance[:, :3, :3])[:, -1])
    # those of the baseline and of the focal length
    assert (sigma >= 0.99 * np.hypot(0.005, 0.003) * away).all()
    (mapped / "map_keyframes_covariance.npy").rename(mapped / "moved.npy")
    # as of an older version
    assert np.isnan(read_finished_run(mapped).map_keyframes.covariance).all()
    np.save(mapped / "map_keyframes_covariance.npy", np.zeros(3))
    with pytest.raises(DataError, match="is damaged"):
        read_finished_run(mapped)
    (mapped / "moved.npy").rename(mapped / "map_keyframes_covariance.npy")
