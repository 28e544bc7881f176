"""Reader of a COLMAP model's poses as a trajectory."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pycolmap

from vio.errors import DataError
from vio.geometry.lie import se3_inverse
from vio.offline.colmap.model import pose_rows
from vio.records import Trajectory

_MODEL_FILES = ("images.bin", "images.txt")
_STAMP = re.compile(r"\d{15,19}")  # nanoseconds, as in EuRoC's file names


def _read(place: Path) -> pycolmap.Reconstruction:
    try:
        return pycolmap.Reconstruction(place)
    except (ValueError, RuntimeError, OSError, IndexError, MemoryError) as error:
        raise DataError(
            f"{place}: pycolmap cannot read the model ({' '.join(str(error).split())[:160]}); "
            "export it again"
        ) from error


def read_colmap_trajectory(folder: Path) -> Trajectory:
    """Read the poses of a COLMAP model as a trajectory of cam0: the rig's reference camera, or the
    only camera.

    A file name of 15 to 19 digits is a time in nanoseconds; otherwise its last number is the frame
    number.

    Raises:
        DataError: no model, or its image names contain no numbers.
    """
    place = model_folder(folder)
    if place is None:
        raise DataError(
            f"{folder}: no COLMAP model (no images.bin or images.txt, also not in sparse/0)"
        )
    model = _read(place)
    images = _reference_images(model)
    if not images:
        raise DataError(f"{place}: the model contains no image with a pose")
    stamps = [_number(image.name, place) for image in images]
    order = np.argsort(stamps)
    numbers = np.array(stamps, dtype=np.int64)[order]
    if (np.diff(numbers) <= 0).any():
        raise DataError(
            f"{place}: two images of the reference camera have the same number; keep one camera in "
            "the model"
        )
    poses = se3_inverse(np.array([pose_rows(images[k].cam_from_world()) for k in order.tolist()]))
    if all(_STAMP.fullmatch(Path(image.name).stem) for image in images):
        return Trajectory(poses, numbers, "cam0")
    return Trajectory(poses, None, "cam0", numbers)


def model_folder(folder: Path) -> Path | None:
    """Return the folder with a model's files: this one, or its `sparse/0` or `sparse`.

    None: no model.
    """
    places = (folder, folder / "sparse" / "0", folder / "sparse")
    return next(
        (place for place in places if any((place / name).is_file() for name in _MODEL_FILES)), None
    )


def _reference_images(model: pycolmap.Reconstruction) -> list[pycolmap.Image]:
    """Return the reference camera's images of known pose."""
    images = model.images.values()
    return [image for image in images if image.has_pose and _is_reference(model, image)]


def _is_reference(model: pycolmap.Reconstruction, image: pycolmap.Image) -> bool:
    frame = model.frame(image.frame_id)
    return bool(model.rig(frame.rig_id).is_ref_sensor(model.camera(image.camera_id).sensor_id))


def _number(name: str, place: Path) -> int:
    found = re.findall(r"\d+", Path(name).stem)
    if not found:
        raise DataError(
            f"{place}: the image name {name!r} contains no frame number or time; name images by "
            "number"
        )
    return int(found[-1])
