"""The page about a calibration: verdict, what is missing, results, and pictures that say why."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from vio.report.html import document, image, table, text
from vio.targets.calibrate import CameraCalibration
from vio.targets.inertial import CameraImu
from vio.targets.picture import (
    depth_png,
    halves_png,
    residuals_png,
    uncertainty_png,
    views_png,
)
from vio.targets.verdict import DEPTH_M

_GOOD_SHARE = 0.005  # of the depth: standard deviation below which a pair is called good
_USABLE_SHARE = 0.02


def calibration_page(
    title: str,
    found: CameraCalibration,
    inertial: CameraImu | None,
    rows: Sequence[tuple[str, str]],
) -> str:
    """Return the page as self-contained HTML.

    Args:
        title: of the page.
        found: the cameras' calibration.
        inertial: the IMU's, where there is one.
        rows: names and values of the results, as the command prints them.
    """
    pair = len(found.found.at.cameras) > 1
    missing = [*found.verdict.findings, *(() if inertial is None else inertial.weak)]
    parts = [
        _section("Verdict", f"<p>{text(verdict_text(found))}</p>{_list(missing)}"),
        table("Results", ["value"], _joined(rows)),
        _picture(
            "What the views show",
            "Corners that were used (blue) and refused (red), how the board was tilted, and how far "
            "away it was. The lens is known where there are corners; the focal length is where the "
            "board was tilted.",
            views_png(found),
        ),
        _picture(
            "Uncertainty of the projection",
            "Where a point of known direction appears in the image, after the motion of the camera "
            "that undoes most of an error; right: over the distance of the point, after the motion "
            "that undoes most of it at the board in the views.",
            uncertainty_png(found),
        ),
    ]
    if pair:
        parts.append(
            _picture(
                "Uncertainty of depth",
                "Standard deviation of a point's depth by lenses and the pair's pose alone, without "
                "the noise of its pixels; blank where one image alone shows it. An error of the board's "
                "measured size comes on top.",
                depth_png(found),
            )
        )
    parts += [
        _picture(
            "Halves of the views against each other",
            "Two calibrations by every other view. Where they are further apart than the standard "
            "deviations say, something is wrong that the residuals do not show: "
            f"{_halves_text(found)}",
            halves_png(found),
        ),
        _picture(
            "Residuals",
            "Round and without a pattern where lens and board are held by the model. A small "
            "residual alone says little.",
            residuals_png(found),
        ),
    ]
    return document(title, parts)


def verdict_text(found: CameraCalibration) -> str:
    """Return the verdict in metres at `DEPTH_M`, or of one camera in pixels."""
    verdict = found.verdict
    if len(found.found.at.cameras) < 2:
        worst = max(verdict.halves.max_px)
        return f"One camera; halves of the views are {worst:.2f} px apart at worst."
    share = max(verdict.depth_m, verdict.halves.depth_m) / DEPTH_M
    word = "not good enough: record more"
    if share < _GOOD_SHARE:
        word = "good"
    elif share < _USABLE_SHARE:
        word = "usable"
    return (
        f"A point {DEPTH_M:g} m away is placed within {1e3 * verdict.depth_m:.0f} mm (one standard "
        f"deviation, {100 * verdict.depth_m / DEPTH_M:.2f} %); halves of the views disagree by "
        f"{1e3 * verdict.halves.depth_m:.0f} mm. That is {word}."
    )


def _halves_text(found: CameraCalibration) -> str:
    factor = found.verdict.inflation
    if factor > 1:
        return f"here all standard deviations were multiplied by {factor:.1f}."
    return "here they are not."


def _joined(rows: Sequence[tuple[str, str]]) -> dict[str, list[str]]:
    """Rows by their names; a row without a name goes on with the one before."""
    out: dict[str, list[str]] = {}
    last = ""
    for name, value in rows:
        if name == "FOUND":
            continue
        last = name or last
        out[last] = [f"{out[last][0]}; {value}" if last in out else value]
    return out


def _list(lines: Sequence[str]) -> str:
    if not lines:
        return "<p>Nothing is missing.</p>"
    return f"<ul>{''.join(f'<li>{text(line)}</li>' for line in lines)}</ul>"


def _section(title: str, inner: str) -> str:
    return f"<section><h2>{text(title)}</h2>{inner}</section>"


def _picture(title: str, remark: str, png: bytes) -> str:
    figure = f'<div class="scroll figure">{image(png, "png", title)}</div>'
    return _section(title, f'<p class="remark">{text(remark)}</p>{figure}')


def write_page(
    path: Path,
    title: str,
    found: CameraCalibration,
    inertial: CameraImu | None,
    rows: Sequence[tuple[str, str]],
) -> None:
    """Write the page, see `calibration_page`."""
    path.write_text(calibration_page(title, found, inertial, rows), encoding="utf-8")
