"""What of the stereo pair's calibration is estimated, and how pixels look without what it got wrong."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from vio.cameras.rectification_error import METRIC_TERMS
from vio.filters.online_calibration import Calibration, prior_variances
from vio.filters.scale_test import SCALE_SIGMA, ScaleTest
from vio.filters.separate_bias import SeparateBias
from vio.filters.settings import MsckfSettings
from vio.filters.stereo_calibration import LEAST_FIELD_PX, StereoCorrection, VerticalDisparityModel
from vio.filters.window import Window
from vio.geometry.lie import FloatArray
from vio.geometry.stereo import StereoCamera
from vio.records import (
    ROTATION_NOT_COMPARABLE,
    ROW_TERMS,
    Estimate,
    MotionSource,
    Observations,
    RotationComparison,
    StereoScaleEstimate,
)

_FREED_FOCAL_SIGMA = 0.05  # over it, once the rotation of camera and gyro differ


class RigCalibration:
    """Begins to estimate a part of the stereo calibration where the run shows that it is off."""

    def __init__(self, camera: StereoCamera, settings: MsckfSettings) -> None:
        """Prepare for a camera; nothing is estimated yet but what the settings want from the start."""
        self.camera = camera  # with the scale that was taken over
        self.settings = settings  # with the priors of what was freed
        self.rotation: RotationComparison | None = ROTATION_NOT_COMPARABLE  # as others compared them; None: they will
        self.scale_log: float | None = None  # of the baseline over the calibrated one; None: nothing contradicts it
        self._rows = VerticalDisparityModel(camera)

    def first_covariance(self, calibration: Calibration, T_world_imu: FloatArray) -> FloatArray:
        """Covariance (C, C) of the errors of a calibration of which nothing was seen yet, at a pose (4, 4)."""
        return calibration.in_world(calibration.variances(prior_variances(self.settings)), T_world_imu)

    def follow_constants(self, window: Window, source: MotionSource | None) -> None:
        """Begin to estimate scale and focal length beside the states of a window without clones."""
        if source is not None and "stereo_scale" not in window.state:
            window.prior.scale_test = ScaleTest(window.state.size)
            if source == "imu" and self.camera.kind == "stereo" and not self.camera.is_cylinder:
                window.prior.focal = SeparateBias(window.state.size)

    def learn_rows(self, window: Window, seen: Observations) -> None:
        """Learn the rows of a frame; begin to estimate the stereo field where they show that it is needed."""
        if self.settings.calibrate_stereo == "off":
            return
        self._rows.update(seen)
        known_off = self.camera.residual_px > LEAST_FIELD_PX
        if "stereo_field" not in window.state and (known_off or self._rows.is_significant):
            calibration = window.calibration.estimating("stereo_field", self.settings)
            variances = prior_variances(self.settings)["stereo_field"]
            window.estimate_block("stereo_field", calibration, np.diag(variances))

    def focal_length_is_off(self, window: Window) -> bool:
        """Whether camera and gyro turn differently, the gyro is not the cause, and the focal length is no state."""
        rotation = self.rotation
        if rotation is not None and rotation.settled:
            window.prior.focal = None  # what is not needed need not be followed
        return rotation is not None and window.prior.focal is not None and rotation.differ and rotation.gyro_agrees

    def free_focal_length(self, window: Window) -> None:
        """Make states of baseline and focal length; errors depend on them as was followed beside them, (S5)."""
        prior = window.prior
        assert prior.focal is not None
        # A baseline that was taken over may be what the focal length passed for.
        baseline = self.settings.stereo_baseline_sigma if self.scale_log is None else SCALE_SIGMA
        self.settings = replace(self.settings, stereo_baseline_sigma=baseline, stereo_focal_sigma=_FREED_FOCAL_SIGMA)
        size = window.state.size
        of_baseline = np.zeros(size) if prior.scale_test is None else prior.scale_test.error_D_bias + window.scaled()
        V = np.column_stack([of_baseline, prior.focal.error_D_bias])
        prior.focal = prior.scale_test = None
        calibration = window.calibration.estimating("stereo_scale", self.settings)
        window.estimate_block("stereo_scale", calibration, np.zeros((METRIC_TERMS, METRIC_TERMS)))
        terms = np.r_[window.state["stereo_scale"]]
        J = np.zeros((size + METRIC_TERMS, METRIC_TERMS))
        J[terms, np.arange(METRIC_TERMS)] = 1.0
        J[np.delete(np.arange(len(J)), terms)] = V
        sigmas = np.array([baseline, _FREED_FOCAL_SIGMA])
        prior.P = prior.P + J @ np.diag(sigmas**2) @ J.T

    def test_scale(self, window: Window, seen: Observations) -> float | None:
        """Take the scale of IMU or velocities, from the frame on at which they contradict that of the baseline.

        Returns:
            The factor by which the world of the window and the camera's baseline were scaled; None: they were not.
        """
        if not seen.has_right.any():  # then the scale is not the baseline's, but the sensor's already
            window.prior.scale_test = None
        test = window.prior.scale_test
        if test is not None:
            test.frames += 1
        if test is None or (self.scale_log is None and not test.contradicted):
            return None
        if self.scale_log is None and (self.rotation is None or not self.rotation.agree):
            return None  # a wrong focal length passes for it
        log, _ = test.estimate()
        move = float(np.expm1(log)) * window.scaled()
        window.relinearise(move)
        window.prior.delta = window.prior.delta - move - log * test.error_D_bias  # (S4)
        test.adopt()
        factor = float(np.exp(log))
        self.scale_log = (self.scale_log or 0.0) + float(np.log(factor))
        self.camera = replace(self.camera, baseline_m=self.camera.baseline_m * factor)
        return factor

    def scale_covariance(self, window: Window, information: FloatArray, P: FloatArray) -> FloatArray | None:
        """What the uncertainty of a scale that was taken over adds to the covariance of the first errors, (S4).

        Args:
            window: with its prior.
            information: about the errors (D, D), not yet absorbed.
            P: covariance of the first errors (k, k) with it, the scale known.
        """
        test, first = window.prior.scale_test, slice(0, len(P))
        if self.scale_log is None or test is None:
            return None
        V = test.error_D_bias[first]
        V = V - P @ (information[first, first] @ V) + window.scaled()[first]
        out: FloatArray = test.estimate()[1] ** 2 * np.outer(V, V)
        return out

    def field(self, window: Window) -> StereoCorrection | None:
        """The stereo calibration's faults at the window's present means; None where they are not estimated."""
        estimated, stereo = window.calibration.stereo_terms, window.calibration.stereo
        if not len(estimated):
            return None
        rows, rows_D_common = np.zeros(ROW_TERMS), None
        if "stereo_field" in window.state:
            rows = self._rows.coefficients
        # Lenses that bend both images alike pass for a focal length: 2 ± 0.4 % for k1 = -0.03. Where that counts as
        # known, drives come out no better without their part of the rows: KITTI 03 by 20 %, 06 and 0039 not.
        if "stereo_field" in window.state and "stereo_scale" in window.state:
            rows, rows_D_common = self._rows.without_common(stereo), self._rows.rows_D_common
        return StereoCorrection(self.camera, rows, stereo, estimated, rows_D_common)

    def report(self, window: Window, estimate: Estimate) -> Estimate:
        """Return an estimate with the scale that was taken over, and with the rows that were learned."""
        scale, field, test = estimate.stereo_scale, estimate.stereo_field, window.prior.scale_test
        if self.scale_log is not None:
            taken = np.array([self.scale_log, 0.0])
            if test is not None:
                scale = StereoScaleEstimate(taken, np.diag([test.estimate()[1] ** 2, 0.0]))
            elif scale is not None:  # of a camera with the baseline that was taken over
                scale = replace(scale, logs=scale.logs + taken)
        if field is not None:
            own, P = self._rows.without_common(field.coefficients), self._rows.covariance
            field = replace(field, rows_rms_px=self._rows.rms_px, rows=own, rows_covariance=P)
        if scale is estimate.stereo_scale and field is estimate.stereo_field:
            return estimate
        return replace(estimate, stereo_scale=scale, stereo_field=field)
