"""Write a simulated recording as a folder in the layout of TUM RGB-D: images, depth images, and their lists."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from vio.cameras.rig import Rig
from vio.datasets.euroc_files import imu_csv
from vio.datasets.images import write_png
from vio.datasets.rigs.kalibr import kalibr_text
from vio.files.atomic import atomic_folder
from vio.files.text import seconds_text, write_text
from vio.files.trajectories import write_tum
from vio.geometry.lie import FloatArray, se3_inverse
from vio.protocols import Progress
from vio.sim.export import MARKER, description
from vio.sim.sequence import SimulatedRecording

_FACTOR = 5000  # levels per metre, as TUM's
_NOISE = 1.5e-3  # 1/m, k of a depth's standard deviation k z^2: structured light
_NEAREST_M, _FARTHEST_M = 0.4, 8.0  # beyond them such a sensor gives none


def export_rgbd(
    recording: SimulatedRecording, out: Path, *, replace: bool = False, progress: Progress | None = None
) -> None:
    """Render the left camera's frames with depth images as TUM RGB-D's layout, and `imu.csv` where there is an IMU.

    A depth has the standard deviation 0.0015 z^2, and is unknown (0) nearer than 0.4 m and beyond 8 m. Ground truth is
    that of the camera, or of the IMU where there is one.

    Raises:
        VioError: `out` exists and may not be replaced, or cannot be written.
    """
    simulation = recording.simulation
    T_cam0_imu = se3_inverse(simulation.calibration.T_imu_cam0)
    T_stated = None if simulation.imu is None else T_cam0_imu
    rig = Rig(simulation.calibration.cam0, T_cam0_imu=T_stated, depth_factor=_FACTOR)
    truth = recording.reference if simulation.imu is not None else recording.reference.in_cam0(T_cam0_imu)
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
            write_png(folder / "depth" / name, _levels(depth, np.random.default_rng([simulation.seed, index, 77])))
            if progress is not None:
                progress(index + 1, len(stamps))


def _levels(depth_m: FloatArray, rng: np.random.Generator) -> np.ndarray:
    """A depth image (H, W) of 16 bits with a sensor's noise and range."""
    z = np.where(np.isfinite(depth_m), depth_m, 0.0)
    noisy = z + rng.normal(size=z.shape) * _NOISE * z**2
    inside = (z > _NEAREST_M) & (z < _FARTHEST_M)
    return np.rint(np.where(inside, noisy, 0.0) * _FACTOR).astype(np.uint16)
