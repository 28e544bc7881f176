"""Faults of the right camera, and an object, as features show them: the columns of `Observations` are changed.

What a front end of another program gives has no images that could be looked at. Each change takes
what a frame shows, and gives what it shows with the fault.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import TypeAlias

import numpy as np

from tools.faults.changes import Period
from vio.calibration.pair_rotation import turned_pixels
from vio.datasets.features import FeatureDataset
from vio.frontend.precomputed import with_right_of
from vio.geometry.lie import FloatArray
from vio.geometry.stereo import StereoCamera
from vio.records import Observations, Recording, feature_tracks, observations

# of what all frames show, the number of one of them, the camera and the period
ColumnChange: TypeAlias = Callable[
    [Sequence[Observations], int, StereoCamera, Period], Observations
]


def unchanged(
    seen: Sequence[Observations], k: int, camera: StereoCamera, period: Period
) -> Observations:
    """What a frame shows without a fault."""
    return seen[k]


def during(change: ColumnChange) -> ColumnChange:
    """A change of the frames of the fault's period alone."""

    def changed(
        seen: Sequence[Observations], k: int, camera: StereoCamera, period: Period
    ) -> Observations:
        if not period.holds(seen[k].time_ns):
            return seen[k]
        return change(seen, k, camera, period)

    return changed


def onwards(change: ColumnChange) -> ColumnChange:
    """A change of all frames from the fault's begin on."""

    def changed(
        seen: Sequence[Observations], k: int, camera: StereoCamera, period: Period
    ) -> Observations:
        return change(seen, k, camera, period) if seen[k].time_ns >= period.begin_ns else seen[k]

    return changed


def _frozen(
    seen: Sequence[Observations], k: int, camera: StereoCamera, period: Period
) -> Observations:
    before = max((o for o in seen if o.time_ns < period.begin_ns), key=lambda o: o.time_ns)
    return with_right_of(seen[k], before)


def _late(
    seen: Sequence[Observations], k: int, camera: StereoCamera, period: Period
) -> Observations:
    return with_right_of(seen[k], seen[max(k - 1, 0)])


def _exchanged(
    seen: Sequence[Observations], k: int, camera: StereoCamera, period: Period
) -> Observations:
    return replace(seen[k], z=seen[k].z[:, [2, 3, 0, 1]]).take(seen[k].has_right)


def _dark(
    seen: Sequence[Observations], k: int, camera: StereoCamera, period: Period
) -> Observations:
    return replace(seen[k], has_right=np.zeros(len(seen[k]), dtype=np.bool_))


def turned(degrees: float, axis: tuple[float, float, float]) -> ColumnChange:
    """The right camera is turned about an axis (unit length)."""

    def rotated(
        seen: Sequence[Observations], k: int, camera: StereoCamera, period: Period
    ) -> Observations:
        now = seen[k]
        H = turned_pixels(camera, np.radians(degrees) * np.array(axis))
        rays: FloatArray = np.column_stack([now.z[:, 2:], np.ones(len(now))]) @ H.T
        z = now.z.copy()
        z[:, 2:] = rays[:, :2] / rays[:, 2:]
        return replace(now, z=z)

    return rotated


_WALL_ID = 10**9  # of the first feature of the wall
_WALL_SHARE = 0.25, 0.75  # what it covers of the image's width
_WALL_SPEED_PX = 6.0  # a frame, to the left
_WALL_DISPARITY_PX = 30.0
_WALL_FEATURES = 12_000  # of its texture, 20 images wide: more than a scene has
_WALL_NOISE_PX = 0.2


def _object(
    seen: Sequence[Observations], k: int, camera: StereoCamera, period: Period
) -> Observations:
    """A wall that moves sideways before the cameras; it hides half of the features."""
    now = seen[k]
    width = camera.width or round(2 * camera.cu)
    height = camera.height or round(2 * camera.cv)
    begin, end = (share * width for share in _WALL_SHARE)
    scene = now.take((now.z[:, 0] < begin) | (now.z[:, 0] >= end))
    rng = np.random.default_rng(7)
    texture = rng.uniform([0.0, 0.0], [20.0 * width, height], (_WALL_FEATURES, 2))
    first = min(o.frame_index for o in seen if period.holds(o.time_ns))
    left = texture - [_WALL_SPEED_PX * (now.frame_index - first), 0.0]
    ids = np.flatnonzero((left[:, 0] >= begin) & (left[:, 0] < end))
    left = left[ids]
    z = np.column_stack([left, left - [_WALL_DISPARITY_PX, 0.0]])
    z += np.random.default_rng(now.frame_index).normal(0.0, _WALL_NOISE_PX, z.shape)
    wall = observations(now.frame_index, now.time_ns, ids + _WALL_ID, z)
    return Observations(
        now.frame_index,
        now.time_ns,
        np.concatenate([scene.ids, wall.ids]),
        np.concatenate([scene.z, wall.z]),
        np.concatenate([scene.has_right, wall.has_right]),
        np.concatenate([scene.stale, wall.stale]),
    )


COLUMNS: dict[str, ColumnChange] = {
    "right frozen": during(_frozen),
    "exchanged": during(_exchanged),
    "right dark": during(_dark),
    "right late": _late,
    "right rolled": onwards(turned(1.0, (0.0, 0.0, 1.0))),
    "right yawed": onwards(turned(0.5, (0.0, 1.0, 0.0))),
    "object": during(_object),
}


def changed_features(
    recording: Recording, seen: Sequence[Observations], change: ColumnChange, period: Period
) -> FeatureDataset:
    """Return the features of a recording with a fault, as those of another program."""
    frames = len(recording.frame_times_ns)
    shown = {o.frame_index: change(seen, k, recording.camera, period) for k, o in enumerate(seen)}
    return FeatureDataset(
        replace(recording, kind="log", has_images=False, motion=frozenset()),
        feature_tracks(shown, frames),
        [],
        np.arange(frames),
    )
