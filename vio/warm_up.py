"""Compile the loops of filter and IMU in a process of its own, at the first run of a machine.

numba compiles one function at a time in a process. While a run compiles what its first images need, a second process
filters a few made-up observations; the run finds the loops that it compiled in numba's cache on disk.
"""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import numpy as np

_FRAMES = 16  # until all loops were called: the window is full, and tracks have become landmarks
_FRAME_NS, _SAMPLE_NS = 100_000_000, 5_000_000
_GRAVITY = np.array([0.0, 9.81, 0.0])  # m/s^2, in the camera's frame: y points down


@contextmanager
def compiling_beside() -> Iterator[None]:
    """Compile the filter's loops in a process of its own, where they are not in the cache and two processors are free.

    The process ends with the context at the latest. Results do not depend on it.
    """
    if not (_is_cold() and _free_processors() >= 2):
        yield
        return
    command, quiet = [sys.executable, "-m", "vio.warm_up"], subprocess.DEVNULL
    environment = dict(os.environ)
    if cache := environment.get("NUMBA_CACHE_DIR"):
        environment["NUMBA_CACHE_DIR"] = os.path.abspath(cache)
    try:  # from the folder that holds vio: modules of the same names in the user's are not to be run
        home = Path(__file__).resolve().parents[1]
        helper = subprocess.Popen(command, cwd=home, env=environment, stdin=quiet, stdout=quiet, stderr=quiet)
    except OSError:  # as without it: the run compiles all by itself
        yield
        return
    try:
        yield
    finally:
        helper.kill()
        helper.wait()


def _free_processors() -> float:
    """Number of processors that this process may use, less those that were busy over the last minute."""
    usable = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    busy = os.getloadavg()[0] if hasattr(os, "getloadavg") else 0.0
    return usable - max(busy - 1.0, 0.0)  # what was busy may have been this process, or what installed it


def _is_cold() -> bool:
    """Whether numba's cache can be written and holds no loop of the filter as its source is now."""
    from vio.filters import track_loops

    folder = track_loops.eliminate_tracks.stats.cache_path  # type: ignore[attr-defined]
    if folder is None:
        return False
    with suppress(OSError):
        source = Path(track_loops.__file__).stat().st_mtime
        return all(file.stat().st_mtime < source for file in Path(folder).glob("track_loops.eliminate_tracks-*.nbi"))
    return False


def warm_up() -> None:
    """Filter observations of a wall from a camera that speeds up: with an IMU, then by the images alone.

    It calls the loops that runs call, in about their order, with arguments of the same types.
    """
    from vio.config import Config
    from vio.filters.settings import MsckfSettings
    from vio.geometry.stereo import StereoCamera, project
    from vio.odometry import Odometry

    camera = StereoCamera(fu=400.0, fv=400.0, cu=320.0, cv=240.0, baseline_m=0.2, width=640, height=480)
    rng = np.random.default_rng(0)
    wall = rng.uniform([-2.0, -1.5, 3.0], [2.0, 1.5, 5.0], (200, 3))
    lasting = np.arange(200) < 30
    acceleration, samples = np.array([0.5, 0.0, 0.3]), _FRAME_NS // _SAMPLE_NS
    calibrating = Config(msckf=MsckfSettings(calibrate_stereo="on"))
    for T_cam0_imu, config in ((np.eye(4), Config()), (None, calibrating)):
        odometry = Odometry(camera, config, T_cam0_imu=T_cam0_imu)
        for frame in range(_FRAMES):
            time_ns = frame * _FRAME_NS
            if T_cam0_imu is not None:
                since = time_ns - _SAMPLE_NS * np.arange(samples if frame else 1)[::-1]
                odometry.add_imu(since, np.zeros((len(since), 3)), np.tile(acceleration - _GRAVITY, (len(since), 1)))
            seen = np.flatnonzero(lasting | ((np.arange(200) + 30 * frame) % 200 < 120))
            z = project(camera, wall[seen] - 0.5 * acceleration * (1e-9 * time_ns) ** 2)
            odometry.add_observations(time_ns, seen, z + rng.normal(0.0, 0.2, z.shape))
        odometry.finish()


if __name__ == "__main__":
    warm_up()
