"""Error messages of the simulator for invalid sizes, fractions and motions."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from vio.errors import VioError
from vio.geometry.distortion import CameraModel
from vio.sim.effects import SensorEffects
from vio.sim.miscalibration import CalibrationErrors
from vio.sim.motion import car_loop, fit_spline, hand_held, motion_at
from vio.sim.oracle import OracleSettings
from vio.sim.render import camera_rays
from vio.sim.rigs import small_rig
from vio.sim.scenarios import Conditions, Scenario, plan
from vio.sim.sequence import simulate
from vio.sim.world import room, street

TIMES = np.arange(20) * 100_000_000
POSES = np.tile(np.eye(4), (20, 1, 1))
MOTION = hand_held(duration_s=1.0)
LATE_NS = MOTION.end_ns + np.array([1, 2]) * 10**9
FOLDING = CameraModel(100, 100, 160, 100, 320, 200, "radtan", (-0.4, 0.0, 0.0, 0.0))


def _with_hole() -> np.ndarray:
    poses = POSES.copy()
    poses[7, 0, 3] = np.nan
    return poses


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: fit_spline(TIMES[:5], POSES), "5 times for poses of shape"),
        (lambda: fit_spline(TIMES[:1], POSES[:1]), "needs at least two poses, got 1"),
        (lambda: fit_spline(TIMES, _with_hole()), "pose 7 of the trajectory is not finite"),
        (
            lambda: car_loop(loop_m=(20.0, 10.0), corner_m=6.0),
            "corners of 6 m do not fit a loop of 20 x 10 m",
        ),
        (lambda: OracleSettings(max_features=0), "must be positive"),
        (lambda: OracleSettings(sigma_px=-1.0), "must not be negative"),
        (lambda: OracleSettings(outlier_fraction=1.5), "must be between 0 and 1"),
        (lambda: OracleSettings(left_only_fraction=-0.1), "must be between 0 and 1"),
        (lambda: OracleSettings(outlier_px=4.0), "outlier_px must be at least 5"),
        (lambda: street(0, loop_m=(100.0, 30.0)), "needs loop_m of at least 37.5 m each way"),
        (lambda: room(0, bounds=[[0, 0, 0], [5, 5, 0.4]]), "at least 0.5 m apart"),
        (lambda: room(0, bounds=[[0, 0], [5, 5]]), "an upper corner"),
        (lambda: room(0, bare_walls=("+x", "up")), r"unknown walls \['up'\]; use some of"),
        (lambda: motion_at(MOTION, MOTION.end_ns + 1), "the motion is defined from"),
        (
            lambda: simulate(room(0), small_rig(64, 48), MOTION, frame_times_ns=LATE_NS),
            "no frame is within the motion",
        ),
        (lambda: camera_rays(FOLDING), "does not reach every pixel"),
        (lambda: SensorEffects(gamma=0.0), "gamma and blur_samples must be positive"),
        (lambda: SensorEffects(exposure=-0.1), "exposure and gain must not be negative"),
        (
            lambda: SensorEffects(vignetting=1.5),
            "vignetting and exposure_swing must be between 0 and 1",
        ),
        (lambda: SensorEffects(read_noise=-1.0), "read_noise, .* must not be negative"),
        (
            lambda: SensorEffects(shutter_ms=0.0),
            "shutter times and exposure_target must be positive",
        ),
        (lambda: SensorEffects(gain_max=0.5), "gain_max at least 1"),
        (lambda: SensorEffects(camera_difference=2.0), "camera_difference must be between 0 and 1"),
        (lambda: SensorEffects(glare=-1.0), "glare not negative"),
        (lambda: CalibrationErrors(rotation_deg=-0.1), "finite and not negative"),
        (lambda: plan(Scenario(conditions=Conditions(people=101))), "101 people"),
    ],
)
def test_rejects_invalid_arguments(make: Callable[[], object], message: str) -> None:
    with pytest.raises(VioError, match=message):
        make()
