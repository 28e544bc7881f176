"""A calibration in pictures: corners and tilts, uncertainty over the image and over distance,
halves of the views against each other, residuals.
"""

from __future__ import annotations

from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np

from vio.geometry.distortion import CameraModel
from vio.geometry.lie import FloatArray
from vio.targets.calibrate import CameraCalibration
from vio.targets.verdict import DEPTH_M, board_tilts_deg, depth_sigma, projection_sigma_from_views

_DISTANCES_M = (1.0, 2.0, 3.0, 5.0, 8.0, 12.0, 20.0)
_NEAR_AND_FAR_M = (0.2, 0.3, 0.5, 0.7, 1.0, 2.0, 5.0, 10.0, 30.0)
_ROW_INCHES = 3.7
_WIDTH_INCHES = 13.0
_DPI = 90


def draw(found: CameraCalibration, path: Path) -> None:
    """Draw the corners, residuals and uncertainty of each camera, and the depth of a pair."""
    cameras = found.found.at.cameras
    figure, axes = _figure(len(cameras) + (len(cameras) > 1), 3)
    for c in range(len(cameras)):
        _draw_corners(axes[c][0], found, c)
        _draw_uncertainty(axes[c][1], found, c)
        _draw_residuals(axes[c][2], found, c)
    if len(cameras) > 1:
        _draw_depth(axes[-1], found)
        axes[-1][2].axis("off")
    figure.savefig(path, dpi=_DPI)


def views_png(found: CameraCalibration) -> bytes:
    """Return what the views show: corners in each image, tilts and distances of the board."""
    cameras = found.found.at.cameras
    figure, axes = _figure(1, len(cameras) + 2)
    for c in range(len(cameras)):
        _draw_corners(axes[0][c], found, c)
    tilts = board_tilts_deg(found.found.at)
    axes[0][-2].plot(tilts[:, 1], tilts[:, 0], "o", ms=4)
    axes[0][-2].set_xlabel("to the left and right, deg")
    axes[0][-2].set_ylabel("forwards and backwards, deg")
    axes[0][-2].set_title("tilts of the board")
    axes[0][-2].grid(alpha=0.3)
    distance = np.linalg.norm(found.found.at.T_cam0_board[:, :3, 3], axis=1)
    axes[0][-1].hist(distance, bins=12)
    axes[0][-1].set_xlabel("distance, m")
    axes[0][-1].set_ylabel("views")
    axes[0][-1].yaxis.get_major_locator().set_params(integer=True)
    axes[0][-1].set_title("distances of the board")
    return _png(figure)


def uncertainty_png(found: CameraCalibration) -> bytes:
    """Return the uncertainty of each camera's projection over the image and over distance."""
    cameras = found.found.at.cameras
    figure, axes = _figure(1, len(cameras) + 1)
    for c in range(len(cameras)):
        _draw_uncertainty(axes[0][c], found, c)
    last = axes[0][-1]
    for c in range(len(cameras)):
        sigmas = [
            found.verdict.inflation
            * projection_sigma_from_views(found.found, found.seen, c, distance)
            for distance in _NEAR_AND_FAR_M
        ]
        middle = [sigma[len(sigma) // 2] for sigma in sigmas]
        worst = [np.nanmax(sigma) for sigma in sigmas]
        last.loglog(_NEAR_AND_FAR_M, worst, "o-", color=f"C{c}", label=f"{_name(found, c)}, worst")
        last.loglog(
            _NEAR_AND_FAR_M, middle, "o:", color=f"C{c}", label=f"{_name(found, c)}, middle"
        )
    last.set_xlabel("distance, m")
    last.set_ylabel("standard deviation, px")
    last.set_title("projection, over distance")
    last.grid(True, which="both", alpha=0.3)
    last.legend(fontsize=8)
    return _png(figure)


def halves_png(found: CameraCalibration) -> bytes:
    """Return how far calibrations by either half of the views are apart, over each image."""
    cameras = found.found.at.cameras
    figure, axes = _figure(1, len(cameras))
    for c, camera in enumerate(cameras):
        _map(axes[0][c], found.verdict.grid[c], found.verdict.halves.off_px[c], camera)
        axes[0][c].set_title(f"{_name(found, c)}: halves of the views apart, px")
    return _png(figure)


def residuals_png(found: CameraCalibration) -> bytes:
    """Return the residuals of each camera's corners."""
    figure, axes = _figure(1, len(found.found.at.cameras))
    for c in range(len(found.found.at.cameras)):
        _draw_residuals(axes[0][c], found, c)
    return _png(figure)


def depth_png(found: CameraCalibration) -> bytes:
    """Return the uncertainty of a pair's depth over the image and over distance."""
    figure, axes = _figure(1, 2)
    _draw_depth(axes[0], found)
    return _png(figure)


def _figure(rows: int, columns: int) -> tuple[Any, Any]:
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(_WIDTH_INCHES, _ROW_INCHES * rows), layout="constrained")
    FigureCanvasAgg(figure)
    return figure, figure.subplots(rows, columns, squeeze=False)


def _png(figure: Any) -> bytes:
    out = BytesIO()
    figure.savefig(out, dpi=_DPI, format="png")
    return out.getvalue()


def _name(found: CameraCalibration, c: int) -> str:
    if len(found.found.at.cameras) > 1:
        return ("left", "right")[c]
    return "camera"


def _draw_corners(axes: Any, found: CameraCalibration, c: int) -> None:
    rows = found.seen.camera == c
    uv = found.seen.uv[rows]
    used = found.found.used[rows]
    axes.plot(*uv[used].T, ".", ms=1.5, color="tab:blue")
    axes.plot(*uv[~used].T, "x", ms=4, color="tab:red")
    axes.set_title(f"{_name(found, c)}: {used.sum()} corners, {np.sum(~used)} refused")
    _image_axes(axes, found.found.at.cameras[c])


def _draw_uncertainty(axes: Any, found: CameraCalibration, c: int) -> None:
    sigma = found.verdict.inflation * found.verdict.projection_sigma_px[c]
    _map(axes, found.verdict.grid[c], sigma, found.found.at.cameras[c])
    axes.set_title(f"{_name(found, c)}: sigma of projection, px")


def _draw_residuals(axes: Any, found: CameraCalibration, c: int) -> None:
    r = found.found.residuals_px[found.seen.camera == c]
    limit = 4 * float(found.found.sigma_px[c])
    axes.plot(*np.clip(r, -limit, limit).T, ".", ms=1.5)
    axes.set_xlim(-limit, limit)
    axes.set_ylim(-limit, limit)
    axes.set_aspect("equal")
    axes.set_xlabel("along u, px")
    axes.set_ylabel("along v, px")
    axes.set_title(f"{_name(found, c)}: residuals, sigma {found.found.sigma_px[c]:.3f} px")


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
    axes[1].set_ylabel("standard deviation, m")
    axes[1].set_title("depth, over distance")
    axes[1].grid(True, which="both", alpha=0.3)


def _map(axes: Any, grid: FloatArray, values: FloatArray, camera: CameraModel) -> None:
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
    axes.set_xlabel("u, px")
    axes.set_ylabel("v, px")
