"""Which frame of a recording each pose of a reference without times belongs to.

A row of a KITTI file is the next image, or the image of that number: where images were lost, or a
recording is a part of a longer one, the two differ, and the number of rows tells which is meant.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from vio.errors import EvaluationError
from vio.records import IntArray, Trajectory


def numbered_by_images(reference: Trajectory, image_numbers: IntArray | None) -> Trajectory:
    """Return a reference without times numbered by the frames of a recording; poses of images that
    it lacks are left out. One with times is returned as it is, and so is any where the names of the
    images do not count frames: then row k is frame k.

    Args:
        reference: M poses; with frame numbers, as a COLMAP model's, these are those of the images,
            or of the frames.
        image_numbers: (F,) increasing, by which the images are named; None: not known.

    Raises:
        EvaluationError: several frames could be meant, or no image has a pose.
    """
    if reference.times_ns is not None or image_numbers is None:
        return reference
    frames = np.arange(len(image_numbers), dtype=np.int64)
    if reference.frame_indices is not None:
        by_number = np.isin(reference.frame_indices, image_numbers).all()
        by_frame = np.isin(reference.frame_indices, frames).all()
        if not by_number:
            return reference
        rows = np.searchsorted(image_numbers, reference.frame_indices)
        if by_frame and not np.array_equal(rows, reference.frame_indices):
            raise EvaluationError(_unclear(reference, image_numbers, "their numbers count"))
        return replace(reference, frame_indices=rows)
    row_of_frame = _rows_of_frames(len(reference), image_numbers)
    if row_of_frame is None:
        raise EvaluationError(_unclear(reference, image_numbers, "they are of"))
    there = (row_of_frame >= 0) & (row_of_frame < len(reference))
    if not there.any():
        raise EvaluationError(_unclear(reference, image_numbers, "they are of"))
    return replace(
        reference,
        T_world_body=reference.T_world_body[row_of_frame[there]],
        frame_indices=frames[there],
    )


def _rows_of_frames(poses: int, numbers: IntArray) -> IntArray | None:
    """Return the row (F,) of each frame among a number of poses; None: several could be meant.

    A reference with a pose for each image, for each number from the first image to the last, or
    for each from 0 or 1 to the last, is of these. A longer one is of a whole sequence, a shorter
    one ends early.
    """
    in_order = np.arange(len(numbers), dtype=np.int64)
    from_first = numbers - numbers[0]
    step = int(np.gcd.reduce(from_first)) or 1
    own = (in_order, from_first // step, from_first)
    whole = (numbers, numbers - 1)
    for rows in (*own, *whole):
        if rows[-1] + 1 == poses:
            return rows
    usual = whole[1] if numbers[0] == 1 else whole[0]
    if poses > usual[-1]:
        return usual
    possible = [rows for rows in (*own, usual) if rows[0] < poses]
    ends = [rows[rows < poses] for rows in possible]
    if not all(np.array_equal(end, ends[0]) for end in ends):
        return None
    return possible[0]


def _unclear(reference: Trajectory, numbers: IntArray, what: str) -> str:
    return (
        f"the reference has {len(reference)} poses without times, and the recording {len(numbers)} "
        f"images, numbered {numbers[0]} to {numbers[-1]}: whether {what} images in their order or "
        "numbers is not known; give the reference with times (TUM form), or a pose for each image"
    )
