"""An IMU that begins after the first frames: images alone until then, one world throughout."""

from __future__ import annotations

import numpy as np

from tests.filters.test_msckf import CAMERA, EXACT_RIG, STEP_NS, T_CAM0_IMU, Flight
from vio.evaluation.consistency import nees, nees_bounds
from vio.filters.late_imu import LateImuMsckf
from vio.geometry.lie import se3_inverse, se3_log, transform_points


def test_images_carry_the_frames_before_an_imu_that_begins_late() -> None:
    """The world stays that of the first frame: no jump at the handover, and gravity is known in
    that world.
    """
    flight, settings, rng = Flight(64), EXACT_RIG, np.random.default_rng(3)
    filt = LateImuMsckf(CAMERA, T_CAM0_IMU, settings)
    samples = [x for x in flight.imu(rng, settings, np.zeros(6)) if x.time_ns > 1_480_000_000]
    errors, covariances = [], []
    for k in range(flight.frames):
        while samples and samples[0].time_ns <= k * STEP_NS:
            filt.propagate(samples.pop(0))
        assert filt.update(flight.observe(k, 0.2, rng, 40)).used > 20 or k == 0
        estimate = filt.estimate()
        T_true = se3_inverse(flight.T_world_imu(0)) @ flight.T_world_imu(k)
        errors.append(se3_log(se3_inverse(T_true) @ estimate.T_world_imu))
        covariances.append(estimate.covariance)
    e = np.array(errors)
    assert np.linalg.norm(e[:, :3], axis=1).max() < 0.05
    assert np.linalg.norm(np.diff(e[:, :3], axis=0), axis=1).max() < 0.02
    assert nees(e, np.array(covariances))[1:].mean() < nees_bounds(6, 1)[1]
    gravity = flight.T_world_imu(0)[:3, :3].T @ [0, 0, -9.81]
    assert np.linalg.norm(estimate.gravity_world - gravity) < 9.81 * np.radians(1.5)
    v = flight.T_world_imu(0)[:3, :3].T @ flight.state((flight.frames - 1) * 0.05)[2]
    assert np.linalg.norm(estimate.velocity_world - v) < 0.05
    p_first = transform_points(se3_inverse(flight.T_world_imu(0)), flight.points)
    found = filt.landmarks()
    assert np.median(np.linalg.norm(found.p_world - p_first[found.ids], axis=1)) < 0.1
