"""Keyframes of a saved run as image files."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from vio.datasets.images import write_png
from vio.offline.colmap.model import ModelImages
from vio.offline.saved_run import SavedRun
from vio.records import Image, IntArray


def write_images(
    run: SavedRun,
    source: str | None,
    keyframes: IntArray,
    names: ModelImages,
    folder: Path,
    each: Callable[[int, Image], None] = lambda keyframe, left: None,
) -> None:
    """Write the rectified images of keyframes (K,), increasing rows of the trajectory, in colour where there is any.

    Names are relative to the folder. `source` is the recording, if it is not at the path stored in the run; `each` is
    called with each keyframe's index and left image.

    Raises:
        DataError: the images are not available.
    """
    for name in (names.left[0], names.right[0]):
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
    for k, frame in enumerate(run.images.frames(run.tracked.frames[keyframes], source, colour=True)):
        assert frame.left is not None
        assert frame.right is not None
        for name, image in ((names.left[k], frame.left), (names.right[k], frame.right)):
            write_png(folder / name, image)
        each(k, frame.left)
