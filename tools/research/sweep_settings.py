"""Every setting halved and doubled: what happens to the error, to the time, and whether anything happens at all.

    python tools/research/sweep_settings.py run --drive FOLDER --flight FOLDER --second-flight FOLDER
        --course 0027.npz=POSES --tracks DRIVE.mat --out sweep.jsonl
    python tools/research/sweep_settings.py report sweep.jsonl --out docs/notes/settings_sweep.md

Each setting is changed alone, in a context in which it can count (the table _CONTEXTS_OF), and the run is compared with
that context's own base run. Settings of the filter replay features that were logged once; settings of the front end see
images. A run's line is appended to the JSON lines as soon as it is done, so an interrupted sweep goes on where it was.
Time is the CPU time of the thread that runs front end, selector and filter; images are read beforehand.
"""

from __future__ import annotations

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import argparse
import hashlib
import json
import logging
import sys
import textwrap
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from fnmatch import fnmatchcase
from functools import lru_cache
from pathlib import Path
from typing import Any, Literal, TypeAlias

import numpy as np

from vio.config import Config, SettingInfo, describe, load_config, merge
from vio.datasets import open_dataset
from vio.datasets.observation_log import write_observation_log
from vio.errors import VioError
from vio.evaluation.trajectories import evaluate
from vio.files.trajectories import read_trajectory
from vio.numerics.threads import one_blas_thread
from vio.protocols import Dataset
from vio.records import Event, Observations, Recording, Trajectory
from vio.runs.pipeline import RunResult, run

Change = Literal["base", "half", "double", "other"]
Identity: TypeAlias = tuple[str, str, str, str]  # context, source, setting, value as JSON


@dataclass(frozen=True, slots=True)
class Source:
    """A recording of the sweep, its frames, and what its runs need besides the context."""

    argument: str  # the command line's argument that gives its path
    start: int = 0
    stop: int | None = None
    overrides: tuple[str, ...] = ()
    logged: bool = False  # replay the features that the default front end saw


@dataclass(frozen=True, slots=True)
class Context:
    """Settings under which others count, and the two recordings to see it on."""

    sources: tuple[str, ...]
    overrides: tuple[str, ...] = ()
    reads: bool = False  # the reader itself is part of the run


@dataclass(frozen=True, slots=True)
class Case:
    """One run."""

    context: str
    source: str
    setting: str  # empty: the context's base
    change: Change
    value: Any


@dataclass(frozen=True, slots=True)
class Outcome:
    """What one run reached; equal digests mean equal bits."""

    ate_m: float | None  # root mean square after SE(3) alignment
    cpu_ms: float | None  # a frame
    poses: str  # digest of the trajectory
    everything: str  # digest of poses, covariances, landmarks and the counts of each frame
    error: str | None = None


_SOURCES = {
    "drive": Source("drive", 0, 50, overrides=("motion=none",)),
    "flight": Source("flight", 80, 110),
    "drive, 20 frames": Source("drive", 0, 20, overrides=("motion=none",)),
    "flight, 20 frames": Source("flight", 80, 100),
    "drive log": Source("drive", overrides=("motion=none",), logged=True),
    "flight log": Source("flight", 60, 160, logged=True),
    "flight 2 log": Source("second_flight", 0, 100, logged=True),
    "flight 2 log, at rest": Source("second_flight", 120, 180, logged=True),
    "course": Source("course", 0, 120),
    "course, at rest": Source("course", 640, 700, overrides=("motion=none",)),
    "tracks": Source("tracks"),
}
_IMAGES, _LOGS, _FLIGHTS = ("drive", "flight"), ("drive log", "flight log"), ("flight log", "flight 2 log")
_FEWER, _VELOCITIES = ("drive, 20 frames", "flight, 20 frames"), ("drive log", "course")
_LOGGED_FRAMES = 400
_CONTEXTS = {
    "front end": Context(_IMAGES),
    "filter": Context(_LOGS),
    "reader": Context(_FEWER, reads=True),
    "feature files": Context(("course", "tracks"), reads=True),
    "orb": Context(_FEWER, ("frontend.name=orb",)),
    "kornia": Context(_FEWER, ("frontend.name=kornia",)),
    "no prior": Context(_FEWER, ("frontend.prior=false",)),
    "IMU": Context(_FLIGHTS, ("motion=imu",)),
    "no sensor": Context(_LOGS, ("motion=none",)),
    "velocities": Context(_VELOCITIES, ("motion=velocity",)),
    "at rest": Context(("flight 2 log, at rest", "course, at rest")),
    "calibrating": Context(_FLIGHTS, ("motion=imu", "msckf.calibrate=both")),
    "visibility": Context(_LOGS, ("selector.name=visibility",)),
    "visibility, few": Context(_LOGS, ("selector.name=visibility", "selector.keep_fraction=0.02")),
    "information": Context(_LOGS, ("selector.name=information", "selector.budget=60")),
    "vislam": Context(_VELOCITIES, ("backend=vislam", "motion=velocity")),
    "vislam input": Context(_VELOCITIES, ("backend=vislam", "motion=velocity", "vislam.motion_model=input")),
    "vislam isotropic": Context(_VELOCITIES, ("backend=vislam", "motion=velocity", "vislam.landmark_prior=isotropic")),
}
# The first pattern that fits a setting names the context in which it is changed, or several.
_CONTEXTS_OF: dict[str, str | tuple[str, ...]] = {
    "motion": "filter",
    "backend": "filter",
    "lag_frames": "filter",
    "dataset.colour": "reader",
    "dataset.interpolation": "reader",
    "dataset.*_frames": "reader",
    "dataset.*": "feature files",
    "frontend.learned.*": "kornia",
    "frontend.match.*": "orb",
    "frontend.grid.*": ("front end", "orb"),
    "frontend.disparity.*": ("front end", "orb"),
    "frontend.consensus.*": ("front end", "orb"),
    "frontend.klt.pyramid_levels": ("front end", "no prior"),
    "frontend.*": "front end",
    "selector.name": "filter",
    "selector.budget": "visibility",
    "selector.keep_fraction": "visibility",
    "selector.minimum": "visibility, few",
    "selector.sticky": "visibility",
    "selector.*": "information",
    "vislam.noise": "vislam input",
    "vislam.input_at": "vislam input",
    "vislam.landmark_prior_sigma_m": "vislam isotropic",
    "vislam.*": "vislam",
    "msckf.calibrate": "IMU",
    "msckf.extrinsic_*": "calibrating",
    "msckf.time_offset_*": "calibrating",
    "msckf.zero_*": "at rest",
    "msckf.rate_bias_*": "velocities",
    "msckf.linear_velocity_*": "velocities",
    "msckf.angular_rate_*": "velocities",
    "msckf.*acceleration_density": "no sensor",
    "msckf.gravity_*": "IMU",
    "msckf.gyro_*": "IMU",
    "msckf.accel_*": "IMU",
    "msckf.start_tilt_*": "IMU",
    "msckf.*": "filter",
}
# Values to try where there is nothing to halve.
_TRIED: dict[str, tuple[Any, ...]] = {
    "lag_frames": (2, 10),
    "dataset.colour": (False, True),
    "frontend.consensus.seed": (1, 2),
    "selector.budget": (30, 120),
    "dataset.prefetch_frames": (2, 8, 0),
}
_NOT_SWEPT = {
    "frontend.features": "names a file; the filter's contexts replay one",
    "dataset.calibration": "names a file",
    "dataset.topics": "names topics",
    "frontend.klt.mask": "names a picture",
    "frontend.learned.descriptor": "all others need weights",
    "frontend.learned.detector_weights": "names a file",
    "frontend.learned.descriptor_weights": "names a file",
    "frontend.learned.affine_weights": "names a file",
    "frontend.learned.orientation_weights": "names a file",
    "frontend.learned.matcher": "LightGlue needs weights",
    "frontend.learned.matcher_weights": "names a file",
    "frontend.learned.aliked_model": "needs weights",
    "frontend.learned.device": "needs a GPU",
    "msckf.calibrate_stereo": "newer than the sweep",
    "msckf.stereo_yaw_sigma_deg": "newer than the sweep",
    "msckf.stereo_field_sigma": "newer than the sweep",
}
_ONLY = {"frontend.learned.detector": ("harris",), "frontend.name": ("orb", "sift")}
_TAILS = ("msckf.gate_probability", "vislam.gate_probability")  # 1 - p is halved and doubled
_EXCESSES = ("frontend.klt.max_anchor_scale",)  # what exceeds 1 is halved and doubled
_RECORDINGS = {
    "drive": "KITTI raw 0039",
    "flight": "flight along EuRoC V1_02",
    "second_flight": "flight along EuRoC MH_03",
    "course": "ECE276A 0027",
    "tracks": "UTIAS 0005",
}
_NOTED_TIME, _MEANING, _NEIGHBOURS = 1.25, 110, 6
_INTRODUCTION = """# Settings, halved and doubled

All {settings} settings, and what happens when each alone is halved and doubled: {runs} runs of
`tools/research/sweep_settings.py`, which also writes this page. The drive is real; the flights are rendered along real
flights and carry their real IMU.

**How to read it.** *Where* names the context in which the setting was changed (the table below). A figure is the ATE
(root mean square, after SE(3) alignment) over that of the same run with the default, first recording / second
recording, then the same for a second context where a setting counts in two: above 1 is worse. `=` is equal to the bit,
in poses, covariances, landmarks and counts; `(=)` in the poses alone. `lost` is a filter that gave up, `refused` a
value that the recording or the other settings do not allow.

Time is the CPU time of front end, selector and filter over the median of the dozen runs before and after it in the same
context. The machine was busy with other work, and the times of runs that are equal to the bit scatter by
{scatter:.0f} % (standard deviation); so a time is given only where both recordings say more than 25 % either way.

**What it cannot tell.** The flights' errors are tenths of a millimetre to millimetres, and the pieces are short: take
ratios between a half and two for chance there. On the drive another seed of the vote moves the ATE by 1 %, another
choice of 60 features by 2 to 14 %. So no default follows from one figure of this page; it shows what a setting can do,
and what it cannot. Names, and numbers that cannot be halved, are tried in turn; of a probability `p` the tail `1 - p`
is halved and doubled, of a factor above 1 its excess; shares end at 1.
"""
_HEAD = (
    "| setting | default | unit | meaning | where | halved, or other values | doubled | time |\n"
    "|---|---:|---|---|---|---|---|---|\n"
)
_UNMOVED = """Guards that these recordings do not call upon, and settings of the readers. Three that changed nothing, or
no more than chance, are gone: `iterations` and `start_rate_sigma_radps` of `msckf`, constants now, and `guess` of
`frontend.klt`.
"""
_READINGS = {
    "dataset.colour": "neither recording holds colour images (`true` is refused on KITTI's folder and does not concern "
    "EuRoC's); `tests/test_datasets_kitti.py` reads both",
    "dataset.max_bad_frames": "guard: no image here is unreadable; `tests/test_datasets_kitti.py`, "
    "`test_datasets_euroc.py` and `test_cli.py` damage some",
    "dataset.prefetch_frames": "changes when images are decoded, not what they are; 0 spares the thread. "
    "`tests/test_datasets_images.py` holds order, depth and errors",
    "frontend.consensus.prior_max_deviation_deg": "guard against a moving object that wins the vote, which none does "
    "here; `tests/test_frontend_outliers.py` and `test_frontend_prior.py` have one",
    "frontend.consensus.prior_min_support": "the same; `tests/test_frontend_prior.py` has trucks of several sizes",
    "frontend.klt.min_gradient_over_noise": "counts where corners are few, as in the dark; "
    "`tests/test_frontend_klt.py` and `test_frontend_patches.py` are there",
    "frontend.klt.max_blind_frames": "guard: no image here is black; `tests/test_frontend_klt.py` blackens some",
    "msckf.pixel_sigma_max_px": "guard: the noise here stays below a pixel; Starry Night's does not "
    "([results](../results.md)); `tests/test_window_tracks.py` reaches it",
}


class Held:
    """A recording whose events of one run are kept in memory, so that reading costs no run any time."""

    def __init__(self, dataset: Dataset) -> None:
        self._dataset = dataset
        self._held: dict[tuple[int, int | None, bool], tuple[Event, ...]] = {}

    @property
    def recording(self) -> Recording:
        """The recording underneath."""
        return self._dataset.recording

    def events(self, start: int = 0, stop: int | None = None, *, images: bool = True) -> Iterator[Event]:
        """Yield the events, read once."""
        key = (start, stop, images)
        if key not in self._held:
            self._held[key] = tuple(self._dataset.events(start, stop, images=images))
        return iter(self._held[key])

    def observations(self, index: int) -> Observations | None:
        """Return the observations underneath."""
        return self._dataset.observations(index)


def main() -> int:
    """Run the sweep, or write its report."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    commands = parser.add_subparsers(required=True)
    sweep = commands.add_parser("run", help="do all runs that the results do not hold yet")
    for name in sorted({source.argument for source in _SOURCES.values()}):
        sweep.add_argument(f"--{name.replace('_', '-')}", required=True, metavar="SOURCE[=REFERENCE]")
    sweep.add_argument("--out", type=Path, required=True, metavar="JSONL", help="results; the logs lie beside it")
    sweep.add_argument("--only", default="*", metavar="PATTERN", help="settings to sweep, such as 'msckf.*'")
    sweep.set_defaults(execute=_sweep)
    report = commands.add_parser("report", help="write the page")
    report.add_argument("results", type=Path, metavar="JSONL")
    report.add_argument("--out", type=Path, required=True, metavar="MARKDOWN")
    report.set_defaults(execute=_report)
    args = parser.parse_args()
    try:
        args.execute(args)
    except VioError as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    return 0


def cases(settings: Iterator[SettingInfo], only: str = "*") -> list[Case]:
    """List the runs of a sweep: for every setting its changes on the recordings of its context, and all base runs."""
    changed = [
        Case(name, source, info.key, change, value)
        for info in settings
        if info.key not in _NOT_SWEPT and fnmatchcase(info.key, only)
        for name in contexts_of(info.key)
        for source in _CONTEXTS[name].sources
        for change, value in changes(info)
    ]
    bases = list(dict.fromkeys(Case(case.context, case.source, "", "base", None) for case in changed))
    # Grouped, so that few images are held at a time; each base run lies before what is compared with it.
    return sorted([*bases, *changed], key=lambda case: (list(_CONTEXTS).index(case.context), case.source))


def contexts_of(key: str) -> tuple[str, ...]:
    """Return the names of the contexts in which a setting is changed."""
    found = next(contexts for pattern, contexts in _CONTEXTS_OF.items() if fnmatchcase(key, pattern))
    return (found,) if isinstance(found, str) else found


def changes(info: SettingInfo) -> list[tuple[Change, Any]]:
    """Return the values that a setting is given beside its default."""
    key, default = info.key, info.default
    if key in _TRIED:
        return [("other", value) for value in _TRIED[key]]
    if info.choices:
        return [("other", choice) for choice in _ONLY.get(key, info.choices) if choice != default]
    if isinstance(default, bool):
        return [("other", not default)]
    if isinstance(default, int):
        return [("half", min(round(default / 2), default - 1)), ("double", max(2 * default, default + 1))]
    if key in _TAILS:
        return [("half", 1 - (1 - default) / 2), ("double", 1 - (1 - default) * 2)]
    if key in _EXCESSES:
        return [("half", 1 + (default - 1) / 2), ("double", 1 + (default - 1) * 2)]
    top = 1.0 if info.range.endswith("at most 1") else np.inf
    return [("half", default / 2), ("double", min(2 * default, top))]


def _sweep(args: argparse.Namespace) -> None:
    import cv2

    cv2.setNumThreads(1)
    logging.getLogger("vio").setLevel(logging.ERROR)  # what a bad setting does to a run is told by its figures
    todo = cases(describe(Config()), args.only)
    done = set(_read(args.out)) if args.out.exists() else set()
    paths = {name: getattr(args, name) for name in {source.argument for source in _SOURCES.values()}}
    bench = _Bench(paths, args.out.parent)
    for number, case in enumerate(todo, 1):
        if _identity(case) in done:
            continue
        outcome = bench.outcome(case)
        with args.out.open("a", encoding="utf-8") as stream:
            stream.write(json.dumps({**asdict(case), **asdict(outcome)}) + "\n")
        told = outcome.error or f"{outcome.ate_m:.4f} m, {outcome.cpu_ms:.1f} ms"
        print(f"{number}/{len(todo)} {case.context}, {case.source}: {case.setting}={case.value}: {told}", flush=True)


class _Bench:
    """Opens recordings, logs their features and runs cases on them."""

    def __init__(self, paths: dict[str, str], folder: Path) -> None:
        self._paths, self._folder = paths, folder
        self.held = lru_cache(maxsize=2)(self._open)

    def outcome(self, case: Case) -> Outcome:
        """Do one run; an expected error is a result too."""
        context, source = _CONTEXTS[case.context], _SOURCES[case.source]
        try:
            config = load_config(None, [*source.overrides, *context.overrides])
            if case.setting:
                nested: Any = case.value
                for part in reversed(case.setting.split(".")):
                    nested = {part: nested}
                config = merge(config, nested, where="the sweep")
            dataset, truth = self.held(case.source)
            if context.reads:
                dataset = open_dataset(dataset.recording.path, config.dataset)
            with one_blas_thread():
                began = time.thread_time()
                result = run(dataset, config, start=source.start, stop=source.stop)
                cpu_s = time.thread_time() - began
        except VioError as error:
            return Outcome(None, None, "", "", f"{type(error).__name__}: {error}")
        return Outcome(_ate(result, truth), 1e3 * cpu_s / len(result.frames), *_digests(result))

    def _open(self, name: str) -> tuple[Dataset, Trajectory]:
        source = _SOURCES[name]
        path, _, reference = self._paths[source.argument].partition("=")
        dataset = open_dataset(path)
        truth = read_trajectory(Path(reference)) if reference else dataset.recording.reference
        if truth is None:
            raise VioError(f"{path}: holds no ground truth; give it as {path}=POSES")
        if source.logged:
            dataset = open_dataset(self._log(source, dataset))
        if truth.times_ns is None and truth.frame_indices is None:
            truth = replace(truth, frame_indices=np.arange(len(truth), dtype=np.int64))
        held = Held(dataset)
        for images in (True, False):
            if images == dataset.recording.has_images:
                held.events(source.start, source.stop, images=images)
        return held, truth

    def _log(self, source: Source, dataset: Dataset) -> Path:
        """Return the log of what the default front end sees, made unless it is there."""
        path = self._folder / f"{source.argument}.npz"
        if not path.exists():
            config = load_config(None, list(source.overrides))
            result = run(dataset, config, stop=_LOGGED_FRAMES, keep_observations=True)
            assert result.observations is not None
            assert result.motion_samples is not None
            write_observation_log(path, dataset.recording, result.observations, result.motion_samples)
        return path


def _ate(result: RunResult, truth: Trajectory) -> float:
    return evaluate(result.trajectory, truth, T_cam0_imu=result.T_cam0_body).ate_m.rmse


def _digests(result: RunResult) -> tuple[str, str]:
    """Digests of the trajectory, and of all that a run tells but its times."""
    poses = hashlib.sha256(result.trajectory.T_world_body.tobytes()).hexdigest()[:16]
    everything = hashlib.sha256(poses.encode())
    for estimate in result.estimates:
        everything.update(estimate.covariance.tobytes())
    for array in (result.landmarks.ids, result.landmarks.p_world, result.landmarks.covariance):
        everything.update(array.tobytes())
    for f in result.frames:
        everything.update(repr((f.detected, f.tracked, f.matched, f.selected, f.used, f.gated)).encode())
    return poses, everything.hexdigest()[:16]


def _identity(case: Case) -> Identity:
    return case.context, case.source, case.setting, json.dumps(case.value)


def _read(path: Path) -> dict[Identity, Outcome]:
    """Read results; a line that was cut off by an interruption is left out, and its run done again."""
    found = {}
    for line in path.read_text(encoding="utf-8").splitlines():
        try:
            row = json.loads(line)
        except json.JSONDecodeError:
            continue
        case = Case(*(row.pop(name) for name in Case.__dataclass_fields__))
        found[_identity(case)] = Outcome(**row)
    return found


def _report(args: argparse.Namespace) -> None:
    found = _read(args.results)
    infos = list(describe(Config()))
    sections: dict[str, list[SettingInfo]] = {}
    for info in infos:
        sections.setdefault(info.key.rpartition(".")[0], []).append(info)
    times, scatter = _times(found)
    parts = [
        _INTRODUCTION.format(settings=len(infos), runs=len(found), scatter=100 * scatter),
        _contexts_table(),
        _unmoved_table(infos, found),
    ]
    for name, rows in sections.items():
        head = "The run" if not name else f"`{name}`"
        parts.append(f"## {head}\n\n{_HEAD}" + "".join(_row(info, found, times) for info in rows))
    args.out.write_text("\n".join(parts), encoding="utf-8")


def _times(found: Mapping[Identity, Outcome]) -> tuple[dict[Identity, float], float]:
    """Times over the median of their neighbours', and how those of runs that are equal to the bit scatter.

    Neighbours are the runs of the same context and source about the same time, when the machine was as busy.
    """
    series: dict[tuple[str, str], list[Identity]] = {}
    for identity, outcome in found.items():
        if outcome.cpu_ms is not None:
            series.setdefault(identity[:2], []).append(identity)
    times: dict[Identity, float] = {}
    for identities in series.values():
        cpu_ms = np.array([found[identity].cpu_ms for identity in identities], dtype=np.float64)
        for k, identity in enumerate(identities):
            times[identity] = float(cpu_ms[k] / np.median(cpu_ms[max(k - _NEIGHBOURS, 0) : k + _NEIGHBOURS + 1]))
    base = {identity[:2]: outcome.everything for identity, outcome in found.items() if not identity[2]}
    same = [times[i] for i in times if found[i].everything == base.get(i[:2])]
    return times, float(np.std(same))


def _contexts_table() -> str:
    rows = []
    for name, context in _CONTEXTS.items():
        first, second = (_told(source, context) for source in context.sources)
        overrides = " ".join(f"`{override}`" for override in context.overrides) or "the defaults"
        rows.append(f"| {name} | {overrides} | {first} | {second} |\n")
    return "## Where\n\n| where | settings | first recording | second recording |\n|---|---|---|---|\n" + "".join(rows)


def _told(name: str, context: Context) -> str:
    """Say what a source is, and which of its own settings the context leaves alone."""
    source = _SOURCES[name]
    frames = "" if source.stop is None else f", frames {source.start} to {source.stop - 1}"
    log_ = ", from its log" if source.logged else ""
    overruled = {override.partition("=")[0] for override in context.overrides}
    own = [f", `{override}`" for override in source.overrides if override.partition("=")[0] not in overruled]
    return _RECORDINGS[source.argument] + log_ + frames + "".join(own)


def _row(info: SettingInfo, found: Mapping[Identity, Outcome], times: Mapping[Identity, float]) -> str:
    """One setting's line of its section's table."""
    doc = textwrap.shorten(info.doc, _MEANING, placeholder=" …").replace("|", "\\|")
    first = f"| `{info.key}` | {_value(info.default)} | {info.unit} | {doc} |"
    if info.key in _NOT_SWEPT:
        return f"{first} | not swept: {_NOT_SWEPT[info.key]} | | |\n"
    cells: dict[Change, list[str]] = {"half": [], "double": [], "other": []}
    slower = []
    for change, value in changes(info):
        told = [_ratios(info.key, change, value, context, found) for context in contexts_of(info.key)]
        cells[change].append(f"{_value(value)}: {', '.join(told)}")
        context = contexts_of(info.key)[0]
        cases_ = [Case(context, source, info.key, change, value) for source in _CONTEXTS[context].sources]
        ratios = [times[_identity(case)] for case in cases_ if _identity(case) in times]
        if ratios and (min(ratios) > _NOTED_TIME or max(ratios) < 1 / _NOTED_TIME):
            slower.append(f"{_value(value)}: {' / '.join(f'{ratio:.2f}' for ratio in ratios)}")
    down = "; ".join(cells["half"] + cells["other"])
    where = ", ".join(contexts_of(info.key))
    return f"{first} {where} | {down} | {'; '.join(cells['double'])} | {'; '.join(slower)} |\n"


def _ratios(key: str, change: Change, value: Any, context: str, found: Mapping[Identity, Outcome]) -> str:
    """A change's errors over its base's on the two recordings of a context."""
    sources = _CONTEXTS[context].sources
    outcomes = [found.get(_identity(Case(context, source, key, change, value))) for source in sources]
    bases = [found.get(_identity(Case(context, source, "", "base", None))) for source in sources]
    return " / ".join(_compared(outcome, base) for outcome, base in zip(outcomes, bases, strict=True))


def _compared(outcome: Outcome | None, base: Outcome | None) -> str:
    """The ratio of the errors, or what stands in its place."""
    if outcome is None or base is None:
        return "not run"
    if outcome.error is not None:
        return "refused" if outcome.error.startswith(("ConfigError", "DataError")) else "lost"
    if outcome.everything == base.everything:
        return "="
    if outcome.poses == base.poses:
        return "(=)"
    assert outcome.ate_m is not None
    assert base.ate_m is not None
    return f"{outcome.ate_m / base.ate_m:.2f}"


def _value(value: Any) -> str:
    if value is None or isinstance(value, bool):
        return {None: "null", True: "true", False: "false"}[value]
    return f"{value:.6g}" if isinstance(value, float) else str(value)


def _unmoved(info: SettingInfo, found: Mapping[Identity, Outcome]) -> bool:
    """Whether no change of a setting moved any pose."""
    if info.key in _NOT_SWEPT:
        return False
    told = [_ratios(info.key, c, v, context, found) for c, v in changes(info) for context in contexts_of(info.key)]
    return all(one in ("=", "(=)", "refused") for pair in told for one in pair.split(" / "))


def _unmoved_table(infos: Sequence[SettingInfo], found: Mapping[Identity, Outcome]) -> str:
    rows = [f"| `{i.key}` | {_READINGS.get(i.key, 'not explained yet')} |\n" for i in infos if _unmoved(i, found)]
    return f"## What changed no pose\n\n{_UNMOVED}\n| setting | why it is there |\n|---|---|\n{''.join(rows)}"


if __name__ == "__main__":
    sys.exit(main())
