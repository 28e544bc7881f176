"""The first run on a machine: what numba compiles for it, in processes side by side.

`python -m vio.live.first_use PART MOTION` compiles the loops of one part of a usual run, the front
end or the filter, by running that part alone over a camera that sways in front of two walls. What it
compiles stays in numba's cache, where the run finds it.
"""

from __future__ import annotations

import contextlib
import gc
import logging
import os
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from typing import IO, Literal, NamedTuple, TypeAlias

import numpy as np

from vio.config import Config, load_config
from vio.errors import NOTE
from vio.geometry.lie import FloatArray
from vio.geometry.stereo import StereoCamera
from vio.numerics import compiling, prebuilt
from vio.numerics.compiled import is_cached
from vio.numerics.kinds import Capacity
from vio.records import IntArray, RunMotion, StereoFrame

log = logging.getLogger(__name__)

Part: TypeAlias = Literal["frontend", "filter"]
_CAMERA = StereoCamera(300.0, 300.0, 320.0, 180.0, 0.1, 640, 360)


class _MadeUpRun(NamedTuple):
    """The run that is made up to be compiled for."""

    frames: Capacity[int] = 30
    points: Capacity[int] = 150
    min_track_frames: Capacity[int] = 4  # frames that a feature is seen in
    max_track_frames: Capacity[int] = 40
    noise_px: Capacity[float] = 0.1


_RUN = _MadeUpRun()


@contextmanager
def compiled_beside(parts: tuple[Part, ...], motion: RunMotion) -> Iterator[None]:
    """Compile parts of a run inside the block, each in a process of its own, where no machine code
    is at hand.

    A loop that this process calls first, and that such a process compiles, is waited for.
    """
    if compiling.before_first_call is not None or prebuilt.is_usable() or is_cached():
        yield
        return
    import subprocess  # none is started where there is machine code

    log.log(
        NOTE,
        "compiling loops, once for this installation: about %.0f s of computing",
        compiling.USUAL_S,
    )
    helpers = {
        part: subprocess.Popen(
            [sys.executable, "-m", __name__, part, motion], stdout=subprocess.PIPE
        )
        for part in parts
    }
    for helper in helpers.values():
        threading.Thread(target=_count_loops, args=(helper.stdout,), daemon=True).start()

    def wait_for(module: str) -> None:
        for part, helper in helpers.items():
            if module.startswith(compiling.PACKAGES[part]):
                with compiling.PROGRESS.waiting():
                    helper.wait()

    compiling.before_first_call = wait_for
    try:
        yield
    finally:
        compiling.before_first_call = None
        for helper in helpers.values():
            helper.terminate()
            helper.wait()


def _count_loops(pipe: IO[bytes]) -> None:
    """Count the loops of a process that compiles, which writes a byte for each."""
    with pipe:
        while pipe.read(1):
            compiling.PROGRESS.count()


def _write_count() -> None:
    with contextlib.suppress(BrokenPipeError):  # nobody counts any more
        os.write(sys.stdout.fileno(), b".")


def compile_part(part: Part, motion: RunMotion) -> None:
    """Run one part of a usual run, so that its loops are compiled."""
    config = load_config(overrides=[f"motion={motion}"])
    if part == "frontend":
        _run_frontend(config)
    else:
        for made in (config, replace(config, msckf=replace(config.msckf, calibrate_stereo="off"))):
            _run_filter(made)


def _run_frontend(config: Config) -> None:
    from vio.frontend import build_frontend
    from vio.live.warm_up import STEP_NS, SwayingCamera

    frontend = build_frontend("auto", _CAMERA, config.frontend)
    source = SwayingCamera(_CAMERA, np.eye(4), config.imu.gravity_mps2)
    for index in range(_RUN.frames):
        time_ns = index * STEP_NS
        left, right, _ = source.images(time_ns)
        frontend.process(StereoFrame(index, time_ns, left, right))


def _run_filter(config: Config) -> None:
    from vio.live.odometry import Odometry
    from vio.live.warm_up import STEP_NS, SwayingCamera

    T_cam0_imu = np.eye(4) if config.motion == "imu" else None
    odometry = Odometry(_CAMERA, config, T_cam0_imu=T_cam0_imu)
    source = SwayingCamera(_CAMERA, odometry.T_cam0_body, config.imu.gravity_mps2)
    features = _Features()
    for index in range(_RUN.frames):
        time_ns = index * STEP_NS
        source.add_samples(odometry, time_ns)
        x_m, *_ = source.motion(time_ns * 1e-9)
        odometry.add_observations(time_ns, *features.seen(index, x_m))
    odometry.landmarks()
    odometry.finish()


class _Features:
    """Points in front of a camera that sways sideways; each is seen for some frames, then another
    one takes its place.
    """

    def __init__(self) -> None:
        self._random = np.random.default_rng(0)
        self._ids: IntArray = np.arange(_RUN.points)
        self._next_id = _RUN.points
        self._points = self._new(_RUN.points)
        self._ends: IntArray = self._random.integers(1, _RUN.max_track_frames, _RUN.points)

    def _new(self, count: int) -> FloatArray:
        """Return points (count, 3) in the first camera's frame, x right and z ahead."""
        depth_m = self._random.uniform(2.0, 12.0, count)
        u = self._random.uniform(60.0, 580.0, count)
        v = self._random.uniform(20.0, 340.0, count)
        x = (u - _CAMERA.cu) / _CAMERA.fu * depth_m
        y = (v - _CAMERA.cv) / _CAMERA.fv * depth_m
        return np.stack([x, y, depth_m], axis=1)

    def seen(self, index: int, x_m: float) -> tuple[IntArray, FloatArray]:
        """Return ids (N,) and pixels (N, 4) in a frame, from a position along x."""
        ended = np.flatnonzero(self._ends <= index)
        if len(ended):
            self._ids[ended] = self._next_id + np.arange(len(ended))
            self._next_id += len(ended)
            self._points[ended] = self._new(len(ended)) + np.array([x_m, 0.0, 0.0])
            self._ends[ended] = index + self._random.integers(
                _RUN.min_track_frames, _RUN.max_track_frames, len(ended)
            )
        x, y, depth_m = self._points.T
        u = _CAMERA.fu * (x - x_m) / depth_m + _CAMERA.cu
        v = _CAMERA.fv * y / depth_m + _CAMERA.cv
        z = np.stack([u, v, u - _CAMERA.fu * _CAMERA.baseline_m / depth_m, v], axis=1)
        z += self._random.normal(0.0, _RUN.noise_px, z.shape)
        inside = (z[:, 0] > 0) & (z[:, 0] < 639) & (z[:, 2] > 0)
        return self._ids[inside], z[inside]


def main(argv: list[str]) -> int:
    """Compile one part for one kind of motion; write a byte to stdout for each loop."""
    part, motion = argv
    logging.addLevelName(NOTE, "NOTE")
    logging.basicConfig(level=NOTE, format="%(levelname)s: %(message)s", stream=sys.stderr)
    logging.getLogger("vio.monitor").setLevel(logging.ERROR)  # of images that are made up
    gc.disable()  # the compiler makes many objects that stay
    compiling.counted_by = _write_count
    compile_part(part, motion)  # type: ignore[arg-type]
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
