#!/usr/bin/env bash
# librealsense 2.59.1: `rotation_filter` turns images by 90 or 180 degrees and their intrinsics with them, but the principal point is one pixel off
# (width - ppx for width - 1 - ppx; pixels count from the centre of the first one), and the extrinsics stay those of the camera before.
# Of a pair turned by 180 degrees, a point 2 m away in the left image is projected 20 px from where the right image shows it: to the wrong side of it.
# Guessed: a profile of the frame that comes out describes that frame, as its size and focal lengths do.
# Matters here: a rig that is mounted upside down is turned so, and a calibration read from these profiles has the baseline the wrong way round and a pixel
# of offset. `vio` turns no image of a RealSense and reads the profiles of the streams themselves.
# Source: rotation-filter.cpp of librealsense; rs2::rotation_filter on a software_device; this run.
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

WIDTH, HEIGHT, FOCAL, CENTRE, BASELINE, DEPTH = 640, 480, 400.0, (310.0, 230.0), 0.05, 2.0
device = rs.software_device()
stereo = device.add_sensor("Stereo Module")
lens = rs.intrinsics()
lens.width, lens.height, lens.fx, lens.fy, lens.ppx, lens.ppy = WIDTH, HEIGHT, FOCAL, FOCAL, *CENTRE
lens.model, lens.coeffs = rs.distortion.brown_conrady, [0.0] * 5
cameras = []
for index in (1, 2):
    video = rs.video_stream()
    video.type, video.index, video.uid, video.fmt = rs.stream.infrared, index, index, rs.format.y8
    video.width, video.height, video.fps, video.bpp, video.intrinsics = WIDTH, HEIGHT, 20, 1, lens
    cameras.append(stereo.add_video_stream(video))
pose = rs.extrinsics()  # of points of the left camera to the right one, which is 5 cm further right
pose.rotation, pose.translation = [1, 0, 0, 0, 1, 0, 0, 0, 1], [-BASELINE, 0, 0]
cameras[0].register_extrinsics_to(cameras[1], pose)
queue = rs.frame_queue(10)
stereo.open(cameras)
stereo.start(queue)
at = (350, 250)  # of the point in the left image; in the right one by the disparity further left
frames = []
for camera, x in zip(cameras, (at[0], at[0] - round(FOCAL * BASELINE / DEPTH))):
    pixels = np.zeros((HEIGHT, WIDTH), np.uint8)
    pixels[at[1], x] = 255
    image = rs.software_video_frame()
    image.pixels, image.stride, image.bpp = pixels.tobytes(), WIDTH, 1
    image.timestamp, image.frame_number = 1000.0, 1
    image.domain, image.profile = rs.timestamp_domain.hardware_clock, camera.as_video_stream_profile()
    stereo.on_video_frame(image)
    frames.append(queue.wait_for_frame())


def projected_and_shown(frames):
    """Return where the profiles say that the right image shows the point of the left one, and where it does."""
    left, right = (frame.profile.as_video_stream_profile() for frame in frames)
    shown = [np.argwhere(np.asanyarray(frame.get_data()))[0, ::-1].astype(float) for frame in frames]
    point = rs.rs2_deproject_pixel_to_point(left.get_intrinsics(), list(shown[0]), DEPTH)
    moved = rs.rs2_transform_point_to_point(left.get_extrinsics_to(right), point)
    return np.array(rs.rs2_project_point_to_pixel(right.get_intrinsics(), moved)), shown[1]


print("pyrealsense2", rs.__version__)
turn = rs.rotation_filter([rs.stream.infrared])
for degrees, centre in ((0, CENTRE), (180, (WIDTH - 1 - CENTRE[0], HEIGHT - 1 - CENTRE[1])), (90, (HEIGHT - 1 - CENTRE[1], CENTRE[0]))):
    turn.set_option(rs.option.rotation, degrees)
    turned = [turn.process(frame) for frame in frames]
    stated = turned[0].profile.as_video_stream_profile().get_intrinsics()
    off = np.array([stated.ppx, stated.ppy]) - centre
    projected, shown = projected_and_shown(turned)
    print(f"turned by {degrees}: principal point {off} px off; right image: projected to {projected.round(2)}, shown at {shown}")
    assert np.array_equal(off, {0: [0, 0], 180: [1, 1], 90: [1, 0]}[degrees])
    wrong = {0: [0.0, 0.0], 180: [-20.0, 0.0], 90: [-10.0, 10.0]}[degrees]
    assert np.abs(projected - shown - wrong).max() < 0.01
PYTHON
