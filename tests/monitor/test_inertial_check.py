"""IMU check: every fault gives its own finding, correct data none."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from vio.datasets.rigs import load_rig
from vio.datasets.samples import imu_samples
from vio.datasets.tables import read_imu_table
from vio.files.trajectories import read_trajectory
from vio.geometry.distortion import rectified_camera
from vio.geometry.lie import FloatArray, se3_exp, se3_from_parts, se3_inverse, transform_points
from vio.geometry.stereo import StereoCamera, project
from vio.imu.clocks import judge_clocks
from vio.imu.findings import InertialFinding
from vio.monitor.inertial import InertialCheck
from vio.monitor.motion import CameraTwists
from vio.monitor.run import RunMonitor
from vio.records import (
    Estimate,
    ImuSample,
    Observations,
    StereoScaleEstimate,
    UpdateReport,
    observations,
)
from vio.sim.imu import ImuNoise, simulate_imu
from vio.sim.motion import (
    MotionSpline,
    car_loop,
    fit_spline,
    hand_held,
    motion_at,
    rotate_body_axes,
)
from vio.sim.rigs import R_FLU_EUROC_IMU, euroc_rectified_rig, small_rig

_FRAME_NS = 50_000_000


@dataclass(frozen=True)
class Watched:
    """A recording as input of the check."""

    camera: StereoCamera
    T_cam0_imu: FloatArray
    samples: list[ImuSample]
    gravity: list[FloatArray]  # (3,) each sample's component due to gravity
    frames: list[Observations]


def _observe(
    camera: StereoCamera,
    T_world_imu: FloatArray,
    T_cam0_imu: FloatArray,
    times_ns: list[int],
    reach: float,
    seed: int,
    sigma_px: float = 0.5,
) -> list[Observations]:
    """Return noisy observations of points on the walls of a cube `reach` metres around the path."""
    rng = np.random.default_rng([seed, 1])
    centre, half = (f(T_world_imu[:, :3, 3], axis=0) for f in (np.mean, np.ptp))
    points = rng.uniform(-1, 1, (6000, 3))
    points[np.arange(6000), rng.integers(0, 3, 6000)] = rng.choice([-1.0, 1.0], 6000)
    points = centre + points * (half / 2 + reach)
    frames = []
    for k, time_ns in enumerate(times_ns):
        p = transform_points(T_cam0_imu @ se3_inverse(T_world_imu[k]), points)
        ahead = np.flatnonzero(p[:, 2] > 0.5)
        z = project(camera, p[ahead])
        seen = (z[:, [0, 2]] > 0).all(axis=1) & (z[:, [0, 2]] < camera.width).all(axis=1)
        seen &= (z[:, 1] > 0) & (z[:, 1] < camera.height)
        ids = ahead[seen][:200]
        frames.append(
            observations(k, time_ns, ids, z[seen][:200] + rng.normal(0, sigma_px, (len(ids), 4)))
        )
    return frames


def _motion(name: str, seed: int) -> MotionSpline:
    if name == "room":
        return hand_held(duration_s=20, seed=seed)
    if name == "slow":
        return hand_held(duration_s=20, period_s=60, seed=seed)
    if name == "still":
        return hand_held(duration_s=6, still_s=10, seed=seed)
    return hand_held(duration_s=16, still_s=3, period_s=8, seed=seed)


@cache
def _recording(
    name: str,
    seed: int = 0,
    mount: str = "euroc",
    *,
    frame_ns: int = _FRAME_NS,
    sigma_px: float = 0.5,
) -> Watched:
    rig = euroc_rectified_rig() if mount == "euroc" else small_rig()
    motion = _motion(name, seed)
    if name == "car":
        motion = car_loop(duration_s=25, start_m=25, seed=seed)
    if mount == "euroc":
        motion = rotate_body_axes(motion, R_FLU_EUROC_IMU)
    imu = simulate_imu(motion, noise=ImuNoise(), seed=seed)
    times = np.arange(motion.start_ns, motion.end_ns, frame_ns)
    T_cam0_imu = se3_inverse(rig.T_imu_cam0)
    camera = rectified_camera(rig)
    reach = 15.0 if name == "car" else 3.0
    poses = motion_at(motion, times).T_world_imu
    frames = _observe(camera, poses, T_cam0_imu, times.tolist(), reach, seed, sigma_px)
    gravity = 9.81 * motion_at(motion, imu.times_ns).T_world_imu[:, 2, :3]
    return Watched(camera, T_cam0_imu, list(imu_samples(imu)), list(gravity), frames)


@cache
def _real(folder: Path, seconds: float) -> Watched:
    """Return the real IMU data of a flight, and observations of points along its ground truth."""
    truth = read_trajectory(folder / "groundtruth_tum.txt", fmt="tum")
    truth_ns, poses = truth.times_ns, truth.T_world_body
    used = truth_ns < truth_ns[0] + round((seconds + 1) * 1e9)
    motion, _ = fit_spline(truth_ns[used], poses[used], knot_s=0.1)
    start, end = motion.start_ns, motion.start_ns + round(seconds * 1e9)
    record = read_imu_table(folder / "imu0.csv", whole_ns=True)[0]
    samples = [s for s in imu_samples(record) if start <= s.time_ns <= end]
    times = np.arange(start, end, _FRAME_NS)
    rig = euroc_rectified_rig()
    camera, T_cam0_imu = rectified_camera(rig), se3_inverse(rig.T_imu_cam0)
    frames = _observe(
        camera, motion_at(motion, times).T_world_imu, T_cam0_imu, times.tolist(), 3.0, 0, 0.2
    )
    return Watched(camera, T_cam0_imu, samples, [], frames)


def _checked(
    it: Watched,
    *,
    samples: list[ImuSample] | None = None,
    T_cam0_imu: FloatArray | None = None,
    frames: list[Observations] | None = None,
) -> tuple[InertialCheck, list[InertialFinding]]:
    """Run the check over samples and frames in time order."""
    check = InertialCheck(it.camera, it.T_cam0_imu if T_cam0_imu is None else T_cam0_imu)
    events: list[ImuSample | Observations] = [*(it.samples if samples is None else samples)]
    events = sorted([*events, *(it.frames if frames is None else frames)], key=lambda e: e.time_ns)
    found: list[InertialFinding] = []
    for event in events:
        if isinstance(event, ImuSample):
            check.imu([event])
        else:
            found += check.frame(event)
    return check, [*found, *check.finish()]


def _watch(it: Watched, **changed: Any) -> list[InertialFinding]:
    """What the check finds in samples and frames; the arguments are those of `_checked`."""
    return _checked(it, **changed)[1]


def _faults(found: list[InertialFinding]) -> list[str]:
    return [f.fault for f in found]


def _gyro(it: Watched, change: Callable[[FloatArray], FloatArray]) -> list[ImuSample]:
    return [replace(s, gyro=change(s.gyro)) for s in it.samples]


def _accel(it: Watched, change: Callable[[FloatArray], FloatArray]) -> list[ImuSample]:
    return [replace(s, accel=change(s.accel)) for s in it.samples]


def _gravity(it: Watched, factor: float) -> list[ImuSample]:
    return [
        replace(s, accel=s.accel + factor * g) for s, g in zip(it.samples, it.gravity, strict=True)
    ]


def _shifted(it: Watched, seconds: float) -> list[ImuSample]:
    return [replace(s, time_ns=s.time_ns + round(seconds * 1e9)) for s in it.samples]


# Correct data


@pytest.mark.parametrize("mount", ["euroc", "forward"])
@pytest.mark.parametrize(
    ("name", "seed"), [("room", 0), ("room", 1), ("slow", 2), ("late", 3), ("still", 4), ("car", 5)]
)
def test_correct_recording_gives_no_finding(name: str, seed: int, mount: str) -> None:
    assert _watch(_recording(name, seed, mount)) == []


def test_correct_recording_of_a_fast_camera_gives_no_finding() -> None:
    """At 100 frames/s a slow turn is less than the errors of pixels from frame to frame."""
    it = _recording("slow", 2, frame_ns=10_000_000, sigma_px=0.2)
    assert _watch(it, frames=it.frames[:600]) == []


@pytest.mark.parametrize(
    ("frame_ns", "spacing"), [(10_000_000, 3), (20_000_000, 2), (33_333_333, 1)]
)
def test_turns_are_those_between_frames_30_ms_apart(frame_ns: int, spacing: int) -> None:
    it = _recording("room")
    twists = CameraTwists(it.camera)
    seen = replace(it.frames[0], time_ns=0)
    motions = [twists.frame(replace(seen, time_ns=k * frame_ns)) for k in range(70)]
    found = [motion for motion in motions if motion is not None]
    assert np.all(found[0].end_ns - found[0].begin_ns == spacing * frame_ns)
    assert twists.spacing == spacing


@pytest.mark.parametrize("count", [10, 25, 40, 90])
@pytest.mark.parametrize("first", [0, 120, 240])
def test_short_recording_gives_no_finding(first: int, count: int) -> None:
    it = _recording("room", 1)
    assert _watch(it, frames=it.frames[first : first + count]) == []


def test_wrong_matches_and_black_images_give_no_finding() -> None:
    it = _recording("room")
    rng = np.random.default_rng(0)
    frames = []
    for k, seen in enumerate(it.frames):
        wrong = rng.random(len(seen)) < 0.15
        z = seen.z + np.where(wrong[:, None], rng.uniform(-40, 40, (len(seen), 4)), 0)
        right = rng.random(len(seen)) < 0.8
        keep = np.arange(len(seen)) < (0 if k % 100 > 90 else 150)
        frames.append(replace(seen, z=z, has_right=right).take(keep))
    assert _watch(it, frames=frames) == []
    assert _faults(_watch(it, frames=frames, samples=_accel(it, lambda a: -a))) == [
        "accelerometer sign"
    ]


def test_poor_sensor_gives_no_finding() -> None:
    it = _recording("room", 1)
    rng = np.random.default_rng(1)
    poor = [
        replace(
            s,
            gyro=s.gyro + rng.normal([0.1, -0.05, 0.08], 0.05),
            accel=s.accel + rng.normal(0.3, 0.5, 3),
        )
        for s in it.samples
    ]
    assert _watch(it, samples=poor) == []


@pytest.mark.parametrize(("name", "seed"), [("room", 0), ("slow", 2), ("still", 4), ("car", 5)])
def test_gyro_and_accelerometer_in_each_others_place_are_named(name: str, seed: int) -> None:
    it = _recording(name, seed)
    exchanged = [replace(s, gyro=s.accel, accel=s.gyro) for s in it.samples]
    (found,) = _watch(it, samples=exchanged)
    assert "gyro and accelerometer are exchanged" in found.message
    assert found.is_disabling


def test_a_gyro_in_degrees_beside_gravity_is_not_exchanged() -> None:
    it = _recording("room", 0)
    steady = _gyro(it, lambda w: w + np.array([9.8, 0.0, 0.0]))  # deg/s, of a turntable
    assert not any("exchanged" in found.message for found in _watch(it, samples=steady))


@pytest.mark.parametrize("count", [30, 45, 60])
def test_a_gyro_that_rests_while_the_camera_turns_is_named_in_a_short_recording(count: int) -> None:
    it = _recording("room", 1)
    frames = it.frames[120 : 120 + count]
    noise = np.random.default_rng(0)
    resting = _gyro(it, lambda w: noise.normal([0.01, -0.02, 0.01], 0.005))
    assert "gyro disagrees" in _faults(_watch(it, frames=frames, samples=resting))


@pytest.mark.parametrize("seconds", [6.5, 9.5, 12.5])
@pytest.mark.parametrize(("name", "seed"), [("room", 0), ("room", 1), ("slow", 2)])
def test_readings_of_another_time_are_found_wrong(name: str, seed: int, seconds: float) -> None:
    """Some offset and some linear map explain half of them by chance, and the given axes nothing."""
    it = _recording(name, seed)
    later = [*it.samples[round(200 * seconds) :], *it.samples[: round(200 * seconds)]]
    samples = [
        replace(own, gyro=other.gyro, accel=other.accel)
        for own, other in zip(it.samples, later, strict=True)
    ]
    assert "gyro disagrees" in _faults(_watch(it, samples=samples))


@pytest.mark.parametrize("count", [60, 90])
@pytest.mark.parametrize(("name", "seed"), [("room", 0), ("slow", 2)])
def test_images_of_a_short_recording_in_reverse_order_are_named(
    name: str, seed: int, count: int
) -> None:
    it = _recording(name, seed)
    frames = it.frames[100 : 100 + count]
    shown = [
        replace(seen, frame_index=frame.frame_index, time_ns=frame.time_ns)
        for seen, frame in zip(frames[::-1], frames, strict=True)
    ]
    (found,) = _watch(it, frames=shown)
    assert "the order of the images reversed the gyro agrees" in found.message


@pytest.mark.parametrize(("name", "seed"), [("room", 0), ("room", 1), ("slow", 2)])
def test_images_in_reverse_order_are_no_clocks_apart(name: str, seed: int) -> None:
    """Some offset and some linear map bring smooth rates together by chance."""
    it = _recording(name, seed)
    shown = [
        replace(seen, frame_index=frame.frame_index, time_ns=frame.time_ns)
        for seen, frame in zip(it.frames[::-1], it.frames, strict=True)
    ]
    (found,) = _watch(it, frames=shown)
    assert found.fault == "gyro disagrees"
    assert "in another order than that of their times" in found.message


def test_readings_of_another_time_are_no_images_in_reverse_order() -> None:
    it = _recording("room", 0)
    later = [*it.samples[1900:], *it.samples[:1900]]
    samples = [
        replace(own, gyro=other.gyro, accel=other.accel)
        for own, other in zip(it.samples, later, strict=True)
    ]
    assert not any("reversed" in f.message for f in _watch(it, samples=samples))


# Units, signs, axes

_CYCLE = np.array([[0.0, 1, 0], [0, 0, 1], [1, 0, 0]])
_CORRUPTED: dict[str, tuple[Callable[[Watched], list[ImuSample]], list[str], str]] = {
    "g": (
        lambda it: _accel(it, lambda a: a / 9.80665),
        ["accelerometer units"],
        "in g: multiply by 9.81",
    ),
    "mg": (lambda it: _accel(it, lambda a: a / 9.80665e-3), ["accelerometer units"], "mg"),
    "odd": (
        lambda it: _accel(it, lambda a: a * 5),
        ["accelerometer units"],
        "the unit or scale is unknown",
    ),
    "increments": (
        lambda it: _accel(it, lambda a: a / 200),
        ["accelerometer units"],
        "changes of velocity from sample to sample",
    ),
    "no gravity": (lambda it: _gravity(it, -1), ["gravity removed"], "taken out"),
    "degrees": (
        lambda it: _gyro(it, np.degrees),
        ["gyro units"],
        "deg/s: multiply its readings by pi/180",
    ),
    "half": (lambda it: _gyro(it, lambda w: 0.5 * w), ["gyro units"], "multiplied by "),
    "left-handed": (lambda it: _gyro(it, lambda w: -w), ["gyro sign"], "left-handed"),
    "cycled gyro": (lambda it: _gyro(it, lambda w: _CYCLE @ w), ["gyro axes"], "[+y +z +x]"),
    "mirrored gyro": (lambda it: _gyro(it, lambda w: w * [1, 1, -1]), ["gyro axes"], "[+x +y -z]"),
    "turned gyro": (lambda it: _gyro(it, lambda w: w * [-1, -1, 1]), ["gyro axes"], "[-x -y +z]"),
    "dead gyro": (lambda it: _gyro(it, lambda w: 0 * w), ["gyro disagrees"], "dead"),
    "inverted accelerometer": (
        lambda it: _accel(it, lambda a: -a),
        ["accelerometer sign"],
        "wrong sign",
    ),
    "cycled accelerometer": (
        lambda it: _accel(it, lambda a: _CYCLE @ a),
        ["accelerometer axes"],
        "[+y +z +x]",
    ),
    "mirrored accelerometer": (
        lambda it: _accel(it, lambda a: a * [1, -1, 1]),
        ["accelerometer axes"],
        "[+x -y +z]",
    ),
    "gravity alone inverted": (
        lambda it: _gravity(it, -2),
        ["upside down"],
        "a + g in place of a - g",
    ),
    "g and degrees": (
        lambda it: [
            replace(s, gyro=np.degrees(s.gyro), accel=s.accel / 9.80665) for s in it.samples
        ],
        ["accelerometer units", "gyro units"],
        "",
    ),
}


@pytest.mark.parametrize(("seed", "mount"), [(0, "euroc"), (1, "forward")])
@pytest.mark.parametrize("name", _CORRUPTED)
def test_corrupted_samples_give_exactly_their_finding(name: str, seed: int, mount: str) -> None:
    corrupt, faults, words = _CORRUPTED[name]
    it = _recording("room", seed, mount)
    found = _watch(it, samples=corrupt(it))
    assert _faults(found) == faults
    assert words in found[0].explanation + found[0].seen
    assert all(
        "\n" not in f.message and f.seen in f.message and f.explanation in f.message for f in found
    )
    assert [f.certain for f in found] == [f.fault != "upside down" for f in found]


@pytest.mark.parametrize(("seed", "mount"), [(0, "euroc"), (1, "forward")])
def test_names_the_axis_along_which_gyro_and_accelerometer_are_mirrored(
    seed: int, mount: str
) -> None:
    """As in the raw readings of a receiver that stores -y of both."""
    it = _recording("room", seed, mount)
    along = np.array([1, -1, 1])
    samples = [replace(s, gyro=s.gyro * along, accel=s.accel * along) for s in it.samples]
    (found,) = _watch(it, samples=samples)
    assert found.fault == "gyro axes"
    assert "[+x -y +z]" in found.explanation


def test_biased_accelerations_without_gravity_are_not_taken_for_g() -> None:
    it = _recording("room")
    bias = np.array([0.6, -0.6, 0.55])
    removed = [
        replace(s, accel=s.accel - g + bias) for s, g in zip(it.samples, it.gravity, strict=True)
    ]
    sizes = [np.linalg.norm(s.accel) for s in removed]
    assert 0.8 < np.median(sizes) < 1.3  # as in g
    assert _faults(_watch(it, samples=removed)) == ["gravity removed"]


@pytest.mark.parametrize("name", ["degrees", "left-handed", "inverted accelerometer", "no gravity"])
def test_slow_motion_is_enough(name: str) -> None:
    corrupt, faults, _ = _CORRUPTED[name]
    it = _recording("slow", 2)
    assert _faults(_watch(it, samples=corrupt(it))) == faults


def test_reports_degrees_when_the_run_ends_after_two_seconds() -> None:
    it = _recording("room")
    assert _faults(_watch(it, samples=_gyro(it, np.degrees), frames=it.frames[:40])) == [
        "gyro units"
    ]


@pytest.mark.parametrize("axis", range(3))
def test_names_an_inverted_axis_of_the_accelerometer_when_the_run_ends_after_four_seconds(
    axis: int,
) -> None:
    it, signs = _recording("room"), 1.0 - 2.0 * np.eye(3)[axis]
    assert _faults(_watch(it, samples=_accel(it, lambda a: signs * a), frames=it.frames[:90])) == [
        "accelerometer axes"
    ]


@pytest.mark.parametrize(
    ("name", "fault", "begin", "end"),
    [
        ("inverted accelerometer", "sign", 0, 90),
        ("inverted accelerometer", "sign", 0, 52),
        ("cycled accelerometer", "axes", 0, 90),
        ("cycled accelerometer", "axes", 120, 172),
        ("", "", 0, 90),
        ("", "", 0, 52),
    ],
)
def test_other_signs_or_axes_of_the_accelerometer_are_named_in_a_short_run(
    name: str, fault: str, begin: int, end: int
) -> None:
    it = _recording("room", 2)
    samples = _CORRUPTED[name][0](it) if name else it.samples
    seen = it.frames[begin:end]
    begin_ns = seen[0].time_ns - _FRAME_NS
    samples = [s for s in samples if begin_ns < s.time_ns < seen[-1].time_ns + _FRAME_NS]
    found = _watch(it, samples=samples, frames=seen)
    assert _faults(found) == ([f"accelerometer {fault}"] if fault else [])


@pytest.mark.parametrize(("name", "said"), [("", True), ("cycled accelerometer", False)])
def test_a_run_blames_the_baseline_only_once_the_accelerometers_axes_are_right(
    name: str, said: bool
) -> None:
    it = _recording("room")
    monitor = RunMonitor(it.camera, it.T_cam0_imu, imu=True)
    off = StereoScaleEstimate(np.array([np.log(1.3), 0.0]), np.diag([1e-4, 0.0]))
    lines_at = []
    for event in sorted(
        [*(_CORRUPTED[name][0](it) if name else it.samples), *it.frames], key=lambda e: e.time_ns
    ):
        if isinstance(event, ImuSample):
            monitor.samples([event])
            continue
        monitor.observations(event)
        used = UpdateReport(50, 2, 1, 30, 0.3, 1.0)
        monitor.update(
            event.frame_index,
            used,
            Estimate(event.time_ns, np.eye(4), 1e-4 * np.eye(6), stereo_scale=off),
        )
        lines_at.append(sum("the baseline" in line for line in monitor.lines))
    monitor.close()
    assert lines_at[60] == 0
    assert [line for line in monitor.lines if "the baseline" in line] == monitor.lines * said
    assert lines_at[-1] == said


@pytest.mark.parametrize(
    ("name", "at"),
    [("", 20), ("g", 0), ("no gravity", 0), ("cycled gyro", 60), ("inverted accelerometer", 240)],
)
def test_the_filter_judges_no_baseline_by_an_imu_that_looks_faulty(name: str, at: int) -> None:
    """From the frame on in which the fault shows; units show at once, axes and signs with
    motion.
    """
    it = _recording("room")
    samples = _CORRUPTED[name][0](it) if name else it.samples
    monitor = RunMonitor(it.camera, it.T_cam0_imu, imu=True)
    agree = []
    for event in sorted([*samples, *it.frames[: at + 60]], key=lambda e: e.time_ns):
        if isinstance(event, ImuSample):
            monitor.samples([event])
        else:
            monitor.observations(event)
            agree.append(
                monitor.rotation_comparison is not None and monitor.rotation_comparison.agree
            )
    assert any(agree[at + 20 :]) == (name == "")


@pytest.mark.parametrize("factor", [1.0, 1000.0])
def test_a_run_says_once_that_its_baseline_is_in_another_unit(factor: float) -> None:
    it = _recording("room")
    monitor = RunMonitor(
        replace(it.camera, baseline_m=factor * it.camera.baseline_m), it.T_cam0_imu, imu=False
    )
    for seen in it.frames[:3]:
        monitor.observations(seen)
    said = [
        line
        for line in monitor.lines
        if "m is implausible; translations are metres: check the unit" in line
    ]
    assert len(said) == (factor > 1)


@pytest.mark.parametrize("seed", [0, 1])
@pytest.mark.parametrize("factor", [6.0, 40.0])
def test_a_baseline_in_squares_of_a_board_is_named_with_its_length(
    factor: float, seed: int
) -> None:
    """Beside a baseline that an IMU contradicts: 126 m of 1.07 m without a word."""
    it = _recording("room", seed)
    true_m = it.camera.baseline_m
    wrong = replace(it, camera=replace(it.camera, baseline_m=factor * true_m))
    for frames in (wrong.frames, wrong.frames[:95]):
        (found,) = _watch(wrong, frames=frames)
        assert found.fault == "camera scale"
        assert (found.code, found.certain) == ("scale-off", True)
        words = found.explanation.split("would be ")[1]
        assert float(words.split(" m")[0]) == pytest.approx(true_m, rel=0.15)


def test_standstill_gives_no_finding_about_motion() -> None:
    it = _recording("still", 4)
    standstill = [f for f in it.frames if f.time_ns < 9_900_000_000]
    for corrupt in ("degrees", "left-handed", "cycled gyro"):
        assert _watch(it, samples=_CORRUPTED[corrupt][0](it), frames=standstill) == []
    assert _faults(_watch(it, samples=_CORRUPTED["g"][0](it), frames=standstill)) == [
        "accelerometer units"
    ]
    hint = _watch(it, samples=_CORRUPTED["inverted accelerometer"][0](it), frames=standstill)
    assert _faults(hint) == ["upside down"]
    assert "too small to decide" in hint[0].explanation
    assert not hint[0].certain


# Extrinsics


@pytest.mark.parametrize("mount", ["euroc", "forward"])
def test_distinguishes_wrong_extrinsics_from_a_wrong_gyro(mount: str) -> None:
    """The inverse of either mount only exchanges axes, as a miswired gyro does; the
    accelerometer decides.
    """
    it = _recording("room", 0, mount)
    T = it.T_cam0_imu
    assert _faults(_watch(it, T_cam0_imu=se3_inverse(T))) == ["extrinsics inverted"]
    identity = _watch(it, T_cam0_imu=np.eye(4))
    assert _faults(identity) == ["extrinsics rotation"]
    assert str(np.round(T[0, 1], 1)) in identity[0].explanation
    turned_by = _watch(it, T_cam0_imu=T @ se3_exp([0, 0, 0, 0.3, 0.4, -0.1]))
    assert _faults(turned_by) == ["extrinsics rotation"]
    assert "turned by 29." in turned_by[0].seen


def test_reports_a_mirrored_frame_that_no_exchange_of_axes_explains() -> None:
    it = _recording("room")
    across = np.array([0.5, 0.3, 0.8]) / np.linalg.norm([0.5, 0.3, 0.8])
    found = _watch(it, samples=_gyro(it, lambda w: w - 2 * across * (across @ w)))
    assert _faults(found) == ["gyro axes"]
    assert "a mirrored frame fits" in found[0].seen


def test_small_errors_of_extrinsics_give_no_finding() -> None:
    it = _recording("room")
    assert _watch(it, T_cam0_imu=it.T_cam0_imu @ se3_exp([0.01, 0.02, 0, 0.03, 0.03, -0.03])) == []


def test_reports_both_degrees_and_inverted_extrinsics() -> None:
    it = _recording("room")
    found = _watch(it, samples=_gyro(it, np.degrees), T_cam0_imu=se3_inverse(it.T_cam0_imu))
    assert _faults(found) == ["extrinsics inverted", "gyro units"]


# What happens during a run


def _after(it: Watched, seconds: float, change: Callable[[ImuSample], ImuSample]) -> Watched:
    """The recording, whose samples are others from a time after its first frame on."""
    since = it.frames[0].time_ns + round(1e9 * seconds)
    samples = [change(s) if s.time_ns >= since else s for s in it.samples]
    return replace(it, samples=samples)


def _without(it: Watched, first: int, count: int) -> Watched:
    """The recording without some images, whose stamps go on."""
    shown = [*it.frames[:first], *it.frames[first + count :]]
    frames = [
        replace(seen, frame_index=frame.frame_index, time_ns=frame.time_ns)
        for seen, frame in zip(shown, it.frames, strict=False)
    ]
    return replace(it, frames=frames)


_TURNED = se3_exp([0, 0, 0, 0.9, -0.4, 0.6])[:3, :3]
_SINCE: dict[str, Callable[[Watched], Watched]] = {
    "images are missing": lambda it: _without(it, 60, 25),
    "it is turned": lambda it: _after(it, 3.0, lambda s: replace(s, gyro=_TURNED @ s.gyro)),
    "it has other axes": lambda it: _after(it, 3.0, lambda s: replace(s, gyro=s.gyro[[1, 0, 2]])),
    "it is in degrees": lambda it: _after(it, 3.0, lambda s: replace(s, gyro=np.degrees(s.gyro))),
    "it is another one": lambda it: _after(it, 3.0, lambda s: replace(s, gyro=-s.gyro[::-1] * 0.7)),
}


@pytest.mark.parametrize("change", _SINCE)
@pytest.mark.parametrize("seed", [0, 1])
def test_a_gyro_that_has_agreed_at_first_has_no_wrong_units_or_axes(change: str, seed: int) -> None:
    whole = _recording("room", seed)
    it = _SINCE[change](replace(whole, frames=whole.frames[:130]))
    (found,) = _watch(it)
    assert found.fault == "gyro disagrees"
    assert found.factor is None
    until = re.search(r"it agrees until (\S+) s after the first frame", found.message)
    assert until is not None
    assert 2.0 < float(until[1]) < 4.0


@pytest.mark.parametrize("factor", [0.4, 1.8])
@pytest.mark.parametrize("axis", range(3))
@pytest.mark.parametrize("name", ["room", "slow"])
def test_an_axis_of_another_scale_has_not_agreed_at_first(
    name: str, axis: int, factor: float
) -> None:
    it = _recording(name)
    scales = np.where(np.arange(3) == axis, factor, 1.0)
    for found in _watch(it, samples=_gyro(it, lambda w: scales * w)):
        assert "it agrees until" not in found.message


@pytest.mark.parametrize("axis", range(3))
def test_a_gyro_of_one_axis_is_named(axis: int) -> None:
    it = _recording("room")
    found = _watch(it, samples=_gyro(it, lambda w: np.where(np.arange(3) == axis, w, 0.0)))
    assert found[0].is_disabling


@pytest.mark.parametrize("axis", range(3))
@pytest.mark.parametrize(("name", "mount"), [("room", "euroc"), ("slow", "forward")])
def test_a_dead_axis_of_a_gyro_is_named(name: str, mount: str, axis: int) -> None:
    it = _recording(name, 0, mount)
    noise = np.random.default_rng(7)

    def dead(w: FloatArray) -> FloatArray:
        return np.where(np.arange(3) == axis, noise.normal(0.01, 0.005), w)

    found = _watch(it, samples=_gyro(it, dead))[0]
    assert found.fault == "gyro dead"
    assert f"about {'xyz'[axis]} of the IMU" in found.message
    assert found.is_disabling


# Clocks


def test_estimates_the_clock_offset() -> None:
    it = _recording("room")
    for seconds in (0.05, 0.13, -1.3):
        found = _watch(it, samples=_shifted(it, seconds))
        assert _faults(found) == ["clocks apart"]
        assert found[0].offset_s == pytest.approx(seconds, abs=0.002)
        assert f"{found[0].offset_s:+.3f} s" in found[0].explanation
    assert _watch(it, samples=_shifted(it, 0.005)) == []


def test_reports_missing_samples_before_a_filter_fails() -> None:
    it = _recording("room")
    check = InertialCheck(it.camera, it.T_cam0_imu)
    reported = [k for k, seen in enumerate(it.frames[:20]) if check.frame(seen)]
    assert reported == [9]
    assert check.finish() == ()
    check = InertialCheck(it.camera, it.T_cam0_imu)
    for sample in it.samples[:100]:
        check.imu([sample])
    late = [replace(f, time_ns=f.time_ns + 10**15) for f in it.frames[:12]]
    found = [f for seen in late for f in check.frame(seen)]
    assert _faults(found) == ["clocks without overlap"]
    assert "epochs" in found[0].explanation


def test_reports_the_share_of_frames_without_samples() -> None:
    it = _recording("room")
    found = _watch(it, samples=[s for s in it.samples if s.time_ns < 15_000_000_000])
    assert _faults(found) == ["clocks overlap in part"]
    assert "75." in found[0].seen


_EPOCH = 1_400_000_000 * 10**9
_CAMERA_NS = _EPOCH + np.arange(400) * _FRAME_NS
_IMU_NS = _EPOCH + np.arange(4000) * 5_000_000


@pytest.mark.parametrize(
    ("imu_ns", "fault", "words"),
    [
        (_IMU_NS // 1000, "clocks without overlap", "1e+3 the IMU's stamps cover the frames"),
        (_IMU_NS // 10**6, "clocks without overlap", "milliseconds"),
        (_IMU_NS - _EPOCH, "clocks without overlap", "different epochs"),
        (
            _IMU_NS + 37 * 10**9,
            "clocks without overlap",
            "the IMU were late by 37 s (TAI and UTC)",
        ),
        (_IMU_NS - _EPOCH, "clocks without overlap", "count from the start of a device"),
        (_IMU_NS[:0], "clocks without overlap", "epoch"),
        (_IMU_NS[:1000], "clocks overlap in part", "cut short"),
        ((_IMU_NS - _EPOCH) // 1000 + _EPOCH, "clocks overlap in part", ""),
    ],
)
def test_finds_clock_faults_by_the_stamps(imu_ns: np.ndarray, fault: str, words: str) -> None:
    (finding,) = judge_clocks(_CAMERA_NS, imu_ns)
    assert finding.fault == fault
    assert words in finding.explanation
    assert str(_CAMERA_NS[0]) in finding.seen


def test_clocks_that_agree_give_no_finding() -> None:
    assert judge_clocks(_CAMERA_NS, _IMU_NS) == ()
    assert judge_clocks(_CAMERA_NS, _IMU_NS[50:]) == ()
    assert judge_clocks(_CAMERA_NS[:0], _IMU_NS) == ()


# Samples alone


def test_reports_saturation_and_no_wrong_scale() -> None:
    it = _recording("room")
    found = _watch(it, samples=_gyro(it, lambda w: np.clip(w, -0.45, 0.45)))
    assert _faults(found) == ["saturation"]
    assert "0.45 rad/s" in found[0].seen


def test_coarse_and_held_samples_are_not_saturated() -> None:
    it = _recording("room")
    coarse = [
        replace(s, gyro=np.round(s.gyro / 0.01) * 0.01, accel=np.round(s.accel / 0.05) * 0.05)
        for s in it.samples
    ]
    assert _watch(it, samples=coarse) == []
    held = [replace(s, gyro=it.samples[k - k % 5].gyro) for k, s in enumerate(it.samples)]
    assert _watch(it, samples=held) == []


def test_reports_a_gap_once() -> None:
    it = _recording("room")
    kept = [s for s in it.samples if not 3 <= s.time_ns * 1e-9 % 8 < 3.2]
    found = _watch(it, samples=kept)
    assert _faults(found) == ["IMU gap"]
    assert "0.205 s" in found[0].seen


# The check itself


def test_check_ends_and_can_be_reset() -> None:
    it = _recording("late", 3)
    check = InertialCheck(it.camera, it.T_cam0_imu)

    def feed(corrupt: float, shift_ns: int) -> list[InertialFinding]:
        found: list[InertialFinding] = []
        samples = iter(it.samples)
        for seen in it.frames:
            for sample in samples:
                shifted_ns = sample.time_ns + shift_ns
                check.imu([replace(sample, gyro=corrupt * sample.gyro, time_ns=shifted_ns)])
                if sample.time_ns >= seen.time_ns:
                    break
            found += check.frame(replace(seen, time_ns=seen.time_ns + shift_ns))
        return found

    length = it.samples[-1].time_ns - it.samples[0].time_ns + 5_000_000
    assert feed(1.0, 0) == []
    assert feed(1.0, length) == []
    assert check.done
    assert feed(-1.0, 2 * length) == []  # the comparison has ended
    check.reset()
    assert not check.done
    assert _faults(feed(-1.0, 3 * length)) == ["gyro sign"]
    check.reset()
    assert feed(-1.0, 4 * length) == []  # reported before
    assert check.finish() == ()


def test_memory_is_bounded() -> None:
    it = _recording("still", 4)
    check = InertialCheck(it.camera, it.T_cam0_imu)
    for k in range(80 * 20):
        for j in range(10):
            time_ns = k * _FRAME_NS + j * 5_000_000
            check.imu([ImuSample(time_ns, np.zeros(3), np.array([9.81, 0, 0]))])
        seen = it.frames[0]
        check.frame(replace(seen, frame_index=k, time_ns=k * _FRAME_NS + 45_000_000))
    times_ns, _ = check._samples.table()
    assert 50e9 < times_ns[-1] - times_ns[0] < 65e9
    assert check.finish() == ()


# Real records


@pytest.mark.parametrize(
    ("flight", "mistakes"),
    [
        ("V1_02", ("degrees", "left-handed", "cycled accelerometer")),
        ("MH_03", ("g", "turned gyro", "inverted accelerometer")),
    ],
)
def test_real_imu_gives_a_finding_only_when_corrupted(
    data_dir: Path, flight: str, mistakes: tuple[str, ...]
) -> None:
    it = _real(data_dir / "euroc_real_imu" / flight, 30.0)
    T = it.T_cam0_imu
    assert _watch(it) == []
    assert _faults(_watch(it, T_cam0_imu=se3_inverse(T))) == ["extrinsics inverted"]
    for name in mistakes:
        corrupt, faults, _ = _CORRUPTED[name]
        assert _faults(_watch(it, samples=corrupt(it))) == faults, name


def test_tumvi_agrees_with_its_motion_capture(data_dir: Path) -> None:
    """Readings at 200 Hz, and between them those that the publishers interpolated at the cameras'
    times.

    Two windows of 20 s; the five others of the record give no finding either.
    """
    folder = data_dir / "tumvi_room1_head"
    truth, record = (
        read_trajectory(folder / "gt_imu.csv"),
        imu_samples(read_imu_table(folder / "imu.txt")[0]),
    )
    rig = load_rig(folder)
    T, camera = rig.T_cam0_imu, StereoCamera(365.0, 365.0, 512.0, 512.0, 0.101, 1024, 1024)
    for start_s in (0, 120):
        begin = truth.times_ns[0] + start_s * 10**9
        used = (truth.times_ns >= begin) & (truth.times_ns <= begin + 21 * 10**9)
        motion, _ = fit_spline(truth.times_ns[used], truth.T_world_body[used], knot_s=0.05)
        times = np.arange(motion.start_ns, motion.start_ns + 20 * 10**9, _FRAME_NS)
        frames = _observe(
            camera, motion_at(motion, times).T_world_imu, T, times.tolist(), 2.5, 0, 0.2
        )
        it = Watched(
            camera, T, [s for s in record if times[0] <= s.time_ns <= times[-1]], [], frames
        )
        assert len(it.samples) > 4300
        assert _watch(it) == []
        if start_s == 0:
            assert _faults(_watch(it, samples=_gyro(it, np.degrees))) == ["gyro units"]


def test_reports_an_inverted_lever_arm_where_the_motion_determines_it(data_dir: Path) -> None:
    it = _real(data_dir / "euroc_real_imu" / "V1_02", 30.0)
    T = se3_from_parts(it.T_cam0_imu[:3, :3], -it.T_cam0_imu[:3, 3])
    found = _watch(it, T_cam0_imu=T)
    assert _faults(found) == ["extrinsics translation"]
    assert "its negative fits" in found[0].seen
