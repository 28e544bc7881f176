"""Features instead of images: run once, keep the features, and run the filter alone on them with
other settings.

python examples/precomputed_features.py RECORDING
"""

import sys
import tempfile
from pathlib import Path

import vio
from vio.runs.folder import write_run_folder

config = vio.load_config()
dataset = vio.open_dataset(sys.argv[1])
print(f"running on {len(dataset.recording.frame_times_ns)} frames", flush=True)
first = vio.run(dataset, config, keep_observations=True)

with tempfile.TemporaryDirectory() as folder:
    write_run_folder(
        Path(folder) / "run", first, dataset.recording.reference, save_observations=True
    )
    features = vio.open_dataset(Path(folder) / "run" / "observations.npz")
    for clones in (5, 11, 20):
        again = vio.run(features, vio.load_config(overrides=[f"msckf.clones={clones}"]))
        x, y, z = again.trajectory.positions[-1]
        ms = 1e3 * again.wall_s / len(again.frames)
        print(f"window of {clones:2d} frames: {x:.3f} {y:.3f} {z:.3f} m, {ms:.1f} ms a frame")
