"""A right camera that is turned against its calibration from the start, by some tenths of a degree
and more.

Its rows differ by more than features are searched, or by so much that terms of small angles do not
hold; turned about y, far points have disparities that are negative. It is suspected where few corners
of the first pair match along their rows, or many with a negative disparity, or where features of
the first two pairs that moved have another yaw. Then points are matched by SIFT without regard to
rows. A rotation after which the rows of nearly all agree is that of the camera, if the next pairs
have the same one. Pairs of images of two times have another one in each pair, or more points agree
with the image of their time. The yaw, which rows tell badly, comes from motion between the pairs
(`vio.calibration.pair_rotation`).

From then on right images are turned back. Frames before are left out, as their depths would stay in
the estimate; where some were used, the rotation is reported and images stay as they are.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Literal, NamedTuple, TypeAlias

import cv2
import numpy as np

from vio.calibration.pair_rotation import (
    PairRotation,
    rotation_by_motion,
    rotation_by_rows,
    turned_pixels,
)
from vio.dataclass import dataclass
from vio.findings import Finding
from vio.frontend.descriptors import Keypoints, OpenCvExtractor
from vio.geometry.lie import FloatArray
from vio.geometry.stereo import StereoCamera
from vio.guard.image_change import image_change
from vio.guard.image_check import FrameImages, ImageCheck
from vio.guard.match_check import SharedMatches, shared_matches
from vio.guard.probe import RowProbe
from vio.records import Image, IntArray, Observations


class _TurnedRules(NamedTuple):
    """When a right camera is turned from the start."""

    tries: int = 3  # pairs that may have too few corners to tell
    min_corners: int = 30
    few_share: float = 0.5  # of the corners that match on their rows; good pairs have 0.56 and more
    negative_share: float = 0.25  # likewise with a negative disparity; good pairs have 0.15 at most
    keypoints: int = 1500
    ratio: float = 0.75  # of the distances of nearest and second descriptor, Lowe (2004)
    # of SIFT's matches that agree with a rotation; true pairs have 0.85 and more
    min_share: float = 0.75
    # Of a rotation. Calibrations of real recordings have at most 0.06 about x and z, and 0.2 about y:
    # four of the standard deviations that the filter takes for it (`msckf.stereo_yaw_sigma_deg`).
    min_deg: float = 0.2
    # of one about y by rows alone: a right lens whose tangential distortion is off looks like 0.6
    # degrees in all rows of KITTI
    min_row_yaw_deg: float = 0.9
    max_yaw_sigma_deg: float = 0.2  # of a yaw by motion that raises suspicion
    min_flow_px: float = 2.0  # of features in the mean, between frames that tell it …
    max_still: int = 40  # … and frames with less of it after which none is waited for
    pairs: int = 6  # that tell the rotation
    alike_deg: float = 0.1  # rotations of pairs differ by less …
    alike_sigmas: float = 4.0  # … and so many standard deviations
    max_delay: int = 3  # frames by which right images may be late in place of turned …
    clear_factor: float = 1.1  # … if so many times as many points agree
    # mean change since the last pair, gray levels at the common contrast, of one that has moved …
    min_change: float = 2.0
    stride_px: int = 4
    max_wait: int = 20  # … and frames after which those that have not are taken
    yaw_sigma_deg: float = 0.05  # of a yaw beside what the fit says: lenses of real cameras


_TURNED = _TurnedRules()
_CODE = "right-camera-turned"
# corners of a pair, features of frames that were used, key points of pairs
Evidence: TypeAlias = Literal["corners", "features", "pairs"]
_AXES = "xyz"


@dataclass(frozen=True, slots=True)
class _Pair:
    """A pair by its key points."""

    left: Keypoints
    right: Keypoints
    sparse: Image  # the left image at few pixels


def turned_back(image: Image, camera: StereoCamera, rotation: FloatArray) -> Image:
    """Return what a right camera as calibrated would show of an image (H, W) of one that is turned
    by `rotation` (3,) rad.
    """
    H = turned_pixels(camera, rotation)
    size = (image.shape[1], image.shape[0])
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    return np.asarray(
        cv2.warpPerspective(image, H, size, flags=flags, borderMode=cv2.BORDER_REPLICATE),
        dtype=np.uint8,
    )


class TurnedPair(ImageCheck):
    """Finds in the first frames that the right camera is turned, and turns its images back."""

    def __init__(self, camera: StereoCamera, probe: RowProbe) -> None:
        super().__init__()
        self._camera = camera
        self._probe = probe
        # what is looked at to learn whether the camera is turned
        self._looks_at: Evidence | None = None if camera.is_cylinder else "corners"
        self._waited = 0  # frames that told nothing, of this evidence
        self._seen: Observations | None = None  # features of the frame before
        self._used_frames = False  # before the camera was suspected
        self._pairs: list[_Pair] = []
        self._rows: list[PairRotation] = []  # of the pairs
        self.rotation: FloatArray | None = None  # (3,) rad, that is taken back; None: none is

    def inspect(self, images: FrameImages) -> FrameImages:
        """Return the images with the right one turned back; while it is not decided whether it
        has to be, the frame is left out.
        """
        begins = False
        if self._looks_at is not None and images.left_usable and images.right_usable:
            if self._looks_at == "corners":
                self._ask_corners(images)
            if self._looks_at == "pairs":
                self._add_pair(images)
                if self._looks_at == "pairs" and not self._used_frames:
                    return images.marked(skipped=True)
                begins = self.rotation is not None
        if self.rotation is None:
            return images
        left, right = images.raw
        back = images.with_raw((left, turned_back(right, self._camera, self.rotation)))
        return back.marked(begin_again=True) if begins else back

    def see(self, seen: Observations) -> None:
        """Take the features of a frame that was used: the first ones between which the rig has
        moved tell whether the camera is suspected.
        """
        if self._looks_at != "features":
            return
        shared = shared_matches(self._seen, seen)
        self._seen = seen
        flow_px = np.linalg.norm(shared.now[:, :2] - shared.before[:, :2], axis=1)
        if len(shared) and flow_px.mean() >= _TURNED.min_flow_px:
            self._look_at("pairs" if self._is_yawed(shared) else None)
            self._used_frames = True
        else:
            self._wait(_TURNED.max_still, None)

    def _look_at(self, evidence: Evidence | None) -> None:
        self._looks_at = evidence
        self._waited = 0
        self._seen = None
        self._pairs = []
        self._rows = []

    def _wait(self, frames: int, then: Evidence | None) -> None:
        """Wait for a frame that tells more, for at most a number of frames."""
        self._waited += 1
        if self._waited >= frames:
            self._look_at(then)

    def _ask_corners(self, images: FrameImages) -> None:
        """Suspect the camera where few corners of a pair match on their rows, or many with a negative
        disparity.
        """
        left, right = images.halves
        corners = self._probe.corners(left)
        if len(corners) < _TURNED.min_corners:
            self._wait(_TURNED.tries, "features")
            return
        few = self._probe.on_rows(left, right, corners) < _TURNED.few_share * len(corners)
        many = _TURNED.negative_share * len(corners)
        suspected = few or self._probe.negative(left, right, corners) > many
        self._look_at("pairs" if suspected else "features")

    def _is_yawed(self, shared: SharedMatches) -> bool:
        rows = rotation_by_rows(self._camera, shared.before)
        if rows is None:
            return False
        found = rotation_by_motion(self._camera, shared.before, shared.now, rows.rotation)
        if found is None or found.sigmas[1] > np.radians(_TURNED.max_yaw_sigma_deg):
            return False
        return bool(abs(found.rotation[1]) > np.radians(_TURNED.min_deg))

    def _add_pair(self, images: FrameImages) -> None:
        """Add a pair that has moved since the last one, and decide once there are enough."""
        sparse = images.halves[0][:: _TURNED.stride_px, :: _TURNED.stride_px].copy()
        if (
            self._pairs
            and self._waited < _TURNED.max_wait
            and not _has_moved(sparse, self._pairs[-1].sparse)
        ):
            self._waited += 1
            return
        left, right = OpenCvExtractor("sift", _TURNED.keypoints)(*images.raw)
        pair = _Pair(left, right, sparse)
        found = self._by_rows(pair.left, pair.right)
        if found is None or not (self._used_frames or _is_turned_by_rows(found)):
            self._look_at(None if self._used_frames else "features")
            return
        self._pairs.append(pair)
        self._rows.append(found)
        if not _is_constant(self._rows) or self._fits_another_time():
            self._look_at(None)
        elif len(self._pairs) == _TURNED.pairs:
            rotation = self._rotation()
            if _is_turned(rotation):
                self._report(images.index, rotation)
            self._look_at(None)

    def _by_rows(self, left: Keypoints, right: Keypoints) -> PairRotation | None:
        rows, others = _matched(left, right)
        found = rotation_by_rows(self._camera, np.hstack([left.pixels[rows], right.pixels[others]]))
        return found if found is not None and found.share >= _TURNED.min_share else None

    def _rotation(self) -> PairRotation:
        """Return the rotation of all pairs."""
        moved = [
            found
            for before, now, rows in zip(self._pairs, self._pairs[1:], self._rows, strict=False)
            if (found := self._by_motion(before, now, rows.rotation)) is not None
        ]
        if not moved:
            return self._rotation_by_rows()
        floor = np.diag([0.0, np.radians(_TURNED.yaw_sigma_deg) ** 2, 0.0])
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
        """Return the rotation by the rows of all pairs; no yaw where a lens may be what they show."""
        mean = np.mean([found.rotation for found in self._rows], axis=0)
        if abs(mean[1]) < np.radians(_TURNED.min_row_yaw_deg):
            mean[1] = 0.0
        return replace(self._rows[-1], rotation=mean)

    def _by_motion(self, before: _Pair, now: _Pair, start: FloatArray) -> PairRotation | None:
        """Return the rotation by the points that two pairs show."""
        rows, others = _matched(before.left, now.left)
        first = _right_pixels(before)[rows]
        second = _right_pixels(now)[others]
        both = np.isfinite(first[:, 0]) & np.isfinite(second[:, 0])
        return rotation_by_motion(
            self._camera,
            np.hstack([before.left.pixels[rows], first])[both],
            np.hstack([now.left.pixels[others], second])[both],
            start,
        )

    def _fits_another_time(self) -> bool:
        """Whether clearly more points of the newest pair agree with the other image of a pair before,
        along the rows as calibrated.
        """
        now = self._pairs[-1]
        least = _TURNED.clear_factor * self._rows[-1].points
        for before in self._pairs[-1 - _TURNED.max_delay : -1]:
            for left, right in ((before.left, now.right), (now.left, before.right)):
                found = self._by_rows(left, right)
                if found is not None and found.points > least and not _is_turned_by_rows(found):
                    return True
        return False

    def _report(self, index: int, found: PairRotation) -> None:
        if not self._used_frames:
            self.rotation = found.rotation
        angles = np.degrees(found.rotation)
        said = ", ".join(
            f"{angle:+.2f} ± {sigma:.2f} about {axis}"
            for angle, sigma, axis in zip(angles, np.degrees(found.sigmas), _AXES, strict=True)
        )
        done = (
            "the run corrects a part of it" if self._used_frames else "its images are turned back"
        )
        message = (
            f"frame {index}: the right camera is turned against its calibration, degrees: {said}; "
            f"{done}; calibrate anew (vio calibrate)"
        )
        figures = {f"turned_{axis}_deg": float(a) for axis, a in zip(_AXES, angles, strict=True)}
        self._found.append(
            Finding(_CODE, message, index, 0, lasts=self._used_frames, figures=figures)
        )


def _has_moved(sparse: Image, before: Image) -> bool:
    return image_change(sparse, before) >= _TURNED.min_change


def _right_pixels(pair: _Pair) -> FloatArray:
    """Return where the right image shows the key points (N, 2) of the left one; not a number where
    none matches.
    """
    rows, others = _matched(pair.left, pair.right)
    out = np.full((len(pair.left), 2), np.nan)
    out[rows] = pair.right.pixels[others]
    return out


def _is_turned(found: PairRotation) -> bool:
    """Whether a rotation is more than that of a usual calibration."""
    return bool(np.abs(found.rotation).max() >= np.radians(_TURNED.min_deg))


def _is_turned_by_rows(found: PairRotation) -> bool:
    """Likewise of a rotation by rows, which tell yaw badly."""
    x, y, z = np.abs(np.degrees(found.rotation)).tolist()
    return bool(max(x, z) >= _TURNED.min_deg or y >= _TURNED.min_row_yaw_deg)


def _is_constant(found: list[PairRotation]) -> bool:
    """Whether rotations by the rows of some pairs are the same about x and z."""
    angles = np.degrees([each.rotation for each in found])[:, [0, 2]]
    sigmas = np.degrees([each.sigmas for each in found])[:, [0, 2]]
    allowed = _TURNED.alike_deg + _TURNED.alike_sigmas * sigmas.max(axis=0)
    return bool((np.ptp(angles, axis=0) < allowed).all())


def _matched(a: Keypoints, b: Keypoints) -> tuple[IntArray, IntArray]:
    """Return rows (M,) and (M,) of key points whose descriptors are clearly next to each other."""
    if min(len(a), len(b)) < 2:
        return np.zeros(0, dtype=np.int64), np.zeros(0, dtype=np.int64)
    near = cv2.BFMatcher(cv2.NORM_L2).knnMatch(a.descriptors, b.descriptors, k=2)
    best = [first for first, second in near if first.distance < _TURNED.ratio * second.distance]
    return (
        np.array([m.queryIdx for m in best], dtype=np.int64),
        np.array([m.trainIdx for m in best], dtype=np.int64),
    )
