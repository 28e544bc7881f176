"""`vio export rosbag2|mcap`: a run as a bag of poses and points."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from tests.commands import json_of, refused
from vio.cli import main
from vio.geometry.lie import rotation_from_quat_xyzw, se3_exp, se3_inverse, so3_log
from vio.interop.ros import to_fixed_axes_covariance
from vio.runs.finished import read_finished_run

rosbags = pytest.importorskip("rosbags", reason="needs rosbags")


@pytest.fixture(scope="module")
def finished(flight: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("export") / "run"
    assert main(["run", str(flight), "--out", str(out), "--quiet"]) == 0
    return out


@pytest.mark.parametrize("form", ["rosbag2", "mcap"])
def test_the_bag_holds_the_run(
    form: str, finished: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    from rosbags.highlevel import AnyReader

    facts = json_of(capsys, "export", form, finished, "--out", tmp_path / "bag")
    run = read_finished_run(finished)
    messages: dict[str, list[tuple[int, object]]] = {}
    with AnyReader([tmp_path / "bag"]) as reader:
        for connection, time_ns, data in reader.messages():
            messages.setdefault(connection.topic, []).append(
                (time_ns, reader.deserialize(data, connection.msgtype))
            )
        late = {c.topic for c in reader.connections if "TRANSIENT_LOCAL" in str(c.ext)}
    assert {topic: len(found) for topic, found in messages.items()} == {
        "/tf_static": 1,
        "/tf": 16,
        "/vio/path": 1,
        "/vio/pose": 16,
        "/vio/landmarks": 1,
        "/reference/path": 1,
    }
    assert late == {"/tf_static", "/vio/path", "/vio/landmarks", "/reference/path"}
    assert [time for time, _ in messages["/vio/pose"]] == run.estimates["time_ns"].tolist()
    for k, (_, message) in enumerate(messages["/vio/pose"]):
        p, q = message.pose.pose.position, message.pose.pose.orientation  # type: ignore[attr-defined]
        np.testing.assert_array_equal([p.x, p.y, p.z], run.trajectory.positions[k])
        R = rotation_from_quat_xyzw(np.array([q.x, q.y, q.z, q.w]))
        np.testing.assert_allclose(R, run.trajectory.T_world_body[k, :3, :3], atol=1e-14)
    cloud = messages["/vio/landmarks"][0][1]
    points = np.frombuffer(cloud.data.tobytes(), "<f4").reshape(-1, 4)  # type: ignore[attr-defined]
    np.testing.assert_array_equal(points[:, :3], run.points.astype(np.float32))
    assert facts["points"] == len(points) > 0
    path, truth = (
        np.array(
            [
                [p.pose.position.x, p.pose.position.y, p.pose.position.z]
                for p in messages[topic][0][1].poses
            ]
        )  # type: ignore[attr-defined]
        for topic in ("/vio/path", "/reference/path")
    )
    distances = np.linalg.norm(truth[:, None] - path[None], axis=2).min(axis=0)
    assert np.ptp(path, axis=0).max() > 0.05
    assert distances.max() < 0.01  # the ground truth lies on the path, in the world of the run


def test_covariances_are_those_of_ros() -> None:
    """PoseWithCovariance: of x y z and of rotations about the axes of the header's frame."""
    T_body_world = se3_exp([1.0, -2.0, 0.5, 0.4, -0.7, 1.1])
    T, h = se3_inverse(T_body_world), 1e-6
    columns = []
    for axis in range(6):
        moved = se3_inverse(se3_exp(h * np.eye(6)[axis]) @ T_body_world)
        columns.append(
            np.concatenate([moved[:3, 3] - T[:3, 3], so3_log(moved[:3, :3] @ T[:3, :3].T)]) / h
        )
    ros_D_xi = np.array(columns).T
    root = np.random.default_rng(0).normal(size=(6, 6))
    expected = ros_D_xi @ root @ root.T @ ros_D_xi.T
    np.testing.assert_allclose(to_fixed_axes_covariance(T, root @ root.T), expected, atol=1e-4)


def test_options_of_another_form_are_refused(
    finished: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert "are for colmap; leave them out" in refused(
        capsys, "export", "mcap", finished, "--refined"
    )
