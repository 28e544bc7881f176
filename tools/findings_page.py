"""Write docs/findings.md: every code that a run can report.

python -m tools.findings_page > docs/findings.md
"""

from __future__ import annotations

from vio.findings import CODES

_INTRODUCTION = """# Findings and integrity

A run checks images, sensors, calibration and its own estimate ([images](frontend.md#faulty-images),
[IMU](inertial.md)). What it finds has a code, which stays the same from version to version: compare codes, not
sentences. `metrics.json` lists them under `findings`; `Odometry.findings`, `LiveOdometry.findings` and the
diagnostics of [ROS 2](ros2.md) have them while it runs.

**Integrity.** A covariance is conditional on what the filter assumes. `Estimate.integrity` says whether these
assumptions hold: *nominal*, *degraded* (a sensor or a part of the images is left out; the covariance still covers the
error), *unusable* (an assumption does not hold; the covariance also covers that the rig has moved in any direction
since then, at the fastest speed so far). The column `integrity` of `frames.csv` is 0, 1, 2; where a fault began before
it was found, earlier frames are marked in the files. An event without an end counts for one second. In `trajectory.png`
the time of degraded estimates is yellow, that of unusable ones red.

`vio.protection_level(estimate)` gives the radius in the horizontal plane and the half height that contain the true
position with a probability (0.997 unless given), as receivers of satellite navigation state it.

This page is written by `python -m tools.findings_page`.

| code | effect | meaning | remedy |
|---|---|---|---|
"""


def page() -> str:
    """Return the text of the page."""
    rows = (
        f"| `{name}` | {code.effect} | {code.meaning} | {code.remedy} |\n"
        for name, code in sorted(CODES.items())
    )
    return _INTRODUCTION + "".join(rows)


if __name__ == "__main__":
    print(page(), end="")
