"""Comparison of a saved run with COLMAP's reconstruction from the images alone."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from vio.colmap.model import keyframe_images
from vio.colmap.reconstruction import Mapper, Reconstructed, match_images, reconstruct
from vio.mapping.comparison import Comparison, compare_keyframes
from vio.mapping.keyframes import choose_keyframes
from vio.mapping.loop_tracks import loop_pairs
from vio.offline.images import write_images
from vio.plotting import write_picture
from vio.records import Trajectory
from vio.saved_run import SavedRun

_COLOURS: dict[Mapper, str] = {"incremental": "#d9822b", "global": "#3a9d5d"}


@dataclass(frozen=True, slots=True)
class MapperResult:
    """The reconstruction of a run's keyframes by one of COLMAP's mappers, and its comparison with the run."""

    mapper: Mapper
    total: int  # keyframes given
    found: tuple[Reconstructed, Comparison] | None  # None: it could not connect them

    @property
    def verdict(self) -> str:
        """A short summary."""
        if self.found is None:
            return (
                "not observable because COLMAP could not connect the keyframes; too few images, no overlap between "
                "them, or too little texture"
            )
        model, comparison = self.found
        missing = self.total - len(model.keyframes)
        left_out = f"; {missing} of {self.total} keyframes could not be connected" if missing else ""
        if comparison.scale is None:
            return f"poses compared, scale not observable because {comparison.why_no_scale}{left_out}"
        where = f"disagrees in {len(comparison.segments)} segments" if comparison.segments else "agrees throughout"
        return f"{where}{left_out}"


def check_run(
    run: SavedRun,
    folder: Path,
    mappers: Sequence[Mapper],
    *,
    most: int,
    source: str | None,
    threads: int,
    progress: Callable[[int, int], None],
) -> tuple[MapperResult, ...]:
    """Reconstruct keyframes of a run from their images with a known stereo rig, and compare.

    Of a run that closed loops, keyframes at both ends of loops are matched as well, and its poses are those in the map.

    Writes a folder of each mapper's name with its model, and the plot `check.png`.

    Args:
        run: the run.
        folder: an existing, empty folder.
        mappers: COLMAP's.
        most: largest number of keyframes.
        source: the recording, if it is not at the path stored in the run.
        threads: for all steps; one makes the result repeatable.
        progress: called with (done, total).

    Raises:
        VioError: the run has too few views, or its images are not available.
    """
    path, steps = run.tracked, 2 + len(mappers)
    keyframes = choose_keyframes(path, most=most)
    names = keyframe_images(path.frames[keyframes])
    images, database = folder / "images", folder / "database.db"
    write_images(run, source, keyframes, names, images)
    progress(1, steps)
    loops = loop_pairs(path.loops, path.frames[keyframes])
    match_images(database, images, names, path.camera, loops, threads=threads)
    progress(2, steps)
    results: list[MapperResult] = []
    for mapper in mappers:
        model = reconstruct(database, images, names, mapper, folder / mapper, loops, threads=threads)
        found = None
        if model is not None:
            rows = keyframes[model.keyframes]
            found = model, compare_keyframes(path, rows, model.T_world_cam0, run.truth)
        results.append(MapperResult(mapper, len(keyframes), found))
        progress(2 + len(results), steps)
    write_picture(folder / "check.png", lambda: _figure(path.trajectory, results))
    shutil.rmtree(images)
    database.unlink()
    return tuple(results)


def _figure(trajectory: Trajectory, results: Sequence[MapperResult]) -> Any:
    """Plot the trajectories from above, and their distance along the path."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(11, 5), dpi=110, layout="constrained")
    above, along = figure.subplots(1, 2)
    p = trajectory.positions
    axes = np.linalg.svd(p - p.mean(axis=0), full_matrices=False)[2][:2]
    above.plot(*((p - p[0]) @ axes.T).T, color="#1f5fbf", label="run")
    for result in results:
        if result.found is None:
            continue
        comparison, colour = result.found[1], _COLOURS[result.mapper]
        q = (comparison.aligned[:, :3, 3] - p[0]) @ axes.T
        above.plot(*q.T, ".", color=colour, label=f"COLMAP, {result.mapper}")
        along.plot(comparison.frames, 1e3 * comparison.difference_m, ".-", color=colour, label=result.mapper)
        for segment in comparison.segments:
            along.axvspan(segment.first_frame, segment.last_frame, color=colour, alpha=0.2)
    above.set_aspect("equal", "datalim")
    above.set_xlabel("m, plane of largest extent")
    along.set_xlabel("frame")
    along.set_ylabel("distance to the run, mm")
    for panel in (above, along):
        if panel.get_legend_handles_labels()[0]:
            panel.legend()
        panel.grid(alpha=0.3)
    return figure
