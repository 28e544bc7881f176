"""How far the pixels of a rectified pair are off, term by term: equations (R1) to (R6) of
docs/math.md.

A right camera that is turned, shifted or distorted against its calibration, and lenses that are
distorted against theirs, move rectified pixels by low polynomials in the place in the image. This
is the one list of these terms; the sliding window, the vertical disparities learned beside it, and
the fit of a rig take theirs from it.

Fourteen columns: a0 to a3 of the right camera's columns, k1, k2, q1, q2 of both lenses (R3), then
the rows' six of 1, x, y, x y, x^2, y^2 (R2) with what they imply for the columns. The rows'
seventh, of the disparity, depends on both images.
"""

from __future__ import annotations

from dataclasses import field

import numpy as np

from vio.cameras.projection import CameraArgs, camera_args
from vio.dataclass import dataclass
from vio.geometry.lie import FloatArray
from vio.geometry.stereo import StereoCamera
from vio.numerics.compiled import compiled
from vio.records import FIELD_TERMS, RIGHT_TERMS, ROW_TERMS, IntArray

METRIC_TERMS = 2  # logarithms of baseline and focal length over the calibrated ones, (R4)
TERMS = FIELD_TERMS + METRIC_TERMS
# what may be considered in place of estimated: those two, and the principal point
CONSIDERED = METRIC_TERMS + 2
_COLUMNS = FIELD_TERMS + ROW_TERMS - 1


@dataclass(frozen=True, slots=True)
class ErrorColumns:
    """Which derivatives of pixels by coefficients of (R3) and (R4) are wanted."""

    camera: StereoCamera
    # (S,) which ones; behind the ten coefficients come those of the principal point (u, v), over
    # the focal length
    chosen: IntArray = field(default_factory=lambda: np.arange(TERMS))
    # (7, 4) what k1, k2, q1, q2 take off the rows of (R2), which right columns follow; (7, 0):
    # nothing
    rows_D_common: FloatArray = field(default_factory=lambda: np.zeros((ROW_TERMS, 0)))

    def jacobian(self, z: FloatArray) -> FloatArray:
        """Derivatives (..., 4, S) of pixels `[ul vl ur vr]` (..., 4), pixels.

        The row of `vr` is zero: right rows are not measured. On a cylinder the column of the focal
        length is zero.
        """
        out = np.empty((*z.shape[:-1], 4, len(self.chosen)))
        pixels = np.ascontiguousarray(z).reshape(-1, 4)
        flat = out.reshape(-1, 4, len(self.chosen))
        _write_jacobian(camera_args(self.camera), pixels, self.chosen, self.rows_D_common, flat)
        return out


def error_basis(camera: StereoCamera, z: FloatArray) -> FloatArray:
    """Derivatives (N, 4, 15) of a pinhole's pixels `[ul vl ur vr]` (N, 4) by the coefficients of
    (R3) and (R2).
    """
    out = np.empty((len(z), 4, FIELD_TERMS + ROW_TERMS))
    _write_basis(camera_args(camera), np.ascontiguousarray(z), out)
    return out


def vertical_disparity_terms(camera: StereoCamera, z: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Derivatives (N, 7) of right minus left rows by the coefficients of (R2), and (N, 4) by k1,
    k2, q1, q2 of (R3).

    In focal lengths, of pixels (N, 4).
    """
    rows = np.empty((len(z), ROW_TERMS))
    common = np.empty((len(z), FIELD_TERMS - RIGHT_TERMS))
    _write_rows(camera_args(camera), np.ascontiguousarray(z), rows, common)
    return rows, common


def radial_focal(camera: StereoCamera) -> FloatArray:
    """Return by how much (2,) the logarithm of a calibrated focal length is too large for one unit
    of k1 and of k2, equation (R8).
    """
    return np.array(_radial_focal(camera_args(camera)))


def corrected_pixels(
    camera: StereoCamera,
    coefficients: FloatArray,
    rows: FloatArray,
    z: FloatArray,
    weight: FloatArray,
) -> FloatArray:
    """Return pixels (..., 4), where they were measured, without their errors; right rows stay as
    they are.

    Args:
        camera: rectified pair.
        coefficients: (10,) of (R3) and (R4).
        rows: (7,) of (R2), in focal lengths.
        z: pixels.
        weight: (..., 4) above zero where measured.
    """
    z = np.ascontiguousarray(z)
    weight = np.ascontiguousarray(weight)
    out = np.empty(z.shape)
    correct = _correct_cylinder if camera.is_cylinder else _correct_pinhole
    flat = z.reshape(-1, 4), weight.reshape(-1, 4), out.reshape(-1, 4)
    correct(camera_args(camera), coefficients, rows, *flat)
    return out


@compiled
def _write_terms(
    camera: CameraArgs, x: float, y: float, fu: float, fv: float, out: FloatArray
) -> None:
    """Write by how much (2, 14) a right camera's coordinates move for one unit of each
    coefficient, times fu and fv.
    """
    if camera[5]:
        _cylinder_terms(x, y, out)
        for j in range(out.shape[1]):
            out[0, j] *= fu
            out[1, j] *= fv
        return
    r2 = x * x + y * y
    u_right = (fu, fu * x, fu * r2, fu * r2 * r2)
    (u_both, v_both) = _common_terms(x, y, fu, fv)
    for j in range(4):
        out[0, j] = u_right[j]
        out[1, j] = 0.0
        out[0, 4 + j] = u_both[j]
        out[1, 4 + j] = v_both[j]
    u_rows = 0.0, -fu * y, 0.0, -fu * y * y, -fu * x * y, fu * x * y
    v_rows = fv, fv * x, fv * y, fv * x * y, fv * x * x, fv * y * y
    for j in range(6):
        out[0, 8 + j] = u_rows[j]
        out[1, 8 + j] = v_rows[j]


@compiled
def _common_terms(
    x: float, y: float, fu: float, fv: float
) -> tuple[tuple[float, float, float, float], tuple[float, float, float, float]]:
    """By how much a pinhole's columns and rows move for one unit of k1, k2, q1, q2, times fu and
    fv.
    """
    r2 = x * x + y * y
    of_columns = fu * x * r2, fu * x * r2 * r2, fu * 2.0 * x * y, fu * (r2 + 2.0 * x * x)
    return of_columns, (fv * y * r2, fv * y * r2 * r2, fv * (r2 + 2.0 * y * y), fv * 2.0 * x * y)


@compiled
def _radial_focal(camera: CameraArgs) -> tuple[float, float]:
    """What the focal length of a pinhole is too long by for one unit of k1 and of k2, equation
    (R8); zero on a cylinder.

    The image is taken to be the rectangle about its principal point.
    """
    fu, fv, cu, cv, _, cylinder = camera
    if cylinder:
        return 0.0, 0.0
    xx = (cu / fu) ** 2
    yy = (cv / fv) ** 2
    r2 = (xx + yy) / 3.0
    r4 = (xx**2 + yy**2) / 5.0 + 2.0 * xx * yy / 9.0
    r6 = (xx**3 + yy**3) / 7.0 + xx * yy * (xx + yy) / 5.0
    return r4 / r2, r6 / r2


@compiled
def _lens_plane(x: float, azimuth: float) -> tuple[float, float, float, float, float, float]:
    """Angles off the axis (along u, along v) of a cylinder's coordinates, and how the coordinates
    move with them (2x2).

    Errors of a wide lens are low polynomials in these angles, as those of a narrow one are on the
    plane z = 1.
    """
    rho = 1.0 / np.sqrt(1.0 + x * x)
    a = x * rho
    y = np.sin(azimuth) * rho
    z = np.cos(azimuth) * rho
    sine = np.sqrt(a * a + y * y)
    if sine < 1e-6:
        return a, y, 1.0, 0.0, 0.0, 1.0
    ratio = np.arctan2(sine, z) / sine
    ca = a / sine
    sa = y / sine
    xx = (z * ca * ca + sa * sa / ratio) / rho**3
    xy = ca * sa * (z - 1.0 / ratio) / rho**3
    yx = ca * sa * (1.0 - z / ratio) / rho**2
    yy = (sa * sa + ca * ca * z / ratio) / rho**2
    return ratio * a, ratio * y, xx, xy, yx, yy


@compiled
def _cylinder_terms(x: float, azimuth: float, out: FloatArray) -> None:
    """Write the terms (2, 14) of coordinates on a cylinder, equation (R6)."""
    u, v, xx, xy, yx, yy = _lens_plane(x, azimuth)
    s = np.sin(azimuth)
    c = np.cos(azimuth)
    r2 = u * u + v * v
    # What moves in the lens, in angles off the axis; then on the cylinder.
    r4 = r2 * r2
    lens_u = (
        4.0,
        u,
        r2,
        r4,
        r2 * u,
        r4 * u,
        2.0 * u * v,
        r2 + 2.0 * u * u,
        0.0,
        0.0,
        0.0,
        0.0,
        0.0,
        r2 * u,
    )
    lens_v = (
        0.0,
        0.0,
        0.0,
        0.0,
        r2 * v,
        r4 * v,
        r2 + 2.0 * v * v,
        2.0 * u * v,
        0.0,
        0.0,
        v,
        0.0,
        3.0,
        r2 * v,
    )
    for j in range(14):
        out[0, j] = xx * lens_u[j] + xy * lens_v[j]
        out[1, j] = yx * lens_u[j] + yy * lens_v[j]
    # The turns about y, z and x.
    out[0, 0] -= 3.0 * (1.0 + x * x) * c
    out[1, 0] -= 3.0 * x * s
    out[0, 11] += (1.0 + x * x) * c
    out[1, 11] += x * s
    out[0, 9] -= (1.0 + x * x) * s
    out[1, 9] += x * c
    out[1, 8] += 1.0
    out[1, 12] -= 3.0


@compiled
def _write_jacobian(
    camera: CameraArgs, z: FloatArray, chosen: IntArray, rows_D_common: FloatArray, out: FloatArray
) -> None:
    """Write the derivatives (M, 4, S) of pixels (M, 4) by S coefficients, see `ErrorColumns`."""
    every = np.empty((3, TERMS + 2))
    for m in range(len(z)):
        write_view(camera, z[m], rows_D_common, every)
        for s in range(len(chosen)):
            for a in range(3):
                out[m, a, s] = every[a, chosen[s]]
            out[m, 3, s] = 0.0


@compiled
def write_view(
    camera: CameraArgs, z: FloatArray, rows_D_common: FloatArray, out: FloatArray
) -> None:
    """Write all derivatives (3, 12) of one view's pixels (4,) but the right row, see
    `ErrorColumns`.
    """
    fu, fv, cu, cv, _, cylinder = camera
    x = (z[0] - cu) / fu
    y = (z[1] - cv) / fv
    xr = (z[2] - cu) / fu
    for k in range(TERMS + 2):
        out[0, k] = out[1, k] = out[2, k] = 0.0
    if cylinder:
        _write_on_cylinder(camera, x, y, xr, out)
    else:
        r2 = xr * xr + y * y
        (left, row) = _common_terms(x, y, fu, fv)
        (right, _) = _common_terms(xr, y, fu, fv)
        out[2, 0] = fu
        out[2, 1] = fu * xr
        out[2, 2] = fu * r2
        out[2, 3] = fu * r2 * r2
        for k in range(4):
            out[0, 4 + k] = left[k]
            out[1, 4 + k] = row[k]
            out[2, 4 + k] = right[k]
        focal = _radial_focal(camera)
        for k in range(2):
            out[0, 4 + k] -= focal[k] * fu * x
            out[1, 4 + k] -= focal[k] * fv * y
            out[2, 4 + k] -= focal[k] * fu * x
        out[0, 9] = fu * x
        out[1, 9] = fv * y
        out[2, 9] = fu * xr
    out[2, 8] = z[2] - z[0]
    out[0, 10] = fu
    out[2, 10] = fu
    out[1, 11] = fv
    if rows_D_common.shape[1]:
        _take_off_common(camera, x, y, xr, rows_D_common, out)


@compiled
def _write_on_cylinder(camera: CameraArgs, x: float, y: float, xr: float, out: FloatArray) -> None:
    """Write the columns of (R3) into the derivatives (3, 12) of a view on a cylinder."""
    left = np.empty((2, _COLUMNS))
    right = np.empty((2, _COLUMNS))
    _write_terms(camera, x, y, camera[0], camera[1], left)
    _write_terms(camera, xr, y, camera[0], camera[1], right)
    for k in range(4):
        out[2, k] = right[0, k]
        out[0, 4 + k] = left[0, 4 + k]
        out[1, 4 + k] = left[1, 4 + k]
        out[2, 4 + k] = right[0, 4 + k]


@compiled
def _take_off_common(
    camera: CameraArgs, x: float, y: float, xr: float, rows_D_common: FloatArray, out: FloatArray
) -> None:
    """Take what right columns follow of the rows that k1, k2, q1, q2 take off, out of a view's
    derivatives (3, 12).
    """
    right = np.empty((2, _COLUMNS))
    _write_terms(camera, xr, y, camera[0], camera[1], right)
    for k in range(4):
        for j in range(6):
            out[2, 4 + k] -= right[0, 8 + j] * rows_D_common[j, k]
        if camera[5]:
            out[2, 4 + k] += rows_D_common[6, k] * camera[0] * xr * (x - xr) * np.sin(y)


@compiled
def _write_basis(camera: CameraArgs, z: FloatArray, out: FloatArray) -> None:
    """Write the derivatives (M, 4, 15) of a pinhole's pixels (M, 4) by the coefficients of (R3)
    and (R2).
    """
    fu, fv, cu, cv, _, _ = camera
    left = np.empty((2, _COLUMNS))
    right = np.empty((2, _COLUMNS))
    focal = _radial_focal(camera)
    for m in range(len(z)):
        x = (z[m, 0] - cu) / fu
        y = (z[m, 1] - cv) / fv
        xr = (z[m, 2] - cu) / fu
        _write_terms(camera, x, y, 1.0, 1.0, left)
        _write_terms(camera, xr, y, 1.0, 1.0, right)
        for k in range(2):
            left[0, 4 + k] -= focal[k] * x
            left[1, 4 + k] -= focal[k] * y
            right[0, 4 + k] -= focal[k] * x
            right[1, 4 + k] -= focal[k] * y
        for k in range(_COLUMNS):
            out[m, 0, k] = left[0, k] * fu if 4 <= k < 8 else 0.0
            out[m, 1, k] = left[1, k] * fv if 4 <= k < 8 else 0.0
            out[m, 2, k] = right[0, k] * fu
            out[m, 3, k] = right[1, k] * fv
        out[m, 0, _COLUMNS] = out[m, 1, _COLUMNS] = out[m, 2, _COLUMNS] = 0.0
        out[m, 3, _COLUMNS] = (x - xr) * fv


@compiled
def _write_rows(camera: CameraArgs, z: FloatArray, rows: FloatArray, common: FloatArray) -> None:
    """Write the arrays (M, 7) and (M, 4) of `vertical_disparity_terms`."""
    fu, fv, cu, cv, _, cylinder = camera
    left = np.empty((2, _COLUMNS))
    right = np.empty((2, _COLUMNS))
    for m in range(len(z)):
        x = (z[m, 0] - cu) / fu
        y = (z[m, 1] - cv) / fv
        xr = (z[m, 2] - cu) / fu
        _write_terms(camera, xr, y, 1.0, 1.0, right)
        for j in range(6):
            rows[m, j] = right[1, 8 + j]
        if cylinder:
            _write_terms(camera, x, y, 1.0, 1.0, left)
            rows[m, 6] = (z[m, 0] - z[m, 2]) / fu * np.cos(y)
            for j in range(4):
                common[m, j] = right[1, 4 + j] - left[1, 4 + j]
        else:  # the same differences, without cancellation
            squares = xr * xr - x * x
            rows[m, 6] = x - xr
            common[m, 0] = y * squares
            common[m, 2] = squares
            common[m, 3] = 2.0 * y * (xr - x)
            common[m, 1] = y * (squares * (xr * xr + x * x + 2.0 * y * y))


@compiled
def _correct_pinhole(
    camera: CameraArgs,
    coefficients: FloatArray,
    rows: FloatArray,
    z: FloatArray,
    weight: FloatArray,
    out: FloatArray,
) -> None:
    """Write a pinhole's pixels (M, 4) without their errors: the terms summed by Horner's rule,
    then (R4).
    """
    fu, fv, cu, cv, _, _ = camera
    a0, a1, a2, a3, k1, k2, q1, q2, baseline, focal = coefficients
    by_focal = np.exp(-focal)
    by_both = np.exp(-focal - baseline)
    metric = baseline != 0.0 or focal != 0.0
    of_radial = _radial_focal(camera)
    longer = of_radial[0] * k1 + of_radial[1] * k2
    for m in range(len(z)):
        x = (z[m, 0] - cu) / fu
        y = (z[m, 1] - cv) / fv
        xr = (z[m, 2] - cu) / fu
        r2 = x * x + y * y
        rr2 = xr * xr + y * y
        radial = r2 * (k1 + r2 * k2)
        right_radial = rr2 * (k1 + rr2 * k2)
        left = x * (radial - longer) + 2.0 * x * y * q1 + (r2 + 2.0 * x * x) * q2
        row = y * (radial - longer) + (r2 + 2.0 * y * y) * q1 + 2.0 * x * y * q2
        right = a0 + a1 * xr + rr2 * (a2 + rr2 * a3)
        right += xr * right_radial + 2.0 * xr * y * q1 + (rr2 + 2.0 * xr * xr) * q2
        right -= x * longer
        right += -rows[1] * y + (rows[5] - rows[4]) * xr * y - rows[3] * y * y
        out[m, 0] = z[m, 0] - fu * left if weight[m, 0] > 0.0 else z[m, 0]
        out[m, 1] = z[m, 1] - fv * row if weight[m, 1] > 0.0 else z[m, 1]
        out[m, 2] = z[m, 2] - fu * right if weight[m, 2] > 0.0 else z[m, 2]
        out[m, 3] = z[m, 3]
        if metric and weight[m, 0] > 0.0:
            disparity = (out[m, 0] - out[m, 2]) * by_both
            out[m, 0] = cu + (out[m, 0] - cu) * by_focal
            out[m, 1] = cv + (out[m, 1] - cv) * by_focal
            out[m, 2] = out[m, 0] - disparity if weight[m, 2] > 0.0 else z[m, 2]


@compiled
def _correct_cylinder(
    camera: CameraArgs,
    coefficients: FloatArray,
    rows: FloatArray,
    z: FloatArray,
    weight: FloatArray,
    out: FloatArray,
) -> None:
    """Write a cylinder's pixels (M, 4) without their errors; of (R4) the baseline's alone."""
    fu, fv, cu, cv, _, _ = camera
    left = np.empty((2, _COLUMNS))
    right = np.empty((2, _COLUMNS))
    for m in range(len(z)):
        y = (z[m, 1] - cv) / fv
        for a in range(4):
            out[m, a] = z[m, a]
        if weight[m, 0] > 0.0:
            _write_terms(camera, (z[m, 0] - cu) / fu, y, fu, fv, left)
            for j in range(4, 8):
                out[m, 0] -= left[0, j] * coefficients[j]
                out[m, 1] -= left[1, j] * coefficients[j]
        if weight[m, 2] > 0.0:
            _write_terms(camera, (z[m, 2] - cu) / fu, y, fu, fv, right)
            for j in range(8):
                out[m, 2] -= right[0, j] * coefficients[j]
            for j in range(6):
                out[m, 2] -= right[0, 8 + j] * rows[j]
            out[m, 2] += rows[6] * (z[m, 2] - cu) * (z[m, 0] - z[m, 2]) / fu * np.sin(y)
            if coefficients[8] != 0.0:
                out[m, 2] = out[m, 0] - (out[m, 0] - out[m, 2]) * np.exp(-coefficients[8])
