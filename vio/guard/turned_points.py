"""The rotation of a right camera by SIFT key points of some pairs, whatever the rows.

A rotation after which the rows of nearly all agree is that of the camera, if all pairs have the
same one. Pairs of images of two times have another one in each pair, or more points agree with the
image of their time. The yaw, which rows tell badly, comes from motion between the pairs
(`vio.calibration.pair_rotation`).
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import cv2
import numpy as np

from vio.calibration.pair_rotation import (
    MIN_ROW_YAW_DEG,
    MIN_TURN_DEG,
    PairRotation,
    is_turned_by_rows,
    rotation_by_motion,
    rotation_by_rows,
)
from vio.dataclass import dataclass
from vio.frontend.keypoints import Keypoints, OpenCvExtractor
from vio.geometry.lie import FloatArray
from vio.geometry.stereo import StereoCamera
from vio.records import Image, IntArray


class _PointRules(NamedTuple):
    """When pairs are those of a turned camera."""

    keypoints: int = 1500
    ratio: float = 0.75  # of the distances of nearest and second descriptor, Lowe (2004)
    # of SIFT's matches that agree with a rotation; true pairs have 0.85 and more
    min_share: float = 0.75
    pairs: int = 6  # that tell the rotation
    alike_deg: float = 0.1  # rotations of pairs differ by less …
    alike_sigmas: float = 4.0  # … and so many standard deviations
    max_delay: int = 3  # frames by which right images may be late in place of turned …
    clear_factor: float = 1.1  # … if so many times as many points agree
    yaw_sigma_deg: float = 0.05  # of a yaw beside what the fit says: lenses of real cameras


_POINTS = _PointRules()


@dataclass(frozen=True, slots=True)
class _Pair:
    """A pair by its key points."""

    left: Keypoints
    right: Keypoints
    z: FloatArray  # (N, 4) pixels [ul vl ur vr] of the left ones; right ones NaN where none matches


class TurnedPoints:
    """Key points of successive pairs, and the rotation that they have in common."""

    def __init__(self, camera: StereoCamera, *, rows_may_agree: bool) -> None:
        """Begin; `rows_may_agree`: pairs whose rows agree as calibrated may still have a yaw."""
        self._camera = camera
        self._rows_may_agree = rows_may_agree
        self._pairs: list[_Pair] = []
        self._rows: list[PairRotation] = []  # of the pairs

    @property
    def complete(self) -> bool:
        """Whether there are enough pairs."""
        return len(self._pairs) >= _POINTS.pairs

    def add(self, images: tuple[Image, ...]) -> bool:
        """Add the images (H, W) of a pair; return whether the pairs can be those of a turned
        camera.
        """
        left, right = OpenCvExtractor("sift", _POINTS.keypoints)(*images)
        pair = _Pair(left, right, pixels_in_both(left, right))
        found = self._by_rows(pair.z)
        if found is None or not (
            self._rows_may_agree or is_turned_by_rows(np.degrees(found.rotation))
        ):
            return False
        self._pairs.append(pair)
        self._rows.append(found)
        return _is_constant(self._rows) and not self._fits_another_time()

    def rotation(self) -> PairRotation | None:
        """Return the rotation of the pairs; None: it is no more than that of usual calibrations."""
        found = self._rotation()
        if np.abs(found.rotation).max() >= np.radians(MIN_TURN_DEG):
            return found
        return None

    def _by_rows(self, z: FloatArray) -> PairRotation | None:
        found = rotation_by_rows(self._camera, z[np.isfinite(z[:, 2])])
        if found is not None and found.share >= _POINTS.min_share:
            return found
        return None

    def _rotation(self) -> PairRotation:
        """Return the rotation of all pairs."""
        moved = [
            found
            for before, now, rows in zip(self._pairs, self._pairs[1:], self._rows, strict=False)
            if (found := self._by_motion(before, now, rows.rotation)) is not None
        ]
        if not moved:
            return self._rotation_by_rows()
        floor = np.diag([0.0, np.radians(_POINTS.yaw_sigma_deg) ** 2, 0.0])
        weights = [np.linalg.inv(found.covariance + floor) for found in moved]
        covariance = np.linalg.inv(np.sum(weights, axis=0))
        mean = covariance @ np.sum(
            [W @ found.rotation for W, found in zip(weights, moved, strict=True)], axis=0
        )
        points = sum(found.points for found in moved)
        share = float(np.mean([found.share for found in moved]))
        # neighbouring intervals share a pair and the lens: they count as one
        return PairRotation(mean, len(moved) * covariance, points, share)

    def _rotation_by_rows(self) -> PairRotation:
        """Return the rotation by the rows of all pairs; no yaw where they may show a lens."""
        mean = np.mean([found.rotation for found in self._rows], axis=0)
        if abs(mean[1]) < np.radians(MIN_ROW_YAW_DEG):
            mean[1] = 0.0
        return replace(self._rows[-1], rotation=mean)

    def _by_motion(self, before: _Pair, now: _Pair, start: FloatArray) -> PairRotation | None:
        """Return the rotation by the points that two pairs show."""
        rows, others = matched_rows(before.left, now.left)
        first = before.z[rows]
        second = now.z[others]
        both = np.isfinite(first[:, 2]) & np.isfinite(second[:, 2])
        return rotation_by_motion(self._camera, first[both], second[both], start)

    def _fits_another_time(self) -> bool:
        """Whether clearly more points of the newest pair agree with the other image of a pair
        before, along the rows as calibrated.
        """
        now = self._pairs[-1]
        least = _POINTS.clear_factor * self._rows[-1].points
        for before in self._pairs[-1 - _POINTS.max_delay : -1]:
            for left, right in ((before.left, now.right), (now.left, before.right)):
                found = self._by_rows(pixels_in_both(left, right))
                if (
                    found is not None
                    and found.points > least
                    and not is_turned_by_rows(np.degrees(found.rotation))
                ):
                    return True
        return False


def pixels_in_both(left: Keypoints, right: Keypoints) -> FloatArray:
    """Return pixels `[ul vl ur vr]` (N, 4) of the key points of a left image; right ones are not a
    number where none matches.
    """
    rows, others = matched_rows(left, right)
    z = np.full((len(left), 4), np.nan)
    z[:, :2] = left.pixels
    z[rows, 2:] = right.pixels[others]
    return z


def _is_constant(found: list[PairRotation]) -> bool:
    """Whether rotations by the rows of some pairs are the same about x and z."""
    angles = np.degrees([each.rotation for each in found])[:, [0, 2]]
    sigmas = np.degrees([each.sigmas for each in found])[:, [0, 2]]
    allowed = _POINTS.alike_deg + _POINTS.alike_sigmas * sigmas.max(axis=0)
    return bool((np.ptp(angles, axis=0) < allowed).all())


def matched_rows(a: Keypoints, b: Keypoints) -> tuple[IntArray, IntArray]:
    """Return rows (M,) and (M,) of key points whose descriptors are clearly next to each other."""
    if min(len(a), len(b)) < 2:
        return np.zeros(0, dtype=np.int64), np.zeros(0, dtype=np.int64)
    near = cv2.BFMatcher(cv2.NORM_L2).knnMatch(a.descriptors, b.descriptors, k=2)
    best = [first for first, second in near if first.distance < _POINTS.ratio * second.distance]
    return (
        np.array([m.queryIdx for m in best], dtype=np.int64),
        np.array([m.trainIdx for m in best], dtype=np.int64),
    )
