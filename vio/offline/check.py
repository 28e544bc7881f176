"""Comparison of a saved run with COLMAP's reconstruction from the images alone."""

from __future__ import annotations

import logging
import shutil
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from textwrap import wrap
from typing import Any, NamedTuple

import numpy as np

from vio.offline.colmap.model import keyframe_images
from vio.offline.colmap.reconstruction import Mapper, match_images, reconstruct
from vio.offline.comparison import compare_keyframes
from vio.offline.keyframes import keyframes_by_overlap
from vio.offline.loop_tracks import loop_pairs
from vio.offline.saved_run import SavedRun, write_images
from vio.offline.verdict import MapperResult, overall_verdict
from vio.records import Trajectory
from vio.runs.picture import write_picture


class _TimeRules(NamedTuple):
    """What a step takes."""

    match_s: float = 2.0  # for a keyframe, see `expected_minutes`
    map_s: float = 1.0


_TIMES = _TimeRules()
_MARGIN = 0.15  # of the path's extent, left free about it
# ratio of largest to median distance beyond which a linear axis shows the largest only
_LOGARITHMIC = 30.0
log = logging.getLogger(__name__)

_COLOURS: dict[Mapper, str] = {"incremental": "#d9822b", "global": "#3a9d5d"}


def expected_minutes(keyframes: int, mappers: Sequence[Mapper]) -> float:
    """Return about how long a check of as many keyframes takes on one slow core; images below 0.1
    megapixel take less.

    Measured with 30 keyframes of 1226 x 370 pixels: 1.8 s each for features and matches, 1.0 and
    0.7 s for the mappers.
    """
    return keyframes * (_TIMES.match_s + _TIMES.map_s * len(mappers)) / 60


@dataclass(frozen=True, slots=True)
class CheckOptions:
    """How much of a run is checked, and by what."""

    keyframes: int  # largest number
    source: str | None  # the recording, if it is not at the path stored in the run
    threads: int  # for all steps; one makes the result repeatable


def check_run(
    run: SavedRun,
    folder: Path,
    mappers: Sequence[Mapper],
    options: CheckOptions,
    *,
    begin: Callable[[str], None],
    announce: Callable[[str], None] = log.info,
) -> tuple[MapperResult, ...]:
    """Reconstruct keyframes of a run from their images with a known stereo rig, and compare.

    Of a run that closed loops, keyframes at both ends of loops are matched as well, and its poses
    are those in the map.

    Writes a folder of each mapper's name with its model, and the plot `check.png`.

    Args:
        run: the run.
        folder: an existing, empty folder.
        mappers: COLMAP's.
        options: how much, by what.
        begin: called with the step that comes next.
        announce: called with the number of keyframes and the time that they take.

    Raises:
        VioError: the run has too few views, or its images are not available.
    """
    path = run.tracked
    steps = 2 + len(mappers)
    keyframes = keyframes_by_overlap(path, most=options.keyframes)
    names = keyframe_images(path.frames[keyframes])
    images = folder / "images"
    database = folder / "database.db"
    minutes = expected_minutes(len(keyframes), mappers)
    announce(f"{len(keyframes)} keyframes: about {minutes:.2g} minutes on one slow core")
    begin(f"write images, step 1 of {steps}")
    write_images(run, options.source, keyframes, names, images)
    loops = loop_pairs(path.loops, path.frames[keyframes])
    begin(f"match images, step 2 of {steps}")
    match_images(database, images, names, path.camera, loops, threads=options.threads)
    results: list[MapperResult] = []
    for step, mapper in enumerate(mappers, start=3):
        begin(f"{mapper} mapper, step {step} of {steps}")
        model = reconstruct(
            database, images, names, mapper, folder / mapper, loops, threads=options.threads
        )
        found = None
        if model is not None:
            rows = keyframes[model.keyframes]
            found = (
                model,
                compare_keyframes(path, rows, model.T_world_cam0, run.truth, linked=model.linked),
            )
        results.append(MapperResult(mapper, len(keyframes), found))
    write_picture(folder / "check.png", lambda: draw_check(path.trajectory, results))
    shutil.rmtree(images)
    database.unlink()
    return tuple(results)


def draw_check(trajectory: Trajectory, results: Sequence[MapperResult]) -> Any:
    """Plot the trajectories from above, and their distance along the path; a broken model must
    not shrink the rest.
    """
    from matplotlib.figure import Figure

    figure = Figure(figsize=(11, 5.4), dpi=110, layout="constrained")
    above, along = figure.subplots(1, 2)
    p = trajectory.positions
    axes = np.linalg.svd(p - p.mean(axis=0), full_matrices=False)[2][:2]
    path = (p - p[0]) @ axes.T
    above.plot(*path.T, color="#1f5fbf", label="run")
    margin = _MARGIN * float(np.ptp(path, axis=0).max())
    low = path.min(axis=0) - margin
    high = path.max(axis=0) + margin
    differences = [np.zeros(0)]
    for result in results:
        if result.found is None:
            continue
        comparison = result.found[1]
        colour = _COLOURS[result.mapper]
        q = (comparison.aligned[:, :3, 3] - p[0]) @ axes.T
        outside = int(((q < low) | (q > high)).any(axis=1).sum())
        q[((q < low) | (q > high)).any(axis=1)] = np.nan
        beyond = ""
        if outside:
            beyond = f" ({outside} of {len(q)} outside the picture)"
        above.plot(*q.T, ".", color=colour, label=f"COLMAP, {result.mapper}{beyond}")
        along.plot(
            comparison.frames,
            1e3 * comparison.difference_m,
            ".-",
            color=colour,
            label=result.mapper,
        )
        differences.append(comparison.difference_m)
        for segment in comparison.segments:
            along.axvspan(segment.first_frame, segment.last_frame, color=colour, alpha=0.2)
    above.set(xlabel="m, plane of largest extent", ylabel="m")
    above.set_aspect("equal", "datalim")
    apart = np.concatenate(differences)
    if len(apart) and apart.max() > _LOGARITHMIC * max(float(np.median(apart)), 1e-9):
        along.set_yscale("log")
    along.set(xlabel="frame", ylabel="distance to the run, mm")
    for panel in (above, along):
        if panel.get_legend_handles_labels()[0]:
            panel.legend()
        panel.grid(alpha=0.3)
    figure.suptitle("\n".join(wrap(overall_verdict(results), 120)), fontsize=10)
    return figure
