"""ros2 launch stereo_vio stereo_vio.launch.py left:=/cam0/image_raw right:=/cam1/image_raw
imu:=/imu0.
"""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, ExecuteProcess
from launch.substitutions import LaunchConfiguration

DEFAULTS = {
    "left": "/cam0/image_raw",
    "right": "/cam1/image_raw",
    "imu": "/imu0",
    "prefix": "/vio",
    "frames": "map,odom,base_link",
}


def generate_launch_description():
    """Start the command; without a calibration file it takes that of CameraInfo and /tf_static."""
    options = []
    for name in DEFAULTS:
        options += [f"--{name}", LaunchConfiguration(name)]
    return LaunchDescription(
        [
            *(DeclareLaunchArgument(name, default_value=value) for name, value in DEFAULTS.items()),
            ExecuteProcess(cmd=["vio", "ros2", "--transport", "rclpy", *options], output="screen"),
        ]
    )
