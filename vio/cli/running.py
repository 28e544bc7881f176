"""Shared by `vio run` and `vio demo`: process a source, show progress, tabulate the metrics."""

from __future__ import annotations

import logging
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from vio.atomic import check_replaceable, check_writable, locked_folder
from vio.cli.progress import ProgressBar
from vio.cli.stopping import StopRequest
from vio.config import Config, load_config
from vio.datasets import open_dataset
from vio.datasets.span import Seconds, frames_between
from vio.errors import StoppedError, VioError
from vio.evaluation import KITTI_LENGTHS_M
from vio.pipeline import run
from vio.protocols import Dataset
from vio.records import Estimate, FrontendOutput, UpdateReport
from vio.run_folder import FILES, MARKER, finish_run_folder, growing_folder, read_request
from vio.run_recorder import CHECKPOINT, UNFINISHED
from vio.trajectory_io import read_trajectory

log = logging.getLogger(__name__)


class ProgressViewer:
    """A progress bar on stderr with frames per second; silent where stderr is no terminal."""

    def __init__(self, frames: int, label: str) -> None:
        self._bar = ProgressBar(label, frames, unit="frames")

    def frame(self, output: FrontendOutput, estimate: Estimate, report: UpdateReport) -> None:
        """Advance by one frame."""
        self._bar.advance()

    def skip(self, frames: int) -> None:
        """Count frames that an earlier process has done."""
        self._bar.update(frames)

    def close(self) -> None:
        """Close the bar."""
        self._bar.close()


def process(
    source: str,
    config: Config,
    *,
    out: Path | None,
    reference: Path | None = None,
    start: int | Seconds = 0,
    stop: int | Seconds | None = None,
    lengths_m: Sequence[float] | None = None,
    save_observations: bool = False,
    progress: bool = True,
) -> dict[str, Any]:
    """Process a source into a run folder, which grows meanwhile, and return its metrics."""
    dataset = open_dataset(source, config.dataset)
    for note in dataset.recording.notes:
        log.warning("%s", note)
    folder = check_out(out if out is not None else free_folder(dataset.recording.path))
    first, end = frames_between(dataset.recording, start, stop)
    request = {
        "source": f"{dataset.recording.kind}:{dataset.recording.path.absolute()}",
        "reference": None if reference is None else str(reference.absolute()),
        "start": first,
        "stop": end,
        "lengths_m": None if lengths_m is None else list(lengths_m),
        "save_observations": save_observations,
    }
    return _process(dataset, config, folder, request, progress=progress, resume=False)


def resume(folder: Path, *, progress: bool = True) -> dict[str, Any]:
    """Go on with an unfinished run and return its metrics.

    Raises:
        VioError: the folder holds no unfinished run, or one that another program began.
    """
    request = read_request(folder)
    config = load_config(folder / "config.yaml")
    dataset = open_dataset(request["source"], config.dataset)
    saved = (folder / UNFINISHED / CHECKPOINT).is_file()
    if not saved:
        log.warning("%s: the run ended before its first checkpoint; it begins again", folder)
    return _process(dataset, config, folder, request, progress=progress, resume=saved)


def _process(
    dataset: Dataset, config: Config, folder: Path, request: dict[str, Any], *, progress: bool, resume: bool
) -> dict[str, Any]:
    """Run, write the results and return the metrics; a run that was interrupted says so and how to go on."""
    recording, reference = dataset.recording, request["reference"]
    truth = recording.reference if reference is None else read_trajectory(Path(reference))
    start, stop, save_observations = request["start"], request["stop"], request["save_observations"]
    total = len(recording.frame_times_ns)
    frames = max(min(total, total if stop is None else stop) - start, 0)
    with locked_folder(folder), StopRequest() as asked:
        try:
            result = run(
                dataset,
                config,
                start=start,
                stop=stop,
                keep_observations=save_observations,
                viewer=ProgressViewer(frames, recording.path.name) if progress else None,
                folder=growing_folder(folder, dataset, config, request),
                resume=resume,
                should_stop=asked.reason,
            )
            metrics = finish_run_folder(
                folder,
                result,
                truth,
                lengths_m=request["lengths_m"] or KITTI_LENGTHS_M,
                save_observations=save_observations,
            )
        except KeyboardInterrupt as error:
            if not (folder / UNFINISHED).is_dir():
                raise
            text = f"interrupted; what was flushed is in {folder}; go on with: vio run --resume {folder}"
            raise StoppedError(text, status=130) from error
    if result.stopped is not None:
        text = f"{result.stopped}; the results of {len(result.frames)} of {frames} frames are in {folder}"
        if asked.number is None:
            raise StoppedError(f"error: {text}", status=1)
        raise StoppedError(f"{text}; go on with: vio run --resume {folder}", status=128 + asked.number)
    return metrics


def check_out(folder: Path) -> Path:
    """Reject a folder with other contents, or one that cannot be written, before the processing starts.

    Raises:
        VioError: the folder is not an earlier run's, the path is a file, or nothing can be written there.
    """
    if folder.exists() and not folder.is_dir():
        raise VioError(f"{folder}: is a file; --out takes a folder")
    check_replaceable(folder, replace=True, marker=MARKER, own=FILES)
    check_writable(folder)
    return folder


def free_folder(source: Path, root: Path = Path("runs")) -> Path:
    """Return the first of runs/NAME, runs/NAME-2, … that does not exist."""
    name = source.stem or "run"
    number = 1
    while (folder := root / (name if number == 1 else f"{name}-{number}")).exists():
        number += 1
    return folder


def rows_of(metrics: dict[str, Any]) -> list[tuple[str, str]]:
    """Return a run's metrics as a few table rows."""
    stages = ", ".join(f"{name} {ms:.1f}" for name, ms in metrics["stages_ms"].items())
    rows = [
        ("frames", f"{metrics['frames']}, path {metrics['path_length_m']:.2f} m"),
        ("time", f"{metrics['ms_per_frame']:.1f} ms a frame ({stages})"),
        ("back end", f"{metrics['backend']}, motion {metrics['motion']}"),
    ]
    if metrics["stereo_field"] is not None:
        field = metrics["stereo_field"]
        off, sigma = field["coefficients_px"][0], field["sigma_px"][0]
        rows.append(
            ("stereo", f"rows off by {field['rows_rms_px']:.2f} px (rms), disparities by {-off:+.2f} ± {sigma:.2f} px")
        )
    rows += _calibration_rows(metrics)
    if metrics["ate_m"] is None:
        rows.append(("ATE", "no reference"))
    else:
        against = metrics["dead_reckoning"]
        beside = "" if against is None else f"   (dead reckoning {against['ate_m']:.3f} m)"
        rows.append(("ATE", f"{metrics['ate_m']:.3f} m after SE(3) alignment{beside}"))
    if metrics["t_err_percent"] is not None:
        rows.append(("drift", f"{metrics['t_err_percent']:.2f} %, {metrics['r_err_deg_per_100m']:.3f} deg/100 m"))
    if metrics["landmark_error"] is not None:
        score = metrics["landmark_error"]
        rows.append(("landmarks", f"{score['rmse_m']:.3f} m ({score['matched']} of {score['surveyed']} surveyed ones)"))
    rows.append(("results", metrics["out"]))
    plot = Path(metrics["out"]) / "trajectory.png"
    rows.append(("plot", str(plot) if plot.is_file() else "could not be drawn"))
    return rows


def _calibration_rows(metrics: dict[str, Any]) -> list[tuple[str, str]]:
    """What was found of the camera's scale, and of camera and IMU; they are near zero where the calibration is good."""
    rows = []
    if scale := metrics["stereo_scale"]:
        found = [
            f"{name.replace('_', ' ')} off by {x['percent']:+.2f} ± {x['sigma_percent']:.2f} %"
            for name, x in scale.items()
        ]
        rows.append(("cameras", ", ".join(found)))
    if found_imu := metrics["camera_imu"]:
        words = []
        if "rotation_deg" in found_imu:
            for key, unit, digits in (("rotation", "deg", 2), ("translation", "mm", 1)):
                values, sigmas = found_imu[f"{key}_{unit}"], found_imu[f"{key}_sigma_{unit}"]
                size, sigma = math.hypot(*values), math.hypot(*sigmas)
                words.append(f"{key} {size:.{digits}f} ± {sigma:.{digits}f} {unit}")
        if "time_offset_ms" in found_imu:
            words.append(f"time {found_imu['time_offset_ms']:+.2f} ± {found_imu['time_offset_sigma_ms']:.2f} ms")
        rows.append(("camera-IMU", "off by " + ", ".join(words)))
    return rows
