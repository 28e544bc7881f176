"""Write a simulated recording as an EuRoC ASL folder or as a KITTI odometry folder, whole or not at all."""

from __future__ import annotations

import json
from collections import deque
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import asdict
from pathlib import Path

import cv2
import numpy as np

from vio.atomic import atomic_folder
from vio.errors import CalibrationError
from vio.geometry.distortion import CameraModel, rectified_camera
from vio.geometry.lie import FloatArray, quat_xyzw_from_rotation, se3_inverse
from vio.records import Image
from vio.sim.errors import SimulationError
from vio.sim.imu import ImuNoise, ImuRecord, sample_times
from vio.sim.motion import evaluate
from vio.sim.sequence import SimulatedRecording

Progress = Callable[[int, int], None]  # frames written, frames in all

MARKER = "simulation.json"
_PENDING = 8  # images waiting to be written
_PNG_LEVEL = 1

_IMU_HEADER = (
    "#timestamp [ns],w_RS_S_x [rad s^-1],w_RS_S_y [rad s^-1],w_RS_S_z [rad s^-1],"
    "a_RS_S_x [m s^-2],a_RS_S_y [m s^-2],a_RS_S_z [m s^-2]"
)
_STATE_HEADER = (
    "#timestamp, p_RS_R_x [m], p_RS_R_y [m], p_RS_R_z [m], q_RS_w [], q_RS_x [], q_RS_y [], q_RS_z [], "
    "v_RS_R_x [m s^-1], v_RS_R_y [m s^-1], v_RS_R_z [m s^-1], "
    "b_w_RS_S_x [rad s^-1], b_w_RS_S_y [rad s^-1], b_w_RS_S_z [rad s^-1], "
    "b_a_RS_S_x [m s^-2], b_a_RS_S_y [m s^-2], b_a_RS_S_z [m s^-2]"
)


def export_euroc(
    recording: SimulatedRecording,
    out: Path,
    *,
    replace: bool = False,
    noise: ImuNoise | None = None,
    progress: Progress | None = None,
) -> None:
    """Render all frames into `out/mav0` as EuRoC's ASL format.

    Ground truth is written at 200 Hz in the IMU's clock; its bias columns are zero where a real IMU goes with the
    images.

    Args:
        recording: what to write; any rig.
        out: folder to make.
        replace: whether an older export at `out` may be replaced.
        noise: the figures written into the IMU's sensor.yaml; None: the defaults of `ImuNoise`.
        progress: told after each frame.

    Raises:
        SimulationError: the simulation has no IMU.
        VioError: `out` exists and may not be replaced, or cannot be written.
    """
    simulation = recording.simulation
    record = simulation.imu
    if record is None:
        raise SimulationError("an EuRoC folder needs an IMU; simulate with imu=ImuNoise() or with a recorded one")
    rig, stamps = simulation.rig, simulation.stamps_ns
    rate_hz = 1e9 / float(np.median(np.diff(stamps))) if len(stamps) > 1 else 20.0
    with atomic_folder(out, replace=replace, marker=MARKER) as folder:
        mav = folder / "mav0"
        cameras = (("cam0", rig.cam0, rig.T_imu_cam0), ("cam1", rig.cam1, rig.T_imu_cam1))
        for name, camera, T_imu_cam in cameras:
            (mav / name / "data").mkdir(parents=True)
            _write(mav / name / "sensor.yaml", _camera_yaml(name, camera, T_imu_cam, rate_hz))
            rows = [f"{t},{t}.png" for t in stamps]
            _write(mav / name / "data.csv", "\n".join(["#timestamp [ns],filename", *rows]) + "\n")
        for name, text in (("imu0", _imu_csv(record)), ("state_groundtruth_estimate0", _state_csv(recording))):
            (mav / name).mkdir()
            _write(mav / name / "data.csv", text)
        _write(mav / "imu0" / "sensor.yaml", _imu_yaml(record, ImuNoise() if noise is None else noise))
        _write(folder / MARKER, _description(recording))
        files = [tuple(mav / name / "data" / f"{t}.png" for name in ("cam0", "cam1")) for t in stamps]
        _write_images(recording, files, progress)


def export_kitti(
    recording: SimulatedRecording, out: Path, *, replace: bool = False, progress: Progress | None = None
) -> None:
    """Render all frames as a self-contained KITTI odometry folder.

    It holds `image_0 image_1 calib.txt times.txt poses.txt T_cam0_imu.txt` and, where the simulation has the velocity
    sensor, `velocity.csv`. Times start at zero; poses are those of cam0 relative to its first.

    Raises:
        SimulationError: the rig is not rectified.
        VioError: `out` exists and may not be replaced, or cannot be written.
    """
    simulation = recording.simulation
    try:
        camera = rectified_camera(simulation.rig)
    except CalibrationError as error:
        raise SimulationError("a KITTI folder needs a rectified rig; export this one as an EuRoC folder") from error
    stamps = simulation.stamps_ns
    T_cam0_imu = se3_inverse(simulation.rig.T_imu_cam0)
    poses = recording.reference.in_cam0(T_cam0_imu).T_world_body
    poses = se3_inverse(poses[0]) @ poses
    P0 = np.hstack([camera.K, np.zeros((3, 1))])
    P1 = P0.copy()
    P1[0, 3] = -camera.fu * camera.baseline_m
    with atomic_folder(out, replace=replace, marker=MARKER) as folder:
        for name in ("image_0", "image_1"):
            (folder / name).mkdir()
        _write(folder / "calib.txt", "".join(f"{name}: {_numbers(P)}\n" for name, P in (("P0", P0), ("P1", P1))))
        _write(folder / "times.txt", "".join(f"{_seconds(t - stamps[0])}\n" for t in stamps))
        _write(folder / "poses.txt", "".join(f"{_numbers(T[:3])}\n" for T in poses))
        _write(folder / "T_cam0_imu.txt", "".join(f"{_numbers(row)}\n" for row in T_cam0_imu[:3]))
        rows = [
            f"{_seconds(s.time_ns - stamps[0])},{_numbers(s.linear, ',')},{_numbers(s.angular, ',')}"
            for s in simulation.velocity
            if stamps[0] <= s.time_ns <= stamps[-1]
        ]
        if rows:
            header = "time_s,vx_mps,vy_mps,vz_mps,wx_radps,wy_radps,wz_radps"
            _write(folder / "velocity.csv", "\n".join([header, *rows]) + "\n")
        _write(folder / MARKER, _description(recording))
        files = [tuple(folder / name / f"{i:06d}.png" for name in ("image_0", "image_1")) for i in range(len(stamps))]
        _write_images(recording, files, progress)


def _write_images(recording: SimulatedRecording, files: list[tuple[Path, ...]], progress: Progress | None) -> None:
    """Render in this thread and compress in another."""
    waiting: deque[Future[None]] = deque()
    with ThreadPoolExecutor(max_workers=1) as writer:
        for index, pair in enumerate(files):
            for path, image in zip(pair, recording.images(index), strict=True):
                waiting.append(writer.submit(_write_png, path, image))
            while len(waiting) > _PENDING:
                waiting.popleft().result()
            if progress is not None:
                progress(index + 1, len(files))
        while waiting:
            waiting.popleft().result()


def _write_png(path: Path, image: Image) -> None:
    _, data = cv2.imencode(".png", image, [cv2.IMWRITE_PNG_COMPRESSION, _PNG_LEVEL])
    path.write_bytes(data.tobytes())


def _write(path: Path, text: str) -> None:
    path.write_text(text, encoding="utf-8", newline="\n")


def _numbers(values: FloatArray, separator: str = " ") -> str:
    """All digits, so that reading gives back the same bits."""
    return separator.join(repr(float(x)) for x in np.ravel(values))


def _seconds(time_ns: int) -> str:
    """Exact decimal seconds of non-negative nanoseconds."""
    return f"{int(time_ns) // 1_000_000_000}.{int(time_ns) % 1_000_000_000:09d}"


def _matrix_yaml(T: FloatArray) -> str:
    rows = [", ".join(repr(float(x)) for x in row) for row in T]
    return "T_BS:\n  cols: 4\n  rows: 4\n  data: [" + ",\n         ".join(rows) + "]\n"


def _camera_yaml(name: str, camera: CameraModel, T_imu_cam: FloatArray, rate_hz: float) -> str:
    model = "equidistant" if camera.model == "equidistant" else "radial-tangential"
    coefficients = camera.coefficients if camera.coefficients else (0.0, 0.0, 0.0, 0.0)
    numbers = ", ".join(repr(float(x)) for x in (camera.fu, camera.fv, camera.cu, camera.cv))
    return (
        f"%YAML:1.0\nsensor_type: camera\ncomment: simulated {name}\n\n{_matrix_yaml(T_imu_cam)}\n"
        f"rate_hz: {rate_hz:.6g}\nresolution: [{camera.width}, {camera.height}]\ncamera_model: pinhole\n"
        f"intrinsics: [{numbers}] #fu, fv, cu, cv\ndistortion_model: {model}\n"
        f"distortion_coefficients: [{', '.join(repr(float(x)) for x in coefficients)}]\n"
    )


def _imu_yaml(record: ImuRecord, noise: ImuNoise) -> str:
    rate_hz = 1e9 / float(np.median(np.diff(record.times_ns))) if len(record.times_ns) > 1 else 0.0
    return (
        f"%YAML:1.0\nsensor_type: imu\ncomment: {'simulated' if record.gyro_bias is not None else 'recorded'} imu0\n\n"
        f"{_matrix_yaml(np.eye(4))}\nrate_hz: {rate_hz:.6g}\n"
        f"gyroscope_noise_density: {noise.gyro_density!r}  # [ rad / s / sqrt(Hz) ]\n"
        f"gyroscope_random_walk: {noise.gyro_walk!r}  # [ rad / s^2 / sqrt(Hz) ]\n"
        f"accelerometer_noise_density: {noise.accel_density!r}  # [ m / s^2 / sqrt(Hz) ]\n"
        f"accelerometer_random_walk: {noise.accel_walk!r}  # [ m / s^3 / sqrt(Hz) ]\n"
    )


def _imu_csv(record: ImuRecord) -> str:
    rows = zip(record.times_ns, record.gyro, record.accel, strict=True)
    return "\n".join([_IMU_HEADER, *(f"{t},{_numbers(w, ',')},{_numbers(a, ',')}" for t, w, a in rows)]) + "\n"


def _state_csv(recording: SimulatedRecording) -> str:
    simulation = recording.simulation
    times = sample_times(simulation.motion, 200.0)
    state = evaluate(simulation.motion, times)
    quaternions = quat_xyzw_from_rotation(state.T_world_imu[:, :3, :3])[:, [3, 0, 1, 2]]
    biases = np.zeros((len(times), 6))
    record = simulation.imu
    if record is not None and record.gyro_bias is not None and record.accel_bias is not None:
        known = np.hstack([record.gyro_bias, record.accel_bias])
        elapsed, at = (record.times_ns - times[0]).astype(np.float64), (times - times[0]).astype(np.float64)
        biases = np.stack([np.interp(at, elapsed, known[:, i]) for i in range(6)], axis=1)
    table = np.hstack([state.T_world_imu[:, :3, 3], quaternions, state.velocity_world, biases])
    return (
        "\n".join([_STATE_HEADER, *(f"{t},{_numbers(row, ',')}" for t, row in zip(times, table, strict=True))]) + "\n"
    )


def _description(recording: SimulatedRecording) -> str:
    """What the folder was made from."""
    simulation = recording.simulation
    facts = {
        "scene": simulation.world.name,
        "seed": simulation.seed,
        "frames": len(simulation.stamps_ns),
        "imu": None
        if simulation.imu is None
        else ("simulated" if simulation.imu.gyro_bias is not None else "recorded"),
        "effects": asdict(simulation.effects),
    }
    return json.dumps(facts, indent=2) + "\n"
