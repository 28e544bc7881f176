"""The recording of `vio demo`: a drive through a rendered street, with the paper's noisy velocities."""

from __future__ import annotations

from pathlib import Path

from vio.protocols import Progress
from vio.sim.effects import SensorEffects
from vio.sim.export import export_kitti
from vio.sim.imu import VelocityNoise
from vio.sim.motion import car_loop
from vio.sim.rigs import kitti_like_rig
from vio.sim.sequence import SimulatedRecording, simulate
from vio.sim.world import street

_RATE_HZ = 10.0
_DURATION_S = 14.0
_WIDTH_PX = 800
_START_M = 12.0  # the drive then covers a straight, a corner and another straight


def write_demo_recording(out: Path, progress: Progress | None = None) -> Path:
    """Render the demo's recording as a KITTI folder with ground truth, velocities and extrinsics; return the folder.

    Raises:
        VioError: the folder cannot be written, or holds foreign files.
    """
    simulation = simulate(
        street(seed=4),
        kitti_like_rig(_WIDTH_PX),
        car_loop(duration_s=_DURATION_S, start_m=_START_M, seed=4),
        rate_hz=_RATE_HZ,
        velocity=VelocityNoise(),
        effects=SensorEffects(read_noise=1.5, vignetting=0.2),
        seed=4,
    )
    export_kitti(SimulatedRecording(simulation), out, replace=True, progress=progress)
    return out
