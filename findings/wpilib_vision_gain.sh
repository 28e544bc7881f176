#!/usr/bin/env bash
# robotpy-wpimath 2026.2.2 (WPILib): a pose given to `addVisionMeasurement` counts by the ratio of standard deviations, not of variances, and anew each time: with 0.1 m for the
# robot's state and 1 m for the camera, a pose that is 1 m beside moves a robot at rest by 9 cm; one fusion of these two moves it by 1 cm. After 50 poses in a second it is 99 cm
# away, after 5 of them 38 cm. No variance is kept, so equal poses are never known, and the odometry's certainty does not grow while the robot stands: the rate of the poses sets
# their weight.
# Guessed: standard deviations in metres, and "Kalman filter" in its text, make a Kalman filter: gains of variances, which fall as poses come in; hardly any move for a camera of
# ten times the deviation.
# Matters here: robots of this library take their poses from a stereo camera or a headset at 30 to 120 Hz. Covariances of a VIO given to it as they are let every drift and jump
# of the VIO through within a second. For the weight of one fusion in each pose, the deviation s must be given as s^2 / (deviation of the state); and errors of a VIO are not
# independent from frame to frame.
# Source: PoseEstimator.h in the wheel robotpy-native-wpimath (the gain of a continuous filter in steady state, q / (q + sqrt(q r))); help(addVisionMeasurement); this run.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m pip --quiet --disable-pip-version-check install --target "$folder/packages" robotpy-wpimath==2026.2.2
PYTHONPATH="$folder/packages" python3 - <<'PYTHON'
from importlib.metadata import version

from wpimath.estimator import DifferentialDrivePoseEstimator
from wpimath.geometry import Pose2d, Rotation2d
from wpimath.kinematics import DifferentialDriveKinematics

BESIDE = Pose2d(1, 0, 0)  # what the camera states while odometry and gyro stand still at 0


def position(state_m, camera_m, count):
    """Estimated x after `count` poses in one second."""
    drive = DifferentialDriveKinematics(0.6)
    estimator = DifferentialDrivePoseEstimator(
        drive, Rotation2d(), 0.0, 0.0, Pose2d(), (state_m,) * 3, (camera_m,) * 3
    )
    for step in range(count):
        time_s = step / count
        estimator.updateWithTime(time_s, Rotation2d(), 0.0, 0.0)
        estimator.addVisionMeasurement(BESIDE, time_s)
    return estimator.getEstimatedPosition().X()


print("robotpy-wpimath", version("robotpy-wpimath"))
for state_m, camera_m in ((0.1, 0.1), (0.1, 1.0), (0.01, 1.0)):
    one, five, fifty = (position(state_m, camera_m, count) for count in (1, 5, 50))
    fused = state_m**2 / (state_m**2 + camera_m**2)
    print(f"state {state_m:g} m, camera {camera_m:g} m: 1 pose {one:.4f} m, 5 poses {five:.3f}, 50 poses {fifty:.3f}; one fusion {fused:.4f} m,",
          f"50 independent poses {1 / (1 + camera_m**2 / state_m**2 / 50):.3f} m")
    gain = state_m / (state_m + camera_m)
    for count, x in ((1, one), (5, five), (50, fifty)):
        assert abs(x - (1 - (1 - gain) ** count)) < 1e-9, (count, x)
given = 1.0**2 / 0.1
print(f"state 0.1 m, camera given as {given:g} m: 1 pose {position(0.1, given, 1):.4f} m")
assert abs(position(0.1, given, 1) - 0.0099) < 1e-4
PYTHON
