#!/usr/bin/env bash
# OpenCV 4.14.0 and 5.0.0: `StereoSGBM` pulls disparities to whole pixels. Of a plane in parallel to the images at 20.25 px it finds 20.08 px, at 20.75 px 20.98 px: 0.16 and 0.24 px off at most, on average over
# the image, with and without noise, on fine and coarse texture, in each of its modes, with OpenCV's usual penalties (P1 of 8, P2 of 32 times the block) and no preFilterCap. With a preFilterCap of 63
# it is 0.10 and 0.17 px, without penalties up to 0.05 and 0.11 px. `StereoBM`, the simpler matcher, is 0.05 px off at most, and so are both at whole pixels. Half of what the
# sixteenths of a pixel promise is lost.
# Guessed: disparities in sixteenths of a pixel are as good as a fit of a parabola to the costs allows on a plane: a few hundredths, as in StereoBM; noise, not their own grid, limits them.
# Matters here: surfaces of dense maps have steps: a depth of 20.75 px is 1.1 % short, one of 4.75 px 4.6 %, always the same way, so that neither more images at rest nor a filter over the image
# help. The errors of neighbouring pixels are the same, so they look smooth and dense. `vio` matches dense depths with StereoSGBM and counts 0.25 px a match, which covers it.
# Source: stereosgbm.cpp fits the parabola to costs to which neighbours have added P1 at both sides of the best whole disparity, which flattens it, most where costs are small; they are those of Birchfield and Tomasi
# (PAMI 1998), 0 within half a pixel of the true match by design; Shimizu and Okutomi (ICCV 2001) on such errors; this run.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
cat > "$folder/run.py" <<'PYTHON'
import cv2
import numpy as np

HEIGHT, WIDTH = 160, 400
FRACTIONS = (0.0, 0.25, 0.5, 0.75)
v, u = np.mgrid[:HEIGHT, :WIDTH].astype(float)


def pair(disparity, blur, noise):
    """A pair of images of one plane, exact to the rounding of the gray values: sums of waves, moved."""
    rng = np.random.default_rng(1)
    waves = [(*rng.normal(0, 1 / blur, 2), rng.uniform(0, 2 * np.pi)) for _ in range(200)]
    images = []
    for shift in (0.0, disparity):
        image = 128 + 4 * sum(np.cos(a * (u + shift) + b * v + c) for a, b, c in waves)
        images.append((image + rng.normal(0, noise, image.shape)).round().clip(0, 255).astype(np.uint8))
    return images


print("OpenCV", cv2.__version__)
for base, count, blur, noise in ((20, 64, 1.0, 0.0), (20, 64, 2.5, 0.0), (20, 64, 1.5, 3.0), (4, 16, 1.5, 3.0)):
    matchers = {"StereoBM": cv2.StereoBM.create(count, 15)}
    for mode in ("SGBM", "SGBM_3WAY", "HH"):
        number = getattr(cv2, f"STEREO_SGBM_MODE_{mode}")
        matchers[mode] = cv2.StereoSGBM.create(0, count, 5, 8 * 25, 32 * 25, 1, 0, 5, mode=number)
    for name, penalties, cap in (("SGBM, cap 63", (8 * 25, 32 * 25), 63), ("SGBM, no penalties", (0, 0), 0)):
        matchers[name] = cv2.StereoSGBM.create(0, count, 5, *penalties, 1, cap, 5)
    pairs = [pair(base + fraction, blur, noise) for fraction in FRACTIONS]
    for name, matcher in matchers.items():
        errors = []
        for fraction, images in zip(FRACTIONS, pairs, strict=True):
            found = matcher.compute(*images)[20:140, 100:380] / 16
            assert (found > 0).mean() > 0.99
            errors.append(found[found > 0].mean() - base - fraction)
        shown = ", ".join(f"{base + f:.2f}: {e:+.3f}" for f, e in zip(FRACTIONS, errors, strict=True))
        print(f"texture {blur} px, noise {noise:.0f}, {name}: errors in px at", shown)
        if name == "StereoBM":
            assert np.abs(errors).max() < 0.06
        elif name == "SGBM, cap 63":
            assert abs(errors[0]) < 0.05 and -0.13 < errors[1] < -0.06 and 0.12 < errors[3] < 0.20, name
        elif name == "SGBM, no penalties":
            assert abs(errors[0]) < 0.05 and -0.07 < errors[1] < 0.02 and 0.05 < errors[3] < 0.13, name
        else:
            assert abs(errors[0]) < 0.05 and errors[1] < -0.12 and errors[3] > 0.18, name
PYTHON
for version in 4.14.0.94 5.0.0.93; do
    python3 -m pip --quiet --disable-pip-version-check install --no-compile --target "$folder/$version" "opencv-contrib-python-headless==$version" numpy==2.4.6
    PYTHONPATH="$folder/$version" python3 "$folder/run.py"
done
