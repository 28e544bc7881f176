"""Latency of `vio.LiveOdometry` against the frame rate, and a soak test.

python -m tools.bench_live latency FLIGHT [FLIGHT …] --rates 10,20,30,60 [--map] [--view]
python -m tools.bench_live soak --frames 36000 --width 376

`latency` plays a recording in real time, at its own frame rate and at those that divide it, once with the defaults and
once with `fast`. `soak` feeds a camera that sways in front of two walls, as fast as its frames are processed.
"""

from __future__ import annotations

import argparse
import gc
import resource
import sys
import tempfile
import threading
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np

import vio
from vio.geometry.lie import se3_inverse
from vio.live.warm_up import SwayingCamera
from vio.records import FrameResult, ImuSample, StereoFrame
from vio.sim.rigs import small_rig
from vio.view.live import RerunViewer, ViewedRig
from vio.view.stream import open_stream

_PARTS = 10  # of a soak test that are compared
_STEP_NS, _SAMPLES = 50_000_000, 10  # a soak test's frame, and IMU samples in it


class Pauses:
    """Times that Python's garbage collector takes, ms."""

    def __init__(self) -> None:
        self.ms: list[float] = []
        self._began = 0.0
        gc.callbacks.append(self._note)

    def _note(self, phase: str, info: dict[str, int]) -> None:
        if phase == "start":
            self._began = time.perf_counter()
        else:
            self.ms.append(1e3 * (time.perf_counter() - self._began))


def play(flight: Path, every: int, config: str | None, map_file: Path | None, view: Path | None) -> list[str]:
    """Play every n-th frame of a recording in real time; return the cells of a row."""
    dataset = vio.open_dataset(flight)
    recording, events = dataset.recording, list(dataset.events())
    frames = [event for event in events if isinstance(event, StereoFrame)][::every]
    samples = [event for event in events if isinstance(event, ImuSample)]
    settings = vio.load_config(None if config is None else Path(config))
    calls: dict[str, list[float]] = {"frame": [], "sample": []}
    watchers: list[RerunViewer] = []

    def on_frame(result: FrameResult) -> None:
        for watcher in watchers:
            watcher.frame(result)

    T_cam0_imu = recording.T_cam0_imu
    with vio.LiveOdometry(recording.camera, settings, T_cam0_imu=T_cam0_imu, on_frame=on_frame, map=map_file) as live:
        live.warm_up()
        if view is not None:
            stream, _ = open_stream(str(view), flight.name)
            watchers.append(RerunViewer(stream, ViewedRig(live.camera, live.T_cam0_body, live.motion, None)))
        began = time.perf_counter() + 0.1 - 1e-9 * frames[0].time_ns

        def feed(kind: str, stream: Sequence[StereoFrame | ImuSample]) -> None:
            for event in stream:
                time.sleep(max(0.0, began + 1e-9 * event.time_ns - time.perf_counter()))
                start = time.perf_counter()
                if isinstance(event, StereoFrame):
                    assert event.left is not None
                    assert event.right is not None
                    live.add_stereo(event.time_ns, event.left, event.right)
                else:
                    live.add_imu(event.time_ns, event.gyro, event.accel)
                calls[kind].append(1e3 * (time.perf_counter() - start))

        threads = [threading.Thread(target=feed, args=(k, s)) for k, s in (("frame", frames), ("sample", samples))]
        before_s = time.process_time(), time.perf_counter()
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        cores = (time.process_time() - before_s[0]) / (time.perf_counter() - before_s[1])
    found, rate = live.figures, 1e9 / float(np.median(np.diff([f.time_ns for f in frames])))
    size = f"{recording.camera.width}x{recording.camera.height}"
    beside = [name for name, there in (("map", map_file), ("viewer", view)) if there]
    cells = [size, f"{rate:.0f}", config or "default", " ".join(beside) or "-", f"{len(frames)}"]
    cells += [f"{found.dropped}", f"{cores:.2f}"]
    for value in (found.latency_median_ms, found.latency_95_ms, found.latency_worst_ms):
        cells.append("-" if value is None else f"{value:.0f}")
    for kind in ("sample", "frame"):
        cells.append(f"{np.percentile(calls[kind], 95):.2f} / {max(calls[kind]):.1f}")
    return cells


def latency(args: argparse.Namespace) -> None:
    """Print a table in Markdown."""
    names = ("images", "Hz", "config", "beside", "frames", "left out", "cores", "median", "95 %", "worst")
    print("|", " | ".join((*names, "add_imu 95 % / worst", "add_stereo 95 % / worst")), "|")
    print("|", " | ".join(["---"] * (len(names) + 2)), "|")
    for flight in args.flights:
        times = vio.open_dataset(flight).recording.frame_times_ns
        full = round(1e9 / float(np.median(np.diff(times))))
        for config in (None, "fast"):
            for rate in args.rates:
                with tempfile.TemporaryDirectory() as folder:
                    map_file = Path(folder) / "bench.map" if args.map else None
                    view = Path(folder) / "bench.rrd" if args.view else None
                    print("|", " | ".join(play(flight, max(1, full // rate), config, map_file, view)), "|", flush=True)


def soak(args: argparse.Namespace) -> None:
    """Print memory and times of each tenth of the frames."""
    cameras = small_rig(args.width, args.width * 9 // 16)
    lens = cameras.cam0
    T_cam0_imu = se3_inverse(cameras.T_imu_cam0)
    baseline_m = float(np.linalg.norm(cameras.T_imu_cam0[:3, 3] - cameras.T_imu_cam1[:3, 3]))
    pair = vio.Rig.rectified(lens.fu, lens.fv, lens.cu, lens.cv, baseline_m, lens.width, lens.height, T_cam0_imu)
    stages: list[float] = []

    def on_frame(result: FrameResult) -> None:
        stages.append(result.log.frontend_ms + result.log.monitor_ms + result.log.filter_ms)

    pauses = Pauses()
    head = (
        "simulated | resident MiB | points | CPU ms a frame | ms a frame, median | 95 % | worst | longest gc pause, ms"
    )
    print("|", head, "| collections |")
    print("|" + " --- |" * (head.count("|") + 2))
    with vio.LiveOdometry(pair, on_frame=on_frame, drop="block", keep_landmarks=args.keep_landmarks) as live:
        live.warm_up()
        pauses.ms.clear()
        source = SwayingCamera(live.camera, T_cam0_imu, 9.81)
        for part in range(_PARTS):
            began_s = time.process_time()
            for frame in range(part * args.frames // _PARTS, (part + 1) * args.frames // _PARTS):
                time_ns = frame * _STEP_NS
                for k in range(1 - _SAMPLES, 1):
                    sample_ns = time_ns + k * _STEP_NS // _SAMPLES
                    live.add_imu(sample_ns, *source.imu(sample_ns))
                left, right, _ = source.images(time_ns)
                assert right is not None
                live.add_stereo(time_ns, left, right)
            points = len(live.landmarks().ids)  # once all frames so far are done
            with open("/proc/self/statm") as stream:
                resident = int(stream.read().split()[1]) * resource.getpagesize() / 2**20
            used_ms = 1e3 * (time.process_time() - began_s) * _PARTS / args.frames
            shown = np.percentile(stages, [50, 95, 100])
            cells = [f"{(frame + 1) * _STEP_NS * 1e-9 / 60:.1f} min", f"{resident:.0f}", f"{points}", f"{used_ms:.1f}"]
            cells += [*(f"{v:.1f}" for v in shown), f"{max(pauses.ms, default=0):.1f}", f"{len(pauses.ms)}"]
            print("|", " | ".join(cells), "|", flush=True)
            stages.clear()
            pauses.ms.clear()
    for line in live.warnings:
        print("warning:", line)


def main() -> int:
    """Run one of the two."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    commands = parser.add_subparsers(dest="command", required=True)
    one = commands.add_parser("latency")
    one.add_argument("flights", type=Path, nargs="+")
    one.add_argument("--rates", type=lambda text: [int(word) for word in text.split(",")], default=[10, 20, 30, 60])
    one.add_argument("--map", action="store_true")
    one.add_argument("--view", action="store_true", help="write what the viewer shows to a file (extra view)")
    one.set_defaults(run=latency)
    two = commands.add_parser("soak")
    two.add_argument("--frames", type=int, default=36_000)
    two.add_argument("--width", type=int, default=376)
    two.add_argument("--keep-landmarks", type=int, default=100_000)
    two.set_defaults(run=soak)
    args = parser.parse_args()
    args.run(args)
    return 0


if __name__ == "__main__":
    sys.exit(main())
