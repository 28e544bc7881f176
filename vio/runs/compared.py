"""Paths of several trajectories over a reference, and their errors along it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from vio.evaluation.trajectories import Evaluation, metres_text

_COLOURS = ("#1f5fbf", "#d9822b", "#2e8b57", "#a83279", "#7a5195", "#0f8b8d", "#b5533c", "#6b7280")
_MILLIMETRES_BELOW_M = 0.02  # largest error


def draw_comparison(results: Mapping[str, Evaluation]) -> Any:
    """Draw evaluations against one reference, by name, in the plane in which the reference extends furthest."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(12, 5.6), dpi=110, layout="constrained")
    above, along = figure.subplots(1, 2, width_ratios=(1, 1.2))
    truth = max((r.reference.positions for r in results.values()), key=len)
    plane = np.linalg.svd(truth - truth.mean(axis=0), full_matrices=False)[2][:2]
    above.plot(*((truth - truth[0]) @ plane.T).T, color="#111111", lw=3.0, label="reference")
    largest = max(float(r.errors_m.max()) for r in results.values())
    factor, unit = (1e3, "mm") if largest < _MILLIMETRES_BELOW_M else (1.0, "m")
    for k, (name, r) in enumerate(results.items()):
        colour, label = _COLOURS[k % len(_COLOURS)], f"{name}: ATE {metres_text(r.ate_m.rmse)}"
        above.plot(*((r.aligned.positions - truth[0]) @ plane.T).T, color=colour, lw=1.4, label=label)
        steps = np.linalg.norm(np.diff(r.reference.positions, axis=0), axis=1)
        along.plot(np.concatenate([[0.0], np.cumsum(steps)]), factor * r.errors_m, color=colour, lw=1.4)
    above.set_aspect("equal", "datalim")
    above.set(xlabel="m, along the longest extent", ylabel="m", title="paths")
    along.set(xlabel="way on the reference (m)", ylabel=f"position error ({unit})", title="errors after alignment")
    along.set_ylim(bottom=0)
    for panel in (above, along):
        panel.grid(alpha=0.25)
    above.legend(fontsize=8, loc="best")
    return figure
