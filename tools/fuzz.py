"""Changed run folders, messages and calls at random, within a time: nothing may end by a traceback,
hang, or write outside of its folder.

    python -m tools.fuzz [folders messages calls] [--seconds 200] [--seed 0] [--only SEED]

Each case has a seed of its own, which `--only` repeats. A case that fails is printed with its seed;
the exit status is then 1.
"""

from __future__ import annotations

import argparse
import contextlib
import hashlib
import io
import json
import logging
import shutil
import sys
import tempfile
import threading
import time
import traceback
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

import vio
from vio.cli import main as vio_main
from vio.config import Config
from vio.datasets.rigs import load_rig
from vio.errors import VioError
from vio.geometry.stereo import StereoCamera
from vio.live.live_odometry import LiveOdometry
from vio.records import ImuSample, StereoFrame
from vio.ros2.sensors import Sensors, SensorTopics
from vio.ros2.transport import Quality, publisher
from vio.runs.folder import growing_folder
from vio.runs.live_folder import LiveFolder, LiveRunSettings
from vio.runs.pipeline import RunControl, run

_MAX_S = 120.0  # that a case may take, on a busy computer
_FRAMES = 8  # of a case
_CHECKPOINT_S = 6.0  # longer than between two checkpoints
_WRONG: tuple[Any, ...] = (
    None,
    True,
    -1,
    0,
    1.5,
    10**30,
    float("nan"),
    "",
    "a",
    "../x",
    [],
    [1],
    {},
    {"a": 1},
)
Case = Callable[[np.random.Generator], None]


class FoundError(Exception):
    """A case did what none may do."""


@contextlib.contextmanager
def _quietly() -> Iterator[io.StringIO]:
    """Catch what is printed."""
    printed = io.StringIO()
    with contextlib.redirect_stdout(printed), contextlib.redirect_stderr(printed):
        yield printed


def _checksum(folder: Path) -> str:
    """Return a hash of all files of a folder."""
    total = hashlib.sha256()
    for path in sorted(p for p in folder.rglob("*") if p.is_file()):
        total.update(str(path.relative_to(folder)).encode())
        total.update(path.read_bytes())
    return total.hexdigest()


# Run folders


class Folders:
    """Finished, stopped and killed live runs of a rendered flight, of which one file is changed."""

    def __init__(self, root: Path) -> None:
        """Render, and run."""
        self._root = root
        self._flight = root / "flight"
        render = ["render", "--scene", "room", "--rate", "10", "--width", "160", "--duration", "1"]
        with _quietly():
            vio_main([*render, "--out", str(self._flight), "--workers", "1"])
            command = ["run", str(self._flight), "--quiet", "--save-observations", "--no-plot"]
            vio_main([*command, "--out", str(root / "done")])
        self._log = root / "done" / "observations.npz"
        self._stop()
        self._kill()

    def _kill(self) -> None:
        """Keep the folder of a live run as it is before its end."""
        rig = load_rig(self._flight)
        folder = LiveFolder(LiveRunSettings(self._root / "ended", "camera", True), Config(), rig)
        with LiveOdometry(rig, Config(), drop="none", sink=folder) as live:
            for event in vio.open_dataset(self._flight).events():
                if isinstance(event, ImuSample):
                    live.add_imu(event.time_ns, event.gyro, event.accel)
                elif isinstance(event, StereoFrame) and event.left is not None:
                    assert event.right is not None
                    if event.index == _FRAMES // 2:
                        time.sleep(_CHECKPOINT_S)  # after which a frame writes a checkpoint
                    live.add_stereo(event.time_ns, event.left, event.right)
            live.landmarks()  # which waits for all frames
            folder.save()
            time.sleep(1.0)
            shutil.copytree(self._root / "ended", self._root / "killed")
        folder.close()

    def _stop(self) -> None:
        dataset = vio.open_dataset(self._log)
        request = dict.fromkeys(("reference", "lengths_m", "save_calibration", "map", "command"))
        request |= {"map_density": None, "start": 0, "stop": _FRAMES, "source": f"log:{self._log}"}
        request |= {"save_observations": True, "localise": False, "plot": False}
        left = [4]  # frames

        def stops() -> str | None:
            left[0] -= 1
            return "stopped" if left[0] <= 0 else None

        folder = growing_folder(self._root / "stopped", dataset, Config(), request)
        control = RunControl(folder, should_stop=stops)
        run(dataset, Config(), stop=_FRAMES, keep_observations=True, control=control)

    def __call__(self, rng: np.random.Generator) -> None:
        """Change a file of a run, and use the run."""
        kind = str(rng.choice(["done", "stopped", "killed"]))
        place = self._root / "place"
        outside = self._root / "outside"
        for folder in (place, outside):
            shutil.rmtree(folder, ignore_errors=True)
        shutil.copytree(self._root / kind, place)
        outside.mkdir()
        (outside / "mine.yaml").write_text("mine\n")
        before = _checksum(outside)
        changed = self._change(place, outside, rng)
        commands = {
            "done": (["report", str(place)], ["eval", str(place), str(self._root / "done")]),
            "stopped": (["run", "--resume", str(place), "--quiet"],),
            "killed": (["run", "--resume", str(place), "--quiet"],),
        }[kind]
        for command in commands:
            with _quietly() as printed:
                status = vio_main(command)
            if status not in (0, 1, 130) or "Traceback" in printed.getvalue():
                raise FoundError(f"{changed}: {command[0]} ended with {status}")
            if _checksum(outside) != before:
                raise FoundError(f"{changed}: {command[0]} wrote outside of its folder")

    def _change(self, place: Path, outside: Path, rng: np.random.Generator) -> str:
        files = sorted(p for p in place.rglob("*") if p.is_file())
        path = files[int(rng.integers(len(files)))]
        stated = [p for p in files if p.suffix == ".json"]
        if rng.random() < 0.5:
            path = stated[int(rng.integers(len(stated)))]
            return _changed_value(path, (*_WRONG, str(outside / "mine.yaml")), rng)
        data = bytearray(path.read_bytes())
        if rng.random() < 0.5 and data:
            for _ in range(int(rng.integers(1, 5))):
                data[int(rng.integers(len(data)))] ^= 1 << int(rng.integers(8))
        else:
            data = data[: int(rng.integers(len(data) + 1))]
        path.write_bytes(bytes(data))
        return f"{path.name}: other bytes"


def _changed_value(path: Path, values: tuple[Any, ...], rng: np.random.Generator) -> str:
    """Replace or remove one value of a JSON file, at any depth."""
    content = json.loads(path.read_text())
    places: list[tuple[Any, Any]] = []

    def collect(node: Any) -> None:
        items = node.items() if isinstance(node, dict) else enumerate(node)
        for key, part in list(items):
            places.append((node, key))
            if isinstance(part, (dict, list)):
                collect(part)

    collect(content)
    holder, key = places[int(rng.integers(len(places)))]
    if rng.random() < 0.2:
        del holder[key]
    else:
        holder[key] = values[int(rng.integers(len(values)))]
    path.write_text(json.dumps(content))
    return f"{path.name}: {key} is {holder.get(key) if isinstance(holder, dict) else 'other'}"


# Messages


class _Graph:
    """Notes who takes the messages of a topic, and those that are published."""

    def __init__(self) -> None:
        self.takers: dict[str, Callable[[bytes], None]] = {}
        self.messages: list[tuple[str, bytes]] = []

    def subscribe(
        self, topic: str, kind: str, take: Callable[[bytes], None], quality: Quality
    ) -> None:
        self.takers[topic] = take

    def advertise(self, topic: str, kind: str, quality: Quality) -> Callable[[bytes], None]:
        return lambda data: self.messages.append((topic, data))

    def subscribers(self, topic: str) -> int:
        return 1

    def topics(self) -> dict[str, frozenset[str]]:
        return {}

    def spin(self, timeout_s: float) -> None:
        """Nothing waits."""

    def close(self) -> None:
        """Nothing is held."""


_CAMERA = StereoCamera(fu=80.0, fv=80.0, cu=40.0, cv=30.0, baseline_m=0.1, width=80, height=60)


class Messages:
    """A rig's messages, of which some are changed, into the node's inputs."""

    def __init__(self) -> None:
        """Make whole messages."""
        self._topics = SensorTopics("/l", "/r", "/imu")
        graph = _Graph()
        out = publisher(graph, {})
        rng = np.random.default_rng(0)
        for k in range(_FRAMES):
            pixels = rng.integers(0, 255, (60, 80), dtype=np.uint8)
            for topic in ("/l", "/r"):
                out.image(topic, "cam", k * 10**8, pixels)
            for j in range(4):
                time_ns = k * 10**8 + j * 25 * 10**6
                sample = ImuSample(time_ns, np.zeros(3), np.array([0, 0, 9.81]))
                out.imu("/imu", "imu", sample)
        self._messages = graph.messages

    def __call__(self, rng: np.random.Generator) -> None:
        """Hand all messages over; what is wrong with them must not be raised."""
        graph = _Graph()
        with LiveOdometry(_CAMERA, T_cam0_imu=np.eye(4)) as odometry:
            Sensors(graph, self._topics, odometry, "reliable")
            for topic, data in self._messages:
                for message in _changed_messages(data, rng):
                    graph.takers[topic](message)
        odometry.check()


def _changed_messages(data: bytes, rng: np.random.Generator) -> list[bytes]:
    """Return a message as it is, changed, twice, or none."""
    dice = rng.random()
    if dice < 0.6:
        return [data]
    changed = bytearray(data)
    if dice < 0.8:
        reach = min(len(changed), int(rng.choice([16, 64, len(changed)])))
        for _ in range(int(rng.integers(1, 4))):
            changed[int(rng.integers(reach))] = int(rng.integers(256))
    elif dice < 0.9:
        changed = changed[: int(rng.integers(len(changed) + 1))]
    elif dice < 0.95:
        return [data, data]
    else:
        return []
    return [bytes(changed)]


# Calls


def _calls(rng: np.random.Generator) -> None:
    """Call a `LiveOdometry` from three threads, with right and wrong values; some end it."""
    ends = int(rng.integers(3, 20))
    error = [SystemExit(3), ValueError("of a callback"), None][int(rng.integers(3))]
    count = [0]

    def on_frame(result: Any) -> None:
        count[0] += 1
        if error is not None and count[0] == ends:
            raise error

    config = Config() if rng.random() < 0.5 else replace(Config(), motion="none")
    drop: Any = str(rng.choice(["oldest", "none", "block"]))
    live = LiveOdometry(
        _CAMERA, config, T_cam0_imu=np.eye(4), on_frame=on_frame, drop=drop, queue_frames=2
    )
    failures: list[str] = []
    threads = [
        threading.Thread(target=_call_often, args=(live, seed, failures), daemon=True)
        for seed in rng.integers(0, 2**31, 3).tolist()
    ]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(_MAX_S)
        if thread.is_alive():
            raise FoundError("a call hangs")
    closing = threading.Thread(target=_close, args=(live,), daemon=True)
    closing.start()
    closing.join(_MAX_S)
    if closing.is_alive():
        raise FoundError("close() hangs")
    if failures:
        raise FoundError(failures[0])


def _close(live: LiveOdometry) -> None:
    with contextlib.suppress(VioError, ValueError):
        live.close()


def _call_often(live: LiveOdometry, seed: int, failures: list[str]) -> None:
    rng = np.random.default_rng(seed)
    wrong: tuple[Any, ...] = (*_WRONG, np.zeros(3), np.zeros((60, 80)), b"", object())

    def some(right: Any) -> Any:
        return right if rng.random() < 0.85 else wrong[int(rng.integers(len(wrong)))]

    image = rng.integers(0, 255, (60, 80), dtype=np.uint8)
    time_ns = 0
    for _ in range(60):
        time_ns += int(rng.choice([10**6, 5 * 10**7, 10**8]))
        calls: tuple[Callable[[], Any], ...] = (
            lambda: live.add_stereo(some(time_ns), some(image), some(image)),  # noqa: B023
            lambda: live.add_imu(some(time_ns), some([0, 0, 0]), some([0, 0, 9.8])),  # noqa: B023
            lambda: live.predict(some(time_ns)),  # noqa: B023
            live.landmarks,
            live.latest,
            live.check,
            lambda: iter(live),
            lambda: live.figures,
            lambda: live.warnings,
            live.calibrated_rig,
            live.reset if rng.random() < 0.2 else live.latest,
            live.close if rng.random() < 0.02 else live.latest,
        )
        call = calls[int(rng.integers(len(calls)))] if rng.random() < 0.5 else calls[0]
        try:
            call()
        except VioError:
            continue
        except ValueError as error:
            if str(error) != "of a callback":
                failures.append("".join(traceback.format_exception(error)))
        except Exception as error:  # noqa: BLE001 # what is looked for
            failures.append("".join(traceback.format_exception(error)))


def _cases(name: str, root: Path) -> Case:
    if name == "folders":
        return Folders(root)
    return Messages() if name == "messages" else _calls


def _run(name: str, args: argparse.Namespace, root: Path) -> int:
    """Run the cases of a kind until their time is over; return how many failed."""
    case = _cases(name, root)
    end_s = time.monotonic() + args.seconds
    seed = args.seed if args.only is None else args.only
    failed = done = 0
    while time.monotonic() < end_s:
        try:
            case(np.random.default_rng(seed))
        except FoundError as error:
            failed += 1
            print(f"{name}, seed {seed}: {error}", flush=True)
        except Exception:  # noqa: BLE001 # what is looked for
            failed += 1
            print(f"{name}, seed {seed}:\n{traceback.format_exc()}", flush=True)
        done += 1
        seed += 1
        if args.only is not None:
            break
    print(f"{name}: {done} cases, {failed} failed", flush=True)
    return failed


def main() -> int:
    """Run the tool and return the exit status."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n", maxsplit=1)[0])
    kinds = ("folders", "messages", "calls")
    parser.add_argument("kinds", nargs="*", metavar="KIND", help=f"of {', '.join(kinds)} (all)")
    parser.add_argument("--seconds", type=float, default=200.0, help="for each kind")
    parser.add_argument("--seed", type=int, default=0, help="of the first case")
    parser.add_argument("--only", type=int, metavar="SEED", help="repeat one case")
    args = parser.parse_args()
    unknown = set(args.kinds) - set(kinds)
    if unknown:
        parser.error(f"no kind {', '.join(sorted(unknown))}; give of {', '.join(kinds)}")
    logging.disable(logging.CRITICAL)
    failed = 0
    with tempfile.TemporaryDirectory(prefix="fuzz") as root:
        for name in args.kinds or kinds:
            failed += _run(name, args, Path(root))
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
