"""Replay a recording with the SDK of Spectacular AI and write its poses.

A program by itself: it runs in an environment that has the SDK and nothing of this project.
`python spectacularai_player.py FOLDER ORIGIN_NS OUT.tum`, where times count from ORIGIN_NS. Poses
are those of the left camera: whether `pose` is the IMU's or the camera's depends on the settings.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

_NS = 10**9


def main(folder: str, origin_ns: int, out: str) -> None:
    """Replay a folder and write the poses that are tracked."""
    import spectacularAI

    lines = ["# body: cam0"]

    def take(output: Any) -> None:
        if output.status != spectacularAI.TrackingStatus.TRACKING:
            return
        pose = output.getCameraPose(0).pose
        p = pose.position
        q = pose.orientation
        time_ns = origin_ns + round(_NS * pose.time)
        values = (p.x, p.y, p.z, q.x, q.y, q.z, q.w)
        shown = " ".join(f"{value:.9f}" for value in values)
        lines.append(f"{time_ns // _NS}.{time_ns % _NS:09d} {shown}")

    replay = spectacularAI.Replay(folder)
    replay.setOutputCallback(take)
    replay.setPlaybackSpeed(-1)  # as fast as it can
    replay.runReplay()
    replay.close()
    Path(out).write_text("\n".join([*lines, ""]), encoding="utf-8")


if __name__ == "__main__":
    main(sys.argv[1], int(sys.argv[2]), sys.argv[3])
