#!/usr/bin/env bash
# message_filters 1.15.15 (Debian 12, ROS 1's own Python class): `ApproximateTimeSynchronizer` emits images within `slop` as soon as they have come. Of a
# pair at 20 Hz with equal stamps, left image first and `slop` 0.1 s, one lost left image pairs the next left image with the right image before it; its own
# right image then waits for the left image after it, and so on: every pair from there on is of two frames, without end.
# Guessed: the policy of this name in C++ finds "the best match" of stamps, whatever the order in which they come; the loss costs one pair.
# Matters here: a right image 50 ms older than its left one shows motion as disparity: wrong depths, scale and rows. `vio` pairs stamps within 3 ms only, and
# finds by the images that saved pairs are of two frames (`pairs-shifted`).
# Source: message_filters/__init__.py; http://wiki.ros.org/message_filters/ApproximateTime; this run.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m pip --quiet --disable-pip-version-check install --target "$folder/packages" pyyaml==6.0.4 # which rospy imports
cd "$folder"
apt-get download -qq python3-message-filters=1.15.15+ds-2 python3-rospy=1.15.15+ds-2 python3-rosgraph=1.15.15+ds-2 python3-roslib=1.15.8-3 \
    python3-genpy=0.6.16-2 python3-genmsg=0.6.0-1 python3-rosgraph-msgs=1.11.3-2 python3-std-msgs=0.5.13-2 python3-roscpp-msg=1.15.15+ds-2 \
    python3-geometry-msgs=1.13.1-1 python3-sensor-msgs=1.13.1-1 python3-rospkg=1.4.0-2 python3-catkin=0.8.10-9 python3-catkin-pkg=0.5.2-5 2>/dev/null
for package in python3-*.deb; do dpkg -x "$package" debian; done
PYTHONPATH="$folder/packages:$folder/debian/usr/lib/python3/dist-packages" python3 - <<'PYTHON'
import message_filters
import rospy
from sensor_msgs.msg import Image

rospy.rostime.set_rostime_initialized(True)  # no master is needed
PERIOD_S, FRAMES = 0.05, 200


def pairs(slop_s, lost_left=()):
    """Return the numbers of the frames whose images are paired; left images come first."""
    left, right = message_filters.SimpleFilter(), message_filters.SimpleFilter()
    synchronizer = message_filters.ApproximateTimeSynchronizer([left, right], 10, slop_s)
    found = []
    synchronizer.registerCallback(lambda one, other: found.append((one.header.seq, other.header.seq)))
    for number in range(FRAMES):
        for camera in (left, right):
            if camera is right or number not in lost_left:
                image = Image()
                image.header.seq = number
                image.header.stamp = rospy.Time.from_sec(100.0 + PERIOD_S * number)
                camera.signalMessage(image)
    return found


print("message_filters 1.15.15")
for slop_s, lost_left, expected in (
    (0.1, (), [(k, k) for k in range(FRAMES)]),
    (0.01, (3,), [(k, k) for k in range(FRAMES) if k != 3]),
    (0.1, (3,), [(k, k) for k in range(3)] + [(k, k - 1) for k in range(4, FRAMES)]),
):
    found = pairs(slop_s, lost_left)
    apart = sum(one != other for one, other in found)
    print(f"slop {slop_s} s, lost left images {lost_left}: {len(found)} pairs, {apart} of two frames; the 3rd to 6th: {found[2:6]}")
    assert found == expected
PYTHON
