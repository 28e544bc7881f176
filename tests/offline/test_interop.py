"""`vio.interop`: each system's own functions agree with ours on what is converted, and a converted
covariance predicts a Monte Carlo in that system's own terms.
"""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.stats import chi2

from vio.cameras.rig import Rig
from vio.errors import CalibrationError, DataError, MissingDependencyError
from vio.geometry.distortion import CameraModel, project_point
from vio.geometry.lie import (
    FloatArray,
    quat_xyzw_from_rotation,
    se3_exp,
    se3_inverse,
    so3_log,
    transform_points,
)
from vio.geometry.stereo import StereoCamera, project
from vio.interop import loading
from vio.records import Landmarks, Trajectory

T = se3_exp([1.0, -2.0, 3.0, 0.4, -1.1, 0.8])
SAMPLES = 5000
CAMERA = StereoCamera(
    fu=420.0, fv=410.0, cu=319.0, cv=241.5, baseline_m=0.12, width=640, height=480
)
POINTS = np.array([[0.3, -0.2, 4.0], [-1.0, 0.8, 6.0], [0.0, 0.0, 2.5]])


def _spread(seed: int = 0, size: int = 6, sigma: float = 0.01) -> FloatArray:
    """Return a covariance whose axes are correlated and differ in size."""
    A = np.random.default_rng(seed).normal(size=(size, size)) * np.linspace(1.0, 3.0, size)
    return sigma**2 / size * (A @ A.T)


COVARIANCE = _spread()


def _samples(count: int = SAMPLES) -> FloatArray:
    """Return poses (count, 4, 4) around T, spread on the body's side by COVARIANCE."""
    xi = np.random.default_rng(1).multivariate_normal(np.zeros(6), COVARIANCE, size=count)
    return T @ se3_exp(xi)


def assert_predicts(stated: FloatArray, errors: FloatArray, tolerance: float = 0.08) -> None:
    """Compare a stated covariance with errors (N, n): whitened by it they must be white."""
    whitened = np.linalg.solve(np.linalg.cholesky(stated), errors.T)
    found = whitened @ whitened.T / errors.shape[0]
    np.testing.assert_allclose(found, np.eye(len(stated)), atol=tolerance)


def _landmarks() -> Landmarks:
    covariance = np.array([_spread(k, 3, 0.1) for k in range(len(POINTS))])
    return Landmarks(np.array([4, 9, 11]), POINTS.copy(), covariance)


def test_nothing_of_another_system_is_imported_before_it_is_called() -> None:
    names = [path.stem for path in (Path(loading.__file__).parent).glob("*.py")]
    modules = [f"vio.interop.{name}" for name in names if name != "__init__"]
    assert len(modules) > 9
    suspects = {"gtsam", "pycolmap", "torch", "kornia", "evo", "foxglove", "rerun", "rosbags"}
    code = f"import sys, {', '.join(modules)}\nprint(*({suspects!r} & set(sys.modules)))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.split() == []


def test_an_absent_package_is_named() -> None:
    with pytest.raises(MissingDependencyError, match="pip install 'no-such>=1'"):
        loading.package("no_such_module_of_ours", "no-such>=1")


def test_a_covariance_of_another_shape_is_refused() -> None:
    from vio.interop import gtsam

    for wrong in (np.eye(3), np.full((6, 6), np.nan)):
        with pytest.raises(DataError, match="finite 6x6 matrix"):
            gtsam.to_pose3_covariance(wrong)


def test_gtsam() -> None:
    theirs = pytest.importorskip("gtsam", reason="gtsam is not installed")
    from vio.interop import gtsam

    pose = gtsam.to_pose3(T)
    np.testing.assert_allclose(gtsam.from_pose3(pose), T, atol=1e-14)
    np.testing.assert_allclose(pose.transformFrom(POINTS[0]), transform_points(T, POINTS[0]))
    x, y, z, w = quat_xyzw_from_rotation(T[:3, :3])
    np.testing.assert_allclose(theirs.Rot3.Quaternion(w, x, y, z).matrix(), T[:3, :3], atol=1e-14)
    np.testing.assert_allclose(pose.rotation().toQuaternion().coeffs(), [x, y, z, w], atol=1e-14)
    stated = gtsam.to_pose3_covariance(COVARIANCE)
    np.testing.assert_array_equal(gtsam.from_pose3_covariance(stated), COVARIANCE)
    errors = [pose.localCoordinates(gtsam.to_pose3(sample)) for sample in _samples()]
    assert_predicts(stated, np.array(errors))
    # A graph of that prior alone has that marginal covariance.
    graph = theirs.NonlinearFactorGraph()
    graph.add(theirs.PriorFactorPose3(0, pose, gtsam.to_noise_model(COVARIANCE)))
    values = theirs.Values()
    values.insert(0, pose)
    marginal = theirs.Marginals(graph, values).marginalCovariance(0)
    np.testing.assert_allclose(gtsam.from_pose3_covariance(marginal), COVARIANCE, rtol=1e-6)


def test_scipy() -> None:
    from vio.interop import scipy

    rotation = scipy.to_rotation(T)
    np.testing.assert_allclose(scipy.from_rotation(rotation), T[:3, :3], atol=1e-15)
    np.testing.assert_allclose(rotation.as_quat(canonical=True), quat_xyzw_from_rotation(T[:3, :3]))
    transform = pytest.importorskip("scipy.spatial.transform")
    if not hasattr(transform, "RigidTransform"):
        pytest.skip("scipy is older than 1.16")
    pose = scipy.to_rigid_transform(T)
    np.testing.assert_allclose(scipy.from_rigid_transform(pose), T, atol=1e-14)
    np.testing.assert_allclose(pose.apply(POINTS), transform_points(T, POINTS))
    stated = scipy.to_exp_coords_covariance(COVARIANCE)
    np.testing.assert_array_equal(scipy.from_exp_coords_covariance(stated), COVARIANCE)
    many = transform.RigidTransform.from_matrix(_samples())
    assert_predicts(stated, (pose.inv() * many).as_exp_coords())


def test_ros_rotates_about_fixed_axes() -> None:
    typesys = pytest.importorskip("rosbags.typesys", reason="rosbags is not installed")
    from scipy.spatial.transform import Rotation

    from vio.interop import ros

    types = typesys.get_typestore(typesys.Stores.ROS2_HUMBLE).types
    message = ros.to_pose_with_covariance(T, COVARIANCE, types)
    pose, covariance = ros.from_pose_with_covariance(message)
    np.testing.assert_allclose(pose, T, atol=1e-14)
    np.testing.assert_allclose(covariance, COVARIANCE, atol=1e-16)
    samples = _samples()
    mean = Rotation.from_quat([getattr(message.pose.orientation, name) for name in "xyzw"])
    turns = Rotation.from_matrix(samples[:, :3, :3]) * mean.inv()  # about axes of the world
    position = [getattr(message.pose.position, name) for name in "xyz"]
    errors = np.hstack([samples[:, :3, 3] - position, turns.as_euler("xyz")])
    stated = message.covariance.reshape(6, 6)
    assert_predicts(stated, errors)
    # About the body's axes it is another covariance, and the test would have seen it.
    of_body = (mean.inv() * Rotation.from_matrix(samples[:, :3, :3])).as_euler("xyz")
    with pytest.raises(AssertionError):
        assert_predicts(stated, np.hstack([errors[:, :3], of_body]))


def test_evo() -> None:
    module = pytest.importorskip("evo.core.trajectory", reason="evo is not installed")
    from evo.core import metrics

    from vio.interop import evo

    start_ns = 1_403_715_523_912_143_104
    samples = _samples(1500)
    times_ns = start_ns + 50_000_000 * np.arange(len(samples))
    theirs = module.PoseTrajectory3D(**evo.to_evo(Trajectory(samples, times_ns, "imu")))
    assert theirs.check()[0]
    back = evo.from_evo(theirs, "imu")
    np.testing.assert_allclose(back.T_world_body, samples, atol=1e-12)
    assert back.times_ns is not None
    assert np.abs(back.times_ns - times_ns).max() <= 128  # half a step of float64 seconds
    # evo's mean squares are the traces of the covariance.
    mean = Trajectory(np.repeat(T[None], len(samples), axis=0), times_ns, "imu")
    other = module.PoseTrajectory3D(**evo.to_evo(mean))
    for relation, block in (
        (metrics.PoseRelation.translation_part, COVARIANCE[:3, :3]),
        (metrics.PoseRelation.rotation_angle_rad, COVARIANCE[3:, 3:]),
    ):
        ape = metrics.APE(relation)
        ape.process_data((other, theirs))
        rmse = ape.get_statistic(metrics.StatisticsType.rmse)
        assert rmse**2 == pytest.approx(np.trace(block), rel=0.1)
    with pytest.raises(DataError, match="without times"):
        evo.to_evo(Trajectory(samples, None, "imu"))


def test_torch() -> None:
    torch = pytest.importorskip("torch", reason="torch is not installed")
    from vio.interop import torch as interop

    landmarks = _landmarks()
    points, covariance = interop.to_points(landmarks)
    assert points.dtype == torch.float64
    back = interop.from_points(landmarks.ids, points, covariance)
    np.testing.assert_array_equal(back.p_world, landmarks.p_world)
    np.testing.assert_array_equal(back.covariance, landmarks.covariance)
    torch.manual_seed(0)
    spread = torch.distributions.MultivariateNormal(points, covariance)
    drawn = spread.sample((SAMPLES,)).numpy() - landmarks.p_world
    for k in range(len(POINTS)):
        assert_predicts(landmarks.covariance[k], drawn[:, k])
    points[0] = 7.0
    assert landmarks.p_world[0, 0] != 7.0


def test_kornia() -> None:
    torch = pytest.importorskip("torch", reason="torch is not installed")
    pytest.importorskip("kornia", reason="kornia is not installed")
    from vio.interop import kornia

    T_cam0_world = se3_exp([0.1, 0.2, -0.1, 0.02, -0.03, 0.05])
    cameras = kornia.to_pinhole_cameras(CAMERA, T_cam0_world)
    pixels = cameras.project(torch.tensor(np.array([POINTS, POINTS]))).numpy()
    ours = project(CAMERA, transform_points(T_cam0_world, POINTS))
    np.testing.assert_allclose(np.hstack(pixels), ours, atol=1e-9)
    camera, pose = kornia.from_pinhole_cameras(cameras)
    np.testing.assert_allclose(pose, T_cam0_world, atol=1e-12)
    assert camera.baseline_m == pytest.approx(CAMERA.baseline_m)
    assert (camera.width, camera.height, camera.K.tolist()) == (640, 480, CAMERA.K.tolist())
    se3 = kornia.to_se3(T)
    np.testing.assert_allclose(kornia.from_se3(se3), T, atol=1e-12)
    xyzw = quat_xyzw_from_rotation(T[:3, :3])
    np.testing.assert_allclose(se3.so3.q.data.detach().numpy()[0], np.roll(xyzw, 1), atol=1e-12)
    many = type(se3).from_matrix(torch.tensor(_samples()))
    inverse = type(se3).from_matrix(torch.tensor(np.repeat(se3_inverse(T)[None], SAMPLES, axis=0)))
    assert_predicts(COVARIANCE, (inverse * many).log().detach().numpy())


def test_kornia_refuses_what_is_no_pair() -> None:
    pytest.importorskip("kornia", reason="kornia is not installed")
    from vio.interop import kornia

    with pytest.raises(CalibrationError, match="known size"):
        kornia.to_pinhole_cameras(StereoCamera(400.0, 400.0, 300.0, 200.0, 0.1), np.eye(4))
    cameras = kornia.to_pinhole_cameras(CAMERA, np.eye(4))
    cameras.extrinsics[1, 1, 3] = 0.01
    with pytest.raises(CalibrationError, match="no rectified pair"):
        kornia.from_pinhole_cameras(cameras)


def test_foxglove() -> None:
    pytest.importorskip("foxglove", reason="foxglove-sdk is not installed")
    pytest.importorskip("google.protobuf", reason="protobuf is not installed")
    from scipy.spatial.transform import Rotation

    from vio.interop import foxglove

    time_ns = 1_403_715_523_912_143_104
    read = _decoded(foxglove.to_frame_transform(time_ns, "world", "imu", T))
    assert read.timestamp.ToNanoseconds() == time_ns
    assert (read.parent_frame_id, read.child_frame_id) == ("world", "imu")
    np.testing.assert_allclose(_pose_of(read.translation, read.rotation), T, atol=1e-14)

    read = _decoded(foxglove.to_odometry(time_ns, "world", "imu", T, COVARIANCE))
    np.testing.assert_allclose(_pose_of(read.pose.position, read.pose.orientation), T, atol=1e-14)
    samples = _samples()
    turns = Rotation.from_matrix(samples[:, :3, :3] @ T[:3, :3].T).as_euler("xyz")
    stated = np.reshape(read.pose_covariance, (6, 6))
    assert_predicts(stated, np.hstack([samples[:, :3, 3] - T[:3, 3], turns]))

    read = _decoded(foxglove.to_camera_calibration(time_ns, "cam0", CAMERA))
    P = np.reshape(read.P, (3, 4))
    pixels = np.column_stack([POINTS, np.ones(3)]) @ P.T
    np.testing.assert_allclose(pixels[:, :2] / pixels[:, 2:], project(CAMERA, POINTS)[:, :2])

    landmarks = _landmarks()
    read = _decoded(foxglove.to_point_cloud(time_ns, "world", landmarks))
    rows = np.frombuffer(read.data, "<f4").reshape(-1, read.point_stride // 4)
    np.testing.assert_allclose(rows[:, :3], POINTS, rtol=1e-6)
    assert [field.name for field in read.fields] == ["x", "y", "z", "sigma"]
    np.testing.assert_allclose(
        3 * rows[:, 3] ** 2, np.trace(landmarks.covariance, axis1=1, axis2=2), rtol=1e-5
    )
    with pytest.raises(CalibrationError, match="known size"):
        foxglove.to_camera_calibration(0, "cam0", StereoCamera(400.0, 400.0, 300.0, 200.0, 0.1))


def _decoded(message: Any) -> Any:
    """Return a message of the SDK as protobuf reads its bytes by its own schema."""
    from google.protobuf import descriptor_pb2, descriptor_pool, message_factory

    schema = message.get_schema()
    pool = descriptor_pool.DescriptorPool()
    for file in descriptor_pb2.FileDescriptorSet.FromString(schema.data).file:
        pool.Add(file)
    kind = message_factory.GetMessageClass(pool.FindMessageTypeByName(schema.name))
    return kind.FromString(message.encode())


def _pose_of(position: Any, q: Any) -> FloatArray:
    from scipy.spatial.transform import Rotation

    out = np.eye(4)
    out[:3, :3] = Rotation.from_quat([q.x, q.y, q.z, q.w]).as_matrix()
    out[:3, 3] = [position.x, position.y, position.z]
    return out


def _values(batch: Any) -> FloatArray:
    return np.array(batch.as_arrow_array().to_pylist()).squeeze(axis=0)


def test_rerun() -> None:
    pytest.importorskip("rerun", reason="rerun-sdk is not installed")
    from scipy.spatial.transform import Rotation

    from vio.interop import rerun

    transform = rerun.to_transform3d(T)
    np.testing.assert_allclose(_values(transform.translation), T[:3, 3], rtol=1e-6)
    columns = _values(transform.mat3x3).reshape(3, 3)
    np.testing.assert_allclose(columns.T, T[:3, :3], atol=1e-6)
    K = _values(rerun.to_pinhole(CAMERA).image_from_camera).reshape(3, 3).T
    pixels = POINTS @ K.T
    theirs = pixels[:, :2] / pixels[:, 2:] - 0.5
    np.testing.assert_allclose(theirs, project(CAMERA, POINTS)[:, :2], rtol=1e-5)
    shown = np.array(rerun.to_points3d(_landmarks()).positions.as_arrow_array().to_pylist())
    np.testing.assert_allclose(shown, POINTS, rtol=1e-6)
    # The share of samples in the ellipsoid is that of a normal distribution.
    ellipsoid = rerun.to_ellipsoid(T, COVARIANCE, sigmas=2.0)
    axes = Rotation.from_quat(_values(ellipsoid.quaternions)).as_matrix()
    offsets = (_samples()[:, :3, 3] - _values(ellipsoid.centers)) @ axes
    inside = ((offsets / _values(ellipsoid.half_sizes)) ** 2).sum(axis=1) < 1.0
    assert inside.mean() == pytest.approx(chi2.cdf(4.0, df=3), abs=0.02)
    with pytest.raises(CalibrationError, match="known size"):
        rerun.to_pinhole(StereoCamera(400.0, 400.0, 300.0, 200.0, 0.1))


LENSES = (
    CameraModel(420.0, 410.0, 319.0, 241.5, 640, 480),
    CameraModel(420.0, 410.0, 319.0, 241.5, 640, 480, "radtan", (-0.2, 0.05, 1e-3, -2e-3)),
    CameraModel(420.0, 410.0, 319.0, 241.5, 640, 480, "radtan", (-0.2, 0.05, 1e-3, -2e-3, 0.01)),
    CameraModel(
        420.0,
        410.0,
        319.0,
        241.5,
        640,
        480,
        "radtan",
        (0.2, 0.05, 1e-3, -2e-3, 0.01, 0.3, 0.1, 0.0),
    ),
    CameraModel(300.0, 300.0, 319.0, 241.5, 640, 480, "equidistant", (0.01, -0.02, 0.003, -4e-4)),
    CameraModel(300.0, 301.0, 319.0, 241.5, 640, 480, "eucm", (0.6, 1.1)),
    CameraModel(300.0, 301.0, 319.0, 241.5, 640, 480, "fov", (0.93,)),
)


@pytest.mark.parametrize("lens", LENSES, ids=lambda lens: f"{lens.model}{len(lens.coefficients)}")
def test_a_lens_of_pycolmap_projects_as_ours(lens: CameraModel) -> None:
    pytest.importorskip("pycolmap", reason="pycolmap is not installed")
    from vio.interop import pycolmap

    camera = pycolmap.to_camera(lens)
    pixels, valid = project_point(lens, POINTS)
    assert valid.all()
    theirs = np.array([camera.img_from_cam(point) for point in POINTS])
    np.testing.assert_allclose(theirs - 0.5, pixels, atol=1e-9)
    back = project_point(pycolmap.from_camera(camera), POINTS)[0]
    np.testing.assert_allclose(back, pixels, atol=1e-9)


def test_pycolmap_refuses_a_lens_that_it_lacks() -> None:
    theirs = pytest.importorskip("pycolmap", reason="pycolmap is not installed")
    from vio.interop import pycolmap

    with pytest.raises(CalibrationError, match="no lens model double_sphere"):
        pycolmap.to_camera(
            CameraModel(300.0, 300.0, 319.0, 241.5, 640, 480, "double_sphere", (-0.2, 0.6))
        )
    camera = theirs.Camera(
        model="DIVISION", width=640, height=480, params=[300, 300, 320, 240, 0.9]
    )
    with pytest.raises(CalibrationError, match="the lens model DIVISION of COLMAP"):
        pycolmap.from_camera(camera)


def test_rigs_and_frames_of_pycolmap() -> None:
    pytest.importorskip("pycolmap", reason="pycolmap is not installed")
    from vio.interop import pycolmap

    np.testing.assert_allclose(pycolmap.from_rigid3d(pycolmap.to_rigid3d(T)), T, atol=1e-14)
    np.testing.assert_allclose(
        np.asarray(pycolmap.to_rigid3d(T) * POINTS), transform_points(T, POINTS)
    )
    T_cam1_cam0 = se3_exp([-0.11, 0.001, 0.002, 0.01, -0.02, 0.003])
    rig, cameras = pycolmap.to_rig(Rig(LENSES[1], LENSES[4], T_cam1_cam0))
    frame = pycolmap.to_frame(T, 3)
    np.testing.assert_allclose(pycolmap.from_frame(frame), T, atol=1e-14)
    back = pycolmap.from_rig(rig, cameras)
    np.testing.assert_allclose(back.T_cam1_cam0, T_cam1_cam0, atol=1e-14)
    assert (back.cam0.model, back.cam1 and back.cam1.model) == ("radtan", "equidistant")
    with pytest.raises(CalibrationError, match="not the reference"):
        pycolmap.from_rig(rig, cameras[::-1])
    alone, one = pycolmap.to_rig(Rig(LENSES[1]))
    assert pycolmap.from_rig(alone, one).cam1 is None


def test_a_covariance_of_pycolmap_predicts_its_adjustments() -> None:
    """What `estimate_ba_covariance` states, as our xi, predicts poses that COLMAP adjusts to noisy
    pixels.
    """
    theirs = pytest.importorskip("pycolmap", reason="pycolmap is not installed")
    from vio.interop import pycolmap

    rng = np.random.default_rng(3)
    points = rng.uniform([-2, -2, 3], [2, 2, 8], size=(60, 3))
    T_cam_world = se3_exp([0.4, -0.3, 1.5, 0.1, -0.2, 0.3])
    p_world = transform_points(se3_inverse(T_cam_world), points)
    pixels = project_point(LENSES[0], points)[0] + 0.5
    stated = None
    errors = []
    for _ in range(250):
        noisy = pixels + rng.normal(size=pixels.shape)  # COLMAP counts in pixels of sigma 1
        model = _two_images(theirs, noisy, p_world, pycolmap.to_rigid3d(T_cam_world))
        adjuster = _adjuster_of_first_pose(theirs, model)
        adjuster.solve()
        if stated is None:
            poses = theirs.BACovarianceOptionsParams.POSES
            options = theirs.BACovarianceOptions(params=poses)
            found = theirs.estimate_ba_covariance(options, model, adjuster)
            stated = found.get_cam_cov_from_world(1)
        T_found = pycolmap.from_rigid3d(model.images[1].cam_from_world())
        errors.append(T_found @ se3_inverse(T_cam_world))
    assert stated is not None
    ours = pycolmap.from_cam_from_world_covariance(T_cam_world, stated)
    np.testing.assert_allclose(
        pycolmap.to_cam_from_world_covariance(T_cam_world, ours), stated, rtol=1e-9, atol=1e-18
    )
    xi = np.array([np.concatenate([E[:3, 3], so3_log(E[:3, :3])]) for E in errors])
    assert_predicts(ours, xi, tolerance=0.4)
    # Read as whole angles it is four times too small for the rotations.
    assert np.mean(xi[:, 3:] ** 2, axis=0) / np.diag(stated)[:3] == pytest.approx(4.0, rel=0.35)


def _two_images(theirs: Any, pixels: FloatArray, p_world: FloatArray, pose: Any) -> Any:
    """Return a model of two images with the same pixels; COLMAP adjusts no track of one image."""
    from vio.interop import pycolmap

    model = theirs.Reconstruction()
    rig, (camera,) = pycolmap.to_rig(Rig(LENSES[0]))
    model.add_camera(camera)
    model.add_rig(rig)
    for name in (1, 2):
        seen = theirs.Point2DList([theirs.Point2D(uv) for uv in pixels])
        image = theirs.Image(name=f"{name}", camera_id=1, image_id=name, points2D=seen)
        frame = theirs.Frame(frame_id=name, rig_id=1)
        image.frame_id = name
        frame.add_data_id(image.data_id)
        frame.rig_from_world = pose
        model.add_frame(frame)
        model.add_image(image)
        model.register_frame(name)
    for k, p in enumerate(p_world):
        track = theirs.Track([theirs.TrackElement(1, k), theirs.TrackElement(2, k)])
        model.add_point3D(p, track, np.zeros(3, np.uint8))
    return model


def _adjuster_of_first_pose(theirs: Any, model: Any) -> Any:
    """Return what adjusts the first image's pose and holds all else."""
    options = theirs.BundleAdjustmentOptions(
        print_summary=False,
        refine_focal_length=False,
        refine_principal_point=False,
        refine_extra_params=False,
    )
    config = theirs.BundleAdjustmentConfig()
    config.add_image(1)
    config.add_image(2)
    config.set_constant_rig_from_world_pose(2)
    for name in model.points3D:
        config.add_constant_point(name)
    return theirs.create_default_ceres_bundle_adjuster(options, config, model)
