"""Time and memory of the whole pipeline, per stage, on recordings of your own.

    python tools/bench.py SOURCE [SOURCE …] [--motion none] [--repeat 3] [--threads 1] [--json]

Medians and quartiles over all frames of all repetitions; the first frame of a run, which only detects, is left out.
Memory is the peak of the whole process, so give one source at a time to compare. On a shared machine compare
figures of one call, not of two.
"""

from __future__ import annotations

import argparse
import json
import resource
import sys
from typing import Any

import numpy as np


def main() -> int:
    """Run the benchmark and print a table or JSON."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("sources", nargs="+", metavar="SOURCE")
    parser.add_argument("--repeat", type=int, default=3)
    parser.add_argument("--threads", type=int, default=None, help="OpenCV's threads (default: its own choice)")
    parser.add_argument("--stop", type=int, default=None)
    parser.add_argument("--set", action="append", default=[])
    parser.add_argument("--motion", default="auto")
    parser.add_argument("--json", action="store_true")
    args = parser.parse_args()

    if args.threads is not None:
        import cv2

        cv2.setNumThreads(args.threads)
    rows = [_measure(source, args) for source in args.sources]
    if args.json:
        print(json.dumps(rows))
        return 0
    for row in rows:
        print(f"{row['source']}: {row['frames']} frames, {row['frames_per_second']:.1f} frames/s, ", end="")
        print(f"peak memory {row['peak_memory_mib']:.0f} MiB")
        for stage, q in row["ms"].items():
            print(f"  {stage:<18} {q[1]:8.2f} ms   (quartiles {q[0]:.2f}, {q[2]:.2f}; 95 % {q[3]:.2f})")
    return 0


def _measure(source: str, args: argparse.Namespace) -> dict[str, Any]:
    from vio.config import load_config
    from vio.datasets import open_dataset
    from vio.pipeline import FrameLog, run
    from vio.threads import one_blas_thread

    config = load_config(None, [*args.set, f'motion="{args.motion}"'])
    frames: list[FrameLog] = []
    wall_s, count = 0.0, 0
    for _ in range(args.repeat):
        with one_blas_thread():
            result = run(open_dataset(source, config.dataset), config, stop=args.stop)
        wall_s += result.wall_s
        count += len(result.frames)
        frames += result.frames[1:]
    stages = {name: [getattr(f, f"{name}_ms") for f in frames] for name in ("read", "frontend", "select", "filter")}
    stages["total"] = np.sum(list(stages.values()), axis=0).tolist()
    for name in frames[0].stages_ms:
        stages[f"frontend.{name}"] = [f.stages_ms.get(name, 0.0) for f in frames]
    return {
        "source": source,
        "frames": count,
        "frames_per_second": count / wall_s,
        "peak_memory_mib": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024,
        "ms": {name: np.percentile(values, [25, 50, 75, 95]).tolist() for name, values in stages.items()},
    }


if __name__ == "__main__":
    sys.exit(main())
