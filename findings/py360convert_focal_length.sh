#!/usr/bin/env bash
# py360convert 1.0.4: perspective images of `e2p` have their field of view from the centre of the first pixel to the centre of the last: a focal length of (width - 1) / (2 tan(fov / 2)) px, not of
# width / (2 tan(fov / 2)): 0.16 % shorter at 640 px and 90 degrees, 0.8 % at 128. Cube faces of `e2c` are made so as well: their border pixels are there twice.
# Guessed: the field of view of an image is that of its outer border, as renderers have it; six faces of a cube divide the sphere.
# Matters here: a VIO takes perspective views of a 360-degree camera with a focal length from their field of view. Rays at the border are half a pixel off, and all depths of a stereo pair of such
# views are 0.16 % too far (0.8 % at 128 px): a scale that no residual shows.
# Source: e2p and e2c in https://github.com/sunset1995/py360convert, whose text says "Field of view" alone; this run.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m pip --quiet --disable-pip-version-check install --target "$folder/packages" py360convert==1.0.4 numpy==2.4.6 scipy==1.17.1 opencv-python-headless==4.14.0.94
PYTHONPATH="$folder/packages" python3 - <<'PYTHON'
from importlib.metadata import version

import numpy as np
import py360convert

ROWS, COLUMNS = 1000, 2000
azimuth = ((np.arange(COLUMNS) + 0.5) / COLUMNS - 0.5) * 2 * np.pi
elevation = (0.5 - (np.arange(ROWS) + 0.5) / ROWS) * np.pi
level = np.cos(elevation)[:, None]
# a panorama whose colour is the direction: x right, y down, z ahead
panorama = np.stack([level * np.sin(azimuth), np.repeat(-np.sin(elevation)[:, None], COLUMNS, 1), level * np.cos(azimuth)], axis=-1)


def focal(view):
    """Return the focal length and the principal point along u, px; the first pixel's centre is 0."""
    width = view.shape[1]
    slope = view[width // 2, :, 0] / view[width // 2, :, 2]
    gradient, start = np.polyfit(np.arange(width), slope, 1)
    assert np.abs(gradient * np.arange(width) + start - slope).max() < 2e-3
    return 1 / gradient, -start / gradient


print("py360convert", version("py360convert"))
for width in (640, 128):
    found, centre = focal(py360convert.e2p(panorama, 90, u_deg=0, v_deg=0, out_hw=(width, width)))
    face, _ = focal(py360convert.e2c(panorama, face_w=width, cube_format="dict")["F"])
    print(f"{width} px, 90 degrees: e2p has f = {found:.3f} px, principal point {centre:.2f}; the cube's face f = {face:.3f} px; width / 2 tan(45) = {width / 2}")
    assert abs(found - (width - 1) / 2) < 0.02 and abs(centre - (width - 1) / 2) < 0.02
    print(f"   depth of a point 10 m away, by width / 2 tan(45): {10 * (width / 2) / found:.3f} m")
    assert abs(face - (width - 1) / 2) < 0.02
PYTHON
