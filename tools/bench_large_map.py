"""Opening a large map, and settling loops in it beside a thread that wants to go on each few milliseconds.

    python tools/bench_large_map.py [--sizes 5000,20000] [--features] [--keep FOLDER] [--json FILE]

A simulated drive at random through a grid of streets, with a keyframe each 5 m and a loop with each fifth keyframe that
shows a street again. Then a session drives on from the middle of the map, and its keyframes close loops. Times are
CPU seconds; a wait is how much later than planned a ticking thread went on, less what either thread waited for a
processor. Without `--features` keyframes show nothing, and the file is small.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import shutil
import tempfile
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from tools.bench_map import CAMERA, features
from vio.geometry.lie import FloatArray, se3_adjoint, se3_exp, se3_from_parts, se3_inverse, so3_exp
from vio.geometry.relative_pose import RelativePose
from vio.live.worker import QuietCollector
from vio.mapping.builder import Keyframe, MapBuilder
from vio.mapping.features import KeyframeFeatures
from vio.mapping.loop_geometry import Verified
from vio.mapping.map_graph import MapGraph
from vio.mapping.map_store import KeyframeRow, LoopRow, MapStore, SessionRow
from vio.mapping.place_finder import FoundPlace, PlaceFinder
from vio.records import LoopMatches

STEP_M, BLOCK = 5.0, 20  # from keyframe to keyframe; keyframes from crossing to crossing
MOTION_M, MOTION_RAD = 0.017, 0.0005  # standard deviations of the odometry from keyframe to keyframe
LOOP_M, LOOP_RAD = 0.052, 0.002
TICK_S = 0.005
EACH = 5  # keyframes that show a street again, from loop to loop
NEW, SPARSE = 60, 12  # keyframes of the session that goes on; they close a loop each so many

NO_MATCHES = LoopMatches(*(np.zeros((0, 4)),) * 2, *(np.zeros(0, np.bool_),) * 2)


def covariance(metres: float, radians: float) -> FloatArray:
    """Covariance (6, 6) of a motion with independent errors."""
    return np.diag(np.repeat([metres**2, radians**2], 3))


def measured(T: FloatArray, metres: float, radians: float, rng: np.random.Generator) -> RelativePose:
    """Return a motion (4, 4) with such errors."""
    C = covariance(metres, radians)
    return RelativePose(T @ se3_exp(rng.normal(size=6) * np.sqrt(np.diag(C))), C)


def drive(count: int, rng: np.random.Generator) -> tuple[FloatArray, list[tuple[int, int]]]:
    """Return the poses (K, 4, 4) of a drive through a grid of streets, and the pairs that show one place."""
    ways = np.array([(0, 1), (1, 0), (0, -1), (-1, 0)])  # in x and z, as the camera has them
    half = round((count / (8 * BLOCK)) ** 0.5) // 2  # blocks to each side: most streets are driven twice
    at, way, T, pairs = np.zeros(2, dtype=np.int64), 0, list[FloatArray](), list[tuple[int, int]]()
    seen: dict[tuple[int, ...], int] = {}
    while len(T) < count:
        for n in range(BLOCK):
            p = STEP_M * (BLOCK * at + n * ways[way])
            T.append(se3_from_parts(so3_exp(np.array([0.0, 0.5 * np.pi * way, 0.0])), np.array([p[0], 0.0, p[1]])))
            before = seen.setdefault((*at.tolist(), way, n), len(T) - 1)
            if before < len(T) - 1 and n % EACH == 0 and len(T) <= count:
                pairs.append((before, len(T) - 1))
        at = at + ways[way]
        way = int((way + rng.integers(-1, 2)) % 4)
        if (np.abs(at + ways[way]) > half).any():
            way = (way + 2) % 4
    return np.array(T[:count]), pairs


def write(path: Path, count: int, shows: bool) -> None:
    """Write the map of a drive, at its true poses."""
    rng = np.random.default_rng(0)
    T, pairs = drive(count, rng)
    nothing = KeyframeFeatures(np.zeros((0, 4)), np.zeros(0, np.bool_), np.zeros(0), np.zeros((0, 32), np.uint8))
    store = MapStore(path, create=True)
    store.add_session(SessionRow("drive", CAMERA, False, 0))
    drift = np.zeros((6, 6))
    for k in range(count):
        if k:
            motion = measured(se3_inverse(T[k - 1]) @ T[k], MOTION_M, MOTION_RAD, rng)
            A = se3_adjoint(T[k])
            drift = drift + A @ motion.covariance @ A.T
        row = KeyframeRow(0, k, 10**9 * k, T[k], T[k], drift, STEP_M * k, None, 0.0)
        store.add_keyframe(row, features(k) if shows else nothing)
        if k:
            store.add_odometry(k - 1, k, motion)
    for i, k in pairs:
        store.add_loop(LoopRow(i, k, measured(se3_inverse(T[i]) @ T[k], LOOP_M, LOOP_RAD, rng), 50, True))
    PlaceFinder(store, MapGraph(store), CAMERA, 0, writes=True)  # writes what finds keyframes again
    store.commit()
    store.close()


@dataclass
class Ticker:
    """A thread that wants to go on each few milliseconds, beside the one that makes it."""

    waits_s: list[float] = field(default_factory=list)  # beyond the pause, without what it waited for a processor
    _ended: threading.Event = field(default_factory=threading.Event)

    @contextlib.contextmanager
    def beside(self) -> Iterator[None]:
        """Tick until the end of the block."""
        thread = threading.Thread(target=self._tick, args=(threading.get_native_id(),))
        thread.start()
        try:
            yield
        finally:
            self._ended.set()
            thread.join()

    def _tick(self, worker: int) -> None:
        own = threading.get_native_id()
        begin, queued = time.perf_counter(), _queued_s(own) + _queued_s(worker)
        while not self._ended.is_set():
            time.sleep(TICK_S)
            now, then = time.perf_counter(), _queued_s(own) + _queued_s(worker)
            self.waits_s.append(now - begin - TICK_S - (then - queued))
            begin, queued = now, then


def _queued_s(thread: int) -> float:
    """Time that a thread has waited for a processor."""
    return 1e-9 * int(Path(f"/proc/self/task/{thread}/schedstat").read_text().split()[1])


def measure(path: Path) -> dict[str, float]:
    """Open a map, and drive on in it."""
    start = time.process_time()
    builder = MapBuilder(MapStore(path), "on", CAMERA, upright=False, localise=False)
    opened, size = time.process_time() - start, len(builder.graph)
    truth, rng, spent = builder.graph.T_map_cam.rows.copy(), np.random.default_rng(1), list[float]()
    first = size // 2
    found = dict[int, FoundPlace]()
    find = builder.places.find

    def placed(number: int, seen: KeyframeFeatures) -> FoundPlace | None:
        if number > size:  # the first one loads compiled loops
            find(number, seen)
        return found.get(number)

    builder.places.find = placed  # type: ignore[assignment, method-assign]
    find(size - 1, features(first))
    ticker, quiet = Ticker(), QuietCollector()
    quiet.hold()
    T: FloatArray = np.eye(4)
    with ticker.beside():
        for n in range(NEW):
            motion = measured(se3_inverse(truth[first + n - 1]) @ truth[first + n], MOTION_M, MOTION_RAD, rng)
            T = T @ motion.T_i_j
            if n % SPARSE == 0:
                pose = measured(np.eye(4), LOOP_M, LOOP_RAD, rng)
                found[size + n] = FoundPlace(first + n, size + n, Verified(pose, 50, 60, NO_MATCHES), 0)
            start = time.thread_time()
            builder.add(Keyframe(n, 10**9 * n, T, motion if n else None, None, 0.0), features(first + n))
            if n % SPARSE == 0:
                spent.append(time.thread_time() - start)
    quiet.release()
    start = time.process_time()
    builder.finish()
    whole = time.process_time() - start
    builder.close()
    waits = 1e3 * np.array(ticker.waits_s)
    return {
        "keyframes": size,
        "loops": len(builder.graph.loops),
        "open_s": opened,
        "settle_s": float(np.median(spent)),
        "wait_ms": float(waits.max()),
        "wait_ms_99": float(np.percentile(waits, 99)),
        "whole_s": whole,
        "file_MB": path.stat().st_size / 1e6,
    }


def main() -> None:
    """Measure all sizes."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--sizes", default="5000,20000")
    parser.add_argument("--features", action="store_true", help="keyframes have features")
    parser.add_argument("--keep", type=Path, help="folder in which the maps are kept, and found again")
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    rows = []
    with tempfile.TemporaryDirectory() as temporary:
        for size in sorted(int(text) for text in arguments.sizes.split(",")):
            kept = (arguments.keep or Path(temporary)) / f"drive_{size}{'_features' * arguments.features}.map"
            if not kept.exists():
                write(kept, size, arguments.features)
            path = Path(temporary) / "measured.map"
            shutil.copy(kept, path)
            rows.append(measure(path))
            path.unlink()
            print("  ".join(f"{name} {value:.4g}" for name, value in rows[-1].items()), flush=True)
    if arguments.json is not None:
        arguments.json.write_text(json.dumps(rows, indent=2) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
