"""One task in a process of its own: `python -m vio.bench.worker FOLDER` reads job.json there and
writes result.json.

A process per task, wherever it was started: its memory and CPU time are its own, a crash costs one
row, and the result is the same on any engine. The process ends when its standard input is closed,
that is, with whoever started it.
"""

from __future__ import annotations

import json
import os
import platform
import re
import shutil
import sys
import tempfile
import threading
import time
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from vio.bench.figures import (
    absent_reasons,
    between,
    coverage,
    error_curve,
    figures_of,
    nees_figures,
    pose_nees,
)
from vio.bench.identity import code_digest, package_versions
from vio.bench.reverse import Reversed
from vio.config import Config, merge
from vio.datasets import open_dataset
from vio.datasets.frame_times import frames_between, parse_bound, used_frames
from vio.errors import DataError, EvaluationError, VioError
from vio.evaluation.association import associate
from vio.evaluation.errors_along_path import path_length_m
from vio.evaluation.field_agreement import disparity_field
from vio.evaluation.numbering import numbered_by_images
from vio.evaluation.trajectories import MIN_POSES, Evaluation, evaluate
from vio.files.printable import json_text
from vio.files.trajectories import read_trajectory, tum_text
from vio.numerics.kinds import Capacity
from vio.protocols import Dataset
from vio.records import NS_PER_S, BoolArray, IntArray, Recording, Trajectory

if TYPE_CHECKING:
    from vio.records import FrameResult
    from vio.runs.pipeline import RunResult

# in which compiled functions are loaded: left out of the CPU time a frame, as its wall times
_WARM_FRAMES: Capacity[int] = 8
_MAX_WARNINGS: Capacity[int] = 5  # of a run that its record keeps; no figure is made of them
JOB = "job.json"
RESULT = "result.json"
_BODY = re.compile(r"^#\s*body:\s*(\S+)", re.MULTILINE)
# Poses of a SLAM system in its map, as known at the end or at the time of their frame; else of its
# odometry.
_POSES = re.compile(r"^#\s*map:\s*(final|causal)\s*$", re.MULTILINE)


class _CpuTimer:
    """A viewer that notes the process's CPU time at each frame."""

    def __init__(self) -> None:
        self.frames = 0
        self.stages: dict[str, float] = {}  # median wall time of a stage
        self._began_s = self._ended_s = time.process_time()

    def frame(self, result: FrameResult) -> None:
        """Count a frame."""
        self.frames += 1
        self._ended_s = time.process_time()
        if self.frames <= _WARM_FRAMES:
            self._began_s = self._ended_s

    def close(self) -> None:
        """Nothing is held."""

    @property
    def ms_per_frame(self) -> float | None:
        """Mean CPU time of a frame after the first ones; None: there were no others."""
        count = self.frames - _WARM_FRAMES
        if count > 0:
            return 1e3 * (self._ended_s - self._began_s) / count
        return None


@dataclass(frozen=True, slots=True)
class _Truth:
    """What a trajectory is compared with."""

    dataset: Dataset
    reference: Trajectory | None
    first: int
    end: int
    covered: tuple[tuple[int, int], ...] = ()  # likewise, of each time that the cameras are covered

    @property
    def frame_times_ns(self) -> Any:
        """Times (F,) of the frames of the sequence."""
        return self.dataset.recording.frame_times_ns[self.first : self.end]


def perform(job: dict[str, Any]) -> dict[str, Any]:
    """Do one task; return figures (the same wherever it is done), what was measured, and why it
    failed, if it did.
    """
    began = time.perf_counter()
    record: dict[str, Any] = {
        "figures": {},
        "failure": None,
        "keep": True,
        "curve": None,
        "trajectory": None,
        "stereo_field": None,
    }
    timer = _CpuTimer()
    try:
        _check_place(job)
        config = merge(Config(), job["config"], where="the suite")
        truth = _truth(job, config)
        record |= _peer(job, truth) if job["kind"] == "peer" else _run(job, config, truth, timer)
    except VioError as error:
        record["failure"] = " ".join(str(error).split())
        cause = error.__cause__
        # What comes from the system, such as a full disk, may not come again; parsers set no
        # number.
        from_system = isinstance(cause, OSError) and cause.errno is not None
        record["keep"] = not (from_system or isinstance(error, _WrongPlaceError))
    except MemoryError:
        record |= {"failure": "out of memory", "keep": False}
    if job["kind"] == "peer":
        record["measured"] = {}
    else:
        record["measured"] = _measured(timer, began)
    return record


def _covered_spans(recording: Recording, covered: Sequence[Any]) -> tuple[tuple[int, int], ...]:
    """Return the frames, each first and end, of the parts of a recording whose images are covered.

    Raises:
        DataError: a part is none of the recording.
    """
    total = len(recording.frame_times_ns)
    parts = [frames_between(recording, *map(parse_bound, span)) for span in covered]
    spans = tuple(sorted((begin, total if last is None else last) for begin, last in parts))
    if any(begin >= last for begin, last in spans):
        raise DataError(f"{recording.path}: a part that is covered ends before it begins")
    return spans


def _truth(job: dict[str, Any], config: Config) -> _Truth:
    """Open the recording of a job."""
    dataset = open_dataset(job["source"], config.dataset)
    if job["stop"] is None:
        stop = None
    else:
        stop = parse_bound(job["stop"])
    first, end = frames_between(dataset.recording, parse_bound(job["start"]), stop)
    total = len(dataset.recording.frame_times_ns)
    spans = _covered_spans(dataset.recording, job["covered"])
    own = dataset.recording.reference
    reference = own
    if job["reference"] is not None:
        given = read_trajectory(Path(job["reference"]))
        reference = numbered_by_images(given, dataset.recording.image_numbers)
    if job["reverse"]:
        backward = Reversed(dataset, first, total if end is None else min(end, total))
        reference = None if reference is None else backward.backward(reference)
        dataset = backward
        first = 0
        end = total = len(backward.recording.frame_times_ns)
    if spans:
        from vio.bench.maps import Covered

        dataset = Covered(dataset, spans)
    return _Truth(dataset, reference, first, total if end is None else min(end, total), spans)


def reference_fault(job: dict[str, Any]) -> str | None:
    """Return why a run's ground truth cannot be that of its recording, by times and body; None: it
    may be.

    Nothing is run. A recording that cannot be opened is left to its task.
    """
    try:
        truth = _truth(job, merge(Config(), job["config"], where="the suite"))
    except VioError:
        return None
    if truth.reference is None:
        return None
    recording = truth.dataset.recording
    times_ns = truth.frame_times_ns
    name = f"the ground truth {job['reference'] or f'in {recording.path}'} is not that of the recording"
    stated = job["reference"] and _stated(_BODY, Path(job["reference"]))
    if stated == "imu" and recording.T_cam0_imu is None:
        return f"{name}: it describes the IMU, whose place on the rig (T_cam0_imu) the recording does not know"
    poses = np.broadcast_to(np.eye(4), (len(times_ns), 4, 4))
    frames = Trajectory(poses, times_ns, truth.reference.body, np.arange(truth.first, truth.end))
    try:
        matched = len(associate(frames, truth.reference.numbered())[1])
    except EvaluationError as error:
        return f"{name}: {str(error).replace('the estimate', 'the recording')}"
    return (
        f"{name}: it has poses of {matched} of {len(frames)} frames"
        if matched < MIN_POSES
        else None
    )


def _stated(pattern: re.Pattern[str], path: Path) -> str | None:
    """Return what a comment of a trajectory's file states; None: there is none of that kind."""
    found = pattern.search(path.read_text(encoding="utf-8", errors="replace"))
    return None if found is None else found[1]


def _measured(timer: _CpuTimer, began: float) -> dict[str, Any]:
    """What this process took, of which two repetitions differ."""
    return {
        "cpu_ms": timer.ms_per_frame,
        **timer.stages,
        "cpu_s": time.process_time(),
        "wall_s": time.perf_counter() - began,
        "memory_mib": _peak_memory_mib(),
        "host": platform.node(),
    }


class _WrongPlaceError(DataError):
    """The task was sent where its result would be another."""


def _check_place(job: dict[str, Any]) -> None:
    for what, wanted, here in (
        ("code", job["code"], code_digest()),
        ("packages", job["packages"], package_versions()),
    ):
        if wanted != here:
            raise _WrongPlaceError(
                f"the worker on {platform.node()} has other {what} than the command that sent the "
                "task: install the "
                "same versions there; if the code was edited meanwhile, repeat the bench"
            )


def _used(truth: _Truth, config: Config) -> IntArray:
    """Times (G,) of the frames of the sequence that the limit on the frame rate lets through."""
    times_ns = truth.dataset.recording.frame_times_ns
    used = used_frames(times_ns[: truth.end], config.dataset.max_frame_rate)
    return times_ns[used[used >= truth.first]]


def _run(job: dict[str, Any], config: Config, truth: _Truth, timer: _CpuTimer) -> dict[str, Any]:
    """Run the odometry as `vio run` does, with one thread of OpenCV, in a folder that is
    removed.
    """
    import cv2

    from vio.bench.maps import map_figures
    from vio.live.build import MapUse
    from vio.offline.map_adjustment import adjust_map
    from vio.runs.folder import growing_folder, landmark_error, refused_share

    # loads compiled functions: not for what cannot be opened
    from vio.runs.pipeline import RunControl, run

    cv2.setNumThreads(1)  # tasks run side by side; the figures do not depend on it
    with tempfile.TemporaryDirectory(prefix="vio-bench-", dir=job["scratch"]) as folder:
        growing = growing_folder(
            Path(folder) / "run", truth.dataset, config, {"source": "", "start": truth.first}
        )
        control = RunControl(growing)
        store = Path(folder) / "map.db"
        use = MapUse(store) if job["map"] else None
        T_ref_map = None
        if job["first"] is not None:
            built = merge(Config(), job["first"]["config"], where="the suite")
            before = _truth(job["first"], built)
            use = MapUse(store, localise=True)
            begin = before.first
            to = before.end
            made = run(
                before.dataset,
                built,
                start=begin,
                stop=to,
                map=MapUse(store),
                keep_observations=True,
            )
            made = adjust_map(made, store)
            if before.reference is None:
                T_ref_map = None
            else:
                T_ref_map = _world_of_map(made, before.reference)
        first = truth.first
        end = truth.end
        kept = bool(job["map"])
        result = run(
            truth.dataset,
            config,
            start=first,
            stop=end,
            viewer=timer,
            map=use,
            control=control,
            keep_observations=kept,
        )
        if kept:  # in a copy: loops are scored as they were measured
            result = adjust_map(result, Path(shutil.copy(store, Path(folder) / "adjusted.db")))
        trajectory = result.trajectory
        figures: dict[str, Any] = {
            "frames": len(result.frames),
            "path_m": path_length_m(trajectory.positions),
            "coverage": coverage(_used(truth, config), trajectory),
            "refused_share": refused_share(
                result.frames.column("used"), result.frames.column("gated")
            ),
            "used_per_frame": float(
                np.mean(np.asarray(result.frames.column("used"), dtype=np.float64))
            ),
            "landmarks": len(result.landmarks.ids),
            "innovation_px": _median(f.innovation_median_px for f in result.frames),
            "innovation_ratio": _median(f.innovation_ratio for f in result.frames),
        }
        timer.stages = _stages(result)
        record = {
            "figures": figures,
            "stereo_field": _field(result),
            "failure": result.stopped,
            "warnings": list(result.warnings[:_MAX_WARNINGS]),
        }
        if truth.reference is not None:
            score = _evaluate(job, trajectory, truth.reference, result.T_cam0_body)
            figures |= figures_of(score, positions_only=job["positions_only"])
            figures |= _nees(result, score) if job["exact_truth"] else {"nees": None}
            figures["landmarks_m"] = (landmark_error(result, score) or {}).get("rmse_m")
            record |= {"curve": error_curve(score, trajectory.times_ns), "notes": list(score.notes)}
            if result.mapped is not None and result.stopped is None:
                own = store if job["map"] else None
                figures |= map_figures(
                    result,
                    score,
                    truth.reference.numbered(),
                    store=own,
                    T_ref_map=T_ref_map,
                    covered=truth.covered,
                )
        assert trajectory.times_ns is not None
        text = tum_text(
            trajectory.times_ns,
            trajectory.T_world_body,
            body=trajectory.body,
            frames=trajectory.frame_indices,
        )
        record["trajectory"] = text.splitlines()  # JSON of ours holds printable text only
    record["absent"] = _absent(job, figures, truth)
    return record


def _field(result: RunResult) -> dict[str, Any] | None:
    """What the run has found that the stereo calibration is off by; None: nothing is estimated."""
    field = None
    if len(result.estimates):
        field = result.estimates[-1].stereo_field
    if field is None:
        found = None
    else:
        found = disparity_field(result.recording.camera, field)
    return None if found is None else found.as_dict()


def _world_of_map(result: RunResult, reference: Trajectory) -> Any:
    """Return the world of the reference (4, 4) from the map that a run has built."""
    assert result.mapped is not None
    final = replace(result.trajectory, T_world_body=result.mapped.T_map_body)
    return evaluate(final, reference.numbered(), T_cam0_imu=result.T_cam0_body).T_ref_est


def _absent(job: dict[str, Any], figures: dict[str, Any], truth: _Truth) -> dict[str, str]:
    return absent_reasons(
        figures,
        has_reference=truth.reference is not None,
        positions_only=job["positions_only"],
        peer=job["kind"] == "peer",
    )


def _stages(result: RunResult) -> dict[str, float]:
    """Return wall times of a frame in ms, start left out: medians of stages and of all, and what
    95 % stay within.
    """
    frames = list(result.frames)[_WARM_FRAMES:]
    if not frames:
        return {}
    total = [f.total_ms for f in frames]
    return {
        "frontend_ms": float(np.median([f.frontend_ms for f in frames])),
        "filter_ms": float(np.median([f.filter_ms for f in frames])),
        "wall_ms": float(np.median(total)),
        "wall_95_ms": float(np.percentile(total, 95)),
    }


def _median(values: Iterable[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return float(np.median(known)) if known else None


def _nees(result: RunResult, score: Evaluation) -> dict[str, float | None]:
    rows = result.estimates
    T_world_imu, covariances = (
        np.array(rows.column(name)) for name in ("T_world_imu", "covariance")
    )
    # With an IMU, the world stays that of the first seconds while gravity is known better, and says
    # where it points.
    stays = np.isfinite(np.array(rows.column("gravity_world"))).all(axis=1)
    upright: BoolArray = np.asarray(
        ~stays if result.motion == "imu" else np.zeros_like(stays), dtype=np.bool_
    )
    values = pose_nees(score, T_world_imu, covariances, result.T_cam0_body, upright=upright)
    return {"nees": None} if values is None else {**nees_figures(values, "nees")}


def _peer(job: dict[str, Any], truth: _Truth) -> dict[str, Any]:
    """Evaluate another system's trajectory on the recording."""
    recording = truth.dataset.recording
    if truth.reference is None:
        raise DataError(f"{recording.path}: no ground truth; name one with reference: in the suite")
    path = Path(job["trajectory"])
    trajectory = read_trajectory(path)
    if _stated(_BODY, path) is None:
        trajectory = replace(trajectory, body=truth.reference.body)
    times_ns = truth.frame_times_ns
    trajectory = between(trajectory, int(times_ns[0]), int(times_ns[-1]))
    score = _evaluate(job, trajectory, truth.reference, recording.T_cam0_body)
    covered = coverage(times_ns, trajectory)
    figures: dict[str, Any] = {
        "frames": len(trajectory),
        "path_m": score.path_length_m,
        "coverage": covered,
    }
    kind = _stated(_POSES, path)
    if kind is None:
        figures |= figures_of(score, positions_only=job["positions_only"])
    elif kind == "final":
        figures["map_ate_m"] = score.ate_m.rmse
    else:
        figures |= {"map_causal_ate_m": score.ate_m.rmse, "placed": covered}
        if trajectory.times_ns is not None:
            figures["place_s"] = float(trajectory.times_ns[0] - times_ns[0]) / NS_PER_S
    curve = error_curve(score, trajectory.times_ns)
    return {
        "figures": figures,
        "curve": curve,
        "absent": _absent(job, figures, truth),
        "notes": list(score.notes),
    }


def _evaluate(
    job: dict[str, Any], trajectory: Trajectory, reference: Trajectory, T_cam0_imu: Any
) -> Evaluation:
    return evaluate(
        trajectory, reference.numbered(), T_cam0_imu=T_cam0_imu, lengths_m=job["lengths_m"]
    )


def _peak_memory_mib() -> float | None:
    """Return the largest resident memory of this process; None where the system does not say.

    On Linux that of `VmHWM`: `ru_maxrss` would count the process that started this one.
    """
    try:
        for line in Path("/proc/self/status").read_text(encoding="ascii").splitlines():
            if line.startswith("VmHWM:"):
                return float(line.split()[1]) / 1024
    except OSError:
        pass
    try:
        import resource
    except ImportError:  # Windows
        return None
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak / (2**20 if sys.platform == "darwin" else 1024)


def _end_with_parent() -> None:
    """End this process when its standard input is closed."""

    def wait() -> None:
        while os.read(sys.stdin.fileno(), 1):
            pass
        os._exit(3)

    threading.Thread(target=wait, daemon=True).start()


def main(folder: Path) -> int:
    """Do the task of a folder."""
    _end_with_parent()
    job = json.loads((folder / JOB).read_text(encoding="utf-8"))
    text = json_text(perform(job))
    partial = folder / f"{RESULT}.partial"
    partial.write_text(text, encoding="utf-8")
    partial.replace(folder / RESULT)
    return 0


if __name__ == "__main__":
    sys.exit(main(Path(sys.argv[1])))
