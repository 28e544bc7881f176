#!/usr/bin/env bash
# kornia 0.9.0: `remap` with maps of pixels, as cv2.remap takes them, reads up to half a pixel beside them, and half the
# value at the border: by default grid_sample's align_corners is False, while the maps are normalised for True.
# `align_corners=True` reads where the map says.
# Guessed: a map that is the identity returns the image.
# Matters here: images rectified with our maps by kornia are stretched by half a pixel at their borders.
# Source: kornia.geometry.transform.remap; this run.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m pip --quiet --disable-pip-version-check install --target "$folder/packages" torch==2.13.0 kornia==0.9.0
PYTHONPATH="$folder/packages" python3 - <<'PYTHON'
import kornia
import torch

image = torch.arange(64.0).repeat(8, 1)[None, None]
u = torch.tensor([[[0.0, 10.0, 31.5, 53.0, 63.0]]])
v = torch.full_like(u, 4.0)
default = kornia.geometry.transform.remap(image, u, v)[0, 0, 0]
aligned = kornia.geometry.transform.remap(image, u, v, align_corners=True)[0, 0, 0]
print("kornia", kornia.__version__, "asked", u[0, 0].tolist())
print("default", default.tolist(), "align_corners=True", aligned.tolist())
assert torch.allclose(aligned, u[0, 0], atol=1e-4)
assert 0.3 < float((default - u[0, 0])[1:4].abs().max()) < 0.5
assert float(default[4]) < 32.0
PYTHON
