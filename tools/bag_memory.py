"""Measure the memory that reading a large bag takes: write one, read it, delete it.

    python -m tools.bag_memory rosbag2 15000

15000 pairs of 752 x 480 pixels are 10.8 GB. The figures are in docs/recordings.md.
"""

from __future__ import annotations

import argparse
import resource
import tempfile
import time
from pathlib import Path

import numpy as np

from vio.datasets import open_dataset
from vio.datasets.bags.writer import Storage, bag_writer
from vio.geometry.stereo import StereoCamera

_CAMERA = StereoCamera(430.0, 430.0, 375.0, 240.0, 0.11, 752, 480)
_START_NS, _FRAME_NS = 10**18, 50_000_000
_SIDES = (("left", "cam0", False), ("right", "cam1", True))


def write_bag(folder: Path, storage: Storage, pairs: int) -> None:
    """Write pairs of one image of noise, which no file system compresses."""
    image = np.random.default_rng(0).integers(0, 256, (480, 752)).astype(np.uint8)
    with bag_writer(folder, storage) as bag:
        for k in range(pairs):
            time_ns = _START_NS + _FRAME_NS * k
            for side, frame, right in _SIDES:
                bag.camera_info(f"/{side}/camera_info", frame, time_ns, _CAMERA, right=right)
                bag.image(f"/{side}/image_rect", frame, time_ns, image)


def main() -> int:
    """Measure, and print one line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("storage", choices=("rosbag2", "mcap"))
    parser.add_argument("pairs", type=int)
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        write_bag(folder, args.storage, args.pairs)
        size = sum(file.stat().st_size for file in folder.iterdir())
        begun = time.perf_counter()
        dataset = open_dataset(folder)
        opened = time.perf_counter()
        frames = sum(1 for _ in dataset.events())
        done = time.perf_counter()
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    print(f"{args.storage}, {size / 1e9:.1f} GB, {frames} pairs: ", end="")
    print(f"first pass {opened - begun:.1f} s, stream {done - opened:.1f} s, peak {peak:.0f} MB with writing")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
