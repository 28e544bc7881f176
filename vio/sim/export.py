"""Write a simulated recording as an EuRoC ASL folder or a KITTI odometry folder, atomically."""

from __future__ import annotations

import json
from collections import deque
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from vio.cameras.rig import Rig
from vio.datasets.euroc_files import (
    STATE_CSV,
    image_name,
    imu_csv,
    imu_yaml,
    median_rate_hz,
    state_csv,
    write_cameras,
)
from vio.datasets.images import write_png
from vio.datasets.kitti import write_calibration, write_times, write_velocity
from vio.datasets.rigs.kalibr import kalibr_text
from vio.datasets.tum_rgbd import DEPTH_FACTOR
from vio.errors import SimulationError
from vio.files.atomic import atomic_folder
from vio.files.text import exact_text, seconds_text, write_text
from vio.files.trajectories import in_first_cam0, write_tum
from vio.geometry.lie import FloatArray, se3_inverse
from vio.numerics.kinds import Capacity
from vio.protocols import Progress
from vio.records import ImuDensities
from vio.sim.imu import ADIS16448, sample_times
from vio.sim.motion import motion_at
from vio.sim.sequence import SimulatedRecording, true_biases

MARKER = "simulation.json"
_TRUTH_HZ = 200.0
_PENDING: Capacity[int] = 8  # images waiting to be written


def export_euroc(
    recording: SimulatedRecording,
    out: Path,
    *,
    replace: bool = False,
    noise: ImuDensities = ADIS16448,
    progress: Progress | None = None,
) -> None:
    """Render all frames into `out/mav0` as EuRoC's ASL format.

    Ground truth is written at 200 Hz, in the IMU's clock; its bias columns are zero for a recorded
    IMU.

    Raises:
        SimulationError: the simulation has no IMU.
        VioError: `out` exists and may not be replaced, or cannot be written.
    """
    simulation = recording.simulation
    record = simulation.imu
    if record is None:
        raise SimulationError(
            "an EuRoC folder needs an IMU; simulate with imu=ImuNoise() or with a recorded one"
        )
    stamps = simulation.stamps_ns
    origin = "recorded" if record.gyro_bias is None else "simulated"
    with atomic_folder(out, replace=replace, marker=MARKER) as folder:
        mav = folder / "mav0"
        for name in ("cam0", "cam1"):
            (mav / name / "data").mkdir(parents=True)
        write_cameras(mav, simulation.calibration, stamps, int(stamps[-1]), kind="simulated")
        for name, text in (
            ("imu0", imu_csv(record)),
            (STATE_CSV.parent.name, _truth_csv(recording)),
        ):
            (mav / name).mkdir()
            write_text(mav / name / "data.csv", text)
        calibration = imu_yaml(
            np.eye(4), noise, comment=f"{origin} imu0", rate_hz=median_rate_hz(record.times_ns)
        )
        write_text(mav / "imu0" / "sensor.yaml", calibration)
        write_text(folder / MARKER, description(recording))
        names = [image_name(t, int(stamps[-1])) for t in stamps.tolist()]
        files = [
            tuple(mav / camera / "data" / name for camera in ("cam0", "cam1")) for name in names
        ]
        _write_images(recording, files, progress)


def export_kitti(
    recording: SimulatedRecording,
    out: Path,
    *,
    replace: bool = False,
    progress: Progress | None = None,
) -> None:
    """Render all frames as a self-contained KITTI odometry folder.

    It holds `image_0 image_1 calib.txt times.txt poses.txt T_cam0_imu.txt` and, where the
    simulation has the velocity sensor, `velocity.csv`. Times start at zero; poses are those of cam0
    relative to its first pose.

    Raises:
        SimulationError: the rig is not rectified.
        VioError: `out` exists and may not be replaced, or cannot be written.
    """
    simulation = recording.simulation
    camera = simulation.rectified_camera(
        "a KITTI folder needs a rectified rig; export this one as an EuRoC folder"
    )
    stamps = simulation.stamps_ns
    T_cam0_imu = se3_inverse(simulation.calibration.T_imu_cam0)
    poses = in_first_cam0(recording.reference, T_cam0_imu).T_world_body
    within = [sample for sample in simulation.velocity if stamps[0] <= sample.time_ns <= stamps[-1]]
    with atomic_folder(out, replace=replace, marker=MARKER) as folder:
        for name in ("image_0", "image_1"):
            (folder / name).mkdir()
        write_calibration(folder, camera, T_cam0_imu)
        write_times(folder, stamps)
        write_text(folder / "poses.txt", "".join(f"{exact_text(T[:3])}\n" for T in poses))
        if within:
            write_velocity(folder, within, int(stamps[0]))
        write_text(folder / MARKER, description(recording))
        files = [
            tuple(folder / name / f"{i:06d}.png" for name in ("image_0", "image_1"))
            for i in range(len(stamps))
        ]
        _write_images(recording, files, progress)


def _write_images(
    recording: SimulatedRecording, files: list[tuple[Path, ...]], progress: Progress | None
) -> None:
    """Render in this thread and compress in another."""
    waiting: deque[Future[None]] = deque()
    with ThreadPoolExecutor(max_workers=1) as writer:
        for index, pair in enumerate(files):
            for path, image in zip(pair, recording.images(index), strict=True):
                waiting.append(writer.submit(write_png, path, image))
            while len(waiting) > _PENDING:
                waiting.popleft().result()
            if progress is not None:
                progress(index + 1, len(files))
        while waiting:
            waiting.popleft().result()


def _truth_csv(recording: SimulatedRecording) -> str:
    simulation = recording.simulation
    times = sample_times(simulation.motion, _TRUTH_HZ)
    state = motion_at(simulation.motion, times)
    biases = true_biases(simulation.imu, times)
    zero = np.zeros((len(times), 6))
    return state_csv(
        times, state.T_world_imu, state.velocity_world, zero if biases is None else biases
    )


def description(recording: SimulatedRecording) -> str:
    """Describe the simulation as JSON."""
    simulation = recording.simulation
    facts = {
        "scene": simulation.world.name,
        "seed": simulation.seed,
        "frames": len(simulation.stamps_ns),
        "imu": None
        if simulation.imu is None
        else ("simulated" if simulation.imu.gyro_bias is not None else "recorded"),
        "effects": asdict(simulation.effects),
        "true_rig": asdict(simulation.rig),  # which the calibration that is written may miss
    }
    return json.dumps(facts, indent=2, default=np.ndarray.tolist) + "\n"


@dataclass(frozen=True, slots=True)
class _DepthSensor:
    """A depth camera of structured light."""

    noise: float = 1.5e-3  # 1/m, k of a depth's standard deviation k z^2: structured light
    nearest_m: float = 0.4  # beyond them such a sensor gives none
    farthest_m: float = 8.0


_DEPTH = _DepthSensor()


def export_rgbd(
    recording: SimulatedRecording,
    out: Path,
    *,
    replace: bool = False,
    progress: Progress | None = None,
) -> None:
    """Render the left camera's frames with depth images as TUM RGB-D's layout, and `imu.csv` where
    there is an IMU.

    A depth has the standard deviation 0.0015 z^2, and is unknown (0) nearer than 0.4 m and beyond 8
    m. Ground truth is that of the camera, or of the IMU where there is one.

    Raises:
        VioError: `out` exists and may not be replaced, or cannot be written.
    """
    simulation = recording.simulation
    T_cam0_imu = se3_inverse(simulation.calibration.T_imu_cam0)
    T_stated = None if simulation.imu is None else T_cam0_imu
    rig = Rig(simulation.calibration.cam0, T_cam0_imu=T_stated, depth_factor=DEPTH_FACTOR)
    truth = (
        recording.reference
        if simulation.imu is not None
        else recording.reference.in_cam0(T_cam0_imu)
    )
    stamps = simulation.stamps_ns.tolist()
    with atomic_folder(out, replace=replace, marker=MARKER) as folder:
        for name in ("rgb", "depth"):
            (folder / name).mkdir()
            lines = [f"{seconds_text(t)} {name}/{seconds_text(t)}.png" for t in stamps]
            write_text(folder / f"{name}.txt", "\n".join(["# timestamp filename", *lines]) + "\n")
        write_text(folder / "calibration.yaml", kalibr_text(rig))
        write_tum(folder / "groundtruth.txt", truth)
        if simulation.imu is not None:
            write_text(folder / "imu.csv", imu_csv(simulation.imu))
        write_text(folder / MARKER, description(recording))
        for index, stamp_ns in enumerate(stamps):
            image, _ = recording.images(index)
            depth, _ = recording.depth(0, int(simulation.taken_ns[index]))
            name = f"{seconds_text(stamp_ns)}.png"
            write_png(folder / "rgb" / name, image)
            write_png(
                folder / "depth" / name,
                _levels(depth, np.random.default_rng([simulation.seed, index, 77])),
            )
            if progress is not None:
                progress(index + 1, len(stamps))


def _levels(depth_m: FloatArray, rng: np.random.Generator) -> np.ndarray:
    """A depth image (H, W) of 16 bits with a sensor's noise and range."""
    z = np.where(np.isfinite(depth_m), depth_m, 0.0)
    noisy = z + rng.normal(size=z.shape) * _DEPTH.noise * z**2
    inside = (z > _DEPTH.nearest_m) & (z < _DEPTH.farthest_m)
    return np.rint(np.where(inside, noisy, 0.0) * DEPTH_FACTOR).astype(np.uint16)
