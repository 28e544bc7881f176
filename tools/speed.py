"""Print what a frame costs: Python calls, and CPU and wall time over what its images cost at least.

    python -m tools.speed RECORDING [--write]

The least cost of a stereo frame is decoding its two images and four passes of Lucas-Kanade (to the
last frame and to the right image, and back) with 400 points, in OpenCV on one thread. Runs and
these passes take turns, so that the ratio holds on any machine. Beside it stands that of the last
commit, `tools/speed.json`, which `--write` replaces. The exit status is 1 where a frame needs a
tenth more calls than that, or twice the ratio of CPU time.
"""

from __future__ import annotations

import argparse
import json
import statistics
import sys
import time
from collections.abc import Callable
from pathlib import Path
from types import FrameType
from typing import Any

import cv2
import numpy as np

from vio.config import load_config
from vio.datasets import open_dataset
from vio.records import StereoFrame
from vio.runs.pipeline import run

REFERENCE = Path(__file__).with_suffix(".json")
_ROUNDS = 3
_POINTS = 400
_WINDOW_PX = 21
_LEVELS = 3
# times the last commit's; calls hardly vary, times do between machines
_MAX = {"calls": 1.1, "cpu": 2.0}


def measured(path: Path) -> dict[str, float]:
    """Return calls a frame, and the ratios of CPU and wall time, of a recording of rectified or
    raw stereo images.
    """
    dataset = open_dataset(path)
    config = load_config()
    pairs = [(e.left, e.right) for e in dataset.events() if isinstance(e, StereoFrame)]
    encoded = [
        cv2.imencode(".png", image)[1] for pair in pairs for image in pair if image is not None
    ]
    points = [cv2.goodFeaturesToTrack(np.asarray(left), _POINTS, 0.001, 7) for left, _ in pairs]

    def lucas_kanade(one: Any, other: Any, corners: Any) -> Any:
        size = _WINDOW_PX, _WINDOW_PX
        moved, _, _ = cv2.calcOpticalFlowPyrLK(  # type: ignore[call-overload]
            one, other, corners, None, winSize=size, maxLevel=_LEVELS
        )
        return moved

    def frames() -> None:
        run(open_dataset(path), config)

    def least() -> None:
        for data in encoded:
            cv2.imdecode(data, cv2.IMREAD_UNCHANGED)
        for (before, _), (left, right), corners in zip(pairs, pairs[1:], points, strict=False):
            for one, other in ((before, left), (left, right)):
                lucas_kanade(other, one, lucas_kanade(one, other, corners))

    frames()  # compiles and loads
    calls = _calls(lambda: run(dataset, config)) / len(pairs)  # those of opening are no frame's
    threads = cv2.getNumThreads()
    ratios = []
    for _ in range(_ROUNDS):
        ours = _times(frames)
        cv2.setNumThreads(1)
        ratios.append(ours / _times(least))
        cv2.setNumThreads(threads)
    cpu, wall = (statistics.median(column) for column in zip(*ratios, strict=True))
    return {"calls": round(calls), "cpu": round(cpu, 2), "wall": round(wall, 2)}


def _calls(work: Callable[[], object]) -> int:
    """Count calls of functions, in Python and C, in this thread."""
    counted = 0

    def count(_: FrameType, event: str, __: object) -> None:
        nonlocal counted
        counted += event in ("call", "c_call")

    sys.setprofile(count)
    try:
        work()
    finally:
        sys.setprofile(None)
    return counted


def _times(work: Callable[[], None]) -> np.ndarray[Any, np.dtype[np.float64]]:
    """Return the CPU and the wall time of the process, s."""
    began = time.process_time(), time.perf_counter()
    work()
    return np.array([time.process_time(), time.perf_counter()]) - began


def slower(now: dict[str, float], last: dict[str, float]) -> list[str]:
    """Return what is beyond its bound, a line each."""
    return [
        f"{name}: {now[name]:g} in place of {last[name]:g}, more than {factor:g} times"
        for name, factor in _MAX.items()
        if now[name] > factor * last[name]
    ]


def main(argv: list[str]) -> int:
    """Return 0 where no figure is beyond its bound."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("recording", type=Path)
    parser.add_argument("--write", action="store_true", help="keep the figures for later commits")
    args = parser.parse_args(argv)
    now = measured(args.recording)
    last = json.loads(REFERENCE.read_text(encoding="utf-8"))
    print("                        now   last commit")
    for name, text in (
        ("calls", "calls a frame"),
        ("cpu", "CPU over the least"),
        ("wall", "wall over the least"),
    ):
        print(f"{text:20} {now[name]:>6g} {last[name]:>13g}")
    if args.write:
        REFERENCE.write_text(json.dumps(now) + "\n", encoding="utf-8")
        return 0
    for line in (found := slower(now, last)):
        print(f"slower: {line}", file=sys.stderr)
    return 1 if found else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
