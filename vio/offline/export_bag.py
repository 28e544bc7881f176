"""Export of a run as a ROS 2 bag of poses and points, for RViz and Foxglove."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

from vio.datasets.bags.writer import Storage, bag_writer
from vio.files.trajectories import read_trajectory
from vio.geometry.lie import se3_inverse
from vio.interop.ros import to_fixed_axes_covariance
from vio.records import Trajectory
from vio.runs.finished import FinishedRun, read_finished_run

POSE = "/vio/pose"
PATH = "/vio/path"
REFERENCE = "/reference/path"
POINTS = "/vio/landmarks"
_WORLD = "world"


@dataclass(frozen=True, slots=True)
class ExportedBag:
    """Counts of the written data."""

    poses: int
    points: int
    reference_poses: int


def export_bag(run: Path, out: Path, storage: Storage) -> ExportedBag:
    """Write a run as a bag: /tf and /vio/pose with covariance at every frame; path, landmarks and
    ground truth at once.

    The frames are world, imu and cam0 (without an IMU world and cam0). The ground truth is aligned
    to the run's world. What is written at once is stamped with the first frame, and kept for
    subscribers that come late.

    Args:
        run: folder of `vio run`; an unfinished one's may be given too.
        out: an existing folder without a bag.
        storage: "rosbag2" (SQLite) or "mcap".

    Raises:
        DataError: it is no run's folder, a file in it is damaged, or the bag cannot be written.
        MissingDependencyError: bags need the package rosbags.
    """
    finished = read_finished_run(run)
    trajectory = finished.trajectory
    assert trajectory.times_ns is not None
    times = trajectory.times_ns.tolist()
    body = trajectory.body
    reference = _reference(finished)
    with bag_writer(out, storage, latched=(PATH, REFERENCE, POINTS)) as bag:
        if body == "imu":
            bag.static_transforms(times[0], [("imu", "cam0", se3_inverse(finished.T_cam0_body))])
        bag.path(PATH, _WORLD, trajectory, times[0])
        bag.points(POINTS, _WORLD, times[0], finished.points, finished.point_sigmas)
        if reference is not None:
            bag.path(REFERENCE, _WORLD, reference, times[0])
        covariances = finished.estimates["covariance"]
        for time_ns, T, covariance in zip(times, trajectory.T_world_body, covariances, strict=True):
            bag.transform(_WORLD, body, time_ns, T)
            bag.pose(POSE, _WORLD, time_ns, T, to_fixed_axes_covariance(T, covariance))
    return ExportedBag(len(times), len(finished.points), 0 if reference is None else len(reference))


def _reference(run: FinishedRun) -> Trajectory | None:
    """Return the ground truth in the run's world.

    None: there is none with times, or it was not compared.
    """
    path = run.folder / "reference.tum"
    if run.evaluation is None or not path.is_file():
        return None
    truth = read_trajectory(path)
    T_cam0_body = run.T_cam0_body
    truth = (
        truth.in_imu(T_cam0_body) if run.trajectory.body == "imu" else truth.in_cam0(T_cam0_body)
    )
    return replace(truth, T_world_body=se3_inverse(run.evaluation.T_ref_est) @ truth.T_world_body)
