#!/usr/bin/env bash
# imageio 2.38.1 (imageio-ffmpeg 0.8.1): frames of a video whose rate changes (30 to 15 Hz, as phones do in the dark) come on the even grid of its container's rate: 60 frames
# are read as 89, of which 29 show the frame before again. The rate that its metadata state is the mean, 20.69 Hz: times by it end at 4.3 s of a video of 3 s.
# A video at 30 Hz of which three frames are missing comes with four repeated ones and a rate of 28.57 Hz. `plugin="pyav"` reads each frame once.
# Guessed: a reader of frames yields the frames that are in the file, as OpenCV and PyAV do in order; or else a rate that belongs to what it yields.
# Matters here: a repeated frame is a standstill of one frame, then a jump of twice the motion; against an IMU, times are stretched by 45 %. Frames that go through
# imageio need the packets' own times; this project's reader of videos takes frames and times by OpenCV.
# Source: imageio_ffmpeg.read_frames and count_frames_and_secs; videos written by PyAV 18.1.0 whose frames carry their number; this run.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m pip --quiet --disable-pip-version-check install --target "$folder/packages" imageio==2.38.1 imageio-ffmpeg==0.8.1 av==18.1.0 numpy==2.4.6 pillow==13.0.0
PYTHONPATH="$folder/packages" python3 - "$folder" <<'PYTHON'
import sys
from fractions import Fraction
from importlib.metadata import version

import av
import imageio.v2
import imageio.v3
import imageio_ffmpeg
import numpy as np

WIDTH, HEIGHT, BITS = 160, 120, 8
CLOCK_HZ = 90_000


def write(path, times_s):
    """Write frame n, with the bits of n as stripes, at times_s[n]."""
    with av.open(path, "w") as file:
        stream = file.add_stream("libx264", rate=30, options={"crf": "10"})
        stream.width, stream.height, stream.pix_fmt = WIDTH, HEIGHT, "yuv420p"
        stream.time_base = stream.codec_context.time_base = Fraction(1, CLOCK_HZ)
        for number, time_s in enumerate(times_s):
            stripes = np.repeat([255 * (number >> bit & 1) for bit in range(BITS)], WIDTH // BITS)
            pixels = np.broadcast_to(stripes[None, :, None], (HEIGHT, WIDTH, 3)).astype(np.uint8)
            frame = av.VideoFrame.from_ndarray(pixels, format="rgb24")
            frame.pts, frame.time_base = round(time_s * CLOCK_HZ), stream.time_base
            file.mux(stream.encode(frame))
        file.mux(stream.encode())


def number_of(image):
    stripes = image[HEIGHT // 2, WIDTH // BITS // 2 :: WIDTH // BITS].mean(axis=-1) > 127
    return int(sum(1 << bit for bit in range(BITS) if stripes[bit]))


print("imageio", version("imageio"), "imageio-ffmpeg", version("imageio-ffmpeg"), "PyAV", av.__version__)
changing = np.r_[np.arange(30) / 30, 1 + np.arange(30) / 15]
missing = np.delete(np.arange(63) / 30, [20, 21, 40])
even = np.arange(60) / 30
for name, times_s in {"30, then 15 Hz": changing, "30 Hz, 3 missing": missing, "30 Hz": even}.items():
    path = f"{sys.argv[1]}/video.mp4"
    write(path, times_s)
    with imageio.v2.get_reader(path) as reader:
        numbers = [number_of(image) for image in reader.iter_data()]
        rate_hz = reader.get_meta_data()["fps"]
    assert [number_of(i) for i in imageio.v3.imiter(path, plugin="FFMPEG")] == numbers
    in_order = [number_of(i) for i in imageio.v3.imiter(path, plugin="pyav")]
    counted = imageio_ffmpeg.count_frames_and_secs(path)[0]
    repeated = len(numbers) - len(set(numbers))
    last_s = (len(numbers) - 1) / rate_hz
    print(
        f"  {name}: {len(times_s)} frames, the last at {times_s[-1]:.2f} s; read {len(numbers)}, {repeated} of them repeated,",
        f"at {rate_hz} Hz the last at {last_s:.2f} s; by pyav {len(in_order)}",
    )
    assert in_order == list(range(60)) and counted == 60
    if name == "30, then 15 Hz":
        assert repeated == 29 and 20 < rate_hz < 21 and last_s > 1.4 * times_s[-1]
    elif name == "30 Hz, 3 missing":
        assert repeated >= 2 and 28 < rate_hz < 29
    else:
        assert numbers == in_order and rate_hz == 30
PYTHON
