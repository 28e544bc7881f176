#!/usr/bin/env bash
# scikit-image 0.26.0: `phase_cross_correlation` with its defaults finds no motion between blurred images: views 1.4 px apart are 0.1 to 0.2 px apart by it once they are out of
# focus by 2 px (sigma), or blurred by a motion of 10 px, with 0.01 px as its unit and hardly any noise. Dividing by the magnitudes makes all frequencies count alike, and where
# the scene has none left, those of the images' borders, which do not move, win. And its error is 1 for any two images, equal ones too, so no number tells (with
# `normalization=None` 0 for equal ones, 0.4 for unrelated ones).
# Guessed: "normalized RMS error" is 0 for equal images; a shift of blurred images is less exact, not 0, or the error says so.
# Matters here: offsets of rows between left and right, and shifts from frame to frame that find a time offset or a standstill, are taken like this. Night, defocus and motion
# blur then look like a rig at rest with rows that agree. A Hann window and `normalization=None` find the shift within 0.05 px.
# Source: help(skimage.registration.phase_cross_correlation), which does not name it; skimage/registration/_phase_cross_correlation.py; this run.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m pip --quiet --disable-pip-version-check install --target "$folder/packages" scikit-image==0.26.0 scipy==1.17.1 numpy==2.3.5
PYTHONPATH="$folder/packages" python3 - <<'PYTHON'
import numpy as np
import skimage
from skimage.registration import phase_cross_correlation

SIZE, CROP = 600, slice(150, 450)
Y, X = np.fft.fftfreq(SIZE)[:, None], np.fft.fftfreq(SIZE)[None]
FREQUENCY = np.hypot(Y, X)


def scene(seed):
    """Spectrum of a texture that falls with the frequency, as those of photographs do."""
    spectrum = np.fft.fft2(np.random.default_rng(seed).normal(size=(SIZE, SIZE)))
    return np.divide(spectrum, FREQUENCY, out=np.zeros_like(spectrum), where=FREQUENCY > 0)


def view(spectrum, shift_px, blur_px, motion_px, seed):
    """Image (300, 300) of 8 bits, moved to the right, out of focus and blurred to the side."""
    moved = spectrum * np.exp(-2j * np.pi * X * shift_px - 2 * (np.pi * blur_px * FREQUENCY) ** 2)
    image = np.fft.ifft2(moved * np.sinc(X * motion_px)).real
    image = image * 40 / np.fft.ifft2(spectrum).real.std() + 120
    noise = np.random.default_rng(seed).normal(0, 0.5, image.shape)
    return np.clip(np.round(image + noise), 0, 255)[CROP, CROP]


print("scikit-image", skimage.__version__)
image, other = view(scene(0), 0, 0, 0, 1), view(scene(9), 0, 0, 0, 2)
for name, pair in (("equal", (image, image)), ("unrelated", (image, other))):
    default, plain = (phase_cross_correlation(*pair, normalization=n)[1] for n in ("phase", None))
    print(f"{name} images: error {default:.3f}; with normalization=None {plain:.3f}")
    assert abs(default - 1) < 1e-3 and (plain < 1e-3 if name == "equal" else plain > 0.3)
window = np.outer(np.hanning(300), np.hanning(300))
for blur_px, motion_px in ((0, 0), (1, 0), (2, 0), (3, 0), (1, 10)):
    found = []
    for seed in range(6):
        pair = [view(scene(seed), d, blur_px, motion_px, 10 + 2 * seed + (d > 0)) for d in (0, 1.4)]
        shift, error, _ = phase_cross_correlation(*pair, upsample_factor=100)
        pair = [(image - image.mean()) * window for image in pair]
        windowed = phase_cross_correlation(*pair, upsample_factor=100, normalization=None)[0]
        found.append((-shift[1], -windowed[1], error))
    shifts, windowed, errors = np.array(found).T
    print(f"1.4 px, out of focus by {blur_px}, motion {motion_px} px: {shifts.round(2).tolist()} px, errors {set(errors.round(3).tolist())};",
          f"windowed, without normalization {windowed.round(2).tolist()} px")
    assert np.abs(windowed - 1.4).max() < 0.05 and np.abs(errors - 1).max() < 1e-3
    if blur_px > 1 or motion_px:
        assert np.abs(shifts).max() < 0.3
    else:
        assert np.abs(shifts - 1.4).max() < (0.3 if blur_px else 0.05)
PYTHON
