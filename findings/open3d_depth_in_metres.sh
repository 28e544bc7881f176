#!/usr/bin/env bash
# Open3D 0.20.0: `PointCloud.create_from_depth_image` divides a depth image of floats, which is in metres, by `depth_scale`, 1000 by default: the cloud is a
# thousand times too small. Up to 0.19.0 it left floats as they are. Within Open3D, `ScalableTSDFVolume.integrate` still counts on that: in 0.20.0 its volume stays empty, for
# depths that came as floats or as uint16, without a word, where 0.19.0 has a surface. `create_from_rgbd_image` of the very same image, and `UniformTSDFVolume`, remain right.
# Guessed: a depth in metres stays one from release to release; at least a map without a single point is an error.
# Matters here: depth images from a stereo's disparities are floats in metres. Clouds at the poses of a VIO become 1/1000 of their size around each camera, so the map looks like the
# path; maps by the TSDF volume of Open3D's own tutorials are gone. With 0.20.0, pass `depth_scale=1.0`, or go by `create_from_rgbd_image` or the tensor classes.
# Source: https://github.com/isl-org/Open3D/issues/5147 (asks for the scale, 2022); Open3D's documentation of depth_scale, the same in both; this run.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
cd "$folder"
if ! python3 -c 'import ctypes; ctypes.CDLL("libusb-1.0.so.0")' 2>/dev/null; then # the wheel wants Debian's
    apt-get download -qq libusb-1.0-0 2>/dev/null && dpkg -x libusb-1.0-0_*.deb usb
    export LD_LIBRARY_PATH="$folder/usb/usr/lib/x86_64-linux-gnu:$folder/usb/lib/x86_64-linux-gnu"
fi
python3 -m pip --quiet --disable-pip-version-check install --target "$folder/0.19.0" open3d-cpu==0.19.0 numpy==2.4.6
python3 -m pip --quiet --disable-pip-version-check install --target "$folder/0.20.0" --no-deps open3d-cpu==0.20.0
for release in 0.19.0 0.20.0; do
    PYTHONPATH="$folder/$release:$folder/0.19.0" python3 - <<'PYTHON'
import numpy as np
import open3d as o3d

clouds, volumes = o3d.geometry.PointCloud, o3d.pipelines.integration
camera = o3d.camera.PinholeCameraIntrinsic(160, 120, 150.0, 150.0, 79.5, 59.5)
u, v = np.meshgrid(np.arange(160), np.arange(120))
metres = 2.0 + 0.002 * u + 0.001 * v  # a wall, not square to the camera
colour = o3d.geometry.Image(np.full((120, 160, 3), 128, np.uint8))
new = o3d.__version__ != "0.19.0"
print("Open3D", o3d.__version__)
for kind, raw, scale in (("float", metres.astype(np.float32), 1.0), ("uint16", (1000 * metres).astype(np.uint16), 1000.0)):
    rgbd = o3d.geometry.RGBDImage.create_from_color_and_depth(
        colour, o3d.geometry.Image(raw), depth_scale=scale, depth_trunc=5.0, convert_rgb_to_intensity=False
    )
    depth = np.asarray(rgbd.depth)  # metres of float32 now, whatever it was
    cloud, stated, coloured = (
        np.asarray(made.points)[:, 2].mean()
        for made in (
            clouds.create_from_depth_image(rgbd.depth, camera),
            clouds.create_from_depth_image(rgbd.depth, camera, depth_scale=1.0),
            clouds.create_from_rgbd_image(rgbd, camera),
        )
    )
    rgb8 = volumes.TSDFVolumeColorType.RGB8
    scalable = volumes.ScalableTSDFVolume(voxel_length=0.02, sdf_trunc=0.08, color_type=rgb8)
    uniform = volumes.UniformTSDFVolume(
        length=4.0, resolution=200, sdf_trunc=0.08, color_type=rgb8, origin=np.array([[-2.0], [-2.0], [0.0]])
    )
    for volume in (scalable, uniform):
        volume.integrate(rgbd, camera, np.eye(4))
    count, other = (len(volume.extract_triangle_mesh().vertices) for volume in (scalable, uniform))
    print(f"{kind}: depth {depth.mean():.3f} m; cloud {cloud:.5f} m, with depth_scale=1 {stated:.3f} m, of the RGBD image {coloured:.3f} m")
    print(f"    vertices of ScalableTSDFVolume {count}, of UniformTSDFVolume {other}")
    assert abs(depth.mean() - metres.mean()) < 1e-3 and depth.dtype == np.float32
    assert abs(cloud - metres.mean() / (1000 if new else 1)) < 1e-3 * cloud
    assert abs(stated - metres.mean()) < 1e-3 and abs(coloured - metres.mean()) < 1e-3
    assert (count == 0) == new and other > 5000
PYTHON
done
