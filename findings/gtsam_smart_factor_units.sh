#!/usr/bin/env bash
# gtsam 4.3.0: a smart projection factor judges by a tolerance of 1, in the unit of the calibration, whether its point can be triangulated.
# With pixels that is small. In normalised coordinates (a focal length of 1, sigma scaled alike) it takes points 3 to 6 m away, seen along
# a path of 1.5 m, for points at infinity: their error is 0, and the parallax is put into rotation. From exact poses and exact
# measurements ISAM2 and Gauss-Newton turn the cameras by 6, 13 and 19 degrees; Levenberg-Marquardt ends at once, as the error is 0.
# Guessed: units cancel once the noise has the same unit.
# Matters here: rays of wide lenses, and tracks of any front end divided by the focal length, are given to gtsam like this.
# `setRankTolerance(1e-9)` makes both units the same.
# Source: gtsam.SmartProjectionParams().print(); this run.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m pip --quiet --disable-pip-version-check install --target "$folder/packages" gtsam==4.3.0 numpy==2.4.6
PYTHONPATH="$folder/packages" python3 - <<'PYTHON'
from importlib.metadata import version

import gtsam
import numpy as np
from gtsam import Cal3_S2, PinholeCameraCal3_S2, Point3, Pose3, Rot3
from gtsam.noiseModel import Isotropic

PIXELS = 460.0  # focal length; a sigma of one pixel in both units
POSES = [Pose3(Rot3(), Point3(0.5 * k, 0.0, 0.0)) for k in range(4)]
POINTS = np.random.default_rng(0).uniform([-1.5, -1.0, 3.0], [2.0, 1.0, 6.0], (20, 3))


def gauss_newton(graph, values):
    return gtsam.GaussNewtonOptimizer(graph, values).optimize()


def levenberg_marquardt(graph, values):
    return gtsam.LevenbergMarquardtOptimizer(graph, values).optimize()


def isam2(graph, values):
    smoother = gtsam.ISAM2(gtsam.ISAM2Params())
    smoother.update(graph, values)
    for _ in range(5):
        smoother.update()
    return smoother.calculateEstimate()


def turned_deg(optimise, focal, tolerance=None):
    """Return by how much an optimiser turns each camera away from the truth, from which it starts."""
    calibration = Cal3_S2(focal, focal, 0.0, 0.0, 0.0)
    parameters = gtsam.SmartProjectionParams()
    if tolerance is not None:
        parameters.setRankTolerance(tolerance)
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    for key, pose in enumerate(POSES):
        values.insert(key, pose)
        graph.add(gtsam.PriorFactorPose3(key, pose, Isotropic.Sigma(6, 0.1 if key else 1e-3)))
    for point in POINTS:
        factor = gtsam.SmartProjectionPoseFactorCal3_S2(Isotropic.Sigma(2, focal / PIXELS), calibration, parameters)
        for key, pose in enumerate(POSES):
            factor.add(PinholeCameraCal3_S2(pose, calibration).project(Point3(*point)), key)
        graph.add(factor)
    assert graph.error(values) < 1e-6
    found = optimise(graph, values)
    return [round(float(np.degrees(np.linalg.norm(Rot3.Logmap(found.atPose3(key).rotation())))), 1) for key in range(len(POSES))]


print("gtsam", version("gtsam"), "degrees by which exact poses are turned:")
for optimise in (isam2, gauss_newton, levenberg_marquardt):
    pixels, rays, tolerant = turned_deg(optimise, PIXELS), turned_deg(optimise, 1.0), turned_deg(optimise, 1.0, 1e-9)
    print(f"  {optimise.__name__}: pixels {pixels}, normalised {rays}, with a tolerance of 1e-9 {tolerant}")
    assert pixels == tolerant == [0.0] * len(POSES)
    assert rays == ([0.0] * len(POSES) if optimise is levenberg_marquardt else [0.0, 6.4, 12.9, 19.3])
PYTHON
