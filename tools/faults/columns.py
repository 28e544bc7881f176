"""Faults of the right camera as features show them: the columns of `Observations` are changed.

What a front end of another program gives has no images that could be looked at. Each change takes
what a frame shows, and gives what it shows with the fault.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import TypeAlias

import numpy as np

from tools.faults.changes import Period
from vio.datasets.features import FeatureDataset
from vio.frontend.precomputed import with_right_of
from vio.geometry.lie import FloatArray, so3_exp
from vio.geometry.stereo import StereoCamera
from vio.records import Observations, Recording, feature_tracks

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


def _rolled(degrees: float) -> ColumnChange:
    """The right camera is turned about its axis."""

    def rolled(
        seen: Sequence[Observations], k: int, camera: StereoCamera, period: Period
    ) -> Observations:
        now = seen[k]
        K = np.array([[camera.fu, 0.0, camera.cu], [0.0, camera.fv, camera.cv], [0.0, 0.0, 1.0]])
        H = K @ so3_exp(np.radians(degrees) * np.array([0.0, 0.0, 1.0])) @ np.linalg.inv(K)
        turned: FloatArray = np.column_stack([now.z[:, 2:], np.ones(len(now))]) @ H.T
        z = now.z.copy()
        z[:, 2:] = turned[:, :2] / turned[:, 2:]
        return replace(now, z=z)

    return rolled


COLUMNS: dict[str, ColumnChange] = {
    "right frozen": during(_frozen),
    "exchanged": during(_exchanged),
    "right dark": during(_dark),
    "right late": _late,
    "right rolled": onwards(_rolled(1.0)),
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
