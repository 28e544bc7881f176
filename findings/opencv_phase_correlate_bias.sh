#!/usr/bin/env bash
# OpenCV 4.14.0 and 5.0.0: `phaseCorrelate` pulls shifts of sharp images to whole pixels: 0.45 px comes back as 0.14, 0.55 px as 0.86, the same for every scene, with a Hann
# window; without one by 0.2 px or more. The peak of such images is narrow and has negative sides, and the centroid of 5 x 5 values about its highest one weighs them. The
# response is above 0.9 all the same. Out of focus by 1 px it is right to 0.12 px with the window, and off by up to 0.45 px without.
# Guessed: "sub-pixel accuracy", as its documentation says, best where the images are sharpest; scikit-image's `phase_cross_correlation` finds these shifts to 0.01 px.
# Matters here: rows of left against right images, shifts between frames and rolling shutters measured like this are off by up to 0.33 px, more than a feature's noise, and the
# more the better the lens. A steady motion of half a pixel comes in steps of 0.2 and 0.8 px, like a shake. `vio` looks by it for views that alternate, in images reduced to a
# width of 96 px and above 0.2 px, where a steady half pixel alternates by 0.1 px.
# Source: https://docs.opencv.org/4.x/d7/df3/group__imgproc__motion.html; this run, with shifts made exactly by Fourier's theorem.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
for opencv in 4.14.0.94 5.0.0.93; do
    python3 -m pip --quiet --disable-pip-version-check install --target "$folder/$opencv" opencv-python-headless==$opencv numpy==2.4.6
    PYTHONPATH="$folder/$opencv" python3 - <<'PYTHON'
import cv2
import numpy as np

SIZE, CROP = 600, slice(150, 450)
Y, X = np.fft.fftfreq(SIZE)[:, None], np.fft.fftfreq(SIZE)[None]
FREQUENCY = np.hypot(Y, X)


def view(seed, shift_px, blur_px, noise_seed):
    """Image (300, 300) of a texture as of photographs, moved to the right and out of focus, 8 bits and noise."""
    spectrum = np.fft.fft2(np.random.default_rng(seed).normal(size=(SIZE, SIZE)))
    spectrum = np.divide(spectrum, FREQUENCY, out=np.zeros_like(spectrum), where=FREQUENCY > 0)
    moved = spectrum * np.exp(-2j * np.pi * X * shift_px - 2 * (np.pi * blur_px * FREQUENCY) ** 2)
    image = np.fft.ifft2(moved).real * 40 / np.fft.ifft2(spectrum).real.std() + 120
    noise = np.random.default_rng(noise_seed).normal(0, 0.5, image.shape)
    return np.clip(np.round(image + noise), 0, 255)[CROP, CROP].astype(np.float32)


print("OpenCV", cv2.__version__)
WINDOW = cv2.createHanningWindow((300, 300), cv2.CV_32F)
SHIFTS = (3.0, 3.2, 3.45, 3.55, 3.8)
for blur_px in (0.0, 0.5, 1.0):
    found = np.array([
        [cv2.phaseCorrelate(view(seed, 0, blur_px, 1), view(seed, d, blur_px, 2), *window) for d in SHIFTS]
        for seed in (0, 1)
        for window in ((), (WINDOW,))
    ], dtype=object)
    shifts = np.array([[at[0] for at, _ in row] for row in found])
    responses = np.array([[response for _, response in row] for row in found])
    print(f"out of focus by {blur_px} px, shifts {SHIFTS}: {shifts[1].round(2).tolist()} px; without window {shifts[0].round(2).tolist()}; responses {responses.min():.2f} to {responses.max():.2f}")
    off = shifts - SHIFTS
    print("    largest error with the window", np.abs(off[1::2]).max().round(2), "px, without", np.abs(off[::2]).max().round(2))
    if blur_px < 1:
        assert np.abs(off[:, 0]).max() < 0.05  # whole pixels are right
        windowed, plain = off[1::2], off[::2]
        assert (windowed[:, 2] < -0.25).all() and (windowed[:, 3] > 0.25).all() and np.ptp(windowed, axis=0).max() < 0.05
        assert (plain[:, 2] < -0.1).all() and (plain[:, 3] > 0.1).all()
    else:
        assert np.abs(off[1::2]).max() < 0.2  # with the window
PYTHON
done
