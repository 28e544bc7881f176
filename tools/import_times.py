"""What imports cost: whole processes, the best of several, beside an interpreter that does nothing.

    python tools/import_times.py [--repeat 10] [--json]

The cases take turns, so that a busy machine slows all of them alike. Elapsed time is what a user waits for; processor
time says what it would be on an idle machine.
"""

from __future__ import annotations

import argparse
import json
import resource
import subprocess
import sys
import time

_CASES = {
    "python -c pass": ("-c", "pass"),
    "import vio": ("-c", "import vio"),
    "vio --help": ("-m", "vio", "--help"),
    "vio run --help": ("-m", "vio", "run", "--help"),
    "import numpy": ("-c", "import numpy"),
    "import cv2": ("-c", "import cv2"),
    "import vio.config": ("-c", "import vio.config"),
    "import vio.runs.pipeline": ("-c", "import vio.runs.pipeline"),
    "import vio.cli.running": ("-c", "import vio.cli.running"),
}


def main() -> int:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--repeat", type=int, default=10, help="processes of each case")
    parser.add_argument("--json", action="store_true", help="one JSON object: [elapsed, processor] seconds")
    args = parser.parse_args()

    best = {name: (float("inf"), float("inf")) for name in _CASES}
    for _ in range(args.repeat):
        for name, arguments in _CASES.items():
            elapsed, processor = _times(arguments)
            best[name] = min(best[name][0], elapsed), min(best[name][1], processor)
    if args.json:
        print(json.dumps(best))
        return 0
    nothing = best["python -c pass"]
    print(f"{'seconds':<24}{'elapsed':>9}{'processor':>11}{'ratio':>8}")
    for name, (elapsed, processor) in best.items():
        print(f"{name:<24}{elapsed:9.3f}{processor:11.3f}{processor / nothing[1]:8.1f}")
    return 0


def _times(arguments: tuple[str, ...]) -> tuple[float, float]:
    """Elapsed and processor time of one interpreter with these arguments, in seconds."""
    before, start = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
    subprocess.run([sys.executable, *arguments], check=True, stdout=subprocess.DEVNULL)
    elapsed, after = time.perf_counter() - start, resource.getrusage(resource.RUSAGE_CHILDREN)
    return elapsed, after.ru_utime - before.ru_utime + after.ru_stime - before.ru_stime


if __name__ == "__main__":
    sys.exit(main())
