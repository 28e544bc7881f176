"""Shared by `vio run` and `vio demo`: process a source, show progress, tabulate the metrics."""

from __future__ import annotations

import contextlib
import logging
import math
import shlex
import signal
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from vio.cli.output import ProgressBar
from vio.cli.stopping import StopRequest
from vio.cli.waiting import working
from vio.config import Config, load_config
from vio.dataclass import dataclass
from vio.datasets import open_dataset
from vio.datasets.frame_times import Seconds, frames_between, used_frames
from vio.errors import NOTE, CalibrationError, ConfigError, DataError, StoppedError, VioError
from vio.evaluation.trajectories import (
    lengths_text,
    metres_text,
    metres_texts,
    rotation_drift_text,
)
from vio.files.atomic import (
    atomic_write_bytes,
    atomic_write_text,
    check_new_file,
    check_replaceable,
    check_writable,
    locked_folder,
)
from vio.files.trajectories import read_trajectory
from vio.live.build import CONFIGURED, MapUse, Parts, resolve_motion
from vio.live.first_use import Part, compiled_beside
from vio.protocols import Dataset, Viewer
from vio.records import FrameResult, Recording, RunMotion, Trajectory, need_stereo
from vio.report.words import camera_imu_findings, scale_findings
from vio.runs.files import CHECKPOINT, FILES, RunFile
from vio.runs.folder import (
    Finishing,
    calibration_text,
    finish_run_folder,
    growing_folder,
    read_request,
)
from vio.runs.pipeline import RunControl, RunResult, Viewers, given_rig, run
from vio.runs.stated import RunRequest
from vio.view.annotated import AnnotatedImage

if TYPE_CHECKING:
    from vio.view.live import RerunViewer


log = logging.getLogger(__name__)

_COMPILED_S = 1.0  # in slow frames; less is the usual scatter
_LINES = 3  # of what the calibration is off by, in the summary; all are in metrics.json


class ProgressViewer:
    """A progress bar on stderr with frames per second; lines where stderr is no terminal."""

    def __init__(self, frames: int, label: str) -> None:
        self._bar = ProgressBar(label, frames, unit="frames", announced=True)

    def frame(self, result: FrameResult) -> None:
        """Advance by one frame."""
        self._bar.advance()

    def skip(self, frames: int) -> None:
        """Count frames that an earlier process has done."""
        self._bar.update(frames)

    def close(self) -> None:
        """Close the bar."""
        self._bar.close()


@dataclass(frozen=True, slots=True)
class RunOptions:
    """What is to be done with a source, as the command line has it."""

    out: Path | None = None  # folder; None: the first free one of runs/NAME
    reference: Path | None = None  # ground truth
    start: int | Seconds = 0
    stop: int | Seconds | None = None
    lengths_m: Sequence[float] | None = None
    save_observations: bool = False
    # file for the calibration that the run finds; `Path()`: in the run's folder
    save_calibration: Path | None = None
    map_file: Path | None = None
    map_density: int | None = None
    localise: bool = False
    plot: bool = True
    # front end or detector of the caller's own, FILE.py:CLASS or module:CLASS
    frontend: str | None = None
    command: str | None = None  # as typed, for the metrics


@dataclass(frozen=True, slots=True)
class Shown:
    """What a run shows while it goes on; no result depends on it."""

    progress: bool = True  # a bar
    view: str | None = None  # where rerun's viewer shows it; None: nowhere
    # gets the metrics before the picture is drawn
    finished: Callable[[dict[str, Any]], None] | None = None


SHOWN = Shown()


def process(
    source: str, config: Config, options: RunOptions, shown: Shown = SHOWN
) -> dict[str, Any]:
    """Process a source into a run folder, which grows meanwhile, and return its metrics."""
    dataset = _opened(source, config, mapped=options.map_file is not None)
    unused = dataset.recording.motion_notes if config.motion == "none" else ()
    for note in dataset.recording.notes:
        if note not in unused:
            log.log(NOTE, "%s", note)
    out = options.out
    folder = check_out(out if out is not None else free_folder(dataset.recording.path))
    calibration = _calibration_file(dataset, folder, options.save_calibration)
    first, end = frames_between(dataset.recording, options.start, options.stop)
    lengths_m = options.lengths_m
    request = RunRequest(
        source=f"{dataset.recording.kind}:{dataset.recording.path.absolute()}",
        reference=_absolute(options.reference),
        start=first,
        stop=end,
        lengths_m=None if lengths_m is None else list(lengths_m),
        save_observations=options.save_observations,
        save_calibration=_stated_calibration(folder, calibration),
        map=_absolute(options.map_file),
        map_density=options.map_density,
        localise=options.localise,
        plot=options.plot,
        frontend=options.frontend,
        command=options.command,
    )
    return _process(dataset, config, folder, request, shown, resume=False)


def _absolute(file: Path | None) -> str | None:
    return None if file is None else str(file.absolute())


def _stated_calibration(folder: Path, file: Path | None) -> str | None:
    """Return how a run's folder states where the calibration goes: in the folder, which may move,
    by the name alone.
    """
    if file is None or file == folder / RunFile.CALIBRATION:
        return None if file is None else file.name
    return str(file.absolute())


def _map_use(request: RunRequest) -> MapUse | None:
    if request.map is None:
        return None
    return MapUse(Path(request.map), request.localise, density=request.map_density)


def _opened(source: str, config: Config, *, mapped: bool) -> Dataset:
    """Open a recording; maps know pinholes only."""
    return open_dataset(
        source, replace(config.dataset, projection="pinhole") if mapped else config.dataset
    )


def resume(
    folder: Path,
    *,
    save_calibration: Path | None = None,
    map_file: Path | None = None,
    frontend: str | None = None,
    shown: Shown = SHOWN,
) -> dict[str, Any]:
    """Go on with an unfinished run and return its metrics.

    The folder may be of another hand: what it wants written outside of itself is written, and code
    that it names is run, only where the caller names the same, and all is checked as for a new run.

    Raises:
        VioError: the folder holds no unfinished run, one that another program began, or one that
            writes a file outside of it that was not named.
    """
    from vio.runs.live_folder import is_live

    request = read_request(folder)
    check_out(folder)
    if is_live(request):
        return _finish_live(folder, request, shown)
    calibration = _named_again(
        folder,
        request.save_calibration,
        "--save-calibration",
        save_calibration,
        inside=folder / RunFile.CALIBRATION,
    )
    request = replace(request, save_calibration=calibration)
    if not request.localise:  # which only reads the map
        request = replace(request, map=_named_again(folder, request.map, "--map", map_file))
    if request.frontend != frontend:
        raise ConfigError(
            f"{folder}: this run began "
            + (
                "without a front end of your own; leave --frontend out"
                if request.frontend is None
                else f"with code of your own; name it again: --frontend {request.frontend}"
            )
        )
    density = request.map_density
    if density is not None and density < 1:
        raise DataError(f"{folder}: its map_density is {density}, not at least 1; repeat the run")
    config = load_config(folder / RunFile.CONFIG)
    dataset = _opened(request.source, config, mapped=request.map is not None)
    if request.save_calibration is not None:
        _calibration_file(dataset, folder, _asked_calibration(folder, request))
    frames_between(dataset.recording, request.start, request.stop)
    saved = (folder / RunFile.UNFINISHED / CHECKPOINT).is_file()
    if not saved:
        log.warning("%s: the run ended before its first checkpoint; it begins again", folder)
    return _process(dataset, config, folder, request, shown, resume=saved)


def _finish_live(folder: Path, request: RunRequest, shown: Shown) -> dict[str, Any]:
    """Write the results of a live run whose program was killed, and return its metrics."""
    from vio.runs.live_folder import finish_live_folder

    log.warning("%s: a live run cannot go on; its results so far are written", folder)
    metrics = finish_live_folder(folder, request)
    if shown.finished is not None:
        shown.finished(metrics)
    return metrics


def _named_again(
    folder: Path, stated: str | None, flag: str, given: Path | None, inside: Path | None = None
) -> str | None:
    """Return a file that a run writes, as its folder states it; outside of the folder, only what
    the caller names too.

    Raises:
        ConfigError: the folder states another file than the caller, or the caller names none.
    """
    if stated is None:
        if given is not None:
            raise ConfigError(f"{flag}: the run in {folder} began without; leave it out")
        return None
    if inside is not None and stated in (inside.name, str(inside.absolute())):
        return inside.name
    if given is None:
        raise ConfigError(
            f"{folder}: this run writes {stated}, which lies outside of its folder; to go on, name "
            f"it again: {flag} {shlex.quote(stated)}"
        )
    if given.absolute() != Path(stated).absolute():
        raise ConfigError(f"{flag} {given}: the run in {folder} began with {stated}; name that one")
    return stated


def _asked_calibration(folder: Path, request: RunRequest) -> Path | None:
    """Return the file of `--save-calibration` as the command line has it; `Path()`: in the
    folder.
    """
    stated = request.save_calibration
    if stated is None:
        return None
    return Path() if stated == RunFile.CALIBRATION else Path(stated)


def _resume_command(folder: Path, request: RunRequest) -> str:
    """Return what goes on with a run, with the files outside of its folder that it writes."""
    words = ["vio", "run", "--resume", str(folder)]
    asked = _asked_calibration(folder, request)
    if asked not in (None, Path()):
        words += ["--save-calibration", str(asked)]
    if request.map is not None and not request.localise:
        words += ["--map", request.map]
    if request.frontend is not None:
        words += ["--frontend", request.frontend]
    return shlex.join(words)


def _process(
    dataset: Dataset,
    config: Config,
    folder: Path,
    request: RunRequest,
    shown: Shown,
    *,
    resume: bool,
) -> dict[str, Any]:
    """Run, write the results and return the metrics; an interrupted run reports how to go on."""
    recording = dataset.recording
    reference = request.reference
    truth = recording.reference if reference is None else read_trajectory(Path(reference))
    span = recording.frame_times_ns[: request.stop]
    frames = int((used_frames(span, config.dataset.max_frame_rate) >= request.start).sum())
    annotated = AnnotatedImage(frames)
    viewers: list[Viewer] = [annotated]
    view = None if shown.view is None else _open_view(shown.view, dataset, config, truth)
    if view is not None:
        viewers.append(view)
    parts = _own_parts(request, recording, config)
    beside: tuple[Part, ...] = ("filter",) if recording.camera.kind == "stereo" else ()
    motion = _likely_motion(recording, config)
    with (
        locked_folder(folder),
        compiled_beside(beside, motion),
        StopRequest() as asked,
        contextlib.ExitStack() as bar,
    ):
        if shown.progress:
            progress = ProgressViewer(frames, f"running {recording.path.name}")
            bar.callback(progress.close)
            viewers.insert(0, progress)
        try:
            result = run(
                dataset,
                config,
                start=request.start,
                stop=request.stop,
                # which the adjustment of a map takes
                keep_observations=request.save_observations or request.writes_map,
                viewer=Viewers(viewers),
                parts=parts,
                map=_map_use(request),
                control=RunControl(
                    growing_folder(folder, dataset, config, request.values()), resume, asked.reason
                ),
            )
            if request.map is not None and request.writes_map:
                from vio.offline.map_adjustment import adjust_map

                result = adjust_map(result, Path(request.map), asked.reason)
            metrics = _finish(folder, request, result, truth, annotated, shown)
        except KeyboardInterrupt as error:
            if not (folder / RunFile.UNFINISHED).is_dir():
                raise
            why = asked.reason() or "interrupted"
            text = (
                f"{why}; what was flushed is in {folder}; go on with: "
                f"{_resume_command(folder, request)}"
            )
            number = signal.SIGINT if asked.number is None else asked.number
            raise StoppedError(text, status=128 + number) from error
    if view is not None:
        _leave_view(view, result)
    if result.stopped is not None:
        text = f"{result.stopped}; the results of {len(result.frames)} of {frames} frames are in {folder}"
        if asked.number is None:
            raise StoppedError(f"error: {text}", status=1)
        raise StoppedError(
            f"{text}; go on with: {_resume_command(folder, request)}", status=128 + asked.number
        )
    return metrics


def _finish(
    folder: Path,
    request: RunRequest,
    result: RunResult,
    truth: Trajectory | None,
    annotated: AnnotatedImage,
    shown: Shown,
) -> dict[str, Any]:
    """Write the results and return the metrics.

    Raises:
        CalibrationError: no calibration could be saved; all other results are written.
    """
    stated = request.save_calibration
    file = None if stated is None else folder / stated  # an absolute path stays itself
    calibration = None if file is None else _calibration_or_fault(result)

    def complete(metrics: dict[str, Any]) -> None:
        if isinstance(calibration, str) and file is not None:
            atomic_write_text(file, calibration)
        if (picture := annotated.jpeg()) is not None:
            atomic_write_bytes(folder / RunFile.FEATURES, picture)
        if shown.finished is not None and metrics["complete"]:
            shown.finished(metrics)

    saved = file is not None and isinstance(calibration, str)
    metrics = finish_run_folder(
        folder,
        result,
        truth,
        Finishing(
            lengths_m=request.lengths_m,
            save_observations=request.save_observations,
            more={
                "command": request.command,
                "calibration": str(file.absolute()) if saved and file is not None else None,
            },
            plot=request.plot,
            finished=complete,
        ),
    )
    if isinstance(calibration, CalibrationError):  # on which the results do not depend
        raise calibration
    return metrics


def _leave_view(view: RerunViewer, result: RunResult) -> None:
    """Show the landmarks, and keep a web page up until it is interrupted."""
    view.landmarks(result.landmarks)
    view.close()
    if view.address is not None and result.stopped is None:
        from vio.view.stream import wait_for_interrupt

        with working(lambda: None):  # until it is interrupted: a silence is no wait
            wait_for_interrupt(view.address)


def _own_parts(request: RunRequest, recording: Recording, config: Config) -> Parts:
    """Return the parts of the caller's own that a run was asked for."""
    text = request.frontend
    if text is None:
        return CONFIGURED
    from vio.frontend.given import load_given

    if not recording.has_images:
        raise ConfigError(f"--frontend {text}: {recording.path} holds features, and no images")
    return Parts(frontend=load_given(text, recording.camera, config.frontend))


def _likely_motion(recording: Recording, config: Config) -> RunMotion:
    """Return what a run will take to propagate poses, without the checks of the run itself."""
    if config.motion != "auto":
        return config.motion
    if "imu" in recording.motion:
        return "imu"
    return "velocity" if "velocity" in recording.motion else "none"


def _calibration_or_fault(result: RunResult) -> str | CalibrationError:
    """Return what `--save-calibration` writes, or why there is none; read before the unfinished
    folder goes.
    """
    try:
        return calibration_text(result)
    except CalibrationError as error:
        return CalibrationError(f"no calibration was saved, all other results were: {error}")


def _calibration_file(dataset: Dataset, folder: Path, asked: Path | None) -> Path | None:
    """Return where a run's calibration goes, checked before the processing starts.

    None: it was not asked for.
    """
    if asked is None:
        return None
    need_stereo(dataset.recording, "--save-calibration")
    if given_rig(dataset) is None:
        if dataset.recording.camera.is_cylinder:
            raise DataError(
                f"{dataset.recording.path}: holds features of images on a cylinder, which no lens "
                "model holds; run on "
                "the images, or leave --save-calibration out"
            )
        raise DataError(
            f"{dataset.recording.path}: states no image size, which a calibration needs; leave "
            "--save-calibration out"
        )
    if asked == Path():
        return folder / RunFile.CALIBRATION
    if asked.suffix.lower() not in (".yaml", ".yml"):
        raise ConfigError(
            f"--save-calibration {asked}: writes Kalibr's format; give a file name that ends in "
            ".yaml"
        )
    if asked.is_dir() or not asked.absolute().parent.is_dir():
        raise DataError(
            f"--save-calibration {asked}: its folder does not exist, or it is one; name a file"
        )
    check_new_file(asked, b"# by vio run")
    check_writable(asked)
    return asked


def _open_view(
    where: str, dataset: Dataset, config: Config, reference: Trajectory | None
) -> RerunViewer:
    """Open rerun's viewer, a file or a web server for a run."""
    from vio.view.live import RerunViewer, ViewedRig
    from vio.view.stream import open_stream

    recording = dataset.recording
    rig = ViewedRig(
        recording.camera, recording.T_cam0_body, resolve_motion(recording, config), reference
    )
    stream, address = open_stream(where, recording.path.name)
    if address is not None:
        log.log(NOTE, "the run is shown at %s", address)
    return RerunViewer(stream, rig, address=address)


def check_out(folder: Path) -> Path:
    """Reject a folder with other contents, or one that cannot be written, before the processing
    starts.

    Raises:
        VioError: the folder is not an earlier run's, the path is a file, or nothing can be written
            there.
    """
    if folder.exists() and not folder.is_dir():
        raise VioError(f"{folder}: is a file; --out takes a folder")
    check_replaceable(folder, replace=True, marker=RunFile.METRICS, own=FILES)
    check_writable(folder)
    return folder


def free_folder(source: Path, root: Path = Path("runs")) -> Path:
    """Return the first of runs/NAME, runs/NAME-2, … that does not exist."""
    name = source.stem or "run"
    number = 1
    while (folder := root / (name if number == 1 else f"{name}-{number}")).exists():
        number += 1
    if number > 1:
        log.log(NOTE, "%s is there: results go to %s", root / name, folder)
    return folder


def _integrity_text(integrity: dict[str, int]) -> str:
    """How many estimates may be used, in words."""
    counts = ", ".join(f"{count} {name}" for name, count in integrity.items() if count)
    return f"{counts}; see the findings above, and the column `integrity` of frames.csv"


def metric_rows(
    metrics: dict[str, Any], *, plot: bool = True, reported: bool = False
) -> list[tuple[str, str]]:
    """Return a run's metrics as a few table rows, ended by what to do next.

    Args:
        metrics: of the run.
        plot: whether its picture is drawn.
        reported: whether a page about it is written anyway.
    """
    stages = ", ".join(f"{name} {ms:.1f}" for name, ms in metrics["stages_ms"].items())
    frames = metrics["frames"]
    span = metrics["last_frame"] - metrics["first_frame"] + 1
    median = metrics["ms_per_frame_median"]
    most = metrics["ms_per_frame_95"]
    rows = [
        (
            "frames",
            f"{frames}{f' of {span}' if span > frames else ''}, path {_path_text(metrics)}",
        ),
        ("time", f"{median:.1f} ms a frame, 95 % within {most:.1f} ({stages})"),
    ]
    if metrics["start_s"] > _COMPILED_S:
        rows.append(
            (
                "",
                f"and {metrics['start_s']:.0f} s in slow frames: loops are compiled once on a "
                "machine",
            )
        )
    rows.append(("back end", f"{metrics['backend']}, motion {metrics['motion']}"))
    rows += _refused_rows(metrics)
    rows += _scale_rows(metrics)
    rows += _stereo_rows(metrics)
    rows += _calibration_rows(metrics)
    rows += _error_rows(metrics)
    rows += _map_rows(metrics)
    if metrics.get("calibration") is not None:
        rows.append(("calib.", f"{metrics['calibration']} (next: --calibration FILE)"))
    rows.append(("results", metrics["out"]))
    if plot:
        rows.append(("plot", str(Path(metrics["out"]) / RunFile.PICTURE)))
    if not reported:
        rows.append(("next", f"vio report {shlex.quote(metrics['out'])} --open"))
    return rows


def _path_text(metrics: dict[str, Any]) -> str:
    """Return the length of the estimated path, and of the path that is compared with ground truth:
    in a bend, camera and IMU go different lengths.
    """
    own = f"{metrics['path_length_m']:.2f} m"
    scores = metrics.get("evaluation")
    if not scores or scores["body"] == metrics["body"]:
        return own
    compared = f"{scores['path_length_m']:.2f} m of {scores['body']}"
    return f"{own} of {metrics['body']}, {compared} (as ground truth)"


def _refused_rows(metrics: dict[str, Any]) -> list[tuple[str, str]]:
    """What the gates refused."""
    rows: list[tuple[str, str]] = []
    if metrics["refused_share"] is not None:
        refused = (
            f"{100 * metrics['refused_share']:.1f} % of the observations, by the chi-square gates"
        )
        ratio = metrics.get("innovation_ratio")
        more = (
            ""
            if ratio is None
            else f"; innovations are {ratio:.2g} of their standard deviation (median)"
        )
        rows.append(("refused", refused + more))
    return rows


def _scale_rows(metrics: dict[str, Any]) -> list[tuple[str, str]]:
    """How many estimates may be used, and what is known of the scale."""
    rows: list[tuple[str, str]] = []
    frames = metrics["frames"]
    integrity = metrics.get("integrity") or {}
    unusable = integrity.get("unusable", 0)
    if unusable or integrity.get("degraded"):
        rows.append(("integrity", _integrity_text(integrity)))
    if unusable:
        share = 100 * unusable / frames
        rows.append(("scale", f"not stated, as {share:.0f} % of the estimates are unusable"))
    elif metrics.get("scale_sigma") is not None:
        sigma = f"{100 * metrics['scale_sigma']:.2g} %"
        rows.append(
            (
                "scale",
                f"one camera: from the IMU, standard deviation {sigma} (median of the frames)",
            )
        )
    elif metrics["camera"].get("kind") == "rgbd":
        rows.append(("scale", "one camera: from the depth images"))
    elif metrics.get("rig_scale_sigma"):
        share = metrics["rig_scale_sigma"]
        path_m = metrics["path_length_m"]
        of_path = f"{metres_text(share * path_m)} of {path_m:.2f} m"
        unchecked = " unchecked" if metrics["motion"] == "none" else ""
        known = f"known to {100 * share:.2g} % by the{unchecked} calibration: {of_path}"
        doubted = bool(metrics.get("doubts"))
        rows.append(("scale", "in doubt: settle what the notes above name" if doubted else known))
    return rows


def _stereo_rows(metrics: dict[str, Any]) -> list[tuple[str, str]]:
    """What the stereo calibration is off by."""
    rows: list[tuple[str, str]] = []
    if metrics["stereo_field"] is not None:
        field = metrics["stereo_field"]
        rows.append(("stereo", f"{field['text']}; corrected in this run"))
        found = [] if field["rig"] is None else field["rig"]["lines"]
        rows += [("", line) for line in found[:_LINES]]
    return rows


def _error_rows(metrics: dict[str, Any]) -> list[tuple[str, str]]:
    """Errors against the reference."""
    rows: list[tuple[str, str]] = []
    if metrics["ate_m"] is None:
        rows.append(("ATE", "no reference"))
    else:
        against = metrics["dead_reckoning"]
        free = metrics["evaluation"]["scale_free"]
        scores = (metrics, free, against)
        texts = iter(metres_texts(*(score["ate_m"] for score in scores if score is not None)))
        rows.append(("ATE", f"{next(texts)} after SE(3) alignment"))
        if free is not None:
            off = f"{100 * (free['scale'] - 1):+.2f} %"
            rows.append(("", f"{next(texts)} after Sim(3), scale off by {off}"))
        if against is not None:
            rows.append(("", f"{next(texts)} by dead reckoning"))
    if metrics["t_err_percent"] is not None:
        over = lengths_text(metrics["drift_lengths_m"])
        turned = rotation_drift_text(metrics["r_err_deg_per_100m"], metrics["drift_lengths_m"])
        rows.append(("drift", f"{metrics['t_err_percent']:.2f} %, {turned} over {over}"))
    return rows


def _map_rows(metrics: dict[str, Any]) -> list[tuple[str, str]]:
    """The map, and errors of landmarks."""
    rows: list[tuple[str, str]] = []
    if metrics.get("map") is not None:
        rows.append(("map", _map_row(metrics["map"])))
        if metrics["map"].get("adjustment") is not None:
            rows.append(("", f"adjusted {metrics['map']['adjustment']}"))
    if metrics["landmark_error"] is not None:
        score = metrics["landmark_error"]
        rows.append(
            (
                "landmarks",
                f"{metres_text(score['rmse_m'])} ({score['matched']} of {score['surveyed']} "
                "surveyed ones)",
            )
        )
    return rows


def _calibration_rows(metrics: dict[str, Any]) -> list[tuple[str, str]]:
    """What was found of the camera's scale, and of camera and IMU; they are near zero where the
    calibration is good.
    """
    scale = scale_findings(metrics)
    rows = [("cameras", ", ".join(scale))] if scale else []
    rows += [("IMU", line) for line in camera_imu_findings(metrics)]
    for sensor, own in (metrics.get("imu") or {}).items():
        rows += _imu_rows(sensor, own)
    return rows


def _imu_rows(sensor: str, own: dict[str, dict[str, float]]) -> list[tuple[str, str]]:
    """What is clearly wrong with the scales and axes of one sensor of the IMU."""
    rows = []
    if _is_clear(own, "scale_percent"):
        sigmas = own["scale_percent_sigma"]
        words = [
            f"{axis} {v:+.2f} ± {sigmas[axis]:.2f}" for axis, v in own["scale_percent"].items()
        ]
        rows.append(("IMU", f"{sensor} scale {', '.join(words)} %"))
    if _is_clear(own, "misalignment_deg"):
        size = math.hypot(*own["misalignment_deg"].values())
        sigma = math.hypot(*own["misalignment_deg_sigma"].values())
        rows.append(("" if rows else "IMU", f"{sensor} misalignment {size:.2f} ± {sigma:.2f} deg"))
    return rows


def _is_clear(own: dict[str, dict[str, float]], kind: str) -> bool:
    """Whether one of the terms of a kind is beyond three standard deviations."""
    sigmas = own.get(f"{kind}_sigma", {})
    return any(abs(v) > 3 * sigmas[axis] for axis, v in own.get(kind, {}).items())


def _map_row(of_map: dict[str, Any]) -> str:
    """Return what a run made of its map as one table row."""
    ate = "" if of_map["ate_m"] is None else f", ATE {metres_text(of_map['ate_m'])}"
    place = "" if of_map["joined"] else "; its place in the map was not found"
    placed = f", {100 * of_map['placed']:.1f} % of the frames placed at the time"
    return f"{of_map['keyframes']} keyframes, {of_map['loops']} loops{ate}{placed}{place}"
