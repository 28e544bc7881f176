"""Other readings of a rig's calibration, judged by the rows of matches.

A coefficient with the wrong sign, in another order or of another lens model, images that were mirrored
or turned: each bends the rows of left and right in its own way, and the right reading straightens them.
A camera that was moved straightens by none.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from vio.calibration.findings import NotObservable
from vio.calibration.severity import rows_grade
from vio.calibration.stereo import row_residuals
from vio.errors import CalibrationError
from vio.geometry.distortion import CameraModel, DistortionModel, StereoRig, project_point
from vio.geometry.lie import FloatArray, se3_from_parts
from vio.geometry.rectify import rectify_pixels, rectifying_rotations
from vio.geometry.stereo import StereoCamera, left_rays

_Change = Callable[[FloatArray], FloatArray]


class _ReadingRules(NamedTuple):
    """When another reading is the right one."""

    straighter: float = 0.2  # largest share of the row differences that it leaves
    in_front: float = 0.8  # least share of its disparities that are positive
    alike: float = 1.5  # ratio of differences within which two readings fit equally well


_READING = _ReadingRules()


class OtherReading(NamedTuple):
    """A reading that straightens the rows."""

    words: str  # what would have to be so: 'their distortion coefficients had the other sign'
    rms_px: float  # row differences as read (rms, a smooth field)
    other_px: float  # by this reading

    def __str__(self) -> str:
        return (
            f"the rows of left and right images differ by {self.rms_px:.2f} px (rms) as the "
            f"calibration is read, and by {self.other_px:.2f} px if {self.words}; check the "
            "calibration's file and the images for that"
        )


def other_reading(rig: StereoRig, rectified: StereoCamera, z: FloatArray) -> OtherReading | None:
    """Return the reading of a calibration that makes rows agree which do not; None: there is none.

    Args:
        rig: as the calibration was read.
        rectified: the camera that it was rectified to.
        z: matches (N, 4) `[ul vl ur vr]` in rectified pixels.
    """
    now = row_residuals(z, rig.cam0.width, rig.cam0.height)
    if isinstance(now, NotObservable) or rows_grade(now.rms_px) == "negligible":
        return None
    raw = _raw_pixels(rig, rectified, z)
    found = []
    for words, read, change in _readings(rig):
        px = _rows_px(read, rectified, [change(uv) for uv in raw])
        if px is not None:
            found.append((px, words))
    best = min(found, default=(np.inf, ""))[0]
    if best > _READING.straighter * now.rms_px or rows_grade(best) != "negligible":
        return None
    alike = [words for px, words in sorted(found) if px <= _READING.alike * best]
    return OtherReading(", or ".join(alike), now.rms_px, best)


def _raw_pixels(rig: StereoRig, rectified: StereoCamera, z: FloatArray) -> list[FloatArray]:
    """Return the pixels (N, 2) of left and right images before they were rectified."""
    rotations = rectifying_rotations(rig)[:2]
    sides = zip((rig.cam0, rig.cam1), rotations, (z[:, :2], z[:, 2:]), strict=True)
    return [
        np.asarray(project_point(camera, left_rays(rectified, uv) @ R)[0])
        for camera, R, uv in sides
    ]


def _rows_px(rig: StereoRig | None, rectified: StereoCamera, raw: list[FloatArray]) -> float | None:
    """Return the row differences (rms, px) of raw pixels by a rig, or as they are without one; None:
    they are of no pair.
    """
    if rig is None:
        rows = row_residuals(np.hstack(raw), rectified.width or 1, rectified.height or 1)
        # Where the centres of rectified images differ, disparities may have any sign.
        return None if isinstance(rows, NotObservable) else rows.rms_px
    try:
        rotations = rectifying_rotations(rig)[:2]
    except CalibrationError:
        return None
    sides = zip((rig.cam0, rig.cam1), rotations, raw, strict=True)
    (left, seen0), (right, seen1) = (rectify_pixels(c, R, rectified, uv) for c, R, uv in sides)
    z = np.hstack([left, right])[seen0 & seen1]
    if 2 * len(z) < len(raw[0]):
        return None
    rows = row_residuals(z, rig.cam0.width, rig.cam0.height)
    if isinstance(rows, NotObservable) or rows.positive_disparity < _READING.in_front:
        return None
    return rows.rms_px


def _same(uv: FloatArray) -> FloatArray:
    return uv


def _readings(rig: StereoRig) -> Iterator[tuple[str, StereoRig | None, _Change]]:
    """Yield other readings of a rig: in words, the rig (None: there is nothing to rectify), and what
    it does to raw pixels.
    """
    last = np.array([rig.cam0.width - 1, rig.cam0.height - 1], dtype=np.float64)
    yield "the images are rectified already", None, _same
    yield "both images are mirrored", rig, lambda uv: uv * [-1, 1] + [last[0], 0]
    yield "both images are upside down", rig, lambda uv: last - uv
    yield "both images are flipped, top to bottom", rig, lambda uv: uv * [1, -1] + [0, last[1]]
    for lens in _LENSES:
        read = lens.of(rig)
        if read is not None and read != rig:
            yield lens.words, read, _same
    exchanged = replace(rig, cam0=rig.cam1, cam1=rig.cam0)
    yield "the intrinsics of left and right are exchanged", exchanged, _same
    T = rig.T_cam0_cam1
    back = se3_from_parts(T[:3, :3].T, T[:3, 3])
    turned = rig.T_imu_cam0 @ back
    yield (
        "the rotation between the cameras is the inverse one",
        replace(rig, T_imu_cam1=turned),
        _same,
    )


class _Lens(NamedTuple):
    """Another lens model, or other coefficients of the same one."""

    words: str
    model: DistortionModel  # that was read
    other: DistortionModel
    order: tuple[int, ...]  # places of its coefficients among those that were read
    sign: float = 1.0

    def of(self, rig: StereoRig) -> StereoRig | None:
        """Return a rig with this lens; None: its cameras have another one."""
        try:
            return replace(rig, cam0=self._camera(rig.cam0), cam1=self._camera(rig.cam1))
        except CalibrationError:
            return None

    def _camera(self, camera: CameraModel) -> CameraModel:
        k = camera.coefficients
        bends = camera.model == self.model and any(k)
        order = self.order or tuple(range(len(k) if self.other == self.model else 0))
        if not bends or (self.order and len(self.order) != len(k)):
            raise CalibrationError(f"no such lens: {self.words}")
        coefficients = tuple(self.sign * k[place] for place in order)
        return replace(camera, model=self.other, coefficients=coefficients)


_LENSES = (
    _Lens("its distortion coefficients have the other sign", "radtan", "radtan", (), -1.0),
    _Lens("the images are undistorted already", "radtan", "pinhole", ()),
    _Lens("its coefficients are in the order k1 k2 k3 p1 p2", "radtan", "radtan", (0, 1, 3, 4, 2)),
    _Lens("its coefficients are in the order k1 p1 p2 k2", "radtan", "radtan", (0, 3, 1, 2)),
    _Lens("its coefficients are in the order p1 p2 k1 k2", "radtan", "radtan", (2, 3, 0, 1)),
    _Lens("its distortion is equidistant (fisheye)", "radtan", "equidistant", (0, 1, 2, 3)),
    _Lens("its distortion is radial-tangential", "equidistant", "radtan", (0, 1, 2, 3)),
    _Lens("its coefficients have the other sign", "equidistant", "equidistant", (), -1.0),
    _Lens("the images are undistorted already", "equidistant", "pinhole", ()),
)
