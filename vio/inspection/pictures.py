"""Brightness, sharpness, depths and stereo rows of some frames, spread over a recording."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from vio.calibration.findings import NotObservable
from vio.calibration.readings import other_reading
from vio.calibration.severity import StereoError
from vio.calibration.stereo import RowResiduals, row_residuals
from vio.geometry.distortion import StereoRig
from vio.geometry.lie import FloatArray
from vio.geometry.stereo import StereoCamera
from vio.inspection.finding import Part
from vio.records import Image, StereoFrame

if TYPE_CHECKING:
    import cv2


@dataclass(frozen=True, slots=True)
class _PictureRules:
    """What images and depths are named for."""

    # of the best to the second best descriptor distance. Reference: Lowe, Distinctive image
    # features (2004)
    ratio: float = 0.8
    features: int = 1500  # per image
    ransac_px: float = 1.5
    min_matches: int = 20  # a pair with fewer says nothing about the calibration
    dark: float = 12.0  # mean and standard deviation of gray levels of an image without content
    bright: float = 243.0
    flat: float = 3.0
    rows_fault_px: float = 2.0  # where matching along rows fails
    # medians outside are another unit: structured light ends at 5 m, lidars at 20
    nearest_m: float = 0.1
    farthest_m: float = 30.0
    min_positive: float = 0.5  # share of matches with ul > ur; true pairs have nearly all


_PICTURES = _PictureRules()


@dataclass(frozen=True, slots=True)
class GrayLevels:
    """Gray levels of one image."""

    mean: float
    spread: float
    clipped: float  # share of pixels at 0 or 255
    # gradient of the image over that of the image blurred by 2 px; about 1 for a blurred one
    sharpness: float


def gray_levels_of(image: Image) -> GrayLevels:
    """Measure an image (H, W)."""
    import cv2

    values = image.astype(np.float32)
    blurred = cv2.GaussianBlur(values, (0, 0), 2.0)
    fine, coarse = (float(np.abs(np.diff(v, axis=1)).mean()) for v in (values, blurred))
    clipped = float(np.mean((image == 0) | (image == 255)))
    return GrayLevels(float(values.mean()), float(values.std()), clipped, fine / max(coarse, 1e-6))


def images_part(frames: Sequence[StereoFrame]) -> Part:
    """Describe the images of some frames."""
    shown = _shown(frames)
    if not shown:
        return Part(
            "images", "none could be read", {}, ["no image could be read; see the warnings above"]
        )
    cameras = len(shown[0])
    found = [list(map(gray_levels_of, side)) for side in zip(*shown, strict=True)]
    means = [float(np.mean([e.mean for e in side])) for side in found]
    clipped = max(e.clipped for side in found for e in side)
    sharpness = float(np.median([e.sharpness for side in found for e in side]))
    height, width = shown[0][0].shape
    facts = {
        "width": width,
        "height": height,
        "mean": means,
        "clipped": clipped,
        "sharpness": sharpness,
    }
    if cameras == 2:
        gray = f"{means[0]:.0f} left and {means[1]:.0f} right"
    else:
        gray = f"{means[0]:.0f}"
    text = (
        f"{width} x {height}, mean gray {gray}, at most {100 * clipped:.1f} % at 0 or 255, "
        f"sharpness {sharpness:.1f} (1: blurred by 2 px or more)"
    )
    return Part("images", text, facts, _image_faults(shown, found))


def _shown(frames: Sequence[StereoFrame]) -> list[tuple[Image, ...]]:
    """Return the images of the frames that show as many cameras as any."""
    shown = [
        tuple(image for image in (f.left, f.right) if image is not None)
        for f in frames
        if f.left is not None
    ]
    cameras = max((len(images) for images in shown), default=0)
    return [images for images in shown if len(images) == cameras]


def _image_faults(
    shown: Sequence[tuple[Image, ...]], found: Sequence[Sequence[GrayLevels]]
) -> list[str]:
    """Say what is wrong with images, whose gray levels were measured by camera."""
    cameras = len(found)
    faults = []
    flat = [
        e
        for side in found
        for e in side
        if e.spread < _PICTURES.flat or not _PICTURES.dark < e.mean < _PICTURES.bright
    ]
    if 2 * len(flat) > cameras * len(shown):
        faults.append(
            f"{len(flat)} of {cameras * len(shown)} images are black, white or without content; "
            "correct the exposure"
        )
    if cameras == 2 and all(np.array_equal(images[0], images[1]) for images in shown):
        faults.append(
            "left and right are the same images, so there is no depth; give the other camera's "
            "images"
        )
    return faults


def depths_part(frames: Sequence[StereoFrame]) -> Part:
    """Describe the depth images of some frames."""
    depths = [f.depth for f in frames if f.depth is not None]
    known = [depth[np.isfinite(depth) & (depth > 0)] for depth in depths]
    share = (
        float(np.mean([len(z) / depth.size for z, depth in zip(known, depths, strict=True)]))
        if depths
        else 0.0
    )
    z = np.concatenate([np.zeros(0), *known])
    if not len(z):
        fault = (
            "no depth image holds a depth; check that they have 16 bits, and what their levels mean"
        )
        return Part("depth", "no depth is known", {"known": 0.0}, [fault])
    near, middle, far = (float(q) for q in np.quantile(z, [0.05, 0.5, 0.95]))
    faults = []
    if not _PICTURES.nearest_m < middle < _PICTURES.farthest_m:
        faults.append(
            f"the median depth is {middle:.3g} m, which is not that of a depth camera; check "
            "depth_factor (levels per "
            "metre: 1000 for millimetres, 5000 for TUM RGB-D)"
        )
    text = f"{100 * share:.0f} % of the pixels have one, {near:.2f} to {far:.2f} m (90 %), median {middle:.2f} m"
    return Part(
        "depth", text, {"known": share, "near_m": near, "median_m": middle, "far_m": far}, faults
    )


def rows_part(
    frames: Sequence[StereoFrame],
    pair: tuple[StereoRig, StereoCamera] | None,
    progress: Callable[[int, int], None],
) -> tuple[Part, StereoError | None]:
    """Describe how the rows of left and right images agree, by SIFT matches that assume nothing
    of the calibration, and what they say of it; None: nothing.

    Args:
        frames: of a recording.
        pair: as read, and the camera that it is rectified to; None: the images were rectified already.
        progress: called with how many steps are done and how many there are.
    """
    matches = []
    for done, f in enumerate(frames):
        if f.left is not None and f.right is not None:
            matches.append(sift_pairs(f.left, f.right))
        progress(done + 1, len(frames))
    counts = list(map(len, matches))
    z = np.concatenate([np.zeros((0, 4)), *(m for m in matches if len(m) >= _PICTURES.min_matches)])
    found = row_residuals(z, *_size_of_images(frames))
    if isinstance(found, NotObservable):
        return _unmatched_part(found, counts), None
    off = StereoError(found.rms_px, found.disparity_px)
    faults = _rows_faults(found, alike=pair is not None and _have_one_lens(pair[0]))
    if faults and (turn_deg := _turn_between(frames)):
        faults = [
            f"the right images are turned by about {turn_deg} degrees against the left ones: turn "
            "them back, or calibrate the pair with images as these"
        ]
    if pair is None:
        reading = None
    else:
        reading = other_reading(*pair, z)
    if reading is not None:
        faults = [str(reading)]
    return Part("stereo", _rows_text(found, counts), _rows_facts(found), faults), off


def calibration_part(off: StereoError) -> Part:
    """Describe how much a calibration is off by the rows, and where the rest shows."""
    more = ""
    if off.disparity_px is None and off.grade == "worth calibrating":
        more = "; what disparities are off by, motion shows (vio run)"
    return Part("calibration", f"{off}{more}", {"grade": off.grade, "rows_rms_px": off.rows_px})


def _size_of_images(frames: Sequence[StereoFrame]) -> tuple[float, float]:
    """Return width and height of the first left image in px; 1, 1: there is none."""
    image = next((f.left for f in frames if f.left is not None), None)
    if image is None:
        return (1.0, 1.0)
    return (float(image.shape[1]), float(image.shape[0]))


def _unmatched_part(why: NotObservable, counts: Sequence[int]) -> Part:
    """Describe images whose rows cannot be compared, with the matches of each pair."""
    most = max(counts, default=0)
    faults = []
    if most < _PICTURES.min_matches:
        faults.append(
            f"only {most} points match between left and right; check that the folders are of one "
            "stereo camera, its lenses clean and in focus"
        )
    return Part("stereo", str(why), {"matches": int(sum(counts))}, faults)


def _rows_text(found: RowResiduals, counts: Sequence[int]) -> str:
    field = found.grid_px[np.isfinite(found.grid_px)]
    over = ""
    if len(field):
        over = f", {field.min():+.2f} to {field.max():+.2f} over the image"
    return (
        f"{np.median(counts):.0f} matches a pair, rows {found.median_px:+.2f} px (median of vl - "
        "vr), spread "
        f"{found.spread_px:.2f}{over}; {100 * found.positive_disparity:.0f} % in front"
    )


def _rows_facts(found: RowResiduals) -> dict[str, object]:
    return {
        "matches": found.matches,
        "rows_median_px": found.median_px,
        "rows_spread_px": found.spread_px,
        "positive_disparity": found.positive_disparity,
        "disparity_median_px": found.disparity_px,
    }


def _have_one_lens(rig: StereoRig) -> bool:
    """Return whether two lenses that distort have one focal length and centre, as no two real ones
    have to all digits.
    """
    numbers = [(c.fu, c.fv, c.cu, c.cv) for c in (rig.cam0, rig.cam1)]
    return numbers[0] == numbers[1] and any(rig.cam0.coefficients)


def _rows_faults(found: RowResiduals, *, alike: bool) -> list[str]:
    """Return what rows are off by.

    Args:
        found: of all matches.
        alike: whether the calibration has one focal length and centre for both lenses.
    """
    if found.positive_disparity < _PICTURES.min_positive:
        return [
            f"{100 * (1 - found.positive_disparity):.0f} % of the matches are behind the cameras: "
            "left and right "
            "images are exchanged; exchange the folders or topics"
        ]
    if abs(found.median_px) + found.spread_px > _PICTURES.rows_fault_px:
        cause = "a camera has been turned"
        if alike:
            cause = (
                "the calibration has one focal length and centre for both lenses, as where those of "
                "one were written for both, a camera has been turned"
            )
        return [
            f"rows differ by {found.median_px:+.1f} px with spread {found.spread_px:.1f} px: {cause} "
            "since the calibration, left and right images are exchanged, the calibration is not "
            "that of these images, "
            "or they are not rectified; run `vio calibrate`, which finds which, and give its file "
            "with --calibration"
        ]
    return []


def _is_distinct(nearest: Sequence[Any]) -> bool:
    """Tell whether the nearest of two descriptors is by far nearer than the other."""
    return len(nearest) == 2 and nearest[0].distance < _PICTURES.ratio * nearest[1].distance


def _turn_between(frames: Sequence[StereoFrame]) -> int:
    """Return by how many quarter turns, in degrees, the points of right images are turned against
    those of the left ones; 0: by none, or it is not known.

    Directions of points turn with the image, whatever the calibration says.
    """
    turns = [
        np.array([b.angle - a.angle for a, b in sift_points(f.left, f.right)])
        for f in frames
        if f.left is not None and f.right is not None
    ]
    all_turns = np.concatenate([np.zeros(0), *turns])
    if len(all_turns) < _PICTURES.min_matches:
        return 0
    quarters = np.round(all_turns / 90).astype(int) % 4
    counts = np.bincount(quarters, minlength=4)
    most = int(counts.argmax())
    if 2 * counts[most] > len(all_turns):
        return 90 * most
    return 0


def sift_points(left: Image, right: Image) -> list[tuple[cv2.KeyPoint, cv2.KeyPoint]]:
    """Return the SIFT points of two images that match, whether or not they fit one motion."""
    import cv2

    sift = cv2.SIFT_create(_PICTURES.features)  # type: ignore[attr-defined] # missing in OpenCV's stubs
    (points0, first), (points1, second) = (
        sift.detectAndCompute(image, None) for image in (left, right)
    )
    if first is None or second is None or min(len(points0), len(points1)) < _PICTURES.min_matches:
        return []
    matcher = cv2.BFMatcher(cv2.NORM_L2)
    return [
        (points0[m[0].queryIdx], points1[m[0].trainIdx])
        for m in matcher.knnMatch(first, second, k=2)
        if _is_distinct(m)
    ]


def sift_pairs(left: Image, right: Image) -> FloatArray:
    """Match SIFT points of two images: `[ul vl ur vr]` (N, 4) that fit one fundamental matrix."""
    import cv2

    near = sift_points(left, right)
    if len(near) < _PICTURES.min_matches:
        return np.zeros((0, 4))
    z = np.array([[*a.pt, *b.pt] for a, b in near], dtype=np.float64)
    _, mask = cv2.findFundamentalMat(z[:, :2], z[:, 2:], cv2.FM_RANSAC, _PICTURES.ransac_px, 0.999)
    return z if mask is None else z[mask.ravel() > 0]
