"""Keyframes of a saved run as image files."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from vio.colmap.model import ModelImages
from vio.datasets.images import write_png
from vio.records import Image, IntArray
from vio.saved_run import SavedRun, stereo_frames


def write_images(
    run: SavedRun,
    source: str | None,
    keyframes: IntArray,
    names: ModelImages,
    folder: Path,
    each: Callable[[int, Image], None] = lambda keyframe, left: None,
) -> None:
    """Write the rectified images of the keyframes.

    Args:
        run: the run.
        source: the recording, where it is not at the place that the run names.
        keyframes: (K,) rows of the trajectory, increasing.
        names: their files, relative to the folder.
        folder: made if missing.
        each: is given each keyframe's index and its left image.

    Raises:
        DataError: the images are not to be had.
    """
    for name in (names.left[0], names.right[0]):
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
    for k, frame in enumerate(stereo_frames(run, source, keyframes)):
        assert frame.left is not None
        assert frame.right is not None
        for name, image in ((names.left[k], frame.left), (names.right[k], frame.right)):
            write_png(folder / name, image)
        each(k, frame.left)
