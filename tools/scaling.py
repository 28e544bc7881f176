"""Plot what a frame costs against the number of features, the window, and the image size.

    python tools/scaling.py SOURCE PNG [--frames 40] [--repeat 2] [--motion auto]

CPU time of the whole process per frame without reading: the frames are held in memory. Other image sizes are the
recording's images resized, with the camera scaled alike. The first frames, which start the filter, are not counted. Of
the repetitions, which take turns over all points, the least disturbed one counts.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from vio.config import Config, load_config
from vio.datasets import open_dataset
from vio.geometry.stereo import StereoCamera
from vio.records import Event, Image, Observations, Recording, StereoFrame
from vio.runs.pipeline import run

FEATURES = (50, 100, 200, 400, 800)
CLONES = (5, 8, 11, 15, 20, 25)
SIZES = ((320, 240), (640, 480), (752, 480), (1280, 800), (1920, 1200))
_WARM_FRAMES = 12  # the window is full then


@dataclass(frozen=True, slots=True)
class HeldDataset:
    """The first frames of a recording in memory, resized; implements `vio.protocols.Dataset`."""

    recording: Recording
    held: tuple[Event, ...]

    def events(self, start: int = 0, stop: int | None = None, *, images: bool = True) -> Iterator[Event]:
        """Yield the events."""
        return iter(self.held)

    def observations(self, index: int) -> Observations | None:
        """Return None: there are images only."""
        return None


def held(source: Any, frames: int, size: tuple[int, int] | None) -> HeldDataset:
    """Hold the first frames of a recording, resized to a width and height; None: as they are."""
    recording, camera = source.recording, source.recording.camera
    if size is not None:
        camera = scaled(camera, size)
    events = tuple(
        replace(e, left=resized(e.left, size), right=resized(e.right, size)) if isinstance(e, StereoFrame) else e
        for e in source.events(0, frames)
    )
    return HeldDataset(replace(recording, camera=camera), events)


def scaled(camera: StereoCamera, size: tuple[int, int]) -> StereoCamera:
    """The camera of images resized to a width and height: pixel centres move as `cv2.resize` moves them."""
    assert camera.width is not None
    assert camera.height is not None
    x, y = size[0] / camera.width, size[1] / camera.height
    return replace(
        camera,
        fu=camera.fu * x,
        fv=camera.fv * y,
        cu=(camera.cu + 0.5) * x - 0.5,
        cv=(camera.cv + 0.5) * y - 0.5,
        width=size[0],
        height=size[1],
    )


def resized(image: Image | None, size: tuple[int, int] | None) -> Image | None:
    """An image of another width and height."""
    if image is None or size is None:
        return image
    method = cv2.INTER_AREA if size[0] < image.shape[1] else cv2.INTER_LINEAR
    return np.asarray(cv2.resize(image, size, interpolation=method), dtype=np.uint8)


def cpu_ms(dataset: HeldDataset, config: Config) -> float:
    """CPU time per frame after the first ones, ms."""
    marks: list[float] = []

    class Clock:
        def frame(self, *_: Any) -> None:
            marks.append(time.process_time())

        def close(self) -> None:
            pass

    run(dataset, config, viewer=Clock())
    return 1e3 * (marks[-1] - marks[_WARM_FRAMES - 1]) / (len(marks) - _WARM_FRAMES)


def measure(source: Any, frames: int, repeat: int, motion: str) -> dict[str, list[float]]:
    """CPU ms a frame of every point of the three plots."""

    def config(*overrides: str) -> Config:
        return load_config(None, [f'motion="{motion}"', *overrides])

    plain = held(source, frames, None)
    points: list[tuple[str, int, Callable[[], float]]] = []
    for k, n in enumerate(FEATURES):
        points.append(("features", k, lambda n=n: cpu_ms(plain, config(f"frontend.grid.target_features={n}"))))  # type: ignore[misc]
    for k, n in enumerate(CLONES):
        points.append(("clones", k, lambda n=n: cpu_ms(plain, config(f"msckf.clones={n}"))))  # type: ignore[misc]
    for k, size in enumerate(SIZES):
        points.append(("sizes", k, lambda s=size: cpu_ms(held(source, frames, s), config())))  # type: ignore[misc]
    out = {"features": [np.inf] * len(FEATURES), "clones": [np.inf] * len(CLONES), "sizes": [np.inf] * len(SIZES)}
    cpu_ms(plain, config())  # loads the compiled functions
    for _ in range(repeat):
        for name, k, point in points:
            out[name][k] = min(out[name][k], point())
    return out


def draw(times: dict[str, list[float]], title: str) -> Any:
    """The figure with three plots."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(10, 3.2), dpi=80, layout="constrained")
    pixels = [1e-6 * width * height for width, height in SIZES]
    panels: tuple[tuple[str, list[float], str], ...] = (
        ("features", [float(n) for n in FEATURES], "features tracked"),
        ("clones", [float(n) for n in CLONES], "poses in the window"),
        ("sizes", pixels, "image size, Mpx"),
    )
    for k, (name, x, label) in enumerate(panels):
        axes = figure.add_subplot(1, 3, k + 1)
        axes.plot(x, times[name], "o-", color="#1f5fbf", markersize=4)
        axes.set(xlabel=label, ylim=(0, None), xlim=(0, None))
        axes.grid(alpha=0.3)
        if k == 0:
            axes.set_ylabel("CPU ms a frame, without reading")
    figure.suptitle(title, fontsize=9)
    return figure


def main() -> int:
    """Measure, print a table, and write the figure."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("source", metavar="SOURCE", type=Path)
    parser.add_argument("png", metavar="PNG", type=Path)
    parser.add_argument("--frames", type=int, default=40)
    parser.add_argument("--repeat", type=int, default=2)
    parser.add_argument("--motion", default="auto")
    args = parser.parse_args()
    source = open_dataset(args.source, load_config().dataset)
    times = measure(source, args.frames, args.repeat, args.motion)
    camera = source.recording.camera
    for name, values in (("features", FEATURES), ("clones", CLONES), ("sizes", SIZES)):
        cells = (f"{value}: {ms:.1f}" for value, ms in zip(values, times[name], strict=True))
        print(f"{name:<9} {'  '.join(cells)} ms")
    draw(times, f"{camera.width}x{camera.height}, defaults but for what is varied").savefig(args.png, format="png")
    return 0


if __name__ == "__main__":
    sys.exit(main())
