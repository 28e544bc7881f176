#!/usr/bin/env bash
# librealsense 2.59.1: frames of `disparity_transform` ("DISPARITY32") have disparities in 1/32 px, and in Python `get_data` returns the bits of these floats as
# uint32: a point 2 m away, 10 px by focal length and baseline, is 320.0, and in numpy 1134559232. `view(numpy.float32) / 32` is the disparity.
# Guessed: pixels, as the text of the format has it ("32-bit float-point disparity values ... Disparity = Baseline*FocalLength/Depth"); the 32 are its bits.
# Matters here: depths by the text's formula are 32 times too near, and disparities given as a right image's columns leave the image. `vio` takes the infrared
# images of a RealSense, never its depth.
# Source: rs_sensor.h (RS2_FORMAT_DISPARITY32) and disparity_info of librealsense ("fractional_bits"); software_device; this run.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m pip --quiet --disable-pip-version-check install --target "$folder/packages" pyrealsense2==2.59.1.11053 numpy==2.4.6
if ! python3 -c 'import ctypes; ctypes.CDLL("libusb-1.0.so.0")' 2>/dev/null; then # the wheel wants Debian's
    (cd "$folder" && apt-get download -qq libusb-1.0-0 2>/dev/null && dpkg -x libusb-1.0-0_*.deb "$folder/usb")
    export LD_LIBRARY_PATH="$folder/usb/usr/lib/x86_64-linux-gnu:$folder/usb/lib/x86_64-linux-gnu"
fi
PYTHONPATH="$folder/packages" python3 - <<'PYTHON'
import numpy as np
import pyrealsense2 as rs

WIDTH, HEIGHT, FOCAL, BASELINE = 640, 480, 400.0, 0.05
device = rs.software_device()
sensor = device.add_sensor("Stereo Module")
lens = rs.intrinsics()
lens.width, lens.height, lens.fx, lens.fy, lens.ppx, lens.ppy = WIDTH, HEIGHT, FOCAL, FOCAL, 319.5, 239.5
lens.model, lens.coeffs = rs.distortion.brown_conrady, [0.0] * 5
video = rs.video_stream()
video.type, video.index, video.uid, video.fmt = rs.stream.depth, 0, 1, rs.format.z16
video.width, video.height, video.fps, video.bpp, video.intrinsics = WIDTH, HEIGHT, 20, 2, lens
profile = sensor.add_video_stream(video)
sensor.add_read_only_option(rs.option.depth_units, 0.001)
sensor.add_read_only_option(rs.option.stereo_baseline, 1000.0 * BASELINE)  # of a D400: millimetres
queue = rs.frame_queue(10)
sensor.open(profile)
sensor.start(queue)
depths_mm = np.full((HEIGHT, WIDTH), 2000, np.uint16)
depths_mm[:, 320:] = 5000
image = rs.software_video_frame()
image.pixels, image.stride, image.bpp = depths_mm.tobytes(), 2 * WIDTH, 2
image.timestamp, image.frame_number, image.depth_units = 1000.0, 1, 0.001
image.domain, image.profile = rs.timestamp_domain.hardware_clock, profile.as_video_stream_profile()
sensor.on_video_frame(image)
depth = queue.wait_for_frame()
disparity = rs.disparity_transform(True).process(depth)
array = np.asanyarray(disparity.get_data())
print("pyrealsense2", rs.__version__, disparity.profile.format(), "as", array.dtype)
assert disparity.profile.format() == rs.format.disparity32 and array.dtype == np.uint32
for column in (100, 500):
    metres = depth.as_depth_frame().get_distance(column, 200)
    pixels, given = FOCAL * BASELINE / metres, array.view(np.float32)[200, column]
    print(f"  {metres:.3f} m: {pixels:.3f} px by focal length and baseline; {array[200, column]}, as a float {given:.3f}")
    assert np.isclose(metres, depths_mm[200, column] / 1000.0)
    assert np.isclose(given, 32.0 * pixels) and array[200, column] > 1e9
PYTHON
