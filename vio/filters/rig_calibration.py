"""What of the stereo pair's calibration is estimated, and how pixels look without what it got
wrong.
"""

from __future__ import annotations

import functools
from typing import Any, NamedTuple

import numpy as np

from vio.filters.online_calibration import (
    MAX_FIELD_SIGMA,
    MIN_FIELD_SIGMA,
    Calibration,
    prior_variances,
    stereo_field_sigmas,
    stereo_yaw_rad,
)
from vio.filters.scale_test import ScaleTest
from vio.filters.settings import MsckfSettings
from vio.filters.stereo_calibration import StereoCorrection, VerticalDisparityModel
from vio.filters.window import Window
from vio.geometry.lie import FloatArray
from vio.geometry.stereo import StereoCamera
from vio.records import (
    ROTATION_NOT_COMPARABLE,
    ROW_TERMS,
    MotionSource,
    Observations,
    RotationComparison,
    StereoFieldEstimate,
    StereoScaleEstimate,
)


class _RigRules(NamedTuple):
    """What the matches tell of a rig."""

    # standard deviation of its coordinates, in focal lengths, over that of the focal length
    principal_point_share: float = 1 / 3
    # of the standard deviation of a lens term, over the root mean square of the rows' field
    columns_by_rows: float = 3.0
    # how much larger the rows' field must become for what was learned of the columns to be in doubt
    rows_moved_sigmas: float = 2.0
    field_samples: int = 9  # along a row, of the field whose size is measured


_RIG = _RigRules()
_NO_ROWS: FloatArray = np.zeros(ROW_TERMS)
_NO_COLUMNS: FloatArray = np.zeros((ROW_TERMS, 0))
# root mean square of a rows' field that says no more of the columns than their least prior does, in
# focal lengths
_LEAST_ROWS = MIN_FIELD_SIGMA / _RIG.columns_by_rows


def rows_off(camera: StereoCamera, offset_px: float) -> float:
    """Size of the rows' field in focal lengths: its root mean square, and what a saved
    calibration left.
    """
    return float(np.hypot(offset_px, camera.residual_px)) / camera.fv


def field_sigmas(camera: StereoCamera, offset_px: float, yaw_rad: float) -> FloatArray:
    """Standard deviations (8,) of the right columns' field, in focal lengths, by the rows' root
    mean square.

    An error of turn or lens moves rows and columns alike, so the size of the rows' field is an
    estimate of the standard deviation of the columns' (empirical Bayes).
    """
    sigma = float(
        np.clip(
            _RIG.columns_by_rows * rows_off(camera, offset_px), MIN_FIELD_SIGMA, MAX_FIELD_SIGMA
        )
    )
    return stereo_field_sigmas(sigma, yaw_rad, offset_px / camera.fv)


def constant_sigmas(settings: MsckfSettings) -> FloatArray:
    """Standard deviations (4,) of baseline, focal length and principal point (u, v).

    The baseline's is over its length, the others are over the focal length.
    """
    centre = _RIG.principal_point_share * settings.stereo_focal_sigma
    return np.array([settings.stereo_baseline_sigma, settings.stereo_focal_sigma, centre, centre])


def scale_sigma(settings: MsckfSettings) -> float:
    """Standard deviation of the scale by baseline and focal length as they are calibrated, over
    it.
    """
    return float(np.hypot(settings.stereo_baseline_sigma, settings.stereo_focal_sigma))


@functools.lru_cache(maxsize=8)
def _powers_over_width(camera: StereoCamera) -> FloatArray:
    """Means over the width (4,) of what multiplies the columns' coefficients in the middle row."""
    if camera.width is None:
        width = 2.0 * camera.cu
    else:
        width = camera.width
    x = (np.linspace(0.0, width, _RIG.field_samples) - camera.cu) / camera.fu
    return np.array([1.0, x.mean(), (x**2).mean(), (x**4).mean()])


def field_doubt(
    camera: StereoCamera, settings: MsckfSettings, field: FloatArray, covariance: FloatArray
) -> float:
    """Return what the field of disparities lets the scale be off by beside `scale_sigma`, as a
    standard deviation over it, equation (S6).

    One board and one fit gave all constants of a rig. Where the mean disparity is off by k times
    what a usual yaw moves it by, baseline and focal length, which images alone do not show, are as
    likely k times as far off as usual.

    Args:
        camera: the rectified pair.
        settings: with the standard deviations of a usual calibration.
        field: (T,) coefficients of (R3), those of the columns first, focal lengths.
        covariance: (T, T) of them.
    """
    if camera.projection != "pinhole" or settings.stereo_baseline_sigma == 0.0:
        return 0.0
    means = _powers_over_width(camera)
    mean = float(means @ field[:4])
    noise = float(means @ covariance[:4, :4] @ means)
    squared = (mean**2 - noise) / stereo_yaw_rad(settings) ** 2
    return scale_sigma(settings) * float(np.sqrt(max(squared - 1.0, 0.0)))


class RigCalibration:
    """Begins to estimate a part of the stereo calibration where the run shows that it is off."""

    def __init__(self, camera: StereoCamera, settings: MsckfSettings) -> None:
        """Prepare for a camera; nothing is estimated yet but what the settings want from the
        start.
        """
        self.camera = camera
        self.settings = settings
        # as others compared them; None: they will
        self.rotation: RotationComparison | None = ROTATION_NOT_COMPARABLE
        self._rows = VerticalDisparityModel(camera)
        self._sigmas = constant_sigmas(settings)
        # (8,) before anything was seen of it
        self._field_variances = prior_variances(settings)["stereo_field"]
        # size of the rows' field that gave them, focal lengths
        self._rows_off = _LEAST_ROWS
        # at a calibration, by the present rows
        self._field: tuple[Calibration, StereoCorrection | None] | None = None

    def first_covariance(self, calibration: Calibration, T_world_imu: FloatArray) -> FloatArray:
        """Covariance (C, C) of the errors of a calibration of which nothing was seen yet, at a
        pose (4, 4).
        """
        variances = prior_variances(self.settings) | {"stereo_field": self._field_variances}
        return calibration.in_world(calibration.variances(variances), T_world_imu)

    def test_scale(
        self, window: Window, source: MotionSource | None, before: ScaleTest | None
    ) -> None:
        """Begin to test the scale beside the states of a window without clones, with what a test
        before has found.
        """
        if source is not None and "stereo_scale" not in window.state.blocks:
            window.prior.scale_test = ScaleTest() if before is None else before

    def learn_rows(self, window: Window, seen: Observations) -> None:
        """Learn the rows of a frame; the first ones say how far off the lenses may be, and begin to
        estimate the field.

        Where the rows' field grows much later, or moves, as a camera has been moved in its mount or
        the first matches were wrong ones, the columns are in doubt again.
        """
        if self.settings.calibrate_stereo == "off" or self.camera.kind != "stereo":
            return
        self._rows.update(seen)
        self._field = None
        if self._rows.offset_px is None:
            return
        moved_px = self._rows.moved_px
        if (
            "stereo_field" in window.state.blocks
            and moved_px > _RIG.rows_moved_sigmas * _LEAST_ROWS * self.camera.fv
        ):
            # A turn of which the rows show this part moves columns as much.
            sigmas = field_sigmas(self.camera, moved_px, stereo_yaw_rad(self.settings))
            window.prior.inflate(window.state.blocks["stereo_field"], sigmas**2)
            self._rows.forget()
            self._rows.update(seen)
            return
        off = rows_off(self.camera, self._rows.offset_px)
        begins = "stereo_field" not in window.state.blocks
        if not begins and off <= _RIG.rows_moved_sigmas * self._rows_off:
            return
        yaw_rad = stereo_yaw_rad(self.settings)
        variances = field_sigmas(self.camera, self._rows.offset_px, yaw_rad) ** 2
        if begins:
            calibration = window.calibration.estimating("stereo_field", self.settings)
            window.estimate_block("stereo_field", calibration, np.diag(variances))
        else:
            window.prior.inflate(
                window.state.blocks["stereo_field"],
                np.maximum(variances - self._field_variances, 0.0),
            )
        self._field_variances, self._rows_off = variances, max(off, self._rows_off)

    def end_frame(self, window: Window, seen: Observations) -> None:
        """Count a frame of the scale's test; without right views the scale is not the
        baseline's.
        """
        if not seen.has_right.any():
            window.prior.scale_test = None
        if window.prior.scale_test is not None:
            window.prior.scale_test.end_frame()

    def considered_sigmas(self, window: Window) -> FloatArray:
        """Standard deviations (4,) as `constant_sigmas` returns them; zero where one is
        estimated.
        """
        if "stereo_scale" in window.state.blocks:
            return self._sigmas * [0.0, 0.0, 1.0, 1.0]
        return self._sigmas

    def uncertainty(self, window: Window, V: FloatArray) -> FloatArray:
        """What the constants considered add to a covariance (..., k, k), by how its errors
        follow them (..., k, 4).
        """
        V = V * self.considered_sigmas(window)
        out: FloatArray = V @ V.swapaxes(-1, -2)
        return out

    def scale_doubt(self, window: Window) -> float:
        """By what motion sensor and field suggest that the baseline is off, as a standard deviation
        over it, beside the one considered; 0 where the settings say that it is known.
        """
        if self._sigmas[0] == 0.0 or "stereo_scale" in window.state.blocks:
            return 0.0
        test = window.prior.scale_test
        by_sensor = 0.0 if test is None else test.doubt()
        return float(np.hypot(by_sensor, self._field_doubt(window)))

    def _field_doubt(self, window: Window) -> float:
        """What `field_doubt` returns of a window."""
        if "stereo_field" not in window.state.blocks:
            return 0.0
        rows = window.state.blocks["stereo_field"]
        covariance = window.prior.P[rows, rows]
        return field_doubt(self.camera, self.settings, window.calibration.stereo, covariance)

    def reported_uncertainty(self, window: Window, V: FloatArray) -> FloatArray:
        """Return `uncertainty` (k, k) with what sensor and field say against the scale."""
        by_scale = V[:, 0] * self.scale_doubt(window)
        return self.uncertainty(window, V) + by_scale[:, None] * by_scale

    def landmark_covariances(self, window: Window) -> FloatArray:
        """Covariances (M, 3, 3) of the landmarks in the state, with what is considered."""
        first = window.state.landmarks.start
        prior = window.prior
        rows = first + np.arange(3 * len(window.landmarks)).reshape(-1, 3)
        out: FloatArray = prior.P[rows[:, :, None], rows[:, None, :]]
        return out + self.uncertainty(window, prior.error_D_constants[rows, 1:])

    def field(self, window: Window) -> StereoCorrection | None:
        """The stereo calibration's faults at the window's present means.

        None where they are not estimated.
        """
        if self._field is None or self._field[0] is not window.calibration:
            self._field = window.calibration, self._field_at(window)
        return self._field[1]

    def _field_at(self, window: Window) -> StereoCorrection | None:
        estimated = window.calibration.stereo_terms
        stereo = window.calibration.stereo
        blocks = window.state.blocks
        if not len(estimated):
            return None
        rows = _NO_ROWS
        rows_D_common = _NO_COLUMNS
        if "stereo_field" in blocks:
            rows = self._rows.coefficients
        # Lenses that bend both images alike pass for a focal length: 2 ± 0.4 % for k1 = -0.03.
        # Where that counts as known, drives come out no better without their part of the rows:
        # KITTI 03 by 20 %, 06 and 0039 not.
        if "stereo_field" in blocks and "stereo_scale" in blocks:
            rows = self._rows.without_common(stereo)
            rows_D_common = self._rows.rows_D_common
        return StereoCorrection(self.camera, rows, stereo, estimated, rows_D_common)

    def report(self, window: Window, own: FloatArray) -> dict[str, Any]:
        """Return the fields of `Estimate` on the calibration, by the errors' covariance (15 + C, 15
        + C).

        That is with the scale that was taken over, and with the rows that were learned.
        """
        out = window.calibration.report(window.state, window.nav, own)
        test = window.prior.scale_test
        if (
            test is not None
            and test.is_confirmed
            and self.rotation is not None
            and self.rotation.agree
        ):
            log, sigma = test.estimate()  # a wrong focal length passes for it
            out["stereo_scale"] = StereoScaleEstimate(
                np.array([log, 0.0]), np.diag([sigma**2, 0.0])
            )
        if "stereo_field" in out:
            field = out["stereo_field"]
            P = self._rows.covariance
            rows = self._rows.without_common(field.coefficients)
            out["stereo_field"] = StereoFieldEstimate(
                field.coefficients, field.covariance, self._rows.stated_px, rows, P
            )
        return out
