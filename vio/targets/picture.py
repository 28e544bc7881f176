"""The verdict on a calibration as a picture: corners, uncertainty over the image, residuals, depth."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from vio.geometry.distortion import CameraModel
from vio.targets.calibrate import CameraCalibration
from vio.targets.verdict import DEPTH_M, depth_sigma

_DISTANCES_M = (1.0, 2.0, 3.0, 5.0, 8.0, 12.0, 20.0)


def draw(found: CameraCalibration, path: Path) -> None:
    """Draw the corners, residuals and uncertainty of each camera, and the depth of a pair."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    cameras = found.found.at.cameras
    rows = len(cameras) + (len(cameras) > 1)
    figure = Figure(figsize=(13, 3.7 * rows), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots(rows, 3, squeeze=False)
    for c, camera in enumerate(cameras):
        _draw_camera(axes[c], found, c, camera)
    if len(cameras) > 1:
        _draw_depth(axes[-1], found)
    figure.savefig(path, dpi=90)


def _draw_camera(axes: Any, found: CameraCalibration, c: int, camera: CameraModel) -> None:
    name = ("left", "right")[c] if len(found.found.at.cameras) > 1 else "camera"
    rows = found.seen.camera == c
    uv = found.seen.uv[rows]
    used = found.found.used[rows]
    r = found.found.residuals_px[rows]
    axes[0].plot(*uv[used].T, ".", ms=1.5, color="tab:blue")
    axes[0].plot(*uv[~used].T, "x", ms=4, color="tab:red")
    axes[0].set_title(f"{name}: {used.sum()} corners, {np.sum(~used)} refused")
    _image_axes(axes[0], camera)
    sigma = found.verdict.inflation * found.verdict.projection_sigma_px[c]
    _map(axes[1], found.verdict.grid[c], sigma, camera)
    axes[1].set_title(f"{name}: standard deviation of projection, px")
    limit = 4 * float(found.found.sigma_px[c])
    axes[2].plot(*np.clip(r, -limit, limit).T, ".", ms=1.5)
    axes[2].set_xlim(-limit, limit)
    axes[2].set_ylim(-limit, limit)
    axes[2].set_aspect("equal")
    axes[2].set_title(f"{name}: residuals, sigma {found.found.sigma_px[c]:.3f} px")


def _draw_depth(axes: Any, found: CameraCalibration) -> None:
    verdict = found.verdict
    percent = 100 * verdict.inflation / DEPTH_M * verdict.depth_sigma_m
    _map(axes[0], verdict.grid[0], percent, found.found.at.cameras[0])
    axes[0].set_title(f"standard deviation of depth at {DEPTH_M:g} m, %")
    sigmas = []
    for distance in _DISTANCES_M:
        sigma = depth_sigma(found.found, distance)
        seen = sigma[np.isfinite(sigma)]
        sigmas.append(float(np.sqrt(np.mean(seen**2))) if len(seen) else np.nan)
    axes[1].loglog(_DISTANCES_M, verdict.inflation * np.array(sigmas), "o-")
    axes[1].set_xlabel("distance, m")
    axes[1].set_title("standard deviation of depth, m")
    axes[1].grid(True, which="both", alpha=0.3)
    axes[2].axis("off")


def _map(axes: Any, grid: Any, values: Any, camera: CameraModel) -> None:
    shape = (len(np.unique(grid[:, 1])), len(np.unique(grid[:, 0])))
    drawn = axes.contourf(
        grid[:, 0].reshape(shape),
        grid[:, 1].reshape(shape),
        np.ma.masked_invalid(values.reshape(shape)),
        levels=12,
    )
    axes.figure.colorbar(drawn, ax=axes)
    _image_axes(axes, camera)


def _image_axes(axes: Any, camera: CameraModel) -> None:
    axes.set_xlim(-0.5, camera.width - 0.5)
    axes.set_ylim(camera.height - 0.5, -0.5)
    axes.set_aspect("equal")
