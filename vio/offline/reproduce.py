"""The paper's experiment: the same features and velocities with every variant of its filter."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from vio.config import BackendName, Config, MotionName
from vio.datasets import DatasetSettings, open_dataset
from vio.errors import DataError
from vio.evaluation.trajectories import Evaluation, evaluate
from vio.files.atomic import atomic_folder, check_writable
from vio.files.printable import json_text, printable
from vio.files.trajectories import read_trajectory
from vio.filters.settings import VislamSettings
from vio.geometry.lie import FloatArray, transform_points
from vio.numerics.threads import one_blas_thread
from vio.records import Trajectory
from vio.runs.picture import write_picture
from vio.runs.pipeline import RunResult, run
from vio.selection.selectors import SelectorSettings

# The paper's values: W = diag(.5, .5, .5, .05, .05, .05) and V = 15 I, both taken as variances, no
# gate, landmarks assumed known in the pose update, zero-order hold of the input between frames,
# repeated pixels used unchanged.
PAPER = VislamSettings(
    motion_model="input",
    noise="literal",
    input_at="start",
    pixel_sigma_px=float(np.sqrt(15.0)),
    gate_probability=None,
    landmark_uncertainty=False,
    landmark_prior="isotropic",
    iterations=1,
    use_stale=True,
)


@dataclass(frozen=True, slots=True)
class Variant:
    """One row of the experiment."""

    name: str
    vislam: VislamSettings
    selector: SelectorSettings = field(default_factory=SelectorSettings)
    dataset: DatasetSettings = field(default_factory=DatasetSettings)
    motion: MotionName = "velocity"
    backend: BackendName = "vislam"
    checks: bool = True  # of features; the paper has none

    @property
    def config(self) -> Config:
        """The configuration of the row."""
        return Config(
            backend=self.backend,
            motion=self.motion,
            dataset=self.dataset,
            frontend=replace(Config().frontend, checks=self.checks),
            selector=self.selector,
            vislam=self.vislam,
        )


# The ids and pixels of the file unchanged, as in every published solution.
AS_FILED = DatasetSettings(repeated_tracks="literal")
# The paper's filter with W as standard deviations times the step, a gate, and landmark uncertainty.
CONSISTENT = replace(
    PAPER,
    noise="consistent",
    gate_probability=0.95,
    landmark_uncertainty=True,
    landmark_prior="stereo",
)
MOST_SEEN = SelectorSettings(name="visibility_whole")
MOST_SEEN_SO_FAR = SelectorSettings(name="visibility")

VARIANTS = (
    Variant(
        "dead reckoning", replace(PAPER, mode="dead_reckoning"), dataset=AS_FILED, checks=False
    ),
    Variant("mapping only", replace(PAPER, mode="mapping"), dataset=AS_FILED, checks=False),
    Variant("paper, all features", PAPER, dataset=AS_FILED, checks=False),
    Variant("paper, most seen 1/7", PAPER, MOST_SEEN, AS_FILED, checks=False),
    Variant("paper, most seen 1/7 so far", PAPER, MOST_SEEN_SO_FAR, AS_FILED, checks=False),
    Variant("consistent W, gate, all", CONSISTENT, dataset=AS_FILED, checks=False),
    Variant("consistent W, gate, most seen 1/7", CONSISTENT, MOST_SEEN, AS_FILED, checks=False),
    Variant("consistent W, gate, all, renamed tracks", CONSISTENT, checks=False),
    Variant("recommended, ids as filed", VislamSettings(), dataset=AS_FILED),
    Variant("recommended, most seen 1/7", VislamSettings(), MOST_SEEN),
    Variant("recommended, most seen 1/7 so far", VislamSettings(), MOST_SEEN_SO_FAR),
    Variant("recommended", VislamSettings()),
    Variant("recommended, images alone", VislamSettings(), motion="none"),
    Variant("sliding window", VislamSettings(), backend="msckf"),
    Variant(
        "sliding window, most seen 1/7 so far", VislamSettings(), MOST_SEEN_SO_FAR, backend="msckf"
    ),
    Variant("sliding window, images alone", VislamSettings(), motion="none", backend="msckf"),
)


# The paper's figures: file, title, and variants side by side; the last panel is ours.
_OURS = "sliding window"
FIGURES = (
    ("dead_reckoning", "Dead reckoning, without images", ("dead reckoning", _OURS)),
    ("landmarks", "Landmarks mapped along the path of dead reckoning", ("mapping only", _OURS)),
    (
        "selection",
        "All features, and the seventh that is seen most",
        ("paper, all features", "paper, most seen 1/7", _OURS),
    ),
)


@dataclass(frozen=True, slots=True)
class ReproducedTable:
    """The experiment on one drive."""

    drive: str
    out: Path
    rows: tuple[dict[str, Any], ...]  # values of JSON; None where there is no reference

    def as_dict(self) -> dict[str, Any]:
        """Return the table for JSON."""
        return {"drive": self.drive, "out": str(self.out), "rows": list(self.rows)}

    def as_text(self) -> str:
        """Return the table in Markdown."""
        head = "| setting | ATE m | t % | deg/100 m | used a frame | landmarks | innovation px | ms a frame |"
        lines = [f"### {self.drive}", "", head, "|---" + "|---:" * 7 + "|"]
        for d in self.rows:
            cells = [
                _number(d["ate_m"], 2),
                _number(d["t_err_percent"], 2),
                _number(d["r_err_deg_per_100m"], 2),
            ]
            cells += [
                _number(d["used_per_frame"], 1),
                str(d["landmarks"]),
                _number(d["innovation_median_px"], 2),
            ]
            lines.append(f"| {d['name']} | {' | '.join(cells)} | {_number(d['ms_per_frame'], 1)} |")
        return "\n".join(lines) + "\n"


def reproduce(
    file: Path,
    reference: Path | None,
    out: Path,
    say: Callable[[str], None] = lambda text: None,
) -> ReproducedTable:
    """Run every variant on one ECE276A file; write `out/DRIVE/` with a table and four figures:
    all paths, and the paper's three, each beside ours.

    Args:
        file: of the course.
        reference: ground truth; None: that of the file, where it has one.
        out: folder.
        say: gets a line before each variant is run.

    Raises:
        VioError: a file cannot be used.
    """
    dataset = open_dataset(str(file))
    recording = dataset.recording
    if "velocity" not in recording.motion or dataset.observations(0) is None:
        raise DataError(
            f"{file}: the experiment needs features and velocities; this is a {recording.kind} "
            "recording"
        )
    truth = recording.reference if reference is None else read_trajectory(reference)
    check_writable(out / file.stem)
    results: list[tuple[Variant, RunResult, Evaluation | None]] = []
    with one_blas_thread():
        for number, variant in enumerate(VARIANTS, start=1):
            say(f"{file.stem}, {number} of {len(VARIANTS)}: {variant.name}")
            result = run(open_dataset(file, variant.dataset), variant.config)
            score = (
                None
                if truth is None
                else evaluate(result.trajectory, truth, T_cam0_imu=result.T_cam0_body)
            )
            results.append((variant, result, score))
    table = ReproducedTable(file.stem, out / file.stem, tuple(_row(*each) for each in results))
    with atomic_folder(table.out, replace=True, marker="table.json") as inside:
        (inside / "table.md").write_text(table.as_text(), encoding="utf-8")
        (inside / "table.json").write_text(
            json_text(table.as_dict(), indent=2) + "\n", encoding="utf-8"
        )
        write_picture(inside / "trajectories.png", lambda: _figure(file.stem, results))
        for name, title, variants in FIGURES:
            panels = partial(_panels, file.stem, title, variants, results)
            write_picture(inside / f"{name}.png", panels)
    return table


def _row(variant: Variant, result: RunResult, score: Evaluation | None) -> dict[str, Any]:
    frames = result.frames
    innovations = [f.innovation_median_px for f in frames if f.innovation_median_px is not None]
    scores = {} if score is None else score.as_dict()
    return {
        "name": variant.name,
        **{name: scores.get(name) for name in ("ate_m", "t_err_percent", "r_err_deg_per_100m")},
        "used_per_frame": float(np.mean([f.used for f in frames])),
        "landmarks": len(result.landmarks.ids),
        "innovation_median_px": float(np.median(innovations)) if innovations else None,
        "ms_per_frame": float(np.mean([f.total_ms for f in frames])),
    }


def _figure(drive: str, results: list[tuple[Variant, RunResult, Evaluation | None]]) -> Any:
    from matplotlib.figure import Figure

    shown = (
        "dead reckoning",
        "paper, all features",
        "paper, most seen 1/7",
        "recommended",
        "sliding window, images alone",
    )
    colours = ("#d9822b", "#8e63b8", "#5aa469", "#1f5fbf", "#c23b5a")
    figure = Figure(figsize=(8.5, 7.5), dpi=110, layout="constrained")
    axes = figure.add_subplot()
    curves: list[tuple[str, FloatArray, str]] = []
    for variant, result, score in results:
        if variant.name in shown:
            colour = colours[shown.index(variant.name)]
            if score is None:
                curves.append((variant.name, result.trajectory.positions[:, :2], colour))
            else:
                label = f"{variant.name}, {score.as_dict()['ate_m']:.1f} m"
                # A KITTI reference is in the first camera's frame: x right, z forward.
                curves.append((label, score.aligned.positions[:, _ground(score.reference)], colour))
                if not axes.lines:
                    ground = score.reference.positions[:, _ground(score.reference)]
                    axes.plot(*ground.T, color="#111111", lw=3, label="ground truth")
    for label, positions, colour in curves:
        axes.plot(*positions.T, color=colour, lw=1.5, label=label)
    axes.set_aspect("equal", adjustable="datalim")
    title = (
        f"{printable(drive)}: the paper's filter, and the effect of a gate and of consistent noise"
    )
    axes.set_title(title, fontsize=11, parse_math=False)
    axes.set_xlabel("m")
    axes.set_ylabel("m")
    axes.grid(alpha=0.25)
    axes.legend(fontsize=9)
    return figure


def _panels(
    drive: str,
    title: str,
    variants: Sequence[str],
    results: Sequence[tuple[Variant, RunResult, Evaluation | None]],
) -> Any:
    """Draw variants side by side from above, in equal frames: landmarks, path, ground truth."""
    from matplotlib.figure import Figure

    chosen = {variant.name: (result, score) for variant, result, score in results}
    figure = Figure(figsize=(4.6 * len(variants), 4.9), dpi=110, layout="constrained")
    every = figure.subplots(1, len(variants), sharex=True, sharey=True)
    drawn = []
    for axes, name in zip(every, variants, strict=True):
        result, score = chosen[name]
        path, points, truth = _from_above(result, score)
        axes.scatter(*points.T, s=1.0, c="#9aa5b1", linewidths=0, rasterized=True)
        if truth is not None:
            axes.plot(*truth.T, color="#111111", lw=2.5, label="ground truth")
            drawn.append(truth)
        axes.plot(*path.T, color="#1f5fbf", lw=1.4, label="estimate")
        axes.plot(*path[0], "o", color="#111111", mfc="white", ms=5, label="start")
        drawn.append(path)
        if score is None:
            ate = ""
        else:
            ate = f", ATE {score.ate_m.rmse:.1f} m"
        ours = "ours: " if name == _OURS else ""
        axes.set_title(f"{ours}{name}{ate}", fontsize=10)
        axes.set_xlabel("m")
        axes.grid(alpha=0.25)
    low = np.min(np.vstack(drawn), axis=0)
    high = np.max(np.vstack(drawn), axis=0)
    middle = 0.5 * (low + high)
    half = 0.6 * float((high - low).max())
    for axes in every:  # landmarks far away are cut off
        axes.set_aspect("equal", adjustable="box")
        axes.set_xlim(middle[0] - half, middle[0] + half)
        axes.set_ylim(middle[1] - half, middle[1] + half)
    every[0].set_ylabel("m")
    figure.legend(*every[0].get_legend_handles_labels(), loc="outside lower center", ncols=3)
    figure.suptitle(f"{printable(drive)}: {title}", fontsize=12, parse_math=False)
    return figure


def _from_above(
    result: RunResult, score: Evaluation | None
) -> tuple[FloatArray, FloatArray, FloatArray | None]:
    """Return path (N, 2), landmarks (M, 2) and ground truth (K, 2) in the ground plane, metres."""
    points = result.landmarks.p_world
    if score is None:
        return result.trajectory.positions[:, :2], points[:, :2], None
    ground = _ground(score.reference)
    moved: FloatArray = transform_points(score.T_ref_est, points)[:, ground]
    return score.aligned.positions[:, ground], moved, score.reference.positions[:, ground]


def _ground(reference: Trajectory) -> list[int]:
    return [0, 2] if reference.body == "cam0" else [0, 1]


def _number(value: float | None, digits: int) -> str:
    return "–" if value is None else f"{value:.{digits}f}"
