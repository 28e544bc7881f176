"""The ROS 2 node over DDS on the loopback interface, disturbed at random for some minutes.

    python -m tools.soak [RECORDING] [--minutes 10] [--seed 0]

Without RECORDING, a flight is rendered that ends where it began, so that it can be played again and
again without a jump, and whose poses are known; one that is given has to be like that. The node
runs in a process of its own, as a robot's would; this one plays the flight in real time and
disturbs it: lost and repeated messages, bursts, images of another size, steps of the clock,
restarts of the publishers. Each disturbance lasts 5 s; 5 s later, poses are looked at for 5 s.
Prints the node's memory as it goes on, how many poses came, by how much the motion over these
seconds was off, whether the node ended in order, and whether its run folders are whole.
"""

from __future__ import annotations

import argparse
import math
import os
import signal
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

import vio
from vio.cameras.rig import rig_of_rectified
from vio.datasets.bags.cdr import decoded
from vio.datasets.bags.index import stamp_of
from vio.datasets.rigs.kalibr import kalibr_text
from vio.geometry.lie import FloatArray, se3_from_parts, se3_inverse
from vio.protocols import Dataset
from vio.records import Event, ImuSample, StereoFrame
from vio.ros2.opening import open_transport
from vio.ros2.transport import Transport, publisher
from vio.runs.finished import read_finished_run
from vio.runs.stated import read_metrics

_LOOPBACK = """<CycloneDDS><Domain><General><Interfaces><NetworkInterface name="lo"/></Interfaces>
<AllowMulticast>false</AllowMulticast></General><Discovery><ParticipantIndex>auto</ParticipantIndex>
<Peers><Peer address="localhost"/></Peers></Discovery></Domain></CycloneDDS>"""
_DOMAIN = 77
_EVERY_S = 15.0  # between two disturbances
_BURST_S = 0.5  # for which messages are held back
_ROUND_S = 20.0  # of the rendered flight
_TOPICS = ("/l/image", "/r/image", "/imu")


@dataclass(slots=True)
class Seen:
    """What came from the node."""

    poses: int = 0
    is_quiet: bool = False
    quiet: list[tuple[int, FloatArray]] = field(default_factory=list)  # stamps, and (4, 4) poses


class Player:
    """Publishes a closed flight again and again."""

    def __init__(self, dataset: Dataset, rng: np.random.Generator) -> None:
        """Read the recording into memory."""
        reference = dataset.recording.reference
        assert reference is not None
        assert reference.times_ns is not None
        frames_ns = dataset.recording.frame_times_ns
        self._first_ns = int(frames_ns[0])
        self._period_ns = int(frames_ns[-1] - frames_ns[0] + np.median(np.diff(frames_ns)))
        self._events: list[Event] = [
            event
            for event in dataset.events()
            if isinstance(event, (StereoFrame, ImuSample))
            and 0 <= event.time_ns - self._first_ns < self._period_ns
        ]
        self._truth = reference
        self._rng = rng
        self.transport: Transport = open_transport("dds", _DOMAIN)
        self._open()
        self.step_ns = 0  # of the clock
        self.fault = "none"
        self._next = 0  # event, counted over all rounds
        self._began_s = time.monotonic()
        self._began_ns = time.time_ns()

    def _open(self) -> None:
        kinds = dict(zip(_TOPICS, ("Image", "Image", "Imu"), strict=True))
        topics = {name: f"sensor_msgs/msg/{kind}" for name, kind in kinds.items()}
        self._out = publisher(self.transport, topics)

    def restart(self) -> None:
        """Leave the graph, and join it again; what was due meanwhile is lost."""
        self.transport.close()
        self.transport = open_transport("dds", _DOMAIN)
        self._open()
        while self._due_ns() * 1e-9 < time.monotonic() - self._began_s:
            self._next += 1

    def _due_ns(self) -> int:
        """When the next event is due, after the beginning."""
        rounds, k = divmod(self._next, len(self._events))
        return rounds * self._period_ns + self._events[k].time_ns - self._first_ns

    def play(self, until_s: float) -> None:
        """Publish in real time until a time of `time.monotonic`."""
        while time.monotonic() < until_s:
            due_ns = self._due_ns()
            due_s = due_ns * 1e-9
            if self.fault == "burst":
                due_s = math.ceil(due_s / _BURST_S) * _BURST_S
            wait_s = self._began_s + due_s - time.monotonic()
            if wait_s > 0:
                time.sleep(min(wait_s, max(until_s - time.monotonic(), 0.0)))
                if time.monotonic() >= until_s:
                    return
            self._publish(
                self._events[self._next % len(self._events)],
                self._began_ns + due_ns + self.step_ns,
            )
            self._next += 1

    def truth(self, time_ns: int) -> FloatArray:
        """Return the true pose (4, 4) at a stamp."""
        phase_ns = (time_ns - self.step_ns - self._began_ns) % self._period_ns
        times_ns = self._truth.times_ns
        assert times_ns is not None
        k = int(np.argmin(np.abs(times_ns - self._first_ns - phase_ns)))  # poses are of frames
        return self._truth.T_world_body[k]

    def _publish(self, event: Event, time_ns: int) -> None:
        repeats = 1
        if self.fault == "loss" and self._rng.random() < 0.5:
            repeats = 0
        if self.fault == "repeats":
            repeats = 2
        for _ in range(repeats):
            if isinstance(event, ImuSample):
                self._out.imu("/imu", "imu", replace(event, time_ns=time_ns))
            elif isinstance(event, StereoFrame) and event.left is not None:
                assert event.right is not None
                cut = 10 if self.fault == "sizes" else 0
                self._out.image("/l/image", "cam", time_ns, event.left[cut:])
                self._out.image("/r/image", "cam", time_ns, event.right[cut:])


def _memory_mib(pid: int) -> float:
    """Return the resident memory of a process."""
    for line in Path(f"/proc/{pid}/status").read_text(encoding="ascii").splitlines():
        if line.startswith("VmRSS"):
            return float(line.split()[1]) / 1024
    return 0.0


def _watch(transport: Transport, seen: Seen) -> None:
    def take(data: bytes) -> None:
        fields = decoded(data, "nav_msgs/msg/Odometry", "odometry")
        seen.poses += 1
        if seen.is_quiet:
            p = fields.pose.pose.position
            q = fields.pose.pose.orientation
            R = Rotation.from_quat([q.x, q.y, q.z, q.w]).as_matrix()
            T = se3_from_parts(R, np.array([p.x, p.y, p.z]))
            seen.quiet.append((stamp_of(fields), T))

    transport.subscribe("/vio/odometry", "nav_msgs/msg/Odometry", take, "reliable")


def _error_mm(seen: Seen, player: Player) -> tuple[float, float]:
    """Return by how much the motion between the first and the last quiet pose is off, mm, and the
    seconds between them; nan: there are not two.
    """
    if len(seen.quiet) < 2:
        return math.nan, 0.0
    (a_ns, a), (b_ns, b) = seen.quiet[0], seen.quiet[-1]
    moved = se3_inverse(a) @ b
    truth = se3_inverse(player.truth(a_ns)) @ player.truth(b_ns)
    return 1e3 * float(np.linalg.norm(moved[:3, 3] - truth[:3, 3])), (b_ns - a_ns) * 1e-9


def closed_flight(folder: Path) -> None:
    """Render a flight of 20 s that ends where it began, at the same velocity."""
    t = np.arange(-0.5, _ROUND_S + 0.5, 0.01)
    w = 2 * np.pi / _ROUND_S
    p = np.stack([1.5 * np.sin(w * t), 1.2 * np.sin(2 * w * t), 0.3 * np.sin(3 * w * t)], axis=1)
    yaw = 0.6 * np.sin(w * t)
    q = Rotation.from_euler("ZYX", np.stack([yaw, 0.1 * np.sin(2 * w * t), 0 * t], axis=1))
    path = folder / "closed.tum"
    rows = np.column_stack([t + 1.0, p, q.as_quat()])
    np.savetxt(path, rows, fmt="%.9f")
    command = [sys.executable, "-m", "vio", "render", "--out", str(folder / "flight")]
    command += ["--trajectory", str(path), "--rig", "euroc-rectified", "--width", "376"]
    frames = folder / "frames.txt"
    stamps_ns = np.round(1e9 * (1.0 + np.arange(0.0, _ROUND_S, 0.05))).astype(np.int64)
    frames.write_text("\n".join(str(x) for x in stamps_ns), encoding="ascii")
    command += ["--frame-times", str(frames), "--imu", "simulated"]
    subprocess.run(command, check=True)


def _node(folder: Path, calibration: Path, has_imu: bool) -> subprocess.Popen[bytes]:
    command = [sys.executable, "-m", "vio", "ros2", "--left", "/l/image", "--right", "/r/image"]
    command += ["--imu", "/imu"] if has_imu else []
    command += ["--calibration", str(calibration), "--out", str(folder), "--domain", str(_DOMAIN)]
    command += ["--transport", "dds"]
    with (folder.parent / "node.txt").open("wb") as log:
        return subprocess.Popen(command, stdout=log, stderr=log)


def main() -> int:
    """Run the tool and return the exit status: 0 where the node lived and ended in order."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n", maxsplit=1)[0])
    parser.add_argument("recording", metavar="RECORDING", nargs="?")
    parser.add_argument("--minutes", type=float, default=10.0)
    parser.add_argument("--seed", type=int, default=0)
    args = parser.parse_args()
    os.environ.setdefault("CYCLONEDDS_URI", _LOOPBACK)
    rng = np.random.default_rng(args.seed)
    with tempfile.TemporaryDirectory(prefix="soak") as temporary:
        root = Path(temporary)
        if args.recording is None:
            closed_flight(root)
        dataset = vio.open_dataset(args.recording or root / "flight")
        recording = dataset.recording
        rig = rig_of_rectified(recording.camera, recording.T_cam0_imu)
        if rig is None or recording.reference is None:
            parser.error("the recording states no image size or poses, or is no pinhole pair")
        calibration = root / "camchain.yaml"
        calibration.write_text(kalibr_text(rig), encoding="utf-8")
        node = _node(root / "out", calibration, recording.T_cam0_imu is not None)
        try:
            return _soak(node, root, Player(dataset, rng), rng, 60 * args.minutes)
        finally:
            node.kill()


def _soak(
    node: subprocess.Popen[bytes],
    root: Path,
    player: Player,
    rng: np.random.Generator,
    seconds: float,
) -> int:
    seen = Seen()
    watcher = open_transport("dds", _DOMAIN)
    _watch(watcher, seen)
    faults = ("none", "loss", "repeats", "burst", "sizes", "clock", "restart")
    end_s = time.monotonic() + seconds
    print("s      fault      poses  MiB    error mm  over s", flush=True)
    errors = []
    while time.monotonic() < end_s and node.poll() is None:
        player.fault = str(rng.choice(faults))
        if player.fault == "clock":
            player.step_ns += int(rng.choice([-30, 30, 3600])) * 10**9
        if player.fault == "restart":
            player.restart()
        _play(player, watcher, end_s)
        disturbed = player.fault
        player.fault = "none"
        _play(player, watcher, end_s)
        seen.quiet.clear()
        seen.is_quiet = True
        _play(player, watcher, end_s)
        seen.is_quiet = False
        error_mm, span_s = _error_mm(seen, player)
        errors.append(error_mm)
        left_s = seconds - (end_s - time.monotonic())
        print(
            f"{left_s:6.0f} {disturbed:10s} {seen.poses:6d} {_memory_mib(node.pid):6.0f} "
            f"{error_mm:9.1f} {span_s:6.1f}",
            flush=True,
        )
    lived = node.poll() is None
    if lived:
        # SIGINT is ignored where a shell started this program behind it
        node.send_signal(signal.SIGTERM)
        node.wait(timeout=300)
    folders = sorted(path.parent for path in root.glob("out*/metrics.json"))
    whole = [folder for folder in folders if read_metrics(folder)[0]["complete"]]
    poses = sum(len(read_finished_run(folder).trajectory) for folder in whole)
    print(
        f"lived {lived}, exit {node.returncode}, {len(folders)} run folders, {len(whole)} whole, "
        f"of {poses} poses"
    )
    print(
        f"motion over the quiet seconds off by {np.nanmedian(errors):.1f} mm (median), "
        f"{np.nanmax(errors):.1f} (largest), {np.count_nonzero(np.isnan(errors))} of {len(errors)} "
        "without poses"
    )
    print((root / "node.txt").read_text(encoding="utf-8", errors="replace"))
    player.transport.close()
    watcher.close()
    kept = bool(folders) and len(whole) == len(folders)
    return 0 if lived and node.returncode == 0 and seen.poses and kept else 1


def _play(player: Player, watcher: Transport, end_s: float) -> None:
    """Play for a third of the time between two disturbances, and take the poses that came."""
    until_s = min(end_s, time.monotonic() + _EVERY_S / 3)
    while time.monotonic() < until_s:
        player.play(min(until_s, time.monotonic() + 0.5))
        watcher.spin(0.0)


if __name__ == "__main__":
    sys.exit(main())
