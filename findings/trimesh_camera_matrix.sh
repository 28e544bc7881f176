#!/usr/bin/env bash
# trimesh 5.2.0: a calibrated camera matrix given to `Camera.K` changes the image: its resolution becomes twice the principal point, in whole pixels. With KITTI 00's (cx 607.2, cy 185.2) an image of
# 1241 x 376 px has rays for 1214 x 370, so 27 columns and 6 rows have none, and `K` comes back with 607 and 185. Rows of the pixels that `camera_rays` returns count from the bottom.
# Guessed: K is a property to be read and set: the image stays as large as it is, and rays go through its pixels, (0, 0) at the top left.
# Matters here: depth images of a scanned model, as truth for stereo or a map, are cropped. With `resolution` set afterwards the principal point is the image's middle: rays pass 13 px beside their
# pixels. Centred cameras show nothing. Compute rays from K yourself.
# Source: trimesh/scene/cameras.py, the setter of K ("set resolution from matrix") and ray_pixel_coords; this run.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m pip --quiet --disable-pip-version-check install --target "$folder/packages" trimesh==5.2.0 numpy==2.4.6
PYTHONPATH="$folder/packages" python3 - <<'PYTHON'
import numpy as np
import trimesh

SIZE = 1241, 376
K = np.array([[718.856, 0, 607.1928], [0, 718.856, 185.2157], [0, 0, 1]])


def rays(camera):
    """Return slopes x/z right and y/z down of all rays, and the pixel (u, v) of each."""
    scene = trimesh.Scene()
    scene.camera, scene.camera_transform = camera, np.eye(4)
    _, directions, pixels = scene.camera_rays()
    return directions[:, :2] / directions[:, 2:] * (-1, 1), pixels


print("trimesh", trimesh.__version__)
camera = trimesh.scene.Camera(resolution=SIZE, fov=(90, 40))
camera.K = K
slopes, pixels = rays(camera)
print(f"image {SIZE}, principal point {K[:2, 2]}: resolution {camera.resolution}, K's principal point {camera.K[:2, 2]}; {len(slopes)} rays for {np.prod(SIZE)} pixels")
assert tuple(camera.resolution) == (1214, 370) and len(slopes) == 1214 * 370
assert np.array_equal(camera.K[:2, 2], (607, 185))

top = slopes[:, 1] < -0.2  # rays that go up
print(f"rays upwards have pixels with v from {pixels[top, 1].min()} to {pixels[top, 1].max()} of {camera.resolution[1]}")
assert pixels[top, 1].min() > camera.resolution[1] / 2

camera.resolution = SIZE
slopes, pixels = rays(camera)
u, v = pixels[:, 0], SIZE[1] - 1 - pixels[:, 1]
off = slopes * K[0, 0] + K[:2, 2] - np.stack([u, v], axis=1)
print(f"resolution set to {SIZE} afterwards: principal point {camera.K[:2, 2]}; rays pass {off.mean(axis=0).round(2)} px beside their pixels, +-{off.std(axis=0).max():.2f}")
assert np.allclose(off, K[:2, 2] - np.array(SIZE) / 2 + 0.5, atol=0.01)

centred = trimesh.scene.Camera(resolution=(640, 480), focal=(500, 500))
before = centred.K
centred.K = before
print(f"a centred camera: {centred.resolution}, K unchanged: {np.array_equal(centred.K, before)}")
assert tuple(centred.resolution) == (640, 480) and np.array_equal(centred.K, before)
PYTHON
