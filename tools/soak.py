"""The ROS 2 node over DDS on the loopback interface, disturbed at random for some minutes.

    python -m tools.soak RECORDING [--minutes 10] [--seed 0]

RECORDING has stereo images, and an IMU where it has one. The node runs in a process of its own, as a
robot's would; this one plays the recording again and again in real time and disturbs it: lost and
repeated messages, bursts, images of another size, steps of the clock, restarts of the publishers.
Prints the node's memory as it goes on, how many poses came, how far from its start the largest was
while nothing disturbed, with its standard deviation, whether the node ended in order, and whether
its run folders are whole.
"""

from __future__ import annotations

import argparse
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

import vio
from vio.cameras.rig import rig_of_rectified
from vio.datasets.bags.cdr import decoded
from vio.datasets.rigs.kalibr import kalibr_text
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
_QUIET_S = 5.0  # after which poses are looked at again
_TOPICS = ("/l/image", "/r/image", "/imu")


@dataclass(slots=True)
class Seen:
    """What came from the node."""

    poses: int = 0
    largest_m: float = 0.0  # position, of poses that were far from a disturbance
    sigma_m: float = 0.0  # of that position
    is_quiet: bool = False


class Player:
    """Publishes a recording again and again; where it begins anew its motion jumps."""

    def __init__(self, dataset: Dataset, rng: np.random.Generator) -> None:
        """Read the recording into memory."""
        self._events: list[Event] = [
            event for event in dataset.events() if isinstance(event, (StereoFrame, ImuSample))
        ]
        self._rng = rng
        self.transport: Transport = open_transport("dds", _DOMAIN)
        self._open()
        self.step_ns = 0  # of the clock
        self.fault = "none"

    def _open(self) -> None:
        self._send: dict[str, list[bytes]] = {}
        kinds = dict(zip(_TOPICS, ("Image", "Image", "Imu"), strict=True))
        topics = {name: f"sensor_msgs/msg/{kind}" for name, kind in kinds.items()}
        self._out = publisher(self.transport, topics)

    def restart(self) -> None:
        """Leave the graph, and join it again."""
        self.transport.close()
        self.transport = open_transport("dds", _DOMAIN)
        self._open()

    def play(self, until_s: float) -> None:
        """Publish in real time until a time of `time.monotonic`, with stamps that go on."""
        first_ns = self._events[0].time_ns
        while time.monotonic() < until_s:
            began_s = time.monotonic()
            began_ns = time.time_ns() + self.step_ns
            for event in self._events:
                due_s = began_s + (event.time_ns - first_ns) * 1e-9
                if self.fault != "burst":
                    time.sleep(max(0.0, due_s - time.monotonic()))
                if time.monotonic() >= until_s:
                    return
                self._publish(event, began_ns + event.time_ns - first_ns)

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


def _watch(transport: Transport, seen: Seen) -> Callable[[bytes], None]:
    def take(data: bytes) -> None:
        fields = decoded(data, "nav_msgs/msg/Odometry", "odometry")
        seen.poses += 1
        p = fields.pose.pose.position
        distance_m = float(np.linalg.norm([p.x, p.y, p.z]))
        if seen.is_quiet and distance_m > seen.largest_m:
            seen.largest_m = distance_m
            variances = np.asarray(fields.pose.covariance)[[0, 7, 14]]
            seen.sigma_m = float(np.sqrt(variances.sum()))

    transport.subscribe("/vio/odometry", "nav_msgs/msg/Odometry", take, "reliable")
    return take


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
    parser.add_argument("recording", metavar="RECORDING")
    parser.add_argument("--minutes", type=float, default=10.0)
    parser.add_argument("--seed", type=int, default=0)
    args = parser.parse_args()
    os.environ.setdefault("CYCLONEDDS_URI", _LOOPBACK)
    dataset = vio.open_dataset(args.recording)
    recording = dataset.recording
    rig = rig_of_rectified(recording.camera, recording.T_cam0_imu)
    if rig is None:
        parser.error("the recording states no image size, or is no pinhole pair")
    rng = np.random.default_rng(args.seed)
    with tempfile.TemporaryDirectory(prefix="soak") as temporary:
        root = Path(temporary)
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
    print("s      fault      poses  MiB    largest m  its sigma m", flush=True)
    while time.monotonic() < end_s and node.poll() is None:
        player.fault = str(rng.choice(faults))
        if player.fault == "clock":
            player.step_ns += int(rng.choice([-30, 30, 3600])) * 10**9
        if player.fault == "restart":
            player.restart()
        player.play(min(end_s, time.monotonic() + _EVERY_S / 3))
        watcher.spin(0.0)
        disturbed = player.fault
        player.fault = "none"
        player.play(min(end_s, time.monotonic() + _QUIET_S))
        watcher.spin(0.0)
        seen.is_quiet = True
        player.play(min(end_s, time.monotonic() + _EVERY_S / 3))
        watcher.spin(0.0)
        left_s = seconds - (end_s - time.monotonic())
        print(
            f"{left_s:6.0f} {disturbed:10s} {seen.poses:6d} {_memory_mib(node.pid):6.0f} "
            f"{seen.largest_m:8.2f} {seen.sigma_m:10.3f}",
            flush=True,
        )
        seen.is_quiet = False
        seen.largest_m = 0.0
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
    print((root / "node.txt").read_text(encoding="utf-8", errors="replace"))
    player.transport.close()
    watcher.close()
    kept = bool(folders) and len(whole) == len(folders)
    return 0 if lived and node.returncode == 0 and seen.poses and kept else 1


if __name__ == "__main__":
    sys.exit(main())
