#!/usr/bin/env bash
# Open3D 0.20.0: a trajectory written as TUM file (`write_pinhole_camera_trajectory`, .txt) has its first pose behind the header's comment, on the same line: who reads
# the file has one pose less, Open3D itself too. Times are numbers of rows, and one that is read loses them: two poses of a TUM file, written again, are one at time "1".
# The .log format of the same function keeps all poses.
# Guessed: a file of a format with times has the times, and what a function writes its twin reads; a count of poses that is one short is found nowhere.
# Matters here: rows against a list of frames are all one frame early, which at 20 Hz is a delay of 50 ms, and no alignment of trajectories removes it. TUM is the
# format of our trajectories too: one that Open3D reads and writes again has lost a pose and all times.
# Source: open3d.io.write_pinhole_camera_trajectory; evo 1.38.1, which reads the written file; this run.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m pip --quiet --disable-pip-version-check install --target "$folder/open3d" open3d-cpu==0.20.0 numpy==2.4.6
python3 -m pip --quiet --disable-pip-version-check install --target "$folder/evo" evo==1.38.1 numpy==2.4.6
cd "$folder"
if ! python3 -c 'import ctypes; ctypes.CDLL("libusb-1.0.so.0")' 2>/dev/null; then # the wheel wants Debian's
    apt-get download -qq libusb-1.0-0 2>/dev/null && dpkg -x libusb-1.0-0_*.deb usb
    export LD_LIBRARY_PATH="$folder/usb/usr/lib/x86_64-linux-gnu:$folder/usb/lib/x86_64-linux-gnu"
fi
PYTHONPATH="$folder/open3d" python3 - <<'PYTHON'
import numpy as np
import open3d as o3d


def poses_of(trajectory):
    """Return T_world_cam (N, 4, 4)."""
    return np.array([np.linalg.inv(p.extrinsic) for p in trajectory.parameters])


cameras = []
for x in range(5):
    camera = o3d.camera.PinholeCameraParameters()
    camera.intrinsic = o3d.camera.PinholeCameraIntrinsic(640, 480, 400.0, 400.0, 319.5, 239.5)
    camera.extrinsic = np.array([[1.0, 0, 0, -x], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]])  # the camera is at x metres
    cameras.append(camera)
drive = o3d.camera.PinholeCameraTrajectory()
drive.parameters = cameras
print("Open3D", o3d.__version__, "writes 5 poses, at x = 0 to 4 m")
for name in ("drive.txt", "drive.log"):
    assert o3d.io.write_pinhole_camera_trajectory(name, drive)
    back = poses_of(o3d.io.read_pinhole_camera_trajectory(name))[:, 0, 3]
    print(f"  {name}, read by Open3D: x = {np.round(back, 6).tolist()}")
    assert np.allclose(back, [1, 2, 3, 4] if name == "drive.txt" else [0, 1, 2, 3, 4])
first = open("drive.txt").readline()
print("  its first line:", first.strip())
assert first.startswith("#") and first.rstrip().endswith("1.000000") and "<qw>0 " in first

with open("stamped.txt", "w") as file:
    file.write("1403715273.262143 1 0 0 0 0 0 1\n1403715273.362143 2 0 0 0 0 0 1\n")
read = o3d.io.read_pinhole_camera_trajectory("stamped.txt")
o3d.io.write_pinhole_camera_trajectory("again.txt", read)
rows = [row for row in open("again.txt").read().splitlines() if row and row[0] != "#"]
print(f"  a file with two times, read ({len(read.parameters)} poses) and written again: {rows}")
assert len(read.parameters) == 2 and len(rows) == 1 and float(rows[0].split()[0]) == 1
PYTHON
PYTHONPATH="$folder/evo" python3 - <<'PYTHON'
from importlib.metadata import version

from evo.tools.file_interface import read_tum_trajectory_file

read = read_tum_trajectory_file("drive.txt")
print(f"  evo {version('evo')}: {read.num_poses} poses, times {read.timestamps.tolist()}, x = {read.positions_xyz[:, 0].tolist()}")
assert read.positions_xyz[:, 0].tolist() == [1, 2, 3, 4] and read.timestamps.tolist() == [1, 2, 3, 4]
PYTHON
