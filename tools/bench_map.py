"""What a query of the map costs against its size: simulated keyframes, their index and file, one query after the other.

    python tools/bench_map.py [--sizes 500,2000,8000,20000]

Descriptors are random bits; a query is a keyframe of the map with a tenth of its bits wrong, so that its words, the
candidates and their geometric verification cost what a real one costs. Times are CPU milliseconds of one thread: where
nothing is known of the place, and where a session that found its place goes on along the map.
"""

from __future__ import annotations

import argparse
import resource
import tempfile
import time
from pathlib import Path

import numpy as np

from vio.geometry.lie import FloatArray, se3_exp
from vio.geometry.relative_pose import RelativePose
from vio.geometry.stereo import StereoCamera, project
from vio.mapping.builder import Keyframe, MapBuilder
from vio.mapping.features import MOST_FEATURES, KeyframeFeatures
from vio.mapping.map_store import KeyframeRow, MapStore
from vio.mapping.place_finder import FoundPlace

CAMERA = StereoCamera(400.0, 400.0, 319.5, 179.5, 0.12, 640, 360)
QUERIES = 20
FOLLOWED = 100  # keyframe at which the session begins that follows the map
STEP = se3_exp([0.0, 0.0, 1.0, 0.0, 0.0, 0.0])
MOTION = RelativePose(STEP, 1e-6 * np.eye(6))


def features(seed: int, *, wrong_bits: float = 0.0) -> KeyframeFeatures:
    """A keyframe with random features; the same seed gives the same place."""
    rng = np.random.default_rng(seed)
    p = rng.uniform((-3, -1, 3), (3, 1, 9), (MOST_FEATURES, 3))
    bits = rng.integers(0, 256, (MOST_FEATURES, 32), dtype=np.uint8)
    flipped = np.random.default_rng([seed, 1]).random((MOST_FEATURES, 256)) < wrong_bits
    z = project(CAMERA, p) + rng.normal(0, 0.5, (MOST_FEATURES, 4))
    return KeyframeFeatures(
        z, rng.random(MOST_FEATURES) < 0.7, np.ones(MOST_FEATURES), bits ^ np.packbits(flipped, axis=1)
    )


def fill(path: Path, begin: int, end: int) -> None:
    """Add keyframes to a map without looking for loops."""
    store = MapStore(path, create=True)
    builder = MapBuilder(store, "simulated", CAMERA, upright=False, localise=False)
    builder.places.find = lambda number, features: None  # type: ignore[method-assign]
    T: FloatArray = np.eye(4)
    for k in range(begin, end):
        builder.add(Keyframe(k, k, T, MOTION if k > begin else None, None, 0.0), features(k))
        T = T @ STEP
    builder.finish()
    builder.close()


def measure(path: Path, size: int) -> dict[str, float]:
    """Open a map, and localise keyframes in it that know nothing of their place."""
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    start = time.process_time()
    builder = MapBuilder(MapStore(path, read_only=True), "query", CAMERA, upright=False, localise=True)
    opened = time.process_time() - start
    rng, spent, found = np.random.default_rng(0), [], 0
    for k in range(QUERIES):
        query = features(int(rng.integers(size)), wrong_bits=0.1)
        keyframe = Keyframe(k, k, np.eye(4), None if k == 0 else MOTION, None, 0.0)
        drift, path_m = builder.graph.gathered(keyframe.T_odom_cam, keyframe.motion)
        own = len(builder.graph.sessions) - 1
        builder.graph.append(KeyframeRow(own, k, k, np.eye(4), np.eye(4), drift, path_m, None, 0.0))
        start = time.process_time()
        found += builder.places.find(len(builder.graph) - 1, query) is not None
        spent.append(1e3 * (time.process_time() - start))
    return {
        "keyframes": size,
        "query_ms": float(np.median(spent)),
        "query_ms_95": float(np.percentile(spent, 95)),
        "found": found / QUERIES,
        **followed(path),
        "open_s": opened,
        "index_MB": builder.places.index_bytes / 1e6,
        "overlap_MB": builder.places.overlap_bytes / 1e6,
        "file_MB": path.stat().st_size / 1e6,
        "memory_MB": (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) / 1e3,
    }


def followed(path: Path) -> dict[str, float]:
    """Localise a session that follows the map's first path, and time queries once it has its place."""
    builder = MapBuilder(MapStore(path, read_only=True), "query", CAMERA, upright=False, localise=True)
    find, spent, found = builder.places.find, list[float](), list[bool]()

    def timed(number: int, seen: KeyframeFeatures) -> FoundPlace | None:
        known, start = builder.is_joined, time.process_time()
        place = find(number, seen)
        if known:
            spent.append(1e3 * (time.process_time() - start))
            found.append(place is not None)
        return place

    builder.places.find = timed  # type: ignore[assignment, method-assign]
    T: FloatArray = np.eye(4)
    for k in range(QUERIES):
        keyframe = Keyframe(k, k, T, None if k == 0 else MOTION, None, 0.0)
        builder.add(keyframe, features(FOLLOWED + k, wrong_bits=0.1))
        T = T @ STEP
    builder.close()
    return {"followed_ms": float(np.median(spent)), "followed": float(np.mean(found))}


def main() -> None:
    """Measure all sizes."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--sizes", default="500,2000,8000,20000")
    filled = 0
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "simulated.map"
        for size in sorted(int(text) for text in parser.parse_args().sizes.split(",")):
            fill(path, filled, size)
            filled = size
            print("  ".join(f"{name} {value:.4g}" for name, value in measure(path, size).items()), flush=True)


if __name__ == "__main__":
    main()
