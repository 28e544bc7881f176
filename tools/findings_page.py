"""Write docs/findings.md: every code that a run can report.

python -m tools.findings_page > docs/findings.md
"""

from __future__ import annotations

import argparse
import sys

from vio.findings import CODES

_INTRODUCTION = """# Findings and integrity

What a run's checks find ([images](frontend.md#faulty-images), [IMU](inertial.md)) has a code that stays the same from
version to version: compare codes, not sentences. `metrics.json` lists them under `findings`; `Odometry.findings`,
`LiveOdometry.findings` and the diagnostics of [ROS 2](ros2.md) have them while it runs.

**Integrity.** `Estimate.integrity` says whether the assumptions behind a covariance hold: *nominal*, *degraded* (a
sensor or a part of the images is left out; the covariance still covers the error), *unusable* (an assumption does not
hold; the covariance also covers that the rig has moved in any direction since then, at the fastest speed so far). In
`frames.csv` these are 0, 1, 2; `trajectory.png` shows degraded estimates in yellow, unusable ones in red. In files,
frames are marked from where the fault began.

`vio.protection_level(estimate)` gives the radius in the horizontal plane and the half height that contain the true
position with a probability (0.997 unless given).

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


def main() -> int:
    """Print the page."""
    argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    ).parse_args()
    print(page(), end="")
    return 0


if __name__ == "__main__":
    sys.exit(main())
