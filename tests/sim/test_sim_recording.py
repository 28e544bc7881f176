"""Camera effects, simulated recordings, statistics of the oracle front end, and round trips of
exported folders.
"""

from __future__ import annotations

import csv
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml

from vio.datasets.plain import read_kitti
from vio.datasets.settings import DatasetSettings
from vio.errors import DataError, SimulationError, VioError
from vio.geometry.lie import FloatArray, rotation_from_quat_xyzw, se3_inverse, transform_points
from vio.geometry.stereo import project
from vio.records import FrontendOutput, ImuSample, StereoFrame, VelocitySample
from vio.sim.effects import CLEAN, SensorEffects, along_flow, apply_effects, average_exposures
from vio.sim.export import export_euroc, export_kitti
from vio.sim.imu import ImuNoise, VelocityNoise
from vio.sim.motion import car_loop, hand_held, rotate_body_axes
from vio.sim.oracle import OracleFrontend, OracleSettings
from vio.sim.render import Radiance, correspondence
from vio.sim.rigs import R_FLU_EUROC_IMU, euroc_like_rig, kitti_like_rig, small_rig
from vio.sim.sequence import (
    FrameFaults,
    SimulatedRecording,
    Simulation,
    read_flight,
    simulate,
    views,
)
from vio.sim.world import World, room, street

RIG = small_rig(192, 120)
MOTION = hand_held(duration_s=4.0)


@pytest.fixture(scope="module")
def world() -> World:
    return room(1, texel_m=0.008)


@pytest.fixture(scope="module")
def plain(world: World) -> Simulation:
    return simulate(
        world, RIG, MOTION, rate_hz=10.0, imu=ImuNoise(), velocity=VelocityNoise(), effects=CLEAN
    )


def _recording(plain: Simulation, effects: SensorEffects) -> SimulatedRecording:
    return SimulatedRecording(replace(plain, effects=effects))


# --- effects
# --------------------------------------------------------------------------------------------------


GRAY: Radiance = np.full((80, 100), 100.0, dtype=np.float32)


def _with_effects(
    effects: SensorEffects, *, camera: int = 0, time_ns: int = 0, frame: int = 0
) -> FloatArray:
    image = apply_effects(GRAY, effects, time_ns=time_ns, frame_index=frame, camera=camera, seed=1)
    return image.astype(np.float64)


def test_exposure_and_gain_scale_the_signal() -> None:
    assert np.all(_with_effects(CLEAN) == 100)
    assert np.all(_with_effects(replace(CLEAN, exposure=0.05)) == 5)
    uneven = replace(CLEAN, exposure=1.2, right_gain=0.5)
    assert np.all(_with_effects(uneven) == 120)
    assert np.all(_with_effects(uneven, camera=1) == 60)
    swinging = replace(CLEAN, exposure_swing=0.4, exposure_period_s=4.0)
    assert np.all(_with_effects(swinging, time_ns=1_000_000_000) == 140)
    assert np.all(_with_effects(swinging, time_ns=3_000_000_000) == 60)


def test_vignetting_darkens_the_corners_only() -> None:
    image = _with_effects(replace(CLEAN, vignetting=0.6))
    assert image[0, 0] == image[-1, -1] == 40
    assert image[40, 50] >= 99


def test_gamma_lifts_the_shadows() -> None:
    expected = round(255 * (100 / 255) ** (1 / 2.2))
    assert np.all(_with_effects(replace(CLEAN, gamma=2.2)) == expected)


def test_noise_has_the_specified_standard_deviation() -> None:
    read = _with_effects(replace(CLEAN, read_noise=3.0))
    assert read.std() == pytest.approx(np.hypot(3.0, 12**-0.5), rel=0.03)
    assert read.mean() == pytest.approx(100, abs=0.2)
    electrons = 100 / 255 * 5000
    photon = _with_effects(replace(CLEAN, full_well=5000.0))
    assert photon.std() == pytest.approx(np.hypot(100 / np.sqrt(electrons), 12**-0.5), rel=0.03)
    same, other = (
        _with_effects(replace(CLEAN, read_noise=3.0)),
        _with_effects(replace(CLEAN, read_noise=3.0), frame=1),
    )
    assert np.array_equal(same, read)
    assert not np.array_equal(other, read)
    right = _with_effects(replace(CLEAN, read_noise=3.0), camera=1)
    assert abs(np.corrcoef(read.ravel(), right.ravel())[0, 1]) < 0.05


def test_exact_blur_is_the_mean_of_sub_exposures() -> None:
    def render_at(time_ns: int) -> Radiance:
        return np.full((2, 2), time_ns * 1e-6, dtype=np.float32)

    blurred = average_exposures(render_at, 50_000_000, 10.0, 5)
    np.testing.assert_allclose(blurred, 50.0, atol=1e-4)  # symmetric about the frame's time


def test_motion_blur_is_along_the_motion_and_the_approximate_one_agrees(plain: Simulation) -> None:
    time_ns = 2_000_000_000
    sharp, approximate, exact = (
        _recording(plain, effects)._seen(0, time_ns, None)
        for effects in (
            CLEAN,
            replace(CLEAN, blur_exposure_ms=30.0, blur_samples=9),
            replace(CLEAN, blur_exposure_ms=30.0, blur_samples=9, blur_exact=True),
        )
    )
    contrast = [cv2.Laplacian(image, cv2.CV_32F).std() for image in (sharp, approximate, exact)]
    assert contrast[2] < 0.8 * contrast[0]
    assert np.abs(approximate - exact).mean() < 0.35 * np.abs(sharp - exact).mean()


def test_flow_is_the_exact_map(plain: Simulation) -> None:
    recording = SimulatedRecording(plain)
    start, end = 1_000_000_000, 1_100_000_000
    flow = recording.flow(0, start, end, step_px=4)
    assert flow.shape == (120, 192, 2)
    u, v = np.meshgrid(np.arange(0, 192, 5), np.arange(0, 120, 5))
    uv = np.stack([u, v], axis=-1).reshape(-1, 2)
    there, visible = correspondence(plain.world, views(plain, start)[0], views(plain, end)[0], uv)
    error = np.linalg.norm(flow[v.ravel(), u.ravel()] - (there - uv), axis=1)[visible]
    assert np.median(np.linalg.norm((there - uv)[visible], axis=1)) > 2
    assert np.median(error) < 0.02
    assert np.mean(error > 0.5) < 0.1  # where the grid straddles an outline


# --- recordings
# --------------------------------------------------------------------------------------------------


def test_events_are_in_time_order_with_ground_truth(plain: Simulation) -> None:
    recording = SimulatedRecording(plain)
    events = list(recording.events(3, 6, images=False))
    times = [event.time_ns for event in events]
    assert times == sorted(times)
    frames = [event for event in events if isinstance(event, StereoFrame)]
    assert [frame.index for frame in frames] == [3, 4, 5]
    assert isinstance(events[-1], StereoFrame)
    inertial = [event.time_ns for event in events if isinstance(event, ImuSample)]
    assert inertial == list(range(0, 500_000_001, 5_000_000)), (
        "up to a second before the first frame, as all readers"
    )
    velocities = [event.time_ns for event in events if isinstance(event, VelocitySample)]
    assert velocities == [300_000_000, 400_000_000, 500_000_000]
    with pytest.raises(DataError, match="none is between"):
        recording.events(5, 5)
    assert recording.recording.motion == {"imu", "velocity"}
    reference = recording.recording.reference
    state = recording.true_state(400_000_000)
    np.testing.assert_allclose(state.T_world_imu, reference.T_world_body[4], atol=1e-12)
    later = recording.true_state(400_100_000)
    speed = (later.T_world_imu - state.T_world_imu)[:3, 3] / 1e-4
    np.testing.assert_allclose(speed, state.velocity_world, atol=1e-3)
    assert np.linalg.norm(state.gyro_bias) > 0


def test_frames_are_reproducible_to_the_bit(plain: Simulation) -> None:
    noisy = replace(plain, effects=SensorEffects(read_noise=2.0, full_well=8000.0))
    first, again = SimulatedRecording(noisy).frame(5), SimulatedRecording(noisy).frame(5)
    assert first.left.dtype == np.uint8
    assert first.left.shape == (120, 192)
    assert np.array_equal(first.left, again.left)  # type: ignore[arg-type]
    assert np.array_equal(first.right, again.right)  # type: ignore[arg-type]


def test_dropped_and_repeated_frames_and_clock_offset(world: World) -> None:
    faults = FrameFaults(dropped=0.2, duplicated=0.2, time_offset_ms=7.0)
    whole = simulate(world, RIG, MOTION, rate_hz=40.0)
    faulty = simulate(world, RIG, MOTION, rate_hz=40.0, faults=faults, seed=2)
    expected = 0.8 * len(whole.stamps_ns)
    assert abs(len(faulty.stamps_ns) - expected) < 4 * np.sqrt(0.2 * expected)
    assert np.all(np.diff(faulty.stamps_ns) > 0)
    lag = faulty.stamps_ns - faulty.taken_ns
    repeated = np.flatnonzero(lag > 7_000_000)
    assert set(np.unique(lag[lag <= 7_000_000])) == {7_000_000}
    assert 0.1 < len(repeated) / len(lag) < 0.3
    k = int(repeated[0])
    recording = SimulatedRecording(replace(faulty, effects=SensorEffects(read_noise=3.0)))
    assert np.array_equal(recording.images(k)[0], recording.images(k - 1)[0])
    assert not np.array_equal(
        recording.images(k + 1 if k + 1 not in repeated else k - 2)[0], recording.images(k)[0]
    )


def test_rejects_image_times_outside_the_ground_truth(tmp_path: Path) -> None:
    gt, times = tmp_path / "gt.txt", tmp_path / "times.txt"
    gt.write_text("".join(f"{k * 0.1:.1f} {k} 0 0 0 0 0 1\n" for k in range(20)))
    times.write_text("5000000000\n6000000000\n")
    with pytest.raises(DataError, match="no image time is within the ground truth"):
        read_flight(gt, times)
    times.write_text("100\nabc\n")
    with pytest.raises(
        DataError, match=r"times\.txt, line 2: 'abc' is no time in whole nanoseconds"
    ):
        read_flight(gt, times)


# --- oracle
# --------------------------------------------------------------------------------------------------


def _run(oracle: OracleFrontend, simulation: Simulation) -> list[FrontendOutput]:
    return [
        oracle.process(StereoFrame(i, int(t), None, None))
        for i, t in enumerate(simulation.stamps_ns)
    ]


def test_perfect_observations_are_projections_of_the_points(plain: Simulation) -> None:
    oracle = OracleFrontend(plain, OracleSettings(max_features=60, sigma_px=0.0))
    camera = SimulatedRecording(plain).recording.camera
    for index, output in enumerate(_run(oracle, plain)):
        seen = output.observations
        time_ns = int(plain.taken_ns[index])
        T_cam0_world = se3_inverse(views(plain, time_ns)[0].T_world_cam)
        expected = project(camera, transform_points(T_cam0_world, oracle.points(seen.ids, time_ns)))
        np.testing.assert_allclose(seen.z, expected, atol=1e-7)
        assert len(seen) > 55
        assert output.tracked + output.detected == len(seen)


def test_oracle_noise_outliers_and_ids(plain: Simulation) -> None:
    settings = OracleSettings(
        max_features=80, sigma_px=0.7, outlier_fraction=0.1, left_only_fraction=0.2
    )
    oracle = OracleFrontend(plain, settings, seed=3)
    outputs = _run(oracle, plain)
    residuals, wrong, gone, last = [], [], set(), set[int]()
    for index, output in enumerate(outputs):
        seen = output.observations
        now = set(seen.ids.tolist())
        assert not now & gone, "an id came back"
        gone |= last - now
        last = now
        wrong.append(oracle.outliers(index))
        residuals.append(seen.z - oracle.exact(index))
    outlier, residual = np.concatenate(wrong), np.concatenate(residuals)
    assert outlier.mean() == pytest.approx(0.1, abs=0.02)
    assert residual[~outlier].std() == pytest.approx(0.7, rel=0.03)
    assert np.abs(residual[~outlier].mean(axis=0)).max() < 0.06
    assert np.linalg.norm(residual[outlier][:, 2:], axis=1).min() > 5 - 4 * 0.7
    has_right = np.concatenate([output.observations.has_right for output in outputs])
    assert has_right.mean() == pytest.approx(0.8, abs=0.03)
    again = _run(OracleFrontend(plain, settings, seed=3), plain)
    assert all(
        np.array_equal(a.observations.z, b.observations.z)
        for a, b in zip(outputs, again, strict=True)
    )
    other = _run(OracleFrontend(plain, settings, seed=4), plain)
    assert not np.array_equal(outputs[0].observations.z, other[0].observations.z)


def test_oracle_spreads_features_and_limits_their_age(plain: Simulation) -> None:
    oracle = OracleFrontend(plain, OracleSettings(max_features=48, max_track_length=5))
    ages: dict[int, int] = {}
    for output in _run(oracle, plain):
        for feature in output.observations.ids.tolist():
            ages[feature] = ages.get(feature, 0) + 1
        uv = output.observations.z[:, :2]
        halves = [np.mean(uv[:, 0] < 96), np.mean(uv[:, 1] < 60)]
        assert min(halves) > 0.2
        assert max(halves) < 0.8
    assert max(ages.values()) == 5
    assert np.median(list(ages.values())) >= 4


def test_oracle_and_recording_need_a_rectified_rig(world: World) -> None:
    simulation = simulate(
        world, euroc_like_rig(), rotate_body_axes(hand_held(duration_s=1.0), R_FLU_EUROC_IMU)
    )
    with pytest.raises(SimulationError, match="rectified"):
        OracleFrontend(simulation)
    with pytest.raises(SimulationError, match="unrectified rig"):
        _ = SimulatedRecording(simulation).recording


# --- export
# --------------------------------------------------------------------------------------------------


def _short(plain: Simulation, frames: int = 3) -> SimulatedRecording:
    return SimulatedRecording(
        replace(plain, taken_ns=plain.taken_ns[:frames], stamps_ns=plain.stamps_ns[:frames])
    )


def test_a_kitti_folder_reads_back(plain: Simulation, tmp_path: Path) -> None:
    recording = _short(plain)
    done: list[tuple[int, int]] = []
    export_kitti(recording, tmp_path / "out", progress=lambda k, n: done.append((k, n)))
    assert done == [(1, 3), (2, 3), (3, 3)]
    dataset = read_kitti(tmp_path / "out", DatasetSettings())
    mine, read = recording.recording, dataset.recording
    assert (read.camera.fu, read.camera.cu, read.camera.width) == (
        mine.camera.fu,
        mine.camera.cu,
        192,
    )
    assert read.camera.baseline_m == pytest.approx(mine.camera.baseline_m)
    np.testing.assert_allclose(read.T_cam0_imu, mine.T_cam0_imu, atol=1e-12)
    truth = recording.reference.in_cam0(se3_inverse(RIG.T_imu_cam0)).T_world_body
    np.testing.assert_allclose(
        read.reference.T_world_body, se3_inverse(truth[0]) @ truth, atol=1e-9
    )
    events = list(dataset.events())
    frames = [event for event in events if isinstance(event, StereoFrame)]
    velocities = [event for event in events if isinstance(event, VelocitySample)]
    for frame in frames:
        left, right = recording.images(frame.index)
        assert np.array_equal(frame.left, left)  # type: ignore[arg-type]
        assert np.array_equal(frame.right, right)  # type: ignore[arg-type]
    assert len(velocities) == 3
    np.testing.assert_allclose(velocities[1].linear, plain.velocity[1].linear)


def test_an_euroc_folder_reads_back(world: World, tmp_path: Path) -> None:
    motion = rotate_body_axes(
        hand_held(duration_s=1.0, start_ns=1_403_715_524_907_143_219), R_FLU_EUROC_IMU
    )
    rig = euroc_like_rig()
    simulation = simulate(world, rig, motion, rate_hz=2.0, imu=ImuNoise())
    recording = SimulatedRecording(simulation)
    export_euroc(recording, tmp_path / "out")
    mav = tmp_path / "out" / "mav0"
    for name, camera, T in (("cam0", rig.cam0, rig.T_imu_cam0), ("cam1", rig.cam1, rig.T_imu_cam1)):
        text = (mav / name / "sensor.yaml").read_text().replace("%YAML:1.0", "")
        sensor = yaml.safe_load(text)
        np.testing.assert_array_equal(np.reshape(sensor["T_BS"]["data"], (4, 4)), T)
        assert sensor["intrinsics"] == [camera.fu, camera.fv, camera.cu, camera.cv]
        assert tuple(sensor["distortion_coefficients"]) == camera.coefficients
        assert sensor["distortion_model"] == "radial-tangential"
        assert sensor["resolution"] == [752, 480]
        rows = list(csv.reader((mav / name / "data.csv").read_text().splitlines()[1:]))
        assert [int(row[0]) for row in rows] == simulation.stamps_ns.tolist()
        image = cv2.imread(str(mav / name / "data" / rows[1][1]), cv2.IMREAD_UNCHANGED)
        assert np.array_equal(image, recording.images(1)[int(name[-1])])
    imu = np.loadtxt(mav / "imu0" / "data.csv", delimiter=",", comments="#", usecols=range(1, 7))
    np.testing.assert_array_equal(imu, np.hstack([simulation.imu.gyro, simulation.imu.accel]))
    state = np.loadtxt(
        mav / "state_groundtruth_estimate0" / "data.csv", delimiter=",", comments="#"
    )
    assert state.shape[1] == 17
    truth = recording.true_state(motion.start_ns)
    np.testing.assert_allclose(state[0, 1:4], truth.T_world_imu[:3, 3])
    np.testing.assert_allclose(
        rotation_from_quat_xyzw(state[0, [5, 6, 7, 4]]), truth.T_world_imu[:3, :3], atol=1e-12
    )
    np.testing.assert_allclose(state[0, 8:11], truth.velocity_world, atol=1e-12)
    np.testing.assert_allclose(state[0, 11:14], truth.gyro_bias)


def test_folders_are_written_atomically(plain: Simulation, tmp_path: Path) -> None:
    class Interrupted(Exception):  # noqa: N818
        pass

    def stop(done: int, _: int) -> None:
        if done == 2:
            raise Interrupted

    with pytest.raises(Interrupted):
        export_kitti(_short(plain), tmp_path / "out", progress=stop)
    assert list(tmp_path.iterdir()) == []
    export_kitti(_short(plain, 1), tmp_path / "out")
    with pytest.raises(VioError, match="exists already"):
        export_kitti(_short(plain, 1), tmp_path / "out")
    export_kitti(_short(plain, 2), tmp_path / "out", replace=True)
    assert len(list((tmp_path / "out" / "image_0").iterdir())) == 2


def test_export_errors_name_the_missing_sensor(world: World, tmp_path: Path) -> None:
    with pytest.raises(SimulationError, match="needs an IMU"):
        export_euroc(SimulatedRecording(simulate(world, RIG, MOTION)), tmp_path / "a")
    motion = rotate_body_axes(hand_held(duration_s=1.0), R_FLU_EUROC_IMU)
    with pytest.raises(SimulationError, match="rectified rig"):
        export_kitti(SimulatedRecording(simulate(world, euroc_like_rig(), motion)), tmp_path / "b")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("seed", range(6))
def test_predefined_scenes_are_clear_of_predefined_motions(seed: int) -> None:
    simulate(room(seed), small_rig(), hand_held(seed=seed))
    simulate(street(seed), kitti_like_rig(), car_loop(seed=seed), rate_hz=10.0)


def test_rows_of_a_rolling_shutter_show_their_own_time(plain: Simulation) -> None:
    readout_ms = 60.0
    rolled = _recording(plain, replace(CLEAN, readout_ms=readout_ms))
    still = _recording(plain, CLEAN)
    height = plain.rig.cam0.height
    frame = 30
    time_ns = int(plain.taken_ns[frame])
    image = rolled.images(frame)[0].astype(float)
    at_once = still.images(frame)[0].astype(float)
    for row in (6, height // 2, height - 7):
        late = (row - 0.5 * (height - 1)) / height * readout_ms
        then = still._sharp(0, time_ns + round(1e6 * late))[row]
        off = float(np.abs(image[row] - then).mean())
        off_at_once = float(np.abs(image[row] - at_once[row]).mean())
        assert off < 4.0
        if abs(late) > 20:
            assert off_at_once > 4 * off


@pytest.mark.parametrize("part", [0.2, 0.25, 0.5, 0.8])
def test_images_along_a_flow_are_moved_by_that_flow(part: float) -> None:
    """The phase of a wave of 20 px tells by how much it was moved."""
    u = np.tile(np.arange(200, dtype=np.float32), (8, 1))
    flow = np.zeros((*u.shape, 2))
    flow[..., 0] = part
    moved = along_flow(np.cos(2 * np.pi * u / 20).astype(np.float32), flow)[4, 20:180]
    wave = np.exp(-2j * np.pi * (np.arange(20, 180) + part) / 20)
    assert abs(np.angle(np.sum(moved * wave))) * 20 / (2 * np.pi) < 0.015
