"""Time and memory of the whole pipeline, per stage, on recordings of your own; also of two revisions in turns.

    python tools/bench.py SOURCE [SOURCE …] [--against REVISION] [--motion none] [--repeat 3] [--threads 1] [--json]

Medians and quartiles over all frames of all repetitions; the first frame of a run, which only detects, is left out. CPU
time is that of the whole process, reading included. A few frames are run beforehand, so that the loading of compiled
functions does not count; the first of all runs also compiles them. Each repetition is a process of its own, and with
`--against` the two revisions take turns: on a shared machine compare figures of one call, not of two.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np

ROOT = Path(__file__).resolve().parent.parent
_WARM_FRAMES = 8
_PERCENTILES = [25, 50, 75, 95]


def main() -> int:
    """Run the benchmark and print a table or JSON."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("sources", nargs="+", metavar="SOURCE")
    parser.add_argument("--against", metavar="REVISION", help="a git revision of this repository to take turns with")
    parser.add_argument("--repeat", type=int, default=3)
    parser.add_argument("--threads", type=int, default=None, help="OpenCV's threads (default: its own choice)")
    parser.add_argument("--stop", type=int, default=None)
    parser.add_argument("--set", action="append", default=[])
    parser.add_argument("--motion", default="auto")
    parser.add_argument("--json", action="store_true")
    parser.add_argument("--one", action="store_true", help=argparse.SUPPRESS)  # one run in this process
    args = parser.parse_args()
    if args.one:
        print(json.dumps(_measure(args.sources[0], args)))
        return 0
    with tempfile.TemporaryDirectory() as folder:
        trees = {"here": ROOT}
        if args.against is not None:
            trees[args.against] = _checked_out(args.against, Path(folder))
        rows = [row for source in args.sources for row in _in_turns(source, trees, args)]
    if args.json:
        print(json.dumps(rows))
        return 0
    for row in rows:
        _print(row)
    return 0


def _checked_out(revision: str, folder: Path) -> Path:
    """Unpack a revision of this repository into a folder."""
    archive = subprocess.run(["git", "-C", str(ROOT), "archive", revision], capture_output=True, check=True)
    subprocess.run(["tar", "-x", "-C", str(folder)], input=archive.stdout, check=True)
    return folder


def _in_turns(source: str, trees: dict[str, Path], args: argparse.Namespace) -> list[dict[str, Any]]:
    """Run each tree `repeat` times, one after the other; return one row per tree."""
    options = ["--motion", args.motion, *(f"--set={text}" for text in args.set)]
    options += [f"--{name}={value}" for name in ("threads", "stop") if (value := getattr(args, name)) is not None]
    command = [sys.executable, str(Path(__file__).resolve()), str(Path(source).resolve()), "--one", *options]
    runs: dict[str, list[dict[str, Any]]] = {name: [] for name in trees}
    for _ in range(args.repeat):
        for name, tree in trees.items():
            path = os.pathsep.join([str(tree), os.environ.get("PYTHONPATH", "")])
            done = subprocess.run(
                command, cwd=tree, env=os.environ | {"PYTHONPATH": path}, stdout=subprocess.PIPE, check=True
            )
            runs[name].append(json.loads(done.stdout))
    return [{"source": source, "revision": name} | _together(parts) for name, parts in runs.items()]


def _measure(source: str, args: argparse.Namespace) -> dict[str, Any]:
    """Run once; return times of every frame and of the whole."""
    import resource

    if args.threads is not None:
        import cv2

        cv2.setNumThreads(args.threads)
    from vio.config import load_config
    from vio.datasets import open_dataset
    from vio.numerics.threads import one_blas_thread
    from vio.runs.pipeline import run

    config = load_config(None, [*args.set, f'motion="{args.motion}"'])
    dataset = open_dataset(source, config.dataset)
    with one_blas_thread():
        start_s = time.process_time()
        run(dataset, config, stop=_WARM_FRAMES)
        begin_s = time.process_time()
        result = run(dataset, config, stop=args.stop)
        cpu_s = time.process_time() - begin_s
    frames = result.frames[1:]
    stages = {name: [getattr(f, f"{name}_ms") for f in frames] for name in ("read", "frontend", "select", "filter")}
    stages["total"] = np.sum(list(stages.values()), axis=0).tolist()
    for name in frames[-1].stages_ms:
        stages[f"frontend.{name}"] = [f.stages_ms.get(name, 0.0) for f in frames]
    return {
        "frames": len(result.frames),
        "cpu_s": cpu_s,
        "wall_s": result.wall_s,
        "warm_up_s": begin_s - start_s,
        "peak_memory_mib": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024,
        "ms": stages,
    }


def _together(runs: list[dict[str, Any]]) -> dict[str, Any]:
    """Summarise the runs of one revision; CPU and wall time are those of the quickest run, the least disturbed one."""
    stages = {name: np.concatenate([run["ms"][name] for run in runs]) for name in runs[0]["ms"]}
    count = runs[0]["frames"]
    return {
        "frames": count,
        "cpu_ms_per_frame": min(1e3 * run["cpu_s"] / count for run in runs),
        "wall_ms_per_frame": min(1e3 * run["wall_s"] / count for run in runs),
        "frames_per_second": max(count / run["wall_s"] for run in runs),
        "warm_up_s": min(run["warm_up_s"] for run in runs),
        "peak_memory_mib": max(run["peak_memory_mib"] for run in runs),
        "ms": {name: np.percentile(values, _PERCENTILES).tolist() for name, values in stages.items()},
    }


def _print(row: dict[str, Any]) -> None:
    print(
        f"{row['source']}, {row['revision']}: {row['frames']} frames, CPU {row['cpu_ms_per_frame']:.1f} ms and wall "
        f"{row['wall_ms_per_frame']:.1f} ms a frame, first frames {row['warm_up_s']:.1f} s, "
        f"peak memory {row['peak_memory_mib']:.0f} MiB"
    )
    for stage, q in row["ms"].items():
        print(f"  {stage:<18} {q[1]:8.2f} ms   (quartiles {q[0]:.2f}, {q[2]:.2f}; 95 % {q[3]:.2f})")


if __name__ == "__main__":
    sys.exit(main())
