"""An IMU in a wrong unit or with wrong axes: the frames so far are estimated again, with what is
left of it.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.monitor.test_inertial_check import Watched, _recording
from vio import evaluate, load_config, run
from vio.errors import DivergedError
from vio.findings import INTEGRITIES
from vio.geometry.lie import so3_exp
from vio.imu.findings import ImuVerdict, InertialFinding
from vio.live.imu_trial import ImuTrial
from vio.live.odometry import Odometry
from vio.records import (
    Estimate,
    Event,
    FrameResult,
    ImuSample,
    Observations,
    Recording,
    StereoFrame,
    Trajectory,
    UpdateReport,
)
from vio.runs.pipeline import RunControl, RunResult
from vio.runs.recorder import GrowingFolder

FRAMES = 110


def _changed(sample: ImuSample, gyro: float, accel: float, axes: list[int]) -> ImuSample:
    return ImuSample(sample.time_ns, gyro * sample.gyro[axes], accel * sample.accel[axes])


@dataclass(frozen=True)
class _Features:
    """Features and IMU samples of a flight as a recording."""

    it: Watched
    samples: list[ImuSample]
    recording: Recording

    def events(
        self, start: int = 0, stop: int | None = None, *, images: bool = True
    ) -> Iterator[Event]:
        frames = [
            StereoFrame(seen.frame_index, seen.time_ns, None, None)
            for seen in self.it.frames[start:FRAMES]
        ]
        yield from sorted(
            [*self.samples, *frames], key=lambda e: (e.time_ns, isinstance(e, StereoFrame))
        )

    def observations(self, index: int) -> Observations | None:
        return self.it.frames[index]


def _flight(
    gyro: float = 1.0, accel: float = 1.0, axes: tuple[int, int, int] = (0, 1, 2)
) -> _Features:
    it = _recording("room")
    times = np.array([seen.time_ns for seen in it.frames[:FRAMES]])
    samples = [
        _changed(s, gyro, accel, list(axes))
        for s in it.samples
        if s.time_ns <= times[-1] + 10_000_000
    ]
    sensors = frozenset({"imu"})
    recording = Recording(
        "fake", Path("flight"), it.camera, it.T_cam0_imu, times, False, sensors, None
    )  # type: ignore[arg-type]
    return _Features(it, samples, recording)


def _run(
    flight: _Features, motion: str = "imu", folder: Path | None = None, *settings: str
) -> RunResult:
    control = RunControl() if folder is None else RunControl(GrowingFolder(folder, {}))
    return run(flight, load_config(overrides=[f"motion={motion}", *settings]), control=control)


@pytest.fixture(scope="module")
def alone() -> Trajectory:
    return _run(_flight(), "none").trajectory


@pytest.fixture(scope="module")
def as_recorded() -> RunResult:
    return _run(_flight())


def _worst_m(found: Trajectory, expected: Trajectory) -> float:
    assert len(found.T_world_body) == len(expected.T_world_body)
    return evaluate(found, expected).ate_m.max


@pytest.mark.parametrize(
    ("gyro", "accel"), [(180 / np.pi, 1.0), (1.0, 1 / 9.80665)], ids=["deg/s", "g"]
)
def test_a_unit_is_applied_from_the_start(
    gyro: float, accel: float, as_recorded: RunResult, tmp_path: Path
) -> None:
    result = _run(_flight(gyro, accel), folder=tmp_path / "run")
    assert _worst_m(result.trajectory, as_recorded.trajectory) < 0.01
    first, last = [line for line in result.warnings if "estimated again" in line]
    assert "is not used until" in first
    assert "readings are multiplied by" in last
    for table in (result.estimates, result.frames):
        assert np.all(np.array(table.column("integrity")) == INTEGRITIES.index("nominal"))
    written = (tmp_path / "run" / "trajectory.tum").read_text().splitlines()
    assert sum(not row.startswith("#") for row in written) == FRAMES
    assert np.allclose(
        np.array(written[-FRAMES].split()[1:4], float), result.trajectory.positions[0], atol=1e-6
    )


def test_without_a_factor_images_alone_go_on(alone: Trajectory) -> None:
    """Not one pose of the frames before the verdict is left of the estimate that was lost."""
    result = _run(_flight(axes=(1, 0, 2)))
    assert _worst_m(result.trajectory, alone) < 0.03
    first, last = [line for line in result.warnings if "estimated again" in line]
    assert "is not used until" in first
    assert "the IMU is not used, and images alone go on" in last


def test_gravity_that_is_set_to_another_planets_is_named(alone: Trajectory) -> None:
    """The filter diverged, and clocks, axes and the baseline were blamed."""
    result = _run(_flight(), "imu", None, "imu.gravity_mps2=3.7")
    assert _worst_m(result.trajectory, alone) < 0.03
    (line,) = [line for line in result.warnings if "leave out the setting" in line]
    assert "gravity is set to 3.7 m/s^2 (imu.gravity_mps2)" in line


class _Shown:
    """What a run shows of each frame, before later ones correct it."""

    def __init__(self) -> None:
        self.estimates: list[Estimate] = []

    def frame(self, result: FrameResult) -> None:
        self.estimates.append(result.estimate)

    def close(self) -> None:
        pass


@pytest.mark.parametrize(
    ("flight", "doubted"),
    [
        ({"gyro": 180 / np.pi}, 40),
        ({"accel": 1 / 9.80665}, 22),
        ({"accel": 100.0}, 22),
        ({"axes": (1, 0, 2)}, 40),
    ],
    ids=["deg/s", "g", "cm/s^2", "axes"],
)
def test_an_imu_that_looks_useless_is_left_out_before_that_is_certain(
    flight: dict[str, Any], doubted: int, alone: Trajectory
) -> None:
    """It takes 100 frames to be certain; from 20 or 40 on each is shown as by images alone, and none
    as unusable.
    """
    shown = _Shown()
    result = run(_flight(**flight), load_config(overrides=["motion=imu"]), viewer=shown)
    doubts = [f for f in result.findings if f.code == "imu-in-doubt"]
    assert [f.ended for f in doubts] == [False, True]
    assert doubts[0].frame <= doubted
    assert doubts[1].frame > 80
    for k in range(doubted, 80):
        assert shown.estimates[k].integrity == "degraded"
        T = shown.estimates[k].T_world_imu
        assert np.linalg.norm(T[:3, 3] - alone.positions[k]) < 0.03


def test_an_imu_whose_first_second_was_wrong_is_used_once_its_size_is_right() -> None:
    flight = _flight()
    wrong_ns = flight.samples[0].time_ns + 1_100_000_000
    samples = [
        replace(s, accel=0.1 * s.accel) if s.time_ns < wrong_ns else s for s in flight.samples
    ]
    shown = _Shown()
    result = run(
        replace(flight, samples=samples), load_config(overrides=["motion=imu"]), viewer=shown
    )
    doubts = [f for f in result.findings if f.code == "imu-in-doubt"]
    assert [f.ended for f in doubts] == [False, True]
    assert doubts[1].frame < 80
    line = next(f.message for f in result.findings if "the IMU is used;" in f.message)
    assert line.startswith(f"frame {doubts[1].frame}:")
    assert shown.estimates[-1].gravity_world is not None or shown.estimates[-1].tilt_sigma_rad


def test_a_healthy_imu_is_never_in_doubt(as_recorded: RunResult) -> None:
    assert not [f for f in as_recorded.findings if f.code == "imu-in-doubt"]


def test_a_right_imu_is_used_to_the_bit_as_without_a_trial(
    as_recorded: RunResult, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert not [line for line in as_recorded.warnings if "again" in line]
    monkeypatch.setattr("vio.live.build.ImuTrial", lambda backend: None)
    np.testing.assert_array_equal(
        _run(_flight()).trajectory.T_world_body, as_recorded.trajectory.T_world_body
    )


def test_live_estimates_are_right_once_the_unit_is_known(as_recorded: RunResult) -> None:
    flight = _flight(180 / np.pi)
    odometry = Odometry(flight.it.camera, T_cam0_imu=flight.it.T_cam0_imu)
    for event in flight.events():
        if isinstance(event, StereoFrame):
            seen = flight.it.frames[event.index]
            odometry.add_observations(seen.time_ns, seen.ids, seen.z, seen.has_right)
        elif isinstance(event, ImuSample):
            odometry.add_imu(event.time_ns, event.gyro, event.accel)
    odometry.finish()
    apart = odometry.estimate.T_world_imu[:3, 3] - as_recorded.trajectory.positions[-1]
    assert np.linalg.norm(apart) < 0.01


def _with_axes(flight: _Features, turn_deg: float, since: int = 0) -> _Features:
    """The flight, with an IMU that is turned from a frame on."""
    R = so3_exp(np.radians(turn_deg) * np.array([0.5, 0.7, 0.5]) / np.sqrt(0.99))
    since_ns = flight.recording.frame_times_ns[since]
    samples = [
        replace(s, gyro=R @ s.gyro, accel=R @ s.accel) if s.time_ns >= since_ns else s
        for s in flight.samples
    ]
    return replace(flight, samples=samples)


@pytest.mark.parametrize("turn_deg", [7.0, 12.0, 30.0])
def test_readings_of_an_imu_that_is_turned_are_turned_back(
    turn_deg: float, as_recorded: RunResult
) -> None:
    result = _run(_with_axes(_flight(), turn_deg))
    assert _worst_m(result.trajectory, as_recorded.trajectory) < 0.01
    line = [line for line in result.warnings if "estimated again" in line][-1]
    found = re.search(r"readings are turned by ([0-9.]+) degrees", line)
    assert found is not None
    assert float(found[1]) == pytest.approx(turn_deg, abs=1.0)
    assert result.estimates[-1].time_offset_s is not None  # the IMU is used


def test_an_imu_that_is_turned_is_left_to_a_filter_that_estimates_its_extrinsics() -> None:
    settings = ["motion=imu", "msckf.calibrate_camera_imu=extrinsics"]
    result = run(_with_axes(_flight(), 5.0), load_config(overrides=settings))
    assert not [line for line in result.warnings if "turned by" in line]


def test_an_imu_that_is_found_wrong_after_the_first_minute_is_not_used_from_there_on(
    long_flight: tuple[_Features, Trajectory], monkeypatch: pytest.MonkeyPatch
) -> None:
    """What it has done to the estimate until then is in the covariance."""
    monkeypatch.setattr("vio.live.imu_trial._MAX_FRAMES", 50)
    flight, alone = long_flight
    samples = [
        replace(s, gyro=s.gyro[[1, 0, 2]], accel=s.accel[[1, 0, 2]])
        if s.time_ns >= flight.recording.frame_times_ns[160]
        else s
        for s in flight.samples
    ]
    result = _run(replace(flight, samples=samples))
    line = next(line for line in result.warnings if "is not used" in line)
    assert "estimated again" not in line
    first = int(line.split()[1].rstrip(":"))
    assert 160 < first < 240
    # the first steps are measured by the images, and look like those of a gyro that has jumped
    assert "nominal" not in {result.estimates[k].integrity for k in range(161, first)}
    assert {result.estimates[k].integrity for k in range(168, first)} == {"unusable"}
    off = np.linalg.norm(
        np.array([x.T_world_imu[:3, 3] for x in result.estimates]) - alone.positions, axis=1
    )
    sigma = [np.sqrt(np.linalg.eigvalsh(x.covariance[:3, :3])[-1]) for x in result.estimates]
    assert np.all(off[165:] < 4.0 * np.array(sigma)[165:])
    usable = next(k for k in range(first, 400) if result.estimates[k].integrity != "unusable")
    assert usable < first + 25
    begun = alone.T_world_body[usable], alone.T_world_body[399]
    truth = np.linalg.inv(begun[0]) @ begun[1]
    moved = np.linalg.inv(result.estimates[usable].T_world_imu) @ result.estimates[399].T_world_imu
    assert np.linalg.norm((moved - truth)[:3, 3]) < 0.05


def _with_clock(flight: _Features, offset_ms: float, since: float = 0.0) -> _Features:
    """The flight, with the IMU's clock ahead from a share of its time on."""
    times_ns = flight.recording.frame_times_ns
    since_ns = times_ns[0] + since * (times_ns[-1] - times_ns[0])
    moved_ns = round(1e6 * offset_ms)
    samples = [
        replace(s, time_ns=s.time_ns + moved_ns * int(s.time_ns >= since_ns))
        for s in flight.samples
    ]
    return replace(flight, samples=samples)


@pytest.mark.parametrize("offset_ms", [-180.0, -500.0, 140.0, 300.0])
def test_images_alone_go_on_where_clocks_are_further_apart_than_a_filter_can_find(
    offset_ms: float, alone: Trajectory
) -> None:
    result = _run(_with_clock(_flight(), offset_ms))
    assert _worst_m(result.trajectory, alone) < 0.001
    line = [line for line in result.warnings if "estimated again" in line][-1]
    assert "the IMU is not used, and images alone go on" in line


def test_clocks_that_are_apart_by_less_are_the_filters_to_find(as_recorded: RunResult) -> None:
    result = _run(_with_clock(_flight(), 50.0))
    assert not [line for line in result.warnings if "estimated again" in line]
    assert result.estimates[-1].time_offset_s == pytest.approx(0.05, abs=0.005)
    assert _worst_m(result.trajectory, as_recorded.trajectory) < 0.03


@pytest.fixture
def long_flight(monkeypatch: pytest.MonkeyPatch) -> tuple[_Features, Trajectory]:
    """20 s of flight, and its trajectory by images alone."""
    monkeypatch.setattr("tests.live.test_imu_trial.FRAMES", 400)
    flight = _flight()
    return flight, _run(flight, "none").trajectory


def test_a_jump_of_the_gyro_that_no_single_step_shows_is_found(
    long_flight: tuple[_Features, Trajectory],
) -> None:
    """By several steps; 2 degrees a second were believed, to 0.53 m and ten standard deviations."""
    flight, _ = long_flight
    since_ns = flight.recording.frame_times_ns[200]
    bias = np.array([0.03, -0.02, 0.01])
    samples = [replace(s, gyro=s.gyro + bias * (s.time_ns >= since_ns)) for s in flight.samples]
    right = _run(flight)
    result = _run(replace(flight, samples=samples))
    (found,) = [f for f in result.findings if f.code == "gyro-jumped"]
    assert found.frame is not None
    assert 200 < found.frame <= 210
    apart_m = np.linalg.norm(result.trajectory.positions - right.trajectory.positions, axis=1)
    sigma_m = np.array([np.sqrt(np.trace(e.covariance[:3, :3])) for e in result.estimates])
    assert (apart_m < 4 * sigma_m + 0.005).all()
    assert apart_m.max() < 0.15


def test_images_alone_go_on_where_a_clock_has_jumped(
    long_flight: tuple[_Features, Trajectory],
) -> None:
    """The filter holds on to the offset that it was certain of, and takes the jump for the gyro's."""
    flight, alone = long_flight
    result = _run(_with_clock(flight, 80.0, 0.25))
    assert _worst_m(result.trajectory, alone) < 0.03
    found, end = [f for f in result.findings if f.code == "estimate-implausible"]
    assert "a clock has jumped" in found.message
    assert end.ended


def test_a_clock_that_has_jumped_after_the_first_minute_ends_in_a_new_start(
    long_flight: tuple[_Features, Trajectory], monkeypatch: pytest.MonkeyPatch
) -> None:
    """From the offset that the rates show, which the new filter keeps."""
    monkeypatch.setattr("vio.live.imu_trial._MAX_FRAMES", 100)
    flight, alone = long_flight
    result = _run(_with_clock(flight, 80.0, 0.25))
    (found,) = [f for f in result.findings if f.code == "estimate-implausible"]
    (anew,) = [f for f in result.findings if f.code == "estimate-restarted"]
    assert found.first_frame is not None
    levels = result.estimates
    assert all(levels[k].integrity == "unusable" for k in range(found.first_frame, anew.frame))
    assert levels[399].integrity == "nominal"
    assert levels[399].time_offset_s == pytest.approx(0.08, abs=0.005)
    first = np.linalg.inv(alone.T_world_body[anew.frame]) @ alone.T_world_body[399]
    begun = levels[anew.frame].T_world_imu, levels[399].T_world_imu
    moved = np.linalg.inv(begun[0]) @ begun[1]
    assert np.linalg.norm(moved[:3, 3] - first[:3, 3]) < 0.1
    off = np.abs(begun[1][:3, 3] - alone.positions[399])
    assert np.all(off < 3.0 * np.sqrt(np.diag(levels[399].covariance)[:3]))


@pytest.mark.parametrize(
    ("fault", "factor", "certain", "expected"),
    [
        ("gyro units", 0.5, True, ImuVerdict(gyro_factor=0.5)),
        ("accelerometer units", 9.8, True, ImuVerdict(accel_factor=9.8)),
        ("accelerometer units", None, True, ImuVerdict(usable=False)),
        ("gyro axes", None, True, ImuVerdict(usable=False)),
        ("extrinsics rotation", None, False, ImuVerdict()),
        ("saturation", None, True, ImuVerdict()),
        ("clocks apart", None, True, ImuVerdict()),
    ],
)
def test_verdict_follows_from_what_is_certain(
    fault: str, factor: float | None, certain: bool, expected: ImuVerdict
) -> None:
    finding = InertialFinding(fault, "", "", certain=certain, factor=factor)  # type: ignore[arg-type]
    assert ImuVerdict().after(finding) == expected


@pytest.mark.parametrize(("offset_s", "usable"), [(0.09, True), (-0.09, True), (0.13, False)])
def test_clocks_far_apart_leave_nothing_of_an_imu(offset_s: float, usable: bool) -> None:
    finding = InertialFinding("clocks apart", "", "", offset_s=offset_s)
    assert ImuVerdict().after(finding) == ImuVerdict(usable=usable)


def test_images_carry_on_by_the_depths_of_before_when_the_right_camera_fails(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("tests.live.test_imu_trial.FRAMES", 80)
    it = _recording("slow", 2)
    frames = [
        replace(seen, has_right=seen.has_right & (seen.frame_index < 40)) for seen in it.frames
    ]
    recording = replace(
        _flight().recording, frame_times_ns=np.array([seen.time_ns for seen in frames[:80]])
    )
    used = np.array(
        _run(_Features(replace(it, frames=frames), [], recording), "none").frames.column("used")
    )
    assert used[40:].min() > 10


class _Diverges:
    """A back end that diverges in its second frame."""

    def update(self, seen: Observations) -> UpdateReport:
        if seen.frame_index == 1:
            raise DivergedError("frame 1: lost")
        return self.restart(seen)

    def restart(self, seen: Observations) -> UpdateReport:
        return UpdateReport(0, 0, 0, 0, None, None, np.zeros(0, dtype=np.int64))

    def estimate(self) -> Estimate:
        return Estimate(0, np.eye(4), np.eye(6))


def test_frames_that_a_back_end_is_started_again_in_are_known() -> None:
    trial = ImuTrial(_Diverges())  # type: ignore[arg-type]
    for seen in _recording("room").frames[:3]:
        trial.take(seen)
    again = trial.again(ImuVerdict(usable=False))
    assert again is not None
    assert [frame.restarted for frame in again[1]] == ["", "frame 1: lost", ""]
