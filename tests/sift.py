"""SIFT points matched between the images of a pair, by a method that does not assume equal rows."""

from __future__ import annotations

import cv2
import numpy as np

from vio.geometry.lie import FloatArray
from vio.records import Image

_RATIO = 0.75  # of the best to the second best descriptor distance
_RANSAC_PX = 1.0


def match_sift(left: Image, right: Image) -> tuple[FloatArray, FloatArray]:
    """Matched pixels (N, 2), (N, 2): mutual nearest SIFT descriptors, inliers of one common
    fundamental matrix.

    The matrix is estimated from these matches alone, without the assumption that rows agree.
    Reference: Lowe, Distinctive image features from scale-invariant keypoints (2004).
    """
    sift = cv2.SIFT.create(nfeatures=1500)
    (points0, words0), (points1, words1) = (
        sift.detectAndCompute(image, None) for image in (left, right)
    )
    if words0 is None or words1 is None or len(words1) < 2:
        return np.zeros((0, 2)), np.zeros((0, 2))
    matcher = cv2.BFMatcher(cv2.NORM_L2)
    back = {m.queryIdx: m.trainIdx for m in matcher.match(words1, words0)}
    good = [
        first
        for first, second in matcher.knnMatch(words0, words1, k=2)
        if first.distance < _RATIO * second.distance and back[first.trainIdx] == first.queryIdx
    ]
    pl = np.array([points0[m.queryIdx].pt for m in good]).reshape(-1, 2)
    pr = np.array([points1[m.trainIdx].pt for m in good]).reshape(-1, 2)
    if len(pl) < 15:
        return np.zeros((0, 2)), np.zeros((0, 2))
    _, mask = cv2.findFundamentalMat(pl, pr, cv2.FM_RANSAC, _RANSAC_PX, 0.999)
    inlier = (
        np.zeros(len(pl), dtype=np.bool_) if mask is None else mask.reshape(-1).astype(np.bool_)
    )
    return pl[inlier], pr[inlier]
