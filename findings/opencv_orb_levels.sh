#!/usr/bin/env bash
# OpenCV 4.14.0 and 5.0.0: ORB's key points of coarse levels are beside what they show: a level's pixel is multiplied by the scale
# 1.2^level, while the level was resized about the corner of the image and to whole pixels. Left and above by half of (scale - 1),
# and by the rounded size more towards the right or the bottom: on 1241 x 376 pixels in level 7 by 1.3 px at the left border and
# 2.5 px at the right one.
# Guessed: positions in the full image, off by the level's own rounding only, to both sides.
# Matters here: key points that go into a run as precomputed features jump by as much wherever a point is found in another level in
# the next frame or in the right image; use few levels, or align patches, as our front end `orb` does.
# Source: cv2.ORB on drawn discs against (x + 1/2) size / level's size - 1/2; this run.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
for release in 4.14.0.94 5.0.0.93; do
    python3 -m pip --quiet --disable-pip-version-check install --target "$folder/$release" "opencv-python-headless==$release"
    PYTHONPATH="$folder/$release" python3 - <<'PYTHON'
import cv2
import numpy as np

WIDTH, HEIGHT = 1241, 376
LEVEL, FINE = 7, 0
SUB = 8  # samples a pixel and axis
rng = np.random.default_rng(0)


def disc(at, radius):
    """Return the corner and the covered shares of the pixels around a disc."""
    corner = np.floor(at).astype(int) - 13
    steps = (np.arange(26 * SUB) + 0.5) / SUB - 0.5
    inside = np.hypot(*np.meshgrid(steps + corner[0] - at[0], steps + corner[1] - at[1])) < radius
    return corner, inside.reshape(26, SUB, 26, SUB).mean(axis=(1, 3))


found = {FINE: [], LEVEL: []}
for _ in range(30):
    image = np.full((HEIGHT, WIDTH), 50.0)
    at = np.array([(u, v) for u in range(70, WIDTH - 60, 100) for v in range(60, HEIGHT - 50, 80)])
    at = at + rng.uniform(-8, 8, at.shape)
    for centre in at:
        (u, v), share = disc(centre, rng.choice([4.0, 6.0, 8.0]))
        image[v : v + 26, u : u + 26] += 150 * share
    for point in cv2.ORB_create(2000, 1.2, 8).detect(image.round().astype(np.uint8)):
        off = np.array(point.pt) - at
        nearest = off[np.hypot(*off.T).argmin()]
        if point.octave in found and np.hypot(*nearest) < 8:
            found[point.octave].append((point.pt[0] / WIDTH, nearest[0]))
print("OpenCV", cv2.__version__)
for level, points in found.items():
    share, off = np.array(points).T
    (left, slope), *_ = np.linalg.lstsq(np.column_stack([np.ones_like(share), share]), off, rcond=None)
    scale = 1.2**level
    real = WIDTH / round(WIDTH / scale)
    ends = [x / scale * (scale - real) - (real - 1) / 2 for x in (0, WIDTH)]
    print(
        f"level {level}, {len(off)} points: {left:.2f} px at the left, {left + slope:.2f} at the right;",
        f"by the sizes {ends[0]:.2f}, {ends[1]:.2f}",
    )
    assert abs(left - ends[0]) < 0.35 and abs(left + slope - ends[1]) < 0.35
PYTHON
done
