"""The recordings that faults are drawn for: real ones, and renders that are made once."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

from tools.faults.kinds import Half
from vio.numerics.threads import one_blas_thread
from vio.records import MotionSource
from vio.sim.export import export_euroc
from vio.sim.scenarios import Scenario, flight_files, plan, real_conditions
from vio.sim.sequence import SimulatedRecording


@dataclass(frozen=True, slots=True)
class Source:
    """A recording with a reference of whole poses."""

    name: str  # a folder among the recordings, or of a render
    motions: tuple[MotionSource | None, ...]  # what carries the pose between frames
    half: Half
    truth_sigma_m: float  # accuracy of a reference position relative to the first one
    frames: int | None = None  # at most so many are run
    render: Scenario | None = None  # how it is made, where it is none of the recordings
    flight: str | None = None  # a recorded flight among the recordings along which it is rendered


_SHORT_S = 5.0
_WIDTH_PX = 376
SOURCES = (
    Source("euroc/MH_01_head", ("imu", None), "work", 0.005),
    Source("kitti_06_head", (None,), "work", 0.03),
    Source("kitti_05_clip", (None,), "work", 0.03),
    Source("kitti_03_head", (None,), "kept", 0.03),
    Source("kitti_0039", (None,), "kept", 0.05, frames=70),
    Source(
        "render_room",
        ("imu", None),
        "work",
        0.0,
        render=Scenario(duration_s=_SHORT_S, width=_WIDTH_PX, seed=3),
    ),
    Source(
        "render_real_room",
        ("imu", None),
        "kept",
        0.0,
        render=Scenario(
            duration_s=_SHORT_S, width=_WIDTH_PX, seed=8, conditions=real_conditions("room")
        ),
    ),
    Source(
        "render_flight_V1_02",
        ("imu", None),
        "work",
        0.002,
        render=Scenario(duration_s=_SHORT_S, width=_WIDTH_PX, rig="euroc"),
        flight="euroc_real_imu/V1_02",
    ),
    Source(
        "render_flight_MH_03",
        ("imu", None),
        "kept",
        0.002,
        render=Scenario(duration_s=_SHORT_S, width=_WIDTH_PX, rig="euroc"),
        flight="euroc_real_imu/MH_03",
    ),
)


def ready(source: Source, data: Path, work: Path) -> Path:
    """Return the folder of a recording; a render is made first where it is not there yet.

    Args:
        source: the recording.
        data: folder of the real recordings.
        work: folder of the renders.
    """
    if source.render is None:
        return data / source.name
    folder = work / source.name
    if not folder.is_dir():
        _render(source, source.render, data, folder)
    return folder


def _render(source: Source, scenario: Scenario, data: Path, folder: Path) -> None:
    if source.flight is not None:
        truth, times, imu = flight_files(data / source.flight)
        assert imu is not None
        scenario = _along(scenario, truth, times, imu)
    folder.parent.mkdir(parents=True, exist_ok=True)
    with one_blas_thread():
        export_euroc(SimulatedRecording(plan(scenario)), folder)


def _along(scenario: Scenario, truth: Path, times: Path | None, imu: Path) -> Scenario:
    return replace(scenario, trajectory=truth, frame_times=times, imu=imu)
