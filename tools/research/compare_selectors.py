"""Every selector under every budget on recordings of your own: accuracy, and what the chosen features said.

    python tools/research/compare_selectors.py SOURCE[=REFERENCE][@START:STOP] … --out FOLDER
        [--backends msckf vislam] [--budgets 20 40 80] [--seeds 3] [--jobs 2]

SOURCE is anything that `vio run` takes; a recording with precomputed features, such as the observations.npz that
`vio run --save-observations` writes, makes all runs see the same features and takes no time for the images. Motion is
that of the images alone. Each selector but `all` runs with and without stickiness, `random` with several seeds.

Writes FOLDER/table.md (also printed), FOLDER/runs.json and FOLDER/selection.png. For every frame the gain is
computed the same way for all selectors: half the log-determinant (nats) that the chosen features add to a broad prior
on the last motion. `correction` is how far the update moved that motion from its prediction.
"""

from __future__ import annotations

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import argparse
import json
import sys
from collections.abc import Iterable
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass, replace
from functools import lru_cache
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
from scipy.stats import rankdata

from vio.config import BackendName, Config, load_config
from vio.datasets import open_dataset
from vio.errors import VioError
from vio.evaluation import associate_times, evaluate
from vio.geometry.lie import FloatArray, se3_inverse, se3_log
from vio.information import MotionInformation, log_det_gain, prior_information
from vio.pipeline import RunResult, run
from vio.protocols import Dataset, Selector
from vio.records import MotionPrior, Observations, Selection, Trajectory
from vio.selectors import SelectorSettings, build_selector
from vio.threads import one_blas_thread
from vio.trajectory_io import read_trajectory

_SHARE = 0  # stands for the share of the configuration in the list of budgets
_PIXEL_SIGMA_PX = 0.5
_SELECTORS = ("visibility", "visibility_whole", "grid", "random", "information")
_COLOURS = {
    "all": "#111111",
    "visibility": "#5aa469",
    "visibility_whole": "#8e63b8",
    "grid": "#d9822b",
    "random": "#9aa5b1",
    "information": "#1f5fbf",
}
_MARKERS, _STYLES = {False: "o", True: "s"}, {False: "-", True: "--"}


@dataclass(frozen=True, slots=True)
class Source:
    """A recording, its reference and the frames to use."""

    name: str
    path: str
    reference: str | None
    start: int
    stop: int | None


@dataclass(frozen=True, slots=True)
class Job:
    """One run."""

    source: Source
    backend: BackendName
    selector: SelectorSettings


@dataclass(frozen=True, slots=True)
class Outcome:
    """What one run reached; arrays hold one entry per frame, NaN where a figure does not exist."""

    job: Job
    ate_m: float | None  # None: the filter lost its way
    rpe_m: float | None  # root mean square error of the motion from one frame to the next
    rpe_deg: float | None
    selected: float  # observations a frame
    used: float
    track_frames: float  # mean length of the runs of frames in which a feature was chosen
    select_ms: float  # median
    filter_ms: float
    gain_nats: FloatArray
    correction_m: FloatArray
    error_before_m: FloatArray  # of the predicted last motion
    error_after_m: FloatArray  # of the estimated last motion


class Watched:
    """A selector that is watched: what its choice says of the last motion, and what motion was expected."""

    def __init__(self, inner: Selector, information: MotionInformation) -> None:
        self._inner, self._information = inner, information
        self.gain_nats: list[float] = []
        self.expected: list[FloatArray | None] = []
        self.chosen: list[frozenset[int]] = []

    def select(self, observations: Observations, motion: MotionPrior | None = None) -> Selection:
        """Let the selector choose and note what the choice says."""
        selection = self._inner.select(observations, motion)
        # Without the run's own prediction: a run that predicts badly must not look uninformed for that.
        L = self._information.add_frame(observations, None)[selection.chosen, :1]
        self._information.mark_used(observations, selection.chosen)
        self.gain_nats.append(log_det_gain(prior_information(None)[None], L))
        self.expected.append(None if motion is None else motion.T_curr_prev)
        self.chosen.append(frozenset(observations.ids[selection.chosen].tolist()))
        return selection


def main() -> int:
    """Run everything and write the table, the figures of all runs and the picture."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("sources", nargs="+", type=_source, metavar="SOURCE[=REFERENCE][@START:STOP]")
    parser.add_argument("--out", type=Path, required=True, help="folder for the results")
    parser.add_argument("--backends", nargs="+", default=["msckf", "vislam"], choices=["msckf", "vislam"])
    parser.add_argument("--selectors", nargs="+", default=list(_SELECTORS), choices=_SELECTORS)
    parser.add_argument("--budgets", nargs="*", type=int, default=[20, 40, 80], help="besides the share of 1/7")
    parser.add_argument("--sticky", nargs="+", default=["no", "yes"], choices=["no", "yes"])
    parser.add_argument("--seeds", type=int, default=3, help="runs of the random selector")
    parser.add_argument("--jobs", type=int, default=1, help="processes")
    parser.add_argument("--set", action="append", default=[], metavar="a.b=c", help="change one setting")
    args = parser.parse_args()
    try:
        base = load_config(None, args.set)
        for source in args.sources:
            _dataset(source.path)
        outcomes = _run_all(list(_jobs(args, base)), base, args.jobs)
    except VioError as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    args.out.mkdir(parents=True, exist_ok=True)
    table = f"{_table(outcomes)}\n{_correlations(outcomes)}"
    (args.out / "table.md").write_text(table, encoding="utf-8")
    (args.out / "runs.json").write_text(json.dumps([_plain(o) for o in outcomes], indent=1) + "\n", encoding="utf-8")
    _plot(args.out / "selection.png", outcomes)
    print(table)
    return 0


def _source(text: str) -> Source:
    body, _, frames = text.partition("@")
    path, _, reference = body.partition("=")
    start, _, stop = frames.partition(":")
    try:
        first, last = int(start or 0), int(stop) if stop else None
    except ValueError as error:
        raise argparse.ArgumentTypeError(f"{text}: frames are given as START:STOP") from error
    name = Path(path).stem + (f" {first}-{'' if last is None else last - 1}" if frames else "")
    return Source(name, path, reference or None, first, last)


def _jobs(args: argparse.Namespace, base: Config) -> Iterable[Job]:
    for source, backend in product(args.sources, args.backends):
        yield Job(source, backend, replace(base.selector, name="all"))
        for name, budget, sticky in product(args.selectors, [_SHARE, *args.budgets], args.sticky):
            if name.startswith("visibility") and sticky == "yes":
                continue  # features that go on keep their order anyway
            if name == "visibility_whole" and not _dataset(source.path)[1]:
                continue  # the record is not known in advance
            for seed in range(args.seeds if name == "random" else 1):
                selector = replace(
                    base.selector,
                    name=name,
                    budget=budget or None,
                    sticky=sticky == "yes",
                    seed=base.selector.seed + seed,
                )
                yield Job(source, backend, selector)


def _run_all(jobs: list[Job], base: Config, processes: int) -> list[Outcome]:
    outcomes: list[Outcome] = []
    with ProcessPoolExecutor(max(processes, 1)) as pool:
        for outcome in pool.map(_run, jobs, [base] * len(jobs)):
            outcomes.append(outcome)
            s = outcome.job.selector
            print(
                f"{len(outcomes)}/{len(jobs)} {outcome.job.source.name} {outcome.job.backend} {s.name} "
                f"{s.budget or 'share'}{' sticky' if s.sticky else ''}: {_number(outcome.ate_m, 4)} m",
                file=sys.stderr,
            )
    return outcomes


@lru_cache(maxsize=2)
def _dataset(path: str) -> tuple[Dataset, bool]:
    """The recording, and whether its features are known in advance."""
    dataset = open_dataset(path)
    return dataset, dataset.observations(0) is not None


def _run(job: Job, base: Config) -> Outcome:
    dataset, precomputed = _dataset(job.source.path)
    camera, frames = dataset.recording.camera, range(len(dataset.recording.frame_times_ns))
    # Feature files do not know the size of their images; the principal point is taken for the centre.
    size = (camera.width or round(2 * camera.cu), camera.height or round(2 * camera.cv))
    selector = build_selector(
        job.selector,
        image_size=size,
        whole_record=(lambda: [o for o in map(dataset.observations, frames) if o is not None]) if precomputed else None,
        camera=camera,
    )
    watched = Watched(selector, MotionInformation(camera, 1, _PIXEL_SIGMA_PX))
    config = replace(base, backend=job.backend, motion="none", selector=job.selector)
    with one_blas_thread():
        try:
            result = run(dataset, config, start=job.source.start, stop=job.source.stop, selector=watched)
        except VioError:
            nothing = np.zeros(0)
            nan = float("nan")
            return Outcome(job, None, None, None, nan, nan, nan, nan, nan, nothing, nothing, nothing, nothing)
    truth = dataset.recording.reference if job.source.reference is None else read_trajectory(Path(job.source.reference))
    return _outcome(job, result, watched, truth)


def _outcome(job: Job, result: RunResult, watched: Watched, truth: Trajectory | None) -> Outcome:
    score = None if truth is None else evaluate(result.trajectory, truth, T_cam0_imu=result.T_cam0_body)
    T = result.trajectory.in_cam0(result.T_cam0_body).T_world_body
    moved = se3_inverse(T[1:]) @ T[:-1]  # T_curr_prev of every frame but the first
    # Where the back end tells nothing, the last motion is expected to go on.
    expected = np.array([moved[max(k - 1, 0)] if e is None else e for k, e in enumerate(watched.expected[1:])])
    true = _true_motions(result, truth)
    nan = np.full(1, np.nan)
    return Outcome(
        job=job,
        ate_m=None if score is None else score.ate_m.rmse,
        rpe_m=None if score is None or score.rpe is None else score.rpe.trans_rmse_m,
        rpe_deg=None if score is None or score.rpe is None else score.rpe.rot_rmse_deg,
        selected=float(np.mean([f.selected for f in result.frames])),
        used=float(np.mean([f.used for f in result.frames])),
        track_frames=_mean_track(watched.chosen),
        select_ms=float(np.median([f.select_ms for f in result.frames])),
        filter_ms=float(np.median([f.filter_ms for f in result.frames])),
        gain_nats=np.array(watched.gain_nats),
        correction_m=np.concatenate([nan, _distance(moved, expected)]),
        error_before_m=np.concatenate([nan, _distance(expected, true)]),
        error_after_m=np.concatenate([nan, _distance(moved, true)]),
    )


def _true_motions(result: RunResult, truth: Trajectory | None) -> FloatArray:
    """True `T_curr_prev` (F - 1, 4, 4) of the left camera; NaN where the reference has no pose for both frames."""
    out = np.full((len(result.frames) - 1, 4, 4), np.nan)
    if truth is None:
        return out
    poses = np.full((len(result.frames), 4, 4), np.nan)
    if truth.times_ns is not None:
        own = np.array([f.time_ns for f in result.frames], dtype=np.int64)
        rows, reference_rows = associate_times(own, truth.times_ns, max_difference_ns=10_000_000)
    else:
        numbers = np.arange(len(truth)) if truth.frame_indices is None else truth.frame_indices
        _, rows, reference_rows = np.intersect1d([f.index for f in result.frames], numbers, return_indices=True)
    poses[rows] = truth.in_cam0(result.T_cam0_body).T_world_body[reference_rows]
    known = np.isfinite(poses[1:, 0, 0]) & np.isfinite(poses[:-1, 0, 0])
    out[known] = se3_inverse(poses[1:][known]) @ poses[:-1][known]
    return out


def _distance(a: FloatArray, b: FloatArray) -> FloatArray:
    """Length (F,) of the translation part of `log(a b^-1)`, metres; NaN where a motion is unknown."""
    known = np.isfinite(a[:, 0, 0]) & np.isfinite(b[:, 0, 0])
    out = np.full(len(a), np.nan)
    out[known] = np.linalg.norm(se3_log(a[known] @ se3_inverse(b[known]))[:, :3], axis=1)
    return out


def _mean_track(chosen: list[frozenset[int]]) -> float:
    """Mean number of frames in a row in which a feature was chosen."""
    begun = sum(len(now - before) for before, now in zip([frozenset[int](), *chosen], chosen, strict=False))
    return sum(map(len, chosen)) / max(begun, 1)


def _correlation(a: FloatArray, b: FloatArray) -> float | None:
    """Spearman's rank correlation over the entries that both have; None for fewer than ten."""
    known = np.isfinite(a) & np.isfinite(b)
    if known.sum() < 10:
        return None
    ranks = rankdata(a[known]), rankdata(b[known])
    return float(np.corrcoef(*ranks)[0, 1])


def _label(selector: SelectorSettings) -> str:
    return f"{selector.name}{', sticky' if selector.sticky else ''}"


def _table(outcomes: list[Outcome]) -> str:
    """Markdown: for each recording and back end a row per selector, a column per budget; seeds as median and range."""
    lines: list[str] = []
    for source, backend in _unique((o.job.source.name, o.job.backend) for o in outcomes):
        group = [o for o in outcomes if (o.job.source.name, o.job.backend) == (source, backend)]
        everything = next(o for o in group if o.job.selector.name == "all")
        budgets = _unique(o.job.selector.budget for o in group if o is not everything)
        lines += [
            f"### {source}, {backend}",
            "",
            f"All {everything.selected:.0f} features a frame: {_cell([everything])}.",
            "",
            "| ATE m (frame to frame mm) | " + " | ".join("1/7" if b is None else str(b) for b in budgets) + " |",
            "|---" + "|---:" * len(budgets) + "|",
        ]
        for label in _unique(_label(o.job.selector) for o in group if o is not everything):
            of_label = [o for o in group if _label(o.job.selector) == label]
            cells = [_cell([o for o in of_label if o.job.selector.budget == budget]) for budget in budgets]
            lines.append(f"| {label} | {' | '.join(cells)} |")
        lines.append("")
    return "\n".join(lines)


def _cell(runs: list[Outcome]) -> str:
    """Median over the runs, the range where there are several, and the error from frame to frame."""
    if not runs:
        return "–"
    ate = sorted(np.inf if o.ate_m is None else o.ate_m for o in runs)
    rpe = sorted(np.inf if o.rpe_m is None else 1e3 * o.rpe_m for o in runs)
    spread = f" [{_short(ate[0])}, {_short(ate[-1])}]" if len(ate) > 1 else ""
    return f"{_short(float(np.median(ate)))}{spread} ({_short(float(np.median(rpe)))})"


def _short(value: float) -> str:
    """Three digits, or that the filter lost its way."""
    return f"{value:.3g}" if np.isfinite(value) else "lost"


def _correlations(outcomes: list[Outcome]) -> str:
    """Markdown: rank correlations of the gain with what the update did, over frames and between selectors."""
    lines = [
        "### Rank correlation of the gain",
        "",
        "Over the frames of a run (median over runs): gain with correction, with the error that the update took away, "
        "and with the error left. Between runs of one budget, frame by frame: gain and error left, both less the mean "
        "over the runs in that frame. Between runs, all budgets: mean gain and ATE.",
        "",
        "| recording, back end | correction | error taken away | error left | between runs, by frame | by run |",
        "|---" + "|---:" * 5 + "|",
    ]
    for source, backend in _unique((o.job.source.name, o.job.backend) for o in outcomes):
        group = [o for o in outcomes if (o.job.source.name, o.job.backend) == (source, backend) and len(o.gain_nats)]
        within = [
            [_correlation(o.gain_nats, o.correction_m) for o in group],
            [_correlation(o.gain_nats, o.error_before_m - o.error_after_m) for o in group],
            [_correlation(o.gain_nats, o.error_after_m) for o in group],
        ]
        cells = [_number(_median(values), 2) for values in within]
        paired = [_paired(group, b) for b in _unique(o.job.selector.budget for o in group)]
        cells.append(_number(_median(paired), 2))
        ate = np.array([np.nan if o.ate_m is None else o.ate_m for o in group])
        cells.append(_number(_correlation(np.array([o.gain_nats.mean() for o in group]), ate), 2))
        lines.append(f"| {source}, {backend} | {' | '.join(cells)} |")
    return "\n".join(lines) + "\n"


def _paired(group: list[Outcome], budget: int | None) -> float | None:
    """Correlation of gain and error left between runs of one budget, each less its mean over the runs of a frame."""
    runs = [o for o in group if o.job.selector.budget == budget and o.job.selector.name != "all"]
    if len(runs) < 2:
        return None
    gain, error = np.array([o.gain_nats for o in runs]), np.array([o.error_after_m for o in runs])
    # Errors of a frame differ by orders of magnitude between frames: compare their ranks within the frame.
    known = np.isfinite(error).all(axis=0)
    ranked = [np.apply_along_axis(rankdata, 0, part[:, known]) - (len(runs) + 1) / 2 for part in (gain, error)]
    return _correlation(ranked[0].ravel(), ranked[1].ravel())


def _plot(path: Path, outcomes: list[Outcome]) -> None:
    """One column per recording: error over budget for each back end, and error over gain for the first one."""
    from matplotlib.figure import Figure
    from matplotlib.lines import Line2D
    from matplotlib.ticker import LogLocator

    sources, backends = (_unique(getter(o) for o in outcomes) for getter in (_source_name, _backend_name))
    figure = Figure(figsize=(3.0 * len(sources) + 0.6, 2.6 * (len(backends) + 1) + 0.5), dpi=90, layout="constrained")
    grid = figure.subplots(len(backends) + 1, len(sources), squeeze=False)
    for column, source in enumerate(sources):
        of_source = [o for o in outcomes if _source_name(o) == source and o.ate_m is not None]
        for row, backend in enumerate(backends):
            _plot_budgets(grid[row, column], [o for o in of_source if _backend_name(o) == backend])
            grid[row, column].set_title(f"{source}, {backend}", fontsize=9)
        _plot_gains(grid[-1, column], [o for o in of_source if _backend_name(o) == backends[0]])
        grid[-1, column].set_title(f"{source}, {backends[0]}: every run", fontsize=9)
    for axes in grid.ravel():
        axes.yaxis.set_major_locator(LogLocator(subs=(1, 1.5, 2, 3, 5, 7) if _narrow(axes) else (1,)))
        axes.yaxis.set_major_formatter("{x:g}")
        axes.yaxis.set_minor_formatter("")
        axes.tick_params(labelsize=7, which="both")
        axes.grid(alpha=0.25)
    for row in grid:
        row[0].set_ylabel("ATE (m)", fontsize=8)
    handles = [Line2D([], [], color="#111111", ls=":", label="all features")]
    for name, sticky in _unique((o.job.selector.name, o.job.selector.sticky) for o in outcomes):
        if name != "all":
            label = f"{name}{', sticky' if sticky else ''}"
            handles.append(
                Line2D([], [], color=_COLOURS[name], marker=_MARKERS[sticky], ls=_STYLES[sticky], label=label)
            )
    figure.legend(handles=handles, loc="outside upper center", ncols=5, fontsize=8)
    figure.savefig(path)


def _narrow(axes: Any) -> bool:
    low, high = axes.get_ylim()
    return bool(high < 20 * low)


def _plot_budgets(axes: Any, group: list[Outcome]) -> None:
    axes.set_yscale("log")
    everything = next((o.ate_m for o in group if o.job.selector.name == "all"), None)
    top = 0.0
    for name, sticky in _unique((o.job.selector.name, o.job.selector.sticky) for o in group):
        runs = [o for o in group if (o.job.selector.name, o.job.selector.sticky) == (name, sticky)]
        budgets = sorted({o.job.selector.budget for o in runs if o.job.selector.budget is not None})
        errors = [float(np.median([o.ate_m for o in runs if o.job.selector.budget == b])) for b in budgets]
        axes.plot(budgets, errors, color=_COLOURS[name], marker=_MARKERS[sticky], ls=_STYLES[sticky], lw=1.3, ms=3.5)
        top = max([top, *errors])
        axes.set_xscale("log")
        if budgets:
            axes.set_xticks(budgets, [str(b) for b in budgets])
            axes.set_xticks([], minor=True)
    if everything is not None:
        axes.axhline(everything, color=_COLOURS["all"], lw=1, ls=":")
        axes.set_ylim(top=min(1.3 * max(top, everything), 300 * everything))  # a run that was lost would hide the rest
    axes.set_xlabel("features a frame", fontsize=8)


def _plot_gains(axes: Any, group: list[Outcome]) -> None:
    axes.set_yscale("log")
    for o in group:
        s = o.job.selector
        axes.plot(o.gain_nats.mean(), o.ate_m, _MARKERS[s.sticky], ms=4.5, color=_COLOURS[s.name], mew=0)
    axes.set_xlabel("mean gain of the choice (nats)", fontsize=8)


def _source_name(outcome: Outcome) -> str:
    return outcome.job.source.name


def _backend_name(outcome: Outcome) -> str:
    return outcome.job.backend


def _unique(values: Iterable[Any]) -> list[Any]:
    return list(dict.fromkeys(values))


def _median(values: list[float | None]) -> float | None:
    known = [v for v in values if v is not None]
    return float(np.median(known)) if known else None


def _number(value: float | None, digits: int) -> str:
    return "–" if value is None or not np.isfinite(value) else f"{value:.{digits}f}"


def _plain(outcome: Outcome) -> dict[str, Any]:
    """One run for JSON: settings, figures, and the correlations over its frames."""
    arrays = ("gain_nats", "correction_m", "error_before_m", "error_after_m")
    figures = {k: getattr(outcome, k) for k in Outcome.__slots__ if k not in (*arrays, "job")}
    figures = {k: None if v is None or not np.isfinite(v) else v for k, v in figures.items()}
    means = {f"{k}_mean": float(np.nanmean(v)) if np.isfinite(v := getattr(outcome, k)).any() else None for k in arrays}
    job = outcome.job
    return {"source": asdict(job.source), "backend": job.backend, "selector": asdict(job.selector), **figures, **means}


if __name__ == "__main__":
    sys.exit(main())
