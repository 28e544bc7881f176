"""The rig that a run found: the given one with what the last estimate says it is off by, or why there is none."""

from __future__ import annotations

from dataclasses import replace

from vio.calibration.stereo_field import CalibratedRig, calibrated_rig
from vio.cameras.rig import Rig
from vio.errors import CalibrationError
from vio.geometry.stereo import StereoCamera
from vio.records import Estimate

_MOST_LEFT_PX = 5.0  # a rig that leaves more of what the run saw is none of these cameras; true ones leave 0.3 px


def estimated_rig(given: Rig, estimate: Estimate, camera: StereoCamera, where: str) -> CalibratedRig:
    """Return a given rig with all that a run estimated of it.

    On a cylinder left and right stay as given: its rectification error is not expressed as a rig.

    Raises:
        CalibrationError: no rig of the given lens models is off as the run found it.
    """
    field = None if camera.is_cylinder else estimate.stereo_field
    if field is None:
        return calibrated_rig(given, replace(estimate, stereo_field=None))
    cause: CalibrationError | None = None
    try:
        found = calibrated_rig(given, estimate)
        if found.left_px <= _MOST_LEFT_PX:
            return found
    except CalibrationError as error:  # the fit's steps led out of the possible rigs
        cause = error
    raise CalibrationError(
        f"{where}: no rig with the given lens models is off as the run found it (rows by {field.rows_rms_px:.2f} px "
        "rms); the calibration may be that of other images, or without their distortion: calibrate the cameras anew"
    ) from cause
