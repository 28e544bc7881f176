#!/usr/bin/env bash
# pycolmap 4.2.1: `BACovariance.get_cam_cov_from_world` states rotations as half angles (the tangent in which Ceres moves a
# quaternion), so that their variances are four times smaller than those of the angles.
# Guessed: radians of the rotation vector, as its own Rigid3d functions take them.
# Matters here: a covariance of COLMAP beside ours, or in a pose graph, is four times too sure of the rotation;
# vio.interop.pycolmap converts it.
# Source: pycolmap.estimate_ba_covariance against 400 adjustments to noisy pixels; this run.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m pip --quiet --disable-pip-version-check install --target "$folder/packages" pycolmap==4.2.1 numpy==2.4.6
PYTHONPATH="$folder/packages" python3 - <<'PYTHON'
import numpy as np
import pycolmap

rng = np.random.default_rng(3)
points = rng.uniform([-2, -2, 3], [2, 2, 8], size=(60, 3))
camera = pycolmap.Camera(camera_id=1, model="PINHOLE", width=640, height=480, params=[400, 400, 320, 240])
clean = np.array([camera.img_from_cam(point) for point in points])


def adjusted():
    model = pycolmap.Reconstruction()
    model.add_camera(camera)
    rig = pycolmap.Rig(rig_id=1)
    rig.add_ref_sensor(camera.sensor_id)
    model.add_rig(rig)
    noisy = clean + rng.normal(size=clean.shape)  # the unit of COLMAP's residuals
    for k in (1, 2):  # the second one is held; a track needs two images
        seen = pycolmap.Point2DList([pycolmap.Point2D(uv) for uv in noisy])
        image = pycolmap.Image(name=str(k), camera_id=1, image_id=k, points2D=seen)
        frame = pycolmap.Frame(frame_id=k, rig_id=1)
        image.frame_id = k
        frame.add_data_id(image.data_id)
        frame.rig_from_world = pycolmap.Rigid3d()
        model.add_frame(frame)
        model.add_image(image)
        model.register_frame(k)
    for k, point in enumerate(points):
        track = pycolmap.Track([pycolmap.TrackElement(1, k), pycolmap.TrackElement(2, k)])
        model.add_point3D(point, track, np.zeros(3, np.uint8))
    options = pycolmap.BundleAdjustmentOptions(
        print_summary=False, refine_focal_length=False, refine_principal_point=False, refine_extra_params=False
    )
    config = pycolmap.BundleAdjustmentConfig()
    config.add_image(1)
    config.add_image(2)
    config.set_constant_rig_from_world_pose(2)
    for name in model.points3D:
        config.add_constant_point(name)
    adjuster = pycolmap.create_default_ceres_bundle_adjuster(options, config, model)
    adjuster.solve()
    return model, adjuster


turns = []
for _ in range(400):
    model, adjuster = adjusted()
    q = model.images[1].cam_from_world().rotation.quat  # x y z w
    turns.append(2.0 * q[:3] * np.sign(q[3]))
options = pycolmap.BACovarianceOptions(params=pycolmap.BACovarianceOptionsParams.POSES)
stated = pycolmap.estimate_ba_covariance(options, model, adjuster).get_cam_cov_from_world(1)
ratios = np.var(turns, axis=0) / np.diag(stated)[:3]
print("pycolmap", pycolmap.__version__, "variance of the angles over the stated ones:", ratios.round(2))
assert (ratios > 3.0).all()
assert (ratios < 5.2).all()
PYTHON
