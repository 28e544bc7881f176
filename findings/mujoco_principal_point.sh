#!/usr/bin/env bash
# MuJoCo 4.0.0: `principalpixel="20 10"` of a camera moves its image by 20 px to the left and 10 up: the principal point of what is rendered is (W/2 - 20, H/2 - 10). The sensor
# `camprojection` of the same camera leaves the offset out altogether, so its pixels are 20 and 10 px beside the image's. Up to 3.5.0 the image moved down instead.
# Guessed: the principal point lies at the image's centre plus the offset, as cx and cy do; and a camera projects points to where it shows them.
# Matters here: a real camera's calibration put into MuJoCo (cx - W/2, cy - H/2) has twice the offset as an error: 40 px here, 4 degrees of direction, and in a stereo rig whose two
# cameras differ in cx, a disparity that is not there, so another scale at every depth. Centred cameras, as in the tutorials, show nothing. Negate both values.
# Source: https://github.com/google-deepmind/mujoco/pull/3150 (mended the sign of y in 3.6.0); https://mujoco.readthedocs.io/en/stable/XMLreference.html; this run.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m pip --quiet --disable-pip-version-check install --no-compile --target "$folder/4.0.0" mujoco==4.0.0 numpy==2.4.6
python3 -m pip --quiet --disable-pip-version-check install --no-compile --no-deps --target "$folder/3.5.0" mujoco==3.5.0
for release in 4.0.0 3.5.0; do
    PYTHONPATH="$folder/$release:$folder/4.0.0" MUJOCO_GL=egl python3 - <<'PYTHON'
import mujoco
import numpy as np

W, H, F = 640, 480, 600.0
POINT = np.array((0.2, -0.1, 2.0))  # in the camera's frame: x right, y down, z forward


def seen(offset):
    """Return where a small sphere is in the image, px from (0, 0) at the corner, and where `camprojection` has it."""
    model = mujoco.MjModel.from_xml_string(f"""
<mujoco>
  <visual><global offwidth="{W}" offheight="{H}"/></visual>
  <worldbody>
    <camera name="camera" resolution="{W} {H}" sensorsize="0.0064 0.0048" focalpixel="{F} {F}" principalpixel="{offset[0]} {offset[1]}"/>
    <geom type="sphere" size="0.05" pos="{POINT[0]} {-POINT[1]} {-POINT[2]}"/>
    <site name="point" pos="{POINT[0]} {-POINT[1]} {-POINT[2]}"/>
  </worldbody>
  <sensor><camprojection camera="camera" site="point"/></sensor>
</mujoco>""")
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    with mujoco.Renderer(model, H, W) as renderer:
        renderer.enable_segmentation_rendering()
        renderer.update_scene(data, camera="camera")
        v, u = np.nonzero(renderer.render()[..., 0] == 0)
    return np.array((u.mean(), v.mean())) + 0.5, data.sensordata.copy()


print("MuJoCo", mujoco.__version__)
centred = F * POINT[:2] / POINT[2] + (W / 2, H / 2)
for offset in ((0, 0), (20, 10), (-7, 30)):
    image, sensor = seen(offset)
    print(f"principalpixel {offset}: expected {centred + offset}, rendered {image.round(1)}, camprojection {sensor.round(1)}")
    assert np.allclose(image, centred + np.array(offset) * (-1, 1 if mujoco.__version__ == "3.5.0" else -1), atol=0.6)
    assert np.allclose(sensor, centred, atol=0.01)
PYTHON
done
