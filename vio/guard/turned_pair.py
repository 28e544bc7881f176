"""A right camera that is turned against its calibration, by some tenths of a degree and more.

Its rows differ by more than features are searched, or by so much that terms of small angles do not
hold; turned about y, far points have disparities that are negative. It is suspected where few
corners of the first pair match along their rows, or many with a negative disparity, or where
features of the first two pairs that moved have another yaw. Then SIFT key points of the next pairs tell the
rotation, if they have one (`vio.guard.turned_points`).

From then on right images are turned back. Frames before are left out, as their depths would stay in
the estimate; where some were used, the rotation is reported and images stay as they are.

So it goes for a camera that turns during a run, of whose right images none is used as they contradict
the left ones: those that are turned back are used once they agree with the depths from before.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING, Literal, NamedTuple, TypeAlias

import cv2
import numpy as np

from vio.calibration.pair_rotation import (
    MIN_TURN_DEG,
    PairRotation,
    rotation_by_motion,
    rotation_by_rows,
    turned_pixels,
)
from vio.findings import Finding
from vio.geometry.lie import FloatArray
from vio.geometry.stereo import StereoCamera
from vio.guard.image_change import has_moved
from vio.guard.image_check import FrameImages, ImageCheck
from vio.guard.match_check import SharedMatches, shared_matches
from vio.guard.probe import RowProbe
from vio.records import Image, Observations

if TYPE_CHECKING:
    from vio.guard.turned_points import TurnedPoints


class _TurnedRules(NamedTuple):
    """When a right camera is suspected to be turned."""

    tries: int = 3  # pairs that may have too few corners to tell
    min_corners: int = 30
    few_share: float = 0.5  # of the corners that match on their rows; good pairs have 0.56 and more
    negative_share: float = 0.25  # likewise with a negative disparity; good pairs have 0.15 at most
    max_yaw_sigma_deg: float = 0.2  # of a yaw by the motion of features
    min_flow_px: float = 2.0  # of features in the mean, between frames that tell it …
    max_still: int = 40  # … and frames with less of it after which none is waited for
    max_contradicting: int = 20  # frames after which images are turned back to no avail
    max_wait: int = 20  # frames that have not moved, in all, after which each is taken


_TURNED = _TurnedRules()
_CODE = "right-camera-turned"
_CONTRADICTS = "right-contradicts-left"
# corners of a pair, features of frames that were used, key points of pairs
Evidence: TypeAlias = Literal["corners", "features", "pairs"]
_AXES = "xyz"


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
        self._onset = 0  # first frame of a camera that has turned during the run; 0: none has
        self._contradicting = 0  # frames since images were turned back that still contradict
        self._points: TurnedPoints | None = None  # of the pairs so far
        self._last: Image | None = None  # the left image of the last of them, at half resolution
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
                begins = self.rotation is not None and not self._onset
        self._give_up()
        if self.rotation is None:
            return images
        left, right = images.raw
        back = images.with_raw((left, turned_back(right, self._camera, self.rotation)))
        return back.marked(begin_again=True) if begins else back

    def _give_up(self) -> None:
        """Use images as given that contradict the left ones for long though they are turned back:
        the right camera has not turned.
        """
        if not self._onset or self.rotation is None:
            return
        self._contradicting += 1
        if self._contradicting > _TURNED.max_contradicting:
            self.rotation = None
            self._onset = 0

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

    def take(self, findings: Iterable[Finding]) -> None:
        """Take what was found in a frame: where right images contradict left ones, the right
        camera may have turned, and where they agree again, that is over.
        """
        for finding in findings:
            if finding.code != _CONTRADICTS:
                continue
            if finding.ended:
                if self._onset and self._looks_at == "pairs":
                    self._look_at(None)
                self._onset = 0
            elif self._looks_at != "pairs":
                self.rotation = None
                self._onset = finding.first_frame or 0
                self._used_frames = True
                self._contradicting = 0
                self._look_at("pairs")

    def _look_at(self, evidence: Evidence | None) -> None:
        self._looks_at = evidence
        self._waited = 0
        self._seen = None
        self._points = None
        self._last = None

    def _wait(self, frames: int, then: Evidence | None) -> None:
        """Wait for a frame that tells more, for at most a number of frames."""
        self._waited += 1
        if self._waited >= frames:
            self._look_at(then)

    def _ask_corners(self, images: FrameImages) -> None:
        """Suspect the camera where few corners of a pair match on their rows, or many with a
        negative disparity.
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
        return bool(abs(found.rotation[1]) > np.radians(MIN_TURN_DEG))

    def _add_pair(self, images: FrameImages) -> None:
        """Add a pair that has moved since the last one, and decide once there are enough."""
        from vio.guard.turned_points import TurnedPoints  # they load descriptors

        left = images.halves[0]
        if (
            self._last is not None
            and self._waited < _TURNED.max_wait
            and not has_moved(left, self._last)
        ):
            self._waited += 1
            return
        self._last = left.copy()
        if self._points is None:
            self._points = TurnedPoints(self._camera, rows_may_agree=self._used_frames)
        if not self._points.add(images.raw):
            self._look_at(None if self._used_frames else "features")
        elif self._points.complete:
            rotation = self._points.rotation()
            if rotation is not None:
                self._report(images.index, rotation)
            self._look_at(None)

    def _report(self, index: int, found: PairRotation) -> None:
        applied = self._onset > 0 or not self._used_frames
        if applied:
            self.rotation = found.rotation
        angles = np.degrees(found.rotation)
        said = ", ".join(
            f"{angle:+.2f} ± {sigma:.2f} about {axis}"
            for angle, sigma, axis in zip(angles, np.degrees(found.sigmas), _AXES, strict=True)
        )
        done = "its images are turned back" if applied else "the run corrects a part of it"
        message = (
            f"frame {index}: the right camera is turned against its calibration, degrees: {said}; "
            f"{done}; calibrate anew (vio calibrate)"
        )
        figures = {f"turned_{axis}_deg": float(a) for axis, a in zip(_AXES, angles, strict=True)}
        self._found.append(
            Finding(_CODE, message, index, self._onset, lasts=not applied, figures=figures)
        )
