"""Whether two estimates of what a stereo calibration is off by agree within their covariances.

Compared is what matters of it: by how much disparities are off, over the image. Rows and columns of
the right image give it, equations (R2) and (R3) of docs/math.md; a distortion that both lenses have
in common moves no disparity of far points.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from vio.cameras.rectification_error import error_basis
from vio.geometry.lie import FloatArray
from vio.geometry.stereo import StereoCamera
from vio.records import FIELD_TERMS, RIGHT_TERMS, ROW_TERMS, StereoFieldEstimate

# places in the image at which fields are compared
_COLUMNS = 6
_ROWS = 3
# between focal lengths or principal points, over the focal length: beyond it the cameras differ
_SAME_CAMERA = 0.01


@dataclass(frozen=True, slots=True)
class DisparityField:
    """By how much the disparities of far points are off, in K coefficients, in focal lengths."""

    intrinsics: FloatArray  # (4,) fu, fv, cu, cv of the rectified camera, px
    image_size: tuple[int, int] | None  # None: not known
    coefficients: FloatArray  # (K,) a0 to a3, then the rows' terms but that of the disparity
    covariance: FloatArray  # (K, K)

    def places(self) -> FloatArray:
        """Places (G, 2) spread evenly over the image, px; it is centred on the principal point where
        its size is not known.
        """
        width, height = self.image_size or 2 * self.intrinsics[2:]
        u = (np.arange(_COLUMNS) + 0.5) * width / _COLUMNS - 0.5
        v = (np.arange(_ROWS) + 0.5) * height / _ROWS - 0.5
        columns, rows = np.meshgrid(u, v)
        return np.column_stack([columns.ravel(), rows.ravel()])

    def as_dict(self) -> dict[str, Any]:
        """Return the field for JSON."""
        return {
            "intrinsics": self.intrinsics.tolist(),
            "image_size": None if self.image_size is None else list(self.image_size),
            "coefficients": self.coefficients.tolist(),
            "covariance": self.covariance.tolist(),
        }

    @staticmethod
    def of(values: Mapping[str, Any]) -> DisparityField:
        """Return the field that `as_dict` wrote."""
        size = values["image_size"]
        return DisparityField(
            np.array(values["intrinsics"], dtype=np.float64),
            None if size is None else (int(size[0]), int(size[1])),
            np.array(values["coefficients"], dtype=np.float64),
            np.array(values["covariance"], dtype=np.float64),
        )


@dataclass(frozen=True, slots=True)
class FieldDifference:
    """How two fields differ over the image."""

    rms_px: float  # root mean square of the difference
    sigma_px: float  # of its stated standard deviation
    # mean over the image of the squared difference over its variance: 1 in the mean for independent
    # estimates that are consistent
    nees: float


def disparity_field(camera: StereoCamera, field: StereoFieldEstimate) -> DisparityField | None:
    """Return what an estimate says of the disparities of far points; None: the camera is no pinhole
    pair.
    """
    if camera.kind != "stereo" or camera.is_cylinder:
        return None
    size = RIGHT_TERMS + ROW_TERMS - 1
    coefficients = np.zeros(size)
    covariance = np.zeros((size, size))
    coefficients[:RIGHT_TERMS] = field.coefficients[:RIGHT_TERMS]
    covariance[:RIGHT_TERMS, :RIGHT_TERMS] = field.covariance[:RIGHT_TERMS, :RIGHT_TERMS]
    if field.rows is not None:
        coefficients[RIGHT_TERMS:] = field.rows[:-1]
    if field.rows_covariance is not None:
        covariance[RIGHT_TERMS:, RIGHT_TERMS:] = field.rows_covariance[:-1, :-1]
    size_px = None
    if camera.width is not None and camera.height is not None:
        size_px = (camera.width, camera.height)
    return DisparityField(
        np.array([camera.fu, camera.fv, camera.cu, camera.cv]),
        size_px,
        coefficients,
        covariance,
    )


def disparity_error(field: DisparityField, places: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the measured disparity of far points less the true one (G,) at places (G, 2), and its
    derivatives (G, K) by the coefficients, px.
    """
    fu, fv, cu, cv = field.intrinsics.tolist()
    camera = StereoCamera(fu, fv, cu, cv, baseline_m=1.0)
    basis = error_basis(camera, np.column_stack([places, places]))
    chosen = [*range(RIGHT_TERMS), *range(FIELD_TERMS, FIELD_TERMS + ROW_TERMS - 1)]
    jacobian = (basis[:, 0] - basis[:, 2])[:, chosen]
    return jacobian @ field.coefficients, jacobian


def field_difference(a: DisparityField, b: DisparityField) -> FieldDifference | None:
    """Compare two fields of cameras with the same image, whose errors are independent.

    None: the cameras differ, or a field is stated without an error.
    """
    apart = np.abs(a.intrinsics - b.intrinsics) / a.intrinsics[0]
    if (apart > _SAME_CAMERA).any():
        return None
    places = (a if a.image_size is not None else b).places()
    of_a, jacobian = disparity_error(a, places)
    of_b, _ = disparity_error(b, places)
    total = a.covariance + b.covariance
    variance = np.einsum("gk,kl,gl->g", jacobian, total, jacobian)
    if not (variance > 0).all():
        return None
    squares = (of_a - of_b) ** 2
    return FieldDifference(
        float(np.sqrt(np.mean(squares))),
        float(np.sqrt(np.mean(variance))),
        float(np.mean(squares / variance)),
    )
