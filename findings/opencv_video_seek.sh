#!/usr/bin/env bash
# OpenCV 4.14.0 and 5.0.0: `VideoCapture.set` with CAP_PROP_POS_FRAMES or CAP_PROP_POS_MSEC counts in the mean frame rate of the file. In a video whose rate
# changes (30 to 15 Hz, as phones do in the dark) frame 40 of 60 is frame 48 and the time of frame 30 is that of frame 21; the last six are not found.
# CAP_PROP_POS_FRAMES then returns the number that was asked for, only CAP_PROP_POS_MSEC is the time of the frame that came.
# Guessed: the frame of that number or time, or a failure; reading in order gives every frame with its right time.
# Matters here: two videos of a stereo pair are cut or aligned so to a common start, a third of a second apart here. `vio`
# reads in order and takes the time of each frame.
# Source: docs.opencv.org, VideoCaptureProperties; this run.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m pip --quiet --disable-pip-version-check install --no-compile --target "$folder/av" av==18.1.0
for release in 4.14.0.94 5.0.0.93; do
    python3 -m pip --quiet --disable-pip-version-check install --no-compile --target "$folder/$release" "opencv-python-headless==$release" numpy==2.4.6
    PYTHONPATH="$folder/$release:$folder/av" python3 - "$folder/phone.mp4" <<'PYTHON'
import sys
from fractions import Fraction

import av
import cv2
import numpy as np

MILLISECOND = Fraction(1, 1000)
times_ms = [33 * k if k < 30 else 990 + 66 * (k - 30) for k in range(60)]
with av.open(sys.argv[1], "w") as container:
    stream = container.add_stream("mpeg4", rate=30)
    stream.width = stream.height = 64
    stream.time_base = stream.codec_context.time_base = MILLISECOND
    for number, time_ms in enumerate(times_ms):  # each frame is as bright as four times its number
        frame = av.VideoFrame.from_ndarray(np.full((64, 64, 3), 4 * number, np.uint8), "rgb24")
        frame.pts, frame.time_base = time_ms, MILLISECOND
        container.mux(stream.encode(frame))
    container.mux(stream.encode())


def read(video):
    """Return the number of the next frame by its brightness, and its time by CAP_PROP_POS_MSEC; None at the end."""
    found, image = video.read()
    return (round(image.mean() / 4), video.get(cv2.CAP_PROP_POS_MSEC)) if found else None


video = cv2.VideoCapture(sys.argv[1])
assert video.get(cv2.CAP_PROP_FRAME_COUNT) == 60
print("OpenCV", cv2.__version__, "PyAV", av.__version__, "frame rate of the file:", round(video.get(cv2.CAP_PROP_FPS), 2))
in_order = [read(video) for _ in times_ms]
assert all(abs(number - k) <= 1 for k, (number, _) in enumerate(in_order))  # a level or two of compression
assert np.allclose([time for _, time in in_order], times_ms)

for setting, asked in (("CAP_PROP_POS_FRAMES", range(60)), ("CAP_PROP_POS_MSEC", times_ms)):
    got = []
    for value in asked:
        video.set(getattr(cv2, setting), value)
        came = read(video)
        got.append(None if came is None else times_ms.index(round(came[1])))
        if setting == "CAP_PROP_POS_FRAMES" and came is not None:
            assert video.get(cv2.CAP_PROP_POS_FRAMES) == value + 1
    print(f"  {setting}:", ", ".join(f"of frame {k} -> {got[k]}" for k in range(0, 60, 10)), f", of frame 59 -> {got[59]}")
    off = [abs(number - k) for k, number in enumerate(got) if number is not None]
    print(f"    largest error {max(off)} frames; {got.count(None)} of 60 not found")
    assert max(off) >= 7 and got[59] is None
PYTHON
done
