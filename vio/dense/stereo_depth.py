"""Depth of every pixel of a rectified pair by semi-global matching, and its errors against a
known depth.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from vio.geometry.stereo import StereoCamera
from vio.records import Image

DepthImage = npt.NDArray[np.float32]  # (H, W) metres along the optical axis, 0 where unknown

# of a match, as rendered images show it: StereoSGBM pulls disparities to whole pixels, by up to
# 0.24 px at quarters (F125), which neighbours have in common
DISPARITY_SIGMA_PX = 0.25


@dataclass(frozen=True, slots=True)
class _DepthRules:
    """How depths are matched and filtered."""

    width_share: int = 8  # the largest disparity is the image's width over this
    block_px: int = 5
    uniqueness_percent: int = 10  # by which the best match must beat the others
    speckle_px: int = 200  # smaller regions of one disparity are dropped
    speckle_range: int = 2
    slant_box_px: int = 9  # over which the surface's direction is measured
    slant_step_px: int = 12
    min_slant: float = 0.05  # a road 1.6 m below the camera, 30 m ahead


_DEPTH = _DepthRules()


class StereoMatcher:
    """Semi-global matching (Hirschmueller, 2008) by OpenCV, with one set of parameters for all
    cameras.
    """

    def __init__(self, camera: StereoCamera, width: int) -> None:
        """Prepare for images of a width in pixels."""
        import cv2

        self._camera = camera
        self._count = 16 * max(1, round(width / _DEPTH.width_share / 16))
        self._sgm = cv2.StereoSGBM.create(
            minDisparity=0,
            numDisparities=self._count,
            blockSize=_DEPTH.block_px,
            P1=8 * _DEPTH.block_px**2,
            P2=32 * _DEPTH.block_px**2,
            disp12MaxDiff=1,
            preFilterCap=31,
            uniquenessRatio=_DEPTH.uniqueness_percent,
            speckleWindowSize=_DEPTH.speckle_px,
            speckleRange=_DEPTH.speckle_range,
            mode=cv2.STEREO_SGBM_MODE_SGBM_3WAY,
        )

    def depth(self, left: Image, right: Image) -> DepthImage:
        """Return the depth (H, W) of the left image's pixels (H, W), of gray images."""
        import cv2

        # Columns left of the first disparity would stay unknown: the pair is continued there.
        pad = [np.pad(image, ((0, 0), (self._count, 0)), mode="edge") for image in (left, right)]
        matched = self._sgm.compute(*pad)[:, self._count :].astype(np.float32)
        disparity = matched / np.float32(cv2.StereoMatcher_DISP_SCALE)
        # A match that lies left of the right image is one with the padding.
        inside = (disparity > 0.5) & (disparity <= np.arange(left.shape[1], dtype=np.float32))
        scale = np.float32(self._camera.fu * self._camera.baseline_m)
        return np.where(inside, scale / np.maximum(disparity, np.float32(0.5)), np.float32(0.0))


def slant(depth: DepthImage, camera: StereoCamera) -> DepthImage:
    """Return by what (H, W) a difference of depths is multiplied to be a distance from the surface
    at that pixel.

    The inverse depth of a plane `n p = 1` is `n ray`: its differences in the image are the first
    two of n, and `(1 - n p) / |n|` is the distance of a point p. Of the differences to both sides,
    the smaller one is that of the surface, and not across its outline; it is 1 where neither is
    known.
    """
    import cv2

    known = (depth > 0).astype(np.float32)
    size = (_DEPTH.slant_box_px, _DEPTH.slant_box_px)
    share = cv2.blur(known, size)
    inverse = cv2.blur(known / np.maximum(depth, np.float32(1e-3)), size) / np.maximum(
        share, np.float32(1e-6)
    )
    height, width = depth.shape
    rays = [
        (np.arange(n, dtype=np.float32) - c) / f
        for n, c, f in ((width, camera.cu, camera.fu), (height, camera.cv, camera.fv))
    ]
    slopes = []
    for axis, focal in ((1, camera.fu), (0, camera.fv)):
        step = np.full_like(inverse, np.inf)
        inner = [slice(None)] * 2
        ahead = [slice(None)] * 2
        inner[axis] = slice(0, -_DEPTH.slant_step_px)
        ahead[axis] = slice(_DEPTH.slant_step_px, None)
        here = tuple(inner)
        there = tuple(ahead)
        both = (known[here] > 0) & (known[there] > 0)
        change = inverse[there] - inverse[here]
        difference = np.where(both, change, np.inf).astype(np.float32)
        step[here] = difference
        closer = np.abs(difference) < np.abs(step[there])
        step[there][closer] = difference[closer]
        slopes.append(
            np.where(np.isfinite(step), step * np.float32(focal / _DEPTH.slant_step_px), 0).astype(
                np.float32
            )
        )
    x = rays[0][None, :]
    y = rays[1][:, None]
    third = inverse - slopes[0] * x - slopes[1] * y
    length = np.sqrt(slopes[0] ** 2 + slopes[1] ** 2 + third**2)
    return np.clip(
        inverse / np.maximum(length, np.float32(1e-9)),
        np.float32(_DEPTH.min_slant),
        np.float32(1.5),
    )


def depth_sigma_m(camera: StereoCamera, depth_m: float) -> float:
    """Return the standard deviation of a depth."""
    return depth_m**2 * DISPARITY_SIGMA_PX / (camera.fu * camera.baseline_m)


def farthest_m(camera: StereoCamera, sigma_m: float) -> float:
    """Return the depth whose standard deviation is `sigma_m`."""
    return float(np.sqrt(sigma_m * camera.fu * camera.baseline_m / DISPARITY_SIGMA_PX))
